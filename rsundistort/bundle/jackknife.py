"""Standard deviations of a solution from its own residuals, with correlated measurements.

What lens, scene or shutter model leave out bends neighbouring measurements alike, so that they contain less information
than as many independent ones, whose covariance is the inverse of the Hessian H. The infinitesimal delete-a-group
jackknife (Jaeckel, "The infinitesimal jackknife", 1972; White's sandwich, by groups) asks the residuals instead: with g
the gradient of a group of measurements, the covariance of the noise's share is sum_g (H^-1 g)(H^-1 g)', whatever goes
on in the groups.

Two partitions are asked: points by their place (a corner of the scene: measurements of a track are aligned with each
other, and its neighbours look at the same things) and measurements by their place in the photo, over all photos of a
camera (a corner of the lens). What each shows above independent noise is added, as Cameron, Gelbach and Miller do
("Robust inference with multiway clustering", 2011). Neighbours that a border parts are missed: groups come in families
of four, and products inside a family count twice, for as many pairs of neighbours belong to different families (a lag
window that errs to the safe side; Vats and Flegal, "Lugsail lag windows", 2022).

The fit follows the noise, most where few measurements decide, and what it has followed the residuals do not show. How
much that is, the same question says of residuals that a fit leaves of independent noise.

Photos' priors are estimated, with the noise: more of it narrows them, and residuals then contain what they keep the
motions from explaining. Taken for noise, that would grow until no motion is left (of 56 points in photos that moved, up
to twelve times). So residuals are asked as they would be without these priors. A path's stay: they join its frames.

A variance from few groups is noisy: one factor, the mean over the components of the motions, serves the photos and all
that follows from them, another the cameras, and none is below 1. (With one for each component, that of phi1 came out
between 1.4 and 5.3 on renderings of the same scene, whose true residuals say 2.2 to 3.3.) What the priors contribute is
theirs, and stays.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..model.array_types import Array, Index
from .normal_equations import PRIORS_ERROR, Marginals, NormalEquations

__all__ = ["Inflation", "by_corner", "by_place", "inflated", "inflation", "sketch"]


# A partition has the group (o,) of each measurement: those of a group may go wrong together. Groups come in families,
# 4 f to 4 f + 3 are those of family f.
_FAMILY = 4
# Families of points that a photo sees: with fewer their variance is noise, with more they part what goes together.
# (Warped herz-jesus-8, whose photos see all of the scene: deviations of phi1 grow by 2.0, 2.2, 2.5, 2.7 and 2.8 for
# 256, 128, 64, 32 and 16 groups without families.)
_FAMILIES = 32
# Families of the corners of a lens, on each side of the photo.
_CORNERS = 4
# Draws of independent noise, at the least: their spread is the doubt of a variance.
_LEAST_DRAWS = 4
# A fit that leaves less than this share of a variance to see hides what it is of.
_LEAST_SEEN = 0.2
# Deviations of an excess beyond which it weighs measurements. A deviation that is too large harms nobody; a weight that
# is too small lets the priors take a part of the motions.
_SURE = 2.0
# Precision of the photos' priors as residuals are asked; where nothing else holds a motion, some is left.
_RELEASED = 0.01


def sketch(partition: Index, most: int) -> tuple[Index, Array, int]:
    """Fewer groups for the same sums of squares: group and sign of each measurement, and the number of groups.

    Families that share their groups do so with signs drawn at random, so that their products with each other have
    the mean zero. Those that follow each other, as near ones do, are kept apart.
    """
    family, own = np.divmod(partition, _FAMILY)
    count = int(family.max(initial=0)) + 1
    sign = np.ones(count) if count <= most else np.random.default_rng(0).choice([-1.0, 1.0], count)
    return family % most * _FAMILY + own, sign[family], min(count, most) * _FAMILY


def by_place(points_w: Array, point_idx: Index, num_frames: int) -> Index:
    """Whole tracks (o,) of points (n, 3) in neighbouring cells of equal counts, by repeated bisection."""
    n = len(points_w)
    # photos times families, over the photos that share each
    wanted = _FAMILIES * num_frames * n / max(len(point_idx), 1)
    depth = int(np.clip(np.ceil(np.log2(max(wanted, 1.0))), 0, np.log2(max(n // _FAMILY, 1)))) + 2
    x = points_w - np.median(points_w, axis=0) if n else points_w
    # far points lie at the walls of a box: the scene is not cut for their sake
    x = np.clip(x, *(sign * 4 * np.median(np.abs(x), axis=0) for sign in (-1, 1))) if n else x
    cell = np.zeros(n, np.int64)
    for level in range(depth):
        count = np.bincount(cell, minlength=2**level)
        mean, square = (
            np.stack([np.bincount(cell, each[:, a], 2**level) for a in range(3)], axis=1)
            / np.maximum(count, 1)[:, None]
            for each in (x, x**2)
        )
        side = np.argmax(square - mean**2, axis=1)
        order = np.lexsort((x[np.arange(n), side[cell]], cell))
        place = np.empty(n, np.int64)
        place[order] = np.arange(n)
        behind = place - (np.cumsum(count) - count)[cell] >= ((count + 1) // 2)[cell]
        cell = 2 * cell + behind
    return cell[point_idx]


def by_corner(xy_raw: Array, size: Array, camera: Index) -> Index:
    """Measurements (o, 2) in the same part of photos of the same camera (o,), whose widths and heights are (o, 2)."""
    sides = 2 * _CORNERS
    x, y = np.clip(sides * (xy_raw + 0.5) / size, 0, sides - 1).astype(np.int64).T
    family = (camera * _CORNERS + y // 2) * _CORNERS + x // 2
    return _FAMILY * family + 2 * (y % 2) + x % 2


def _squares(pulls: Array) -> Array:
    """Variances (...) by the pulls (groups, ...) of whole families: products inside a family count twice."""
    families = pulls.reshape(len(pulls) // _FAMILY, _FAMILY, *pulls.shape[1:])
    return 2.0 * (families.sum(1) ** 2).sum(0) - (families**2).sum((0, 1))


class Inflation(NamedTuple):
    """How many times larger than with independent noise its share of the deviations is; 1 or more.

    Attributes
    ----------
    photos, cameras : float
        Of the unknowns of the photos, by what they have beside their poses if anything, and of the cameras.
    has_pace : bool
        Whether the last unknown of a camera is the pace of its path: that is one of the motions.
    sure_photos, sure_cameras : float
        The same as far as they are certain (two deviations of their own): what measurements are weighed with.
    """

    photos: float = 1.0
    cameras: float = 1.0
    has_pace: bool = False
    sure_photos: float = 1.0
    sure_cameras: float = 1.0


def inflation(
    equations: NormalEquations,
    partitions: tuple[Index, ...],
    marginals: Marginals,
    noise_factor: float = 1.0,
    has_pace: bool = False,
) -> Inflation:
    """The factors, from the residuals at an optimum and the covariances there.

    `noise_factor` is how many times larger than independent noise the noise is that weighs the measurements there.
    """
    if equations.inverse is None:
        return Inflation()
    shares = _Shares.of(equations, marginals, has_pace)
    m = equations.num_photos
    released, seen = (equations, equations.blocks[0]) if has_pace else equations.released(_RELEASED)
    # what a fit leaves is the mean over all photos: of many it takes few families to find, and few draws
    few = int(np.clip(8 * _FAMILIES // m, _FAMILY, _FAMILIES))
    draws = int(np.clip(64 // m, _LEAST_DRAWS, 2 * _LEAST_DRAWS))
    left = _left_of_noise(released, draws, with_priors=released is equations)
    # of the residuals, in the units of what weighs the measurements
    square = float((seen**2).sum() / np.mean([(each**2).sum() for each in left]))
    excess, doubt = np.zeros(2), np.zeros(2)
    for partition in partitions:
        of_noise = np.array([shares.variances(equations, each, partition, few) for each in left])
        shown = np.maximum(of_noise.mean(0), _LEAST_SEEN)
        excess += shares.variances(equations, seen, partition, _FAMILIES) / shown - square
        doubt += few / _FAMILIES * (square / shown) ** 2 * of_noise.var(0, ddof=1)
    # as far as it stands out of what independent noise makes of so few families (the positive part of James and Stein's
    # estimate)
    share = np.divide(doubt, excess, out=np.full(2, np.inf), where=excess > 0)
    by_belief = np.stack([excess - share, excess - _SURE**2 * share]).clip(0.0)
    factors = np.sqrt(np.maximum(noise_factor**2 * (square + by_belief), 1.0))
    # nothing is uncertain by the noise, such as a lens that is held
    factors[:, [not noise.any() for noise in shares.noise]] = 1.0
    (photos, cameras), (sure_photos, sure_cameras) = factors.tolist()
    return Inflation(photos, cameras, has_pace, sure_photos, sure_cameras)


def _left_of_noise(equations: NormalEquations, draws: int, with_priors: bool) -> list[Array]:
    """What a fit leaves (o, 2) of independent noise of the size that weighs the measurements, so many times.

    And of photos' priors whose means are off, if asked for.
    """
    rng = np.random.default_rng(0)
    seen, J = equations.blocks
    of_photos, of_cameras = (equations.num_photos, J.shape[2]), equations.num_shared
    return [
        equations.residuals_of(
            rng.normal(size=seen.shape), with_priors * rng.normal(size=of_photos), rng.normal(size=of_cameras), rng
        )
        for _ in range(draws)
    ]


class _Shares(NamedTuple):
    """By what the unknowns' variances count: of the photos, and of the cameras.

    Attributes
    ----------
    weight : pair of (units, kinds) array
        Of each unknown: a photo, or a camera, counts by the noise's share.
    noise : pair of (kinds,) array
        That share, if noise is independent; 0 of kinds that are not asked.
    of_lengths : pair of array
        Variances that known lengths contribute.
    """

    weight: tuple[Array, Array]
    noise: tuple[Array, Array]
    of_lengths: tuple[Array, Array]

    @classmethod
    def of(cls, equations: NormalEquations, marginals: Marginals, has_pace: bool) -> _Shares:
        """Those of a solution."""
        weights, noises = [], []
        c = equations.num_cameras
        for total, prior in (
            (np.einsum("maa->ma", marginals.photos), np.einsum("maa->ma", marginals.photos_of_priors)),
            (np.diagonal(each).reshape(c, -1) for each in (marginals.cameras, marginals.cameras_of_priors)),
        ):
            weight = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
            noise = (weight * (total - prior)).sum(0)
            # of a difference that is off by so much, less means nothing: such are poses that only their places hold
            noise[noise <= PRIORS_ERROR * (total > 0).sum(0)] = 0.0
            weights.append(weight)
            noises.append(noise)
        # motions make good what a lens leaves more than poses do
        noises[0][: 6 if noises[0][6:].any() else 0] = 0.0
        noises[1][len(noises[1]) - has_pace :] = 0.0
        lengths = [(each**2).sum(0) for each in equations.length_pulls()]
        return cls((weights[0], weights[1]), (noises[0], noises[1]), (lengths[0], lengths[1]))

    def variances(self, equations: NormalEquations, residuals: Array, partition: Index, most: int) -> Array:
        """(2,) by residuals (o, 2), over those of independent noise: the mean over the kinds, by the noise's share."""
        group, sign, count = sketch(partition, most)
        pulls = equations.group_pulls(sign[:, None] * residuals, group, count)
        found = []
        for pull, weight, noise, of_lengths in zip(pulls, *self, strict=True):
            kinds = (weight * (_squares(pull) + of_lengths).reshape(weight.shape)).sum(0)[noise > 0]
            found.append(kinds.sum() / noise.sum() if len(kinds) else 1.0)
        return np.array(found)


def inflated(marginals: Marginals, by: Inflation, num_cameras: int) -> tuple[Array, Array]:
    """Covariances of photos (m, nb, nb) and cameras (k, k) with the noise's share of the deviations enlarged."""
    of_photos, of_cameras = (total - prior for total, prior in zip(marginals[:2], marginals[2:], strict=True))
    factors = np.full((num_cameras, len(of_cameras) // num_cameras), by.cameras)
    factors[:, factors.shape[1] - by.has_pace :] = by.photos
    each = factors.ravel()
    return (
        marginals.photos_of_priors + by.photos**2 * of_photos,
        marginals.cameras_of_priors + each[:, None] * of_cameras * each,
    )
