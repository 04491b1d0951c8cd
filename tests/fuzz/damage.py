"""Strategies that damage files by their structure: trees of values, texts, and binaries with marks."""

from __future__ import annotations

import copy
import json
import re
import struct
import zlib
from collections.abc import Callable

from hypothesis import strategies as st

NUMBERS = [
    0, -1, 1, 2, 3, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**53 + 1, 2**63, 2**64, 10**30, 10**400, 0.5, -0.0,
    1e-310, 1e-9, 1e9, 1e300, -1e300, float("nan"), float("inf"), float("-inf"),
]  # fmt: skip
TEXTS = [
    "", "0", "x", "nan", "-1", "../x", "/etc/passwd", "a\nb", "a\0b", "a/b.jpg", "\ud800", "x" * 100_000, "{{7*7}}",
    "<script>", "1e999", "%s%n", "\u202eabc",
]  # fmt: skip
VALUES = [
    None, True, False, *NUMBERS, *TEXTS, [], {}, [[]], [None], [1, 2, 3], ["x"] * 3, [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    [[[1.0]]], {"a": 1}, {"a": {"a": {}}}, [0] * 5000, [1e300, -1e300, 1e300],
]  # fmt: skip
TOKENS = [
    b"", b"0", b"-1", b"1e999", b"nan", b"inf", b"9" * 5000, b"1e-400", b"x", b"\0", b"\xff\xfe", b"\xef\xbb\xbf",
    b"\n", b"\r", b",", b'"', b"'", b"#", b"<", b">", b"</a>", b"<a>" * 500, b"&amp;", b"&x;", b"[" * 2000, b"]",
    b"{", b"}", b":", b"- ", b"&a [1]", b"*a", b"!!python/object/apply:os.system ['true']", b"!!binary x", b"<<: *a",
    b"x" * 100_000, b"..", b"4294967296", b"99999999999999999999", b"\t", b" " * 1000,
]  # fmt: skip
BYTES = [0, 1, 2, 0x7F, 0x80, 0xFF]
SIZES = [
    0, 1, 2, 3, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0xFFFFFFFF, 0x100000000, 0x7FFFFFFFFFFFFFFF,
]  # fmt: skip


def places(tree) -> list[tuple]:
    """Paths of all values of a tree but the whole."""
    found, open_ = [], [((), tree)]
    while open_:
        path, value = open_.pop()
        inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, each in inside:
            found.append((*path, key))
            open_.append(((*path, key), each))
    return found


def at(tree, path):
    for key in path:
        tree = tree[key]
    return tree


@st.composite
def trees(draw, tree):
    """A tree of which one to three values were replaced, dropped, doubled, wrapped, scaled or exchanged."""
    tree = copy.deepcopy(tree)
    for _ in range(draw(st.integers(1, 3))):
        paths = places(tree)
        if not paths:
            return tree
        path = paths[draw(st.integers(0, len(paths) - 1))]
        holder, key = at(tree, path[:-1]), path[-1]
        how = draw(st.sampled_from(["replace"] * 6 + ["drop", "double", "wrap", "exchange", "rename", "scale"]))
        if how == "replace":
            holder[key] = copy.deepcopy(draw(st.sampled_from(VALUES)))
        elif how == "drop":
            del holder[key]
        elif how == "double" and isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        elif how == "wrap":
            holder[key] = [holder[key]]
        elif how == "exchange":
            other = paths[draw(st.integers(0, len(paths) - 1))]
            holder[key] = copy.deepcopy(at(tree, other))
        elif how == "rename" and isinstance(holder, dict):
            holder[draw(st.sampled_from(TEXTS))] = holder.pop(key)
        elif how == "scale" and isinstance(holder[key], float):
            holder[key] *= draw(st.sampled_from([-1.0, 1e3, 1e-3, 1e12]))
    return tree


@st.composite
def json_texts(draw, tree):
    """A damaged tree as JSON, now and then damaged as a text, too."""
    text = json.dumps(draw(trees(tree))).encode()
    return draw(tokens(text)) if draw(st.integers(0, 4)) == 0 else text


@st.composite
def tokens(draw, data: bytes):
    """A text of which some words, signs or lines were replaced, dropped, doubled or cut off."""
    for _ in range(draw(st.integers(1, 3))):
        parts = re.findall(rb"[\w.+-]+|\n|\s+|.", data, re.DOTALL)
        if not parts:
            return draw(st.sampled_from(TOKENS))
        k = draw(st.integers(0, len(parts) - 1))
        how = draw(st.sampled_from(["replace"] * 4 + ["insert", "drop", "cut", "repeat", "line", "noise"]))
        if how == "replace":
            parts[k] = draw(st.sampled_from(TOKENS))
        elif how == "insert":
            parts.insert(k, draw(st.sampled_from(TOKENS)))
        elif how == "drop":
            del parts[k]
        elif how == "cut":
            parts = parts[:k]
        elif how == "repeat":
            parts[k] *= min(draw(st.sampled_from([2, 100, 20_000])), 1 + 1_000_000 // len(parts[k]))
        elif how == "line":
            lines = data.split(b"\n")
            m = draw(st.integers(0, len(lines) - 1))
            lines[m : m + 1] = [lines[m]] * draw(st.sampled_from([0, 2, 50]))
            parts = [b"\n".join(lines)]
        else:
            parts[k] = draw(st.binary(max_size=8))
        data = b"".join(parts)
    return data


@st.composite
def binaries(draw, data: bytes, marks: Callable[[bytes], list[int]] | None = None, mend=None):
    """Bytes of which some were changed, most near marks: where a format keeps sizes, counts and offsets."""
    marked = marks(data) if marks else []
    data = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        if not data:
            break
        near = marked and draw(st.integers(0, 3))
        start = marked[draw(st.integers(0, len(marked) - 1))] + draw(st.integers(0, 12)) if near else None
        k = min(start if start is not None else draw(st.integers(0, len(data) - 1)), len(data) - 1)
        how = draw(st.sampled_from(["size"] * 4 + ["byte"] * 3 + ["cut", "drop", "zero", "copy", "insert"]))
        length = draw(st.sampled_from([1, 2, 4, 8, 64, 1000]))
        if how == "size":
            width = draw(st.sampled_from([1, 2, 4, 8]))
            number = draw(st.sampled_from(SIZES)) % 256**width
            data[k : k + width] = number.to_bytes(width, draw(st.sampled_from(["little", "big"])))
        elif how == "byte":
            data[k] = draw(st.sampled_from(BYTES) | st.integers(0, 255))
        elif how == "cut":
            del data[k:]
        elif how == "drop":
            del data[k : k + length]
        elif how == "zero":
            data[k : k + length] = bytes(min(length, len(data) - k))
        elif how == "copy":
            data[k:k] = data[k : k + length]
        else:
            data[k:k] = draw(st.binary(max_size=16))
    damaged = bytes(data)
    return mend(damaged) if mend and draw(st.booleans()) else damaged


# ---------------------------------------------------------------- where formats keep their sizes


def png_marks(data: bytes) -> list[int]:
    found, k = [8], 8
    while k + 12 <= len(data):
        found += [k, k + 8]
        k += 12 + int.from_bytes(data[k : k + 4], "big")
    return [each for each in found if each < len(data)]


def png_mended(data: bytes) -> bytes:
    """The same with true checksums, so that what was damaged is looked at."""
    out, k = bytearray(data), 8
    while k + 12 <= len(data):
        end = k + 8 + int.from_bytes(data[k : k + 4], "big")
        if end + 4 > len(data):
            break
        out[end : end + 4] = struct.pack(">I", zlib.crc32(data[k + 4 : end]))
        k = end + 4
    return bytes(out)


def jpeg_marks(data: bytes) -> list[int]:
    return [match.start() for match in re.finditer(rb"\xff[\xc0-\xfe]", data[:4000])]


def tiff_marks(data: bytes) -> list[int]:
    order = "<" if data[:2] == b"II" else ">"
    found, (k,) = [0, 4], struct.unpack_from(order + "I", data, 4)
    for _ in range(4):
        if not 0 < k <= len(data) - 2:
            break
        (count,) = struct.unpack_from(order + "H", data, k)
        found += [k, *(k + 2 + 12 * n for n in range(min(count, 60)))]
        k = struct.unpack_from(order + "I", data, k + 2 + 12 * count)[0] if k + 6 + 12 * count <= len(data) else 0
    return [each for each in found if each < len(data)]


def riff_marks(data: bytes) -> list[int]:
    found, k = [0, 4, 8], 12
    while k + 8 <= len(data):
        found += [k, k + 4, k + 8, k + 12]
        size = int.from_bytes(data[k + 4 : k + 8], "little")
        k += 8 + size + size % 2
    return [each for each in found if each < len(data)]


def box_marks(data: bytes, start: int = 0, end: int | None = None) -> list[int]:
    """Boxes of MP4, whatever they hold: those that hold boxes are looked into."""
    found, k, end = [], start, len(data) if end is None else end
    while k + 8 <= end:
        size, kind = int.from_bytes(data[k : k + 4], "big"), data[k + 4 : k + 8]
        if size < 8 or k + size > end:
            break
        found += [k, k + 8, k + 16, k + 24]
        if kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf"):
            found += box_marks(data, k + 8, k + size)
        k += size
    return [each for each in found if each < len(data)]


def klv_marks(data: bytes) -> list[int]:
    """Keys of GPMF."""
    return [match.start() for match in re.finditer(rb"[A-Z]{4}", data)]


def zip_marks(data: bytes) -> list[int]:
    heads = [match.start() for match in re.finditer(rb"PK..", data)]
    return [h + step for h in heads for step in (0, 8, 18, 22, 26, 28)] + [
        m.start() for m in re.finditer(rb"NUMPY", data)
    ]
