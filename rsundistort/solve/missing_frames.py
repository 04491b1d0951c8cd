"""Frames that are missing between others of a video, by how far its camera travels there."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

__all__ = ["frames_missing", "regular_gaps"]

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
# Frame rates that videos are converted between: a few gaps fit some ratio or other.
_RATES = (15, 24, 25, 30, 48, 50, 60)
_RATIOS = sorted({Fraction(high, low) for high in _RATES for low in _RATES if low < high < 2 * low})
# Gaps of a conversion that must be seen, the share of all its gaps, and the share of those seen that it explains.
_LEAST_SEEN, _SEEN, _EXPLAINED = 3, 0.5, 0.85


def frames_missing(center_w: Array, steps: Array, joined: NDArray[np.bool_]) -> Index:
    """Number of frames that are missing in each interval between consecutive ones, beyond what their times say.

    Where frames are missing but their times do not show it, the camera travels a multiple of what it does before and
    after. A jerk of the hand moves it elsewhere. Each hypothesis is weighed by the usual changes from interval to
    interval. Rotations do not count: hands tremble too fast.

    Parameters
    ----------
    center_w : (m, 3) array
        Positions, each of its own measurements; NaN where unknown.
    steps : (m - 1,) array
        Times between them by the file, in times between frames.
    joined : (m - 1,) bool array
        Whether both are of one part.

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
    """(m - 1, d) mean rates of the intervals before and after; NaN where both are unknown."""
    padded = np.pad(rate, ((1, 1), (0, 0)), constant_values=np.nan)
    both = np.stack([padded[:-2], padded[2:]])
    known = np.isfinite(both).sum(axis=0)
    mean: Array = np.nan_to_num(both).sum(axis=0) / np.where(known > 0, known, np.nan)
    return mean


def _minus_log_likelihood(left: Array, variance: Array, missing: int) -> Array:
    """Of what is left (m - 1, d) of a way if frames are missing: the rate of its neighbours counts for each of them."""
    more = (1 + 0.5 * (1 + missing) ** 2) / 1.5
    squares = (left**2 / variance).sum(axis=1) / more
    d = left.shape[1]
    value: Array = 0.5 * (_DEGREES + d) * np.log1p(squares / _DEGREES) + 0.5 * d * np.log(more)
    return value


def regular_gaps(missing: Index) -> tuple[Index, float] | None:
    """All gaps of a conversion to a lower frame rate, and the ratio of both rates; None if it was none.

    `missing` (n,) is of all intervals of a video. Of a conversion, frames are those nearest to multiples of the ratio.
    """
    seen, n = np.flatnonzero(missing == 1), len(missing)
    best: tuple[int, Index, float] | None = None
    for ratio in _RATIOS:
        share = ratio - 1
        for phase in range(share.denominator):
            place = (np.arange(n + 1) * share.numerator + phase) // share.denominator
            gaps = np.diff(place).astype(np.int64)
            hits, total = int(gaps[seen].sum()), int(gaps.sum())
            enough = max(_LEAST_SEEN, _SEEN * total, _EXPLAINED * (missing > 0).sum())
            if hits >= enough and (best is None or hits - total > best[0]):
                best = hits - total, gaps, float(ratio)
    return None if best is None else best[1:]
