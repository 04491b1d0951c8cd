"""What data looks like between the stages: frozen dataclasses of arrays."""

from .bend import BEND_GROUPS, Bend
from .camera import READOUTS, Camera, check_readout, opposite, other_axis
from .control_point import ControlPoint
from .depth import AtInfinity, Depth, DepthMap, Plane
from .known_length import KnownLength
from .motion import SHUTTER_MODELS, RowMotion, check_shutter_model
from .reconstruction import Observations, Reconstruction
from .solution import Solution, SolvedImage

__all__ = [
    "BEND_GROUPS",
    "READOUTS",
    "SHUTTER_MODELS",
    "AtInfinity",
    "Bend",
    "Camera",
    "ControlPoint",
    "Depth",
    "DepthMap",
    "KnownLength",
    "Observations",
    "Plane",
    "Reconstruction",
    "RowMotion",
    "Solution",
    "SolvedImage",
    "check_readout",
    "check_shutter_model",
    "opposite",
    "other_axis",
]
