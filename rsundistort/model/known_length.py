"""A length that was measured in the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .checks import check_fields

__all__ = ["End", "KnownLength"]

End = tuple[str, float, float]
# Beyond, squares of ratios lose all digits, whatever the unit.
_LONGEST = 1e12


@dataclass(frozen=True)
class KnownLength:
    """A length between two points of the scene, in any unit: all lengths share it.

    Parameters
    ----------
    start, end : (photo name, x, y)
        Where the points are seen, in pixels of stored photos with integer centres; each is taken to be the point that
        was measured nearest, within 5 px.
    length : float
        What was measured.
    sigma : float
        Its standard deviation, in the same unit.
    """

    start: End
    end: End
    length: float
    sigma: float

    def __post_init__(self) -> None:
        for name, end in (("start", self.start), ("end", self.end)):
            fits = isinstance(end, (tuple, list)) and len(end) == 3 and isinstance(end[0], str)
            if not fits or not all(isinstance(v, (int, float, np.integer, np.floating)) for v in end[1:]):
                raise InputError(f"known length: {name}={end!r}, expected (photo name, x, y)")
        check_fields(self)
        for name, value in (("length", self.length), ("sigma", self.sigma)):
            if not 1 / _LONGEST <= value <= _LONGEST:
                raise InputError(
                    f"known length from {self.start} to {self.end}: {name}={value!r}, expected above 0, up to "
                    f"{_LONGEST:g}"
                )
        if not np.isfinite([*self.start[1:], *self.end[1:]]).all():
            raise InputError(f"known length from {self.start} to {self.end}: pixels must be finite numbers")
