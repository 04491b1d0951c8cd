"""How the pictures of a TIFF file are stored, and which of that is not read."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace

from ...errors import FileError, SkippedPhotoWarning
from .exif import Damaged, Entry, TiffStructure

__all__ = ["CMYK", "HORIZONTAL", "MIN_IS_BLACK", "MIN_IS_WHITE", "RGB", "TiffLayout", "check_pages", "layout_of"]

_SUBFILE, _WIDTH, _LENGTH, _BITS, _COMPRESSION, _PHOTOMETRIC = 0x00FE, 0x0100, 0x0101, 0x0102, 0x0103, 0x0106
_SAMPLES, _PLANAR, _PREDICTOR, _SUB_IFDS, _FORMAT = 0x0115, 0x011C, 0x013D, 0x014A, 0x0153
_LONG, _IFD = 4, 13

MIN_IS_WHITE, MIN_IS_BLACK, RGB = 0, 1, 2
HORIZONTAL = 2  # the predictor that takes differences
_PALETTE, CMYK = 3, 5
_COLOUR_SPACES = {_PALETTE: "palette", CMYK: "CMYK", 6: "YCbCr", 8: "Lab", 9: "Lab", 10: "Lab"}
_LOG_LUV = (32844, 32845)
_FORMS = {1: "u", 2: "i", 3: "f", 4: "u"}
_FORM_NAMES = {"u": "whole numbers", "i": "signed numbers", "f": "floats"}
_DEPTHS = {"u": (8, 10, 12, 14, 16), "i": (8, 16), "f": (16, 32, 64)}
# Every libtiff unpacks these; whether it does others depends on how it was built.
_COMPRESSIONS = (1, 2, 3, 4, 5, 6, 7, 8, 32773, 32946, 34676, 34677)
_WITH_PREDICTOR = (5, 8, 32946, 50000)
_OTHER_COMPRESSIONS = {34712: "JPEG 2000", 34887: "LERC", 34925: "LZMA", 50000: "Zstandard", 50001: "WebP"}

# Bits of the kind of a picture.
_REDUCED, _MASK = 1, 4
# Pictures of so small a part of the first one's pixels are its thumbnails, even where they do not say so.
_OF_A_THUMBNAIL = 0.25
_MOST_PICTURES = 1000


@dataclass(frozen=True)
class TiffLayout:
    """How the first picture of a file is stored.

    Attributes
    ----------
    photometric, predictor, compression : int
        Values of their tags.
    bits : int
        Of a number; 0 if the channels differ.
    samples : int
        Channels of a pixel.
    form : str
        "u", "i" or "f" as in NumPy; "" for others, and if the channels differ.
    planar : bool
        Whether the channels stand one behind another.
    """

    width: int
    height: int
    photometric: int
    bits: int
    samples: int
    form: str
    planar: bool
    predictor: int
    compression: int

    @property
    def is_plain(self) -> bool:
        """Whether OpenCV decodes it rightly as it is.

        With more than 8 bits it takes what it finds for interleaved, and for brighter the larger it is.
        """
        if self.form == "u" and self.bits <= 8:
            return self.photometric > MIN_IS_BLACK or self.samples == 1
        if self.photometric in _LOG_LUV:
            return True
        if self.planar and self.samples > 1:
            return False
        if self.form == "f":
            return self.bits > 16 and self.samples != 2
        colours = {MIN_IS_BLACK: (1,), RGB: (3, 4)}.get(self.photometric, ())
        return self.form == "u" and self.samples in colours

    @property
    def differences(self) -> int:
        """The predictor, where the way of packing heeds it; 1 for none."""
        return self.predictor if self.compression in _WITH_PREDICTOR else 1

    def refusal(self) -> str:
        """What it is, if that is not read."""
        if not self.form or not self.bits:
            return "of numbers of several depths, or of an unknown kind"
        if not 1 <= self.samples <= 4:
            return f"of {self.samples} channels"
        few = self.form == "u" and (self.bits in (1, 8) or (self.bits == 4 and self.photometric == _PALETTE))
        if few or self.photometric in _LOG_LUV:
            return ""
        if self.bits not in _DEPTHS[self.form]:
            return f"of {_FORM_NAMES[self.form]} of {self.bits} bits"
        if self.photometric > RGB:
            space = _COLOUR_SPACES.get(self.photometric, "unknown")
            return f"of {space} colours in {_FORM_NAMES[self.form]} of {self.bits} bits"
        if self.photometric == MIN_IS_WHITE and (self.form == "f" or self.samples > 2):
            return f"of {self.samples} channels of {_FORM_NAMES[self.form]} of which 0 is white"
        if self.samples == 2 and not self.planar and self.differences > HORIZONTAL:
            return "of grey floats with alpha that are packed by differences"
        return ""

    def unusual_compression(self) -> str:
        """The name of how it is packed, if that may not be unpacked."""
        if self.compression in _COMPRESSIONS:
            return ""
        return _OTHER_COMPRESSIONS.get(self.compression, f"method {self.compression}")


def layout_of(structure: TiffStructure, entries: dict[int, Entry]) -> TiffLayout | None:
    """The layout of the picture of an IFD; None where the file does not say."""

    def number(tag: int, default: int) -> int:
        return default if tag not in entries else structure.number(entries[tag]) or 0

    def common(tag: int, default: int) -> int:
        """The value of all channels; 0 if they differ."""
        values = {default} if tag not in entries else {*structure.numbers(entries[tag])}
        return values.pop() if len(values) == 1 else 0

    try:
        if not {_WIDTH, _LENGTH, _PHOTOMETRIC} <= entries.keys():
            return None
        return TiffLayout(
            number(_WIDTH, 0), number(_LENGTH, 0), number(_PHOTOMETRIC, 0), common(_BITS, 1), number(_SAMPLES, 1),
            _FORMS.get(common(_FORMAT, 1), ""), number(_PLANAR, 1) == 2, number(_PREDICTOR, 1), number(_COMPRESSION, 1),
        )  # fmt: skip
    except (Damaged, KeyError, struct.error):
        return None


def _further_pictures(
    structure: TiffStructure, entries: dict[int, Entry], following: int
) -> Iterator[tuple[int, int, int]]:
    """Width, height and kind of the pictures behind the first, and of those in it."""
    inside: tuple[int, ...] = ()
    if _SUB_IFDS in entries and entries[_SUB_IFDS].kind in (_LONG, _IFD):
        inside = structure.numbers(replace(entries[_SUB_IFDS], kind=_LONG))
    for k in range(_MOST_PICTURES):
        if k < len(inside):
            at, named = inside[k], structure.ifd(inside[k], "a picture")[0]
        else:
            at = following
            if not at:
                return
            named, _, following = structure.ifd(at, "a picture")
        values = {e.tag: structure.number(e) or 0 for e in named if e.tag in (_SUBFILE, _WIDTH, _LENGTH)}
        if _WIDTH in values and _LENGTH in values:
            yield values[_WIDTH], values[_LENGTH], values.get(_SUBFILE, 0)


def check_pages(
    structure: TiffStructure, entries: dict[int, Entry], following: int, layout: TiffLayout, name: str
) -> None:
    """Refuse a file that begins with a thumbnail; warn of one that holds several pictures."""
    num_others = 0
    for width, height, kind in _further_pictures(structure, entries, following):
        if kind & _MASK:
            continue
        if width * height > layout.width * layout.height:
            raise FileError(
                f"{name} is a TIFF that begins with a picture of {layout.width}x{layout.height} pixels and holds one "
                f"of {width}x{height}; save the one that is meant as a file of its own"
            )
        num_others += not kind & _REDUCED and width * height > _OF_A_THUMBNAIL * layout.width * layout.height
    if num_others:
        warnings.warn(
            f"{name} holds {num_others + 1} pictures, of which only the first is read; "
            "save the others as files of their own if they are meant",
            SkippedPhotoWarning,
            stacklevel=2,
        )
