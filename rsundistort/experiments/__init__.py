"""The paper's experiments, on any scene."""

from .one import OneOptions, experiment_one
from .scenes import KnownScene, load_scene
from .two import TwoOptions, experiment_two

__all__ = ["KnownScene", "OneOptions", "TwoOptions", "experiment_one", "experiment_two", "load_scene"]
