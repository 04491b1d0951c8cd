"""The pairs of a large set that are worth matching.

Everything here is the same whatever the number of threads: the sums that a library may split among them are of
integers, and small enough for floats to hold them exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from ..model.array_types import Array, Index
from .codebook import STRONGEST, distance_from_words, make_codebook, sums_by_word

__all__ = ["choose_pairs", "global_descriptors"]

# Length of a global descriptor. Sums of products of integers stay below its square, 2^24: float32 is exact to there.
_LENGTH = 4000.0
# partners in a sequence (on each side), by place and by similarity
_NEXT, _NEARBY, _SIMILAR = 6, 6, 10
# photos compared at a time
_BLOCK = 1024


def choose_pairs(
    num_photos: int,
    sequences: Sequence[ArrayLike] = (),
    positions: ArrayLike | None = None,
    descriptors: ArrayLike | None = None,
    *,
    given: Sequence[Index] = (),
    similar: int = _SIMILAR,
) -> Index:
    """Pairs of photos that are neighbours in order of capture, by place, or by appearance.

    Each photo picks a fixed number of partners of each kind, so that the number of pairs is proportional to the photos.

    Parameters
    ----------
    num_photos : int
        How many there are, m.
    sequences : sequence of int arrays
        Photos in the order of capture; of several cameras one each.
    positions : (m, 2 | 3) array, optional
        Where they were taken, in any unit of length; NaN where that is not known.
    descriptors : (m, D) array, optional
        As `global_descriptors` gives them; photos of which it is 0 look like none.
    given : sequence of (p, 2) int arrays
        Pairs that are chosen already.
    similar : int
        Partners of a photo by appearance.

    Returns
    -------
    (p, 2) int64 array
        Pairs i < j in ascending order, each once.
    """
    pairs = [np.zeros((0, 2), np.int64), *given, *(_next_in(np.asarray(order, np.int64)) for order in sequences)]
    if positions is not None:
        pairs.append(_nearest(np.asarray(positions, np.float64)))
    if descriptors is not None:
        # the most similar ones are often chosen already: they would leave no room for a return
        pairs.append(_most_similar(np.asarray(descriptors), np.concatenate(pairs), similar))
    chosen = np.sort(np.concatenate(pairs), axis=1)
    chosen = chosen[chosen[:, 0] < chosen[:, 1]]
    return np.column_stack(np.divmod(np.unique(chosen[:, 0] * num_photos + chosen[:, 1]), num_photos))


def _next_in(order: Index) -> Index:
    """Each photo of a sequence with those after it."""
    ahead = range(1, min(_NEXT, len(order) - 1) + 1)
    return np.concatenate(
        [np.zeros((0, 2), np.int64), *(np.column_stack([order[:-step], order[step:]]) for step in ahead)]
    )


def _nearest(positions: Array) -> Index:
    """Each photo with those nearest to it."""
    known = np.flatnonzero(np.isfinite(positions).all(1))
    if len(known) < 2:
        return np.zeros((0, 2), np.int64)
    # one more: of photos at the same place it need not find itself first
    _, found = cKDTree(positions[known]).query(positions[known], k=range(1, min(_NEARBY + 1, len(known)) + 1))
    return np.column_stack([np.repeat(known, found.shape[1]), known[found.ravel()]])


def _most_similar(descriptors: NDArray[Any], chosen: Index, count: int) -> Index:
    """Each photo with so many similar ones that are not chosen already; of equals the first."""
    known = np.flatnonzero(descriptors.any(1))
    place = np.full(len(descriptors), -1)
    place[known] = np.arange(len(known))
    chosen = place[np.concatenate([chosen, chosen[:, ::-1]])]
    chosen = chosen[(chosen >= 0).all(1)]
    found = [np.zeros((0, 2), np.int64)]
    for first in range(0, len(known), _BLOCK):
        block = np.arange(first, min(first + _BLOCK, len(known)))
        similarity = _products(descriptors[known[block]], descriptors[known])
        of_block = chosen[(chosen[:, 0] >= first) & (chosen[:, 0] < first + _BLOCK)]
        similarity[of_block[:, 0] - first, of_block[:, 1]] = -np.inf
        similarity[block - first, block] = -np.inf
        best = np.argsort(-similarity, axis=1, kind="stable")[:, :count]
        row, column = np.nonzero(np.isfinite(np.take_along_axis(similarity, best, axis=1)))
        found.append(np.column_stack([known[block[row]], known[best[row, column]]]))
    return np.concatenate(found)


def _products(these: NDArray[Any], those: NDArray[Any]) -> NDArray[np.float32]:
    """Scalar products of rows, of as many at a time as their floats have room for."""
    first = these.astype(np.float32)
    blocks = (those[k : k + _BLOCK].astype(np.float32) for k in range(0, len(those), _BLOCK))
    return np.concatenate([first @ block.T for block in blocks], axis=1)


def global_descriptors(descriptors: Sequence[NDArray[np.uint8]], seed: int = 0) -> NDArray[np.int16]:
    """Appearance of each photo: a vector of locally aggregated descriptors (VLAD).

    The codebook is made of the set's own descriptors by k-means. The residuals of a photo's descriptors to their words
    are summed by word; signed roots and equal weights of the words keep what repeats in a photo from counting for more.

    Parameters
    ----------
    descriptors : sequence of (n_i, d) uint8 arrays
        RootSIFT of each photo, the strongest first.

    Returns
    -------
    (m, D) int16 array
        Vectors of length 4000 or so, whose scalar products measure similarity. Zero for photos without features.

    References
    ----------
    H. Jegou et al., Aggregating local image descriptors into compact codes, PAMI 2012; R. Arandjelovic, A. Zisserman,
    All about VLAD, CVPR 2013.
    """
    words = make_codebook(descriptors, seed)
    if not len(words):
        return np.zeros((len(descriptors), 1), np.int16)
    return np.array([_aggregated(each[:STRONGEST].astype(np.float32), words) for each in descriptors])


def _aggregated(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int16]:
    """Sums of the residuals of a photo's descriptors by word: signed roots, of equal length by word, as one vector."""
    sums, counts = sums_by_word(descriptors, distance_from_words(descriptors, words).argmin(axis=1), len(words))
    residuals = sums - counts[:, None] * words
    by_word = _unit(np.sign(residuals) * np.sqrt(np.abs(residuals)))
    return np.rint(_LENGTH * _unit(by_word.reshape(1, -1))[0]).astype(np.int16)


def _unit(rows: Array) -> Array:
    """Rows at length 1; zeros as they are."""
    return np.asarray(rows / np.maximum(np.sqrt((rows**2).sum(1, keepdims=True)), 1e-12))
