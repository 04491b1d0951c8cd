"""The paper's Experiment II: photos of a scene taken still, and taken again while the camera moved."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..batch.progress import ProgressCallback
from ..errors import InputError, ReconstructionError
from ..input.photo_cameras import camera_file_of
from ..io import list_photos, output_folder
from ..io.record import Record
from ..model import Solution, check_shutter_model
from ..model.array_types import Array
from ..report.figures import need_matplotlib
from ..solve import RunOptions, SolveOptions, run
from ..solve.run_outputs import files_of_run
from ..versions import versions
from .paths import PathComparison, compare_paths
from .plots import camera_paths

__all__ = ["TwoOptions", "experiment_two"]

# folders of the three runs
_STILL, _WITH, _WITHOUT = "still", "swung", "swung-global"


@dataclass(frozen=True)
class TwoOptions:
    """Options of `experiment_two`.

    Parameters
    ----------
    camera, readout : str, optional
        Of both folders, as `RunOptions` has them.
    shutter_model : str
        Of the photos that were taken in motion: any of `RunOptions` but "global", with which it is compared.
    seed, jobs : int
        As `RunOptions` has them.
    overwrite : bool
        Replace the outputs of an earlier run.
    """

    camera: str | None = None
    readout: str | None = None
    shutter_model: str = "auto"
    seed: int = 0
    jobs: int = 0
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.shutter_model == "global":
            raise InputError("shutter_model='global' is what the others are compared with; give another")
        if self.shutter_model != "auto":
            check_shutter_model(self.shutter_model)
        if self.jobs < 0:
            raise InputError(f"jobs={self.jobs}, expected 0 or more")


def check_same_names(still: Path, swung: Path) -> list[str]:
    """The names of the photos that both folders hold; refuses folders that differ in them, or are one."""
    if still.resolve() == swung.resolve():
        raise InputError(f"{still} is given twice; give one folder taken still and one taken in motion")
    here, there = list_photos(still), list_photos(swung)
    for lone, folder, other in ((set(here) - set(there), still, swung), (set(there) - set(here), swung, still)):
        if lone:
            more = f" and {len(lone) - 1} more" if len(lone) > 1 else ""
            raise InputError(
                f"{folder} has {min(lone)}{more}, which {other} has not; "
                "photos taken from one place need the same name in both folders"
            )
    return here


def experiment_two(
    still: Path | str,
    swung: Path | str,
    out: Path | str,
    options: TwoOptions | None = None,
    progress: ProgressCallback | None = None,
) -> dict[str, Any]:
    """Camera paths of photos taken in motion, with and without a shutter model, against the same photos taken still.

    Writes `still/`, `swung/` and `swung-global/` (outputs of `run`), `summary.json`, `photos.csv` and `paths.png`.

    Parameters
    ----------
    still, swung : path
        Folders of photos with the same names, each pair taken from one place by one camera.
    out : path
        Folder for the outputs; it gets all of them or stays as it was.

    Returns
    -------
    dict
        As in `summary.json`.

    Raises
    ------
    InputError, ReconstructionError
        When the names differ, or fewer than three photos are registered in all three reconstructions.
    """
    options = options or TwoOptions()
    still, swung, out = Path(still), Path(swung), Path(out)
    # before the minutes of work, not after them
    need_matplotlib()
    names = check_same_names(still, swung)
    solving = SolveOptions(readout=options.readout, seed=options.seed)
    common = RunOptions(solve=solving, camera=options.camera)
    solutions: dict[str, Solution] = {}
    camera_files = [file for each in (still, swung) if (file := camera_file_of(each, options.camera)) is not None]
    inputs, folders = [still, swung, *camera_files], (_STILL, _WITH, _WITHOUT)
    with output_folder(out, overwrite=options.overwrite, apart_from=inputs, replaced=folders) as scratch:
        files = files_of_run(names, common.rectify.raw_as, common.outputs)
        made = ["summary.json", "photos.csv", "paths.png", *(f"{key}/{file}" for key in folders for file in files)]
        Record(out).check(made, inputs)
        for key, photos, model in (
            (_STILL, still, "global"),
            (_WITH, swung, options.shutter_model),
            (_WITHOUT, swung, "global"),
        ):
            each = replace(common, solve=replace(solving, shutter_model=model))
            within = None if progress is None else _within(progress, key)
            try:
                solutions[key] = run(photos, scratch / key, each, within, jobs=options.jobs)
            except ReconstructionError as error:
                raise ReconstructionError(f"{photos}: {error}") from error
        found = compare_paths(solutions[_STILL], solutions[_WITH], solutions[_WITHOUT])
        summary = _summary(names, solutions, found, options)
        (scratch / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
        _write_csv(scratch / "photos.csv", names, solutions, found)
        camera_paths(found, solutions[_WITH].shutter_model, scratch / "paths.png")
    return summary


def _within(progress: ProgressCallback, key: str) -> ProgressCallback:
    """Progress of one of the three runs."""
    return lambda stage, done, total: progress(f"{key}: {stage}", done, total)


def _spread(values: Array) -> dict[str, float]:
    return {"mean": float(np.mean(values)), "median": float(np.median(values)), "max": float(np.max(values))}


def _summary(
    names: Sequence[str], solutions: Mapping[str, Solution], found: PathComparison, options: TwoOptions
) -> dict[str, Any]:
    return {
        "photos": len(names),
        "registered": {key: len(solution.registered) for key, solution in solutions.items()},
        "not_registered": {
            key: {image.name: image.reason for image in solution.images if not image.registered}
            for key, solution in solutions.items()
        },
        "compared": len(found.names),
        "shutter_model": solutions[_WITH].shutter_model,
        **{
            f"{key}_shutter_model": {
                "position": _spread(found.position[key]),
                "rotation_deg": _spread(found.rotation_deg[key]),
            }
            for key in ("with", "without")
        },
        "rms_px": {key: solution.quality.get("rms_px") for key, solution in solutions.items()},
        "cameras": {key: solution.options.get("camera") for key, solution in solutions.items()},
        "options": {"shutter_model": options.shutter_model, "seed": options.seed},
        "generator": versions(),
    }


def _write_csv(path: Path, names: Sequence[str], solutions: Mapping[str, Solution], found: PathComparison) -> None:
    """A line for each photo; errors are empty where it was not registered in all three reconstructions."""
    place = {name: k for k, name in enumerate(found.names)}
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        errors = {
            f"{what}_{key}": values
            for what, by_key in (("position", found.position), ("rotation_deg", found.rotation_deg))
            for key, values in by_key.items()
        }
        writer.writerow(["photo", *(f"registered_{key}" for key in solutions), *errors])
        for name in names:
            k = place.get(name)
            writer.writerow(
                [
                    name,
                    *(int(solution.image(name).registered) for solution in solutions.values()),
                    *("" if k is None else f"{values[k]:.6g}" for values in errors.values()),
                ]
            )
