"""Pixels of TIFF files: OpenCV decodes them; layouts that it would mix up are put before it in grey parts."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from .exif import Damaged, Entry, TiffStructure, pack_ifd
from .tiff import as_stored
from .tiff_layout import CMYK, HORIZONTAL, MIN_IS_BLACK, MIN_IS_WHITE, RGB, TiffLayout, check_pages, layout_of

__all__ = ["misread_as_plain", "read_tiff"]

_WIDTH, _LENGTH, _BITS, _COMPRESSION, _PHOTOMETRIC, _FILL_ORDER = 0x0100, 0x0101, 0x0102, 0x0103, 0x0106, 0x010A
_STRIPS, _SAMPLES, _ROWS_PER_STRIP, _STRIP_LENGTHS = 0x0111, 0x0115, 0x0116, 0x0117
_PLANAR, _PREDICTOR, _TILE_WIDTH, _TILE_LENGTH, _TILES, _TILE_LENGTHS = 0x011C, 0x013D, 0x0142, 0x0143, 0x0144, 0x0145
_EXTRA_SAMPLES, _FORMAT, _JPEG_TABLES = 0x0152, 0x0153, 0x015B
_LONG, _UNDEFINED = 4, 7
_UNSIGNED, _FLOAT = 1, 3  # numbers, in the tag

_Decode = Callable[[bytes | bytearray], NDArray[Any]]


def read_tiff(data: bytes, name: str, decode: _Decode) -> NDArray[Any]:
    """Pixels of the first picture in the stored frame: uint8, uint16 or float32; grey, BGR or BGRA.

    Grey with alpha becomes BGRA, signed numbers unsigned ones, floats of 16 and 64 bits those of 32; numbers of 10 to
    14 bits are multiplied so that white is that of 16; what has 0 for white is inverted. Otherwise no value changes.

    Parameters
    ----------
    data, name
        Content of the file, and its name for errors.
    decode : callable
        Gives the pixels of a file as OpenCV reads it.

    Raises
    ------
    FileError
        When it is damaged, or of a kind that is not read.
    """
    try:
        structure = TiffStructure(data)
        entries, _, following = structure.main()
        layout = layout_of(structure, entries)
        if layout is not None:
            check_pages(structure, entries, following, layout, name)
    except Damaged:
        layout = None
    if layout is None:  # OpenCV may see further
        return decode(as_stored(data))
    if what := layout.refusal():
        mend = "save it as grey or RGB of 8 or 16 bits, or of 32-bit floats"
        raise FileError(f"{name} is a TIFF {what}, which are not read; {mend}")
    try:
        pixels = decode(as_stored(data)) if layout.is_plain else _by_planes(structure, entries, layout, decode)
    except FileError as error:
        if how := layout.unusual_compression():
            raise FileError(f"{name} is a TIFF packed by {how}, which is not read; pack it by LZW") from error
        raise
    except (Damaged, LookupError, struct.error, ValueError) as error:
        raise FileError(f"{name} cannot be decoded: its tags are damaged ({error}); copy it again") from error
    return _as_photo(pixels, layout, name)


def misread_as_plain(data: bytes) -> str:
    """What a TIFF is that OpenCV alone would read otherwise than it is meant; empty for others."""
    try:
        structure = TiffStructure(data)
        layout = layout_of(structure, structure.main()[0])
    except Damaged:
        return ""
    if layout is None or layout.bits <= 8:
        return ""
    if layout.photometric == MIN_IS_WHITE and layout.form == "u":
        return f"a TIFF of {layout.bits} bits of which 0 is white"
    return f"a TIFF of {layout.bits} bits whose channels stand apart" if layout.planar and layout.samples > 1 else ""


def _by_planes(
    structure: TiffStructure, entries: dict[int, Entry], layout: TiffLayout, decode: _Decode
) -> NDArray[Any]:
    """Numbers as stored, in one of OpenCV's orders of channels, or (h, w, 2)."""

    def plane(**change: int) -> NDArray[Any]:
        pixels = decode(_rewritten(structure, entries, layout, **change))
        return pixels.view(f"{layout.form}{pixels.itemsize}")

    if layout.planar and layout.samples > 1:
        planes = [plane(number=k) for k in range(layout.samples)]
        return np.dstack([*planes[2::-1], *planes[3:]] if layout.samples > 2 else planes)
    if layout.samples != 2:
        return plane(samples=layout.samples)
    # two channels are none of OpenCV's kinds, but a grey picture twice as wide is
    numbers = plane(widen=2).reshape(layout.height, layout.width, 2)
    if layout.differences == HORIZONTAL:
        step = layout.width if _TILE_WIDTH not in entries else structure.number(entries[_TILE_WIDTH]) or layout.width
        bits = numbers.view(f"u{numbers.itemsize}")
        for x in range(0, layout.width, step):
            bits[:, x : x + step] = np.cumsum(bits[:, x : x + step], axis=1, dtype=bits.dtype)
    return numbers


def _rewritten(
    structure: TiffStructure,
    entries: dict[int, Entry],
    layout: TiffLayout,
    number: int = 0,
    samples: int = 1,
    widen: int = 1,
) -> bytearray:
    """The file with other tags, of unsigned numbers or floats: of a channel that stands apart, or of all as grey."""
    order = structure.order
    is_float = layout.form == "f" and layout.bits > 16
    tags = {
        _WIDTH: (widen * layout.width,),
        _LENGTH: (layout.height,),
        _BITS: samples * (layout.bits,),
        _COMPRESSION: (layout.compression,),
        _PHOTOMETRIC: (MIN_IS_BLACK if samples == 1 else RGB,),
        _SAMPLES: (samples,),
        _PLANAR: (1,),
        _FORMAT: samples * (_FLOAT if is_float else _UNSIGNED,),
    }
    if layout.differences > 1 and widen == 1:
        tags[_PREDICTOR] = (layout.differences,)
    if samples == 4:
        tags[_EXTRA_SAMPLES] = (0,)
    for tag in (_FILL_ORDER, _ROWS_PER_STRIP, _TILE_WIDTH, _TILE_LENGTH):
        if tag in entries:
            tags[tag] = (structure.numbers(entries[tag])[0] * (widen if tag == _TILE_WIDTH else 1),)
    for tag in (_STRIPS, _STRIP_LENGTHS, _TILES, _TILE_LENGTHS):
        if tag in entries:
            values = structure.numbers(entries[tag])
            each = len(values) // layout.samples if layout.planar else len(values)
            tags[tag] = values[number * each : (number + 1) * each]
    packed: list[tuple[int, int, int, bytes | int]] = [
        (tag, _LONG, len(values), struct.pack(f"{order}{len(values)}I", *values)) for tag, values in tags.items()
    ]
    if _JPEG_TABLES in entries:
        tables = structure.value(entries[_JPEG_TABLES])
        packed.append((_JPEG_TABLES, _UNDEFINED, len(tables), tables))
    # as a classic TIFF, whatever it was: where its strips are stays true
    data = bytearray(structure.data)
    data += bytes(len(data) % 2)
    data[2:8] = struct.pack(order + "HI", 42, len(data))
    return data + pack_ifd(order, packed, len(data))


def _as_photo(pixels: NDArray[Any], layout: TiffLayout, name: str) -> NDArray[Any]:
    """Numbers as a photo has them."""
    if pixels.dtype.kind == "i":
        if pixels.min() < 0:
            raise FileError(f"{name} is a TIFF with negative numbers, which no photo has; save it as unsigned ones")
        pixels = pixels.view(f"u{pixels.itemsize}")
    if pixels.dtype.kind == "f":
        with np.errstate(over="ignore"):
            pixels = pixels.astype(np.float32, copy=False)
    unused = 16 - layout.bits if layout.form == "u" and layout.bits in (10, 12, 14) else 0
    if unused and not _multiplies(layout.bits):
        pixels = pixels << unused
    if layout.is_plain:
        # OpenCV makes three channels of four inks, and adds one that says that they cover
        return np.ascontiguousarray(pixels[..., :3]) if layout.photometric == CMYK and pixels.ndim == 3 else pixels
    if layout.photometric == MIN_IS_WHITE:
        most = ((1 << (layout.bits - (layout.form == "i"))) - 1) << unused
        grey = pixels if pixels.ndim == 2 else pixels[..., :1]
        np.subtract(most, grey, out=grey)
    if layout.samples == 2:
        pixels = pixels[..., [0, 0, 0, 1]]
    return pixels


@cache
def _multiplies(bits: int) -> bool:
    """Whether this version of OpenCV makes numbers of so many bits the highest of 16, rather than the lowest."""
    numbers = {_WIDTH: 8, _LENGTH: 1, _BITS: bits, _COMPRESSION: 1, _PHOTOMETRIC: MIN_IS_BLACK, _STRIPS: 8}
    numbers |= {_SAMPLES: 1, _ROWS_PER_STRIP: 1, _STRIP_LENGTHS: bits}
    start = struct.pack("<2sHI", b"II", 42, 24) + bytes(16 * [255])
    tags: list[tuple[int, int, int, bytes | int]] = [
        (tag, _LONG, 1, struct.pack("<I", value)) for tag, value in numbers.items()
    ]
    white = cv2.imdecode(np.frombuffer(start + pack_ifd("<", tags, 24), np.uint8), cv2.IMREAD_UNCHANGED)
    return white is not None and int(white.max()) >= 1 << bits
