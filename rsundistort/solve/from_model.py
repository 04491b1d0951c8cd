"""The same job from a model of COLMAP or others: tracks in; motions, rectified photos, an unwarped model out."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from ..batch.progress import ProgressCallback, StageLog
from ..batch.rectify_options import RectifyOptions
from ..batch.workers import Workers, use_threads
from ..colmap.conventions import kept_log_level
from ..colmap.measured_model import ColmapModel, colmap_model_of, surviving_points
from ..colmap.rectified_model import ModelIds, colmap_model
from ..errors import FileError, InputError, ReconstructionError, RsUndistortWarning
from ..input.gyroscope import known_readouts
from ..input.photo_cameras import PhotoCameras, check_readouts
from ..io import ExifFacts, guess_readouts, list_photos, output_folder, output_name, read_exif, read_solution
from ..io.metashape import is_metashape
from ..io.models import read_model
from ..io.outputs import work_folder
from ..io.photos.images import stored_size
from ..io.places import local_place
from ..io.record import Record, is_inside
from ..model import Reconstruction, Solution
from ..model.orientation import INVERSE, orient_reconstruction
from ..sfm import matched_of_database
from .from_poses import measured, posed_photos, shutter_terms
from .going_on import RunFolder, key_of, run_folder
from .known_contradiction import known_contradiction
from .model_frame import in_frame_of
from .model_sequence import solve_tracks
from .outcome import Solved
from .run_options import OutputOptions, SolveOptions
from .run_outputs import (
    REPLACED,
    Outputs,
    PointRgb,
    check_images_of,
    check_usd,
    files_of_run,
    inputs_of,
    photo_times,
    remove_former,
)
from .survey import clocks_of, survey_of
from .tracks import TrackSource

if TYPE_CHECKING:
    import pycolmap

__all__ = ["solve"]

# Keypoints of other programs have heavier tails than ours: at 4.5 deviations 5 % of the measurements of the warped
# herz-jesus-8 are lost and the poses are off by 0.017 deg, at this by 0.013, with 2 % more.
_OUTLIER_SIGMA = 6.0


@overload
def solve(
    model: Path | str,
    out: Path | str,
    options: SolveOptions | None = None,
    *,
    rectify: RectifyOptions | None = None,
    outputs: OutputOptions | None = None,
    images: Path | str | None = None,
    database: Path | str | None = None,
    jobs: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    scheduler: str | None = None,
    progress: ProgressCallback | None = None,
) -> Solution: ...


@overload
def solve(
    model: pycolmap.Reconstruction,
    out: None = None,
    options: SolveOptions | None = None,
    *,
    rectify: RectifyOptions | None = None,
    database: Path | str | None = None,
    progress: ProgressCallback | None = None,
) -> tuple[pycolmap.Reconstruction, Solution]: ...


def solve(
    model: Path | str | pycolmap.Reconstruction,
    out: Path | str | None = None,
    options: SolveOptions | None = None,
    *,
    rectify: RectifyOptions | None = None,
    outputs: OutputOptions | None = None,
    images: Path | str | None = None,
    database: Path | str | None = None,
    jobs: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    scheduler: str | None = None,
    progress: ProgressCallback | None = None,
) -> Solution | tuple[pycolmap.Reconstruction, Solution]:
    """Estimate the camera's motion during each photo's readout from a model of another program.

    From files it writes what `run` writes. From a `pycolmap.Reconstruction` it writes nothing, changes nothing global,
    and several threads may each solve one.

    Parameters
    ----------
    model : path or pycolmap.Reconstruction
        Folder of a COLMAP model, text or binary; or `sfm_data.json` of OpenMVG, or `reconstruction.json` of OpenSfM
        with `tracks.csv` beside it; or `cameras.xml` of Metashape, for which `images` are measured. A
        `pycolmap.Reconstruction` stays as it is; its keypoints must be pixels of the photos as the sensor stored them.
    out : path
        Folder for the outputs, as of `run`; for a model in files.
    options : SolveOptions, optional
        See there. Groups are cameras of the model: "camera 1".
    rectify, outputs : RectifyOptions, OutputOptions, optional
        As in `RunOptions`; of a `pycolmap.Reconstruction` `rectify.view` and `rectify.raw_as` alone count.
    images : path, optional
        Folder of the photos that the model names; for a model in files. Without it none are rectified.
    database : path, optional
        COLMAP's database behind the model: the matches in it are verified again with the motions found, and the tracks
        rebuilt.
    jobs, overwrite, scheduler
        As in `rectify_folder`, for a model in files.
    resume : bool
        As in `run`, for a model in files.
    progress : callable, optional
        Called as (stage, done, total). What it raises stops the work.

    Returns
    -------
    rectified : pycolmap.Reconstruction
        Of a `pycolmap.Reconstruction` only: poses, points and tracks without shutter, in PINHOLE cameras; the model of
        the rectified photos.
    solution : Solution
        The motions; of a model in files as written to `out/solution.json`.

    Raises
    ------
    InputError
        `out` is missing for a model in files, or given for a `pycolmap.Reconstruction`.
    """
    if isinstance(out, SolveOptions):  # until the next version: they were the second argument
        warnings.warn("solve takes options by name: solve(model, options=...)", DeprecationWarning, stacklevel=2)
        out, options = None, out
    options, rectify = options or SolveOptions(), rectify or RectifyOptions()
    if isinstance(model, str | Path):
        if out is None:
            raise InputError(f"solve: out is missing; say which folder gets the outputs of {model}")
        workers, outputs = Workers(use_threads(jobs), scheduler), outputs or OutputOptions()
        check_usd(outputs, is_clip=False)
        folder = None if images is None else local_place(images)
        if folder is None and (rectify.maps is not None or rectify.also or rectify.masks is not None):
            raise InputError("solve: maps, masks and other images are of rectified photos; give images, too")
        job = _Job(local_place(model), local_place(out), folder, database, options, rectify, outputs, workers)
        return _solve_files(job, overwrite, resume, progress)
    if not hasattr(model, "reg_image_ids"):
        kind = f"{type(model).__module__}.{type(model).__name__}"
        raise InputError(f"solve: model is a {kind}, expected a folder, a file or a pycolmap.Reconstruction")
    if not (out is images is outputs is None):
        raise InputError("solve: out and images are for a model in files; write what is returned, or give the folder")
    return _solve_in_memory(model, options, rectify, database, progress)


@dataclass(frozen=True)
class _Job:
    """Arguments of `solve` of a model in files."""

    model: Path
    out: Path
    images: Path | None
    database: Path | str | None
    options: SolveOptions
    rectify: RectifyOptions
    outputs: OutputOptions
    workers: Workers

    @property
    def inputs(self) -> list[Path]:
        """Files and folders that are read."""
        return inputs_of(self.rectify, self.model, self.images, self.database)

    def check_names(self, names: Sequence[str]) -> None:
        """Refuse photos to rectify, before any of them is read, where their outputs would replace other files.

        So are folders of other images or depth maps that hold none of them.
        """
        check_images_of(names, self.rectify)
        Record(self.out).check(files_of_run(names, self.rectify.raw_as, self.outputs), self.inputs)


def _solve_files(job: _Job, overwrite: bool, resume: bool, progress: ProgressCallback | None) -> Solution:
    """Solve a model in files, and write files."""
    model, out = job.model, job.out
    if job.database is not None and model.is_file():
        raise InputError(f"{model} is no COLMAP model, and --database is COLMAP's; leave it out")
    log = StageLog(progress)
    key = key_of([*job.inputs, *_parts_of(job)], job.options, job.rectify, job.outputs)
    with run_folder(out, key, log, overwrite=overwrite, resume=resume) as before:
        if before.finished:
            return read_solution(out / "solution.json")
        if before.begun:
            written: Outputs = before.outputs(log)
        else:
            again = overwrite or before.goes_on
            with output_folder(out, overwrite=again, apart_from=job.inputs, replaced=REPLACED) as scratch:
                written = _outputs_of(job, log, before)
                solution = written.begin(scratch, log)
            before.begin()
        remove_former(out, job.outputs)
        if job.images is not None:
            return written.rectify(job.images, out, job.workers, log, before.begun)
        written.report(out, job.workers.jobs, log)
        return read_solution(out / "solution.json") if before.begun else solution


def _parts_of(job: _Job) -> list[Path]:
    """Files and folders in and beside a job's inputs that are read, too."""
    model = job.model
    found = [model / "sparse", model.parent / "tracks.csv"]
    if model.suffix.lower() == ".opf":  # it names the files of the project
        found.append(model.parent)
    if job.images is not None:  # names may be "left/a.jpg"
        found += sorted(each for each in job.images.rglob("*") if each.is_dir() and not is_inside(each, job.out))
    return found


def _outputs_of(job: _Job, log: StageLog, before: RunFolder) -> Outputs:
    """The outputs of a model, unless they were kept."""
    before.kept.begin()
    found: Outputs | None = before.outputs(log)
    if found is not None:
        return found
    folder = job.images
    with work_folder() as work:
        log.begin("model")
        given, track_source, kept = _given(job, work, log)
        photos = {} if folder is None else _look_at(folder, job.model, given.reconstruction, job.rectify.again)
        given, said = _in_stored_frame(given, photos)
        if folder is not None:
            given = replace(given, unregistered=_others_in(folder, given, job.rectify.raw_as))
        log.end("model", photos=given.reconstruction.num_images, points=given.reconstruction.num_points)
        facts = {name: fact for name, (_, fact) in photos.items()}
        solved, ids, rgb = _solve(given, str(job.model), facts, job.options, job.database, log, track_source)
        facts_of_model = {
            "frame": said,
            "points": given.reconstruction.num_points,
            "observations": len(given.reconstruction.observations),
            **kept,
        }
        solved = replace(solved, facts={"model": facts_of_model})
        orientations = {name: fact.orientation or 1 for name, fact in facts.items()}
        times = {} if folder is None else photo_times(folder)
        written = Outputs.of_solved(
            solved, job.options, job.rectify, job.outputs, orientations, ids, rgb, folder is not None, times
        )
    before.solved(written, log)
    return written


def _given(job: _Job, work: Path, log: StageLog) -> tuple[ColmapModel, TrackSource | None, Mapping[str, Any]]:
    """The model, what new tracks can be made from, and what the solution keeps of the file.

    One without measurements is measured in its photos.
    """
    if is_metashape(job.model):
        posed = posed_photos(job.model, job.images, job.rectify.raw_as)
        assert job.images is not None
        job.check_names(posed.labels)
        kept = {"rolling_shutter": shutter_terms(posed)} if posed.shutter else {}
        return *measured(posed, job.images, job.rectify, job.options.seed, job.workers, work, log), kept
    given = read_model(job.model)
    job.check_names([] if job.images is None else given.reconstruction.image_names)
    return given, None, {}


def _solve_in_memory(
    reconstruction: pycolmap.Reconstruction,
    options: SolveOptions,
    rectify: RectifyOptions,
    database: Path | str | None,
    progress: ProgressCallback | None,
) -> tuple[pycolmap.Reconstruction, Solution]:
    """Solve a `pycolmap.Reconstruction`, and return another one."""
    log = StageLog(progress)
    given = colmap_model_of(reconstruction)
    with kept_log_level():
        solved, ids, rgb = _solve(given, "the model", {}, options, database, log)
    outputs = Outputs.of_solved(solved, options, rectify, OutputOptions(), {}, ids, rgb)
    rec, solution = outputs.reconstruction, outputs.solution
    names = [output_name(name, rectify.raw_as) for name in rec.image_names]
    cameras = [solution.rectified_cameras[str(key)] for key in ids.cameras]
    return colmap_model(rec, cameras, names, rgb.values, ids), replace(solution, stages=tuple(log.stages))


def _look_at(
    folder: Path, model: Path, rec: Reconstruction, again: bool
) -> dict[str, tuple[tuple[int, int] | None, ExifFacts]]:
    """Size and EXIF facts of each photo of a model."""
    missing = [name for name in rec.image_names if not (folder / name).is_file()]
    if missing:
        raise InputError(
            f"{folder} lacks {len(missing)} of {rec.num_images} photos of the model, such as {missing[0]}; "
            "give the folder that the model was made from"
        )
    found = {name: (stored_size(folder / name), read_exif(folder / name)) for name in rec.image_names}
    by = [facts.rectified_by for _, facts in found.values()]
    if by and all(by) and not again:
        raise InputError(f"{folder}: all photos were rectified already, by rsundistort {by[0]}; give the raw ones")
    ours = model.parent
    if model.name == "sparse" and not all(by) and (ours / Record.NAME).is_file() and (ours / "solution.json").is_file():
        raise InputError(
            f"{model} shows the rectified photos of {ours}, not those in {folder}; `rsundistort rectify {folder} "
            f"--solution {ours / 'solution.json'} -o OUT` rectifies these with the motions that were found"
        )
    return found


def _others_in(folder: Path, given: ColmapModel, raw_as: str) -> list[str]:
    """Photos beside those of a model, which it did not register: its files do not name them."""
    names = given.reconstruction.image_names
    try:
        listed = list_photos(folder, raw_as, {PurePosixPath(name).parent.as_posix() for name in names} - {"."})
    except (FileError, InputError):  # errors of others do not matter here
        listed = []
    return sorted({*listed, *given.unregistered} - set(names))


def _in_stored_frame(
    given: ColmapModel, photos: Mapping[str, tuple[tuple[int, int] | None, ExifFacts]]
) -> tuple[ColmapModel, str]:
    """The model in the frames of the stored photos, and a remark on that, for people.

    Some programs rotate photos by their EXIF orientation before they measure them: the sizes show it.
    """
    rec = given.reconstruction
    applied: dict[str, int] = {}
    unsure = []
    for i, name in enumerate(rec.image_names):
        size, facts = photos.get(name, (None, ExifFacts()))
        if size is None:
            continue
        camera, orientation = rec.camera(i), facts.orientation or 1
        if (camera.width, camera.height) == size:
            if orientation in (2, 3, 4) or (orientation > 4 and camera.width == camera.height):
                unsure.append(name)
        elif (camera.height, camera.width) == size and orientation > 4:
            applied[name] = INVERSE[orientation]
        else:
            raise InputError(
                f"{name} has {size[0]}x{size[1]} pixels, its camera in the model {camera.width}x{camera.height}; "
                "give the photos that the model was made from"
            )
    if unsure:
        warnings.warn(
            f"{len(unsure)} photos, such as {unsure[0]}, have an EXIF orientation that keeps their size: the model is "
            "taken to show them as they are stored", RsUndistortWarning, stacklevel=4,
        )  # fmt: skip
    if not applied:
        return given, "stored" if photos else "not looked at"
    said = f"rotated by the EXIF orientation in {len(applied)} of {rec.num_images} photos"
    stored = orient_reconstruction(rec, applied)
    ids = list(given.camera_ids)
    free = (k for k in range(1, 2 + max(ids) + len(stored.cameras)) if k not in ids)
    ids += [next(free) for _ in range(len(stored.cameras) - len(ids))]
    return replace(given, reconstruction=stored, camera_ids=np.array(ids, np.int64)), said


def _photo_cameras(
    given: ColmapModel, source: str, exif: Sequence[ExifFacts], sizes: Sequence[tuple[int, int]], options: SolveOptions
) -> PhotoCameras:
    """The model's cameras, with the readout directions that were specified or are guessed."""
    rec = given.reconstruction
    labels = [f"camera {key}" for key in given.camera_ids]
    specified = check_readouts(options.readout)
    unknown = sorted(specified.keys() - {"", *labels})
    if unknown:
        raise InputError(f"readout of {unknown[0]!r}: no such camera, there are {', '.join(labels)}")
    of_photo = [labels[k] for k in rec.camera_idx.tolist()]
    guessed, notes = guess_readouts(exif, sizes, of_photo)
    cameras = []
    for label, camera in zip(labels, rec.cameras, strict=True):
        direction = specified.get(label, specified.get("", guessed.get(label, camera.readout)))
        cameras.append(replace(camera, readout=direction))
    return PhotoCameras(
        tuple(cameras),
        tuple(labels),
        rec.camera_idx,
        calibrated=not given.self_calibrated,
        readout_specified=tuple(label in specified or "" in specified for label in labels),
        source=f"{source}, refined" if given.self_calibrated else source,
        notes=() if specified else tuple(notes),
    )


def _solve(
    given: ColmapModel,
    source: str,
    facts: Mapping[str, ExifFacts],
    options: SolveOptions,
    database: Path | str | None,
    log: StageLog,
    track_source: TrackSource | None = None,
) -> tuple[Solved, ModelIds, PointRgb]:
    if given.reconstruction.num_images < 3:
        raise ReconstructionError(
            f"the model holds {given.reconstruction.num_images} registered photos, the shutter needs three"
        )
    rec = given.reconstruction
    sizes = [(rec.camera(i).width, rec.camera(i).height) for i in range(rec.num_images)]
    exif = [facts.get(name, ExifFacts()) for name in rec.image_names]
    cameras = _photo_cameras(given, source, exif, sizes, options)
    rec = replace(rec, cameras=cameras.cameras)
    for name in (*options.still, *options.known):
        if name not in rec.image_names:
            raise InputError(f"constraint on {name!r}, which is not among the photos of the model")
    for name in (end[0] for each in options.lengths for end in (each.start, each.end)):
        if name not in rec.image_names and name not in given.unregistered:
            raise InputError(f"known length in {name!r}, which is not among the photos of the model")

    readouts, survey = known_readouts(exif, rec.cameras, rec.camera_idx, options.readout_s, None), None
    if options.crs is not None or options.control:  # else its frame is the model's
        clock_s = clocks_of(rec.image_names, rec.camera_idx, readouts, cameras)
        survey = survey_of(options.crs, options.control, rec.image_names, exif, sizes, clock_s)

    fitting = replace(options.options_for(cameras), outlier_sigma=_OUTLIER_SIGMA)
    with work_folder() as work:
        if database is not None:
            log.begin("database")
            matched = matched_of_database(Path(database), work / "database.db", rec, options.seed)
            log.end("database", keypoints=sum(len(found.xy_raw) for found in matched.features))
            track_source = TrackSource(matched)
        solved = solve_tracks(
            rec, cameras, options.shutter_model, options.seed, lambda _: fitting, log, options.remedy, track_source,
            survey,
        )  # fmt: skip
    if solved.survey is None:
        solved = replace(in_frame_of(solved, given.reconstruction), georeference=given.georeference)
    after = solved.shared
    contradictions = [
        known_contradiction(after, {}, options.known, solved.known_motions),
        *cameras.contradicted(after.cameras, fitting),
    ]
    for text in filter(None, contradictions):
        warnings.warn(text, RsUndistortWarning, stacklevel=4)
    lost = dict.fromkeys(given.unregistered, "it is not registered in the model")
    lost |= dict.fromkeys(set(rec.image_names) - set(after.image_names), "no measurement of it survived")
    old = surviving_points(given.reconstruction, after)
    ids = given.ids_of(old, after.image_names)
    known = (old >= 0) & given.has_colors
    rgb = PointRgb(np.where(known[:, None], given.colors[old], 0).astype(np.uint8), known)
    camera_of = {**given.camera_of, **dict(zip(rec.image_names, rec.camera_idx.tolist(), strict=True))}
    solved = replace(solved, shared_ids=ids.cameras, unregistered=lost, camera_of=camera_of, readouts=readouts)
    return solved, ids, rgb
