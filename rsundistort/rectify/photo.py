"""Rectifying a photo strip by strip."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..model import Camera, RowMotion
from .maps import EDGE_PX, fill_rows, rectified_rays

__all__ = ["INTERPOLATIONS", "rectify"]

#: Interpolations of `rectify` by name.
INTERPOLATIONS: dict[str, int] = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}

_STRIP_ROWS = 64


def rectify(
    photo: NDArray[Any],
    camera: Camera,
    motion: RowMotion | None = None,
    shutter_model: str = "rotation",
    new_camera: Camera | None = None,
    interpolation: str = "cubic",
    jobs: int = 1,
    mask: NDArray[np.uint8] | None = None,
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """A photo as a global shutter without lens distortion would have taken it, and which pixels were seen.

    The grid is made and used in strips, so that no full-size float map is held.

    Parameters
    ----------
    photo : (h, w) or (h, w, channels) array
        uint8, uint16 or float32, in the stored pixel frame.
    camera, motion, shutter_model
        As in `init_rectify_map`.
    new_camera : Camera, optional
        Pinhole camera of the result (its distortion must be empty); the photo's size and K when left out.
    interpolation : {"cubic", "linear", "lanczos", "nearest"}
        OpenCV positions cubic and lanczos to 1/32 pixel.
    jobs : int
        Threads; the result does not depend on them.
    mask : (h, w) uint8 array, optional
        0 where pixels of the photo do not count: they are rectified, but not in the mask of the result.

    Returns
    -------
    rectified : array
        As `photo`, of the new camera's size; 0 where nothing was seen.
    valid : (h, w) uint8 array
        255 where a raw pixel (that counts) answers, else 0.
    """
    photo = np.asarray(photo)
    if photo.dtype not in (np.uint8, np.uint16, np.float32) or photo.ndim not in (2, 3):
        raise InputError(f"photo is {photo.dtype} {photo.shape}, expected uint8, uint16 or float32 (h, w[, channels])")
    if photo.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"photo has {photo.shape[1]}x{photo.shape[0]} pixels, its camera {camera.width}x{camera.height}"
        )
    if mask is not None and (mask.dtype != np.uint8 or mask.shape != photo.shape[:2]):
        raise InputError(f"mask is {mask.dtype} {mask.shape}, expected uint8 {photo.shape[:2]}")
    if interpolation not in INTERPOLATIONS:
        raise InputError(f"interpolation={interpolation!r}, expected one of {', '.join(INTERPOLATIONS)}")
    target = new_camera or camera.pinhole()
    if not target.is_pinhole:
        raise InputError("new_camera has lens distortion; a rectified photo has none")
    motion = motion or RowMotion()
    rays = rectified_rays(target.K, None, camera)
    shape = (target.height, target.width)
    rectified = np.empty(shape + photo.shape[2:], photo.dtype)
    valid = np.empty(shape, np.uint8)
    flag = INTERPOLATIONS[interpolation]

    def strip(row0: int) -> None:
        rows = slice(row0, min(row0 + _STRIP_ROWS, target.height))
        map_x = np.empty((rows.stop - row0, target.width), np.float32)
        map_y = np.empty_like(map_x)
        fill_rows(camera, motion, shutter_model, rays, row0, map_x, map_y)
        seen = (map_x >= -EDGE_PX) & (map_x <= camera.width - 1 + EDGE_PX)
        seen &= (map_y >= -EDGE_PX) & (map_y <= camera.height - 1 + EDGE_PX)
        # taps beyond the border repeat it, so that seen pixels at the edge keep their brightness
        values = cv2.remap(photo, map_x, map_y, flag, borderMode=cv2.BORDER_REPLICATE)
        values[~seen] = 0
        rectified[rows] = values.reshape(rectified[rows].shape)
        if mask is not None:
            seen &= cv2.remap(mask, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE) > 0
        valid[rows] = np.where(seen, 255, 0)

    starts = range(0, target.height, _STRIP_ROWS)
    if jobs == 1:
        for row0 in starts:
            strip(row0)
    else:
        with ThreadPoolExecutor(jobs) as pool:
            list(pool.map(strip, starts))
    return rectified, valid
