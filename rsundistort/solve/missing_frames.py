"""Frames that are missing between others of a video, by how far its camera travels and rotates there.

Two things predict how far it moves from one frame to the next, if so many steps of time lie between them: how far it
travels before and after, and how the lines of both frames rotate. A hand trembles too fast for its rotations before and
after to say anything; those of the lines are measured where the interval begins and ends.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import entr

from ..bundle.own_motions import OwnMotions
from ..bundle.path_prior import FramePath
from ..errors import RsUndistortWarning
from ..input.key_frames import Clip
from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask

__all__ = ["Gaps", "frames_missing", "gaps_between", "tell_of_gaps", "told_by", "with_gaps"]


# Frames that may be missing between two others; intervals that say what is usual.
_MOST, _FEWEST = 3, 12
# How much likelier, as a logarithm, missing frames must be than jerks of the hand.
_CLEAR = 3.0
# Degrees of freedom of changes from interval to interval (Student's t): hands jerk, and frames are placed wrongly.
_DEGREES = 4.0
# Minus the logarithm of how likely a knock is that moves the camera anywhere within an interval, for each size of the
# usual changes: one in a thousand intervals has one, over some ten sizes along each axis.
_KNOCK = 15.0
# Rounds in which most changes may be of missing frames and their neighbours, so that the smallest tell what is usual;
# and all rounds. Gaps that are tried in each.
_FIRST, _ROUNDS, _MOST_GAPS = 8, 12, 200
# Quantiles of squares of normal variables.
_TENTH, _MEDIAN = 0.0158, 0.455
# Frame rates that videos are converted between, those of NTSC among them, the share by which files and cameras miss
# them, the largest ratio of two, and how far from a whole number it is: frames of a whole ratio are evenly spaced, and
# those of a large one almost.
_RATES = np.array([10, 12, 12.5, 15, 20, 24, 25, 30, 48, 50, 60, 90, 100, 120, 240])
_NTSC = np.array([24, 30, 48, 60, 120, 240]) * (1000 / 1001)
_SAME_RATE, _LARGEST_RATIO, _NOT_WHOLE = 2e-3, 2.9, 0.01
# Frames of a conversion are evenly spaced in the file, but for its rounding of times: share of a step.
_ROUNDED = 0.05
# Powers of the steps with which the variance grows of what the lines of both frames do not say of rotations.
_GROWTH = 2.0, 6.0
# Phases of a conversion that are tried, and steps to the usual size of its changes.
_PHASES, _SCALE_STEPS = 120, 8
# Intervals of all hypotheses at once, for the memory.
_AT_ONCE = 200_000


class Gaps(NamedTuple):
    """Frames that are missing.

    Attributes
    ----------
    missing : (n - 1,) int array
        How many between consecutive frames of a video, beyond what their times say.
    ratio : float or None
        The frame rate of the camera by that of the video, if that was converted. It lasts as long as before.
    """

    missing: Index
    ratio: float | None


def with_gaps(clip: Clip, path: FramePath, rec: Reconstruction, own: OwnMotions) -> tuple[Clip, FramePath]:
    """A clip and its path with the times of its frames where others are missing between them.

    Times of the file do not show it. `own` are the motions of the photos of a reconstruction.
    """
    place = clip.places(rec.image_names)
    steps = np.diff(clip.time_s[place]) / clip.frame_s
    joined = np.diff(clip.part[place]) == 0
    of_all, ratio = gaps_between(own, place, steps, joined, len(clip.names), 1 / clip.frame_s)
    if not of_all.any():
        return clip, path
    # the video lasts as long as before
    clip = clip.with_gaps(of_all, clip.frame_s if ratio is None else clip.frame_s / ratio)
    of_path = dict(zip(clip.names, clip.time_s.tolist(), strict=True))
    return clip, replace(path, time_s=of_path, frame_s=clip.frame_s)


def tell_of_gaps(clip: Clip, corrected: Clip) -> None:
    """Warn of missing frames, if the times of a clip were corrected for them."""
    before, after = (np.diff(each.time_s) / each.frame_s for each in (clip, corrected))
    missing = np.where(np.diff(clip.part) == 0, np.rint(after - before), 0).astype(np.int64)
    if not missing.any():
        return
    first = clip.names[int(np.flatnonzero(missing)[0])]
    is_converted = corrected.frame_s != clip.frame_s
    how = f", as if it was converted from {1 / corrected.frame_s:.3g} frames a second" if is_converted else ""
    warnings.warn(
        f"{missing.sum()} frames are missing between those of {clip.video.name}, the first after {first}{how}: the "
        "camera moves farther there than before and after; the times were corrected",
        RsUndistortWarning, stacklevel=5,
    )  # fmt: skip


class _Intervals(NamedTuple):
    """How far the camera moves between consecutive frames, in one respect.

    Attributes
    ----------
    way : (m - 1, d) array
        How far; NaN where unknown.
    usual : function of (..., m - 1) steps of time
        What is expected (..., m - 1, d) for each step, if so many lie between the frames; NaN where nothing is.
    more : function of steps
        How much larger the variance of what differs from that is over so many steps.
    counts : float
        How many intervals each is as good as, which says partly the same as its neighbours.
    """

    way: Array
    usual: Callable[[Array], Array]
    more: Callable[[Array], Array]
    counts: float

    @property
    def num_known(self) -> int:
        """Number of intervals of which the way is known."""
        return int(np.isfinite(self.way).all(axis=1).sum())


def _travels(own: OwnMotions, joined: Mask) -> _Intervals | None:
    """Ways between positions, as those before and after; None if few are known."""
    way = np.where(joined[:, None], np.diff(own.center_w, axis=0), np.nan)
    way = way[:, np.nansum(np.abs(way), axis=0) > 0]
    if not way.size or np.isfinite(way).all(axis=1).sum() < _FEWEST:
        return None
    return _Intervals(
        way,
        lambda steps: _of_neighbours(way / steps[..., None]),
        lambda steps: (1 + 0.5 * steps**2) / 1.5,  # neighbours' rates count for each step
        0.5,  # each interval is the neighbour of two others
    )


def _rotations(own: OwnMotions, joined: Mask) -> _Intervals | None:
    """Rotations between frames, as those of the lines of both, times the steps; None if few are known."""
    (way, lines), (two, of_ends) = _rotated(own, 1), _rotated(own, 2)
    way[~joined], two[~(joined[1:] & joined[:-1])] = np.nan, np.nan
    known = np.isfinite(way).all(axis=1)
    square = np.where(known, (lines**2).sum(axis=1), 0.0)
    if known.sum() < _FEWEST or not square.any() or np.isnan(two).any(axis=1).all():
        return None
    share = np.divide(np.where(known, (way * lines).sum(axis=1), 0.0), square, out=np.zeros(len(way)), where=square > 0)
    # over two steps, by frames that are there: the mean of both ends misses 64 times as much of a slow rotation's
    # variance there as over one, and four times as much of a fast one's
    by = _weighted_median(share, square)
    once, twice = (np.nanmedian(((a - n * by * b) ** 2).sum(1)) for a, b, n in ((way, lines, 1), (two, of_ends, 2)))
    power = float(np.clip(np.log2(twice / once), *_GROWTH)) if once > 0 else _GROWTH[0]

    def usual(steps: Array) -> Array:
        by = _weighted_median(share / steps, square * steps ** (2 - power))
        return by[..., None, None] * lines

    return _Intervals(way, usual, lambda steps: steps**power, 1.0)


def _rotated(own: OwnMotions, apart: int) -> tuple[Array, Array]:
    """(m - n, 3) rotations between frames that are n apart, NaN where unknown, and the mean of those of their lines."""
    between = own.R_cw[apart:] @ own.R_cw[:-apart].transpose(0, 2, 1)
    lines = 0.5 * (own.phi[apart:] + own.phi[:-apart])
    known = np.isfinite(between).all(axis=(1, 2)) & np.isfinite(lines).all(axis=1)
    way = np.full(lines.shape, np.nan)
    way[known] = Rotation.from_matrix(between[known]).as_rotvec()
    return way, lines


def _weighted_median(values: Array, weights: Array) -> Array:
    """(...) medians of values (..., n) by weights (..., n)."""
    order = np.argsort(values, axis=-1)
    passed = np.cumsum(np.take_along_axis(weights, order, axis=-1), axis=-1)
    middle = np.argmax(passed >= 0.5 * passed[..., -1:], axis=-1)[..., None]
    return np.take_along_axis(values, np.take_along_axis(order, middle, axis=-1), axis=-1)[..., 0]


def told_by(own: OwnMotions, joined: Mask) -> list[_Intervals]:
    """All that tells of missing frames."""
    return [each for each in (_travels(own, joined), _rotations(own, joined)) if each is not None]


def gaps_between(own: OwnMotions, place: Index, steps: Array, joined: Mask, num_frames: int, rate: float) -> Gaps:
    """Frames that are missing here and there, or regularly since the video was converted from a higher frame rate.

    A conversion is one hypothesis about all intervals, so that it is seen where hands shake too much for single gaps.

    Parameters
    ----------
    own : OwnMotions
        Of frames of the video, in their order.
    place : (m,) int array
        Which frames of the video these are.
    steps : (m - 1,) array
        Times between them by the file, in times between frames.
    joined : (m - 1,) bool array
        Whether both are of one part.
    rate : float
        Its frame rate, 1/s.
    """
    told = told_by(own, joined)
    single = frames_missing(told, steps)
    of_all = np.zeros(max(num_frames - 1, 0), np.int64)
    of_all[place[:-1]] = single
    between = np.diff(place)
    if not told or not np.allclose(steps[joined], between[joined], atol=_ROUNDED):
        return Gaps(of_all, None)
    patterns, ratios, cost_of_conversions = _conversions(num_frames, rate)
    passed = np.concatenate([np.zeros((len(patterns), 1), np.int64), np.cumsum(patterns, axis=1)], axis=1)
    of_conversions = passed[:, place[1:]] - passed[:, place[:-1]]
    hypotheses = between + np.vstack([np.zeros_like(single), single, of_conversions])
    cost = _cost(told, hypotheses)
    cost[1] += _cost_of_gaps(int(np.count_nonzero(single)), max(each.num_known for each in told))
    cost[2:] += cost_of_conversions
    best = int(np.argmin(cost))
    if best < 2:
        return Gaps(of_all, None)
    return Gaps(patterns[best - 2], float(ratios[best - 2]))


def _conversions(num_frames: int, rate: float) -> tuple[Index, Array, Array]:
    """(h, n - 1) missing frames of all conversions to a rate, (h,) ratios of the rates, and what each costs.

    The frames of a conversion are those nearest to multiples of the ratio. Those between a rate of NTSC and another
    one slip by a frame now and then, which takes evidence.
    """
    low, ntsc = _RATES[_is_near(_RATES, rate)], _NTSC[_is_near(_NTSC, rate)]
    even, slipping = np.outer(_RATES, 1 / low), (np.outer(_NTSC, 1 / low), np.outer(_RATES, 1 / ntsc))
    ratios: Array = np.concatenate([each.ravel() for each in (even, *slipping)])
    cost = np.where(np.arange(len(ratios)) < even.size, 0.0, _CLEAR)
    whole = np.abs(ratios - np.round(ratios)) < _NOT_WHOLE
    possible = np.flatnonzero((ratios > 1) & (ratios < _LARGEST_RATIO) & ~whole)
    ratios, cost = ratios[possible], cost[possible]
    phases = (np.arange(_PHASES) + 0.5) / _PHASES
    place = np.floor(np.arange(num_frames) * ratios[:, None, None] + phases[:, None])
    missing = np.diff(place, axis=2).astype(np.int64).reshape(-1, num_frames - 1) - 1
    first = np.sort(np.unique(missing, axis=0, return_index=True)[1])
    cost = np.repeat(cost, _PHASES)[first] + np.log(max(len(first), 1)) + _CLEAR
    return missing[first], np.repeat(ratios, _PHASES)[first], cost


def _is_near(rates: Array, rate: float) -> Mask:
    return np.abs(rates / rate - 1) < _SAME_RATE


def _cost_of_all(intervals: _Intervals, steps: Array) -> Array:
    """(h,) minus log likelihoods of all changes under (h, m - 1) numbers of steps, whose usual size each estimates."""
    left = intervals.way - steps[..., None] * intervals.usual(steps)
    known = np.isfinite(left[..., 0])
    left, count = np.where(known[..., None], left, 0.0), known.sum(axis=1)
    more, d = intervals.more(steps), left.shape[-1]
    even = left**2 / more[..., None]
    variance = np.maximum(even.sum(axis=1) / count[:, None], 1e-18)
    for _ in range(_SCALE_STEPS):
        squares = (even / variance[:, None]).sum(axis=2)
        weight = known * (_DEGREES + d) / (_DEGREES + squares)
        variance = np.maximum((weight[..., None] * even).sum(axis=1) / count[:, None], 1e-18)
    squares = (even / variance[:, None]).sum(axis=2)
    return _student(squares, more, d).sum(axis=1, where=known) + 0.5 * count * np.log(variance).sum(axis=1)


def frames_missing(told: Sequence[_Intervals], steps: Array) -> Index:
    """(m - 1,) frames that are missing between consecutive ones, beyond what their times say; 0 if one gap at most is.

    Where frames are missing but their times do not show it, the camera moves a multiple of what is usual. A jerk of the
    hand moves it elsewhere. Each hypothesis is weighed by the usual changes from interval to interval. It is the
    likeliest set of gaps, the likeliest ones first: each that is explained shows more clearly what is usual.
    """
    found = np.zeros(len(steps), np.int64)
    if not told:
        return found
    valid = max(each.num_known for each in told)
    for k in range(_ROUNDS):
        quantile, normal = (0.1, _TENTH) if k < _FIRST else (0.5, _MEDIAN)
        gains = sum(_gains(each, steps, found, quantile, normal) for each in told)
        best, gain = 1 + np.argmax(gains, axis=0), np.max(gains, axis=0)
        order = np.argsort(-gain)[: min(int((gain > 0).sum()), valid // 2, _MOST_GAPS)]
        sets = np.zeros((len(order) + 1, len(steps)), np.int64)
        for n, each in enumerate(order):
            sets[n + 1 :, each] = best[each]
        cost = _cost(told, steps + sets) + [_cost_of_gaps(n, valid) for n in range(len(sets))]
        before, found = found, sets[np.argmin(cost)]
        if k >= _FIRST and (found == before).all():
            break
    return found if (found > 0).sum() > 1 else np.zeros_like(found)


def _cost(told: Sequence[_Intervals], steps: Array) -> Array:
    """(h,) minus log likelihoods of (h, m - 1) numbers of steps."""
    blocks = np.array_split(steps.astype(np.float64), 1 + steps.size // _AT_ONCE)
    return np.concatenate(
        [np.sum([each.counts * _cost_of_all(each, block) for each in told], axis=0) for block in blocks]
    )


def _cost_of_gaps(count: int, valid: int) -> float:
    """What it takes to say how many of the intervals have gaps, and which."""
    share = count / valid
    return np.log(valid) + valid * (entr(share) + entr(1 - share)) + _CLEAR if count else 0.0


def _gains(intervals: _Intervals, steps: Array, found: Index, quantile: float, normal: float) -> Array:
    """(_MOST, m - 1) logarithms of how much likelier each interval is with missing frames than with none."""
    usual = intervals.usual(steps + found)
    rate = intervals.way / (steps + found)[:, None]
    variance = np.maximum(np.nanquantile((rate - usual) ** 2, quantile, axis=0) / normal, 1e-18)
    costs = []
    for missing in range(_MOST + 1):
        left = intervals.way - (steps + missing)[:, None] * usual
        more = intervals.more(np.array(1.0 + missing))
        costs.append(_student((left**2 / variance).sum(axis=1) / more, more, left.shape[1]))
    return np.nan_to_num(costs[0] - np.array(costs[1:]))


def _of_neighbours(rate: Array) -> Array:
    """(..., m - 1, d) mean rates of the intervals before and after; NaN where both are unknown."""
    padded = np.pad(rate, [(0, 0)] * (rate.ndim - 2) + [(1, 1), (0, 0)], constant_values=np.nan)
    both = np.stack([padded[..., :-2, :], padded[..., 2:, :]])
    known = np.isfinite(both).sum(axis=0)
    return np.nan_to_num(both).sum(axis=0) / np.where(known > 0, known, np.nan)


def _student(squares: Array, more: Array, d: int) -> Array:
    """Minus log likelihood of squares of d deviations whose variances are so much larger.

    Of Student's t, or of a knock, which may be of any size.
    """
    usual = 0.5 * (_DEGREES + d) * np.log1p(squares / _DEGREES) + 0.5 * d * np.log(more)
    return -np.log(np.exp(-usual) + np.exp(-_KNOCK))
