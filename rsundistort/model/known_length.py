"""A length that was measured in the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError

__all__ = ["End", "KnownLength"]

End = tuple[str, float, float]


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
        for name, value in (("length", self.length), ("sigma", self.sigma)):
            if not 0 < value < np.inf:
                raise InputError(f"known length from {self.start} to {self.end}: {name}={value!r}, expected above 0")
        if not np.isfinite([*self.start[1:], *self.end[1:]]).all():
            raise InputError(f"known length from {self.start} to {self.end}: pixels must be finite numbers")
