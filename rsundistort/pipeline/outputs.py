"""The outputs of a reconstruction: models for other programs, rectified photos, and the solution."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, RsUndistortWarning
from ..io import output_folder, output_name, write_colmap_model, write_solution, write_transforms
from ..io.colmap import ModelIds
from ..io.journal import Journal
from ..io.outputs import batch_folder
from ..model import Reconstruction, Solution
from ..model.orientation import turn_reconstruction, turn_solution
from ..report import Diagnostics, relative_folder, write_diagnostics, write_report
from .depth import PhotoDepths, ScenePoints, with_depths
from .ladder import Solved
from .options import SolveOptions
from .outcome import Outcome, solution_of
from .photo import turn_of
from .progress import StageLog
from .views import with_view
from .workers import Workers
from .write import PointColors, mask_names, rectify_photos

__all__ = ["Outputs"]


@dataclass(frozen=True)
class PointRgb:
    """Colours of points that are known beforehand.

    Attributes
    ----------
    values : (n, 3) uint8 array
        Red, green, blue.
    known : (n,) bool array
        Of which points; the photos tell the others.
    """

    values: NDArray[np.uint8]
    known: NDArray[np.bool_]


@dataclass(frozen=True)
class Outputs:
    """What is written of a reconstruction, before the photos are rectified and after.

    Attributes
    ----------
    solution : Solution
        In the stored frame, with the rectified cameras that were asked for.
    solved : Solved
        Poses, motions, points and measurements, and those of a global shutter.
    options : SolveOptions
        How the outputs are to be.
    ids : ModelIds
        By which the COLMAP model calls its parts.
    turns : mapping of name to int
        EXIF orientations that are applied.
    rgb : PointRgb or None
        Colours of points; None where the photos tell them all.
    with_photos : bool
        Whether there are photos to rectify.
    """

    solution: Solution
    solved: Solved
    options: SolveOptions
    ids: ModelIds
    turns: Mapping[str, int]
    rgb: PointRgb | None = None
    with_photos: bool = True

    @classmethod
    def of_outcome(
        cls,
        outcome: Outcome,
        options: SolveOptions,
        orientations: Mapping[str, int],
        ids: ModelIds | None = None,
        rgb: PointRgb | None = None,
        with_photos: bool = True,
    ) -> Outputs:
        """Outputs of an outcome, whose photos have these EXIF orientations."""
        rec = outcome.reconstruction
        solution = with_view(solution_of(outcome, options), options.view)
        turns: dict[str, int] = {}
        if options.apply_orientation:
            turns = {name: turn_of(orientations.get(name, 1), True)[0] for name in rec.image_names}
        return cls(solution, outcome.solved, options, ids or ModelIds.in_order(rec), turns, rgb, with_photos)

    @property
    def reconstruction(self) -> Reconstruction:
        """Poses, motions, points and measurements."""
        return self.solved.result.reconstruction

    @cached_property
    def _diagnostics(self) -> Diagnostics:
        return Diagnostics.of_results(self.solved.result, self.solved.global_result, self.ids.cameras)

    def begin(self, folder: Path, log: StageLog) -> Solution:
        """Write all but the photos and the colours that they tell, so that what comes after can be gone on with."""
        if self.with_photos:
            for name in ("images", "masks"):
                (folder / name).mkdir()
            Journal(folder).write(())
        rgb = None if self.rgb is None else self.rgb.values
        turned = replace(self._models(folder, self.solution, {}, rgb), stages=tuple(log.stages))
        write_solution(folder / "solution.json", turned)
        with _only_warned_of():
            write_diagnostics(folder / "report.npz", self._diagnostics.with_colors(rgb))
        return turned

    def report(self, out: Path, log: StageLog, photos: Path | None = None) -> None:
        """Write the report of what is in `out`, if it is asked for; a failure is no more than warned of."""
        if not self.options.report:
            return
        try:
            with _only_warned_of():
                write_report(out, photos, jobs=self.options.jobs, progress=log.tell)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(f"all but the report is written; go on with: rsundistort report {out}") from stop

    def rectify(self, photos: Path, out: Path, workers: Workers, log: StageLog) -> Solution:
        """Rectify the photos of a folder into `out`, which `begin` has filled, and write the rest again."""
        solution, rec, options = self.solution, self.reconstruction, self.options
        colors = None if self.rgb is not None and self.rgb.known.all() else PointColors(rec)
        depths = PhotoDepths(solution, options.depth, ScenePoints.of_reconstruction(rec))
        go_on = f"whole; go on with: rsundistort rectify {photos} --solution {out / 'solution.json'} -o {out} --resume"
        with batch_folder(out, overwrite=True) as journal:
            done = rectify_photos(
                photos, solution, list(rec.image_names), out, options.rectify_options(), depths, workers, log, journal,
                colors=colors, go_on=go_on,
            )  # fmt: skip
        log.begin("writing")
        left_out = {name: each.problem for name, each in done.items() if each.problem}
        if len(left_out) == len(done):
            raise InputError(f"none of the {len(done)} photos of {photos} could be rectified; see the warnings")
        images = [replace(image, reason=left_out.get(image.name, image.reason)) for image in solution.images]
        found = {name: each.depth for name, each in done.items() if each.depth is not None}
        solution = with_depths(replace(solution, images=tuple(images)), found)
        with output_folder(out, overwrite=True) as scratch:
            rgb = self._rgb(colors)
            turned = self._models(scratch, solution, left_out, rgb)
            with _only_warned_of():
                told = replace(self._diagnostics.with_colors(rgb), photos=relative_folder(photos, out))
                write_diagnostics(scratch / "report.npz", told)
            log.end("writing")
            turned = replace(turned, stages=tuple(log.stages))
            write_solution(scratch / "solution.json", turned)
        if not left_out:
            journal.path.unlink()  # nothing to go on with
        self.report(out, log, photos)
        return turned

    def _rgb(self, colors: PointColors | None) -> NDArray[np.uint8] | None:
        """Colours as the photos tell them, where they were not known."""
        told = None if colors is None else colors.rgb()
        if self.rgb is None or told is None:
            return told if self.rgb is None else self.rgb.values
        return np.where(self.rgb.known[:, None], self.rgb.values, told)

    def _models(
        self, folder: Path, solution: Solution, left_out: Mapping[str, str], rgb: NDArray[np.uint8] | None
    ) -> Solution:
        """Write the models for other programs; returns the solution as they have it, turned."""
        rec, raw_as = self.reconstruction, self.options.raw_as
        if self.turns:
            solution, rec = turn_solution(solution, self.turns), turn_reconstruction(rec, self.turns)
        names = [None if name in left_out else output_name(name, raw_as) for name in rec.image_names]
        new_cameras = [solution.rectified_cameras[str(key)] for key in self.ids.cameras]
        write_colmap_model(folder / "sparse", rec, new_cameras, names, rgb, self.ids)
        masks = mask_names([image.name for image in solution.images])
        files = {
            name: (f"images/{written}", f"masks/{masks[name]}")
            for name, written in zip(rec.image_names, names, strict=True)
            if written is not None
        }
        write_transforms(folder / "transforms.json", solution, files)
        return solution


@contextmanager
def _only_warned_of() -> Iterator[None]:
    """Trouble with the report loses no run."""
    try:
        yield
    except Exception as error:
        said = " ".join(str(error).split()) or type(error).__name__
        warnings.warn(f"no report was written: {said}", RsUndistortWarning, stacklevel=4)
