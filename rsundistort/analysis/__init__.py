"""What files are worth: poses by the measure of critical motions, outputs against the truth."""

from .against_truth import evaluate
from .critical_poses import analyze
from .results import ErrorSummary, Evaluation, PhiErrorSummary, PoseAnalysis, PsnrSummary

__all__ = ["ErrorSummary", "Evaluation", "PhiErrorSummary", "PoseAnalysis", "PsnrSummary", "analyze", "evaluate"]
