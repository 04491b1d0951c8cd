"""From photos, or a model of another program, to poses, motions and points, and all that is written of them."""

from .from_model import solve
from .readout_time import MeasuredReadout, measure_readout
from .run import run
from .run_options import OutputOptions, RunOptions, SolveOptions

__all__ = ["MeasuredReadout", "OutputOptions", "RunOptions", "SolveOptions", "measure_readout", "run", "solve"]
