"""How uncertain a solution is by its own residuals, where measurements go wrong together.

What lens, scene or shutter model leave out bends neighbouring measurements alike, so that they tell less than as many
independent ones, whose covariance is the inverse of the Hessian H. The infinitesimal delete-a-group jackknife (Jaeckel,
"The infinitesimal jackknife", 1972; White's sandwich in groups) asks the residuals instead: with g the summed gradient
of a group of measurements the noise's covariance is sum_g (H^-1 g)(H^-1 g)', whatever goes on inside the groups.

Two partitions are asked, of points by their place (one corner of the scene: a track's measurements are aligned with
each other, and share what the scene hides) and of measurements by their place in the photo, over all photos of a camera
(one corner of the lens). What each shows above independent noise is added (as Cameron, Gelbach and Miller do, "Robust
inference with multiway clustering", 2011). Neighbours that a border parts are missed; groups are kept in families of
four, and the products inside a family count twice, for as many pairs of neighbours belong to different families (a lag
window that errs to the safe side: Vats and Flegal, "Lugsail lag windows", 2022).

A variance from few groups is itself noisy, by a third: so the factors are pooled over photos, one for each kind of
unknown, and none is below 1. What the priors contribute is theirs, and stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .elimination import Marginals
from .normal_equations import Function, NormalEquations

__all__ = ["Inflation", "Partition", "by_corner", "by_place", "inflated", "inflated_function", "inflation"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_FAMILY = 4
# Families of points that a photo sees: with fewer their variance is noise, with more they part what goes together.
# (Groups of points on warped herz-jesus-8, whose photos see 4,000 points: deviations of phi grow by 2.0, 2.5, 2.8 and
# 2.8 from 256 groups to 128, 64, 32 and 16.)
_FAMILIES = 32
# Families of the corners of a lens, on each side of the photo.
_CORNERS = 4


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
    cells = [np.arange(n)]
    for _ in range(depth):
        cells = [half for cell in cells for half in _halves(points_w, cell)]
    group = np.empty(n, np.int64)
    for number, cell in enumerate(cells):
        group[cell] = number
    return Partition(group[point_idx])


def _halves(points_w: Array, cell: Index) -> list[Index]:
    """A cell of points cut across its longest side, far points aside."""
    x = points_w[cell]
    axis = int(np.argmax(np.subtract(*np.percentile(x, (90, 10), axis=0)))) if len(x) > 1 else 0
    return np.array_split(cell[np.argsort(x[:, axis], kind="stable")], 2)


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
        """One factor of the noise for all that has a prior of zero mean: the motion and what varies, else the lens."""
        kinds = self.photos[6:] if len(self.photos) > 6 else self.cameras
        return float(np.sqrt(np.mean(kinds**2))) if len(kinds) else 1.0


def _pooled(seen: Array, noise: Array, total: Array) -> Array:
    """Excess (kinds,) of variances (units, kinds) seen over those of independent noise, a unit by its noise's share."""
    weight = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
    expected = (weight * noise).sum(0)
    ratio = np.divide((weight * seen).sum(0), expected, out=np.ones_like(expected), where=expected > 0)
    return np.maximum(ratio - 1.0, 0.0)


def inflation(
    equations: NormalEquations, partitions: tuple[Partition, ...], marginals: Marginals, noise_factor: float = 1.0
) -> Inflation:
    """The factors, from the residuals at an optimum and the covariances there.

    `noise_factor` is how many times larger than independent noise the noise is that weighs the measurements there.
    """
    nb = marginals.photos.shape[1]
    num_cameras = equations.num_cameras
    totals = [np.einsum("maa->ma", marginals.photos), np.diagonal(marginals.cameras).reshape(num_cameras, -1)]
    priors = [
        np.einsum("maa->ma", marginals.photos_of_priors),
        np.diagonal(marginals.cameras_of_priors).reshape(num_cameras, -1),
    ]
    excess = [np.zeros(nb), np.zeros(totals[1].shape[1])]
    if equations.inverse is None:
        return Inflation(*(1.0 + each for each in excess))
    of_lengths = [(each**2).sum(0) for each in equations.length_pulls()]
    for partition in partitions:
        for k, pulls in enumerate(equations.group_pulls(*partition.sketch(_FAMILIES))):
            seen = (_squares(pulls) + of_lengths[k]).reshape(totals[k].shape)
            excess[k] = excess[k] + _pooled(seen, (totals[k] - priors[k]) / noise_factor**2, totals[k])
    return Inflation(*(np.sqrt(1.0 + each) for each in excess))


def inflated(marginals: Marginals, photos: Array, cameras: Array) -> tuple[Array, Array]:
    """Covariances of the photos' unknowns (m, nb, nb) and of the cameras' (k, k) with a larger share of the noise.

    Its part of the deviations is larger by a factor for each kind of unknown, (nb,) and (nc,).
    """
    of_cameras = np.tile(cameras, len(marginals.cameras) // max(len(cameras), 1))
    parts = zip(marginals[:2], marginals[2:], (photos, of_cameras), strict=True)
    of_photos, of_all_cameras = (prior + by[:, None] * (total - prior) * by for total, prior, by in parts)
    return of_photos, of_all_cameras


def inflated_function(
    found: Function, partitions: tuple[Partition, ...], photos: Array, noise_factor: float = 1.0
) -> tuple[float, Array]:
    """Variance of a function and its covariance with the photos (m, nb), whose factors are (nb,).

    These are of the noise that weighs the measurements, which is `noise_factor` times the independent one.
    """
    noise = found.variance - found.of_priors
    ratio = 1.0
    for partition in partitions:
        sums = np.zeros(_FAMILY * partition.num_families)
        np.add.at(sums, partition.group, found.pulls)
        seen = float(_squares(sums)) + found.of_lengths
        ratio += max(noise_factor**2 * seen / noise - 1.0, 0.0) if noise > 0 else 0.0
    own = np.sqrt(ratio) / noise_factor
    rest = found.with_photos - found.with_photos_of_priors
    return found.of_priors + own**2 * noise, found.with_photos_of_priors + own * photos * rest
