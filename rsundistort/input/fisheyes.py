"""Cameras that nobody described, and that no pinhole lens describes: fisheyes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..model import Camera
from ..model.field import MOST_FIELD_PX, fisheye_apart_px
from .photo_cameras import PhotoCameras

__all__ = ["cameras_as_fisheyes", "cameras_as_pinholes"]

# Focal length of an equidistant fisheye of 180 degrees from corner to corner, as a share of the diagonal.
_FULL_FRAME = 1.0 / np.pi


def cameras_as_fisheyes(
    cameras: PhotoCameras, found: Sequence[Camera], *, is_unexplained: bool, doubted: bool
) -> tuple[PhotoCameras, list[str]] | None:
    """The cameras of photos after those that no pinhole lens describes became fisheyes.

    Parameters
    ----------
    found : sequence of Camera
        Estimates of the same cameras.
    is_unexplained, doubted : bool
        Whether the estimates leave more of the photos than noise; whether a pinhole lens is in doubt all the same, as
        one that varies is. Then, or where a lens needs a residual field, cameras whose view is so wide that this makes
        a difference become fisheyes.

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
        is_odd = is_unexplained or doubted or estimate.field.size > 0
        if estimate.lens == "pinhole" and is_odd and fisheye_apart_px(wide) > MOST_FIELD_PX:
            changed[k] = replace(camera, K=wide.K, dist=np.zeros(0), lens="fisheye")
            labels.append(cameras.labels[k])
    notes = [
        f"no pinhole lens explains the photos of {label}, and a fisheye does: solved as of one; rectified photos show "
        "the middle of it (--alpha: more)"
        for label in labels
    ]
    return (replace(cameras, cameras=tuple(changed)), notes) if notes else None


def cameras_as_pinholes(cameras: PhotoCameras, found: Sequence[Camera]) -> PhotoCameras | None:
    """The cameras after fisheyes that a pinhole lens follows as well became such; None if there are none.

    Photos by which no pinhole lens was found may have one all the same: a fisheye's coefficients follow its tangent.

    Parameters
    ----------
    found : sequence of Camera
        Estimates of the same cameras, whose focal lengths are taken.
    """
    changed = [
        replace(camera, K=estimate.K, dist=np.zeros(0), lens="pinhole")
        if estimate.lens == "fisheye" and fisheye_apart_px(estimate) <= MOST_FIELD_PX
        else camera
        for camera, estimate in zip(cameras.cameras, found, strict=True)
    ]
    return None if changed == [*cameras.cameras] else replace(cameras, cameras=tuple(changed))


def _at_most(camera: Camera, share: float) -> Camera:
    """A camera whose focal length is at most a share of the diagonal."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= min(1.0, share * float(np.hypot(camera.width, camera.height)) / K[0, 0])
    return replace(camera, K=K)
