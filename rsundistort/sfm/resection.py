"""Where a photo was taken from, by points that are known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["LEAST_POINTS", "resect"]

# Fewer points that agree tell no pose.
LEAST_POINTS = 12
_TRIALS = 200


def resect(
    rays: NDArray[np.float64], points_w: NDArray[np.float64], within: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Pose of a photo by points of the scene and where it shows them, as far as these agree.

    Parameters
    ----------
    rays : (n, 2) array
        Ideal image coordinates x / z, y / z of the points in the camera.
    points_w : (n, 3) array
        The points.
    within : float
        How far apart, in the same coordinates, a point and its prediction may be: room for the shutter.

    Returns
    -------
    R_cw, center_w : (3, 3), (3,) array
        Or None if fewer than `LEAST_POINTS` agree on one.
    """
    if len(rays) < LEAST_POINTS:
        return None
    # a world of its own, for the sake of the scale of what is solved
    middle, size = points_w.mean(0), float(np.linalg.norm(points_w.std(0))) or 1.0
    local = (points_w - middle) / size
    found, rotation, translation, agreeing = cv2.solvePnPRansac(
        local, rays, np.eye(3), None, iterationsCount=_TRIALS, reprojectionError=within, confidence=0.9999,
        flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or agreeing is None or len(agreeing) < LEAST_POINTS:
        return None
    chosen = agreeing.ravel()
    rotation, translation = cv2.solvePnPRefineLM(local[chosen], rays[chosen], np.eye(3), None, rotation, translation)
    R_cw = cv2.Rodrigues(rotation)[0]
    return R_cw, middle - size * (R_cw.T @ translation.ravel())
