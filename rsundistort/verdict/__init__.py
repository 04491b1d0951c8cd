"""What to believe of a solution: whether there was a rolling shutter, whether its shape holds, which photos do not."""

from .judge import Verdict, judge
from .photos import PhotoMotions, photo_motions
from .residuals import left_along_readout, left_over_frame

__all__ = [
    "PhotoMotions",
    "Verdict",
    "judge",
    "left_along_readout",
    "left_over_frame",
    "photo_motions",
]
