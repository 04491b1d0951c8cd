"""Deprecated: what was here is in `input`, `solve`, `batch`, `simulate` and `analysis`. Gone in the next version."""

import warnings
from importlib import import_module
from typing import Any

_MOVED = {
    "analyze": "analysis", "evaluate": "analysis",
    "RectifyOptions": "batch", "rectify_folder": "batch", "use_threads": "batch",
    "GyroOptions": "input",
    "SceneOptions": "simulate", "WarpOptions": "simulate", "read_motion_file": "simulate",
    "simulate_scene": "simulate", "simulate_warp": "simulate",
    "RunOptions": "solve", "SolveOptions": "solve", "run": "solve", "solve": "solve", "solve_model": "solve",
    "versions": "versions",
}  # fmt: skip

__all__ = list(_MOVED)


def __getattr__(name: str) -> Any:
    if name not in _MOVED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = f"rsundistort.{_MOVED[name]}"
    warnings.warn(f"rsundistort.pipeline.{name} is now in {module}", DeprecationWarning, stacklevel=2)
    return getattr(import_module(module), name)
