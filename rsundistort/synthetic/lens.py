"""OpenCV's lens models and their inverses, iterated to rounding: the truth must not use our own.

OpenCV's default of five steps back is wrong by whole pixels at the edge of a wide lens, and
`cv2.fisheye.undistortPoints` treats all that lies beyond pi/2 focal lengths from the centre as if it lay there.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..model import Camera
from ..model.array_types import Array

__all__ = ["clock_at", "distort_rays", "undistort_to_rays"]

_TIGHT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)

#: Angles of a fisheye in the table where its inverse starts: neighbours are so near that three Newton steps end it.
_ANGLES = np.linspace(0.0, np.pi / 2, 4097)


def distort_rays(rays_c: ArrayLike, camera: Camera, K: ArrayLike | None = None) -> Array:
    """Pixels (n, 2) of directions or points (n, 3) of the camera frame, without shutter; K in place of the camera's."""
    _check_lens(camera)
    rays, K = np.asarray(rays_c, np.float64).reshape(-1, 1, 3), np.array(camera.K if K is None else K, np.float64)
    dist, still = np.array(camera.dist) if len(camera.dist) else None, np.zeros(3)
    if camera.lens == "fisheye":
        uv = cv2.fisheye.projectPoints(rays, still, still, K, np.zeros(4) if dist is None else dist)[0]
    else:
        uv = cv2.projectPoints(rays, still, still, K, dist)[0]
    return np.asarray(uv, np.float64).reshape(-1, 2)


def undistort_to_rays(uv_raw: ArrayLike, camera: Camera) -> Array:
    """Undistorted normalised coordinates (..., 2) of pixels (..., 2); of a fisheye NaN from 90 degrees on."""
    _check_lens(camera)
    uv, K = np.asarray(uv_raw, np.float64), np.array(camera.K)
    if camera.is_pinhole:
        return np.asarray((uv - K[:2, 2]) / np.diag(K)[:2], np.float64)
    if camera.lens == "fisheye":
        return _fisheye_rays((uv - K[:2, 2]) / np.diag(K)[:2], camera.dist)
    flat, dist = uv.reshape(-1, 1, 2), np.array(camera.dist)
    # OpenCV 4 takes the criteria in a function of its own, OpenCV 5 in the one
    if hasattr(cv2, "undistortPointsIter"):
        rays = cv2.undistortPointsIter(flat, K, dist, np.eye(3), np.eye(3), _TIGHT)
    else:
        rays = cv2.undistortPoints(flat, K, dist, criteria=_TIGHT)
    return np.asarray(rays, np.float64).reshape(uv.shape)


def clock_at(camera: Camera, lines: NDArray[Any]) -> Array:
    """The clock when lines are read, by their places along the readout: rows, or columns, in pixels of any shape."""
    axis = camera.clock_axis
    return np.asarray(camera.clock_sign * (lines - camera.K[axis, 2]) / camera.K[axis, axis], np.float64)


def _check_lens(camera: Camera) -> None:
    if camera.field.size:
        raise InputError("the camera has a residual field, which is not simulated; take the key field out of its file")


def _fisheye_rays(distorted: Array, dist: Array) -> Array:
    """Undistorted from distorted normalised coordinates (..., 2) of a fisheye."""
    k1, k2, k3, k4 = dist if len(dist) else np.zeros(4)
    radius_of = Polynomial([0, 1, 0, k1, 0, k2, 0, k3, 0, k4])
    table = radius_of(_ANGLES)
    falls = np.flatnonzero(np.diff(table) <= 0)
    end = falls[0] + 1 if len(falls) else len(table)
    radius = np.linalg.norm(distorted, axis=-1)
    angle = np.interp(radius, table[:end], _ANGLES[:end], right=np.nan)
    for _ in range(3):
        angle -= (radius_of(angle) - radius) / radius_of.deriv()(angle)
    scale = np.divide(np.tan(angle), radius, out=np.ones_like(radius), where=radius > 0)
    return np.asarray(distorted * scale[..., None], np.float64)
