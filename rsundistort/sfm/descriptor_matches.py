"""Matches of the descriptors of two photos."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .._kernels.nearest import most_similar
from ..model.array_types import Array, Index, Mask

__all__ = ["match_descriptors"]

# Length of a descriptor.
_LENGTH = 512.0
# Largest angle to the nearest descriptor (rad), and by that to the next one: COLMAP's.
_FARTHEST, _RATIO = 0.7, 0.8


def match_descriptors(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Pairs of descriptors that are nearest to each other, and clearly nearer than to any other.

    These are the matches of COLMAP's brute-force matcher: within an angle of 0.7, and of 0.8 times that to the next one
    in either photo (Lowe, IJCV 2004, 7.1). pycolmap's fast matcher finds neighbours by an approximate index, which is
    not the same in each run.

    Parameters
    ----------
    first, second : (n, 128), (m, 128) uint8 array
        As `Features.descriptors`.

    Returns
    -------
    (k, 2) uint32 array
        Their indices, in the order of the first.
    """
    if not len(first) or not len(second):
        return np.zeros((0, 2), np.uint32)
    nearest, is_clear = _nearest(first, second)
    mine = np.flatnonzero(is_clear)
    theirs, which = np.unique(nearest[mine], return_inverse=True)
    back, is_clear = _nearest(second[theirs], first)  # of the others nothing is asked
    mutual = is_clear[which] & (back[which] == mine)
    return np.column_stack([mine, nearest[mine]])[mutual].astype(np.uint32)


def _nearest(of: NDArray[np.uint8], among: NDArray[np.uint8]) -> tuple[Index, Mask]:
    """Index of the nearest of other descriptors to each, and whether it is near, and clearly the nearest."""
    nearest, (product, next_product) = np.empty(len(of), np.int64), np.empty((2, len(of)), np.int32)
    most_similar(of, among, nearest, product, next_product)
    angle, next_angle = _angle(product), _angle(next_product)
    return nearest, (angle <= _FARTHEST) & (angle < _RATIO * next_angle)


def _angle(product: NDArray[np.int32]) -> Array:
    return np.asarray(np.arccos(np.minimum(product / _LENGTH**2, 1.0)))
