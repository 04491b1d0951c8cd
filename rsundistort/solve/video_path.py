"""From the frames of a video to one path: poses at any time, motions of all frames, and the readout time."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..batch.progress import StageLog
from ..bundle import BundleOptions, BundleResult, bundle_adjust
from ..bundle.own_motions import OwnMotions, own_motions
from ..bundle.path_prior import FramePath, PathPrior, PathStart
from ..critical import heal
from ..errors import InputError, ReconstructionError, RsUndistortWarning
from ..input.key_frames import Clip
from ..input.load import LoadedPhotos
from ..input.stabilisation import Stabilisation, calmer_than_felt, judge_stabilisation
from ..io.gyro import GyroLog
from ..io.kept import Kept
from ..model import Reconstruction, opposite
from ..sfm import MatchedPhotos, retriangulate
from ..verdict.judge_path import BY_SLOW_ROTATIONS, SIGMAS, ReadoutTime, judge_clip, unfollowed_px
from .clip_direction import likely_directions, read_along
from .clip_gyroscope import Felt, felt_gyroscope, own_gyroscope, readout_of, rotations_between
from .clip_pair import FramePair
from .clip_pan import rotating_only
from .clip_tracks import follow_points, followed_again, with_all_frames
from .missing_frames import tell_of_gaps, with_gaps
from .model_sequence import without_shutter
from .outcome import Solved
from .placing import place_photos
from .shaking import held_by_slow_rotations, speeds_of, tell_if_held, with_slow_rotations
from .tracks import rough_options

__all__ = ["frame_path", "readouts_of_halves", "solve_clip"]

# Frames with a pose from fewer measurements say nothing of the path.
_LEAST_MEASUREMENTS = 15
# Frames that half of a clip needs to determine a readout time.
_LEAST_HALF = 4
# Rotations explain the frames up to this error of the flow in pixels, and this share of outliers.
_FLOW_PX, _OUTLIERS = 0.25, 0.2
# Times that error after a first adjustment, which knows neither the rotations' size nor the readout.
_AT_FIRST = 4.0
# Times that frames which only rotate are adjusted again, since some are missing between them.
_GAP_ROUNDS = 3
# Solves that estimate the prior standard deviations of a path, and the share by which these may still change: with
# hundreds of frames few are enough.
_SIGMA_ROUNDS, _SETTLED = 4, 0.05
# Prior standard deviations of the path through two frames, which determine none: rotation (rad), and travel (ways from
# one to the other). The rates of a first frame may change by ten times as much: the velocity by a fifth.
_OF_TWO = 5e-3, 0.02
# Relative fall of the cost that ends an adjustment of a path that another one follows.
_ROUGH_COST = 1e-4
# A focal length changes from frame to frame, by focusing or zooming, if a first adjustment finds it to vary by more
# (relative standard deviation). That one does not know the path well yet: where the lens stays it finds up to 2.4e-4.
_FOCUSES = 5e-4
# Standard deviation of a readout time, as a share of the time between frames, that no false axis of it leaves.
_CLEAR = 0.01
# Readout time that counts as none, as a share of the time between frames.
_NO_READOUT = 1e-6
# Relative standard deviation of a readout time that is specified, or from the table.
_GIVEN_SIGMA, _TABLE_SIGMA = 0.02, 0.1
# A readout time is measured if its standard deviation falls to this share of the one before.
_MEASURED = 0.7
_OF_STABILISED = "what is taken for frames that were stabilised"
_OF_GLOBAL = "what was given: a global shutter"

# Result, its options, whether the frames are as the sensor read them, if that was tested, and the clip with the times
# that the path has.
_Found = tuple[BundleResult, BundleOptions, Stabilisation | None, Clip]


def solve_clip(
    clip: Clip,
    keys: LoadedPhotos,
    path: FramePath,
    options_of: Callable[[Reconstruction], BundleOptions],
    scratch: Path,
    log: StageLog,
    *,
    seed: int = 0,
    matching: str = "auto",
    gyroscope: GyroLog | None = None,
    kept: Kept | None = None,
    at_once: bool = False,
) -> Solved:
    """Map the key frames, register all others with their points, and adjust all as moments of one path.

    Parameters
    ----------
    clip : Clip
        The video.
    keys : LoadedPhotos
        Its key frames, with their features.
    path : FramePath
        Times of all frames, and what is known of the readout.
    options_of : callable
        Options of the adjustments for a reconstruction.
    scratch : Path
        Folder for the database.
    log : StageLog
        Receives the progress.
    seed, matching
        As in `solve_photos`.
    gyroscope : GyroLog, optional
        A gyroscope's log; else that of the video's own telemetry, if it has any. Its axes and the offset of its clock
        are found.
    kept : Kept, optional
        Results of an earlier run; takes those of this run.
    at_once : bool
        Whether the frames were read at once, by a global shutter, or have lost their shutter since.

    Returns
    -------
    Solved
        Its result is that of the key frames, `whole` the reconstruction of all frames.
    """
    path = _at_once(path) if at_once else path
    known = path.readout
    telemetry = own_gyroscope(clip) if gyroscope is None else None
    # the scene of the key frames is that of a global shutter, whatever their lines are
    placed = cache(lambda: place_photos(keys, scratch, log, seed, matching, kept or Kept(), of_clip=True))

    def along(direction: str) -> tuple[LoadedPhotos, _Found]:
        as_stored = direction == keys.cameras.of(0).readout
        read_so = keys if as_stored else replace(keys, cameras=read_along(direction, keys.cameras))
        return read_so, _filmed_by(clip, read_so, path, options_of, log, telemetry, placed)

    directions = (keys.cameras.of(0).readout,) if at_once else likely_directions(keys.cameras)
    keys, found = _as_read(directions, along, clip.frame_s)
    as_said, (result, options, filmed, clip) = clip, found
    tell_of_gaps(as_said, clip)
    assert options.path is not None
    if options.path.rotation_only:
        warnings.warn(
            "the camera only rotated: without parallax there are directions, but no positions and no scene",
            RsUndistortWarning, stacklevel=3,
        )  # fmt: skip
    tell_if_held(options.path)
    alone = readout_of(result)
    # the telemetry of frames that were rotated since says nothing; those of a global shutter only look like them
    of_camera = None if _was_stabilised(filmed) and not at_once else gyroscope or telemetry
    result, options, felt = _with_gyroscope(result, options, of_camera, known, log)
    return _judged(clip, keys, result, options, alone, felt, filmed, telemetry, log, at_once)


def _as_read(
    directions: Sequence[str], along: Callable[[str], tuple[LoadedPhotos, _Found]], frame_s: float
) -> tuple[LoadedPhotos, _Found]:
    """The key frames and their path, read in the one of these directions that fits; the way round as lines say."""
    tried, failed = list[tuple[LoadedPhotos, _Found]](), None
    for direction in directions:
        try:
            tried.append(along(direction))
        except (InputError, ReconstructionError) as error:
            failed = failed or error
        if tried and readout_of(tried[-1][1][0]).sigma < _CLEAR * frame_s and _shows_readout(tried[-1][1]):
            break
    if not tried and failed is not None:
        raise failed
    keys, found = tried[0]
    if len(tried) > 1:  # lines that are none show something, too, but fit worse
        keys, found = min(tried, key=lambda each: each[1][0].sigma_px if _shows_readout(each[1]) else np.inf)
    if len(directions) > 1 and _shows_readout(found) and readout_of(found[0]).seconds < 0:
        return along(opposite(keys.cameras.of(0).readout))
    return keys, found


def _filmed_by(
    clip: Clip, keys: LoadedPhotos, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog, telemetry: GyroLog | None, placed: Callable[[], tuple[Reconstruction, MatchedPhotos]],
) -> _Found:  # fmt: skip
    """The path of the camera: of one that only rotates, through two frames, or of one that travels."""
    turned, explained = _turned(clip, keys, path, options_of, log)
    if turned is not None and explained:
        return turned
    if len(clip.names) == 2:
        return _of_two(clip, keys, path, options_of, log)
    direction = keys.cameras.of(0).readout

    def read_so() -> tuple[Reconstruction, MatchedPhotos]:
        mapped, matched = placed()
        return read_along(direction, mapped), read_along(direction, matched)

    try:
        found = _travelled(clip, path, options_of, log, telemetry, read_so)
    except ReconstructionError:
        # no scene: rotations that explain neighbours are all that there is
        if turned is None:
            raise
        return turned
    if turned is not None and _shows_readout(turned) and not _shows_readout(found):
        return turned
    return found


def _with_gyroscope(
    result: BundleResult, options: BundleOptions, gyroscope: GyroLog | None, known: tuple[float, float] | None,
    log: StageLog,
) -> tuple[BundleResult, BundleOptions, Felt | None]:  # fmt: skip
    """The path by the rates of a gyroscope, too, if it fits; its options, and what the gyroscope felt."""
    assert options.path is not None
    log.begin("gyroscope")
    felt = felt_gyroscope(result, gyroscope)
    if felt is not None:
        # its rates are those of the camera, however fast that shakes
        path = replace(
            options.path, rates=felt.rates(result), start=_start_of(result), readout=known, held_sigma=0.0
        )  # fmt: skip
        options = replace(options, path=path)
        result = bundle_adjust(
            result.reconstruction, "constant-motion",
            replace(options, outlier_rounds=0, prior_sigma_rounds=_SIGMA_ROUNDS, prior_sigma_tolerance=_SETTLED),
            partial(_tell, log, "gyroscope"),
        )  # fmt: skip
    log.end("gyroscope", offset_s=None if felt is None else felt.alignment.offset_s)
    return result, options, felt


def _turned(
    clip: Clip, keys: LoadedPhotos, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog,
) -> tuple[_Found | None, bool]:  # fmt: skip
    """The path of a camera that only rotates, if that explains neighbours; and whether it explains all frames."""
    log.begin("rotations")
    start, found, explained = rotating_only(clip, keys), None, False
    if start is not None:
        path = replace(path, rotation_only=True)
        options = replace(options_of(start), path=path)
        # a focal length that the rotations said would absorb wild ones, which the path smooths yet
        said = start.cameras[0] != keys.cameras.of(0)
        rough = replace(options, refine=()) if said else options
        result, own, clip, path = _turned_in_time(clip, path, start, rough, log)
        if own is not None:
            path = held_by_slow_rotations(clip, result.reconstruction, path, own)
            options = _if_it_focuses(replace(options, path=path), result)
            result = bundle_adjust(
                result.reconstruction, "constant-motion",
                replace(
                    options, outlier_rounds=1, prior_sigma_rounds=_SIGMA_ROUNDS, prior_sigma_tolerance=_SETTLED,
                    path=replace(path, start=_start_of(result)),
                ),
                partial(_tell, log, "rotations"),
            )  # fmt: skip
            dropped = 1 - len(result.reconstruction.observations) / len(start.observations)
            found, explained = (result, options, None, clip), result.sigma_px < _FLOW_PX and dropped < _OUTLIERS
    log.end("rotations", explained=explained)
    return found, explained


def _turned_in_time(
    clip: Clip, path: FramePath, start: Reconstruction, options: BundleOptions, log: StageLog
) -> tuple[BundleResult, OwnMotions | None, Clip, FramePath]:
    """The first adjustment of frames that only rotate, and their own motions; None if rotations do not explain them.

    And the clip and its path, with other times where frames are missing. On a path without the gaps the motions of the
    frames beside them are off, so that others are seen when some were found.
    """
    as_said, rounds = (clip, path), 0
    while True:
        how = _at_first(replace(options, path=path))
        result = bundle_adjust(start, "constant-motion", how, partial(_tell, log, "rotations"))
        # it smooths wild rotations, which leaves an error several times as large as that of the next one
        if result.sigma_px >= _AT_FIRST * _FLOW_PX:
            return result, None, clip, path
        own = own_motions(result.reconstruction, rotation_only=True)
        timed = with_gaps(*as_said, result.reconstruction, own)
        if rounds == _GAP_ROUNDS or np.array_equal(timed[0].time_s, clip.time_s):
            return result, own, clip, path
        (clip, path), rounds = timed, rounds + 1


def _shows_readout(found: _Found) -> bool:
    """Whether lines rotate as their frames do: a scene that is none, of things that move, shows anything."""
    time = readout_of(found[0])
    return not _was_stabilised(found[2]) and bool(abs(time.seconds) > SIGMAS * time.sigma)


def _of_two(
    clip: Clip, keys: LoadedPhotos, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog,
) -> _Found:  # fmt: skip
    """The path through two frames."""
    log.begin("path")
    pair = FramePair.of(clip, keys)
    start = pair.placed(None if path.readout is None else path.readout_prior[0])
    prior = PathPrior(path, start, _OF_TWO)
    path = replace(path, start=PathStart(tuple(start.image_names), prior.start(start), _OF_TWO))
    # one step determines no spread of steps, and estimates of it would not settle
    options = replace(options_of(start), path=path, prior_sigma_rounds=0)
    rough = replace(_at_first(options), prior_sigma_rounds=0, varying=False)
    first = bundle_adjust(start, "constant-motion", rough, partial(_tell, log, "path"))
    options = replace(options, path=replace(path, start=_start_of(first)))
    whole = pair.of_all(first.reconstruction)
    result = bundle_adjust(whole, "constant-motion", options, partial(_tell, log, "path"))
    log.end("path", points=result.reconstruction.num_points, rms_px=result.rms_px)
    return result, options, None, clip


def _travelled(
    clip: Clip, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog, telemetry: GyroLog | None, placed: Callable[[], tuple[Reconstruction, MatchedPhotos]],
) -> _Found:  # fmt: skip
    """The path of a camera that travels, from the scene of its key frames, mapped as of a global shutter."""
    mapped, matched = placed()
    result: BundleResult | None = None
    filmed: Stabilisation | None = None
    # the lens would absorb a shutter that is not modelled yet
    rough = rough_options(replace(options_of(mapped), refine=()))
    current = bundle_adjust(mapped, "global", rough).reconstruction
    log.begin("flow")
    followed = follow_points(clip, current)
    log.end("flow", observations=len(followed.frame))
    for stage in ("path", "path again"):
        log.begin(stage)
        on_path = None if result is None else result.reconstruction
        whole = with_all_frames(clip, current, followed, on_path).without_photos(_LEAST_MEASUREMENTS)
        if on_path is not None:
            whole = _focused_as(on_path, whole)
        if on_path is None:
            own = own_motions(whole)
            clip, path = with_gaps(clip, path, whole, own)
            path, filmed = _as_filmed(clip, whole, path, telemetry, own)
            held = path if _was_stabilised(filmed) else held_by_slow_rotations(clip, whole, path, own, fills=False)
        elif held.held_sigma or not (_was_stabilised(filmed) or clip.is_even):  # by what is better known now
            held = held_by_slow_rotations(clip, on_path, path, own_motions(on_path))
        options, is_first = replace(options_of(whole), path=held), result is None
        if result is None:
            # a camera that nobody knows would take the lines' rotations for its lens; mapping refined it
            how = _at_first(options if matched.calibrated else replace(options, refine=()))
        else:
            options = _if_it_focuses(replace(options, path=replace(held, start=_start_of(result))), result)
            how = replace(options, outlier_rounds=1, prior_sigma_rounds=_SIGMA_ROUNDS, prior_sigma_tolerance=_SETTLED)
        result = bundle_adjust(whole, "constant-motion", how, partial(_tell, log, stage))
        log.end(
            stage, frames=whole.num_images, of_frames=len(clip.names), rms_px=result.rms_px,
            iterations=result.num_iterations, readout_s=readout_of(result).seconds, stop_reason=result.stop_reason,
        )  # fmt: skip
        if is_first:
            # key frames without shutter: measurements that it had torn from their tracks return
            before, of_keys = current, result.of_photos(_are_keys(result, clip)).reconstruction
            current = retriangulate(matched, of_keys)
            followed = followed_again(clip, followed, before, current)
    assert result is not None
    return result, options, filmed, clip


def _as_filmed(
    clip: Clip, start: Reconstruction, path: FramePath, telemetry: GyroLog | None, found: OwnMotions
) -> tuple[FramePath, Stabilisation]:
    """Whether frames are as the sensor read them, and the path of those that can share one.

    The shutter of frames that were rotated since is not that of their path, and any readout time would be wrong. The
    telemetry is the video's own.
    """
    filmed = _stabilisation(clip, start, found)
    if not filmed.shows_shaking:  # poses without a path say little else
        filmed = replace(filmed, verdict="unknown" if filmed.verdict == "stabilised" else filmed.verdict)
    if telemetry is not None:
        filmed = _against_telemetry(clip, start, found.R_cw, found, telemetry, filmed)
    return (_at_once(path) if _was_stabilised(filmed) else path), filmed


def _against_telemetry(
    clip: Clip, rec: Reconstruction, R_cw: NDArray[np.float64], own: OwnMotions, telemetry: GyroLog,
    filmed: Stabilisation,
) -> Stabilisation:  # fmt: skip
    """The verdict on frames that rotate by less than the video's own telemetry, unless their lines rotate as they do.

    Lines agree with frames if a lens moves against the shaking.
    """
    if filmed.verdict == "none":
        return filmed
    place = clip.places(rec.image_names)
    pairs, rotations = rotations_between(clip.part[place], R_cw)
    reason = calmer_than_felt(clip.time_s[place], pairs, rotations, _rotation_sigma(own, pairs), telemetry)
    return replace(filmed, verdict="stabilised", reason=reason) if reason else filmed


def _start_of(result: BundleResult, *, at_once: bool = False) -> PathStart:
    """What an adjustment found of a path, for the next one; or of the same frames if they are read at once."""
    assert result.path is not None
    state, noise = result.path.state, result.noise_factor if result.noise_factor != 1.0 else None
    if at_once:
        state = replace(state, pace=np.zeros_like(state.pace))
    return PathStart(tuple(result.reconstruction.image_names), state, result.path_sigmas, noise)


def _at_once(path: FramePath) -> FramePath:
    """The path of frames that are read at once."""
    return replace(path, readout=(0.0, _NO_READOUT * path.frame_s))


def _standing(rec: Reconstruction) -> Reconstruction:
    """The same frames as those of a global shutter."""
    none = {key: np.zeros_like(getattr(rec, key)) for key in ("phi", "velocity", "bend")}
    return replace(rec, shutter_model="global", **none)


def _was_stabilised(filmed: Stabilisation | None) -> bool:
    return filmed is not None and filmed.verdict == "stabilised"


def _at_first(options: BundleOptions) -> BundleOptions:
    """Options of an adjustment of a path that is followed by another one."""
    return replace(
        rough_options(options), outlier_rounds=2, prior_sigma_rounds=1, cost_tolerance=_ROUGH_COST, deviations="model",
        varying=True,
    )  # fmt: skip


def _focused_as(before: Reconstruction, whole: Reconstruction) -> Reconstruction:
    """A reconstruction with the focal lengths that another one found for the same frames."""
    of_frame = dict(zip(before.image_names, before.variation, strict=True))
    none = np.zeros(3)
    return replace(whole, variation=np.array([of_frame.get(name, none) for name in whole.image_names]))


def _if_it_focuses(options: BundleOptions, first: BundleResult) -> BundleOptions:
    """Options with a focal length that varies from frame to frame, if a first adjustment shows that."""
    if first.focal_sigma < _FOCUSES:
        return options
    return replace(options, varying=True, focal_sigma_start=first.focal_sigma)


def _judged(
    clip: Clip, keys: LoadedPhotos, result: BundleResult, options: BundleOptions, alone: ReadoutTime,
    felt: Felt | None, filmed: Stabilisation | None, telemetry: GyroLog | None, log: StageLog, at_once: bool,
) -> Solved:  # fmt: skip
    """The verdict on a path, and the motions of its key frames."""
    assert options.path is not None
    remedy = None
    if not (options.path.rotation_only or at_once):  # there is no shape, or no shutter that could bend it
        log.begin("critical motion")
        result, remedy = heal(result, options)
        log.end("critical motion", sigma_log_k=remedy.after.sigma_log_k)
    log.begin("halves")
    without_readout = at_once or _was_stabilised(filmed)
    halves = None if without_readout or options.path.held_sigma else readouts_of_halves(result, options)
    log.end("halves", readout_s=None if halves is None else [each.seconds for each in halves])
    log.begin("stabilisation")
    stabilisation, vibration_px, speeds = filmed, 0.0, None
    if stabilisation is None or not without_readout:
        own = own_motions(result.reconstruction, rotation_only=options.path.rotation_only)
        if not at_once:
            vibration_px = unfollowed_px(result.reconstruction, own)
            speeds = speeds_of(clip, result.reconstruction, own, readout_of(result).seconds)
            result = with_slow_rotations(result, options.path, speeds)
        stabilisation = _stabilisation(clip, result.reconstruction, own, felt)
        if felt is None and telemetry is not None:
            on_path = result.reconstruction
            stabilisation = _against_telemetry(clip, on_path, on_path.R_cw, own, telemetry, stabilisation)
    log.end("stabilisation", verdict=stabilisation.verdict)
    of_keys = result.of_photos(_are_keys(result, clip))
    log.begin("comparison with a global shutter")
    if options.path.rotation_only:  # there are no positions without a path
        path_at_once = replace(_at_once(options.path), start=_start_of(result, at_once=True))
        rough = replace(rough_options(options), path=path_at_once, outlier_rounds=0, prior_sigma_rounds=0)
        global_result = bundle_adjust(of_keys.reconstruction, "constant-motion", rough)
    else:
        global_result = without_shutter(of_keys, options)
    log.end("comparison with a global shutter", rms_px=global_result.rms_px)
    against = stabilisation.reason if stabilisation.verdict == "stabilised" else ""
    if at_once:
        against = _against_global(stabilisation)
    ratio = 1.0 if felt is None else felt.alignment.ratio
    # where the path follows slow rotations only, fast ones contradict nothing
    apart = speeds._replace(fast=None) if speeds is not None and options.path.held_sigma else speeds
    verdict = judge_clip(result, of_keys, halves, clip.frame_s, remedy, against, vibration_px, apart, ratio)
    if verdict.lens_only:
        warnings.warn(
            f"the frames are corrected for the lens only: {verdict.reasons[0]}", RsUndistortWarning, stacklevel=4
        )
    # the frame of a mapping is arbitrary
    rec, whole, found = of_keys.reconstruction, result.reconstruction, result.path
    assert found is not None
    world = rec.R_cw[0], rec.center_w[0], 1.0 / rec.baseline
    path = replace(found, path=found.path.moved(*world))
    if at_once:
        rec, whole = _standing(rec), _standing(whole)
    of_keys = replace(of_keys, reconstruction=rec.moved(*world), path=path)
    time = ReadoutTime(0.0, 0.0) if at_once else readout_of(result)
    by_speed = [] if speeds is None else [each._asdict() for each in (speeds.slow, speeds.fast) if each is not None]
    evidence: dict[str, Any] = {
        "seconds": time.seconds,
        "sigma": time.sigma,
        "source": _OF_GLOBAL if at_once else _source(options, time, felt, filmed),
        "of_frame": time.seconds / clip.frame_s,
        "unbounded_seconds": float(found.unbounded_s[0]),
        "unfollowed_px": vibration_px,
        "frames": len(path.names),
        "halves": [] if halves is None else [each._asdict() for each in halves],
        "by_speed": by_speed if len(by_speed) > 1 else [],
        "stabilisation": {"verdict": stabilisation.verdict, "reason": stabilisation.reason},
    }
    if felt is not None:
        by_gyro = stabilisation.shutter_by_gyro
        evidence["by_pictures"] = alone._asdict()
        evidence["gyroscope"] = felt.facts()
        if by_gyro is not None:
            evidence["by_gyroscope"] = felt.readout(by_gyro)._asdict()
    return Solved(
        of_keys, global_result, keys.cameras, remedy=remedy, verdict=verdict,
        whole=whole.moved(*world), evidence=evidence,
    )  # fmt: skip


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


def _source(options: BundleOptions, time: ReadoutTime, felt: Felt | None, filmed: Stabilisation | None) -> str:
    """The evidence for the readout time."""
    assert options.path is not None
    if _was_stabilised(filmed):
        return _OF_STABILISED
    if options.path.held_sigma:
        return BY_SLOW_ROTATIONS
    measured = "the video" if felt is None else "the video and its gyroscope"
    if options.path.readout is None or time.sigma < _MEASURED * options.path.readout[1]:
        return measured
    return "what was known before"


def frame_path(clip: Clip, readout: tuple[float, str] | None) -> FramePath:
    """The path of a clip's frames, whose readout time is known from some source, or not at all."""
    known = None
    if readout is not None:
        seconds, source = readout
        known = seconds, (_GIVEN_SIGMA if source == "given" else _TABLE_SIGMA) * seconds
    time = dict(zip(clip.names, clip.time_s.tolist(), strict=True))
    return FramePath(time, clip.frame_s, known, dict(zip(clip.names, clip.part.tolist(), strict=True)))


def _are_keys(result: BundleResult, clip: Clip) -> NDArray[np.bool_]:
    keys = {*clip.key_names}
    return np.array([name in keys for name in result.reconstruction.image_names])


def readouts_of_halves(result: BundleResult, options: BundleOptions) -> tuple[ReadoutTime, ReadoutTime] | None:
    """The readout time by each half of the frames; None if there are too few."""
    rec = result.reconstruction
    late = np.arange(rec.num_images) >= rec.num_images // 2
    if rec.num_images < 2 * _LEAST_HALF:
        return None
    assert options.path is not None
    # poses are those of the whole, as good as; a tolerance this small lets each half find its own readout time
    pictures = replace(options.path, rates={}, start=_start_of(result))
    how = replace(
        rough_options(options), path=pictures, outlier_rounds=0, prior_sigma_rounds=1, cost_tolerance=1e-6, refine=(),
        deviations="jackknife",
    )  # fmt: skip
    parts = [rec.take_photos(keep) for keep in (~late, late)]
    if any(part.num_images < _LEAST_HALF or part.num_points < _LEAST_MEASUREMENTS for part in parts):
        return None
    first, second = (readout_of(bundle_adjust(part, "constant-motion", how)) for part in parts)
    return first, second


def _stabilisation(clip: Clip, rec: Reconstruction, found: OwnMotions, felt: Felt | None = None) -> Stabilisation:
    """Whether the lines of the frames move as the frames do, each frame having its own motion."""
    place = clip.places(rec.image_names)
    pairs, rotations = rotations_between(clip.part[place], found.R_cw)
    span = rec.frame_span()[:, None]
    log, offset_s = (None, 0.0) if felt is None else (felt.log, felt.alignment.offset_s)
    return judge_stabilisation(
        clip.time_s[place], pairs, rotations, found.phi * span, found.sigma_phi * span, log=log, offset_s=offset_s,
        rotation_sigma=_rotation_sigma(found, pairs),
    )  # fmt: skip


def _rotation_sigma(found: OwnMotions, pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """(n, 3) standard deviations of the rotations between pairs of frames."""
    sigma: NDArray[np.float64] = np.linalg.norm(found.sigma_rotation[pairs], axis=1)
    return sigma


def _tell(log: StageLog, stage: str, _cost: float) -> None:
    log.tell(stage, 0)
