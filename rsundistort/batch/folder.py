"""Rectification of a folder by a solution."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import InputError, MetadataWarning, RsUndistortWarning, SkippedPhotoWarning
from ..io import list_photos, read_solution
from ..io.outputs import batch_folder, check_begins_or_goes_on
from ..io.places import Place, RemoteFolder, local_place, place_of, write_in
from ..io.record import Record
from ..io.solution_json import solution_to_bytes
from ..model import Solution
from ..model.checks import check_kind
from ..model.orientation import in_stored_frame, orient_solution, split_mirror
from .geometry import SceneGeometry, ScenePoints, with_depths
from .many_photos import rectify_photos
from .one_photo import PhotoDone
from .progress import ProgressCallback, StageLog
from .rectify_options import RectifyOptions
from .views import with_view
from .workers import Workers, use_threads

__all__ = ["photos_of", "rectify_folder"]

# What a run writes that describes its rectified photos to other programs.
_MODELS = ("sparse", "transforms.json")


def rectify_folder(
    photos: Path | str,
    solution: Path | str,
    out: Path | str,
    options: RectifyOptions | None = None,
    *,
    jobs: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    scheduler: str | None = None,
    progress: ProgressCallback | None = None,
    **named: Any,
) -> tuple[Solution, dict[str, str]]:
    """Rectify the photos of a folder with the motions of a solution, into `out/images` and `out/masks`.

    Outputs appear file by file, whole; what is there when the work is interrupted stays, and `resume` goes on with it.
    What is wrong with one photo does not stop the others.

    Parameters
    ----------
    photos, solution, out : path
        Folder of the raw photos; `solution.json` or a ground-truth file; folder for the outputs. Photos in sub-folders
        are those that the solution names as "sub/photo.jpg". `photos` and `out`, and the masks of the options, may be
        URLs that `fsspec` knows ("s3://bucket/folder").
    options : RectifyOptions, optional
        What is done to each photo. With `apply_orientation` mirrored photos are mirrored, and lose their pose: no
        camera takes a mirror image. The points that depths are taken from are those of `sparse/` beside the solution.
    jobs : int
        Threads; 0 for all cores.
    overwrite : bool
        Replace the outputs that are in `out`.
    resume : bool
        Go on with an earlier batch: photos whose outputs are whole, and made of the same photo with the same motion
        and options, are passed over; other outputs of that batch are made again or deleted.
    scheduler : str, optional
        Address of a Dask scheduler (tcp://host:8786) whose workers do the work, instead of threads. They see `photos`
        and `out` under the same absolute paths or URLs.
    progress : callable, optional
        Called as (stage, done, total).
    **named
        Fields of `RectifyOptions`, instead of or on top of `options`.

    Returns
    -------
    solution : Solution
        As copied to `out/solution.json`.
    left_out : dict of name to reason
        Photos of the folder that were not rectified; a warning says so, too.
    """
    if options is not None:
        check_kind(options, RectifyOptions, "options")
    check_begins_or_goes_on(overwrite, resume)
    options = replace(options or RectifyOptions(), **named)
    solution = local_place(solution)
    folder, target = place_of(photos), place_of(out)
    inputs = [folder, *map(place_of, options.inputs)]
    for place in (target, *inputs):
        if scheduler is not None and isinstance(place, RemoteFolder) and place.protocol == "memory":
            raise InputError(f"{place} is in the memory of this process, which the workers of a scheduler do not see")
    solved = in_stored_frame(read_solution(solution))
    names, left_out = _with_motion(folder, solved, solution, options.raw_as)
    solved = with_view(solved, options.view)
    scene = SceneGeometry(solved, options.depth, _points_beside(solution, solved, options.depth))
    workers = Workers(use_threads(jobs), scheduler)
    with batch_folder(target, overwrite=overwrite, resume=resume, apart_from=inputs) as journal:
        record = Record(target)
        # a solution of ours is brought up to date in its place
        record.check(["solution.json"], [] if _is_of(solution, target) else [solution], again=resume)
        _check_models(target, record, solution, solved, names, options)
        done = rectify_photos(
            folder, scene, names, target, options, workers, StageLog(progress), journal,
            posed=False, resume=resume,
        )  # fmt: skip
        left_out |= {name: each.problem for name, each in done.items() if each.problem}
        if all(each.problem for each in done.values()):
            raise InputError(f"none of the {len(names)} photos of {photos} could be rectified; see the warnings")
        solved = _as_rectified(solved, done, options)
        with record.writing(["solution.json"]):
            write_in(target, "solution.json", solution_to_bytes(solved))
    return solved, dict(sorted(left_out.items()))


def photos_of(folder: Place | str, solution: Solution, raw_as: str = "tif") -> list[str]:
    """Names of the photos in a folder, and in its sub-folders that the solution has motions of."""
    within = {PurePosixPath(image.name).parent.as_posix() for image in solution.registered}
    return list_photos(folder, raw_as, within - {"."})


def _with_motion(folder: Place, solved: Solution, solution: Path, raw_as: str) -> tuple[list[str], dict[str, str]]:
    """Photos of a folder that have a motion; and the others, with the reason why they are left out."""
    motions = {image.name for image in solved.registered}
    listed = photos_of(folder, solved, raw_as)
    if motions.isdisjoint(listed):
        raise InputError(f"{solution} has no motion for any photo of {folder}, such as {listed[0]}; is it theirs?")
    left_out = {name: f"it has no motion in {solution}" for name in listed if name not in motions}
    for name in left_out:
        warnings.warn(f"skipped: {name} has no motion in {solution}", SkippedPhotoWarning, stacklevel=3)
    return [name for name in listed if name in motions], left_out


def _as_rectified(solved: Solution, done: Mapping[str, PhotoDone], options: RectifyOptions) -> Solution:
    """The solution with what became of each photo."""
    solved = with_depths(solved, {name: each.depth for name, each in done.items() if each.depth is not None})
    images = [
        replace(image, reason=done[image.name].problem or None) if image.name in done else image
        for image in solved.images
    ]
    solved = replace(solved, images=tuple(images), options={**solved.options, "raw_as": options.raw_as})
    if options.apply_orientation:
        orientations = {name: each.orientation for name, each in done.items() if not each.problem}
        solved = orient_solution(_without_mirrored_poses(solved, orientations), orientations)
    return solved


def _check_models(
    target: Place, record: Record, solution: Path, solved: Solution, names: list[str], options: RectifyOptions
) -> None:
    """Refuse a folder whose models for other programs describe other rectified photos than these will be."""
    models = record.ours(_MODELS)
    if not models or not isinstance(target, Path) or not (target / "solution.json").is_file():
        return
    former = read_solution(target / "solution.json")
    were_rotated = any(image.applied_orientation != 1 for image in former.registered)
    were_raw_as = former.options.get("raw_as") or options.raw_as
    stored = in_stored_frame(former)
    is_same = (
        _is_of(solution, target)
        and (options.apply_orientation, options.raw_as) == (were_rotated, were_raw_as)
        and all(
            image.name in names
            and stored.rectified_cameras[image.camera_id] == solved.rectified_cameras[image.camera_id]
            for image in stored.registered
            if image.reason is None
        )
    )
    if not is_same:
        raise InputError(
            f"{target} holds {min(models)}, which describes the photos that were rectified there; give another folder "
            "for others, or repeat the run with these options"
        )


def _is_of(solution: Path, target: Place) -> bool:
    """Whether a solution is the one in a folder of outputs."""
    return (
        isinstance(target, Path)
        and (target / "solution.json").is_file()
        and solution.samefile(target / "solution.json")
    )


def _points_beside(solution: Path, solved: Solution, depth: str | Path) -> ScenePoints | None:
    """The points of the COLMAP model that a run wrote beside its solution, where a camera moved."""
    moves = any(image.posed and image.motion is not None and image.motion.moves for image in solved.images)
    if solved.shutter_model != "constant-motion" or not moves or str(depth) == "infinity":
        return None
    folder = solution.parent / "sparse"
    if folder.is_dir():
        names = [image.name for image in solved.registered]
        return ScenePoints.of_colmap_model(folder, names, solved.options.get("raw_as") or "tif")
    text = f"{folder} is missing, and with it the points of the scene"
    if str(depth) in ("plane", "points"):
        raise InputError(f"{text}; depth {depth} needs them")
    if str(depth) == "auto":
        text += ": photos are rectified as if all were far away, which leaves the effect of the translation in them"
        warnings.warn(text, RsUndistortWarning, stacklevel=3)
    return None


def _without_mirrored_poses(solution: Solution, orientations: Mapping[str, int]) -> Solution:
    images = []
    for image in solution.images:
        if image.posed and split_mirror(orientations.get(image.name, 1))[1] != 1:
            text = (
                f"{image.name} is mirrored by its EXIF orientation and loses its pose: no camera takes a mirror image"
            )
            warnings.warn(text, MetadataWarning, stacklevel=3)
            image = replace(image, R_cw=None, center_w=None)
        images.append(image)
    return replace(solution, images=tuple(images))
