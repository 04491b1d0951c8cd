"""Rolling-shutter bundle adjustment: problem, solver, priors and gauge."""

import warnings
from typing import Any

from .adjust import MODEL_SEQUENCE, adjust_sequence, bundle_adjust, objective, sequence_to
from .bundle_options import BundleOptions, BundleResult
from .choice import choose_model
from .control import CONTROL_SIGMA_PX, PlacedControl, place_control, with_control
from .direction import ReadoutChoice, choose_readouts
from .intrinsics import GuessedCameras, deviation, pixels_of
from .known_lengths import measured_lengths, scale_of_lengths
from .known_motions import FAR, KnownMotions, judge_known_motions, misses_of
from .known_positions import KnownPlaces
from .model_choice import ModelChoice
from .pose_sigmas import PoseCovariances, pose_covariances
from .posterior import Posterior, gauge_directions

__all__ = [
    "CONTROL_SIGMA_PX",
    "FAR",
    "MODEL_SEQUENCE",
    "BundleOptions",
    "BundleResult",
    "GuessedCameras",
    "KnownMotions",
    "KnownPlaces",
    "ModelChoice",
    "PlacedControl",
    "PoseCovariances",
    "Posterior",
    "ReadoutChoice",
    "adjust_sequence",
    "bundle_adjust",
    "choose_model",
    "choose_readouts",
    "deviation",
    "gauge_directions",
    "judge_known_motions",
    "measured_lengths",
    "misses_of",
    "objective",
    "pixels_of",
    "place_control",
    "pose_covariances",
    "scale_of_lengths",
    "sequence_to",
    "with_control",
]


def __getattr__(name: str) -> Any:
    if name == "LADDER":  # the former name, in this version
        text = "rsundistort.bundle.LADDER is now rsundistort.bundle.MODEL_SEQUENCE"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return MODEL_SEQUENCE
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
