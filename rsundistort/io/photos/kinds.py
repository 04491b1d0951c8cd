"""What a photo file is by its content, how large its picture is, and whether it is whole: all from its headers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from .boxes import primary_properties
from .exif import Damaged, TiffStructure

__all__ = [
    "HEIF_SUFFIXES",
    "PHOTO_SUFFIXES",
    "RAW_SUFFIXES",
    "can_hold",
    "is_whole",
    "jpeg_segments",
    "kind_of_content",
    "kind_of_name",
    "picture_size",
]

_KINDS = {
    **dict.fromkeys((".jpg", ".jpeg", ".jpe", ".jfif", ".jif", ".jfi", ".pjpeg", ".pjp"), "JPEG"),
    **{".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF", ".webp": "WebP"},
}
PHOTO_SUFFIXES = tuple(_KINDS)
RAW_SUFFIXES = (
    *(".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".nrw", ".rwl", ".crw", ".mrw"),
    *(".sr2", ".srf", ".3fr", ".fff", ".iiq", ".mos", ".mef", ".erf", ".dcr", ".kdc", ".x3f"),
)
HEIF_SUFFIXES = (".heic", ".heif", ".hif")
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")

_COLOUR_FILTER = 32803
# Markers of a JPEG that nothing follows: a stuffed byte, TEM, RST0 to RST7, SOI, EOI.
_ALONE = frozenset((0x00, 0x01, *range(0xD0, 0xDA)))
_DNG_VERSION, _SUB_IFDS, _PHOTOMETRIC = 0xC612, 0x014A, 0x0106


def kind_of_name(name: str) -> str:
    """The kind that a file's ending says: "JPEG", "PNG", "TIFF", "WebP", "HEIC", "RAW", or "" for others."""
    suffix = Path(name).suffix.lower()
    if suffix in RAW_SUFFIXES:
        return "RAW"
    return "HEIC" if suffix in HEIF_SUFFIXES else _KINDS.get(suffix, "")


def kind_of_content(data: bytes, name: str) -> str:
    """The kind that the content is of, as in `kind_of_name`; the ending distinguishes RAW from what looks like TIFF."""
    if data[:3] == b"\xff\xd8\xff":
        return "JPEG"
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return "PNG"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WebP"
    if data[4:8] == b"ftyp":
        return "RAW" if data[8:12] == b"crx " else "HEIC" if data[8:12] in _HEIF_BRANDS else ""
    if data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return "RAW" if _is_raw(data, kind_of_name(name) == "RAW") else "TIFF"
    # the others of many makers: LibRaw knows them
    return "RAW" if kind_of_name(name) == "RAW" else ""


def _is_raw(data: bytes, named_raw: bool) -> bool:
    """Whether a TIFF structure holds what the sensor saw, rather than a picture."""
    try:
        structure = TiffStructure(data)
        entries = structure.main()[0]
    except Damaged:
        return named_raw
    photometric = structure.number(entries[_PHOTOMETRIC]) if _PHOTOMETRIC in entries else None
    if _DNG_VERSION in entries or photometric == _COLOUR_FILTER:
        return True
    # RAW files of TIFF structure begin with a preview; a picture under the name of a RAW has no others in it
    is_picture = photometric is not None and _SUB_IFDS not in entries and data[8:10] != b"CR"
    return named_raw and not is_picture


def is_whole(data: bytes) -> bool:
    """Whether a JPEG or PNG has its end; some decoders fill what is missing with grey and say nothing.

    Of a PNG, chunk by chunk: OpenCV makes room for what each claims to hold, 4 GB perhaps.
    """
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        at = 8
        while at + 12 <= len(data) and data[at + 4 : at + 8] != b"IEND":
            at += 12 + int.from_bytes(data[at : at + 4], "big")
        return at + 12 <= len(data) and data[at : at + 4] == bytes(4)
    if data[:2] != b"\xff\xd8":
        return True
    before = max((end for _, _, end in jpeg_segments(data)), default=2)
    return data.rfind(b"\xff\xd9", before) > 0  # from behind, where it mostly is


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Marker, begin and end of the content of the segments before the pixels.

    What stands between them is passed over, as libjpeg does: it decodes such files, so nothing may hide there.
    """
    at = 2
    while (at := data.find(b"\xff", at)) >= 0 and at + 4 <= len(data):
        marker = data[at + 1]
        if marker == 0xDA:
            return
        if marker == 0xFF:  # padding
            at += 1
        elif marker in _ALONE:
            at += 2
        else:
            end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
            yield marker, at + 4, end
            at = max(end, at + 4)


def picture_size(data: bytes, kind: str) -> tuple[int, int] | None:
    """Width and height in pixels by the header, before anything is decoded; None where it does not say."""
    size = {"JPEG": _jpeg_size, "PNG": _png_size, "WebP": _webp_size, "TIFF": _tiff_size, "HEIC": _heif_size}.get(kind)
    return None if size is None else size(data)


def can_hold(data: bytes, kind: str, size: tuple[int, int]) -> bool:
    """Whether a file is long enough for a picture of this size, however well it was packed.

    zlib packs up to 1032 bytes into one. A JPEG has a bit or more for each block of 64 pixels, 6 for 256 of three
    channels. In a WebP of one colour pixels take nothing.
    """
    width, height = size
    if kind == "PNG":
        return width * height * data[24] // 8 <= 1100 * len(data)
    return kind not in ("JPEG", "TIFF") or width * height <= 8192 * len(data)


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    for marker, at, _ in jpeg_segments(data):
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and at + 5 <= len(data):  # start of frame
            return int.from_bytes(data[at + 3 : at + 5], "big"), int.from_bytes(data[at + 1 : at + 3], "big")
    return None


def _png_size(data: bytes) -> tuple[int, int] | None:
    if len(data) < 24 or data[8:16] != b"\0\0\0\rIHDR":
        return None
    return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")


def _webp_size(data: bytes) -> tuple[int, int] | None:
    chunk = data[12:16]
    if len(data) < 30:
        return None
    if chunk == b"VP8X":
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    if chunk == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    return int.from_bytes(data[26:28], "little") & 0x3FFF, int.from_bytes(data[28:30], "little") & 0x3FFF


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    try:
        structure = TiffStructure(data)
        entries = structure.main()[0]
        width, height = (structure.number(entries[tag]) for tag in (0x0100, 0x0101))
    except (Damaged, KeyError):
        return None
    return None if width is None or height is None else (width, height)


def _heif_size(data: bytes) -> tuple[int, int] | None:
    for name, content in primary_properties(data):
        if name == b"ispe" and len(content) >= 12:
            return int.from_bytes(content[4:8], "big"), int.from_bytes(content[8:12], "big")
    return None
