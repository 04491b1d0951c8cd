"""Words that descriptors are near to: k-means over the descriptors of a set.

Everything here is the same whatever the number of threads: the sums that a library may split among them are of
integers, and small enough for floats to hold them exactly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..model.array_types import Array, Index

__all__ = ["STRONGEST", "distance_from_words", "make_codebook", "sums_by_word"]

#: Features of a photo that count for a codebook.
STRONGEST = 2048
# Words of a codebook: no more than a byte can name.
_NUM_WORDS = 256
# Descriptors that it is made of, or a few more, and rounds of k-means. With four times as many and ten rounds the pairs
# that it finds similar have no more matches (lund, phone, drone), at five times the cost.
_SAMPLED, _ROUNDS = 8192, 4


def make_codebook(descriptors: Sequence[NDArray[np.uint8]], seed: int) -> NDArray[np.float32]:
    """Words of integers by k-means over an equal share of each photo's descriptors.

    Parameters
    ----------
    descriptors : sequence of (n_i, 128) uint8 arrays
        Of each photo, the strongest first.
    seed : int
        Of the choice of descriptors.

    Returns
    -------
    (w, 128) float32 array
        256 words, fewer of fewer descriptors.
    """
    rng = np.random.default_rng(seed)
    share = -(-_SAMPLED // max(1, len(descriptors)))
    strongest = [each[:STRONGEST] for each in descriptors]
    sample = np.concatenate([each[rng.permutation(len(each))[:share]] for each in strongest]).astype(np.float32)
    words = sample[rng.permutation(len(sample))[:_NUM_WORDS]]
    for _ in range(_ROUNDS if len(words) else 0):
        sums, counts = sums_by_word(sample, distance_from_words(sample, words).argmin(axis=1), len(words))
        # a word that nothing is nearest to stays where it is
        words = np.where(counts[:, None] > 0, np.rint(sums / np.maximum(counts, 1)[:, None]), words).astype(np.float32)
    return words


def distance_from_words(descriptors: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.float32]:
    """Squared distances (n, w), each less that of its descriptor from 0; squares of 128 bytes stay below 2^24."""
    return np.asarray((words**2).sum(1) - 2.0 * (descriptors @ words.T))


def sums_by_word(descriptors: NDArray[np.float32], word: NDArray[np.intp], num_words: int) -> tuple[Array, Index]:
    """Sum of the descriptors of each word, and how many there are."""
    counts = np.bincount(word, minlength=num_words)
    sums = np.zeros((num_words, descriptors.shape[1]))
    present = np.flatnonzero(counts)
    if len(present):
        starts = np.cumsum(counts)[present] - counts[present]
        order = np.argsort(word, kind="stable")
        sums[present] = np.add.reduceat(descriptors[order].astype(np.float64), starts, axis=0)
    return sums, counts
