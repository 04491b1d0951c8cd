"""The path of a video's camera as a prior: white noise on the change of acceleration connects neighbouring frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..model import Bend, Reconstruction
from ..model.array_types import Array, Index
from ..model.bend import splines_at
from ..model.motion import steady_parts
from ..model.path import CameraPath, cross_matrices, inverse_left_jacobians

__all__ = [
    "FramePath",
    "PathPrior",
    "PathSolution",
    "PathStart",
    "PathState",
    "of_motions",
    "orthogonal",
    "path_bends",
    "path_solution",
    "with_path_motions",
]


# Before anything is known of a readout: it takes about half of the time to the next frame, give or take as much, so
# that neither a global shutter nor one that runs the other way is excluded.
_READOUT_SHARE, _READOUT_SIGMA = 0.5, 1.0
# A readout ends before that of the next frame begins: standard deviation, in times between frames, by which one may
# exceed that. It stands for times of frames that are not exact, and keeps the cost smooth.
_EXCESS_SIGMA = 0.02
# Readout time that counts as none, in times between frames.
_NO_READOUT = 1e-6
# Frames that a path is taken to have run at, from rest, before its first one.
_FRAMES_BEFORE = 100.0


@dataclass(frozen=True)
class PathStart:
    """Path that an adjustment found, with which the next one begins.

    Attributes
    ----------
    names : tuple of str
        Frames, in the order of the state.
    state : PathState
        How they move; its world is that of the reconstruction that begins there.
    sigmas : (rotation, travel)
        Prior standard deviations, as `PathPrior` takes them.
    noise : float, optional
        Factor of the noise, where the residuals have said so.
    """

    names: tuple[str, ...]
    state: PathState
    sigmas: tuple[float, ...]
    noise: float | None = None

    @property
    def at_once(self) -> PathStart:
        """The same frames, read at once."""
        return replace(self, state=replace(self.state, pace=np.zeros_like(self.state.pace)))

    def in_order(self, names: Sequence[str], otherwise: PathState) -> PathState:
        """The state of other frames; of those without one, another's, whose cameras are the same."""
        place = {name: i for i, name in enumerate(self.names)}
        mine = np.array([place.get(name, -1) for name in names])
        rates, changes = (
            np.where((mine >= 0)[:, None], own[mine], other)
            for own, other in ((self.state.rates, otherwise.rates), (self.state.changes, otherwise.changes))
        )
        return PathState(rates, changes, self.state.pace)


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
    held_sigma : float
        Standard deviation in seconds of a readout time that the path says nothing about, as where the camera shakes
        too fast for its frames; `readout` then holds it with a small one. 0 if the path may say something.
    part : mapping of photo name to int, optional
        Parts that a cut separates; all in one when left out.
    rates : mapping of photo name to (rate, sigma), optional
        Rate of rotation by a gyroscope, (3,) radians per second in the camera frame, and its standard deviation.
    rotation_only : bool
        Whether the camera stays where it is: centres are held, and points count by their directions.
    start : PathStart, optional
        The path of an adjustment of these frames before, where the next one begins.
    """

    time_s: Mapping[str, float]
    frame_s: float
    readout: tuple[float, float] | None = None
    part: Mapping[str, int] = field(default_factory=dict)
    rates: Mapping[str, tuple[ArrayLike, ArrayLike]] = field(default_factory=dict)
    rotation_only: bool = False
    start: PathStart | None = None
    held_sigma: float = 0.0

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

    @property
    def readout_most(self) -> float:
        """The longest readout, in times between frames: one, unless a longer one is given."""
        return max(1.0, abs(self.readout_prior[0]))

    @property
    def at_once(self) -> FramePath:
        """The same frames, read at once."""
        return replace(self, readout=(0.0, _NO_READOUT * self.frame_s))

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
    changes : (m, 6) array
        How fast these change.
    pace : (cameras,) array
        Time that a unit of each camera's clock takes: phi is `pace * rates`.
    """

    rates: Array
    changes: Array
    pace: Array

    def paces(self, camera_idx: Index, variation: Array) -> Array:
        """(m,) time that a unit of each photo's clock takes, by the variation (m, 3) of their intrinsics.

        A line takes the same time whatever the focal length is, and a unit of the clock has as many lines as f pixels.
        """
        return self.pace[camera_idx] * np.exp(variation[:, 0])

    def motions(self, camera_idx: Index, variation: Array) -> Array:
        """(m, 6) phi and velocity of the photos."""
        return self.paces(camera_idx, variation)[:, None] * self.rates


class PathPrior:
    """Residuals of the path between neighbouring photos, their Jacobians, and those of the readout time.

    Of neighbours at times t and t + dt, whose rotations differ by xi = log(R' R^T): xi - dt omega - dt^2/2 alpha,
    J(xi)^-1 omega' - omega - dt alpha and J(xi)^-1 alpha' - alpha, and likewise of the positions, with the covariance
    that white noise on the change of acceleration has (Barfoot 2017, section 11.1; Tang, Yoon and Barfoot 2019). White
    noise on acceleration itself would do with fewer unknowns, but its cubics have but 0.9 of the rate of a tremor at a
    third of the frame rate and 0.6 at 0.4 of it, and readouts come out the longer for it; these have 0.98 and 0.8.

    Parameters
    ----------
    sigmas : (rotation, travel)
        Square roots of the spectral densities Q: radians, and world units, per (time between frames)^(5/2).
    """

    def __init__(self, path: FramePath, reconstruction: Reconstruction, sigmas: tuple[float, float]) -> None:
        order, time, part = path.order(reconstruction.image_names)
        joined = part[order[1:]] == part[order[:-1]]
        self.first, self.second = order[:-1][joined], order[1:][joined]
        if not len(self.first):
            raise InputError("a path needs two frames that are not separated by a cut")
        self.dt = dt = time[self.second] - time[self.first]
        powers = [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
        # unit variance: times the inverse of the covariance's Cholesky factor
        self._whitening = np.linalg.inv(np.linalg.cholesky(np.array(powers).transpose(2, 0, 1)))
        self.sigmas = sigmas
        # nothing comes before the first frame of a part: its changes are those of a path that began at rest
        self.begins = np.setdiff1d(order, self.second)
        self.begins_sigma = np.sqrt(_FRAMES_BEFORE) * np.repeat(sigmas, 3)
        share, sigma = path.readout_prior
        span = np.array([camera.frame_span for camera in reconstruction.cameras])
        self.pace_prior, self.pace_sigma = share / span, sigma / span
        self.pace_most, self.excess_sigma = path.readout_most / span, _EXCESS_SIGMA / span
        self._camera_idx = reconstruction.camera_idx

    def start(self, reconstruction: Reconstruction, known: PathStart | None = None) -> PathState:
        """The state that an adjustment begins with: as far as it is `known`, that one.

        Else rates by differences of the poses of neighbours, and the pace that is likeliest before the photos.
        """
        m = reconstruction.num_images
        total, count = np.zeros((m, 6)), np.zeros((m, 1))
        i, j = self.first, self.second
        xi = Rotation.from_matrix(reconstruction.R_cw[j] @ reconstruction.R_cw[i].transpose(0, 2, 1)).as_rotvec()
        rate = np.hstack([xi, reconstruction.center_w[j] - reconstruction.center_w[i]]) / self.dt[:, None]
        for end in (i, j):
            np.add.at(total, end, rate)
            np.add.at(count, end, 1.0)
        differences = PathState(total / np.maximum(count, 1.0), np.zeros((m, 6)), self.pace_prior.copy())
        return differences if known is None else known.in_order(reconstruction.image_names, differences)

    def residuals(self, R_cw: Array, center_w: Array, state: PathState) -> Array:
        """(q, 18) residuals of unit variance, 6 each of steps, rates and changes."""
        return self._whitened(self._differences(R_cw, center_w, state)[0]).reshape(len(self.dt), 18)

    def _differences(self, R_cw: Array, center_w: Array, state: PathState) -> tuple[Array, Array]:
        """(q, 3, 6) what steps, rates and changes differ by from those of steady changes, and xi (q, 3)."""
        i, j, dt = self.first, self.second, self.dt[:, None]
        xi = Rotation.from_matrix(R_cw[j] @ R_cw[i].transpose(0, 2, 1)).as_rotvec()
        J = inverse_left_jacobians(xi)

        def local(values: Array) -> Array:
            return np.hstack([np.einsum("qab,qb->qa", J, values[j, :3]), values[j, 3:]])

        rates, changes = state.rates[i], state.changes[i]
        step = np.hstack([xi, center_w[j] - center_w[i]]) - dt * rates - 0.5 * dt**2 * changes
        return np.stack([step, local(state.rates) - rates - dt * changes, local(state.changes) - changes], axis=1), xi

    def _whitened(self, differences: Array) -> Array:
        """(q, 3, 6, ...) divided by their standard deviations."""
        spread = np.repeat(self.sigmas, 3).reshape(6, *(1,) * (differences.ndim - 3))
        return np.einsum("qij,qj...->qi...", self._whitening, differences) / spread

    def cost(self, R_cw: Array, center_w: Array, state: PathState) -> float:
        """Half the sum of squares, with that of the pace."""
        apart = (state.pace - self.pace_prior) / self.pace_sigma
        excess = _excess(state.pace, self.pace_most) / self.excess_sigma
        begun = state.changes[self.begins] / self.begins_sigma
        squares = (self.residuals(R_cw, center_w, state) ** 2).sum() + (apart**2).sum() + (begun**2).sum()
        return 0.5 * float(squares + (excess**2).sum())

    def prior_on_pace(self, state: PathState, bounded: bool = True) -> tuple[Array, Array]:
        """Diagonal Hessian and gradient (cameras,) of what is known of the pace.

        The bound is no evidence of where within it a readout lies: standard deviations are those without it
        (`bounded` False).
        """
        excess = _excess(state.pace, self.pace_most) if bounded else np.zeros_like(state.pace)
        at_bound, weight = np.where(excess != 0, self.excess_sigma**-2.0, 0.0), self.pace_sigma**-2.0
        return weight + at_bound, weight * (state.pace - self.pace_prior) + at_bound * excess

    def prior_on_changes(self, state: PathState) -> tuple[Array, Array]:
        """Diagonal Hessian and gradient (m, 6) of what is known of the changes beforehand."""
        diagonal, gradient = np.zeros((2, *state.changes.shape))
        diagonal[self.begins] = self.begins_sigma**-2.0
        gradient[self.begins] = self.begins_sigma**-2.0 * state.changes[self.begins]
        return diagonal, gradient

    def jacobians(self, R_cw: Array, center_w: Array, state: PathState) -> tuple[Array, Array, Array]:
        """Residuals (q, 18), and their Jacobians (q, 18, 18) by pose, rates and changes of the first and second photo.

        Poses by a left increment of the rotation and the centre.
        """
        differences, xi = self._differences(R_cw, center_w, state)
        q = len(xi)
        J = inverse_left_jacobians(xi)
        Jt = J.transpose(0, 2, 1)
        dt, eye = self.dt[:, None, None], np.eye(6)
        of_first, of_second = np.zeros((2, q, 3, 6, 18))
        # log(Exp(d') Exp(xi) Exp(-d)) = xi + J d' - J' d
        of_first[:, 0, :3, :3], of_second[:, 0, :3, :3] = -Jt, J
        of_first[:, 0, 3:, 3:6], of_second[:, 0, 3:, 3:6] = -eye[:3, :3], eye[:3, :3]
        of_first[:, 0, :, 6:12], of_first[:, 0, :, 12:] = -dt * eye, -0.5 * dt**2 * eye
        of_first[:, 1, :, 12:] = -dt * eye
        for level, values in ((1, state.rates), (2, state.changes)):
            by_xi = _by_xi(xi, values[self.second, :3])
            of_first[:, level, :3, :3], of_second[:, level, :3, :3] = -by_xi @ Jt, by_xi @ J
            own = slice(6 * level, 6 * level + 6)
            of_first[:, level, :, own] = -eye
            of_second[:, level, 3:, own] = eye[3:]
            of_second[:, level, :3, 6 * level : 6 * level + 3] = J
        A, B = (self._whitened(each).reshape(q, 18, 18) for each in (of_first, of_second))
        return self._whitened(differences).reshape(q, 18), A, B

    def unit_squares(self, squares: Array) -> tuple[Array, Array]:
        """Squares (q, 18) of residuals as those of standard deviations of 1: of rotation and of travel, (q, 9) each."""
        by_kind = squares.reshape(-1, 3, 2, 3)
        turn, travel = (by_kind[:, :, k].reshape(-1, 9) * self.sigmas[k] ** 2 for k in range(2))
        return turn, travel


def _by_xi(xi: Array, x: Array) -> Array:
    """(q, 3, 3) derivatives by xi of J(xi)^-1 x, the series of J's factor to the second order."""
    turned = np.cross(xi, x)
    return (
        0.5 * cross_matrices(x)
        - (cross_matrices(turned) + cross_matrices(xi) @ cross_matrices(x)) / 12.0
        + np.cross(xi, turned)[:, :, None] * xi[:, None] / 360.0
    )


def _excess(pace: Array, most: Array) -> Array:
    """(cameras,) how far readouts are longer than the longest one, with their sign."""
    return np.sign(pace) * np.maximum(np.abs(pace) - most, 0.0)


def camera_path(reconstruction: Reconstruction, path: FramePath, state: PathState) -> tuple[CameraPath, Index]:
    """The path through a reconstruction's poses, and its photos in the order of time."""
    order, time, part = path.order(reconstruction.image_names)
    rates, changes = state.rates[order] / path.frame_s, state.changes[order] / path.frame_s**2
    return CameraPath(
        time[order] * path.frame_s, reconstruction.R_cw[order], reconstruction.center_w[order], rates[:, :3],
        rates[:, 3:], changes[:, :3], changes[:, 3:], part[order],
    ), order  # fmt: skip


def with_path_motions(reconstruction: Reconstruction, path: FramePath, state: PathState) -> Reconstruction:
    """The reconstruction with the motion of each frame as the path has it around its principal row."""
    found, order = camera_path(reconstruction, path, state)
    clock_s, camera_idx = state.pace * path.frame_s, reconstruction.camera_idx[order]
    clock, parts = np.array([camera.clock_range for camera in reconstruction.cameras])[reconstruction.camera_idx], []
    for k, camera in enumerate(reconstruction.cameras):
        moments = np.flatnonzero(camera_idx == k)
        parts.append((order[moments], *found.row_motions(moments, camera.clock_range, float(clock_s[k]))))
    photos, *motions = (np.concatenate(each) for each in zip(*parts, strict=True))
    phi, velocity, bend = (each[np.argsort(photos)] for each in motions)
    # units of the camera's clock have become those of each photo's, whose lines are the same
    units = np.exp(reconstruction.variation[:, :1])
    return replace(reconstruction, phi=units * phi, velocity=units * velocity, bend=bend, bend_clock=clock / units)


def path_bends(reconstruction: Reconstruction, path: FramePath, state: PathState) -> dict[str, Bend]:
    """What bends the motion of each frame, by name."""
    bent = with_path_motions(reconstruction, path, state)
    bends = [bent.motion(i).bend for i in range(bent.num_images)]
    return {name: bend for name, bend in zip(bent.image_names, bends, strict=True) if bend is not None}


@dataclass(frozen=True)
class PathSolution:
    """Solution of a path.

    Attributes
    ----------
    path : CameraPath
        Poses when the principal rows are read, at the frames' times: these are all early by the same, the time that the
        row takes to come.
    state : PathState
        The same rates as the adjustment has them, and the pace of the readout.
    names : tuple of str
        The photo of each moment.
    readout_s, sigma_readout_s : (cameras,) array
        Time of the readout of a frame, seconds, negative where it runs against its direction; and its standard
        deviation, without what is due to its bound, the time between frames.
    unbounded_s : (cameras,) array
        What the measurements ask for without the bound, to first order: another time only where they contradict it.
    """

    path: CameraPath
    state: PathState
    names: tuple[str, ...]
    readout_s: Array
    sigma_readout_s: Array
    unbounded_s: Array


def path_solution(reconstruction: Reconstruction, path: FramePath, state: PathState, pace_sigma: Array) -> PathSolution:
    """The path through a reconstruction's poses, and the readout time by pace and standard deviation (cameras,).

    A deviation that could not be computed is the one before the photos.
    """
    found, frames = camera_path(reconstruction, path, state)
    span = np.array([camera.frame_span for camera in reconstruction.cameras])
    pace_sigma = np.where(np.isfinite(pace_sigma), pace_sigma, path.readout_prior[1] / span)
    # without the bound, by a Gauss-Newton step from it
    free = state.pace + _excess(state.pace, path.readout_most / span) * (pace_sigma / (_EXCESS_SIGMA / span)) ** 2
    span_s = span * path.frame_s
    pace_sigma = np.hypot(pace_sigma, path.held_sigma / span_s)
    names = tuple(reconstruction.image_names[k] for k in frames.tolist())
    times = (each * span_s for each in (state.pace, pace_sigma, free))
    return PathSolution(found, state, names, *times)


def of_motions(
    covariances: Array, with_pace: Array, pace_sigma: Array, state: PathState, reconstruction: Reconstruction
) -> Array:
    """Covariances (m, nb, nb) of poses, phi and velocity by those of poses and rates, and of these with the pace."""
    m, nb = covariances.shape[:2]
    joint = np.zeros((m, nb + 1, nb + 1))
    joint[:, :nb, :nb] = covariances
    joint[:, nb, :nb] = joint[:, :nb, nb] = with_pace
    joint[:, nb, nb] = pace_sigma[reconstruction.camera_idx] ** 2
    T = np.tile(np.eye(nb, nb + 1), (m, 1, 1))
    T[:, 6:12, 6:12] *= state.paces(reconstruction.camera_idx, reconstruction.variation)[:, None, None]
    T[:, 6:12, nb] = np.exp(reconstruction.variation[:, :1]) * state.rates
    return T @ joint @ T.transpose(0, 2, 1)


def orthogonal(reconstruction: Reconstruction) -> Reconstruction:
    """The same motions as the nearest steady ones and bends, and the poses that belong to these.

    Motions are those of `with_path_motions`: photos of a camera bend over the same share of their clock.
    """
    rec, sites = reconstruction, reconstruction.bend.shape[1]
    R_cw, center_w, bend = rec.R_cw.copy(), rec.center_w.copy(), np.empty_like(rec.bend)
    phi, velocity = np.empty((2, rec.num_images, 3))
    # each photo's own unit of the clock is its readout, so that those of a camera, whatever their focal length, have
    # the same clock
    start, length = rec.bend_clock[:, 0], np.ptp(rec.bend_clock, axis=1)
    for camera in np.unique(rec.camera_idx):
        mine = np.flatnonzero(rec.camera_idx == camera)
        own = length[mine, None]
        clock = start[mine[0]] / length[mine[0]] + np.linspace(0, 1, 4 * sites)
        moved = splines_at(sites, np.linspace(0, 1, len(clock))) @ rec.bend[mine]
        moved[..., :3] += clock[:, None] * (own * rec.phi[mine])[:, None]
        moved[..., 3:] += clock[:, None] * (own * rec.velocity[mine])[:, None]
        rest, turn, way, rate = steady_parts(clock, moved, sites)
        R_cw[mine], center_w[mine] = turn @ R_cw[mine], center_w[mine] + way
        phi[mine], velocity[mine], bend[mine] = rate[:, 0] / own, rate[:, 1] / own, rest
    return replace(rec, R_cw=R_cw, center_w=center_w, phi=phi, velocity=velocity, bend=bend)
