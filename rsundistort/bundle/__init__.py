"""Rolling-shutter bundle adjustment: problem, solver, priors and gauge."""

from .adjust import LADDER, bundle_adjust, climb
from .options import BundleOptions, BundleResult
from .problem import reprojection_residuals

__all__ = ["LADDER", "BundleOptions", "BundleResult", "bundle_adjust", "climb", "reprojection_residuals"]
