"""From photos, or a model of another program, to poses, motions and points, and all that is written of them."""

from .from_model import solve
from .run import run
from .run_options import OutputOptions, RunOptions, SolveOptions

__all__ = ["OutputOptions", "RunOptions", "SolveOptions", "run", "solve"]
