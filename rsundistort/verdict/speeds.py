"""The readout time by slow and by fast rotations: they differ where a camera vibrates faster than its frames show."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import KroghInterpolator
from scipy.spatial.transform import Rotation

from ..model.array_types import Array, Index, Mask

__all__ = ["BySpeed", "ReadoutTime", "readouts_by_speed"]


# Fewer frames than this have no spectrum to speak of.
_FEWEST = 24
# Frames that may be missing between two for both to be of one run, the share of a run's frames that may be, and how far
# from a whole number of steps a frame may be.
_MOST_MISSING, _MOST_FILLED, _UNEVEN = 3, 0.5, 0.25
# Frames on each side that say where the camera was at one that is missing.
_BESIDE = 2
# Another readout time, by the one that is thought, which shows how much what is asked for hangs on it.
_MORE = 1.1
# Periods in a part that a rotation has at least: slower ones are what lens and scene leave, and the window's edge.
_LEAST_PERIODS = 2
# A Hann window spreads each rotation over three frequencies: what is left of neighbours goes together.
_TOGETHER = 1.5
# Share of the power of frames' rotations that lines have at least, if the camera rotated so: all of it.
_IN_LINES = 0.5
# Standard deviations of the noise's power beyond which lines show what frames do not.
_BEYOND = 3.0


class ReadoutTime(NamedTuple):
    """Time of the readout of a frame in seconds, and its standard deviation."""

    seconds: float
    sigma: float


class BySpeed(NamedTuple):
    """What slow and fast rotations of frames and of their lines say.

    Attributes
    ----------
    slow, fast : ReadoutTime or None
        The readout times by them; None if that kind of rotation is lost in the noise. That of fast ones is none, too,
        if frames show them, and lines do not.
    unfollowed : float
        Share of the power of the lines' rotations that is not in those of the frames at the readout time by slow ones,
        significantly beyond the noise of both: 0 if they agree, 1 or more if they have nothing to do with each other.
    unfollowed_rad : float
        The same as a rotation: root mean square over the frames.
    """

    slow: ReadoutTime | None
    fast: ReadoutTime | None
    unfollowed: float
    unfollowed_rad: float = 0.0


class _Run(NamedTuple):
    """Frames in a row: times (m,), rotations (m, 3) since the first and during the readout, their standard errors."""

    time_s: Array
    rotated: Array
    rotation_sigma: Array
    phi: Array
    phi_sigma: Array


def readouts_by_speed(
    time_s: Array, part: Index, R_cw: Array, rotation_sigma: Array, phi: Array, phi_sigma: Array,
    readout_s: float, *, fills: bool = True,
) -> BySpeed | None:  # fmt: skip
    """The readout time by rotations slower and faster than a quarter of the frame rate.

    The lines of a frame rotate by the readout time times the rate of the frames. A rotation faster than half of the
    frame rate F shows in the frames as one of F less its frequency that runs the other way, whose rate has the other
    sign: then fast rotations ask for another readout time than slow ones, most likely for a negative one. Both spectra
    are compared, so that rates need no differences of frames, which would miss fast ones.

    Where frames are missing, those beside them say where the camera was, and how fast it rotated if the readout took as
    long as is thought. That readout time is the one which all frames then ask for.

    Parameters
    ----------
    time_s, part : (m,) array
        When the middle lines of the frames were read, and the parts that cuts separate.
    R_cw, rotation_sigma : (m, 3, 3), (m, 3) array
        Rotations of the frames, each found from its own measurements, and their standard deviations; NaN where unknown.
    phi, phi_sigma : (m, 3) array
        Likewise rotations during the readout, radians per frame.
    readout_s : float
        The readout time that was found: lines average over it.
    fills : bool
        Whether frames that are missing may be filled in; they need rotations that are known to some percent.

    Returns
    -------
    BySpeed or None
        None if there are too few frames.
    """
    known = np.isfinite(np.hstack([R_cw.reshape(-1, 9), phi, phi_sigma])).all(axis=1)
    time_s, part, R_cw = time_s[known], part[known], R_cw[known]
    step_s = float(np.median(np.diff(time_s))) if len(time_s) > 1 else 0.0
    runs = [
        _Run(time_s[mine], _rotated(R_cw[mine]), rotation_sigma[known][mine], phi[known][mine], phi_sigma[known][mine])
        for mine in _in_a_row(time_s, part, step_s, fills)
    ]
    if not runs:
        return None
    found = _compared(runs, readout_s, step_s)
    num = sum(int(_places(run, step_s)[-1]) + 1 for run in runs)
    num_filled = num - sum(len(run.time_s) for run in runs)
    if not num_filled or found.slow is None:
        return found
    # errors of those that are filled in are in all frequencies, but no more independent than they are themselves
    wider = max(1.0, np.sqrt(0.5 * num / num_filled))
    # what is asked for grows by a share of what is thought: where both are one, less that share of the evidence counts
    more = _compared(runs, _MORE * readout_s, step_s)
    kinds = []
    for about, further in ((found.slow, more.slow), (found.fast, more.fast)):
        share = np.inf if about is None or further is None else (further[0] - about[0]) / ((_MORE - 1) * readout_s)
        at = None if about is None or not share < 1 else (about[0] - share * readout_s) / (1 - share)
        kinds.append((at, max(share, 0.0)))
    (slow_s, of_slow), (fast_s, of_fast) = kinds
    if slow_s is None:
        return BySpeed(None, None, found.unfollowed, found.unfollowed_rad)
    there = _compared(runs, slow_s, step_s)
    slow, fast = (
        None if at is None or each is None else ReadoutTime(at, wider * each.sigma / (1 - share))
        for at, each, share in ((slow_s, there.slow, of_slow), (fast_s, there.fast, of_fast))
    )
    return BySpeed(slow, fast, there.unfollowed, there.unfollowed_rad)


def _in_a_row(time_s: Array, part: Index, step_s: float, fills: bool) -> list[Index]:
    """Which frames are evenly spaced, but for some that are missing if they can be filled in; of runs long enough."""
    apart = np.diff(time_s) / step_s if step_s > 0 else np.zeros(0)
    missing = np.rint(apart) - 1
    parted = (missing > (_MOST_MISSING if fills else 0)) | (np.abs(apart - missing - 1) > _UNEVEN)
    run = np.concatenate([[0], np.cumsum(parted | (np.diff(part) != 0))]) if len(time_s) else np.zeros(0)
    rows = [np.flatnonzero(run == each) for each in np.unique(run)]
    filled = [missing[mine[:-1]].sum() if len(mine) > 1 else 0 for mine in rows]
    return [
        mine for mine, count in zip(rows, filled, strict=True)
        if len(mine) >= _FEWEST and count <= _MOST_FILLED * len(mine)
    ]  # fmt: skip


def _rotated(R_cw: Array) -> Array:
    """(m, 3) rotations of frames since the first, the sum of those from each to the next."""
    steps = Rotation.from_matrix(R_cw[1:] @ R_cw[:-1].transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _compared(runs: Sequence[_Run], readout_s: float, step_s: float) -> BySpeed:
    """What slow and fast rotations say, about a readout time at which missing frames are filled in."""
    spectra = [_spectra(_filled(run, readout_s, step_s), readout_s) for run in runs]
    fast, lines, rates, line_noise, rate_noise = (np.concatenate(each) for each in zip(*spectra, strict=True))
    slow, rest = (
        _slope(lines[mine], rates[mine], line_noise[mine], rate_noise[mine], readout_s) for mine in (~fast, fast)
    )
    by_slow = 0.0 if slow is None else slow.seconds
    if not _in_lines(lines[fast], rates[fast], line_noise[fast], rate_noise[fast], by_slow):
        rest = None
    noise = by_slow**2 * rate_noise + line_noise
    left = float((np.abs(lines - by_slow * rates) ** 2 - noise).sum())
    # of frames that hardly rotate the noise alone leaves a share; its power at a frequency scatters by itself
    left -= min(max(left, 0.0), _BEYOND * float(np.sqrt(_TOGETHER * (noise**2).sum())))
    power = float((np.abs(lines) ** 2).sum()) - float(line_noise.sum())
    # Parseval's: of m frames under a Hann window, over the half of the frequencies that is looked at
    frames = [int(_places(run, step_s)[-1]) + 1 for run in runs]
    size = np.sqrt(max(left, 0.0) / sum(3 / 16 * m**2 for m in frames))
    return BySpeed(slow, rest, left / power if power > line_noise.sum() else 0.0, float(size))


def _places(run: _Run, step_s: float) -> Index:
    """(m,) number of each frame of a run, those that are missing counted."""
    return np.rint((run.time_s - run.time_s[0]) / step_s).astype(np.int64)


def _filled(run: _Run, readout_s: float, step_s: float) -> _Run:
    """A run with the frames that are missing: rotations and rates there, by those of the frames beside it."""
    place = _places(run, step_s)
    if place[-1] == len(place) - 1 or not readout_s:
        return run
    number = np.arange(place[-1] + 1)
    near = [np.stack([np.interp(number, place, each) for each in sigma.T], axis=1) for sigma in run[2::2]]
    rotated, phi = np.zeros((2, len(number), 3))
    rotated[place], phi[place] = run.rotated, run.phi
    of_step = readout_s / step_s
    # values and rates, alternately
    both = np.stack([run.rotated, run.phi / of_step], axis=1)
    for each in np.setdiff1d(number, place):
        after = int(np.searchsorted(place, each))
        beside = slice(max(after - _BESIDE, 0), after + _BESIDE)
        weights = _weights_between(tuple((place[beside] - each).tolist()))
        rotated[each], rate = weights @ both[beside].reshape(-1, 3)
        phi[each] = rate * of_step
    return _Run(run.time_s[0] + number * step_s, rotated, near[0], phi, near[1])


@lru_cache(maxsize=4096)
def _weights_between(places: tuple[int, ...]) -> Array:
    """(2, 2 n) weights of values and rates at n places, alternately, in value and rate at 0 (Hermite's polynomial)."""
    node = np.repeat(np.array(places, np.float64), 2)
    polynomial = KroghInterpolator(node, np.eye(len(node)))
    return np.stack([polynomial(0.0), polynomial.derivative(0.0)])


def _spectra(run: _Run, readout_s: float) -> tuple[Mask, NDArray[np.complex128], NDArray[np.complex128], Array, Array]:
    """Whether frequencies (n,) are fast; spectra (n, 3) of phi and of the rates; and power (n, 3) of their noise."""
    time_s, rotated, rotation_sigma, phi, phi_sigma = run
    step_s = float(np.median(np.diff(time_s)))
    length = time_s[-1] - time_s[0] + step_s
    # the rate of a path under a window: that of both, less the window's own
    phase = 2 * np.pi * (time_s - time_s[0] + 0.5 * step_s) / length
    window, slope = 0.5 * (1 - np.cos(phase)), np.pi / length * np.sin(phase)
    rotated = rotated - np.average(rotated, axis=0, weights=window)
    frequency = np.arange(_LEAST_PERIODS, int(0.5 * length / step_s)) / length
    waves = np.exp(-2j * np.pi * frequency[:, None] * time_s)
    circular = 2j * np.pi * frequency[:, None]
    # a steady motion that is fitted to a period shows less of it, in its rate and in its pose
    z = np.maximum(np.pi * frequency * abs(readout_s), 1e-3)
    shown = 3 * (np.sin(z) - z * np.cos(z)) / z**2 / np.sin(z)
    rates = (circular * (waves @ (window[:, None] * rotated)) - waves @ (slope[:, None] * rotated)) * shown[:, None]
    of_rotations, of_lines = rotation_sigma**2, phi_sigma**2
    rate_noise = np.abs(circular) ** 2 * (window**2 @ of_rotations) + slope**2 @ of_rotations
    line_noise = np.broadcast_to(window**2 @ of_lines, rate_noise.shape)
    fast = frequency > 0.25 / step_s
    return fast, waves @ (window[:, None] * phi), rates, line_noise, rate_noise * shown[:, None] ** 2


def _in_lines(
    lines: NDArray[np.complex128], rates: NDArray[np.complex128], line_noise: Array, rate_noise: Array, about: float
) -> bool:
    """Whether lines rotate as much as frames do at these frequencies, by a readout time.

    A vibration faster than half of the frame rate shows in the lines, and as a slower one in the frames. What only the
    frames show are their errors, which a scene that is seen from a small way leaves in their rotations.
    """
    weight = 1.0 / (line_noise + about**2 * rate_noise)
    of_lines = float((weight * (np.abs(lines) ** 2 - line_noise)).sum())
    return of_lines >= _IN_LINES * about**2 * float((weight * (np.abs(rates) ** 2 - rate_noise)).sum())


def _slope(
    lines: NDArray[np.complex128], rates: NDArray[np.complex128], line_noise: Array, rate_noise: Array, about: float
) -> ReadoutTime | None:
    """What the rates are multiplied by in the lines, by the scatter of what is left; None if no rate shows."""
    weight = 1.0 / (line_noise + about**2 * rate_noise)
    power = float((weight * (np.abs(rates) ** 2 - rate_noise)).sum())
    chance = float((weight * rate_noise).sum())
    if not power > chance:
        return None
    slope = float((weight * (lines * rates.conj()).real).sum()) / power
    left = np.maximum(np.abs(lines - slope * rates) ** 2, line_noise + slope**2 * rate_noise)
    variance = 0.5 * _TOGETHER * float((weight**2 * np.abs(rates) ** 2 * left).sum()) / power**2
    return ReadoutTime(slope, float(np.sqrt(variance)))
