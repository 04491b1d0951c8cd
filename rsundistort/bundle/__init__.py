"""Rolling-shutter bundle adjustment: problem, solver, priors and gauge."""

from .adjust import LADDER, adjust_sequence, bundle_adjust, objective, sequence_to
from .choice import ModelChoice, choose_model
from .control import CONTROL_SIGMA_PX, PlacedControl, place_control, with_control
from .direction import ReadoutChoice, choose_readouts
from .intrinsics import GuessedCameras, deviation, pixels_of
from .lengths import scale_of_lengths
from .options import BundleOptions, BundleResult
from .places import KnownPlaces
from .posterior import Posterior, gauge_directions

__all__ = [
    "CONTROL_SIGMA_PX",
    "LADDER",
    "BundleOptions",
    "BundleResult",
    "GuessedCameras",
    "KnownPlaces",
    "ModelChoice",
    "PlacedControl",
    "Posterior",
    "ReadoutChoice",
    "adjust_sequence",
    "bundle_adjust",
    "choose_model",
    "choose_readouts",
    "deviation",
    "gauge_directions",
    "objective",
    "pixels_of",
    "place_control",
    "scale_of_lengths",
    "sequence_to",
    "with_control",
]
