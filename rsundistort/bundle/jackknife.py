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
much that is, the same question says of residuals that a fit would leave of independent noise, and of that noise itself.

A variance from few groups is noisy: factors are pooled over photos, one for each kind of unknown, and none is below 1.
What the priors contribute is theirs, and stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .normal_equations import PRIORS_ERROR, Function, Marginals, NormalEquations

__all__ = ["Inflation", "Partition", "by_corner", "by_place", "inflated", "inflation", "inflation_of"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FAMILY = 4
# Families of points that a photo sees: with fewer their variance is noise, with more they part what goes together.
# (Warped herz-jesus-8, whose photos see all of the scene: deviations of phi1 grow by 2.0, 2.2, 2.5, 2.7 and 2.8 for
# 256, 128, 64, 32 and 16 groups without families.)
_FAMILIES = 32
# Families of the corners of a lens, on each side of the photo.
_CORNERS = 4
# A fit that leaves less than this share of a variance to see hides what it is of.
_LEAST_SEEN = 0.2


@dataclass(frozen=True)
class Partition:
    """Groups of measurements that may go wrong together.

    Attributes
    ----------
    group : (o,) int array
        Group of each measurement, in families of four: 4 f to 4 f + 3 are those of family f.
    """

    group: Index

    @property
    def num_families(self) -> int:
        """Number of families."""
        return int(self.group.max(initial=0)) // _FAMILY + 1

    def sketch(self, most: int) -> tuple[Index, Array, int]:
        """Fewer groups for the same sums of squares: group and sign of each measurement, and the number of groups.

        Families that share their groups do so with signs drawn at random, so that their products with each other have
        the mean zero. Those that follow each other, as near ones do, are kept apart.
        """
        family, own = np.divmod(self.group, _FAMILY)
        count = self.num_families
        sign = np.ones(count) if count <= most else np.random.default_rng(0).choice([-1.0, 1.0], count)
        return family % most * _FAMILY + own, sign[family], min(count, most) * _FAMILY


def by_place(points_w: Array, point_idx: Index, num_frames: int) -> Partition:
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
    return Partition(cell[point_idx])


def by_corner(xy_raw: Array, size: Array, camera: Index) -> Partition:
    """Measurements (o, 2) in the same part of photos of the same camera (o,), whose widths and heights are (o, 2)."""
    sides = 2 * _CORNERS
    x, y = np.clip(sides * (xy_raw + 0.5) / size, 0, sides - 1).astype(np.int64).T
    family = (camera * _CORNERS + y // 2) * _CORNERS + x // 2
    return Partition(_FAMILY * family + 2 * (y % 2) + x % 2)


def _squares(pulls: Array) -> Array:
    """Variances (...) by the pulls (groups, ...) of whole families: products inside a family count twice."""
    families = pulls.reshape(len(pulls) // _FAMILY, _FAMILY, *pulls.shape[1:])
    value: Array = 2.0 * (families.sum(1) ** 2).sum(0) - (families**2).sum((0, 1))
    return value


class _Residuals(NamedTuple):
    """Residuals (o, 2), independent noise of the size that weighs the measurements, and what a fit leaves of it."""

    seen: Array
    drawn: Array
    left: Array

    @classmethod
    def of(cls, equations: NormalEquations) -> _Residuals:
        """The residuals of a solution."""
        rng = np.random.default_rng(0)
        seen, J = equations.blocks
        drawn = rng.normal(size=seen.shape)
        photos = rng.normal(size=(equations.num_photos, J.shape[2]))
        return cls(seen, drawn, equations.residuals_of(drawn, photos, rng.normal(size=equations.num_shared)))

    @property
    def square(self) -> float:
        """Mean square of the noise, in the units of what weighs the measurements."""
        return float((self.seen**2).sum() / (self.left**2).sum())


def _ratios(variances: Sequence[Array], noise: Array) -> Array:
    """Variances (kinds,) seen over those of independent noise, from those of each of `_Residuals`.

    What the fit hides is taken to be the same of all kinds.
    """
    seen, drawn, left = (np.divide(each, noise, out=np.zeros_like(noise), where=noise > 0) for each in variances)
    shown = float(left.sum() / drawn.sum()) if drawn.sum() > 0 else 1.0
    value: Array = seen / max(shown, _LEAST_SEEN)
    return value


def _deviations(excess: Array, square: float, partitions: Sequence[Partition], noise_factor: float) -> Array:
    """Factors of deviations by the excess of variances over what the mean square of the residuals says.

    An excess counts as far as it stands out of what independent noise makes of so few families (the positive part of
    James and Stein's estimate).
    """
    # twice the squares of F sums of normal variables of variance 1 / F, less those of their four parts
    doubt = square**2 * sum((8 + 0.5 - 2) / min(each.num_families, _FAMILIES) for each in partitions)
    shrunk = excess - np.divide(doubt, excess, out=np.full_like(excess, np.inf), where=excess > 0)
    value: Array = np.sqrt(np.maximum(noise_factor**2 * (square + np.maximum(shrunk, 0.0)), 1.0))
    return value


def _pulls(equations: NormalEquations, residuals: Array, partition: Partition, most: int) -> tuple[Array, Array]:
    """How far groups of residuals (o, 2) pull photos (groups, m, nb) and cameras (groups, k)."""
    group, sign, count = partition.sketch(most)
    return equations.group_pulls(sign[:, None] * residuals, group, count)


class Inflation(NamedTuple):
    """How many times larger than with independent noise its share of the deviations is; 1 or more.

    Attributes
    ----------
    photos : (nb,) array
        Of each kind of unknown of the photos.
    cameras : (nc,) array
        Of each kind of unknown of the cameras.
    """

    photos: Array
    cameras: Array

    @property
    def noise(self) -> float:
        """One factor for all that has a prior of mean zero: the motion and what varies of photos, else the lens."""
        kinds = self.photos[6:] if len(self.photos) > 6 else self.cameras
        return float(np.sqrt(np.mean(kinds**2))) if len(kinds) else 1.0


def inflation(
    equations: NormalEquations, partitions: tuple[Partition, ...], marginals: Marginals, noise_factor: float = 1.0
) -> Inflation:
    """The factors, from the residuals at an optimum and the covariances there.

    `noise_factor` is how many times larger than independent noise the noise is that weighs the measurements there.
    """
    c = equations.num_cameras
    totals, priors = (
        (np.einsum("maa->ma", photos), np.diagonal(cameras).reshape(c, -1))
        for photos, cameras in (marginals[:2], marginals[2:])
    )
    if equations.inverse is None:
        return Inflation(*(np.ones(total.shape[1]) for total in totals))
    residuals = _Residuals.of(equations)
    of_lengths = [(each**2).sum(0) for each in equations.length_pulls()]
    # a unit counts by its noise's share
    weights = [np.divide(1.0, total, out=np.zeros_like(total), where=total > 0) for total in totals]
    noise = [(weight * (total - prior)).sum(0) for weight, total, prior in zip(weights, totals, priors, strict=True)]
    # of a difference that is off by so much, less means nothing: such are poses that only their places hold
    noise = [
        np.where(each > PRIORS_ERROR * (total > 0).sum(0), each, 0.0) for each, total in zip(noise, totals, strict=True)
    ]
    square = residuals.square
    excess = [np.zeros_like(each) for each in noise]
    # what a fit hides is the mean over all photos: of many it takes few families to find
    families = _FAMILIES, *[int(np.clip(8 * _FAMILIES // len(totals[0]), _FAMILY, _FAMILIES))] * 2
    for partition in partitions:
        pulls = [_pulls(equations, each, partition, most) for each, most in zip(residuals, families, strict=True)]
        for k, weight in enumerate(weights):
            variances = [(weight * (_squares(each[k]) + of_lengths[k]).reshape(weight.shape)).sum(0) for each in pulls]
            excess[k] += _ratios(variances, noise[k]) - square
    return Inflation(*(_deviations(each, square, partitions, noise_factor) for each in excess))


def inflated(marginals: Marginals, photos: Array, cameras: Array) -> tuple[Array, Array]:
    """Covariances of photos (m, nb, nb) and cameras (k, k) with the noise's share of the deviations enlarged.

    By a factor for each kind of unknown, (nb,) and (nc,).
    """
    of_cameras = np.tile(cameras, len(marginals.cameras) // max(len(cameras), 1))
    parts = zip(marginals[:2], marginals[2:], (photos, of_cameras), strict=True)
    of_photos, of_all_cameras = (prior + by[:, None] * (total - prior) * by for total, prior, by in parts)
    return of_photos, of_all_cameras


def inflation_of(
    found: Function, equations: NormalEquations, partitions: tuple[Partition, ...], noise_factor: float = 1.0
) -> float:
    """The factor of a function of the points: what a photo's unknowns suffer need not be what it does."""
    residuals = _Residuals.of(equations)
    noise, excess, square = np.array([found.variance - found.of_priors]), np.zeros(1), residuals.square
    for partition in partitions:
        variances = []
        for each in residuals:
            sums = np.zeros(_FAMILY * partition.num_families)
            np.add.at(sums, partition.group, (found.pulls * each).sum(1))
            variances.append(_squares(sums[:, None]) + found.of_lengths)
        excess += _ratios(variances, noise) - square
    return float(_deviations(excess, square, partitions, noise_factor)[0])
