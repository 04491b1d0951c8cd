"""Rolling-shutter bundle adjustment: problem, solver, priors and gauge."""

from .adjust import LADDER, bundle_adjust, climb, objective
from .options import BundleOptions, BundleResult
from .problem import reprojection_residuals

__all__ = ["LADDER", "BundleOptions", "BundleResult", "bundle_adjust", "climb", "objective", "reprojection_residuals"]
