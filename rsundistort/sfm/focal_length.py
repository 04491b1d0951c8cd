"""The unknown focal length of a camera, from pairs of its photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..model import Camera
from ..model.array_types import Array
from .relative_pose import Pair, RelativePose, View, adjusted_pose, suggested_poses

__all__ = ["USUAL_FOCAL", "FocalLength", "estimate_focal_length"]

#: Focal lengths of phones, drones and most other cameras over the longer side of their photos, and the standard
#: deviation of the logarithm of that.
USUAL_FOCAL = (0.85, 0.35)
# Focal lengths that are tried, over the longer side, with equal ratios; and more of them around the best one, in steps
# between those.
_TRIED = np.geomspace(0.35, 3.5, 15)
_FINER = np.array([-2.0, -1.0, 1.0, 2.0]) / 3.0
# Matches of a pair that are used, and pairs that are conclusive together.
_MATCHES, _LEAST_PAIRS = 300, 3
# Width of the loss of their distances, in pixels of the image that the features were detected in: their noise is about
# one, and a lens that nobody knows adds to it.
_WIDTH_PX = 3.0
# Prior standard deviation of rotations during the readout, radians a frame: those of most hands and drones. With more
# room they explain flat scenes, too, by any focal length.
_PHI_SIGMA = 0.02
# Costs that are higher by this share count as equal: a plane, or a camera that hardly travelled, is fitted a little
# better by shorter focal lengths, whose essential matrices bend more.
_AS_WELL = 0.05
# Nor does any difference count that is small for matches as exact as this, pixels of the features' image.
_EXACT_PX = 0.1
# Sets of pairs drawn for the standard deviation.
_DRAWS = 200
# Effect of an unknown lens on the estimate (logarithm): published focal lengths of photos differ from it by this.
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
    pairs: Sequence[tuple[Array, Array]], camera: Camera, step_px: float = 1.0, seed: int = 0
) -> FocalLength:
    """The focal length whose relative poses fit matches best, combined with the usual one.

    For each focal length each pair gets the best relative pose with a shutter (`find_relative_pose`); what that leaves
    of its matches, summed over all pairs, is least at the right one. Without motions during the readout, the focal
    length would make up for them. Fundamental matrices of single pairs determine it, too (Fetzer et al., WACV 2020),
    but each of them only weakly; a plane, or a camera that only rotated, adds about the same to all focal lengths. The
    variance is that of the estimate over sets of pairs drawn with replacement, and of the focal lengths that fit the
    matches about as well.

    Parameters
    ----------
    pairs : sequence of ((n, 2), (n, 2)) arrays
        Verified matches of photos of one camera, pixels with integer centres.
    camera : Camera
        The size of its photos and how they are read; its focal length does not matter.
    step_px : float
        Pixels of the photos to one of those that the features were found in.
    """
    side = float(max(camera.width, camera.height))
    usual, spread = float(np.log(USUAL_FOCAL[0])), USUAL_FOCAL[1]
    rng = np.random.default_rng(seed)

    def with_focal(log_ratio: float) -> Camera:
        """Of the features' image, so that the noise is a pixel of it."""
        size = np.array([camera.width, camera.height]) / step_px
        (cx, cy), f = 0.5 * (size - 1.0), np.exp(log_ratio) * side / step_px
        K = np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
        width, height = np.ceil(size).astype(int).tolist()
        return Camera(width, height, K, readout=camera.readout)

    shown, starts = [], []
    for matches in pairs:
        few = rng.permutation(len(matches[0]))[:_MATCHES]
        first, second = ((each[few] + 0.5) / step_px - 0.5 for each in matches)
        suggested = suggested_poses(_pair((first, second), with_focal(usual)))
        if suggested:
            shown.append((first, second))
            starts.append(suggested)
    if len(shown) < _LEAST_PAIRS:
        return FocalLength(side * USUAL_FOCAL[0], spread, 0)
    log_f = np.log(_TRIED)
    cameras, begin = [with_focal(each) for each in log_f], int(np.argmin(np.abs(log_f - usual)))
    rough = [_fits(*each, cameras, begin) for each in zip(shown, starts, strict=True)]
    best = int(np.argmin(_costs(rough).sum(0)))
    finer = np.sort(np.append(log_f, log_f[best] + (log_f[1] - log_f[0]) * _FINER))
    cameras, begin = [with_focal(each) for each in finer], int(np.argmin(np.abs(finer - log_f[best])))
    cost = _costs([_fits(xy, [poses[best]], cameras, begin) for xy, poses in zip(shown, rough, strict=True)])
    found = _lowest(finer, cost.sum(0))
    drawn = [_lowest(finer, cost[rng.integers(0, len(cost), len(cost))].sum(0)) for _ in range(_DRAWS)]
    exact = _EXACT_PX**2 * sum(len(first) for first, _ in shown)
    variance = np.var(drawn) + _indifference(finer, cost.sum(0), exact) + _UNMODELLED**2
    weight = np.array([1.0 / variance, 1.0 / spread**2])
    value = float(weight @ [found, usual] / weight.sum())
    return FocalLength(float(side * np.exp(value)), float(weight.sum() ** -0.5), len(shown))


def _pair(matches: tuple[Array, Array], camera: Camera) -> Pair:
    return Pair(*(View.of(xy, camera) for xy in matches))


def _fits(
    matches: tuple[Array, Array], starts: Sequence[RelativePose], cameras: Sequence[Camera], begin: int
) -> list[RelativePose]:
    """The pose of a pair by each of the cameras: by one of them from the starts, by each other from its neighbour's."""
    pairs = [_pair(matches, camera) for camera in cameras]

    def fit(start: RelativePose, k: int) -> RelativePose:
        return adjusted_pose(start, pairs[k], _PHI_SIGMA, _WIDTH_PX)

    found = {begin: min((fit(start, begin) for start in starts), key=lambda each: each.cost)}
    for k in range(begin + 1, len(pairs)):
        found[k] = fit(found[k - 1], k)
    for k in reversed(range(begin)):
        found[k] = fit(found[k + 1], k)
    return [found[k] for k in range(len(pairs))]


def _costs(poses: Sequence[Sequence[RelativePose]]) -> Array:
    """(pairs, focal lengths) costs."""
    return np.array([[each.cost for each in of_pair] for of_pair in poses])


def _lowest(log_f: Array, cost: Array) -> float:
    """Logarithm of the focal length of the least cost, between those that were tried by a parabola."""
    k = int(np.argmin(cost))
    if not 0 < k < len(cost) - 1:
        return float(log_f[k])
    square, slope, _ = np.polyfit(log_f[k - 1 : k + 2] - log_f[k], cost[k - 1 : k + 2], 2)
    return float(log_f[k] - (slope / (2.0 * square) if square > 0.0 else 0.0))


def _indifference(log_f: Array, cost: Array, exact: float) -> float:
    """Variance of the logarithms of focal lengths that are about as good as the best, which costs `exact` at least."""
    fine = np.linspace(log_f[0], log_f[-1], 50 * len(log_f))
    as_well = np.interp(fine, log_f, cost) < cost.min() + _AS_WELL * max(cost.min(), exact)
    return float(np.var(fine[as_well]))
