"""The verdict on the path of a clip, and what `solution.json` says of its readout time."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..batch.progress import StageLog
from ..bundle import BundleOptions, BundleResult, bundle_adjust, pose_covariances
from ..bundle.own_motions import own_motions
from ..bundle.path_prior import FramePath
from ..critical import heal
from ..errors import RsUndistortWarning
from ..input.key_frames import Clip
from ..input.load import LoadedPhotos
from ..input.stabilisation import Stabilisation
from ..io.gyro import GyroLog
from ..model import Reconstruction
from ..verdict.judge_path import BY_SLOW_ROTATIONS, ReadoutTime, judge_clip, unfollowed_px
from ..verdict.speeds import BySpeed
from .clip_gyroscope import Felt, readout_of
from .clip_stabilisation import against_telemetry, stabilisation_of, was_stabilised
from .model_sequence import without_shutter
from .outcome import Solved
from .shaking import speeds_of, tell_if_held, with_slow_rotations
from .tracks import rough_options

__all__ = ["FoundPath", "judged", "readouts_of_halves"]

# Frames that half of a clip needs to determine a readout time, and points.
_LEAST_HALF, _LEAST_POINTS = 4, 15
# A readout time is measured if its standard deviation falls to this share of the one before.
_MEASURED = 0.7
_OF_STABILISED = "what is taken for frames that were stabilised"
_OF_GLOBAL = "what was given: a global shutter"


@dataclass(frozen=True)
class FoundPath:
    """A path, as it was adjusted.

    Attributes
    ----------
    clip : Clip
        With the times that the path has.
    result : BundleResult
        Of all frames.
    filmed : Stabilisation, optional
        Whether the frames are as the sensor read them, if that was tested.
    felt : Felt, optional
        The gyroscope that took part.
    travel_px : float
        What frames that are taken to rotate only leave of points that frames far apart share, where a scene leaves much
        less; else 0.
    share_that_fits : float
        Share of the matches of key frames that its poses fit.
    stands : bool
        Whether the camera moved so little that its frames would look the same through any lens.
    """

    clip: Clip
    result: BundleResult
    options: BundleOptions
    filmed: Stabilisation | None = None
    felt: Felt | None = None
    travel_px: float = 0.0
    share_that_fits: float = 1.0
    stands: bool = False

    @property
    def path(self) -> FramePath:
        """What the adjustment was given of the path."""
        assert self.options.path is not None
        return self.options.path


@dataclass(frozen=True)
class _Tested:
    """What a path was tested for: by halves of its frames, by speeds of rotations, and for a stabilisation."""

    result: BundleResult
    halves: tuple[ReadoutTime, ReadoutTime] | None
    speeds: BySpeed | None
    stabilisation: Stabilisation
    vibration_px: float


def judged(
    found: FoundPath, keys: LoadedPhotos, alone: ReadoutTime, telemetry: GyroLog | None, log: StageLog, *, at_once: bool
) -> Solved:
    """The verdict on a path, and the motions of its key frames.

    Parameters
    ----------
    alone : ReadoutTime
        By the pictures, without a gyroscope.
    telemetry : GyroLog or None
        That of the video itself.
    at_once : bool
        Whether the frames were read at once.
    """
    clip, options, remedy = found.clip, found.options, None
    if not (found.path.rotation_only or at_once):  # there is no shape, or no shutter that could bend it
        log.begin("critical motion")
        result, remedy = heal(found.result, options)
        found = replace(found, result=result)
        log.end("critical motion", sigma_log_k=remedy.after.sigma_log_k)
    tested = _tested(found, telemetry, log, at_once)
    result, stabilisation = tested.result, tested.stabilisation
    if stabilisation.verdict != "stabilised":
        tell_if_held(found.path)
    are_keys = clip.are_keys(result.reconstruction.image_names)
    of_keys, poses = result.of_photos(are_keys), pose_covariances(result, found.options)
    log.begin("comparison with a global shutter")
    global_result = _read_at_once(found, result, of_keys)
    log.end("comparison with a global shutter", rms_px=global_result.rms_px)
    against = stabilisation.reason if stabilisation.verdict == "stabilised" else ""
    if at_once:
        against = _against_global(stabilisation)
    ratio = 1.0 if found.felt is None else found.felt.alignment.ratio
    # where the path follows slow rotations only, fast ones contradict nothing
    apart = tested.speeds
    if apart is not None and found.path.held_sigma:
        apart = apart._replace(fast=None)
    verdict = judge_clip(
        result, of_keys, tested.halves, clip.frame_s, remedy, against, tested.vibration_px, apart, ratio,
        found.travel_px, found.share_that_fits,
    )  # fmt: skip
    if verdict.lens_only:
        warnings.warn(
            f"the frames are corrected for the lens only: {verdict.reasons[0]}", RsUndistortWarning, stacklevel=4
        )
    # the frame of a mapping is arbitrary
    rec, whole, on_path = of_keys.reconstruction, result.reconstruction, result.path
    assert on_path is not None
    world = rec.R_cw[0], rec.center_w[0], 1.0 / rec.baseline
    if poses is not None:
        poses = poses.take(are_keys, rec.baseline / whole.baseline)
    if at_once:
        rec, whole = _standing(rec), _standing(whole)
    path = replace(on_path, path=on_path.path.moved(*world))
    return Solved(
        replace(of_keys, reconstruction=rec.moved(*world), path=path), global_result, keys.cameras, remedy=remedy,
        verdict=verdict, whole=whole.moved(*world), evidence=_evidence(found, tested, alone, at_once), poses=poses,
    )  # fmt: skip


def _tested(found: FoundPath, telemetry: GyroLog | None, log: StageLog, at_once: bool) -> _Tested:
    """The tests of a path."""
    clip, result, path = found.clip, found.result, found.path
    log.begin("halves")
    without_readout = at_once or was_stabilised(found.filmed)
    halves = None if without_readout or path.held_sigma else readouts_of_halves(result, found.options)
    log.end("halves", readout_s=None if halves is None else [each.seconds for each in halves])
    log.begin("stabilisation")
    stabilisation, vibration_px, speeds = found.filmed, 0.0, None
    if stabilisation is None or not without_readout:
        own = own_motions(result.reconstruction, rotation_only=path.rotation_only)
        if not at_once:
            vibration_px = unfollowed_px(result.reconstruction, own)
            speeds = speeds_of(clip, result.reconstruction, own, readout_of(result).seconds)
            result = with_slow_rotations(result, path, speeds)
        stabilisation = stabilisation_of(clip, result.reconstruction, own, found.felt)
        if found.felt is None and telemetry is not None:
            on_path = result.reconstruction
            stabilisation = against_telemetry(clip, on_path, on_path.R_cw, own, telemetry, stabilisation)
    log.end("stabilisation", verdict=stabilisation.verdict)
    return _Tested(result, halves, speeds, stabilisation, vibration_px)


def _read_at_once(found: FoundPath, result: BundleResult, of_keys: BundleResult) -> BundleResult:
    """The key frames, adjusted as those of a global shutter."""
    if not found.path.rotation_only:
        return without_shutter(of_keys, found.options)
    # there are no positions without a path
    path = replace(found.path.at_once, start=result.path_start().at_once)
    rough = replace(rough_options(found.options), path=path, outlier_rounds=0, prior_sigma_rounds=0)
    return bundle_adjust(of_keys.reconstruction, "constant-motion", rough)


def _evidence(found: FoundPath, tested: _Tested, alone: ReadoutTime, at_once: bool) -> dict[str, Any]:
    """`quality.readout_time` of a solution."""
    result, felt, on_path = tested.result, found.felt, tested.result.path
    assert on_path is not None
    time = ReadoutTime(0.0, 0.0) if at_once else readout_of(result)
    speeds, shaking = tested.speeds, tested.stabilisation
    by_speed = [] if speeds is None else [each._asdict() for each in (speeds.slow, speeds.fast) if each is not None]
    evidence: dict[str, Any] = {
        "seconds": time.seconds,
        "sigma": time.sigma,
        "source": _OF_GLOBAL if at_once else _source(found, time),
        "of_frame": time.seconds / found.clip.frame_s,
        "unbounded_seconds": float(on_path.unbounded_s[0]),
        "unfollowed_px": tested.vibration_px,
        "share_that_fits": found.share_that_fits,
        "frames": len(on_path.names),
        "stands": found.stands,
        "halves": [] if tested.halves is None else [each._asdict() for each in tested.halves],
        "by_speed": by_speed if len(by_speed) > 1 else [],
        "stabilisation": {"verdict": shaking.verdict, "reason": shaking.reason},
    }
    if felt is not None:
        evidence["by_pictures"] = alone._asdict()
        evidence["gyroscope"] = felt.facts()
        if shaking.shutter_by_gyro is not None:
            evidence["by_gyroscope"] = felt.readout(shaking.shutter_by_gyro)._asdict()
    return evidence


def _standing(rec: Reconstruction) -> Reconstruction:
    """The same frames as those of a global shutter."""
    none = {key: np.zeros_like(getattr(rec, key)) for key in ("phi", "velocity", "bend")}
    return replace(rec, shutter_model="global", **none)


def _against_global(found: Stabilisation) -> str:
    """Why frames may not have been read at once, as the user says they were; empty if their lines show that."""
    if found.read_at_once:
        return ""
    if found.verdict == "none":
        return f"The camera has a rolling shutter, which was not removed, as you asked (--model global): {found.reason}"
    if found.verdict == "unknown":
        return (
            "The camera rotated too little to show whether its frames were read at once, as you asked (--model global)"
        )
    return found.reason


def _source(found: FoundPath, time: ReadoutTime) -> str:
    """The evidence for the readout time."""
    if was_stabilised(found.filmed):
        return _OF_STABILISED
    if found.path.held_sigma:
        return BY_SLOW_ROTATIONS
    known = found.path.readout
    if known is None or time.sigma < _MEASURED * known[1]:
        return "the video" if found.felt is None else "the video and its gyroscope"
    return "what was known before"


def readouts_of_halves(result: BundleResult, options: BundleOptions) -> tuple[ReadoutTime, ReadoutTime] | None:
    """The readout time by each half of the frames; None if there are too few."""
    rec = result.reconstruction
    late = np.arange(rec.num_images) >= rec.num_images // 2
    if rec.num_images < 2 * _LEAST_HALF:
        return None
    assert options.path is not None
    # poses are those of the whole, as good as; a tolerance this small lets each half find its own readout time
    pictures = replace(options.path, rates={}, start=result.path_start())
    how = replace(
        rough_options(options), path=pictures, outlier_rounds=0, prior_sigma_rounds=1, cost_tolerance=1e-6, refine=(),
        deviations="jackknife",
    )  # fmt: skip
    parts = [rec.take_photos(keep) for keep in (~late, late)]
    if any(part.num_images < _LEAST_HALF or part.num_points < _LEAST_POINTS for part in parts):
        return None
    first, second = (readout_of(bundle_adjust(part, "constant-motion", how)) for part in parts)
    return first, second
