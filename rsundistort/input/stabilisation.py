"""Whether a video was stabilised in the camera, so that its shutter and its path contradict each other.

During the readout of a frame, in a time T, the world in an unstabilised video rotates by phi = T w, where w is the
rotation rate between the frames: T is between 0 and the time from frame to frame, and the same for all frames. A camera
that stabilises rotates each frame as a whole against its shaking, and may remove its shutter, too:

- shutter without its rotation: the frames are smooth, but their lines still show the shaking;
- rotation without its shutter: the frames rotate, and their lines show less of it than the fastest sensor would;
- against a gyroscope: the frames rotate by less than the camera did, or differently.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..io.gyro import GyroLog
from ..model.array_types import Array
from ..model.checks import check_array, check_finite
from .gyro_alignment import check_pairs

__all__ = ["Regression", "Stabilisation", "calmer_than_felt", "judge_stabilisation"]

# Of the time from frame to frame: no rolling shutter is read faster (0.2 of 1/60 s; `io.readout_times`), none slower,
# but rates between frames miss up to a third of a tremor that is nearly as fast as they can show.
_FASTEST, _SLOWEST = 0.1, 1.5
# Relative standard deviation of a known readout time.
_KNOWN_SHARE = 0.3
# Standard deviations that are required, and the share of the power of a signal that must be left unexplained.
_SIGMAS, _UNEXPLAINED = 4.0, 0.5
# Of what lines show, over the power of their noise: noise that is said to be a third of what it is shows eight.
_SHOWN = 9.0
# Times the median: rates of a hand are not farther out.
_FARTHEST = 12.0
# Frames rotate as the gyroscope says except for the focal length, which may be wrong by a fifth.
_ROTATION_SHARE = 0.75
_FEWEST = 10
# Of the changes of the lines' rotations: those from frame to frame of a camera that vibrates faster than its frames
# show are about as large, those of stabilised frames a thirtieth.
_JUMPS = 0.5
# Half a period of a hand's shaking.
_CHANGE_S = 0.1
# Frames with correlated rotations: this many lie between key frames, whose points they show.
_TOGETHER = 8
# Frames whose rotation changes by less than this share of the gyroscope's were rotated afterwards: no focal length is
# so wrong.
_CALM = 0.5


@dataclass(frozen=True)
class Regression:
    """One motion by another, through the origin: `y = slope x`.

    Attributes
    ----------
    slope, sigma : float
        With its standard deviation, from the scatter of what is left, in neighbours together.
    correlation : float
        Of both, weighted, about zero: from -1 to 1.
    signal : float
        Mean square of y over that of its noise, less one: 0 if y is noise alone.
    unexplained : float
        The same of what is left of y.
    reach : float
        Standard deviation that the slope would have by the noise alone.
    """

    slope: float
    sigma: float
    correlation: float
    signal: float
    unexplained: float
    reach: float


@dataclass(frozen=True)
class Stabilisation:
    """Evidence for stabilisation in a video.

    Attributes
    ----------
    verdict : {"none", "stabilised", "unknown"}
        "unknown" if the camera rotated too little.
    reason : str
        One line, with the figures that decide.
    shutter : Regression
        Rotations during the readout by the rate between frames, or the changes of both, whichever determine the slope
        better: it is the time of the readout in seconds.
    changes : Regression
        Changes within a tenth of a second of the one by those of the other.
    beyond_frames : bool
        Whether the lines change their rotation by more than the frames do in all of the time from one to the next: no
        readout takes longer, and false poses only make the frames seem to rotate by more.
    frames_jump : bool
        Whether the rotation from frame to frame changes by as much as that of the lines does: frames that a stabiliser
        rotated are smooth, those of a camera that vibrates are not.
    read_at_once : bool
        Whether the frames rotate and their lines show less of it than the fastest rolling shutter does: that of a
        global shutter, or of a camera that took its shutter out.
    frames_by_gyro, shutter_by_gyro : Regression or None
        Rates between frames, and rotations during the readout, by the gyroscope's rates.
    """

    verdict: Literal["none", "stabilised", "unknown"]
    reason: str
    shutter: Regression
    changes: Regression
    frames_by_gyro: Regression | None = None
    shutter_by_gyro: Regression | None = None
    beyond_frames: bool = False
    read_at_once: bool = False
    frames_jump: bool = False

    @property
    def shows_shaking(self) -> bool:
        """Whether the lines show shaking that the frames do not: the one sign that no doubt in the poses makes."""
        return self.beyond_frames and self.changes.unexplained > max(_UNEXPLAINED * self.changes.signal, _SHOWN)

    def __str__(self) -> str:
        return self.reason


def judge_stabilisation(
    frame_time_s: ArrayLike,
    pairs: ArrayLike,
    rotations: ArrayLike,
    phi_frame: ArrayLike,
    phi_sigma: ArrayLike,
    *,
    rotation_sigma: ArrayLike = 0.0,
    readout_s: float | None = None,
    log: GyroLog | None = None,
    offset_s: float = 0.0,
) -> Stabilisation:
    """Whether the frames of a video rotate as their shutters say, and as a gyroscope says.

    Parameters
    ----------
    frame_time_s : (m,) array
        When the middle lines of the frames were read.
    pairs : (n, 2) array of int
        Neighbouring frames of each rotation, the earlier first.
    rotations : (n, 3) array
        Rotation vectors of the world in the camera, radians; NaN where unknown.
    phi_frame, phi_sigma : (m, 3) array
        Rotations of the world in the camera during the readout of each frame, in radians per frame, found without any
        knowledge of `rotations`; NaN where unknown. Their standard deviations, or one for all; too small by a factor of
        1.4, they do no harm.
    rotation_sigma : float or (n, 3) array
        Standard deviation of `rotations` in radians.
    readout_s : float, optional
        Readout time, if it is known.
    log : GyroLog, optional
        About the camera's axes (`GyroAlignment.in_camera`), and known to be of this clip: one of another is taken for
        a proof.
    offset_s : float
        What its clock shows when the camera's shows zero.

    Returns
    -------
    Stabilisation
        "stabilised" only where figures say so by four standard deviations, "none" only where the shutter follows.

    Raises
    ------
    InputError
        Shapes that do not fit, or a readout that is not positive.
    """
    times = check_finite(frame_time_s, (None,), "frame_time_s")
    joined, vectors = check_pairs(pairs, rotations)
    phi = check_array(phi_frame, (len(times), 3), "phi_frame")
    phi_noise = _noise(phi_sigma, phi, "phi_sigma")
    rotation_noise = _noise(rotation_sigma, vectors, "rotation_sigma")
    if readout_s is not None and not (np.isfinite(readout_s) and readout_s > 0):
        raise InputError(f"the time of the readout is {readout_s!r} s, expected a positive number")
    start, end = times[joined[:, 0]], times[joined[:, 1]]
    span = np.where(end > start, end - start, np.nan)
    interval = float(np.nanmedian(span)) if np.isfinite(span).any() else np.nan
    rate, rate_noise = vectors / span[:, None], rotation_noise / span[:, None]
    at_frames = _rate_at_frames(rate, joined, len(times))
    shutter, changes, beyond = _of_lines(phi, at_frames, phi_noise, interval)
    frames_by_gyro = shutter_by_gyro = None
    if log is not None:
        felt = -log.mean(start + offset_s, end + offset_s)
        # of rotations without a known noise, that of the gyroscope is all there is
        noise = np.hypot(rate_noise, log.noise * np.sqrt(np.minimum(1.0, log.step_s / interval)))
        frames_by_gyro = _regress(rate, felt, noise, steady=True)
        length = readout_s or 0.5 * interval
        within = -log.mean(times + offset_s - length / 2, times + offset_s + length / 2)
        shutter_by_gyro = _of_lines(phi, within, phi_noise, interval)[0]
    jump = _jump(vectors, joined, phi)
    found = Stabilisation("unknown", "", shutter, changes, frames_by_gyro, shutter_by_gyro, beyond, frames_jump=jump)
    verdict, reason = _judge(found, interval, readout_s)
    fastest = _FASTEST * interval
    at_once = _SIGMAS * shutter.reach < fastest and abs(shutter.slope) + _SIGMAS * shutter.sigma < fastest
    return replace(found, verdict=verdict, reason=reason, read_at_once=at_once and not found.shows_shaking)


def _of_lines(phi: Array, rate: Array, noise: Array, interval: float) -> tuple[Regression, Regression, bool]:
    """Phi (m, 3) by the rate, its changes by those of the rate, and whether these exceed those of whole frames.

    What is in no rotation shows in changes alone: what lens and scene leave in phi is slow. Where it is more than
    noise, changes determine the slope better than levels, and are the first, too.
    """
    levels = _regress(phi, rate, noise, together=_TOGETHER)
    step = max(1, round(_CHANGE_S / interval)) if np.isfinite(interval) else 1
    lines, frames = (each[step:] - each[:-step] for each in (phi, rate))
    changes = _regress(lines, frames, np.hypot(noise[step:], noise[:-step]), together=_TOGETHER)
    known = np.isfinite(lines).all(axis=1) & np.isfinite(frames).all(axis=1)
    in_lines, in_frames = (np.linalg.norm(each[known], axis=1) for each in (lines, frames))
    beyond = bool(known.any()) and float(np.median(in_lines)) > interval * float(np.median(in_frames))
    return min(levels, changes, key=lambda found: found.sigma), changes, beyond


def _jump(rotations: Array, pairs: NDArray[np.integer], phi: Array) -> bool:
    """Whether rotations from frame to frame change by as much, in the middle, as those of the lines."""
    follows = pairs[1:, 0] == pairs[:-1, 1]
    steps = np.linalg.norm(np.diff(rotations, axis=0)[follows], axis=1)
    lines = np.linalg.norm((phi[pairs[1:, 0]] - phi[pairs[:-1, 0]])[follows], axis=1)
    known = np.isfinite(steps) & np.isfinite(lines)
    return bool(known.any()) and float(np.median(steps[known])) > _JUMPS * float(np.median(lines[known]))


def calmer_than_felt(
    frame_time_s: ArrayLike, pairs: ArrayLike, rotations: ArrayLike, rotation_sigma: ArrayLike, log: GyroLog
) -> str:
    """Why frames of a video are stabilised, by a gyroscope with unknown axes and clock; empty if not.

    What is compared is by how much the rotation changes from one frame to the next: that knows no axes and no bias, and
    little of the offset of a clock.

    Parameters
    ----------
    frame_time_s, pairs, rotations, rotation_sigma
        As in `judge_stabilisation`.
    log : GyroLog
        Of this clip beyond doubt, by a clock that is right to some frames: telemetry of the video itself.
    """
    times, joined = np.asarray(frame_time_s, np.float64), np.asarray(pairs)
    span = (times[joined[:, 1]] - times[joined[:, 0]])[:, None]
    seen, felt = np.asarray(rotations) / span, log.mean(times[joined[:, 0]], times[joined[:, 1]])
    noise = _noise(rotation_sigma, seen, "rotation_sigma") / span
    follows = joined[1:, 0] == joined[:-1, 1]
    by_frames, by_gyro = (np.linalg.norm(np.diff(each, axis=0)[follows], axis=1) for each in (seen, felt))
    known = np.isfinite(by_frames) & np.isfinite(by_gyro)
    if known.sum() < _FEWEST:
        return ""
    of_frames, of_gyro = float(np.median(by_frames[known])), float(np.median(by_gyro[known]))
    # three poses and three axes
    of_noise = 3.0 * float(np.nanmedian(noise))
    if of_gyro < _SIGMAS * of_noise or of_frames > _CALM * of_gyro:
        return ""
    return (
        f"stabilised in the camera: from frame to frame the rotation changes by {of_frames / of_gyro:.2f} of what the "
        "camera's own gyroscope felt"
    )


def _noise(sigma: ArrayLike, values: Array, name: str) -> Array:
    """(n, 3) standard deviations of values, from those or one for all."""
    given = np.asarray(sigma, np.float64)
    return np.broadcast_to(given, values.shape) if given.ndim == 0 else check_array(given, values.shape, name)


def _rate_at_frames(rate: Array, pairs: NDArray[np.integer], num_frames: int) -> Array:
    """(m, 3) rate when each frame was read, from the mean rates between frames; NaN where a neighbour is unknown.

    Means over the time between frames are smoother than the rate: with two on each side the value at the frame is that
    of the cubic through their integral, 7/12 and -1/12 of them; with one, their mean.
    """
    before, after = np.full((2, num_frames, 3), np.nan)
    earlier, later = np.full((2, num_frames), -1)
    before[pairs[:, 1]], earlier[pairs[:, 1]] = rate, pairs[:, 0]
    after[pairs[:, 0]], later[pairs[:, 0]] = rate, pairs[:, 1]
    near = before + after
    far = np.where((earlier >= 0)[:, None], before[earlier], np.nan) + np.where(
        (later >= 0)[:, None], after[later], np.nan
    )
    cubic: Array = (7 * near - far) / 12
    return np.where(np.isfinite(cubic), cubic, near / 2)


def _regress(y: Array, x: Array, noise: Array, *, steady: bool = False, together: int = 1) -> Regression:
    """`y = slope x` with a robust loss; without the means of both where a steady difference (a bias) says nothing.

    So many neighbours may be off together.
    """
    there = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1) & (noise > 0).all(axis=1)
    x, y, noise = x[there], y[there], noise[there]
    if len(x) < _FEWEST or not np.any(x):
        signal = float(np.mean((y / noise) ** 2) - 1) if len(y) else 0.0
        return Regression(0.0, np.inf, 0.0, signal, signal, np.inf)
    # false poses between frames are rates that nobody rotates by, and would decide alone
    size = np.linalg.norm(x, axis=1)
    near = size <= _FARTHEST * np.median(size)
    x, y, noise = x[near], y[near], noise[near]
    if steady:
        x, y = x - np.median(x, axis=0), y - np.median(y, axis=0)
    x, y = x / noise, y / noise
    # false rotations are large and pull: the start is the slope of one frame that leaves the smallest median
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = np.sum(x * y, 1) / np.sum(x * x, 1)
    slopes = np.append(np.quantile(slopes[np.isfinite(slopes)], np.linspace(0, 1, 101)), 0.0)
    slope = slopes[np.argmin([np.median(np.linalg.norm(y - each * x, axis=1)) for each in slopes])]
    for _ in range(20):
        size = np.linalg.norm(y - slope * x, axis=1)
        inlier = 1 / (1 + (size / (6 * max(np.median(size) / 1.538, 1e-12))) ** 2) ** 2
        slope = float(inlier @ np.sum(x * y, 1) / (inlier @ np.sum(x * x, 1)))
    left = y - slope * x
    information = inlier @ np.sum(x * x, 1)
    pull = np.pad(inlier * np.sum(x * left, 1), (0, -len(x) % together)).reshape(-1, together)
    sigma = np.sqrt(max(np.sum(pull**2), np.sum(pull.sum(1) ** 2))) / information
    norms = information * (inlier @ np.sum(y * y, 1))
    power = inlier / inlier.sum() / 3
    return Regression(
        slope=slope,
        sigma=float(sigma),
        correlation=float(inlier @ np.sum(x * y, 1) / np.sqrt(norms)) if norms > 0 else 0.0,
        signal=float(power @ np.sum(y * y, 1) - 1),
        unexplained=float(power @ np.sum(left * left, 1) - 1),
        reach=float(1 / np.sqrt(information)),
    )


def _judge(
    evidence: Stabilisation, interval: float, readout_s: float | None
) -> tuple[Literal["none", "stabilised", "unknown"], str]:
    """The verdict, and the line that says why."""
    shutter, changes, rotations = evidence.shutter, evidence.changes, evidence.frames_by_gyro
    if readout_s is None:
        least, most, wanted = _FASTEST * interval, _SLOWEST * interval, f"{1e3 * _FASTEST * interval:.1f} ms or more"
    else:
        least, most = (1 - _KNOWN_SHARE) * readout_s, (1 + _KNOWN_SHARE) * readout_s
        wanted = f"{1e3 * readout_s:.1f} ms"
    alike = f"correlation {shutter.correlation:.2f}"
    found = f"{1e3 * shutter.slope:.1f} +- {1e3 * shutter.sigma:.1f} ms, {alike}"
    low, high = (shutter.slope + side * _SIGMAS * shutter.sigma for side in (-1, 1))
    if (
        rotations is not None
        and _SIGMAS * max(rotations.reach, rotations.sigma) < 1 - _ROTATION_SHARE
        and rotations.slope + _SIGMAS * rotations.sigma < _ROTATION_SHARE
    ):
        line = (
            f"stabilised in the camera: the frames rotate by {rotations.slope:.2f} +- {rotations.sigma:.2f} of "
            "what the gyroscope felt"
        )
        lines = evidence.shutter_by_gyro
        if lines is not None and lines.slope > _SIGMAS * lines.sigma:
            line += f", their lines as it says ({1e3 * lines.slope:.1f} ms)"
        return "stabilised", line
    detectable = _SIGMAS * shutter.reach < least
    if evidence.shows_shaking:
        unseen = f"{changes.unexplained / changes.signal:.0%} of what the lines show is not in the rotation between the"
        if evidence.frames_jump:
            return "stabilised", (
                f"shakes faster than {0.5 / interval:.0f} Hz, which no path through its frames follows, or was "
                f"stabilised in part: {unseen} frames (readout {found})"
            )
        return "stabilised", (
            f"stabilised in the camera: a shutter without its rotation, {unseen} frames (readout {found}); shaking "
            f"faster than {0.5 / interval:.0f} Hz looks the same"
        )
    if detectable and high < -least and low > -most:
        # a stabilised video has lost its rotation or its shutter, and here are both
        return "none", f"not stabilised: the lines rotate as much as the frames, the other way ({alike})"
    if detectable and high < least:
        return "stabilised", (
            f"read at once, or stabilised in the camera: rotation between the frames without its shutter (readout "
            f"{found}, expected {wanted}; if the camera has a global shutter: run --model global)"
        )
    if detectable and low > most:
        return "stabilised", (
            f"stabilised in the camera: the lines rotate by more than the frames (readout {found}, expected "
            f"{1e3 * most:.1f} ms at most)"
        )
    if detectable and high > least and low < most and shutter.slope > _SIGMAS * shutter.sigma:
        # differences of frames miss some of how fast they rotate, so that the slope is a rough readout time
        return "none", f"not stabilised: the lines rotate as the frames do ({alike})"
    return "unknown", f"the camera rotated too little to show whether it was stabilised (readout {found})"
