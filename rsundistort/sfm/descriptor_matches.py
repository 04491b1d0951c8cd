"""Matches of the descriptors of two photos: the same in each run, whatever the number of threads.

pycolmap's fast matcher finds neighbours by an approximate index that is not the same in each run.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .._kernels.nearest import most_similar
from ..model.array_types import Array, Index, Mask
from .codebook import distance_from_words

__all__ = ["DescriptorIndex", "match_descriptors"]

# Length of a descriptor as a vector.
_NORM = 512.0
# Largest angle to the nearest descriptor (rad), and by that to the next one: COLMAP's.
_FARTHEST, _RATIO = 0.7, 0.8
# Words of 256 that a descriptor's neighbours are looked for in. Of the matches of herz-jesus-8 and drone 0.1 % are
# missed, at a fifth of the time for all words; with 16 words 0.7 %.
_NEAR = 32


@dataclass(frozen=True)
class DescriptorIndex:
    """Descriptors of a photo by the words of a codebook.

    Attributes
    ----------
    descriptors : (n, 128) uint8 array
        Those that are nearest to the first word first.
    order : (n,) int array
        Their indices in the photo.
    starts : (w + 1,) int64 array
        Where those of each word begin, and the last ones end.
    near : (n, p) uint8 array
        The words nearest to each descriptor.
    """

    descriptors: NDArray[np.uint8]
    order: Index
    starts: Index
    near: NDArray[np.uint8]

    @classmethod
    def of(cls, descriptors: NDArray[np.uint8], words: NDArray[np.float32] | None = None) -> DescriptorIndex:
        """By words (w, 128) of `make_codebook`; without them all descriptors are compared with all."""
        if words is None or not len(words):
            words = np.zeros((1, descriptors.shape[1]), np.float32)
        distance = distance_from_words(descriptors.astype(np.float32), words)
        word = distance.argmin(axis=1)
        order = np.argsort(word, kind="stable")
        starts = np.append(0, np.cumsum(np.bincount(word, minlength=len(words))))
        count = min(_NEAR, len(words))
        near = np.argpartition(distance[order], count - 1, axis=1)[:, :count].astype(np.uint8)
        return cls(descriptors[order], order, starts, near)


def match_descriptors(first: DescriptorIndex, second: DescriptorIndex) -> NDArray[np.uint32]:
    """Pairs of descriptors that are nearest to each other, and clearly nearer than to any other.

    These are the matches of COLMAP's brute-force matcher, as far as they are near the same words: within an angle of
    0.7, and of 0.8 times that to the next one in either photo (Lowe, IJCV 2004, 7.1).

    Parameters
    ----------
    first, second : DescriptorIndex
        Of two photos, by the same words.

    Returns
    -------
    (k, 2) uint32 array
        Indices of the descriptors in their photos, in the order of the first.
    """
    nearest, is_clear = _nearest(first, slice(None), second)
    mine = np.flatnonzero(is_clear)
    theirs, which = np.unique(nearest[mine], return_inverse=True)
    back, is_clear = _nearest(second, theirs, first)  # of the others nothing is asked
    mutual = is_clear[which] & (back[which] == mine)
    found = np.column_stack([first.order[mine], second.order[nearest[mine]]])[mutual]
    return found[np.argsort(found[:, 0])].astype(np.uint32)


def _nearest(of: DescriptorIndex, which: slice | Index, among: DescriptorIndex) -> tuple[Index, Mask]:
    """The nearest of other descriptors to each of some, and whether it is near, and clearly the nearest."""
    descriptors, words = of.descriptors[which], of.near[which]
    nearest, (product, next_product) = np.zeros(len(words), np.int64), np.zeros((2, len(words)), np.int32)
    most_similar(descriptors, words, among.descriptors, among.starts, nearest, product, next_product)
    angle, next_angle = _angle(product), _angle(next_product)
    return nearest, (angle <= _FARTHEST) & (angle < _RATIO * next_angle)


def _angle(product: NDArray[np.int32]) -> Array:
    return np.asarray(np.arccos(np.minimum(product / _NORM**2, 1.0)))
