"""From the frames of a video to one path: poses at any time, motions of all frames, and the readout time."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from ..batch.progress import StageLog
from ..bundle import BundleOptions, BundleResult, bundle_adjust
from ..bundle.own_motions import OwnMotions, own_motions
from ..bundle.path_prior import FramePath, PathPrior, PathStart
from ..errors import InputError, ReconstructionError, RsUndistortWarning
from ..input.key_frames import Clip
from ..input.load import LoadedPhotos
from ..input.stabilisation import Stabilisation
from ..io.gyro import GyroLog
from ..io.kept import Kept
from ..model import Reconstruction, opposite
from ..model.reprojection import reprojection_residuals
from ..sfm import MatchedPhotos, retriangulate
from ..sfm.contradiction import share_that_fits
from ..sfm.epipolar import read_num_verified
from ..verdict.judge_path import SIGMAS
from .clip_direction import likely_directions, read_along
from .clip_gyroscope import felt_gyroscope, own_gyroscope, readout_of
from .clip_lens import at_first, if_it_focuses, is_other_lens, unsettled, with_known_lens, with_unknown_lens
from .clip_pair import FramePair
from .clip_pan import as_directions, lens_shows_px, rotating_only
from .clip_stabilisation import as_filmed, was_stabilised
from .clip_tracks import Followed, focused_as, follow_points, followed_again, with_all_frames
from .clip_verdict import FoundPath, judged
from .missing_frames import tell_of_gaps, with_gaps
from .outcome import Solved
from .placing import map_key_frames, place_photos
from .shaking import held_by_slow_rotations
from .tracks import rough_options, tell

__all__ = ["frame_path", "solve_clip"]

# Frames with a pose from fewer measurements say nothing of the path.
_LEAST_MEASUREMENTS = 15
# Rotations explain the frames up to this error of the flow in pixels, and this share of outliers.
_FLOW_PX, _OUTLIERS = 0.25, 0.2
# Error that the flow has itself, where nothing else is left.
_EXACT_PX = 0.125
# Share of the error of frames that are taken for stabilised which their shutter leaves, if it was that.
_MOST_OF_IT = 0.5
# Times that error after a first adjustment, which knows neither the rotations' size nor the readout.
_AT_FIRST = 4.0
# A scene is one if rotations leave of its measurements so many times what it leaves, by this quantile, and if it has
# such a share of the frames that rotations explain.
_PARALLAX, _MOST, _LEAST_SHARED = 1.5, 0.75, 0.8
# Way that a camera which hardly travels is off at first, in distances of its scene: half a pixel.
_HARDLY = 1e-3
# Times that frames which only rotate are adjusted again, since some are missing between them.
_GAP_ROUNDS = 3
# Solves that estimate the prior standard deviations of a path, and the share by which these may still change: with
# hundreds of frames few are enough.
_SIGMA_ROUNDS, _SETTLED = 4, 0.05
# Prior standard deviations of the path through two frames, which determine none: rotation (rad), and travel (ways from
# one to the other). The rates of a first frame may change by ten times as much: the velocity by a fifth.
_OF_TWO = 5e-3, 0.02
# A scene is mapped again if its path found a focal length that differs by this share; so many times.
_MAPPED_BY, _LENS_ROUNDS = 0.05, 3
# If new points are fewer than this share of those before, rays may meet at this angle: ten times what pixels measure.
_LEAST_SHARE, _LEAST_DEG = 0.3, 0.2
# Standard deviation of a readout time, as a share of the time between frames, that no false axis of it leaves.
_CLEAR = 0.01
# Relative standard deviation of a readout time that is specified, or from the table.
_GIVEN_SIGMA, _TABLE_SIGMA = 0.02, 0.1


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
    gyro_offset_s: float = 0.0,
    kept: Kept | None = None,
    at_once: bool = False,
    rotates: bool = False,
) -> Solved:
    """Map the key frames, register all others with their points, and adjust all as moments of one path.

    Parameters
    ----------
    keys : LoadedPhotos
        Its key frames, with their features.
    path : FramePath
        Times of all frames, and what is known of the readout.
    options_of : callable
        Options of the adjustments for a reconstruction.
    scratch : Path
        Folder for the database.
    seed, matching
        As in `solve_photos`.
    gyroscope : GyroLog, optional
        A gyroscope's log; else that of the video's own telemetry, if it has any. Its axes and the offset of its clock
        are found.
    gyro_offset_s : float
        Where the offset of that log's clock is looked for, as `align_gyro` does around it.
    at_once : bool
        Whether the frames were read at once, by a global shutter, or have lost their shutter since.
    rotates : bool
        Whether the camera is one that only rotates: no scene is looked for, and there is none if rotations fail.

    Returns
    -------
    Solved
        Its result is that of the key frames, `whole` the reconstruction of all frames.
    """
    path = path.at_once if at_once else path
    known = path.readout
    telemetry = own_gyroscope(clip) if gyroscope is None else None
    # the scene of the key frames is that of a global shutter, whatever their lines are
    placed = cache(lambda: place_photos(keys, scratch, log, seed, matching, kept or Kept(), of_clip=True))

    def along(direction: str) -> tuple[LoadedPhotos, FoundPath]:
        as_stored = direction == keys.cameras.of(0).readout
        read_so = keys if as_stored else replace(keys, cameras=read_along(direction, keys.cameras))
        return read_so, _filmed_by(clip, read_so, path, options_of, log, telemetry, placed, rotates=rotates)

    directions = (keys.cameras.of(0).readout,) if at_once else likely_directions(keys.cameras)
    keys, found = _as_read(directions, along, clip.frame_s)
    tell_of_gaps(clip, found.clip)
    if found.stands:
        warnings.warn(
            "the camera hardly moves, which says nothing of shutter, lens and scene: film while you turn or carry it",
            RsUndistortWarning, stacklevel=3,
        )  # fmt: skip
    elif found.path.rotation_only:
        why = "travelled too little" if found.travel_px else "only rotated"
        warnings.warn(
            f"the camera {why}: without parallax there are directions, but no positions and no scene",
            RsUndistortWarning, stacklevel=3,
        )  # fmt: skip
    alone = readout_of(found.result)
    # the telemetry of frames that were rotated since says nothing; those of a global shutter only look like them
    of_camera = None if was_stabilised(found.filmed) and not at_once else gyroscope or telemetry
    found = _with_gyroscope(found, of_camera, gyro_offset_s, known, log)
    return judged(found, keys, alone, telemetry, log, at_once=at_once)


def _as_read(
    directions: Sequence[str], along: Callable[[str], tuple[LoadedPhotos, FoundPath]], frame_s: float
) -> tuple[LoadedPhotos, FoundPath]:
    """The key frames and their path, read in the one of these directions that fits; the way round as lines say."""
    tried, failed = list[tuple[LoadedPhotos, FoundPath]](), None
    for direction in directions:
        try:
            tried.append(along(direction))
        except (InputError, ReconstructionError) as error:
            failed = failed or error
        if tried and readout_of(tried[-1][1].result).sigma < _CLEAR * frame_s and _shows_readout(tried[-1][1]):
            break
    if not tried and failed is not None:
        raise failed
    keys, found = tried[0]
    if len(tried) > 1:  # lines that are none show something, too, but fit worse
        keys, found = min(tried, key=lambda each: each[1].result.sigma_px if _shows_readout(each[1]) else np.inf)
    if len(directions) > 1 and _shows_readout(found) and readout_of(found.result).seconds < 0:
        return along(opposite(keys.cameras.of(0).readout))
    return keys, found


def _filmed_by(
    clip: Clip, keys: LoadedPhotos, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog, telemetry: GyroLog | None, placed: Callable[[], tuple[Reconstruction, MatchedPhotos]],
    *, rotates: bool = False,
) -> FoundPath:  # fmt: skip
    """The path of the camera: of one that only rotates, through two frames, or of one that travels."""
    rotated, explained = _only_rotated(clip, keys, path, options_of, log)
    if len(clip.names) == 2:
        two = rotated if explained == "by rotations" else None
        return two or _of_two(clip, keys, path, options_of, log)
    if rotated is not None and (rotated.stands or (rotates and explained == "by rotations")):
        return rotated
    if rotates:
        raise ReconstructionError("rotations do not explain the frames")
    direction = keys.cameras.of(0).readout

    def read_so() -> tuple[Reconstruction, MatchedPhotos]:
        mapped, matched = placed()
        return read_along(direction, mapped), read_along(direction, matched)

    try:
        found = _travelled(clip, path, options_of, log, telemetry, read_so)
    except (InputError, ReconstructionError):
        # no scene: rotations that explain neighbours are all that there is, unless what they leave is one
        if rotated is None:
            raise
        if explained != "by rotations":
            return rotated
        try:
            found = _hovered(rotated, log)
        except ReconstructionError:
            return rotated
    if rotated is None:
        return found
    if explained == "by rotations":
        left_px = _left_by_rotations(found, rotated, log)
        if left_px <= _PARALLAX * _left_px(found.result.reconstruction):
            return rotated
        with suppress(ReconstructionError):
            keys.cameras.check_plausible(found.result.reconstruction.cameras)
            return found
        return replace(rotated, travel_px=left_px)
    # a lens that zooms, or that nobody knows, makes of travel a rotation; what explains the frames better was it
    explains = explained in ("by zooming", "by a lens") and rotated.result.sigma_px <= found.result.sigma_px
    return rotated if explains or (_shows_readout(rotated) and not _shows_readout(found)) else found


def _with_gyroscope(
    found: FoundPath, gyroscope: GyroLog | None, around_s: float, known: tuple[float, float] | None, log: StageLog
) -> FoundPath:
    """The path by the rates of a gyroscope, too, if it fits."""
    log.begin("gyroscope")
    result, options, felt = found.result, found.options, felt_gyroscope(found.result, gyroscope, around_s)
    if felt is not None:
        # its rates are those of the camera, however fast that shakes
        path = replace(found.path, rates=felt.rates(result), start=result.path_start(), readout=known, held_sigma=0.0)
        options = replace(options, path=path)
        how = replace(options, outlier_rounds=0, prior_sigma_rounds=_SIGMA_ROUNDS, prior_sigma_tolerance=_SETTLED)
        result = bundle_adjust(result.reconstruction, "constant-motion", how, partial(tell, log, "gyroscope"))
    log.end("gyroscope", offset_s=None if felt is None else felt.alignment.offset_s)
    return replace(found, result=result, options=options, felt=felt)


def _only_rotated(
    clip: Clip, keys: LoadedPhotos, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog,
) -> tuple[FoundPath | None, str]:  # fmt: skip
    """The path of a camera that only rotates, if that explains neighbours; and by what it explains all frames.

    Where they would look the same through any lens, but for errors of the flow, they say nothing of it: it is held.

    "by rotations", of a lens that may focus if that leaves no more than the flow's own error; "by zooming" only: by a
    focal length that varies, which takes travel for zoom; "by a lens" only, whose distortion nobody knew; or "".
    """
    log.begin("rotations")
    start, found, explained = rotating_only(clip, keys), None, ""
    if start is not None:
        path = replace(path, rotation_only=True)
        options, ways = replace(options_of(start), path=path), ["by rotations", "by zooming"]
        stands = lens_shows_px(start, keys.cameras.likely_sigma(0)) < _EXACT_PX
        if stands:  # errors of the flow alone would say the lens
            start = as_directions(start, replace(start, cameras=[keys.cameras.of(0)]))
            options, ways = replace(options, refine=()), ways[:1]
        # a focal length that the rotations said would absorb wild ones, which the path smooths yet
        said = start.cameras[0] != keys.cameras.of(0)
        rough = replace(options, refine=()) if said else options
        for how in ways:
            other = _rotated_as_filmed(clip, path, start, options, replace(rough, varying=how == "by zooming"), log)
            if other is None:
                continue
            dropped = 1 - len(other.result.reconstruction.observations) / len(start.observations)
            explains = other.result.sigma_px < _FLOW_PX and dropped < _OUTLIERS
            if explains and other.result.sigma_px < _EXACT_PX:
                found, explained = other, "by rotations"
                break
            if found is None or (explains and not explained):
                found, explained = other, how if explains else ""
        if stands and explained and found:
            found = replace(found, stands=True)
    knew_lens = start is None or np.array_equal(start.cameras[0].dist, keys.cameras.of(0).dist)
    if explained == "by rotations" and not knew_lens and found and found.result.sigma_px >= _EXACT_PX:
        explained = "by a lens"
    log.end("rotations", explained=explained)
    return found, explained


def _rotated_as_filmed(
    clip: Clip, path: FramePath, start: Reconstruction, options: BundleOptions, rough: BundleOptions, log: StageLog
) -> FoundPath | None:
    """The path of frames that only rotate, by `rough` options at first; None if rotations do not explain them."""
    result, own, clip, path = _rotated_in_time(clip, path, start, rough, log)
    if own is None:
        return None
    held = held_by_slow_rotations(clip, result.reconstruction, path, own)
    for _ in range(_LENS_ROUNDS):  # what was an outlier by one lens is none by another
        before, (result, options) = result, _rotated_again(result, replace(options, path=held), log)
        if not is_other_lens(result, before.reconstruction.cameras[0], _MAPPED_BY):
            break
    # what a rough path does not follow, a better one may
    if held.held_sigma and not _is_held(clip, path, result):
        result, options = _rotated_again(result, replace(options, path=path), log)
    return FoundPath(clip, result, options)


def _rotated_in_time(
    clip: Clip, path: FramePath, start: Reconstruction, options: BundleOptions, log: StageLog
) -> tuple[BundleResult, OwnMotions | None, Clip, FramePath]:
    """The first adjustment of frames that only rotate, and their own motions; None if rotations do not explain them.

    And the clip and its path, with other times where frames are missing. On a path without the gaps the motions of the
    frames beside them are off, so that others are seen when some were found.
    """
    as_said, rounds = (clip, path), 0
    while True:
        how = replace(at_first(replace(options, path=path)), varying=options.varying)
        result = bundle_adjust(start, "constant-motion", how, partial(tell, log, "rotations"))
        # it smooths wild rotations, which leaves an error several times as large as that of the next one
        if result.sigma_px >= _AT_FIRST * _FLOW_PX:
            return result, None, clip, path
        own = own_motions(result.reconstruction, rotation_only=True)
        timed = with_gaps(*as_said, result.reconstruction, own)
        if rounds == _GAP_ROUNDS or np.array_equal(timed[0].time_s, clip.time_s):
            return result, own, clip, path
        (clip, path), rounds = timed, rounds + 1


def _rotated_again(before: BundleResult, options: BundleOptions, log: StageLog) -> tuple[BundleResult, BundleOptions]:
    """The last adjustment of frames that only rotate, from one before, and its options."""
    options = if_it_focuses(options, before)
    assert options.path is not None
    how = replace(options, outlier_rounds=1, prior_sigma_rounds=_SIGMA_ROUNDS, prior_sigma_tolerance=_SETTLED)
    how = replace(how, path=replace(options.path, start=before.path_start()))
    told = partial(tell, log, "rotations")
    return bundle_adjust(before.reconstruction, "constant-motion", how, told), options


def _hovered(rotated: FoundPath, log: StageLog) -> FoundPath:
    """The path of a camera that travels too little for its scene to be mapped, from rotations that explain its frames.

    Some tenths of a pixel of parallax, more of it below than above before slanted ground, look like lines that rotate:
    readout times come out anywhere. All frames share the depths, so that an adjustment finds these and the way, from
    one distance of all and next to no way.
    """
    log.begin("travel")
    turned, told = rotated.result.reconstruction, partial(tell, log, "travel")
    way = _HARDLY * np.random.default_rng(0).normal(size=turned.center_w.shape)  # without any, depths would be free
    path = replace(rotated.path, rotation_only=False)
    options = replace(rotated.options, path=path)
    rough = replace(at_first(replace(options, refine=())), varying=False)
    first = bundle_adjust(replace(turned, center_w=way), "constant-motion", rough, told)
    how = replace(options, outlier_rounds=1, prior_sigma_rounds=_SIGMA_ROUNDS, prior_sigma_tolerance=_SETTLED)
    how = replace(how, path=replace(path, start=first.path_start()))
    result = bundle_adjust(first.reconstruction, "constant-motion", how, told)
    log.end("travel", points=result.reconstruction.num_points, readout_s=readout_of(result).seconds)
    return FoundPath(rotated.clip, result, options)


def _left_by_rotations(found: FoundPath, rotated: FoundPath, log: StageLog) -> float:
    """What rotations leave of most measurements of a scene, pixels; 0 if they have too few of its frames.

    Those of neighbouring frames, which rotations explained, hide the travel of a camera that is swung on an arm: nearly
    all of it looks like a longer focal length. Points of a scene are seen in frames far apart.
    """
    rec, turned = found.result.reconstruction, rotated.result.reconstruction
    shared = np.isin(rec.image_names, turned.image_names)
    if shared.sum() < _LEAST_SHARED * turned.num_images:
        return 0.0
    path = replace(rotated.path, start=rotated.result.path_start())
    how = replace(rough_options(rotated.options), path=path, outlier_rounds=0)
    start = as_directions(rec.take_photos(shared), turned)
    return _left_px(bundle_adjust(start, "constant-motion", how, partial(tell, log, "rotations")).reconstruction)


def _left_px(reconstruction: Reconstruction) -> float:
    """Error of measurements that most do not exceed, in pixels: what is near shows parallax, what is far does not."""
    return float(np.quantile(np.linalg.norm(reprojection_residuals(reconstruction)[0], axis=1), _MOST))


def _is_held(clip: Clip, path: FramePath, result: BundleResult) -> bool:
    """Whether frames that only rotate shake faster than a path through them follows."""
    own = own_motions(result.reconstruction, rotation_only=True)
    return held_by_slow_rotations(clip, result.reconstruction, path, own).held_sigma > 0


def _shows_readout(found: FoundPath) -> bool:
    """Whether lines rotate as their frames do: a scene that is none, of things that move, shows anything."""
    time = readout_of(found.result)
    return not was_stabilised(found.filmed) and bool(abs(time.seconds) > SIGMAS * time.sigma)


def _of_two(
    clip: Clip, keys: LoadedPhotos, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog,
) -> FoundPath:  # fmt: skip
    """The path through two frames."""
    log.begin("path")
    pair = FramePair.of(clip, keys)
    start = pair.placed(None if path.readout is None else path.readout_prior[0])
    prior = PathPrior(path, start, _OF_TWO)
    path = replace(path, start=PathStart(tuple(start.image_names), prior.start(start), _OF_TWO))
    # one step determines no spread of steps, and estimates of it would not settle
    options = replace(options_of(start), path=path, prior_sigma_rounds=0)
    rough = replace(at_first(options), prior_sigma_rounds=0, varying=False)
    first = bundle_adjust(start, "constant-motion", rough, partial(tell, log, "path"))
    options = replace(options, path=replace(path, start=first.path_start()))
    whole = pair.of_all(first.reconstruction)
    result = bundle_adjust(whole, "constant-motion", options, partial(tell, log, "path"))
    log.end("path", points=result.reconstruction.num_points, rms_px=result.rms_px)
    return FoundPath(clip, result, options)


def _travelled(
    clip: Clip, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog, telemetry: GyroLog | None, placed: Callable[[], tuple[Reconstruction, MatchedPhotos]],
) -> FoundPath:  # fmt: skip
    """The path of a camera that travels, from the scene of its key frames, mapped as of a global shutter."""
    mapped, matched = placed()
    num_verified = read_num_verified(matched)  # new tracks overwrite them
    found = _first_path(clip, path, options_of, log, telemetry, mapped, matched)
    # in a scene that was mapped by a wrong lens frames bend as by a shutter
    for _ in range(_LENS_ROUNDS):
        if matched.calibrated or not is_other_lens(found.result, mapped.cameras[0], _MAPPED_BY):
            break
        log.begin("mapping again")
        try:
            lens = found.result.reconstruction.cameras
            mapped = map_key_frames(replace(matched, cameras=lens, calibrated=True))
        except ReconstructionError:
            break
        finally:
            log.end("mapping again", photos=mapped.num_images)
        other = _first_path(clip, path, options_of, log, telemetry, mapped, matched)
        if not other.result.sigma_px < found.result.sigma_px:
            break
        found = other
    moved = np.inf
    for repeats in range(_LENS_ROUNDS):
        before, moved_before = found, moved
        try:
            found = _path_again(before, options_of, log, matched)
        except ReconstructionError:
            if not repeats:
                raise
            break
        moved = unsettled(found.result, before.result, clip.frame_s, by_lens=not matched.calibrated)
        if repeats and found.result.sigma_px > before.result.sigma_px and not moved < moved_before:
            found = before  # it ran away, as where frames that were knocked are among them
            break
        # what was an outlier by one lens, or readout, is none by another
        if not moved > 1.0:
            break
    are_keys = found.clip.are_keys(found.result.reconstruction.image_names)
    share = share_that_fits(matched, num_verified, found.result.of_photos(are_keys).reconstruction)
    return FoundPath(found.clip, found.result, found.options, found.filmed, share_that_fits=share)


@dataclass(frozen=True)
class _TravelledPath:
    """A path, and what it was found from.

    Attributes
    ----------
    clip, path
        The clip and its path, with other times where frames are missing.
    options : BundleOptions
        Of its adjustment, with the path as it was held.
    filmed : Stabilisation, optional
        Whether frames are as they were read.
    result : BundleResult
        Of all frames.
    scene, followed
        The key frames, as of a global shutter, and what of them was followed.
    """

    clip: Clip
    path: FramePath
    options: BundleOptions
    filmed: Stabilisation | None
    result: BundleResult
    scene: Reconstruction
    followed: Followed


def _first_path(
    clip: Clip, path: FramePath, options_of: Callable[[Reconstruction], BundleOptions],
    log: StageLog, telemetry: GyroLog | None, mapped: Reconstruction, matched: MatchedPhotos,
) -> _TravelledPath:  # fmt: skip
    """The path through all frames, from the scene of its key frames."""
    # the lens would absorb a shutter that is not modelled yet
    rough = rough_options(replace(options_of(mapped), refine=()))
    scene = bundle_adjust(mapped, "global", rough).reconstruction
    log.begin("flow")
    followed = follow_points(clip, scene)
    log.end("flow", observations=len(followed.frame))
    log.begin("path")
    whole = with_all_frames(clip, scene, followed).without_photos(_LEAST_MEASUREMENTS)
    own, said = own_motions(whole), (clip, path)
    clip, path = with_gaps(clip, path, whole, own)
    path, filmed = as_filmed(clip, whole, path, telemetry, own)
    by_lens = with_known_lens if matched.calibrated else with_unknown_lens
    held = path if was_stabilised(filmed) else held_by_slow_rotations(clip, whole, path, own, fills=False)
    options = replace(options_of(whole), path=held)
    result = by_lens(whole, at_first(options), log)
    if was_stabilised(filmed) and result.sigma_px > _EXACT_PX:
        # so look lines that rotate by more than points show that a scene without a shutter bent, too
        free = by_lens(whole, at_first(replace(options, path=said[1])), log)
        better, own = free.reconstruction, own_motions(free.reconstruction)
        timed, of_times = with_gaps(*said, better, own)
        of_times, other = as_filmed(timed, better, of_times, telemetry, own)
        if not was_stabilised(other) and _explains_it(free, result, clip.frame_s):
            clip, path, filmed, options = timed, of_times, other, replace(options, path=of_times)
            result = free if of_times is said[1] else by_lens(better, at_first(options), log)
    elif held.held_sigma:
        # what a rough scene shows, and no path follows, a better one may not
        free = by_lens(whole, at_first(replace(options, path=path)), log)
        own = own_motions(free.reconstruction)
        if not held_by_slow_rotations(clip, free.reconstruction, path, own).held_sigma:
            options, result = replace(options, path=path), free
    _end_path(log, "path", clip, whole, result)
    return _TravelledPath(clip, path, options, filmed, result, scene, followed)


def _explains_it(free: BundleResult, at_once: BundleResult, frame_s: float) -> bool:
    """Whether a shutter explains most of what frames show that are taken for stabilised, by a readout that can be."""
    assert free.path is not None
    return free.sigma_px < _MOST_OF_IT * at_once.sigma_px and abs(float(free.path.unbounded_s[0])) < frame_s


def _path_again(
    first: _TravelledPath, options_of: Callable[[Reconstruction], BundleOptions], log: StageLog, matched: MatchedPhotos
) -> _TravelledPath:
    """The path once more, with measurements that the shutter, or a wrong lens, had torn from their tracks."""
    result, clip, held = first.result, first.clip, first.options.path
    assert held is not None
    on_path = result.reconstruction
    # key frames without shutter
    scene = _new_points(matched, result.of_photos(clip.are_keys(on_path.image_names)).reconstruction)
    followed = followed_again(clip, first.followed, first.scene, scene)
    log.begin("path again")
    whole = focused_as(on_path, with_all_frames(clip, scene, followed, on_path).without_photos(_LEAST_MEASUREMENTS))
    if held.held_sigma or not (was_stabilised(first.filmed) or clip.is_even):  # by what is better known now
        held = held_by_slow_rotations(clip, on_path, first.path, own_motions(on_path))
    options = if_it_focuses(replace(options_of(whole), path=replace(held, start=result.path_start())), result)
    how = replace(options, outlier_rounds=1, prior_sigma_rounds=_SIGMA_ROUNDS, prior_sigma_tolerance=_SETTLED)
    result = bundle_adjust(whole, "constant-motion", how, partial(tell, log, "path again"))
    _end_path(log, "path again", clip, whole, result)
    return replace(first, options=options, result=result, scene=scene, followed=followed)


def _new_points(matched: MatchedPhotos, keys: Reconstruction) -> Reconstruction:
    """New points of the key frames; of short clips, whose frames lie close together, those of small angles, too."""
    scene = None
    with suppress(ReconstructionError):
        scene = retriangulate(matched, keys)
    if scene is None or scene.num_points < _LEAST_SHARE * keys.num_points:
        scene = retriangulate(matched, keys, least_deg=_LEAST_DEG)
    return scene


def _end_path(log: StageLog, stage: str, clip: Clip, whole: Reconstruction, result: BundleResult) -> None:
    log.end(
        stage, frames=whole.num_images, of_frames=len(clip.names), rms_px=result.rms_px,
        iterations=result.num_iterations, readout_s=readout_of(result).seconds, stop_reason=result.stop_reason,
    )  # fmt: skip


def frame_path(clip: Clip, readout: tuple[float, str] | None) -> FramePath:
    """The path of a clip's frames, whose readout time is known from some source, or not at all."""
    known = None
    if readout is not None:
        seconds, source = readout
        known = seconds, (_GIVEN_SIGMA if source == "given" else _TABLE_SIGMA) * seconds
    time = dict(zip(clip.names, clip.time_s.tolist(), strict=True))
    return FramePath(time, clip.frame_s, known, dict(zip(clip.names, clip.part.tolist(), strict=True)))
