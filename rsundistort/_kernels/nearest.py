"""The descriptors that are most similar to others, by integers: exact, and the same whatever the number of threads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ._jit import parallel_kernel, prange

# Numbers of a descriptor; a constant, so that their products are summed by instructions for vectors of bytes.
_NUMBERS = 128


@parallel_kernel()
def most_similar(
    of: NDArray[np.uint8],
    words: NDArray[np.uint8],
    among: NDArray[np.uint8],
    starts: NDArray[np.int64],
    most: NDArray[np.int64],
    product: NDArray[np.int32],
    next_product: NDArray[np.int32],
) -> None:
    """For each descriptor the one of others with the largest product, that product, and the second largest.

    Parameters
    ----------
    of, words : (n, 128), (n, p) uint8 array
        Descriptors, and the words whose lists are searched for each.
    among, starts : (m, 128) uint8, (w + 1,) int64 array
        The other descriptors, list by list, and where that of each word begins, and the last one ends.
    most, product, next_product : (n,) int64, int32, int32 array
        Take the results: the first of equals counts; where there is no other descriptor the product is 0.
    """
    for i in prange(len(of)):
        at, largest, second = 0, np.int32(0), np.int32(0)
        for word in words[i]:
            for j in range(starts[word], starts[word + 1]):
                total = np.int32(0)
                for k in range(_NUMBERS):
                    total = np.int32(total + np.int32(of[i, k]) * np.int32(among[j, k]))
                if total > second:
                    if total > largest:
                        at, second, largest = j, largest, total
                    else:
                        second = total
        most[i], product[i], next_product[i] = at, largest, second
