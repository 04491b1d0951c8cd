"""Rolling-shutter bundle adjustment: problem, solver, priors and gauge."""

from .adjust import LADDER, bundle_adjust, climb, objective
from .choice import ModelChoice, choose_model
from .options import BundleOptions, BundleResult
from .problem import reprojection_residuals

__all__ = [
    "LADDER",
    "BundleOptions",
    "BundleResult",
    "ModelChoice",
    "bundle_adjust",
    "choose_model",
    "climb",
    "objective",
    "reprojection_residuals",
]
