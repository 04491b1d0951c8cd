"""Named sets of cameras around a scene, critical and not, for tests and benchmarks."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rsundistort import Camera, Observations, Reconstruction

#: Changes of the scene's shape that each set hides: how many singular values of the degeneracy measure are zero.
HIDDEN = {
    "parallel": 1,
    "parallel, some upside down": 1,
    "parallel, column readout of rolled photos": 1,
    "pure translation": 2,
    "two views": 2,
    "one portrait": 0,
    "one portrait, read by columns": 1,
    "5 degrees": 0,
    "10 degrees": 0,
    "20 degrees": 0,
    "looking ahead and down": 0,
    "random": 0,
}


def _roll(degrees: float) -> np.ndarray:
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix()


def named_scene(name: str, m: int = 10, num_points: int = 60, seed: int = 0) -> Reconstruction:
    """Cameras on an arc around a cloud of points, which all see all points; nothing measured, nothing moving.

    "5 degrees" and the like are elevations drawn with that standard deviation. In "one portrait" one camera is rolled
    by 90 degrees; read by columns, its readout runs along the others' again. "looking ahead and down" has cameras of
    elevation 0 and 90 degrees with parallel x axes.
    """
    if name not in HIDDEN:
        raise KeyError(name)
    rng = np.random.default_rng([seed, 11])
    m = 2 if name == "two views" else m
    points = rng.uniform(-1, 1, (num_points, 3)) * [2.0, 1.2, 2.0]
    turn = np.linspace(-0.6, 0.6, m) + rng.normal(0, 0.05, m)
    tilt = np.zeros(m)
    if "degrees" in name:
        tilt = rng.normal(0, float(name.split()[0]), m)
    elif name == "looking ahead and down":
        turn, tilt = np.zeros(m), 90.0 * (np.arange(m) % 2)
    elif name == "two views":
        tilt = np.array([0.0, 20.0])
    R_cw = (Rotation.from_euler("x", tilt[:, None], degrees=True) * Rotation.from_euler("y", turn[:, None])).as_matrix()
    if name == "pure translation":
        R_cw = np.broadcast_to(np.eye(3), (m, 3, 3)).copy()
    elif name == "random":
        R_cw = Rotation.random(m, random_state=seed).as_matrix()
    # all look at the cloud from 7 away
    wander = 1.5 if name == "looking ahead and down" else 0.3  # two orientations determine little from two places
    centers = -7.0 * R_cw[:, 2] + rng.normal(0, wander, (m, 3))
    if name == "pure translation":
        centers = np.array([0.0, 0.0, -7.0]) + rng.uniform(-1.5, 1.5, (m, 3))
    readout = ["top-to-bottom"] * m
    if name == "parallel, some upside down":
        R_cw[::3] = _roll(180) @ R_cw[::3]
    elif name == "parallel, column readout of rolled photos":
        R_cw[::3] = _roll(90) @ R_cw[::3]
        readout[::3] = ["left-to-right"] * len(readout[::3])
    elif name.startswith("one portrait"):
        R_cw[m // 2] = _roll(90) @ R_cw[m // 2]
        if name.endswith("by columns"):
            readout[m // 2] = "right-to-left"
    cameras = [Camera(960, 720, [[900.0, 0, 480], [0, 900.0, 360], [0, 0, 1]], [], each) for each in readout]
    point, frame = (a.ravel() for a in np.mgrid[:num_points, :m])
    return Reconstruction(
        cameras, [f"{i:02d}.jpg" for i in range(m)], np.arange(m), R_cw, centers, points,
        Observations(frame, point, np.zeros((len(frame), 2))),
    )  # fmt: skip
