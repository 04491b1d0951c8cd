"""Frames of a video along a known path, projected row by row in plain NumPy: the oracle of the path's estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsundistort import Camera, Observations, Reconstruction
from rsundistort.model.path import CameraPath

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HandHeld:
    """A camera that is carried to the right, swings at 0.3 to 2 Hz and trembles at 5 to 11 Hz."""

    seed: int = 0
    swing: float = 1.0  # of 2 to 8 hundredths of a radian
    tremor: float = 0.004  # radians
    level: bool = False
    walks: bool = True

    def rotations(self, time_s: Array) -> Array:
        """R_cw (n, 3, 3)."""
        rng = np.random.default_rng(self.seed)
        phase = rng.uniform(0, 2 * np.pi, (6, 3))
        slow, fast = rng.uniform(0.3, 2.0, (3, 3)), rng.uniform(5.0, 11.0, (3, 3))
        size = np.concatenate([self.swing * rng.uniform(0.02, 0.08, (3, 3)), np.full((3, 3), self.tremor / 3)])
        angle = 2 * np.pi * np.concatenate([slow, fast]) * np.asarray(time_s)[:, None, None] + phase
        vector = (size * np.sin(angle)).sum(1)
        if self.level:
            vector[:, [0, 2]] = 0.0
        return Rotation.from_rotvec(vector).as_matrix()

    def centers(self, time_s: Array) -> Array:
        """center_w (n, 3)."""
        t = np.asarray(time_s)
        way = np.stack([1.2 * t, 0.05 * np.sin(2 * np.pi * 1.8 * t), 0.3 * t], axis=1)
        return way if self.walks else np.zeros_like(way)


def filmed(
    hand: HandHeld, num_frames: int = 30, readout: float = 0.6, num_points: int = 250, noise_px: float = 0.3,
    frame_s: float = 1 / 30, every: int = 1, zoom: Array | float = 1.0,
) -> tuple[Reconstruction, dict[str, float]]:  # fmt: skip
    """What the camera sees, with its true poses at the moments of the principal row, and the time of each frame.

    `readout` is the share of the time between frames, negative for a shutter that runs from the bottom to the top;
    `zoom` times 500 px are the focal lengths of the frames. Lines take the same time whatever these are.
    """
    camera = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    rng = np.random.default_rng(1000 + hand.seed)
    time = np.arange(0, num_frames, every) * frame_s
    far = 1.2 * time[-1]
    points = np.column_stack(
        [rng.uniform(-4, 4 + far, num_points), rng.uniform(-3, 3, num_points), rng.uniform(4, 10, num_points)]
    )
    start, end = camera.clock_range
    seconds = readout * frame_s / (end - start)
    frames, seen, pixels = [], [], []
    zoom = np.broadcast_to(zoom, time.shape)
    for k, moment in enumerate(time):
        clock, units = np.zeros(num_points), zoom[k]
        for _ in range(60):  # the row that shows a point is that of its own image
            at = moment + seconds * clock
            x = np.einsum("nab,nb->na", hand.rotations(at), points - hand.centers(at))
            before, clock = clock, np.where(x[:, 2] > 0.5, units * x[:, 1] / np.maximum(x[:, 2], 0.5), 0.0)
            if np.abs(clock - before).max() < 1e-14:
                break
        xy = 500 * units * x[:, :2] / np.maximum(x[:, 2:], 0.5) + [320, 240]
        inside = (x[:, 2] > 0.5) & (xy >= 0).all(1) & (xy <= [639, 479]).all(1)
        frames.append(np.full(inside.sum(), k))
        seen.append(np.flatnonzero(inside))
        pixels.append(xy[inside] + rng.normal(0, noise_px, (inside.sum(), 2)))
    observations = Observations(np.concatenate(frames), np.concatenate(seen), np.concatenate(pixels))
    names = [f"{k:06d}.png" for k in range(len(time))]
    truth = Reconstruction(
        [camera], names, np.zeros(len(time), int), hand.rotations(time), hand.centers(time), points, observations,
        variation=np.column_stack([np.log(zoom), np.zeros((len(time), 2))]),
    )  # fmt: skip
    return truth.with_points(np.ones(len(observations), bool)), dict(zip(names, time.tolist(), strict=True))


def rotation_errors_deg(R_cw: Array, R_true: Array) -> Array:
    """(n,) angles between rotations, after the world of the first is rotated to that of the second."""
    U, _, Vt = np.linalg.svd(np.einsum("nab,nac->bc", R_true, R_cw))
    world = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return np.degrees(Rotation.from_matrix(R_cw @ world.T @ R_true.transpose(0, 2, 1)).magnitude())


def poses_at(path: CameraPath, time_s: Array) -> tuple[Array, Array]:
    """Poses R_cw (n, 3, 3) and center_w (n, 3) of a path at any times (n,), each by the nearest moment."""
    R_cw, center_w = [], []
    for time in time_s:
        moment = int(np.argmin(np.abs(path.time_s - time)))
        turn, way = path.around(np.array([moment]), np.array([time - path.time_s[moment]]))
        R_cw.append(Rotation.from_rotvec(turn[0, 0]).as_matrix() @ path.R_cw[moment])
        center_w.append(path.center_w[moment] + way[0, 0])
    return np.array(R_cw), np.array(center_w)
