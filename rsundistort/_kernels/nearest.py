"""The descriptors that are most similar to others, by integers: exact, and the same whatever the number of threads."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ._jit import parallel_kernel, prange

# Numbers of a descriptor; a constant, so that their products are summed by instructions for vectors of bytes.
_LENGTH = 128


@parallel_kernel()
def most_similar(
    of: NDArray[np.uint8],
    among: NDArray[np.uint8],
    most: NDArray[np.int64],
    product: NDArray[np.int32],
    next_product: NDArray[np.int32],
) -> None:
    """For each descriptor (n, 128) the one of others (m, 128) with the largest product, that, and the second largest.

    `most`, `product` and `next_product` (n,) take the results. The first of equals counts; with one other descriptor
    the second largest product is 0.
    """
    for i in prange(len(of)):
        at, largest, second = 0, np.int32(-1), np.int32(0)
        for j in range(len(among)):
            total = np.int32(0)
            for k in range(_LENGTH):
                total = np.int32(total + np.int32(of[i, k]) * np.int32(among[j, k]))
            if total > second or largest < 0:
                if total > largest:
                    at, second, largest = j, max(largest, np.int32(0)), total
                else:
                    second = total
        most[i], product[i], next_product[i] = at, largest, second
