"""Frames that are missing between others of a video, by how far its camera travels there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import entr

__all__ = ["Gaps", "frames_missing", "gaps_between"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Frames that may be missing between two others; intervals that say what is usual.
_MOST, _FEWEST = 3, 12
# How much likelier, as a logarithm, missing frames must be than a jerk of the hand, beyond all intervals there are;
# where at least two are, frames are missing, and that others are is as likely as they are frequent.
_CLEAR, _LIKELY = 3.0, 1.5
# Degrees of freedom of changes from interval to interval (Student's t): hands jerk, and frames are placed wrongly.
_DEGREES = 4.0
# Rounds in which most changes may be of missing frames and of their neighbours, so that the smallest tell what is usual
# and any that may be missing are tried; and all rounds. The last ones, with the usual changes that are left, decide.
_FIRST, _FIRST_LEAST, _ROUNDS = 8, 3.7, 12
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
# Phases of a conversion that are tried, and steps to the usual size of its changes.
_PHASES, _SCALE_STEPS = 120, 8
# Intervals of all hypotheses at once, for the memory.
_AT_ONCE = 200_000
# Changes that share intervals say partly the same: each interval is the neighbour of two others.
_COUNTED_ONCE = 0.5


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


def gaps_between(
    center_w: Array, place: Index, steps: Array, joined: NDArray[np.bool_], num_frames: int, rate: float
) -> Gaps:
    """Frames that are missing here and there, or regularly since the video was converted from a higher frame rate.

    A conversion is one hypothesis about all intervals, so that it is seen where hands shake too much for single gaps.

    Parameters
    ----------
    center_w : (m, 3) array
        Positions, each of its own measurements; NaN where unknown.
    place : (m,) int array
        Which frames of the video these are.
    steps : (m - 1,) array
        Times between them by the file, in times between frames.
    joined : (m - 1,) bool array
        Whether both are of one part.
    num_frames : int
        Number of frames of the video.
    rate : float
        Its frame rate, 1/s.
    """
    single = frames_missing(center_w, steps, joined)
    of_all = np.zeros(max(num_frames - 1, 0), np.int64)
    of_all[place[:-1]] = single
    way = np.where(joined[:, None], np.diff(center_w, axis=0), np.nan)
    valid = int(np.isfinite(way).all(axis=1).sum())
    way = way[:, np.nansum(np.abs(way), axis=0) > 0]
    between = np.diff(place)
    if valid < _FEWEST or not way.size or not np.allclose(steps[joined], between[joined], atol=_ROUNDED):
        return Gaps(of_all, None)
    patterns, ratios, cost_of_conversions = _conversions(num_frames, rate)
    passed = np.concatenate([np.zeros((len(patterns), 1), np.int64), np.cumsum(patterns, axis=1)], axis=1)
    of_conversions = passed[:, place[1:]] - passed[:, place[:-1]]
    hypotheses = between + np.vstack([np.zeros_like(single), single, of_conversions])
    blocks = np.array_split(hypotheses.astype(np.float64), 1 + hypotheses.size // _AT_ONCE)
    cost = _COUNTED_ONCE * np.concatenate([_cost_of_all(way, block) for block in blocks])
    # what it takes to say which intervals have gaps, and which conversion it is
    share = np.count_nonzero(single) / valid
    cost[1] += np.log(valid) + valid * (entr(share) + entr(1 - share))
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


def _is_near(rates: Array, rate: float) -> NDArray[np.bool_]:
    near: NDArray[np.bool_] = np.abs(rates / rate - 1) < _SAME_RATE
    return near


def _cost_of_all(way: Array, steps: Array) -> Array:
    """(h,) minus log likelihoods of all changes under (h, m - 1) numbers of steps, whose usual size each estimates."""
    rate = way / steps[..., None]
    left = way - steps[..., None] * _of_neighbours(rate)
    known = np.isfinite(left[..., 0])
    left, count = np.where(known[..., None], left, 0.0), known.sum(axis=1)
    more, d = _more(steps), way.shape[1]
    even = left**2 / more[..., None]
    variance = np.maximum(even.sum(axis=1) / count[:, None], 1e-18)
    for _ in range(_SCALE_STEPS):
        squares = (even / variance[:, None]).sum(axis=2)
        weight = known * (_DEGREES + d) / (_DEGREES + squares)
        variance = np.maximum((weight[..., None] * even).sum(axis=1) / count[:, None], 1e-18)
    squares = (even / variance[:, None]).sum(axis=2)
    cost: Array = _student(squares, more, d).sum(axis=1, where=known) + 0.5 * count * np.log(variance).sum(axis=1)
    return cost


def frames_missing(center_w: Array, steps: Array, joined: NDArray[np.bool_]) -> Index:
    """Number of frames that are missing in each interval between consecutive ones, beyond what their times say.

    Where frames are missing but their times do not show it, the camera travels a multiple of what it does before and
    after. A jerk of the hand moves it elsewhere. Each hypothesis is weighed by the usual changes from interval to
    interval. Rotations do not count: hands tremble too fast.

    Parameters
    ----------
    center_w, steps, joined
        As for `gaps_between`.

    Returns
    -------
    (m - 1,) int array
        All 0 if fewer than two intervals are clear.
    """
    m = len(center_w)
    found = np.zeros(max(m - 1, 0), np.int64)
    way = np.where(joined[:, None], np.diff(center_w, axis=0), np.nan)
    valid = np.flatnonzero(np.isfinite(way[:, 0]))
    way = way[:, np.nansum(np.abs(way), axis=0) > 0]
    if len(valid) < _FEWEST or not way.size:
        return found
    clear = np.log(len(valid)) + _CLEAR
    for k in range(_ROUNDS):
        rate = way / (steps + found)[:, None]
        usual = _of_neighbours(rate)
        quantile, normal = (0.1, _TENTH) if k < _FIRST else (0.5, _MEDIAN)
        variance = np.maximum(np.nanquantile((rate - usual) ** 2, quantile, axis=0) / normal, 1e-18)
        costs = np.array([
            _minus_log_likelihood(way - (steps + missing)[:, None] * usual, variance, missing)
            for missing in range(_MOST + 1)
        ])  # fmt: skip
        gains = np.nan_to_num(costs[0] - costs[1:])
        best, gain = 1 + np.argmax(gains, axis=0), gains.max(axis=0)
        if k < _FIRST:
            least = _FIRST_LEAST
        elif (certain := int((gain > clear).sum())) < 2:
            least = clear
        else:
            share = min(certain / len(valid), 0.5)
            least = np.log((1 - share) / share) + _LIKELY
        found = np.where(gain > least, best, 0)
    return found if (found > 0).sum() > 1 else np.zeros_like(found)


def _of_neighbours(rate: Array) -> Array:
    """(..., m - 1, d) mean rates of the intervals before and after; NaN where both are unknown."""
    padded = np.pad(rate, [(0, 0)] * (rate.ndim - 2) + [(1, 1), (0, 0)], constant_values=np.nan)
    both = np.stack([padded[..., :-2, :], padded[..., 2:, :]])
    known = np.isfinite(both).sum(axis=0)
    mean: Array = np.nan_to_num(both).sum(axis=0) / np.where(known > 0, known, np.nan)
    return mean


def _minus_log_likelihood(left: Array, variance: Array, missing: int) -> Array:
    """Of what is left (m - 1, d) of a way if frames are missing: the rate of its neighbours counts for each of them."""
    more = _more(np.array(1.0 + missing))
    return _student((left**2 / variance).sum(axis=1) / more, more, left.shape[1])


def _more(steps: Array) -> Array:
    """How much larger the variance of a change is over so many steps: neighbours' rates count for each."""
    more: Array = (1 + 0.5 * steps**2) / 1.5
    return more


def _student(squares: Array, more: Array, d: int) -> Array:
    """Minus log likelihood of squares of d deviations whose variances are so much larger (Student's t)."""
    value: Array = 0.5 * (_DEGREES + d) * np.log1p(squares / _DEGREES) + 0.5 * d * np.log(more)
    return value
