"""How far the path of a video can be trusted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..bundle import BundleResult
from ..bundle.own_motions import OwnMotions
from ..critical import Remedy
from ..model import Reconstruction
from ..model.reprojection import shutter_displacements
from ..rectify import largest_shift_px
from .judge import UNSEEN_PX, Verdict, height_reasons, loose_reasons, unexplained_reasons
from .speeds import BySpeed, ReadoutTime

__all__ = ["BY_SLOW_ROTATIONS", "SIGMAS", "ReadoutTime", "in_ms", "judge_clip", "problem_of", "unfollowed_px"]

#: Source of a readout time that the path says nothing about.
BY_SLOW_ROTATIONS = "slow rotations of the video"
#: Standard deviations by which a readout time differs from none, or from another of the same video.
SIGMAS = 3.0
# Those by which slow and fast rotations contradict each other, whose spectra leak.
_APART = 4.0
# Share of the readout time by slow rotations that fast ones must show: noise in the poses hides some of it.
_SHOWN_FAST = 0.5
# Relative error that the scale of a gyroscope may have: 3 % by most data sheets, and what the lens adds.
_GYRO_SCALE = 0.05
# Of the time from frame to frame: a readout time that ends at it, and is known no better, is not measured.
_KNOWN = 0.1
# Of what key frames share, right poses fit this much at least: 0.96 and more, or 0.81 beside a hood in a quarter of the
# frame. In videos of one plane, or of something large that moved, poses were wrong (0.33 to 0.75).
_LEAST_SHARE = 0.8
# Of all measurements, those that are displaced by less than what counts as seen: a few points may be wrong.
_SHARE_SHOWN = 0.95
# Where a path misses part of how fast its camera rotates, the readout time comes out longer.
_TOO_FEW = "the camera shakes too fast for its frame rate, or frames are missing or came twice"
_VIBRATES = "the camera vibrates faster than half of the frame rate, or something else bends the frames"
# A vibration a little faster than half of the frame rate shows in the frames as a slower one that runs the other way.
_BACKWARDS = (
    "the last line is read first (--readout), the video runs backwards, or the camera vibrates faster than half of the "
    "frame rate"
)


def judge_clip(
    result: BundleResult,
    keys: BundleResult,
    halves: tuple[ReadoutTime, ReadoutTime] | None,
    frame_s: float,
    remedy: Remedy | None = None,
    against: str = "",
    vibration_px: float = 0.0,
    speeds: BySpeed | None = None,
    rotation_ratio: float = 1.0,
    travel_px: float = 0.0,
    share_that_fits: float = 1.0,
) -> Verdict:
    """Judge the path of a video.

    Parameters
    ----------
    result : BundleResult
        Of all frames.
    keys : BundleResult
        The same of the key frames only.
    halves : pair of ReadoutTime, optional
        The readout times from the first and the second half of the frames.
    frame_s : float
        Time from frame to frame, which no readout exceeds.
    remedy : Remedy, optional
        The remedy of a critical motion, with the uncertainty of the height.
    against : str
        The reason why the frames are no longer as they were read, such as stabilisation; empty if there is none.
    vibration_px : float
        What frames rotate beyond their path, as `unfollowed_px` gives it.
    speeds : BySpeed, optional
        What slow and fast rotations say.
    rotation_ratio : float
        Rotations of the frames over those of the gyroscope.
    travel_px : float
        What rotations leave of points that frames far apart share, where a scene leaves much less; else 0.
    share_that_fits : float
        Share of the matches of key frames that the poses fit, of those that any epipolar geometry does.

    Returns
    -------
    Verdict
        "found" if a readout time differs significantly from none and displaces lines, "not-found" if no readout time
        within its deviations displaces them visibly; else, and if it would be longer than possible, "not-determined".
    """
    assert result.path is not None
    time = ReadoutTime(float(result.path.readout_s[0]), float(result.path.sigma_readout_s[0]))
    unbounded_s = float(result.path.unbounded_s[0])
    reasons = loose_reasons(keys, scaled=True) + height_reasons(remedy) + unexplained_reasons(keys, None)
    rec = keys.reconstruction
    shift = _shift_px(rec)
    most = shift * (abs(time.seconds) + SIGMAS * time.sigma) / max(abs(time.seconds), 1e-9)
    if against:
        return Verdict(
            "not-determined", "doubtful", (f"{against[0].upper()}{against[1:]}.", *reasons), {}, tuple(rec.image_names)
        )
    if not most > UNSEEN_PX:
        shutter = "not-found"
    elif _is_too_long(unbounded_s, time.sigma, frame_s):
        # whatever bends them, corrected as by a shutter they would be bent the more
        shutter = "not-determined"
        reasons.insert(
            0,
            f"The readout appears to take {1e3 * abs(unbounded_s):.0f} +- {1e3 * time.sigma:.0f} ms, longer than the "
            f"{1e3 * frame_s:.1f} ms from frame to frame: something else bends the frames.",
        )
    elif abs(time.seconds) > SIGMAS * time.sigma:
        shutter = "found"
    else:
        shutter = "not-determined"
        reasons.append(
            f"The camera moved too little to determine the readout time: {1e3 * time.seconds:.1f} +- "
            f"{1e3 * time.sigma:.1f} ms."
        )
    if shutter != "not-found":  # what displaces nothing contradicts nothing
        reasons += _contradictions(time, vibration_px, speeds, halves)
    reasons += _of_poses(rec, rotation_ratio, share_that_fits, travel_px)
    lens_only = tuple(rec.image_names) if shutter == "not-determined" else ()
    return Verdict(shutter, "doubtful" if reasons else "trusted", tuple(reasons), {}, lens_only)


def _shift_px(rec: Reconstruction) -> float:
    """By how much the shutter displaces pixels, the most of all frames."""
    shift = max(largest_shift_px(rec.camera(i), rec.motion(i), rec.shutter_model) for i in range(rec.num_images))
    # travel displaces what is near
    moved, valid = shutter_displacements(rec)
    if valid.any():
        shift = max(shift, float(np.quantile(np.linalg.norm(moved[valid], axis=1), _SHARE_SHOWN)))
    return shift


def _of_poses(rec: Reconstruction, rotation_ratio: float, share_that_fits: float, travel_px: float) -> list[str]:
    """Why the poses of the frames may be wrong."""
    reasons = []
    if abs(np.log(rotation_ratio)) > _GYRO_SCALE:
        reasons.append(
            f"The frames rotate {rotation_ratio:.2f} times as far as the gyroscope: by it the focal length is "
            f"{rotation_ratio * rec.cameras[0].K[0, 0]:.0f} px, not {rec.cameras[0].K[0, 0]:.0f} px."
        )
    if share_that_fits < _LEAST_SHARE:
        reasons.append(f"The {_fit_little(share_that_fits)}.")
    if travel_px > 0:
        reasons.append(
            f"The camera travelled, too: rotations leave {travel_px:.1f} px of what frames far apart share. The focal "
            "length and the rotations may be wrong by some percent."
        )
    return reasons


def _contradictions(
    time: ReadoutTime, vibration_px: float, speeds: BySpeed | None, halves: tuple[ReadoutTime, ReadoutTime] | None
) -> list[str]:
    """Why the readout time may be wrong, whatever its standard deviation."""
    reasons = []
    if _is_backwards(time):
        reasons.append(f"The readout time is {1e3 * time.seconds:.1f} +- {1e3 * time.sigma:.1f} ms: {_BACKWARDS}.")
    if vibration_px > UNSEEN_PX:
        reasons.append(f"The frames rotate by {vibration_px:.1f} px more than their path explains: {_VIBRATES}.")
    slow, fast = (None, None) if speeds is None else speeds[:2]
    if slow is not None and fast is not None and _runs_the_other_way(slow, fast):
        reasons.append(
            f"Slow rotations ask for a readout time of {1e3 * slow.seconds:.1f} ms, fast ones for "
            f"{1e3 * fast.seconds:.1f} +- {1e3 * fast.sigma:.1f} ms: the camera vibrates faster than half of the frame "
            "rate, and the readout time may be wrong."
        )
    elif slow is not None and _contradicts(time, slow):
        reasons.append(
            f"The readout time is {1e3 * time.seconds:.1f} +- {1e3 * time.sigma:.1f} ms along the path, and "
            f"{1e3 * slow.seconds:.1f} +- {1e3 * slow.sigma:.1f} ms by slow rotations alone: {_TOO_FEW}."
        )
    if halves is not None:
        a, b = halves
        apart = abs(a.seconds - b.seconds) / float(np.hypot(a.sigma, b.sigma))
        if apart > SIGMAS:
            reasons.append(
                f"The readout time is {1e3 * a.seconds:.1f} ms by the first half of the video and "
                f"{1e3 * b.seconds:.1f} ms by the second, {apart:.0f} standard deviations apart."
            )
        elif _is_outside(time, halves):
            reasons.append(
                f"The readout time is {1e3 * time.seconds:.1f} +- {1e3 * time.sigma:.1f} ms by the whole video, "
                f"{1e3 * a.seconds:.1f} and {1e3 * b.seconds:.1f} ms by its halves."
            )
    return reasons


def _is_outside(time: ReadoutTime, halves: tuple[ReadoutTime, ReadoutTime]) -> bool:
    """Whether a readout time is not that of its halves together, as it is where all fit the same path."""
    weights = np.array([each.sigma for each in halves]) ** -2.0
    if not weights.sum() > 0:
        return False
    mean = float(np.average([each.seconds for each in halves], weights=weights))
    return bool(abs(time.seconds - mean) > SIGMAS * max(time.sigma, float(weights.sum()) ** -0.5))


def _is_too_long(unbounded_s: float, sigma_s: float, frame_s: float) -> bool:
    """Whether the measurements ask for a readout that ends after the next has begun.

    Exact ones have to say so beyond doubt; for vague ones, whose estimate would then be the bound, it is enough.
    """
    doubt_s = SIGMAS * sigma_s if sigma_s < _KNOWN * frame_s else 0.0
    return abs(unbounded_s) > frame_s + doubt_s


def _is_backwards(time: ReadoutTime) -> bool:
    """Whether lines rotate against the frames, as no camera's do whose readout direction is known."""
    return time.seconds < -SIGMAS * time.sigma


def _runs_the_other_way(slow: ReadoutTime, fast: ReadoutTime) -> bool:
    """Whether fast rotations are not those of the lines, but show in the frames as others."""
    sign = np.sign(slow.seconds)
    missing = sign * (_SHOWN_FAST * slow.seconds - fast.seconds)
    return bool(missing > _APART * np.hypot(fast.sigma, _SHOWN_FAST * slow.sigma))


def _contradicts(time: ReadoutTime, slow: ReadoutTime) -> bool:
    """Whether the readout time along the path is not that of slow rotations, which any path follows."""
    return bool(abs(time.seconds - slow.seconds) > SIGMAS * np.hypot(time.sigma, slow.sigma))


def unfollowed_px(reconstruction: Reconstruction, own: OwnMotions) -> float:
    """How far the first and last lines of frames are displaced by rotations that they show, and their path does not.

    Robust standard deviation for one axis, in pixels, without that of the frames' own rotations. A path follows
    rotations up to half of the frame rate; a motor, or a mount, may shake a camera faster.
    """
    pixels = 0.5 * reconstruction.frame_span()[:, None] * np.array([each.K[0, 0] for each in reconstruction.cameras])[
        reconstruction.camera_idx, None
    ]  # fmt: skip
    apart, sigma = pixels * (own.phi - reconstruction.phi), pixels * own.sigma_phi
    known = np.isfinite(apart) & np.isfinite(sigma)
    if not known.any():
        return 0.0
    # median of the square of a normal variable
    return float(np.sqrt(max(np.median((apart**2)[known]) / 0.455 - np.median((sigma**2)[known]), 0.0)))


def in_ms(seconds: float, sigma: float) -> str:
    """A readout time with its standard deviation, which nothing may tell."""
    said = f"+- {1e3 * sigma:.1f} ms" if np.isfinite(sigma) else "ms, of unknown standard deviation"
    return f"{1e3 * seconds:.1f} {said}"


def _fit_little(share_that_fits: float) -> str:
    return (
        f"poses fit only {100 * share_that_fits:.0f} % of what key frames share: something large moves, parts of the "
        "scene look alike, or all of it lies in one plane"
    )


def problem_of(evidence: Mapping[str, Any]) -> str:
    """Why a video does not determine its readout time, by `quality.readout_time`; empty if it does."""
    stabilised = evidence.get("stabilisation") or {}
    if stabilised.get("verdict") == "stabilised":
        return str(stabilised["reason"])
    if evidence.get("stands"):
        return "the camera hardly moves"
    if evidence["source"] == "what was known before":
        return "the video does not determine it better than it was known before"
    seconds, sigma = evidence["seconds"], evidence["sigma"]
    if not abs(seconds) > SIGMAS * sigma:
        return f"the camera moved too little: {in_ms(seconds, sigma)}"
    frame_s = abs(seconds / evidence["of_frame"]) if evidence.get("of_frame") else np.inf
    unbounded_s = evidence.get("unbounded_seconds", seconds)
    if _is_too_long(unbounded_s, sigma, frame_s):
        return (
            f"it would be {1e3 * abs(unbounded_s):.0f} +- {1e3 * sigma:.0f} ms, longer than the time from frame to "
            "frame: something else bends the frames"
        )
    if _is_backwards(ReadoutTime(seconds, sigma)):
        return f"{in_ms(seconds, sigma)}: {_BACKWARDS}"
    if evidence.get("unfollowed_px", 0.0) > UNSEEN_PX:
        return f"the frames rotate by {evidence['unfollowed_px']:.1f} px more than their path explains: {_VIBRATES}"
    if evidence.get("halves"):
        first, second = evidence["halves"]
        apart = abs(first["seconds"] - second["seconds"]) / np.hypot(first["sigma"], second["sigma"])
        if apart > SIGMAS:
            return f"the halves of the video contradict each other, {apart:.0f} standard deviations apart"
        if _is_outside(ReadoutTime(seconds, sigma), (ReadoutTime(**first), ReadoutTime(**second))):
            return "the halves of the video contradict the whole"
    if (share := evidence.get("share_that_fits", 1.0)) < _LEAST_SHARE:
        return f"the {_fit_little(share)}"
    if evidence.get("by_speed"):
        slow, fast = (ReadoutTime(each["seconds"], each["sigma"]) for each in evidence["by_speed"])
        if evidence["source"] != BY_SLOW_ROTATIONS and _runs_the_other_way(slow, fast):
            return (
                "the camera vibrates faster than half of the frame rate: slow and fast rotations contradict each other"
            )
        if _contradicts(ReadoutTime(seconds, sigma), slow):
            return f"slow rotations alone contradict it: {_TOO_FEW}"
    return ""
