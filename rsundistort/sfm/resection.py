"""The pose of a photo from known points."""

from __future__ import annotations

import cv2
import numpy as np

from ..model.array_types import Array

__all__ = ["LEAST_POINTS", "resect"]

# Fewer points that agree determine no pose.
LEAST_POINTS = 12
# Points that agree are searched around the guess, then around each result, with smaller tolerances.
_NARROWER = (4.0, 2.0, 1.0)


def resect(rays: Array, points_w: Array, R_cw: Array, center_w: Array, within: float) -> tuple[Array, Array] | None:
    """Pose of a photo by points of the scene and where it shows them, as far as these agree, from a pose nearby.

    Parameters
    ----------
    rays : (n, 2) array
        Ideal image coordinates x / z, y / z of the points in the camera.
    points_w : (n, 3) array
        The points.
    R_cw, center_w : (3, 3), (3,) array
        Start of the search.
    within : float
        Largest distance in the end, in the coordinates of the rays, of a point and its prediction: room for the
        shutter. Four times that at first.

    Returns
    -------
    R_cw, center_w : (3, 3), (3,) array
        Or None if fewer than `LEAST_POINTS` agree on one.
    """
    for times in _NARROWER:
        x_c = (points_w - center_w) @ R_cw.T
        ahead = x_c[:, 2] > 0
        apart = np.linalg.norm(x_c[:, :2] / np.where(ahead, x_c[:, 2], 1.0)[:, None] - rays, axis=1)
        agree = ahead & (apart < times * within)
        if agree.sum() < LEAST_POINTS:
            return None
        # a world of its own, for the sake of the scale of what is solved
        size = float(np.median(x_c[agree, 2]))
        local = (points_w[agree] - center_w) / size
        turn, way = cv2.solvePnPRefineLM(local, rays[agree], np.eye(3), None, cv2.Rodrigues(R_cw)[0], np.zeros((3, 1)))
        R_cw = cv2.Rodrigues(turn)[0]
        center_w = center_w - size * (R_cw.T @ way.ravel())
    return R_cw, center_w
