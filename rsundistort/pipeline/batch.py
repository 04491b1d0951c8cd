"""Rectification of a folder by a solution."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..errors import InputError, SkippedPhotoWarning
from ..io import list_photos, output_folder, read_solution, write_solution
from ..model import Solution
from .progress import ProgressCallback, StageLog
from .run import use_threads
from .write import rectify_photos

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
    progress: ProgressCallback | None = None,
) -> tuple[Solution, Sequence[str]]:
    """Rectify the photos of a folder with the motions of a solution, into `out/images` and `out/masks`.

    Parameters
    ----------
    photos, solution, out : path
        Folder of the raw photos; `solution.json` or a ground-truth file; folder for the outputs.
    interpolation, quality, jobs, overwrite, masks, progress
        As in `run`.

    Returns
    -------
    solution : Solution
        As copied to `out/solution.json`.
    left_out : sequence of str
        Photos of the folder that were not rectified; a warning says why.
    """
    photos, out = Path(photos), Path(out)
    solved = read_solution(Path(solution))
    listed = list_photos(photos)
    motions = {image.name for image in solved.registered}
    names = [name for name in listed if name in motions]
    if not names:
        raise InputError(f"{solution} has no motion for any photo of {photos}, such as {listed[0]}; is it theirs?")
    for name in listed:
        if name not in motions:
            warnings.warn(f"skipped: {name} has no motion in {solution}", SkippedPhotoWarning, stacklevel=2)
    log = StageLog(progress)
    jobs = use_threads(jobs)
    with output_folder(out, overwrite=overwrite, apart_from=[photos]) as scratch:
        written = [
            name
            for name, _ in rectify_photos(
                photos,
                solved,
                names,
                scratch,
                interpolation=interpolation,
                quality=quality,
                jobs=jobs,
                log=log,
                masks=None if masks is None else Path(masks),
            )
        ]
        if not written:
            raise InputError(f"none of the {len(names)} photos of {photos} could be rectified; see the warnings")
        write_solution(scratch / "solution.json", replace(solved, stages=tuple(log.stages)))
    return solved, [name for name in listed if name not in written]
