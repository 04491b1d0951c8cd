"""The main job: a folder of photos in, rectified photos and poses out."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ..batch.progress import ProgressCallback, StageLog
from ..batch.workers import Workers, use_threads
from ..bundle import BundleOptions
from ..bundle.intrinsics import check_lenses
from ..errors import FileError, InputError, ReconstructionError, RsUndistortWarning
from ..input.exposure import bounded_by_exposure
from ..input.fisheyes import cameras_as_fisheyes
from ..input.frames import find_photos
from ..input.gyroscope import GyroOptions, Readouts, gyro_motions, known_readouts
from ..input.key_frames import Clip
from ..input.load import LoadedPhotos, OtherFeatures, load_photos
from ..input.photo_cameras import PhotoCameras, camera_file_of
from ..input.unknown_focal import warn_of_weak_focal_lengths, with_focal_lengths
from ..input.zooms import cameras_by_zoom
from ..io import ExifFacts, is_video, list_photos, output_folder, read_solution
from ..io.gyro import GyroLog
from ..io.kept import Kept
from ..io.motions import Known
from ..io.outputs import work_folder
from ..io.places import local_place
from ..io.record import Record
from ..io.video import VIDEO_SUFFIXES, VideoFrames
from ..model import Reconstruction, Solution
from ..model.checks import check_kind
from ..verdict.judge import unexplained_reasons
from .clip_fisheye import by_likeliest_lens
from .going_on import RunFolder, key_of, run_folder
from .known_contradiction import known_contradiction
from .model_sequence import solve_photos
from .outcome import Solved
from .run_options import RunOptions, SolveOptions
from .run_outputs import (
    OF_VIDEOS,
    REPLACED,
    USD,
    VIDEO,
    Outputs,
    check_images_of,
    check_usd,
    files_of_run,
    inputs_of,
    photo_times,
    remove_former,
)
from .solutions import explains_most, explains_variation, leaves_less, needs_other_lens
from .stretched import cameras_if_stretched
from .survey import clocks_of, survey_of
from .tracks import of_registered
from .video_path import frame_path, solve_clip

__all__ = ["check_of_video", "run", "solve_frames"]

# Times that photos are solved again after some of them seem to have another lens, or another zoom.
_CAMERA_ROUNDS = 3


def run(
    photos: Path | str,
    out: Path | str,
    options: RunOptions | None = None,
    progress: ProgressCallback | None = None,
    *,
    jobs: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    scheduler: str | None = None,
) -> Solution:
    """Estimate the camera's motion during each photo's readout; write rectified photos, masks and poses.

    Parameters
    ----------
    photos : path
        Folder of photos, or a video: its frames share one path, and its key frames, which go to
        `out/frames`, are the photos.
    out : path
        Folder for the outputs. It stays as it was until the motions are solved; then it gets the solution, and the
        rectified photos one by one.
    options : RunOptions, optional
        See there.
    progress : callable, optional
        Called as (stage, done, total).
    jobs, overwrite, scheduler
        As in `rectify_folder`.
    resume : bool
        Resume a run of these photos and options into `out` that ended early, however it did: features, matches,
        mapping, solution and rectified photos that were complete are not made again, and the outputs are what they
        would have been without the interruption. If there is neither such a run nor an output, it begins.

    Returns
    -------
    Solution
        As written to `out/solution.json`; photos that did not register are in it, with the reason.
    """
    options = RunOptions() if options is None else options
    check_kind(options, RunOptions, "options")
    rectify = options.rectify
    photos, out = local_place(photos), local_place(out)
    if photos.suffix.lower() in VIDEO_SUFFIXES and not photos.exists():
        raise FileError(f"{photos} does not exist; give a video, or a folder of photos")
    log = StageLog(progress)
    workers = Workers(use_threads(jobs), scheduler)
    gyro_files = () if options.gyro is None else (options.gyro.file, options.gyro.times)
    inputs = inputs_of(rectify, photos, *gyro_files, camera_file_of(photos, options.camera))
    is_clip = is_video(photos) and options.every is None and options.sharpest is None
    check_usd(options.outputs, is_clip)
    if options.frames == "all" and not is_clip:
        raise InputError(f"{photos} is no video; --frames all is for one")
    if is_clip:
        check_of_video(options)
    elif options.gyro is not None and options.solve.shutter_model == "global":
        raise InputError("--gyro says how photos moved, and --model global has no motion; leave one of them out")
    unasked = {VIDEO: options.frames != "all", USD: not options.outputs.usd}
    of_video = [name for name in OF_VIDEOS if not unasked.get(name)] if is_clip else []
    replaced = (*REPLACED, "frames") if is_video(photos) else REPLACED
    with run_folder(out, key_of(inputs, options), log, overwrite=overwrite, resume=resume) as before:
        if before.finished:
            return read_solution(out / "solution.json")
        if before.begun:
            outputs: Outputs = before.outputs(log)
        else:
            again = overwrite or before.goes_on
            with output_folder(out, overwrite=again, apart_from=inputs, replaced=replaced) as scratch:
                outputs = _solved(photos, out, scratch, options, inputs, of_video, workers, log, before)
                outputs.begin(scratch, log)
            before.begin()
        remove_former(out, options.outputs, of_video)
        if options.frames == "all":
            stages: list[dict[str, Any]] | None = before.kept.get(VIDEO)
            if stages is None:
                known = len(log.stages)
                outputs.rectify_clip(photos, out, workers, log)
                before.kept.put(VIDEO, log.stages[known:])
            else:
                log.stages += stages
        return outputs.rectify(out / "frames" if is_video(photos) else photos, out, workers, log, before.begun)


def _solved(
    photos: Path,
    out: Path,
    scratch: Path,
    options: RunOptions,
    inputs: Sequence[Path],
    of_video: Sequence[str],
    workers: Workers,
    log: StageLog,
    before: RunFolder,
) -> Outputs:
    """The outputs, with frames of a video in the scratch folder; results of an earlier run are not computed again."""
    rectify, kept = options.rectify, before.kept
    gyro_log = None if options.gyro is None else options.gyro.log()
    source = find_photos(photos, scratch, options.camera, options.every, options.sharpest, log)
    folder = source.folder
    frames = [] if source.frames is None else [f"frames/{path.name}" for path in folder.iterdir()]
    names = list_photos(folder, rectify.raw_as)
    options.outputs.check_names(names)
    check_images_of(names, rectify)
    Record(out).check([*frames, *of_video, *files_of_run(names, rectify.raw_as, options.outputs)], inputs)
    kept.begin()
    found: Outputs | None = before.outputs(log)
    if found is not None:
        return found
    is_clip = source.clip is not None
    loaded = load_photos(
        folder, source.camera, options.solve.readout, options.most_features(is_clip), workers, log,
        megapixels=options.feature_megapixels, masks=rectify.masks, raw_as=rectify.raw_as, again=rectify.again,
        max_megapixels=rectify.max_megapixels, least=2 if is_clip else 3, kept=kept,
        coarse=not is_clip,
    )  # fmt: skip
    loaded = with_focal_lengths(loaded, options.solve.seed, log, kept)
    _check_anchors(options.solve, loaded.names, photos)
    for each in loaded.cameras.cameras:
        rectify.view.scale_for(each.width, each.height)
    check_lenses([*options.solve.camera_sigma], loaded.cameras.cameras, "camera_sigma:")
    bodies = loaded.facts if source.frames is None else [source.frames] * len(loaded.names)
    if source.clip is None:
        solve = partial(_solve, options, bodies=bodies, gyro_log=gyro_log, workers=workers, log=log)
        solved, solving, loaded = _by_cameras(solve, loaded, kept)
    else:
        solved, solving = solve_frames(options, source.clip, loaded, bodies, gyro_log, log, kept), options.solve
    rec, sigmas = solved.result.reconstruction, solved.result.sigma_intrinsics
    if not solved.evidence.get("stands"):  # of a camera that hardly moves that was said already
        warn_of_weak_focal_lengths(loaded.cameras, rec.cameras, sigmas, {*rec.camera_idx.tolist()})
    facts: dict[str, Any] = {} if is_clip else {"features": options.features}
    facts |= {
        "max_features": options.most_features(is_clip),
        "feature_megapixels": options.feature_megapixels,
        "matching": options.matching,
        "video": source.video,
        "gyro": options.gyro and options.gyro.facts(),
    }
    outputs = Outputs.of_solved(
        replace(solved, facts=facts), solving, rectify, options.outputs, loaded.orientations, times=photo_times(folder)
    )
    if source.clip is not None:
        outputs = replace(outputs, shown=source.clip.shown, every_frame=options.frames == "all")
    before.solved(outputs, log)
    return outputs


def _check_anchors(options: SolveOptions, names: Sequence[str], photos: Path) -> None:
    """Refuse constraints on photos that do not exist."""
    ends = (end[0] for each in options.lengths for end in (each.start, each.end))
    for name in (*options.still, *options.known, *ends):
        if name not in names:
            raise InputError(f"constraint on {name!r}, which is not among the photos of {photos}")


def _by_cameras(
    solve: Callable[..., tuple[Solved, SolveOptions]], loaded: LoadedPhotos, kept: Kept
) -> tuple[Solved, SolveOptions, LoadedPhotos]:
    """The result of the photos; by other cameras for those that seem to have another lens or zoom, if these fit."""
    told = list[str]()
    with _saying() as said:
        solved, solving = solve(loaded, kept=kept)
        for other_cameras, is_better in _OTHER_CAMERAS:
            for _ in range(_CAMERA_ROUNDS):
                apart = other_cameras(loaded, solved, solving)
                if apart is None:
                    break
                cameras, notes = apart
                divided, before, other = replace(loaded, cameras=cameras), [*said], None
                said.clear()
                # what was mapped before has other cameras: it is not kept
                with suppress(ReconstructionError, InputError):
                    other, solving_then = solve(divided, kept=Kept())
                if other is None or not is_better(other, solved):
                    said[:] = before
                    break
                solved, solving, loaded = other, solving_then, divided
                told += notes
        for note in told:
            warnings.warn(note, RsUndistortWarning, stacklevel=4)
    return solved, solving, loaded


def _as_fisheyes(loaded: LoadedPhotos, solved: Solved, _options: SolveOptions) -> tuple[PhotoCameras, list[str]] | None:
    """Cameras of another lens, as `cameras_as_fisheyes`."""
    varies = solved.choice is not None and solved.choice.varying
    return cameras_as_fisheyes(
        loaded.cameras, solved.shared.cameras, is_unexplained=_is_unexplained(solved), doubted=varies
    )


def _if_stretched(loaded: LoadedPhotos, solved: Solved, options: SolveOptions) -> tuple[PhotoCameras, list[str]] | None:
    """Cameras of pixels that are not square, as `cameras_if_stretched`."""
    return cameras_if_stretched(loaded.cameras, solved, options, is_unexplained=_is_unexplained(solved))


def _is_unexplained(solved: Solved) -> bool:
    undetermined = solved.verdict is not None and solved.verdict.shutter == "not-determined"
    return undetermined or bool(unexplained_reasons(solved.result, solved.choice))


def _by_zoom(loaded: LoadedPhotos, solved: Solved, _options: SolveOptions) -> tuple[PhotoCameras, list[str]] | None:
    """Cameras of another zoom, as `cameras_by_zoom`."""
    return cameras_by_zoom(loaded.cameras, loaded.names, _zooms(solved))


def _zooms(solved: Solved) -> Mapping[str, float]:
    """Focal lengths of photos in pixels where the lens varies, if it does or would explain much; else {}."""
    rec, choice = solved.shared, solved.choice
    if choice is None or not choice.focal_px:
        return {}
    # the last adjustment, of all measurements, knows them better
    known = {name: float(rec.camera(i).K[0, 0]) for i, name in enumerate(rec.image_names)}
    return known if choice.varying else choice.focal_px


@contextmanager
def _saying() -> Iterator[list[warnings.WarningMessage]]:
    """Hold back warnings; those that are left in the list are given in the end, or before an error.

    What is said of a solution that is not taken concerns nobody.
    """
    said: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as said:
            yield said
    finally:
        for each in said:
            warnings.warn(each.message, each.category, stacklevel=6)


def _is_better(other: Solved, before: Solved) -> bool:
    """Whether a solution leaves less of as many photos."""
    fewer = len(other.shared.image_names) < len(before.shared.image_names)
    return not fewer and other.result.sigma_px < before.result.sigma_px


def _is_explained(other: Solved, before: Solved) -> bool:
    """Whether a solution explains most of what another leaves of as many photos, or as much without varying.

    If the other one leaves no more than noise does, it is explained if anything less is left.
    """
    fewer = len(other.shared.image_names) < len(before.shared.image_names)
    results = other.result, before.result
    is_odd = _is_unexplained(before) or needs_other_lens(before.shared)
    return not fewer and (
        explains_most(*results) or explains_variation(*results) or (not is_odd and leaves_less(*results))
    )


# What else cameras may be, and when that is kept.
# The stretch is asked first: what bends stretched photos may look like a fisheye.
_OTHER_CAMERAS = (_if_stretched, _is_explained), (_as_fisheyes, _is_explained), (_by_zoom, _is_better)


def _solve(
    options: RunOptions,
    loaded: LoadedPhotos,
    bodies: Sequence[ExifFacts | VideoFrames],
    gyro_log: GyroLog | None,
    workers: Workers,
    log: StageLog,
    kept: Kept,
) -> tuple[Solved, SolveOptions]:
    """The result of the photos and a gyroscope's log; and the options with the motions of that log."""
    solving, cameras = options.solve, loaded.cameras
    readouts = known_readouts(bodies, cameras.cameras, cameras.camera_idx, solving.readout_s, gyro_log)
    from_gyro: Known = {}
    if options.gyro is not None and gyro_log is not None:
        from_gyro, solving = _with_gyroscope(solving, options.gyro, gyro_log, loaded, readouts)
    known_s = {k: seconds for k, (seconds, _) in readouts.items()}

    def options_of(rec: Reconstruction) -> BundleOptions:
        return bounded_by_exposure(solving.options_for(cameras), rec, loaded, known_s)

    sizes = [(cameras.of(i).width, cameras.of(i).height) for i in range(len(loaded.names))]
    clock_s = clocks_of(loaded.names, cameras.camera_idx, readouts, cameras)
    other = OtherFeatures(loaded, options.most_features(False), workers, log, options.feature_megapixels, kept)
    survey = survey_of(solving.crs, solving.control, loaded.names, loaded.facts, sizes, clock_s)
    with work_folder() as work:
        solved = solve_photos(
            loaded, solving.shutter_model, solving.seed, options_of,
            work, log, solving.remedy, options.matching, workers, kept, survey, other,
            always_affine=options.features == "affine",
        )  # fmt: skip
    rec = solved.shared
    cameras.check_plausible(rec.cameras, solved.result.sigma_intrinsics)
    contradictions = [
        known_contradiction(rec, from_gyro, options.solve.known, solved.known_motions),
        *cameras.contradicted(rec.cameras, options_of(rec)),
    ]
    for text in filter(None, contradictions):
        warnings.warn(text, RsUndistortWarning, stacklevel=3)
    return replace(solved, readouts=readouts), solving


def check_of_video(options: RunOptions) -> None:
    """Refuse options that the path of a video does not take."""
    solving, gyro = options.solve, options.gyro
    if options.features != "auto":
        raise InputError(
            "frames of a video differ by little and need no other features; leave --features out, or say --every N"
        )
    if solving.control or solving.crs not in (None, "none"):
        raise InputError("frames of a video have no GPS; it takes no --crs and --gcp, say --every N for photos that do")
    of_photos = solving.still or solving.known or solving.known_bends or solving.remedy != "auto"
    if of_photos or solving.shutter_model not in ("auto", "constant-motion", "global"):
        raise InputError(
            "the path of a video says how its frames move: it takes no --still, --known, --remedy or --model but "
            "global; say --every N for photos that do"
        )
    if gyro is not None and gyro.times is not None:
        raise InputError(
            "the frames of a video have times of their own; it takes no --photo-times, say --every N for photos that do"
        )
    if solving.shutter_model == "global" and solving.readout_s is not None:
        raise InputError("frames of a global shutter have no readout time; leave out --readout-ms or --model global")


def solve_frames(
    options: RunOptions,
    clip: Clip,
    keys: LoadedPhotos,
    bodies: Sequence[ExifFacts | VideoFrames],
    gyro_log: GyroLog | None,
    log: StageLog,
    kept: Kept | None = None,
) -> Solved:
    """The result of a video and a gyroscope's log; as of a fisheye, if no pinhole lens explains its frames as well."""
    solving = options.solve
    at_once = solving.shutter_model == "global"
    around_s = 0.0 if options.gyro is None else options.gyro.offset_s

    def solve(keys: LoadedPhotos, kept: Kept | None = None, *, rotates: bool = False) -> Solved:
        cameras = keys.cameras
        readouts = {} if at_once else known_readouts(
            bodies, cameras.cameras, cameras.camera_idx, solving.readout_s, gyro_log
        )  # fmt: skip
        wanted = solving.options_for(cameras)
        with work_folder() as work:
            solved = solve_clip(
                clip, keys, frame_path(clip, readouts.get(0)), partial(of_registered, wanted, says=False), work, log,
                seed=solving.seed, matching=options.matching, gyroscope=gyro_log, gyro_offset_s=around_s, kept=kept,
                at_once=at_once, rotates=rotates,
            )  # fmt: skip
        registered = of_registered(wanted, solved.shared)  # which names what was left out
        cameras.check_plausible(solved.shared.cameras)
        for text in cameras.contradicted(solved.shared.cameras, registered):
            warnings.warn(text, RsUndistortWarning, stacklevel=3)
        lost = keys.unregistered(solved.shared.image_names)
        return replace(solved, unregistered=lost, camera_of=keys.camera_of, readouts=readouts)

    with _saying() as said:
        solved, notes = by_likeliest_lens(solve, clip, keys, said, kept)
        for note in notes:
            warnings.warn(note, RsUndistortWarning, stacklevel=3)
    return solved


def _with_gyroscope(
    options: SolveOptions, gyro: GyroOptions, log: GyroLog, loaded: LoadedPhotos, readouts: Readouts
) -> tuple[Known, SolveOptions]:
    """The motions by a gyroscope's log, of photos whose motion was not specified, and the options with them."""
    cameras = loaded.cameras
    times = [readouts[k][0] if k in readouts else None for k in cameras.camera_idx.tolist()]
    by_photo = dict(zip(loaded.names, times, strict=True))
    of_photo = {name: cameras.of(i) for i, name in enumerate(loaded.names)}
    motions, bends = gyro_motions(loaded.folder, gyro, log, by_photo, of_photo)
    found = {k: v for k, v in motions.items() if k not in options.known and k not in options.still}
    known_bends = {name: bends[name] for name in found} | dict(options.known_bends)
    return found, replace(options, known={**options.known, **found}, known_bends=known_bends)
