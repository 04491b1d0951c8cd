"""Small pictures of large photos, before and after."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError
from ..io import read_exif, read_photo
from ..io.photos.images import read_plain, stored_size
from ..io.photos.kinds import kind_of_content
from ..model.brightness import white_level
from ..model.orientation import compose_orientations, orient_pixels

__all__ = ["Picture", "PictureJob", "make_pictures"]

# Bytes of all pictures of a report, and of one at least and at most: 100 photos fill half of 15 MB, beside plotly.js.
_ALL_BYTES = 6_000_000
_BYTES = (5_500, 160_000)
# Approximate bytes that JPEG takes for a pixel of a reduced photo. WebP takes two thirds, and forty times as long.
_BYTES_PER_PIXEL = 0.17
_REDUCED = (8, cv2.IMREAD_REDUCED_COLOR_8), (4, cv2.IMREAD_REDUCED_COLOR_4), (2, cv2.IMREAD_REDUCED_COLOR_2)
_QUALITIES = (80, 70, 55, 40, 25)


@dataclass(frozen=True)
class PictureJob:
    """A photo to be reduced.

    Attributes
    ----------
    before, after : Path or None
        Raw and rectified photo, None where there is none.
    applied_orientation : int
        EXIF orientation that was applied to the rectified one.
    """

    before: Path | None
    after: Path | None
    applied_orientation: int = 1


@dataclass(frozen=True)
class Picture:
    """Both sides of a photo as JPEG, upright; None where one could not be had.

    `orientation` is the one that was applied to the stored frame.
    """

    before: bytes | None
    after: bytes | None
    orientation: int


def make_pictures(
    jobs: Sequence[PictureJob], threads: int, progress: Callable[[int], None] | None = None
) -> list[Picture]:
    """Small pictures of photos, the smaller the more there are; each thread holds one photo in memory at a time."""
    num_bytes = _bytes_of_each(len(jobs))
    pictures = []
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        for picture in pool.map(lambda job: _picture(job, num_bytes), jobs):
            pictures.append(picture)
            if progress is not None:
                progress(len(pictures))
    return pictures


def _bytes_of_each(count: int) -> int:
    """Bytes that each side of so many photos may take."""
    return int(np.clip(_ALL_BYTES / max(2 * count, 1), *_BYTES))


def _picture(job: PictureJob, num_bytes: int) -> Picture:
    # what players do to the rectified photo, and to the raw one unless that was done for good
    path = job.after or (job.before if job.applied_orientation == 1 else None)
    shown = 1 if path is None else read_exif(path).orientation or 1
    upright = compose_orientations(job.applied_orientation, shown)
    return Picture(_small(job.before, num_bytes, upright), _small(job.after, num_bytes, shown), upright)


def _small(path: Path | None, num_bytes: int, orientation: int) -> bytes | None:
    """A photo as a small JPEG; None if it cannot be read."""
    if path is None:
        return None
    side = float(np.sqrt(num_bytes / _BYTES_PER_PIXEL * 4 / 3))
    try:
        pixels = _decoded(path, side)
    except (FileError, InputError, cv2.error, OSError):
        return None
    scale = min(1.0, side / max(pixels.shape[:2]))
    if scale < 1:
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    pixels = orient_pixels(pixels, orientation)
    data = b""
    for quality in _QUALITIES:
        data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(data) <= num_bytes:
            break
    return data


def _decoded(path: Path, side: float) -> NDArray[np.uint8]:
    """(h, w, 3) pixels of a photo in the stored frame, somewhat larger than `side`: JPEG is decoded coarsely."""
    data = path.read_bytes()
    if kind_of_content(data, path.name) != "JPEG":
        return _as_bytes(read_photo(path).pixels)
    size = stored_size(path) or (0, 0)
    flag = next((flag for factor, flag in _REDUCED if max(size) >= factor * side), cv2.IMREAD_COLOR)
    pixels = read_plain(path, "photo", flag | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(pixels, np.uint8)


def _as_bytes(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Pixels of any depth and number of channels as 8-bit colours."""
    if pixels.dtype.kind == "f":
        pixels = np.clip(np.nan_to_num(pixels / white_level(pixels)), 0, 1) * 255
    elif pixels.dtype != np.uint8:
        pixels = np.minimum(pixels.astype(np.uint32) * 255 // int(white_level(pixels)), 255)
    pixels = np.atleast_3d(pixels)[..., :3].astype(np.uint8)
    return np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels
