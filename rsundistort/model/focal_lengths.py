"""Focal lengths that lie too far apart for a lens that focuses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .array_types import Array, Index

__all__ = ["zooms"]

# Focal lengths that lie this far apart, with none between, are no focusing of one lens.
_APART = 0.05


def zooms(focal_px: ArrayLike) -> list[Index]:
    """Places of focal lengths (n,) that one lens may have had while it focused: one array for each zoom."""
    values: Array = np.asarray(focal_px, np.float64)
    order = np.argsort(values, kind="stable")
    ends = np.flatnonzero(np.diff(np.log(values[order])) > _APART) + 1
    return np.split(order, ends)
