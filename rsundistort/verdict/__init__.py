"""What to believe of a solution: whether there was a rolling shutter, whether its shape holds, which photos do not."""

from .judge import Verdict, judge

__all__ = ["Verdict", "judge"]
