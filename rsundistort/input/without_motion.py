"""Photos as they would have been without the rotation of their camera, to detect features in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..model import Camera, RowMotion
from ..model.array_types import Array
from ..rectify import distort_points, rectify, undistort_points
from ..rectify.photo import MAX_SIDE
from ..sfm import Features

__all__ = ["FrameWithoutMotion", "photo_without_motion"]

# Points along each side of a frame; times of its size that a photo may need when its motion is taken out.
_SAMPLES, _MOST = 33, 1.5
# Pixels from the border of what was seen, in those of the image that features are detected in, in which none are.
_BORDER_PX = 8.0


@dataclass(frozen=True)
class FrameWithoutMotion:
    """Where the pixels of a photo without lens and rotation are in the photo.

    Attributes
    ----------
    camera, motion : of the photo
    target : Camera
        Pinhole camera with the focal lengths of the photo, and all of it in its frame.
    """

    camera: Camera
    motion: RowMotion
    target: Camera

    @property
    def area_ratio(self) -> float:
        """Pixels for each of the photo's."""
        return self.target.width * self.target.height / (self.camera.width * self.camera.height)

    def in_photo(self, features: Features) -> Features:
        """Features that were detected without motion where the photo shows them."""
        xy = distort_points(features.xy_raw, self.camera, self.motion, P=self.target.K)
        inside = np.flatnonzero(((xy > -0.5) & (xy < [self.camera.width - 0.5, self.camera.height - 0.5])).all(axis=1))
        return replace(features.take(inside), xy_raw=xy[inside])


def photo_without_motion(
    pixels: NDArray[Any], mask: NDArray[np.uint8] | None, camera: Camera, motion: RowMotion, megapixels: float
) -> tuple[NDArray[Any], NDArray[np.uint8], FrameWithoutMotion]:
    """A photo without its lens and the rotation of its camera, where features may be detected in it, and its frame.

    Parameters
    ----------
    pixels, mask
        As in `rectify`.
    camera : Camera
        With a lens that a pinhole camera can show.
    motion : RowMotion
        Its rotation is taken out.
    megapixels : float
        Size of the photo in which features are detected: none near to the border of what it shows.
    """
    target = _whole(camera, motion)
    rectified, seen = rectify(pixels, camera, motion, new_camera=target, interpolation="linear", mask=mask)
    step_px = max(1.0, (camera.width * camera.height / (1e6 * megapixels)) ** 0.5)
    border = 2 * round(_BORDER_PX * step_px) + 1
    inner = cv2.erode(seen, np.ones((border, border), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return rectified, inner.astype(np.uint8), FrameWithoutMotion(camera, motion, target)


def _whole(camera: Camera, motion: RowMotion) -> Camera:
    """The pinhole camera of the photo's focal lengths whose frame holds all of it, within reason."""
    size = np.array([camera.width, camera.height])
    x, y = np.meshgrid(*(np.linspace(0, side - 1, _SAMPLES) for side in size))
    xy: Array = undistort_points(np.column_stack([x.ravel(), y.ravel()]), camera, motion, P=camera.K)
    xy = xy[np.isfinite(xy).all(axis=1)]
    most = 0.5 * np.minimum((_MOST - 1.0) * size, MAX_SIDE - size)
    low = np.floor(np.clip(xy.min(axis=0), -most, 0.0))
    high = np.ceil(np.clip(xy.max(axis=0), size - 1.0, size - 1.0 + most))
    K = camera.K.copy()
    K[:2, 2] -= low
    width, height = (high - low + 1.0).astype(int).tolist()
    return Camera(width, height, K, readout=camera.readout)
