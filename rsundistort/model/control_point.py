"""A point on the ground whose place was measured, and where photos show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..errors import InputError

__all__ = ["ControlPoint"]

# Beyond, squares lose all digits; the earth's coordinates are below 1e8.
_FARTHEST_M, _FARTHEST_PX = 1e9, 1e6


@dataclass(frozen=True)
class ControlPoint:
    """A point on the ground whose place was measured, and where photos show it.

    Parameters
    ----------
    place_m : (float, float, float)
        East, north and up, metres.
    sigma_m : (float, float, float)
        Their standard deviations.
    seen : mapping of photo name to (x, y)
        Pixels of the stored photos, integer centres; two photos or more.
    is_check : bool
        Whether it is only compared: a check point holds nothing.
    """

    name: str
    place_m: tuple[float, float, float]
    sigma_m: tuple[float, float, float]
    seen: Mapping[str, tuple[float, float]]
    is_check: bool = False

    def __post_init__(self) -> None:
        where = f"control point {self.name!r}"
        if not (np.abs(self.place_m) <= _FARTHEST_M).all():
            raise InputError(f"{where}: E, N, U are {self.place_m}, expected metres up to {_FARTHEST_M:g}")
        if not all(1 / _FARTHEST_M <= sigma <= _FARTHEST_M for sigma in self.sigma_m):
            raise InputError(f"{where}: sigma {self.sigma_m}, expected metres above 0, up to {_FARTHEST_M:g}")
        if not (np.abs([*self.seen.values()]) <= _FARTHEST_PX).all():
            raise InputError(f"{where}: pixels must be finite numbers up to {_FARTHEST_PX:g}")
        if len(self.seen) < 2:
            raise InputError(f"{where} is seen in {len(self.seen)} photo; two are needed to place it")
