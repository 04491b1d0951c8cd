"""OpenCV's inverse lens model, iterated to rounding: the truth must not use our own.

OpenCV's default of five steps is wrong by whole pixels at the edge of a wide lens.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["undistort_to_rays"]

_TIGHT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)


def undistort_to_rays(uv_raw: ArrayLike, K: ArrayLike, dist: ArrayLike) -> NDArray[np.float64]:
    """Undistorted normalised coordinates (..., 2) of pixels (..., 2)."""
    uv = np.asarray(uv_raw, np.float64)
    flat, K, dist = uv.reshape(-1, 1, 2), np.array(K, np.float64), np.array(dist, np.float64)
    # OpenCV 4 takes the criteria in a function of its own, OpenCV 5 in the one
    if hasattr(cv2, "undistortPointsIter"):
        rays = cv2.undistortPointsIter(flat, K, dist, np.eye(3), np.eye(3), _TIGHT)
    else:
        rays = cv2.undistortPoints(flat, K, dist, criteria=_TIGHT)
    return np.asarray(rays, np.float64).reshape(uv.shape)
