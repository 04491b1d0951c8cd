"""The readout time by slow and by fast rotations: they differ where a camera vibrates faster than its frames show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

__all__ = ["BySpeed", "ReadoutTime", "readouts_by_speed"]

Array = NDArray[np.float64]

# Fewer frames than this, evenly spaced, have no spectrum to speak of; where one is missing, others begin.
_FEWEST, _GAP = 24, 1.5
# Periods in a part that a rotation has at least: slower ones are what lens and scene leave, and the window's edge.
_LEAST_PERIODS = 2
# A Hann window spreads each rotation over three frequencies: what is left of neighbours goes together.
_TOGETHER = 1.5


class ReadoutTime(NamedTuple):
    """Time of the readout of a frame in seconds, and its standard deviation."""

    seconds: float
    sigma: float


class BySpeed(NamedTuple):
    """What slow and fast rotations of frames and of their lines say.

    Attributes
    ----------
    slow, fast : ReadoutTime or None
        The readout times by them; None if that kind of rotation is lost in the noise.
    unfollowed : float
        Share of the power of the lines' rotations that is not in those of the frames at the readout time by slow ones,
        beyond the noise of both: 0 if they agree, 1 or more if they have nothing to do with each other.
    """

    slow: ReadoutTime | None
    fast: ReadoutTime | None
    unfollowed: float


def readouts_by_speed(
    time_s: Array, part: NDArray[np.int64], R_cw: Array, rotation_sigma: Array, phi: Array, phi_sigma: Array,
    readout_s: float,
) -> BySpeed | None:  # fmt: skip
    """The readout time by rotations slower and faster than a quarter of the frame rate.

    The lines of a frame rotate by the readout time times the rate of the frames. A rotation faster than half of the
    frame rate F shows in the frames as one of F less its frequency that runs the other way, whose rate has the other
    sign: then fast rotations ask for another readout time than slow ones, most likely for a negative one. Both spectra
    are compared, so that rates need no differences of frames, which would miss fast ones.

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

    Returns
    -------
    BySpeed or None
        None if there are too few frames.
    """
    known = np.isfinite(np.hstack([R_cw.reshape(-1, 9), phi, phi_sigma])).all(axis=1)
    part = part[known]
    time_s, R_cw, rotation_sigma, phi, phi_sigma = (
        each[known] for each in (time_s, R_cw, rotation_sigma, phi, phi_sigma)
    )
    apart = np.diff(time_s)
    ends = (np.diff(part) != 0) | (apart > _GAP * np.median(apart)) if len(apart) else np.zeros(0, bool)
    run = np.concatenate([[0], np.cumsum(ends)])
    spectra = [
        _spectra(time_s[mine], R_cw[mine], rotation_sigma[mine], phi[mine], phi_sigma[mine], readout_s)
        for each in np.unique(run)
        if len(mine := np.flatnonzero(run == each)) >= _FEWEST
    ]
    if not spectra:
        return None
    fast, lines, rates, line_noise, rate_noise = (np.concatenate(each) for each in zip(*spectra, strict=True))
    slow, rest = (
        _slope(lines[mine], rates[mine], line_noise[mine], rate_noise[mine], readout_s) for mine in (~fast, fast)
    )
    by_slow = 0.0 if slow is None else slow.seconds
    left = float((np.abs(lines - by_slow * rates) ** 2 - by_slow**2 * rate_noise - line_noise).sum())
    power = float((np.abs(lines) ** 2).sum()) - float(line_noise.sum())
    return BySpeed(slow, rest, left / power if power > line_noise.sum() else 0.0)


def _spectra(
    time_s: Array, R_cw: Array, rotation_sigma: Array, phi: Array, phi_sigma: Array, readout_s: float
) -> tuple[NDArray[np.bool_], NDArray[np.complex128], NDArray[np.complex128], Array, Array]:
    """Whether frequencies (n,) are fast; spectra (n, 3) of phi and of the rates; and power (n, 3) of their noise."""
    steps = Rotation.from_matrix(R_cw[1:] @ R_cw[:-1].transpose(0, 2, 1)).as_rotvec()
    rotated = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    step_s = float(np.median(np.diff(time_s)))
    length = time_s[-1] - time_s[0] + step_s
    # the rate of a path under a window: that of both, less the window's own
    phase = 2 * np.pi * (time_s - time_s[0] + 0.5 * step_s) / length
    window, slope = 0.5 * (1 - np.cos(phase)), np.pi / length * np.sin(phase)
    rotated -= np.average(rotated, axis=0, weights=window)
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
