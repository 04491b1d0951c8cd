"""TIFF files of any layout, written tag by tag: the numbers are packed here, by no library that reads them."""

from __future__ import annotations

import struct
import zlib

import numpy as np

_FORMS = {"u": 1, "i": 2, "f": 3}
_METHODS = {"none": 1, "lzw": 5, "deflate": 8}


def _lzw(data: bytes) -> bytes:
    """Codes of 9 bits that stand for themselves, with a new table before they would have to be longer."""
    codes = []
    for k in range(0, len(data), 200):
        codes += [256, *data[k : k + 200]]
    text = "".join(f"{code:09b}" for code in [*codes, 257])
    return int(text.ljust(-(-len(text) // 8) * 8, "0"), 2).to_bytes(-(-len(text) // 8), "big")


def _packed_bits(rows: np.ndarray, bits: int) -> bytes:
    """Numbers of less than 16 bits, the rows padded to whole bytes."""
    every = np.unpackbits(rows.astype(">u2").view(np.uint8).reshape(*rows.shape, 2), axis=2)[..., 16 - bits :]
    return np.packbits(every.reshape(len(rows), -1), axis=1).tobytes()


def _block(values: np.ndarray, order: str, predictor: int, bits: int) -> bytes:
    """Bytes of a block (h, w, samples) of a strip or tile, differences taken."""
    if predictor == 2:
        values = values.copy()
        whole = values.view(f"u{values.itemsize}")
        whole[:, 1:] -= whole[:, :-1].copy()
    if bits < 8 * values.itemsize:
        return _packed_bits(values.reshape(len(values), -1), bits)
    if predictor == 3:  # the bytes of a row by their weight, and differences of these
        height, width, samples = values.shape
        heavy_first = values.astype(values.dtype.newbyteorder(">")).view(np.uint8).reshape(height, width * samples, -1)
        planes = heavy_first.transpose(0, 2, 1).reshape(height, -1).copy()
        planes[:, samples:] -= planes[:, :-samples].copy()
        return planes.tobytes()
    return values.astype(values.dtype.newbyteorder(order)).tobytes()


def tiff_file(
    values: np.ndarray,
    photometric: int,
    extra: tuple[int, ...] = (),
    planar: bool = False,
    method: str = "none",
    predictor: int = 1,
    order: str = "<",
    tile: int = 0,
    bits: int = 0,
    rows_per_strip: int = 16,
) -> bytes:
    """A file of (h, w, samples) numbers; `tile` is the side of its tiles, 0 for strips."""
    height, width, samples = values.shape
    bits = bits or 8 * values.itemsize
    blocks = []
    for part in np.split(values, samples, axis=2) if planar else [values]:
        if tile:
            padded = np.pad(part, ((0, -height % tile), (0, -width % tile), (0, 0)))
            places = [(y, x) for y in range(0, height, tile) for x in range(0, width, tile)]
            blocks += [padded[y : y + tile, x : x + tile] for y, x in places]
        else:
            blocks += [part[y : y + rows_per_strip] for y in range(0, height, rows_per_strip)]
    pack = {"none": bytes, "lzw": _lzw, "deflate": zlib.compress}[method]
    packed = [pack(_block(np.ascontiguousarray(block), order, predictor, bits)) for block in blocks]
    data = b""
    starts = []
    for each in packed:
        starts.append(8 + len(data))
        data += each + bytes(len(each) % 2)
    tags = {
        0x0100: [width], 0x0101: [height], 0x0102: [bits] * samples, 0x0103: [_METHODS[method]],
        0x0106: [photometric], 0x0115: [samples], 0x011C: [2 if planar else 1],
        0x0153: [_FORMS[values.dtype.kind]] * samples,
    }  # fmt: skip
    if predictor > 1:
        tags[0x013D] = [predictor]
    if extra:
        tags[0x0152] = [*extra]
    if tile:
        tags |= {0x0142: [tile], 0x0143: [tile], 0x0144: starts, 0x0145: [len(each) for each in packed]}
    else:
        tags |= {0x0111: starts, 0x0116: [rows_per_strip], 0x0117: [len(each) for each in packed]}
    at = 8 + len(data)
    behind, head, tail = at + 2 + 12 * len(tags) + 4, struct.pack(order + "H", len(tags)), b""
    for tag, numbers in sorted(tags.items()):
        kind, form = (4, "I") if tag in (0x0111, 0x0117, 0x0144, 0x0145) else (3, "H")
        raw = struct.pack(f"{order}{len(numbers)}{form}", *numbers)
        field = raw.ljust(4, b"\0") if len(raw) <= 4 else struct.pack(order + "I", behind + len(tail))
        tail += b"" if len(raw) <= 4 else raw + bytes(len(raw) % 2)
        head += struct.pack(order + "HHI", tag, kind, len(numbers)) + field
    start = b"II*\0" if order == "<" else b"MM\0*"
    return start + struct.pack(order + "I", at) + data + head + bytes(4) + tail
