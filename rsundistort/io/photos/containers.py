"""Where JPEG, PNG and WebP keep EXIF, XMP and ICC: taking the blocks out, and putting them into encoded pictures."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

from .exif import MAKER_NOTE, Damaged, exif_of_tiff
from .kinds import jpeg_segments, picture_size
from .metadata import Metadata
from .xmp import marked_xmp, rectified_by

__all__ = ["Parts", "metadata_of", "with_metadata"]

_EXIF_HEAD = b"Exif\0\0"
_XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\0"
_ICC_HEAD = b"ICC_PROFILE\0"
_PNG_XMP_HEAD = b"XML:com.adobe.xmp\0"
_SEGMENT = 65533  # most bytes in one segment of a JPEG

# a profile of colours is some kilobytes; a bomb is not
_MOST_INFLATED = 64 << 20

# one behind another; pictures are megabytes, which nobody should copy without need
Parts = list[bytes | memoryview]


def metadata_of(data: bytes, kind: str) -> Metadata:
    """EXIF, XMP and ICC of a file of a kind; what is damaged beyond finding is left out."""
    return {"JPEG": _of_jpeg, "PNG": _of_png, "WebP": _of_webp}[kind](data)


def with_metadata(encoded: memoryview, kind: str, metadata: Metadata) -> tuple[Parts, list[str]]:
    """An encoded picture with metadata put in, as the parts of its file, and what could not be kept."""
    return {"JPEG": _into_jpeg, "PNG": _into_png, "WebP": _into_webp}[kind](encoded, metadata)


# ---------------------------------------------------------------- JPEG


def _of_jpeg(data: bytes) -> Metadata:
    exif = xmp = b""
    profile: dict[int, bytes] = {}
    for marker, begin, end in jpeg_segments(data):
        content = data[begin:end]
        if marker == 0xE1 and content.startswith(_EXIF_HEAD):
            exif = exif or content[6:]
        elif marker == 0xE1 and content.startswith(_XMP_HEAD):
            xmp = xmp or content[len(_XMP_HEAD) :]
        elif marker == 0xE2 and content.startswith(_ICC_HEAD):
            profile[content[12]] = content[14:]
    return Metadata(exif, xmp, b"".join(profile[k] for k in sorted(profile)))


def _into_jpeg(encoded: memoryview, metadata: Metadata) -> tuple[Parts, list[str]]:
    exif, xmp, icc = metadata.exif, metadata.xmp, metadata.icc
    lost = []
    if len(exif) > _SEGMENT - len(_EXIF_HEAD):
        lost.append("the maker note, which is too long for a JPEG")
        try:
            exif = exif_of_tiff(exif, without=frozenset([MAKER_NOTE]))
        except Damaged:
            exif = b""
        if len(exif) > _SEGMENT - len(_EXIF_HEAD):
            lost, exif = ["the EXIF, which is too long for a JPEG"], b""
    if len(xmp) > _SEGMENT - len(_XMP_HEAD):
        lost.append("the XMP, which is too long for a JPEG")
        version = rectified_by(xmp)
        xmp = b"" if version is None else marked_xmp(b"", version)
    step = _SEGMENT - len(_ICC_HEAD) - 2
    chunks = [icc[k : k + step] for k in range(0, len(icc), step)]
    if len(chunks) > 255:
        lost.append("the ICC profile, which is too long for a JPEG")
        chunks = []
    contents = [(0xE1, _EXIF_HEAD + exif)] if exif else []
    contents += [(0xE1, _XMP_HEAD + xmp)] if xmp else []
    contents += [(0xE2, _ICC_HEAD + bytes([k + 1, len(chunks)]) + chunk) for k, chunk in enumerate(chunks)]
    block = b"".join(struct.pack(">BBH", 0xFF, marker, len(content) + 2) + content for marker, content in contents)
    # behind JFIF's own segment, where readers look for it
    at = 2 + 2 + int.from_bytes(encoded[4:6], "big") if encoded[2:4] == b"\xff\xe0" else 2
    return [encoded[:at], block, encoded[at:]], lost


# ---------------------------------------------------------------- PNG


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 8
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        yield data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        at += 12 + length


def _inflated(data: bytes) -> bytes:
    try:
        inflater = zlib.decompressobj()
        out = inflater.decompress(data, _MOST_INFLATED)
    except zlib.error:
        return b""
    return out if inflater.eof else b""


def _of_png(data: bytes) -> Metadata:
    exif = xmp = icc = b""
    for name, content in _png_chunks(data):
        if name == b"eXIf":
            exif = content.removeprefix(_EXIF_HEAD)
        elif name == b"iCCP":
            icc = _inflated(content[content.find(b"\0") + 2 :])
        elif name == b"iTXt" and content.startswith(_PNG_XMP_HEAD):
            rest = content[len(_PNG_XMP_HEAD) :]
            text = rest[2:].split(b"\0", 2)[-1]  # after the language and the translated keyword
            xmp = _inflated(text) if rest[:1] == b"\1" else text
    return Metadata(exif, xmp, icc)


def _stored(data: bytes) -> bytes:
    """A zlib stream that does not compress: where pycolmap came first, compressing aborts (see images.py)."""
    out = b"\x78\x01"
    pieces = [data[k : k + 65535] for k in range(0, len(data), 65535)] or [b""]
    for k, piece in enumerate(pieces):
        out += struct.pack("<BHH", k == len(pieces) - 1, len(piece), len(piece) ^ 0xFFFF) + piece
    return out + struct.pack(">I", zlib.adler32(data))


def _into_png(encoded: memoryview, metadata: Metadata) -> tuple[Parts, list[str]]:
    chunks = [(b"iCCP", b"ICC profile\0\0" + _stored(metadata.icc))] if metadata.icc else []
    chunks += [(b"iTXt", _PNG_XMP_HEAD + b"\0\0\0\0" + metadata.xmp)] if metadata.xmp else []
    chunks += [(b"eXIf", metadata.exif)] if metadata.exif else []
    block = b"".join(
        struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        for name, content in chunks
    )
    at = 8 + 25  # behind the header chunk
    return [encoded[:at], block, encoded[at:]], []


# ---------------------------------------------------------------- WebP


def _riff_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 12
    while at + 8 <= len(data):
        length = int.from_bytes(data[at + 4 : at + 8], "little")
        yield data[at : at + 4], data[at + 8 : at + 8 + length]
        at += 8 + length + length % 2


def _of_webp(data: bytes) -> Metadata:
    chunks = dict(reversed(list(_riff_chunks(data))))
    exif = chunks.get(b"EXIF", b"").removeprefix(_EXIF_HEAD)
    return Metadata(exif, chunks.get(b"XMP ", b""), chunks.get(b"ICCP", b""))


def _into_webp(picture: memoryview, metadata: Metadata) -> tuple[Parts, list[str]]:
    encoded = bytes(picture)
    size = picture_size(encoded, "WebP")
    assert size is not None
    chunks = list(_riff_chunks(encoded))
    head = next((content for name, content in chunks if name == b"VP8X"), None)
    flags = head[0] if head else 0
    if head is None and chunks[0][0] == b"VP8L" and chunks[0][1][4] & 0x10:
        flags = 0x10  # alpha
    flags |= (0x20 if metadata.icc else 0) | (0x08 if metadata.exif else 0) | (0x04 if metadata.xmp else 0)
    extended = bytes([flags, 0, 0, 0]) + (size[0] - 1).to_bytes(3, "little") + (size[1] - 1).to_bytes(3, "little")
    every = [(b"VP8X", extended)]
    every += [(b"ICCP", metadata.icc)] if metadata.icc else []
    every += [chunk for chunk in chunks if chunk[0] in (b"ALPH", b"VP8 ", b"VP8L")]
    every += [(b"EXIF", metadata.exif)] if metadata.exif else []
    every += [(b"XMP ", metadata.xmp)] if metadata.xmp else []
    body = b"".join(
        name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2) for name, content in every
    )
    return [b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP", body], []
