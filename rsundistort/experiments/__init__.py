"""The paper's experiments, on any scene."""

from .one import METHODS, OneOptions, experiment_one
from .paths import PathComparison, compare_paths
from .scenes import KnownScene, load_scene
from .two import TwoOptions, experiment_two

__all__ = [
    "METHODS",
    "KnownScene",
    "OneOptions",
    "PathComparison",
    "TwoOptions",
    "compare_paths",
    "experiment_one",
    "experiment_two",
    "load_scene",
]
