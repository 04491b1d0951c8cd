"""HEIC and HEIF, decoded by libheif through pillow-heif (extra `heif`)."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from ...model.orientation import INVERSE, compose_orientations, orient_pixels
from .boxes import primary_properties
from .metadata import Metadata

__all__ = ["heif_metadata", "read_heif"]

# what libheif raises of files that are damaged
_BROKEN = (ValueError, EOFError, SyntaxError, RuntimeError, OSError, IndexError)

# irot rotates anticlockwise in steps of 90 degrees; imir exchanges top and bottom, or left and right
_ROTATIONS, _MIRRORS = {0: 1, 1: 8, 2: 3, 3: 6}, {0: 4, 1: 2}


def _orientation(data: bytes) -> int:
    """The EXIF orientation that does what the file's own rotation and mirror do."""
    orientation = 1
    for name, content in primary_properties(data):
        if name == b"irot" and content:
            orientation = compose_orientations(orientation, _ROTATIONS[content[0] & 3])
        elif name == b"imir" and content:
            orientation = compose_orientations(orientation, _MIRRORS[content[0] & 1])
    return orientation


def _opened(data: bytes, name: str) -> Any:
    """The picture, not decoded yet."""
    try:
        import pillow_heif
    except ImportError:
        raise FileError(f'{name} is HEIC; reading it needs: pip install "rsundistort[heif]"') from None
    return pillow_heif.open_heif(io.BytesIO(data), convert_hdr_to_8bit=False, bgr_mode=True)


def _metadata(data: bytes, image: Any) -> Metadata:
    """The picture's metadata, with the orientation that counts in HEIF: the one of its own properties."""
    info = image.info
    exif = info.get("exif") or b""
    metadata = Metadata(exif.removeprefix(b"Exif\0\0"), info.get("xmp") or b"", info.get("icc_profile") or b"")
    return metadata.with_orientation(_orientation(data))


@contextmanager
def _decoding(name: str) -> Iterator[None]:
    try:
        yield
    except FileError:
        raise
    except _BROKEN as error:
        raise FileError(
            f"{name} cannot be decoded ({' '.join(str(error).split())}); copy it again from the camera"
        ) from error


def heif_metadata(data: bytes, name: str) -> Metadata:
    """The metadata alone, as `read_heif` gives it."""
    with _decoding(name):
        return _metadata(data, _opened(data, name))


def read_heif(data: bytes, name: str) -> tuple[NDArray[np.uint16], Metadata]:
    """Pixels in the stored frame, BGR(A) or grey, 16 bit; and the metadata.

    libheif rotates the pixels by the file's irot and imir properties, which are what counts in HEIF: that is undone,
    and becomes the EXIF orientation, whatever the EXIF said.
    """
    with _decoding(name):
        image = _opened(data, name)
        pixels = np.array(np.asarray(image))
        metadata = _metadata(data, image)
    if pixels.dtype == np.uint8:
        pixels = pixels.astype(np.uint16) * 257
    return orient_pixels(pixels, INVERSE[_orientation(data)]), metadata
