"""Measurements of a rolling-shutter camera, by plain NumPy: the judge of the kernels.

Shares no function with them: the row is a fixed point of the paper's Eq. 2 instead of a Newton step, the rotation is
SciPy's, the lens OpenCV's, and the four readout directions are written out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..model import Camera, RowMotion
from ..model.array_types import Array, Mask
from .lens import distort_rays

__all__ = ["clock_of", "project_rows"]

# the speed of the rotation, |phi| and what a bend adds, contracts the fixed point: 0.2 rad per frame needs some 20
# steps to rounding
_MAX_STEPS = 200
_STILL = 1e-14


def clock_of(readout: str, seen: Array) -> Array:
    """The clock (n,) of distorted normalised coordinates (n, 2): it runs along the readout."""
    return {
        "top-to-bottom": seen[:, 1],
        "bottom-to-top": -seen[:, 1],
        "left-to-right": seen[:, 0],
        "right-to-left": -seen[:, 0],
    }[readout]


def project_rows(
    points_w: ArrayLike, R_cw: ArrayLike, center_w: ArrayLike, motion: RowMotion, camera: Camera
) -> tuple[Array, Mask]:
    """Pixels where a rolling-shutter photo shows world points: Eq. 2 whole, the clock on the distorted row.

    Parameters
    ----------
    points_w : (n, 3) array
        World points.
    R_cw, center_w : (3, 3), (3,) array
        Pose that the motion belongs to.
    motion : RowMotion
        Motion during the readout, with its bend.

    Returns
    -------
    uv : (n, 2) array
        Pixels, integer centres; they may lie outside the photo.
    valid : (n,) bool array
        The point lies before the camera, and the fixed point was reached.
    """
    points, R, center = (np.asarray(a, np.float64) for a in (points_w, R_cw, center_w))
    q = (points - center) @ R.T
    ahead = q[:, 2] > 1e-9
    seen = np.zeros((len(points), 2))
    if not len(points):
        return seen, ahead  # OpenCV returns None of nothing
    reached = np.zeros(len(points), bool)
    for _ in range(_MAX_STEPS):
        tau = clock_of(camera.readout, seen)
        rotation, way = motion.at(tau)
        q = Rotation.from_rotvec(rotation).apply((points - (center + way)) @ R.T)
        ahead &= q[:, 2] > 1e-9
        q[~ahead] = (0.0, 0.0, 1.0)
        before, seen = seen, distort_rays(q, camera, np.eye(3))
        reached = np.abs(seen - before).max(1) < _STILL
        if reached.all():
            break
    K = camera.K
    return seen * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]], ahead & reached
