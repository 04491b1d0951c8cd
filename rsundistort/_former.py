"""Names that moved, and where each is now. They work in this version and go with the next."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from .bundle import MODEL_SEQUENCE, BundleOptions, BundleResult, adjust_sequence
from .model import Reconstruction
from .rectify import RemapGrid
from .solve import solve

__all__ = ["FORMER_NAMES", "by_former_name"]

#: Former name and the present one, both below `rsundistort`.
FORMER_NAMES = {
    "BundleResult": "bundle.BundleResult",
    "CriticalMotion": "critical.CriticalMotion",
    "FileError": "errors.FileError",
    "FileKindWarning": "errors.FileKindWarning",
    "FormatError": "errors.FormatError",
    "GuessedCameras": "bundle.GuessedCameras",
    "InputError": "errors.InputError",
    "MetadataWarning": "errors.MetadataWarning",
    "ReconstructionError": "errors.ReconstructionError",
    "SceneOptions": "simulate.SceneOptions",
    "SkippedPhotoWarning": "errors.SkippedPhotoWarning",
    "WarpOptions": "simulate.WarpOptions",
    "climb": "bundle_adjust(..., simpler_first=True)",
    "motion_errors": "evaluation.motion_errors",
    "pose_errors": "evaluation.pose_errors",
    "psnr": "evaluation.psnr",
    "remap_grid": "RemapGrid.from_camera",
    "simulate_scene": "simulate.simulate_scene",
    "simulate_warp": "simulate.simulate_warp",
    "solve_model": "solve",
    "pipeline.GyroOptions": "GyroOptions",
    "pipeline.RectifyOptions": "RectifyOptions",
    "pipeline.RunOptions": "RunOptions",
    "pipeline.SceneOptions": "simulate.SceneOptions",
    "pipeline.SolveOptions": "SolveOptions",
    "pipeline.WarpOptions": "simulate.WarpOptions",
    "pipeline.analyze": "analyze",
    "pipeline.evaluate": "evaluate",
    "pipeline.read_motion_file": "simulate.read_motion_file",
    "pipeline.rectify_folder": "rectify_folder",
    "pipeline.run": "run",
    "pipeline.simulate_scene": "simulate.simulate_scene",
    "pipeline.simulate_warp": "simulate.simulate_warp",
    "pipeline.solve": "solve",
    "pipeline.solve_model": "solve",
    "pipeline.use_threads": "batch.use_threads",
    "pipeline.versions": "versions.versions",
}


def _climb(
    reconstruction: Reconstruction,
    rungs: Sequence[str] = MODEL_SEQUENCE,
    options: BundleOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, BundleResult]:
    """The results of all models, which `bundle_adjust` does not give."""
    return adjust_sequence(reconstruction, rungs, options, progress)


# Those that are no longer a name of a module.
_STAND_INS = {"climb": _climb, "remap_grid": RemapGrid.from_camera, "solve_model": solve}


def by_former_name(module: str, name: str) -> Any:
    """What a module had under a name that moved, with a warning that says the present one; its `__getattr__`."""
    former = f"{module}.{name}".removeprefix("rsundistort.")
    if former not in FORMER_NAMES:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    present = FORMER_NAMES[former]
    warnings.warn(f"{module}.{name} is now rsundistort.{present}", DeprecationWarning, stacklevel=3)
    if name in _STAND_INS:
        return _STAND_INS[name]
    place, _, attribute = f"rsundistort.{present}".rpartition(".")
    return getattr(import_module(place), attribute)
