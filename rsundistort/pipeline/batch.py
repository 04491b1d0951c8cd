"""Rectification of a folder by a solution."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ..errors import InputError, MetadataWarning, RsUndistortWarning, SkippedPhotoWarning
from ..io import MAX_MEGAPIXELS, list_photos, output_folder, read_solution, write_solution
from ..model import Solution
from ..model.orientation import in_stored_frame, split_mirror, turn_solution
from ..rectify import ViewOptions
from .depth import PhotoDepths, ScenePoints, check_depth
from .extras import find_extras
from .progress import ProgressCallback, StageLog
from .run import use_threads
from .views import with_view
from .write import rectify_photos, turn_of

__all__ = ["rectify_folder"]


def rectify_folder(
    photos: Path | str,
    solution: Path | str,
    out: Path | str,
    *,
    interpolation: str = "cubic",
    quality: int = 98,
    jobs: int = 0,
    overwrite: bool = False,
    masks: Path | str | None = None,
    depth: str | Path = "auto",
    raw_as: str = "tif",
    apply_orientation: bool = False,
    again: bool = False,
    max_megapixels: float = MAX_MEGAPIXELS,
    view: ViewOptions | None = None,
    maps: str | None = None,
    also: Sequence[tuple[Path, str]] = (),
    progress: ProgressCallback | None = None,
) -> tuple[Solution, Sequence[str]]:
    """Rectify the photos of a folder with the motions of a solution, into `out/images` and `out/masks`.

    Parameters
    ----------
    photos, solution, out : path
        Folder of the raw photos; `solution.json` or a ground-truth file; folder for the outputs.
    interpolation, quality, jobs, overwrite, masks, depth, raw_as, again, max_megapixels, progress
        As in `run`. The points that depths are taken from are those of `sparse/` beside the solution.
    apply_orientation : bool
        Turn photos, masks and the cameras and poses of the solution by the photos' EXIF orientation. Mirrored photos
        are mirrored, and lose their pose: no camera takes a mirror image.
    view : ViewOptions, optional
        What the rectified photos show and how large they are; as the solution has it when left out.
    maps : {"npz", "exr", "stmap"}, optional
        Write each photo's remap grid and its inverse into `out/maps`, as `RemapGrid.save` does.
    also : sequence of (folder, interpolation)
        Folders of other images of the same frames (labels, depth, near infrared), of the photos' stems and sizes: they
        are rectified alike into `out/also`.

    Returns
    -------
    solution : Solution
        As copied to `out/solution.json`.
    left_out : sequence of str
        Photos of the folder that were not rectified; a warning says why.
    """
    photos, out = Path(photos), Path(out)
    check_depth(depth)
    solved = in_stored_frame(read_solution(Path(solution)))
    listed = list_photos(photos, raw_as)
    motions = {image.name for image in solved.registered}
    names = [name for name in listed if name in motions]
    if not names:
        raise InputError(f"{solution} has no motion for any photo of {photos}, such as {listed[0]}; is it theirs?")
    for name in listed:
        if name not in motions:
            warnings.warn(f"skipped: {name} has no motion in {solution}", SkippedPhotoWarning, stacklevel=2)
    extras = find_extras(maps, also, names)
    solved = with_view(solved, view or ViewOptions())
    depths = PhotoDepths(solved, depth, _points_beside(Path(solution), solved, depth))
    log = StageLog(progress)
    jobs = use_threads(jobs)
    # a photo without a pose may be mirrored
    unposed = replace(solved, images=[replace(image, R_cw=None, center_w=None) for image in solved.images])
    turns: dict[str, int] = {}
    with output_folder(out, overwrite=overwrite, apart_from=[photos, *(folder for folder, _ in also)]) as scratch:
        rectified = rectify_photos(
            photos, unposed, names, scratch,
            interpolation=interpolation, quality=quality, jobs=jobs, log=log, depths=depths,
            raw_as=raw_as, apply_orientation=apply_orientation, again=again, max_megapixels=max_megapixels,
            masks=None if masks is None else Path(masks), extras=extras,
        )  # fmt: skip
        for name, photo in rectified:
            turns[name] = turn_of(unposed.image(name), photo)[0]
        if not turns:
            raise InputError(f"none of the {len(names)} photos of {photos} could be rectified; see the warnings")
        solved = depths.noted(solved)
        if apply_orientation:
            solved = turn_solution(_without_mirrored_poses(solved, turns), turns)
        solved = replace(solved, options={**solved.options, "raw_as": raw_as})
        write_solution(scratch / "solution.json", replace(solved, stages=tuple(log.stages)))
    return solved, [name for name in listed if name not in turns]


def _points_beside(solution: Path, solved: Solution, depth: str | Path) -> ScenePoints | None:
    """The points of the COLMAP model that a run wrote beside its solution, where a camera moved."""
    moves = any(image.posed and image.motion is not None and image.motion.velocity.any() for image in solved.images)
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


def _without_mirrored_poses(solution: Solution, turns: Mapping[str, int]) -> Solution:
    images = []
    for image in solution.images:
        if image.posed and split_mirror(turns.get(image.name, 1))[1] != 1:
            text = (
                f"{image.name} is mirrored by its EXIF orientation and loses its pose: no camera takes a mirror image"
            )
            warnings.warn(text, MetadataWarning, stacklevel=3)
            image = replace(image, R_cw=None, center_w=None)
        images.append(image)
    return replace(solution, images=tuple(images))
