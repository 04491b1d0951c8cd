"""Similarities that take points to others, of which some are wrong."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from .array_types import Array
from .checks import frozen
from .reconstruction import Reconstruction

__all__ = ["FittedSimilarity", "Similarity", "fit_similarity", "similarity_of"]


# Triples of points that are tried; all of up to 13 points, at random of more.
_TRIES = 300
# Squared deviations, in units of sigma, where the weight of a place halves: three coordinates of three sigma each.
_BEND = 27.0
_STEPS = 50


@dataclass(frozen=True)
class Similarity:
    """x becomes scale R x + shift.

    Attributes
    ----------
    scale : float
        Positive.
    R : (3, 3) array
        Rotation.
    shift : (3,) array
        Translation.
    """

    scale: float
    R: Array
    shift: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "R", frozen(np.asarray(self.R, np.float64)))
        object.__setattr__(self, "shift", frozen(np.asarray(self.shift, np.float64)))

    def of(self, points: Array) -> Array:
        """Points (n, 3), moved."""
        return self.scale * points @ self.R.T + self.shift

    def of_reconstruction(self, reconstruction: Reconstruction) -> Reconstruction:
        """A reconstruction, moved; its photos show the same."""
        return reconstruction.moved(self.R, -self.R.T @ self.shift / self.scale, self.scale)

    def after(self, other: Similarity) -> Similarity:
        """The composition of both, the other one applied first."""
        return Similarity(self.scale * other.scale, self.R @ other.R, self.of(other.shift[None])[0])


@dataclass(frozen=True)
class FittedSimilarity:
    """A similarity, and how well it is known.

    Attributes
    ----------
    middle : (3,) array
        That of the points, weighed, where they were moved to.
    sigma_m : (3,) array
        Standard deviations of its place.
    sigma_rad : (3,) array
        Of the rotation about the axes of the target; inf about an axis that nothing determines.
    sigma_scale : float
        Of the scale, relative.
    residuals : (m, 3) array
        Points where they were moved to less their targets.
    deviations : (m,) array
        Root mean square of a point's residuals in their standard deviations.
    """

    similarity: Similarity
    middle: Array
    sigma_m: Array
    sigma_rad: Array
    sigma_scale: float
    residuals: Array
    deviations: Array

    def variance_at(self, points: Array) -> Array:
        """Variances (n, 3) that it gives to places (n, 3), as if its parts were independent."""
        arm = np.asarray(points, np.float64) - self.middle
        tilt = np.cross(np.eye(3), arm[:, None]) * self.sigma_rad[:, None]
        return self.sigma_m**2 + (tilt**2).sum(1) + (self.sigma_scale * arm) ** 2


def similarity_of(points: Array, targets: Array) -> Similarity:
    """The similarity of least squares that takes points (n, 3) to targets, after Umeyama (1991)."""
    mean, mean_target = points.mean(0), targets.mean(0)
    X, Y = points - mean, targets - mean_target
    U, s, Vt = np.linalg.svd(Y.T @ X)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = max(float((s * flip).sum() / max(np.sum(X**2), 1e-300)), 1e-300)
    R = (U * flip) @ Vt
    return Similarity(scale, R, mean_target - scale * R @ mean)


def fit_similarity(
    points: Array, targets: Array, sigma: Array, rotation: tuple[Array, float] | None = None
) -> FittedSimilarity:
    """The similarity that takes points (m, 3), three or more, to targets of standard deviations (m, 3).

    Robust: the triple whose similarity leaves the least median is the start, weights of Cauchy's loss find the rest.
    The standard deviations grow with the residuals where these are larger than their own say. `rotation` is one that
    is known, (3, 3), with its standard deviation about each axis in radians: points along a line need it.
    """
    m = len(points)
    if m <= 13:
        triples = list(combinations(range(m), 3))
    else:
        rng = np.random.default_rng(0)
        triples = [tuple(rng.choice(m, 3, replace=False).tolist()) for _ in range(_TRIES)]
    tried = [similarity_of(points, targets)] + [similarity_of(points[[*t]], targets[[*t]]) for t in triples]
    if rotation is not None:
        tried += [_rotated(each, points, rotation[0]) for each in tried]
    found = min(
        tried,
        key=lambda each: float(np.median(_squares(each, points, targets, sigma))) + _rotation_square(each, rotation),
    )
    for _ in range(_STEPS):
        weight = 1 / (1 + _squares(found, points, targets, sigma) / _BEND)
        found, step, H, middle = _step(found, points, targets, sigma, weight, rotation)
        if step < 1e-12:
            break
    square = _squares(found, points, targets, sigma)
    excess = max(1.0, float((weight * square).sum()) / max(3 * m - 7, 1))
    # what nothing determines has no curvature
    values, vectors = np.linalg.eigh(H)
    with np.errstate(divide="ignore"):
        variance = np.where(values > 1e-9 * values.max(), 1 / np.maximum(values, 1e-300), np.inf)
    share = np.where(vectors**2 > 1e-12, vectors**2, 0.0)
    diagonal = np.array([sum(a * v for a, v in zip(row, variance, strict=True) if a > 0) for row in share])
    unit = float(np.sqrt(np.mean(((found.of(points) - middle) ** 2).sum(1)))) or 1.0
    sigmas = np.sqrt(excess * diagonal) / np.r_[np.ones(3), np.full(4, unit)]
    return FittedSimilarity(
        found, middle, sigmas[:3], sigmas[3:6], float(sigmas[6]), found.of(points) - targets, np.sqrt(square / 3)
    )  # fmt: skip


def _rotated(found: Similarity, points: Array, R: Array) -> Similarity:
    """The same scale and middle with another rotation."""
    middle = points.mean(0)
    return Similarity(found.scale, R, found.of(middle[None])[0] - found.scale * R @ middle)


def _rotation_square(found: Similarity, rotation: tuple[Array, float] | None) -> float:
    """Squared deviation from a rotation that is known, in units of sigma."""
    if rotation is None:
        return 0.0
    return float((Rotation.from_matrix(found.R @ rotation[0].T).magnitude() / rotation[1]) ** 2)


def _squares(found: Similarity, points: Array, targets: Array, sigma: Array) -> Array:
    """(m,) squared residuals in units of sigma."""
    return (((found.of(points) - targets) / sigma) ** 2).sum(1)


def _step(
    found: Similarity, points: Array, targets: Array, sigma: Array, weight: Array, rotation: tuple[Array, float] | None
) -> tuple[Similarity, float, Array, Array]:
    """A Gauss-Newton step: the new similarity, its size, the Hessian of shift, rotation and scale, and the middle.

    Rotation and scale are about the middle of the points, and in units that make them as large as shifts.
    """
    moved = found.of(points)
    by = weight[:, None] / sigma**2
    middle = (by * moved).sum(0) / by.sum(0)
    arm = moved - middle
    unit = float(np.sqrt(np.mean((arm**2).sum(1)))) or 1.0
    J = np.zeros((len(points), 3, 7))
    J[:, :, :3] = np.eye(3)
    for k in range(3):
        J[:, :, 3 + k] = np.cross(np.eye(3)[k], arm) / unit
    J[:, :, 6] = arm / unit
    H = np.einsum("mia,mi,mib->ab", J, by, J)
    g = np.einsum("mia,mi,mi->a", J, by, moved - targets)
    if rotation is not None:
        information = (rotation[1] * unit) ** -2
        H[range(3, 6), range(3, 6)] += information
        g[3:6] += information * unit * Rotation.from_matrix(found.R @ rotation[0].T).as_rotvec()
    step = -np.linalg.pinv(H, rcond=1e-9, hermitian=True) @ g
    # no step is longer than what it is linear in
    factor = float(np.exp(np.clip(step[6] / unit, -1.0, 1.0)))
    R = Rotation.from_rotvec(step[3:6] / unit).as_matrix()
    about = Similarity(factor, R, middle - factor * R @ middle + step[:3])
    return about.after(found), float(np.linalg.norm(step) / unit), H, middle
