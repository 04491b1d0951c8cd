"""Critical motions: the degeneracy measure, their cost in a solution, and remedies."""

from .advice import Advice, advise, advise_poses
from .common import CommonMotion, clock_contrast, common_motion
from .cost import ShapeCost, shape_cost
from .degeneracy import CriticalMotion, critical_motion
from .remedy import REMEDIES, Remedy, heal, still_probability, with_remedy

__all__ = [
    "REMEDIES",
    "Advice",
    "CommonMotion",
    "CriticalMotion",
    "Remedy",
    "ShapeCost",
    "advise",
    "advise_poses",
    "clock_contrast",
    "common_motion",
    "critical_motion",
    "heal",
    "shape_cost",
    "still_probability",
    "with_remedy",
]
