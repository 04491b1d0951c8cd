"""Cameras that nobody described, and that no pinhole lens describes: fisheyes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..model import Camera
from ..model.field import MOST_FIELD_PX, excess_px
from .photo_cameras import PhotoCameras

__all__ = ["cameras_as_fisheyes", "fisheye_apart_px"]

# Places across and down at which lenses are compared; those of a pinhole end before 90 degrees.
_ACROSS = 33
_PINHOLE_ENDS = np.radians(85.0)
# Focal length of an equidistant fisheye of 180 degrees from corner to corner, as a share of the diagonal.
_FULL_FRAME = 1.0 / np.pi


def fisheye_apart_px(camera: Camera) -> float:
    """By how many pixels an equidistant fisheye of this focal length differs from the nearest pinhole lens.

    Root mean square over what lies ahead of the camera, after k1, k2, k3 and another focal length.
    """
    x, y = ((np.arange(_ACROSS) + 0.5) / _ACROSS * side - 0.5 for side in (camera.width, camera.height))
    radius = np.hypot(*np.meshgrid(x - camera.K[0, 2], y - camera.K[1, 2])).ravel() / camera.K[0, 0]
    radius = radius[radius < _PINHOLE_ENDS]
    tan = np.tan(radius)[:, None] ** [1, 3, 5, 7]
    tan /= np.linalg.norm(tan, axis=0)
    apart = tan @ np.linalg.lstsq(tan, radius)[0] - radius
    return float(camera.K[0, 0] * np.sqrt((apart**2).mean()))


def cameras_as_fisheyes(
    cameras: PhotoCameras, found: Sequence[Camera], *, is_unexplained: bool, varies: bool
) -> tuple[PhotoCameras, list[str]] | None:
    """The cameras of photos after those that no pinhole lens describes became fisheyes.

    Parameters
    ----------
    found : sequence of Camera
        Estimates of the same cameras.
    is_unexplained, varies : bool
        Whether the estimates leave more of the photos than noise, or need a lens that varies. Then, or where a lens
        needs a residual field, cameras may be fisheyes whose view is so wide that this makes a difference.

    Returns
    -------
    cameras : PhotoCameras
        A fisheye has the focal length and the principal point found, which lie on its axis, and no coefficients: those
        of a pinhole lens say nothing about them. Where no file tells the focal length, and what was found explains
        nothing, it is at most that of a full-frame fisheye, which shows 180 degrees from corner to corner.
    notes : list of str
        Which cameras, for people; None if all are described, or given.
    """
    if cameras.calibrated:
        return None
    changed, labels = [*cameras.cameras], list[str]()
    for k, (camera, estimate) in enumerate(zip(cameras.cameras, found, strict=True)):
        wide = _at_most(estimate, _FULL_FRAME) if is_unexplained and k in cameras.without_focal else estimate
        is_odd = is_unexplained or varies or estimate.field.size > 0
        may_be = excess_px(estimate) > 0 or (is_odd and fisheye_apart_px(wide) > MOST_FIELD_PX)
        if estimate.lens == "pinhole" and may_be:
            changed[k] = replace(camera, K=wide.K, dist=np.zeros(0), lens="fisheye")
            labels.append(cameras.labels[k])
    notes = [
        f"no pinhole lens explains the photos of {label}, and a fisheye does: solved as of one; rectified photos show "
        "the middle of it (--alpha: more)"
        for label in labels
    ]
    return (replace(cameras, cameras=tuple(changed)), notes) if notes else None


def _at_most(camera: Camera, share: float) -> Camera:
    """A camera whose focal length is at most a share of the diagonal."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= min(1.0, share * float(np.hypot(camera.width, camera.height)) / K[0, 0])
    return replace(camera, K=K)
