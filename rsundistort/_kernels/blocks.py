"""Products of a symmetric matrix of blocks, of which the upper triangle is stored, and its projection on clusters.

Block i (nb x nb) of S stands in block row rows[i] and block column cols[i] >= rows[i]; row_start (m + 1,) are the
ranges of the block rows.
"""

from __future__ import annotations

import numpy as np

from ._jit import SUMS, parallel_kernel, prange


@parallel_kernel(fastmath=SUMS)
def multiply(row_start, cols, S, x, parts, y):
    """Product y (m, nb) of S with x; parts (k, m, nb) is room for the shares of k ranges of rows.

    Each block is read once, for its place above the diagonal and for that below, since reading dominates the time of a
    product. The number of ranges, not that of the threads, sets the order of the sums.
    """
    nb = x.shape[1]
    m, k = len(x), len(parts)
    for t in prange(k):
        part = parts[t]
        part[:] = 0.0
        for f in range(t * m // k, (t + 1) * m // k):
            for i in range(row_start[f], row_start[f + 1]):
                g = cols[i]
                for a in range(nb):
                    total = 0.0
                    for b in range(nb):
                        total += S[i, a, b] * x[g, b]
                    part[f, a] += total
                if g == f:
                    continue
                for a in range(nb):
                    left = x[f, a]
                    for b in range(nb):
                        part[g, b] += S[i, a, b] * left
    for f in prange(m):
        for a in range(nb):
            total = 0.0
            for t in range(k):
                total += parts[t, f, a]
            y[f, a] = total


@parallel_kernel(fastmath=SUMS)
def project_blocks(R, free, functions, pair_start, block, left, right, S, E):
    """E (pairs, q nb, q nb) = Z_c' S Z_d of each pair of clusters, from the entries that belong to it.

    Z is functions[f, k] (m, q) times the unknowns of photo f, of which the first three are rotated by R[f]
    (m, 3, 3) and those that are held (free[f, a] is 0) vanish. Entry s is the part of S between the photos left[s] and
    right[s], block[s] or, below the diagonal, its transpose; entries pair_start[p] to pair_start[p + 1] belong to
    pair p, those of one photo together.
    """
    nb = S.shape[1]
    q = functions.shape[1]
    for pair in prange(len(E)):
        E[pair] = 0.0
        G = np.empty((nb, nb))
        H = np.empty((nb, q * nb))  # a photo against the cluster of the right
        rotated = np.empty(3)
        s = pair_start[pair]
        while s < pair_start[pair + 1]:
            f = left[s]
            H[:] = 0.0
            while s < pair_start[pair + 1] and left[s] == f:
                i, g = block[s], right[s]
                for a in range(nb):
                    for b in range(nb):
                        value = S[i, a, b] if f <= g else S[i, b, a]
                        G[a, b] = value * free[f, a] * free[g, b]
                    for b in range(3):
                        rotated[b] = G[a, 0] * R[g, 0, b] + G[a, 1] * R[g, 1, b] + G[a, 2] * R[g, 2, b]
                    for b in range(3):
                        G[a, b] = rotated[b]
                for k in range(q):
                    scale = functions[g, k]
                    for a in range(nb):
                        for b in range(nb):
                            H[a, k * nb + b] += scale * G[a, b]
                s += 1
            for b in range(q * nb):
                for a in range(3):
                    rotated[a] = R[f, 0, a] * H[0, b] + R[f, 1, a] * H[1, b] + R[f, 2, a] * H[2, b]
                for a in range(3):
                    H[a, b] = rotated[a]
            for k in range(q):
                scale = functions[f, k]
                for a in range(nb):
                    for b in range(q * nb):
                        E[pair, k * nb + a, b] += scale * H[a, b]
