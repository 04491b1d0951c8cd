"""TIFF with its metadata: OpenCV packs the pixels, the tags around them are put here.

OpenCV keeps no metadata of a TIFF, follows its orientation whatever one says, and forgets what the fourth channel is.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .exif import ORIENTATION, Damaged, TiffStructure, described_entries, exif_of_tiff, exif_structure, pack_ifd
from .metadata import Metadata

__all__ = ["as_stored", "damaged_strips", "encode_tiff", "tiff_metadata"]

_STRIPS, _STRIP_LENGTHS, _PREDICTOR, _EXTRA_SAMPLES, _XMP, _ICC = 0x0111, 0x0117, 0x013D, 0x0152, 0x02BC, 0x8773
_COMPRESSION, _TILES, _TILE_LENGTHS = 0x0103, 0x0144, 0x0145
_DEFLATE = (8, 32946)
_BYTE, _SHORT, _LONG, _UNDEFINED = 1, 3, 4, 7
_NO_PREDICTION, _HORIZONTAL = 1, 2
_NO_COMPRESSION, _LZW = 1, 5
_STRAIGHT_ALPHA = 2


def tiff_metadata(data: bytes, without: frozenset[int] = frozenset()) -> Metadata:
    """What a TIFF-structured file (also RAW) says of the photo, but for some tags; nothing where it is damaged."""
    try:
        structure = TiffStructure(data)
        entries = structure.main()[0]
        xmp, icc = (structure.value(entries[tag]) if tag in entries else b"" for tag in (_XMP, _ICC))
        return Metadata(exif_of_tiff(data, without), xmp, icc)
    except Damaged:
        return Metadata()


def as_stored(data: bytes) -> bytes:
    """The file with tags such that OpenCV leaves its pixels as they are: not rotated, not multiplied by alpha."""
    patched = bytearray(data)
    try:
        structure = TiffStructure(data)
        entries = structure.main()[0]
        for tag, troubling, harmless in ((ORIENTATION, range(2, 9), 1), (_EXTRA_SAMPLES, (_STRAIGHT_ALPHA,), 0)):
            if tag in entries and entries[tag].kind == _SHORT and structure.number(entries[tag]) in troubling:
                struct.pack_into(structure.order + "H", patched, entries[tag].value_at, harmless)
    except Damaged:
        return data
    return bytes(patched)


def damaged_strips(data: bytes) -> int:
    """How many strips or tiles, packed by deflate, do not have their checksum: libtiff does not look at it."""
    try:
        structure = TiffStructure(data)
        entries = structure.main()[0]
        if _COMPRESSION not in entries or structure.number(entries[_COMPRESSION]) not in _DEFLATE:
            return 0
        tags = (_STRIPS, _STRIP_LENGTHS) if _STRIPS in entries else (_TILES, _TILE_LENGTHS)
        starts, lengths = (structure.numbers(entries[tag]) for tag in tags)
    except (Damaged, KeyError, struct.error):
        return 0
    return sum(not _is_whole_stream(data[at : at + length]) for at, length in zip(starts, lengths, strict=False))


def _is_whole_stream(packed: bytes) -> bool:
    inflater = zlib.decompressobj()
    try:
        while packed and not inflater.eof:
            inflater.decompress(packed, 1 << 20)  # bit by bit: it may be of any size
            packed = inflater.unconsumed_tail
    except zlib.error:
        return False
    return inflater.eof


def _pack_pixels(pixels: NDArray[Any], order: str) -> bytes:
    """A TIFF by OpenCV whose strips are in a byte order; whole numbers LZW of differences, floats as they are."""
    params = [cv2.IMWRITE_TIFF_COMPRESSION, _NO_COMPRESSION]
    if pixels.dtype.kind == "u":
        params = [cv2.IMWRITE_TIFF_COMPRESSION, _LZW, cv2.IMWRITE_TIFF_PREDICTOR, _NO_PREDICTION]
        # the differences are taken here, since OpenCV packs only the machine's byte order
        differences = pixels.copy()
        differences[:, 1:] -= pixels[:, :-1]
        pixels = differences
    if order == ">":
        pixels = pixels.byteswap()
    done, data = cv2.imencode(".tif", np.ascontiguousarray(pixels), params)
    if not done:
        raise InputError(f"an image {pixels.shape} {pixels.dtype} cannot be stored as TIFF")
    return bytes(data)


def encode_tiff(pixels: NDArray[Any], metadata: Metadata) -> tuple[bytes, list[str]]:
    """A TIFF of the pixels with the metadata, and what of it could not be kept.

    The EXIF block is itself a TIFF structure: it stays as it is, maker note and all, and strips and layout follow it.
    """
    lost = []
    described: list[tuple[int, int, int, bytes | int]] = []
    data = bytearray(b"II*\0" + bytes(4))
    if metadata.exif:
        try:
            described = list(described_entries(exif_structure(metadata.exif)))
        except Damaged as error:
            lost.append(f"the EXIF, which is damaged ({error})")
        if described:
            data = bytearray(metadata.exif)
    order = {b"II": "<", b"MM": ">"}[bytes(data[:2])]

    def append(content: bytes) -> int:
        data.extend(bytes(len(data) % 2))
        data.extend(content)
        return len(data) - len(content)

    packed = _pack_pixels(pixels, order)
    picture = TiffStructure(packed)
    values = {tag: picture.numbers(entry) for tag, entry in picture.main()[0].items() if entry.kind in (_SHORT, _LONG)}
    lengths = values[_STRIP_LENGTHS]
    values[_STRIPS] = tuple(
        append(packed[at : at + length]) for at, length in zip(values[_STRIPS], lengths, strict=True)
    )
    if pixels.dtype.kind == "u":
        values[_PREDICTOR] = (_HORIZONTAL,)
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        values[_EXTRA_SAMPLES] = (_STRAIGHT_ALPHA,)
    layout: list[tuple[int, int, int, bytes | int]] = []
    for tag, numbers in values.items():
        kind, form = (_LONG, "I") if max(numbers) > 65535 or tag == _STRIPS else (_SHORT, "H")
        layout.append((tag, kind, len(numbers), struct.pack(f"{order}{len(numbers)}{form}", *numbers)))
    for tag, kind, content in ((_XMP, _BYTE, metadata.xmp), (_ICC, _UNDEFINED, metadata.icc)):
        if len(content) > 4:
            layout.append((tag, kind, len(content), append(content)))
    layout += [entry for entry in described if entry[0] not in values]
    at = append(b"")
    if at >= 1 << 32:
        raise InputError("the image is too large for a TIFF, which ends at 4 GB")
    data += pack_ifd(order, layout, at)
    data[4:8] = struct.pack(order + "I", at)
    return bytes(data), lost
