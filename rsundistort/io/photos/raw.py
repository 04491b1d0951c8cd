"""RAW, developed by LibRaw, and what the file says of the photo."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...errors import FileError
from .containers import metadata_of
from .exif import COLOR_SPACE
from .metadata import Metadata
from .tiff import tiff_metadata

__all__ = ["read_raw"]

# LibRaw's rotations as EXIF orientations
_FLIPS = {3: 3, 5: 8, 6: 6}


def read_raw(data: bytes, name: str, check_size: Callable[[int, int], None]) -> tuple[NDArray[np.uint16], Metadata]:
    """Developed RAW, (h, w, 3) BGR, 16 bit sRGB, camera white balance, in the sensor's rows; and its metadata.

    Parameters
    ----------
    data, name
        Content of the file, and its name for errors.
    check_size : callable
        Called with width and height before anything is developed.
    """
    import rawpy

    try:
        with rawpy.imread(io.BytesIO(data)) as raw:
            check_size(raw.sizes.raw_width, raw.sizes.raw_height)
            rgb = raw.postprocess(use_camera_wb=True, output_bps=16, user_flip=0, no_auto_bright=True)
            flip = raw.sizes.flip
    except FileError:
        raise
    except (rawpy.LibRawError, OSError) as error:
        reason = error.args[0] if error.args else error
        text = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
        raise FileError(
            f"{name} cannot be developed ({text}); copy it again from the camera, or convert it to DNG"
        ) from error
    metadata = _metadata(data)
    if metadata.orientation == 1 and flip in _FLIPS:
        metadata = metadata.with_orientation(_FLIPS[flip])
    return np.ascontiguousarray(rgb[..., ::-1]), metadata


def _metadata(data: bytes) -> Metadata:
    """EXIF and XMP; none of CR3. The profile is that of the preview, and the colours are sRGB now."""
    if data.startswith(b"FUJIFILM"):  # keeps a whole JPEG
        at, length = (int.from_bytes(data[k : k + 4], "big") for k in (84, 88))
        found = metadata_of(data[at : at + length], "JPEG")
    else:
        found = tiff_metadata(data, without=frozenset([COLOR_SPACE]))
    return Metadata(found.exif, found.xmp)
