"""Where two photos were taken from, seen from each other, if the camera rotated while each was read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .._kernels import epipolar as kernels
from ..colmap.conventions import quiet_pycolmap
from ..model import Camera
from ..model.array_types import Array, Index
from ..model.projection import clock_of, unproject_points

__all__ = [
    "INLIER_PX",
    "NO_SHUTTER",
    "Pair",
    "RelativePose",
    "View",
    "adjusted_pose",
    "best_relative_pose",
    "find_relative_pose",
    "phi_information",
    "relative_poses",
    "suggested_poses",
]

# Five points suggest a pose with thresholds of these pixels: what fits a narrow one is a part of the photos that the
# shutter hardly bends, what fits the wide one most of them.
_SEARCH_PX = (4.0, 16.0)
_SEARCHES, _CONFIDENCE = 2000, 0.999
# So many matches suggest poses to pycolmap, and to five points with the wide threshold beside it, in so many trials.
_WIDE_PX, _SUGGESTING, _TRIALS = (16.0,), 500, 500
# Widths of the loss, in pixels: the inliers grow under the wide one. An inlier of the result lies within the last.
_WIDTHS_PX = (3.0, 1.5)
INLIER_PX = 4.0
# The best pose is adjusted under a loss of so many standard deviations of its inliers, and of no less noise, in pixels.
# A narrower one wastes matches, a wider one is moved by false ones; 4 to 8 are about as good.
_WIDTH, _LEAST_NOISE_PX = 7.0, 0.1
_LEAST_MATCHES = 15
# Median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745
_MAX_STEPS, _CONVERGED, _GIVEN_UP = 40, 1e-5, 1e5
# Prior standard deviation of phi that its estimation starts from, radians a frame, and its rounds.
_START_SIGMA, _ROUNDS = 0.1, 6
#: Its least value: no shutter.
NO_SHUTTER = 1e-4


@dataclass(frozen=True)
class View:
    """One photo's side of a list of matches.

    Attributes
    ----------
    rays : (n, 3) array
        Directions of unit length, of the lens but not of the shutter.
    slopes : (n, 2, 3) array
        Their derivatives by the pixel's x and y.
    clock : (n,) array
        When the pixels were read.
    rate : (2,) array
        The clock's derivative by the pixel's x and y.
    frame_span : float
        How far the clock runs over the frame.
    """

    rays: Array
    slopes: Array
    clock: Array
    rate: Array
    frame_span: float
    focal_px: float

    @classmethod
    def of(cls, xy_raw: Array, camera: Camera) -> View:
        """Normalised rays of pixels (n, 2)."""
        axis = camera.clock_axis
        rate = np.zeros(2)
        rate[axis] = camera.clock_sign / camera.K[axis, axis]
        half = 0.5 * np.eye(2)
        slopes = np.stack([_rays(xy_raw + half[k], camera) - _rays(xy_raw - half[k], camera) for k in (0, 1)], axis=1)
        return cls(
            _rays(xy_raw, camera), slopes, clock_of(camera, xy_raw), rate, camera.frame_span, float(camera.K[0, 0])
        )

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Arguments of the kernels."""
        return self.rays, self.slopes, self.clock, self.rate

    @property
    def normalized(self) -> Array:
        """(n, 2) rays where they meet z = 1."""
        return np.asarray(self.rays[:, :2] / self.rays[:, 2:])

    def select(self, chosen: Index) -> View:
        """Some of the matches."""
        return replace(self, rays=self.rays[chosen], slopes=self.slopes[chosen], clock=self.clock[chosen])


def _rays(xy_raw: Array, camera: Camera) -> Array:
    """(n, 3) unit directions of pixels; ahead where the lens has none."""
    ideal, valid = unproject_points(xy_raw, camera, None, "global")
    rays = np.column_stack([np.where(valid[:, None], ideal, 0.0), np.ones(len(ideal))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@dataclass(frozen=True)
class Pair:
    """The matches of two photos, as each shows them."""

    first: View
    second: View

    @cached_property
    def arrays(self) -> tuple[Array, ...]:
        """Arguments of the kernels."""
        return *self.first.arrays, *self.second.arrays

    @property
    def frame_spans(self) -> Array:
        """(6,) clock over the frame, for each component of phi of both."""
        return np.repeat([self.first.frame_span, self.second.frame_span], 3)

    def evenly(self, most: int) -> Pair:
        """At most so many of the matches, evenly spaced in their order."""
        count = len(self.first.clock)
        if count <= most:
            return self
        chosen = np.linspace(0, count - 1, most).astype(int)
        return Pair(self.first.select(chosen), self.second.select(chosen))


@dataclass(frozen=True)
class RelativePose:
    """A relative pose with the rotation of both cameras during the readout.

    Attributes
    ----------
    R_21, t_21 : (3, 3), (3,) array
        From the first camera to the second, `x_2 ~ R_21 x_1 + t_21` at their reference rows; t of length 1.
    phi : (2, 3) array
        Of the first and of the second, radians per unit of the clock.
    cost : float
        What the estimate minimises, squared pixels: robust squares of the distances, and the prior of phi.
    phi_sigma : (2, 3) array
        Standard deviations of phi, for noise of one pixel.
    """

    R_21: Array
    t_21: Array
    phi: Array
    cost: float = np.inf
    phi_sigma: Array | None = None

    def distances_px(self, pair: Pair) -> Array:
        """(n,) Sampson distances of the matches in pixels of the photos as they are, shutters included."""
        distance = np.empty(len(pair.first.clock))
        kernels.sampson(*pair.arrays, self.R_21, self.t_21, self.phi[0], self.phi[1], distance)
        return np.abs(distance)


def find_relative_pose(pair: Pair, phi_sigma: float) -> RelativePose | None:
    """Relative pose of two photos with a shutter, from matches many of which may be wrong.

    Five points suggest poses without a shutter (RANSAC); each is adjusted to all matches with both motions under a
    robust loss, so that its inliers grow over the photos, and the one that costs least is the answer. The distance is
    Sampson's by the raw pixels: rows that a motion makes alike have no more distance between them, and no more room for
    noise either, so that motions which collapse the photos onto a line, as algebraic errors favour them, do not win.

    Parameters
    ----------
    phi_sigma : float
        Prior standard deviation of the components of phi, radians a frame.

    Returns
    -------
    RelativePose
        Or None if no five points agree on one.
    """
    starts = suggested_poses(pair)
    if not starts:
        return None
    found = [adjusted_pose(start, pair, phi_sigma, _WIDTHS_PX[0]) for start in starts]
    return _ahead(adjusted_pose(min(found, key=lambda each: each.cost), pair, phi_sigma, _WIDTHS_PX[1]), pair)


def best_relative_pose(pair: Pair, phi_sigma: float, known: Sequence[RelativePose] = ()) -> RelativePose | None:
    """Relative pose of two photos, from more starts than `find_relative_pose` has, and by the noise of its matches.

    A long lens has several poses that fit nearly as well, and five points may suggest a wrong one: so pycolmap's pose
    is a start, too, and each is adjusted to the end before the one that costs least is chosen. That one is adjusted
    once more under a loss as wide as the noise of the pair's inliers asks for.

    Parameters
    ----------
    phi_sigma : float
        Prior standard deviation of the components of phi, radians a frame.
    known : sequence of RelativePose, optional
        Poses that were adjusted with this prior already.

    Returns
    -------
    RelativePose
        Or None if nothing suggests one.
    """
    few, found = pair.evenly(_SUGGESTING), [*known]
    for start in (*suggested_poses(few, _WIDE_PX), *_poses_for_mapping(few)):
        grown = adjusted_pose(start, pair, phi_sigma, _WIDTHS_PX[0])
        found.append(adjusted_pose(grown, pair, phi_sigma, _WIDTHS_PX[1]))
    if not found:
        return None
    best = min(found, key=lambda each: each.cost)
    return _ahead(adjusted_pose(best, pair, phi_sigma, _WIDTH * _noise_px(best, pair)), pair)


def _noise_px(pose: RelativePose, pair: Pair) -> float:
    """Standard deviation of a pair's inliers in pixels, of normal noise, by their median."""
    distances = pose.distances_px(pair)
    near = distances[distances < INLIER_PX]
    return max(float(np.median(near)) / _MEDIAN, _LEAST_NOISE_PX) if len(near) >= _LEAST_MATCHES else 1.0


def relative_poses(pairs: Sequence[Pair]) -> tuple[list[RelativePose | None], float]:
    """Relative poses of many pairs of photos, and the prior standard deviation of phi, radians a frame.

    That prior standard deviation is the one that these motions have (empirical Bayes: squares over what
    the matches, not the prior, determine): photos without a shutter get none. With it each pair is adjusted from other
    starts, too (`best_relative_pose`), since the motions that its estimation begins with may lead to a wrong minimum.
    """
    poses = [find_relative_pose(pair, _START_SIGMA) for pair in pairs]
    sigma = _START_SIGMA
    for _ in range(_ROUNDS):
        squares, known = [], []
        for pose, pair in zip(poses, pairs, strict=True):
            if pose is not None and pose.phi_sigma is not None:
                squares.append(((pose.phi.ravel() * pair.frame_spans) ** 2).sum())
                known.append((1.0 - (pose.phi_sigma.ravel() * pair.frame_spans / sigma) ** 2).sum())
        if not squares:
            break
        # the middle of the pairs: one of false matches moves as it likes
        sigma = max(float(np.sqrt(np.median(squares) / max(np.median(known), 1e-3))), NO_SHUTTER)
        poses = [
            None if pose is None else adjusted_pose(pose, pair, sigma, _WIDTHS_PX[1])
            for pose, pair in zip(poses, pairs, strict=True)
        ]
    begun: list[list[RelativePose]] = [[] if pose is None else [pose] for pose in poses]
    return [best_relative_pose(pair, sigma, each) for pair, each in zip(pairs, begun, strict=True)], sigma


def _poses_for_mapping(pair: Pair) -> list[RelativePose]:
    """The pose that pycolmap verifies a pair by, from an essential matrix or a plane; none if it finds none."""
    if len(pair.first.clock) < _LEAST_MATCHES:
        return []
    pycolmap = quiet_pycolmap()
    sides = [
        (pycolmap.Camera(model="PINHOLE", width=1, height=1, params=[view.focal_px, view.focal_px, 0.0, 0.0]),
         view.normalized * view.focal_px)
        for view in (pair.first, pair.second)
    ]  # fmt: skip
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose, options.ransac.random_seed = True, 0
    options.ransac.max_num_trials = _TRIALS
    each = np.repeat(np.arange(len(pair.first.clock), dtype=np.uint32)[:, None], 2, axis=1)
    pose = pycolmap.estimate_calibrated_two_view_geometry(*sides[0], *sides[1], each, options).cam2_from_cam1
    length = 0.0 if pose is None else float(np.linalg.norm(pose.translation))
    if not length > 0.0:
        return []
    return [RelativePose(pose.rotation.matrix(), np.asarray(pose.translation) / length, np.zeros((2, 3)))]


def suggested_poses(pair: Pair, search_px: Sequence[float] = _SEARCH_PX) -> list[RelativePose]:
    """Poses by five points each, without a shutter, for each threshold in pixels."""
    if len(pair.first.clock) < _LEAST_MATCHES:
        return []
    x_1, x_2 = pair.first.normalized, pair.second.normalized
    focal_px, poses = 0.5 * (pair.first.focal_px + pair.second.focal_px), []
    for within in search_px:
        E, inlier = cv2.findEssentialMat(
            x_1, x_2, np.eye(3), method=cv2.USAC_DEFAULT, prob=_CONFIDENCE, threshold=within / focal_px,
            maxIters=_SEARCHES,
        )  # fmt: skip
        if E is not None and E.shape == (3, 3):
            _, R, t, _ = cv2.recoverPose(E, x_1, x_2, np.eye(3), mask=inlier)
            poses.append(RelativePose(R, t.ravel(), np.zeros((2, 3))))
    return poses


def adjusted_pose(start: RelativePose, pair: Pair, phi_sigma: float, width: float) -> RelativePose:
    """Pose and motions by Levenberg and Marquardt's steps under a loss of such a width, in pixels.

    `phi_sigma` is the prior standard deviation of phi, radians a frame.
    """
    weights = (pair.frame_spans / phi_sigma) ** 2
    H, g = np.empty((11, 11)), np.empty(11)

    def system_of(pose: RelativePose) -> tuple[RelativePose, Array, Array, NDArray[Any]]:
        across = _across(pose.t_21)
        cost = kernels.pair_system(*pair.arrays, pose.R_21, pose.t_21, across, *pose.phi, width, H, g)
        phi = pose.phi.ravel()
        A, b = H.copy(), g.copy()
        A[range(5, 11), range(5, 11)] += weights
        b[5:] += weights * phi
        return replace(pose, cost=float(cost + weights @ phi**2)), A, b, across

    (now, A, b, across), damping = system_of(start), 1e-3
    for _ in range(_MAX_STEPS):
        step = -np.linalg.solve(A + np.diag(damping * np.diag(A) + 1e-12), b)
        t = now.t_21 + step[3:5] @ across
        moved = RelativePose(
            Rotation.from_rotvec(step[:3]).as_matrix() @ now.R_21, t / np.linalg.norm(t),
            now.phi + step[5:].reshape(2, 3),
        )  # fmt: skip
        then = system_of(moved)
        if not then[0].cost < now.cost:
            damping *= 10.0
            if damping > _GIVEN_UP:
                break
            continue
        settled = now.cost - then[0].cost < _CONVERGED * now.cost
        (now, A, b, across), damping = then, damping / 10.0
        if settled:
            break
    covariance = np.linalg.inv(A + 1e-9 * np.diag(np.diag(A)) + 1e-12 * np.eye(11))
    return replace(now, phi_sigma=np.sqrt(np.maximum(np.diag(covariance)[5:], 0.0)).reshape(2, 3))


def phi_information(pose: RelativePose, pair: Pair) -> tuple[Array, Array]:
    """Inverse covariance (6, 6) of both phi by the matches alone, whatever the pose, and the gradient (6,) there.

    For noise of one pixel. The gradient is what the prior of an estimate holds against.
    """
    H, g = np.empty((11, 11)), np.empty(11)
    kernels.pair_system(*pair.arrays, pose.R_21, pose.t_21, _across(pose.t_21), *pose.phi, _WIDTHS_PX[1], H, g)
    H += 1e-9 * np.diag(np.diag(H)) + 1e-12 * np.eye(11)
    of_pose = np.linalg.solve(H[:5, :5], np.column_stack([H[:5, 5:], g[:5]]))
    return H[5:, 5:] - H[5:, :5] @ of_pose[:, :6], g[5:] - H[5:, :5] @ of_pose[:, 6]


def _across(t: Array) -> Array:
    """(2, 3) directions at right angles to a unit vector."""
    first = np.cross(t, np.eye(3)[np.argmin(np.abs(t))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(t, first)])


def _ahead(pose: RelativePose, pair: Pair) -> RelativePose:
    """The pose with the sign of t that has most points ahead of both cameras."""
    near = pose.distances_px(pair) < INLIER_PX
    rays = [
        (Rotation.from_rotvec(-view.clock[near, None] * phi).apply(view.rays[near]) if near.any() else view.rays[:0])
        for view, phi in zip((pair.first, pair.second), pose.phi, strict=True)
    ]
    # x_2 along s_2, R x_1 along s_1 meet where s_2 x_2 - s_1 R x_1 = t: cross products give the signs of both
    x_1, x_2 = rays[0] @ pose.R_21.T, rays[1]
    normal = np.cross(x_1, x_2)
    s_1 = np.einsum("ni,ni->n", np.cross(pose.t_21, x_2), -normal)
    s_2 = np.einsum("ni,ni->n", np.cross(pose.t_21, x_1), -normal)
    forward = ((s_1 > 0) & (s_2 > 0)).sum() >= ((s_1 < 0) & (s_2 < 0)).sum()
    return pose if forward else replace(pose, t_21=-pose.t_21)
