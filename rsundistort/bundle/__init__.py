"""Rolling-shutter bundle adjustment: problem, solver, priors and gauge."""

from .adjust import LADDER, adjust_sequence, bundle_adjust, objective, sequence_to
from .choice import ModelChoice, choose_model
from .direction import ReadoutChoice, choose_readouts
from .intrinsics import GuessedCameras, deviation, pixels_of
from .options import BundleOptions, BundleResult
from .posterior import Posterior, gauge_directions

__all__ = [
    "LADDER",
    "BundleOptions",
    "BundleResult",
    "GuessedCameras",
    "ModelChoice",
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
    "sequence_to",
]
