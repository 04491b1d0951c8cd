"""Whole jobs: the order of the stages, nothing else."""

from .analyze import analyze
from .batch import rectify_folder
from .evaluate import evaluate
from .from_model import solve, solve_model
from .gyro import GyroOptions
from .options import RunOptions, SolveOptions
from .outcome import versions
from .photo import RectifyOptions
from .run import run
from .scene import SceneOptions, simulate_scene
from .simulate import WarpOptions, read_motion_file, simulate_warp
from .workers import use_threads

__all__ = [
    "GyroOptions",
    "RectifyOptions",
    "RunOptions",
    "SceneOptions",
    "SolveOptions",
    "WarpOptions",
    "analyze",
    "evaluate",
    "read_motion_file",
    "rectify_folder",
    "run",
    "simulate_scene",
    "simulate_warp",
    "solve",
    "solve_model",
    "use_threads",
    "versions",
]
