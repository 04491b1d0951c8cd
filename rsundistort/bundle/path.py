"""The path of a video's camera as a prior: white noise on acceleration joins neighbouring frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..model import Bend, Reconstruction, RowMotion
from ..model.path import CameraPath, cross_matrices, inverse_left_jacobians

__all__ = [
    "FramePath",
    "PathPrior",
    "PathSolution",
    "PathState",
    "of_motions",
    "orthogonal",
    "path_bends",
    "path_solution",
    "with_path_motions",
]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Before anything is known of a readout: it takes about half of the time to the next frame, give or take as much, so
# that neither a global shutter nor one that runs the other way is excluded.
_READOUT_SHARE, _READOUT_SIGMA = 0.5, 1.0


@dataclass(frozen=True)
class FramePath:
    """Frames of one video, which share one trajectory.

    Parameters
    ----------
    time_s : mapping of photo name to float
        When each frame of the reconstruction was taken; one origin for all.
    frame_s : float
        Time from one frame of the video to the next, whether or not both are among the photos.
    readout : (seconds, sigma), optional
        What is known of the readout time of a frame; without it, that it is about half of `frame_s`, give or take as
        much.
    part : mapping of photo name to int, optional
        Parts that a cut separates; all in one when left out.
    rates : mapping of photo name to (rate, sigma), optional
        What a gyroscope says of the turn, (3,) radians per second in the camera frame, and its standard deviation.
    """

    time_s: Mapping[str, float]
    frame_s: float
    readout: tuple[float, float] | None = None
    part: Mapping[str, int] = field(default_factory=dict)
    rates: Mapping[str, tuple[ArrayLike, ArrayLike]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 0 < self.frame_s < np.inf:
            raise InputError(f"frame_s={self.frame_s!r}, expected a positive number of seconds")
        if self.readout is not None and not (np.isfinite(self.readout[0]) and self.readout[1] > 0):
            raise InputError(f"readout={self.readout!r}, expected seconds and a positive standard deviation")

    @property
    def readout_prior(self) -> tuple[float, float]:
        """Mean and standard deviation of the readout, in times between frames."""
        if self.readout is None:
            return _READOUT_SHARE, _READOUT_SIGMA
        return self.readout[0] / self.frame_s, self.readout[1] / self.frame_s

    def known_rates(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Rates (m, 6) that are known, and their weights, from one frame to the next; weight 0 where none is."""
        known, weight = np.zeros((2, len(names), 6))
        for i, name in enumerate(names):
            if name in self.rates:
                rate, sigma = self.rates[name]
                known[i, :3] = np.asarray(rate) * self.frame_s
                weight[i, :3] = (np.asarray(sigma, np.float64) * self.frame_s) ** -2.0
        return known, weight

    def order(self, names: Sequence[str]) -> tuple[Index, Array, Index]:
        """Photos in the order of their times, these (m,) in times between frames, and their parts (m,)."""
        lost = [name for name in names if name not in self.time_s]
        if lost:
            raise InputError(f"the path has no time of {len(lost)} frames, such as {lost[0]}")
        time = np.array([self.time_s[name] for name in names]) / self.frame_s
        order = np.argsort(time, kind="stable")
        part = np.array([self.part.get(name, 0) for name in names], np.int64)
        if (np.diff(time[order]) <= 0).any():
            raise InputError("two frames of the path have the same time")
        return order, time, part


@dataclass(frozen=True)
class PathState:
    """What the frames of a path move by, in times between frames.

    Attributes
    ----------
    rates : (m, 6) array
        Radians (camera frame) and world units (world) from one frame to the next, at each photo.
    pace : (cameras,) array
        Time that a unit of each camera's clock takes: phi is `pace * rates`.
    """

    rates: Array
    pace: Array

    def motions(self, camera_idx: Index) -> Array:
        """(m, 6) phi and velocity of the photos."""
        return self.pace[camera_idx, None] * self.rates


class PathPrior:
    """Residuals of the path between neighbouring photos, their Jacobians, and those of the readout time.

    Of neighbours at times t and t + dt: xi - dt omega and J(xi)^-1 omega' - omega, xi = log(R' R^T), and likewise of
    the positions, with the covariance Q [dt^3/3, dt^2/2; dt^2/2, dt] (Barfoot 2017, Eqs. 11.7 and 11.94).

    Parameters
    ----------
    path : FramePath
        Times.
    reconstruction : Reconstruction
        Whose photos they are.
    spreads : (turn, travel)
        Square roots of the spectral densities Q: radians, and world units, per (time between frames)^(3/2).
    """

    def __init__(self, path: FramePath, reconstruction: Reconstruction, spreads: tuple[float, float]) -> None:
        order, time, part = path.order(reconstruction.image_names)
        joined = part[order[1:]] == part[order[:-1]]
        self.first, self.second = order[:-1][joined], order[1:][joined]
        if not len(self.first):
            raise InputError("a path needs two frames that are not separated by a cut")
        self.dt = time[self.second] - time[self.first]
        self.spreads = spreads
        share, sigma = path.readout_prior
        span = np.array([camera.frame_span for camera in reconstruction.cameras])
        self.pace_prior, self.pace_sigma = share / span, sigma / span
        self._camera_idx = reconstruction.camera_idx

    def start(self, reconstruction: Reconstruction) -> PathState:
        """Rates by differences of the poses of neighbours, and the pace that is likeliest before the photos."""
        m = reconstruction.num_images
        total, count = np.zeros((m, 6)), np.zeros((m, 1))
        i, j = self.first, self.second
        xi = Rotation.from_matrix(reconstruction.R_cw[j] @ reconstruction.R_cw[i].transpose(0, 2, 1)).as_rotvec()
        rate = np.hstack([xi, reconstruction.center_w[j] - reconstruction.center_w[i]]) / self.dt[:, None]
        for end in (i, j):
            np.add.at(total, end, rate)
            np.add.at(count, end, 1.0)
        return PathState(total / np.maximum(count, 1.0), self.pace_prior.copy())

    def residuals(self, R_cw: Array, center_w: Array, rates: Array) -> Array:
        """(q, 2, 6) residuals of unit variance: of the change of rates, and of the steps given that."""
        step, change, _ = self._differences(R_cw, center_w, rates)
        return self._whitened(step, change)

    def _differences(self, R_cw: Array, center_w: Array, rates: Array) -> tuple[Array, Array, Array]:
        """(q, 6) what steps and rates differ by from those of steady rates, and xi (q, 3)."""
        i, j = self.first, self.second
        xi = Rotation.from_matrix(R_cw[j] @ R_cw[i].transpose(0, 2, 1)).as_rotvec()
        step = np.hstack([xi, center_w[j] - center_w[i]]) - self.dt[:, None] * rates[i]
        local = np.einsum("qab,qb->qa", inverse_left_jacobians(xi), rates[j, :3])
        return step, np.hstack([local, rates[j, 3:]]) - rates[i], xi

    def _whitened(self, step: Array, change: Array) -> Array:
        """(q, 2, 6, ...) by the Cholesky factor of the covariance, the change first."""
        dt = self.dt.reshape(-1, *(1,) * (step.ndim - 1))
        spread = np.repeat(self.spreads, 3).reshape(6, *(1,) * (step.ndim - 2))
        conditional = (step - 0.5 * dt * change) / np.sqrt(dt**3 / 12.0)
        return np.stack([change / np.sqrt(dt), conditional], axis=1) / spread

    def cost(self, R_cw: Array, center_w: Array, state: PathState) -> float:
        """Half the sum of squares, with that of the pace."""
        apart = (state.pace - self.pace_prior) / self.pace_sigma
        return 0.5 * float((self.residuals(R_cw, center_w, state.rates) ** 2).sum() + (apart**2).sum())

    def jacobians(self, R_cw: Array, center_w: Array, rates: Array) -> tuple[Array, Array, Array]:
        """Residuals (q, 12) and their Jacobians (q, 12, 12) by pose and rates of the first and the second photo.

        Poses by a left increment of the rotation and the centre.
        """
        step, change, xi = self._differences(R_cw, center_w, rates)
        q = len(xi)
        J = inverse_left_jacobians(xi)
        # by xi of J(xi)^-1 omega'; the series of the factor to the second order
        omega = rates[self.second, :3]
        turned = np.cross(xi, omega)
        by_xi = 0.5 * cross_matrices(omega) - (
            cross_matrices(turned) + cross_matrices(xi) @ cross_matrices(omega)
        ) / 12.0 + np.cross(xi, turned)[:, :, None] * xi[:, None] / 360.0  # fmt: skip
        of_first, of_second = np.zeros((2, 2, q, 6, 12))  # of steps and of changes
        eye = np.eye(3)
        # log(Exp(d') Exp(xi) Exp(-d)) = xi + J d' - J' d
        of_first[0, :, :3, :3], of_second[0, :, :3, :3] = -J.transpose(0, 2, 1), J
        of_first[1, :, :3, :3], of_second[1, :, :3, :3] = -by_xi @ J.transpose(0, 2, 1), by_xi @ J
        of_first[0, :, 3:, 3:6], of_second[0, :, 3:, 3:6] = -eye, eye
        of_first[0, :, :, 6:] = -self.dt[:, None, None] * np.eye(6)
        of_first[1, :, :, 6:] = -np.eye(6)
        of_second[1, :, :3, 6:9], of_second[1, :, 3:, 9:] = J, eye
        res = self._whitened(step, change).reshape(q, 12)
        A, B = (self._whitened(*each).reshape(q, 12, 12) for each in (of_first, of_second))
        return res, A, B

    def unit_squares(self, squares: Array) -> tuple[Array, Array]:
        """Squares (q, 12) of residuals as those of spreads of 1: of turn and of travel, (q, 6) each."""
        by_kind = squares.reshape(-1, 2, 2, 3)
        return tuple(by_kind[:, :, k].reshape(-1, 6) * self.spreads[k] ** 2 for k in range(2))  # type: ignore[return-value]


def camera_path(reconstruction: Reconstruction, path: FramePath, state: PathState) -> tuple[CameraPath, Index]:
    """The path through a reconstruction's poses, and its photos in the order of time."""
    order, time, part = path.order(reconstruction.image_names)
    rates = state.rates[order] / path.frame_s
    return CameraPath(
        time[order] * path.frame_s, reconstruction.R_cw[order], reconstruction.center_w[order], rates[:, :3],
        rates[:, 3:], part[order],
    ), order  # fmt: skip


def with_path_motions(reconstruction: Reconstruction, path: FramePath, state: PathState) -> Reconstruction:
    """The reconstruction with the motion of each frame as the path has it around its principal row."""
    found, order = camera_path(reconstruction, path, state)
    clock_s = state.pace * path.frame_s
    motions = {}
    for moment, image in enumerate(order.tolist()):
        camera = reconstruction.camera(image)
        motions[image] = found.row_motion(moment, camera.clock_range, float(clock_s[reconstruction.camera_idx[image]]))
    return reconstruction.with_motions([motions[i] for i in range(reconstruction.num_images)])


def path_bends(reconstruction: Reconstruction, path: FramePath, state: PathState) -> dict[str, Bend]:
    """What bends the motion of each frame, by name."""
    bent = with_path_motions(reconstruction, path, state)
    bends = [bent.motion(i).bend for i in range(bent.num_images)]
    return {name: bend for name, bend in zip(bent.image_names, bends, strict=True) if bend is not None}


@dataclass(frozen=True)
class PathSolution:
    """What was found of a path.

    Attributes
    ----------
    path : CameraPath
        Poses at the moments of the frames' principal rows, less the time that the row takes to come.
    state : PathState
        The same rates as the adjustment has them, and the pace of the readout.
    names : tuple of str
        The photo of each moment.
    readout_s, sigma_readout_s : (cameras,) array
        Time of the readout of a frame, seconds, negative where it runs against its direction; and its standard
        deviation.
    """

    path: CameraPath
    state: PathState
    names: tuple[str, ...]
    readout_s: Array
    sigma_readout_s: Array


def path_solution(reconstruction: Reconstruction, path: FramePath, state: PathState, pace_sigma: Array) -> PathSolution:
    """The path through a reconstruction's poses, and the readout time by pace and standard deviation (cameras,)."""
    found, frames = camera_path(reconstruction, path, state)
    span_s = np.array([camera.frame_span for camera in reconstruction.cameras]) * path.frame_s
    names = tuple(reconstruction.image_names[k] for k in frames.tolist())
    return PathSolution(found, state, names, state.pace * span_s, pace_sigma * span_s)


def of_motions(covariances: Array, with_pace: Array, pace_sigma: Array, state: PathState, camera_idx: Index) -> Array:
    """Covariances (m, nb, nb) of poses, phi and velocity by those of poses and rates, and of these with the pace."""
    m, nb = covariances.shape[:2]
    joint = np.zeros((m, nb + 1, nb + 1))
    joint[:, :nb, :nb] = covariances
    joint[:, nb, :nb] = joint[:, :nb, nb] = with_pace
    joint[:, nb, nb] = pace_sigma[camera_idx] ** 2
    T = np.tile(np.eye(nb, nb + 1), (m, 1, 1))
    T[:, 6:12, 6:12] *= state.pace[camera_idx, None, None]
    T[:, 6:12, nb] = state.rates
    return T @ joint @ T.transpose(0, 2, 1)


def orthogonal(reconstruction: Reconstruction) -> Reconstruction:
    """The same motions, told as those of the nearest steady ones and bends, and the poses that go with these."""
    R_cw, center_w, motions = reconstruction.R_cw.copy(), reconstruction.center_w.copy(), []
    for i in range(reconstruction.num_images):
        start, end = reconstruction.bend_clock[i]
        clock = np.linspace(start, end, 4 * reconstruction.bend.shape[1])
        motion, turn, way = RowMotion.of(clock, *reconstruction.motion(i).at(clock), sites=reconstruction.bend.shape[1])
        R_cw[i], center_w[i] = turn @ R_cw[i], center_w[i] + way
        motions.append(replace(motion, frame="world"))
    return replace(reconstruction.with_motions(motions), R_cw=R_cw, center_w=center_w)
