"""The unknown focal length of a camera, from pairs of its photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["USUAL_FOCAL", "FocalLength", "estimate_focal_length"]

Array = NDArray[np.float64]

#: Focal lengths of phones, drones and most other cameras over the longer side of their photos, and the standard
#: deviation of the logarithm of that.
USUAL_FOCAL = (0.85, 0.35)
# Focal lengths that are tried, over the longer side, with equal ratios.
_TRIED = np.geomspace(0.35, 3.5, 15)
# Matches of a pair that are used, and pairs that are conclusive together.
_MATCHES, _LEAST_PAIRS = 300, 3
# Distance of an outlier, in pixels of the image that the features were detected in; the noise is about one.
_OUTLIER_PX, _INLIER_PX = 3.0, 2.0
_TRIALS = 60
# Costs that are higher by this share count as equal: a plane, or a camera that hardly travelled, is fitted a little
# better by shorter focal lengths, whose essential matrices bend more.
_AS_WELL = 0.05
# Sets of pairs drawn for the standard deviation.
_DRAWS = 200
# Effect of an unknown lens and shutter on the estimate (logarithm): published focal lengths of photos with them differ
# from it by this.
_UNMODELLED = 0.05


@dataclass(frozen=True)
class FocalLength:
    """A focal length and its standard deviation.

    Attributes
    ----------
    pixels : float
        The focal length.
    sigma : float
        Relative standard deviation.
    num_pairs : int
        Pairs of photos that it is from; 0 if none is conclusive, and it is the usual one.
    """

    pixels: float
    sigma: float
    num_pairs: int


def estimate_focal_length(
    pairs: Sequence[tuple[Array, Array]], size: tuple[int, int], step_px: float = 1.0, seed: int = 0
) -> FocalLength:
    """The focal length whose relative poses fit matches best, combined with the usual one.

    For each focal length each pair gets the best essential matrix; the truncated Sampson errors of its matches, summed
    over all pairs, are smallest at the right one. Fundamental matrices of single pairs determine the focal length, too
    (Fetzer et al., WACV 2020), but each of them only weakly; a plane, or a camera that only rotated, adds about the
    same to all focal lengths. The variance is that of the estimate over sets of pairs drawn with replacement, and of
    the focal lengths that fit the matches about as well.

    Parameters
    ----------
    pairs : sequence of ((n, 2), (n, 2)) arrays
        Verified matches of photos of one camera, pixels with integer centres.
    size : (int, int)
        Width and height of its photos.
    step_px : float
        Pixels of the photos to one of those that the features were found in.
    seed : int
        Of the choice of matches and of the draws.

    Returns
    -------
    FocalLength
        Combined with `USUAL_FOCAL` by their variances.
    """
    side = float(max(size))
    usual, spread = np.log(USUAL_FOCAL[0]), USUAL_FOCAL[1]
    if len(pairs) < _LEAST_PAIRS:
        return FocalLength(float(side * np.exp(usual)), spread, 0)
    rng = np.random.default_rng(seed)
    middle = (np.array(size) - 1.0) / 2.0
    cost = np.zeros((len(pairs), len(_TRIED)))
    for k, matches in enumerate(pairs):
        few = rng.permutation(len(matches[0]))[:_MATCHES]
        first, second = (each[few] - middle for each in matches)
        cost[k] = [_cost(first, second, tried * side, step_px) for tried in _TRIED]
    found = _lowest(cost.sum(0))
    drawn = [_lowest(cost[rng.integers(0, len(cost), len(cost))].sum(0)) for _ in range(_DRAWS)]
    variance = np.var(drawn) + _indifference(cost.sum(0)) + _UNMODELLED**2
    weight = np.array([1.0 / variance, 1.0 / spread**2])
    value = float(weight @ [found, usual] / weight.sum())
    return FocalLength(float(side * np.exp(value)), float(weight.sum() ** -0.5), len(pairs))


def _cost(first: Array, second: Array, focal: float, step_px: float) -> float:
    """Truncated squares of the Sampson errors under the best essential matrix, in pixels of the features' image."""
    x1, x2 = first / focal, second / focal
    worst = _OUTLIER_PX**2
    E, _ = cv2.findEssentialMat(
        x1, x2, np.eye(3), cv2.USAC_ACCURATE, 0.99, _INLIER_PX * step_px / focal, maxIters=_TRIALS
    )
    if E is None or len(E) < 3:
        return worst * len(x1)
    rays1, rays2 = (np.column_stack([x, np.ones(len(x))]) for x in (x1, x2))
    lines2, lines1 = rays1 @ E[:3].T, rays2 @ E[:3]
    slope = (lines2[:, :2] ** 2).sum(1) + (lines1[:, :2] ** 2).sum(1)
    square = (rays2 * lines2).sum(1) ** 2 / np.maximum(slope, 1e-300) * (focal / step_px) ** 2
    return float(np.minimum(square, worst).sum())


def _lowest(cost: Array) -> float:
    """Logarithm of the focal length of the least cost, between those that were tried by a parabola."""
    k = int(np.argmin(cost))
    between = 0.0
    if 0 < k < len(cost) - 1:
        left, here, right = cost[k - 1 : k + 2]
        between = 0.5 * (left - right) / max(left - 2.0 * here + right, 1e-12)
    return float(np.log(_TRIED[k]) + between * np.log(_TRIED[1] / _TRIED[0]))


def _indifference(cost: Array) -> float:
    """Variance of the logarithms of focal lengths that are about as good as the best."""
    fine = np.linspace(np.log(_TRIED[0]), np.log(_TRIED[-1]), 50 * len(_TRIED))
    as_well = np.interp(fine, np.log(_TRIED), cost) < (1.0 + _AS_WELL) * cost.min()
    return float(np.var(fine[as_well])) if as_well.any() else 0.0
