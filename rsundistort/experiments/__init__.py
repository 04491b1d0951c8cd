"""The paper's experiments, on any scene."""

from .one import METHODS, OneOptions, experiment_one
from .scenes import KnownScene, load_scene

__all__ = ["METHODS", "KnownScene", "OneOptions", "experiment_one", "load_scene"]
