"""A scene of the experiments: photos on an arc, and their poses in another world frame."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rsundistort.synthetic import look_at

K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
PHOTOS, POINTS = 6, 60


def scene_arrays():
    """Photos on an arc, rolled from 0 to 90 degrees (no critical motion); all see all points."""
    rng = np.random.default_rng(0)
    angle = np.radians(np.linspace(-40, 40, PHOTOS))
    center = 6 * np.stack([np.sin(angle), -np.cos(angle), 0.15 * (-1.0) ** np.arange(PHOTOS)], axis=1)
    rolls = np.linspace(0, 90, PHOTOS)
    frame, point = np.divmod(np.arange(PHOTOS * POINTS), POINTS)
    return {
        "K": K,
        "width": 640,
        "height": 480,
        "R_cw": np.array([look_at(c, np.zeros(3), roll) for c, roll in zip(center, rolls, strict=True)]),
        "center_w": center,
        "points_w": rng.uniform(-1, 1, (POINTS, 3)) * [2, 1.5, 2],
        "frame_idx": frame,
        "point_idx": point,
    }


def moved(R_cw, center_w, rng):
    """Poses in another world frame, of another scale."""
    A = Rotation.random(random_state=rng).as_matrix()
    return R_cw @ A.T, 2.5 * center_w @ A.T + rng.normal(size=3)
