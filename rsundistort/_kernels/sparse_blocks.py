"""Factor of a symmetric matrix of blocks, of which most are zero: U' U with U block upper triangular.

Block i (nb x nb) stands in block row k, row_start[k] <= i < row_start[k + 1], and block column cols[i] >= k, ascending
from the diagonal; with those that the factorisation fills. `unknowns` stands for nb, see `_jit.unknowns_of`.
"""

from __future__ import annotations

import math

import numpy as np

from ._jit import SUMS, columns, kernel, parallel_kernel, prange


@kernel()
def eliminate(row_start, cols, order, joined):
    """An order in which block rows fill few blocks, each time the one with the fewest neighbours (minimum degree).

    joined (m, m) bool, false before, gets the neighbours of each row when it is eliminated, without the diagonal.
    """
    m = len(order)
    for f in range(m):
        for i in range(row_start[f], row_start[f + 1]):
            if cols[i] != f:
                joined[f, cols[i]] = joined[cols[i], f] = True
    degree = np.empty(m, np.int64)
    for f in range(m):
        degree[f] = joined[f].sum()
    left = np.ones(m, np.bool_)
    for step in range(m):
        best = -1
        for f in range(m):
            if left[f] and (best < 0 or degree[f] < degree[best]):
                best = f
        order[step] = best
        left[best] = False
        around = np.flatnonzero(joined[best])
        for f in around:
            joined[f, best] = False
            for g in around:
                if f != g:
                    joined[f, g] = True
            degree[f] = joined[f].sum()


@kernel(forceinline=True)
def _place(row_start, cols, row, col):
    """Where a block of the upper triangle stands."""
    low, high = row_start[row], row_start[row + 1] - 1
    while low < high:
        middle = (low + high) // 2
        if cols[middle] < col:
            low = middle + 1
        else:
            high = middle
    return low


@kernel()
def fill_blocks(row_start, cols, first, second, S, scale, free, U):
    """Blocks S (blocks, nb, nb), between rows first[i] and second[i] in either order, into those of U, scaled.

    scale, free (m, nb); rows of held unknowns are those of the identity.
    """
    U[:] = 0.0
    nb = S.shape[1]
    for i in range(len(S)):
        f, g = first[i], second[i]
        at = _place(row_start, cols, min(f, g), max(f, g))
        for a in range(nb):
            for b in range(nb):
                value = S[i, a, b] * scale[f, a] * scale[g, b] * free[f, a] * free[g, b]
                if f <= g:
                    U[at, a, b] = value
                else:
                    U[at, b, a] = value
    for f in range(len(scale)):
        for a in range(nb):
            if not free[f, a]:
                U[row_start[f], a, a] = 1.0


@kernel(fastmath=SUMS)
def _subtract_product(unknowns, A, B, out):
    """A' B from out, six of its rows and three rows of both at a time: what is loaded serves several products."""
    nb = columns(unknowns)
    whole = nb // 6 * 6
    for c in range(0, whole, 3):
        for a in range(0, whole, 6):
            u0, u1, u2 = A[c, a], A[c + 1, a], A[c + 2, a]
            v0, v1, v2 = A[c, a + 1], A[c + 1, a + 1], A[c + 2, a + 1]
            w0, w1, w2 = A[c, a + 2], A[c + 1, a + 2], A[c + 2, a + 2]
            x0, x1, x2 = A[c, a + 3], A[c + 1, a + 3], A[c + 2, a + 3]
            y0, y1, y2 = A[c, a + 4], A[c + 1, a + 4], A[c + 2, a + 4]
            z0, z1, z2 = A[c, a + 5], A[c + 1, a + 5], A[c + 2, a + 5]
            for b in range(nb):
                b0, b1, b2 = B[c, b], B[c + 1, b], B[c + 2, b]
                out[a, b] -= u0 * b0 + u1 * b1 + u2 * b2
                out[a + 1, b] -= v0 * b0 + v1 * b1 + v2 * b2
                out[a + 2, b] -= w0 * b0 + w1 * b1 + w2 * b2
                out[a + 3, b] -= x0 * b0 + x1 * b1 + x2 * b2
                out[a + 4, b] -= y0 * b0 + y1 * b1 + y2 * b2
                out[a + 5, b] -= z0 * b0 + z1 * b1 + z2 * b2
    for c in range(nb):
        # rows of out that are left, and rows of both
        for a in range(whole if c < whole else 0, nb):
            x0 = A[c, a]
            for b in range(nb):
                out[a, b] -= x0 * B[c, b]


@parallel_kernel(fastmath=SUMS)
def factor_blocks(unknowns, row_start, cols, U):
    """The factor in place of the matrix; False if that is not positive."""
    nb = columns(unknowns)
    for k in range(len(row_start) - 1):
        start, end = row_start[k], row_start[k + 1]
        D = U[start]
        for j in range(nb):
            for i in range(j + 1):
                v = D[i, j]
                for c in range(i):
                    v -= D[c, i] * D[c, j]
                if i < j:
                    D[i, j] = v / D[i, i]
                elif v > 1e-15:  # of a unit diagonal
                    D[j, j] = math.sqrt(v)
                else:
                    return False
        for p in range(start + 1, end):
            B = U[p]
            for i in range(nb):
                for c in range(i):
                    x = D[c, i]
                    for b in range(nb):
                        B[i, b] -= x * B[c, b]
                x = 1.0 / D[i, i]
                for b in range(nb):
                    B[i, b] *= x
        for p in prange(start + 1, end):
            at = row_start[cols[p]]
            for q in range(p, end):
                while cols[at] != cols[q]:
                    at += 1
                _subtract_product(unknowns, U[p], U[q], U[at])
    return True


@parallel_kernel(fastmath=SUMS)
def solve_blocks(row_start, cols, U, x):
    """Right-hand sides x (k, m, nb) become solutions.

    Four are solved at a time, since reading the factor from memory dominates the time of a solution.
    """
    m, nb = x.shape[1:]
    for quad in prange((len(x) + 3) // 4):
        first, count = 4 * quad, min(4, len(x) - 4 * quad)
        # those beyond the last are zero
        y = np.zeros((m, nb, 4))
        for j in range(count):
            y[:, :, j] = x[first + j]
        for k in range(m):
            start = row_start[k]
            for i in range(nb):
                scale = 1.0 / U[start, i, i]
                for j in range(4):
                    y[k, i, j] *= scale
                for b in range(i + 1, nb):
                    for j in range(4):
                        y[k, b, j] -= U[start, i, b] * y[k, i, j]
            for p in range(start + 1, row_start[k + 1]):
                for b in range(nb):
                    t0 = t1 = t2 = t3 = 0.0
                    for i in range(nb):
                        u = U[p, i, b]
                        t0 += u * y[k, i, 0]
                        t1 += u * y[k, i, 1]
                        t2 += u * y[k, i, 2]
                        t3 += u * y[k, i, 3]
                    y[cols[p], b, 0] -= t0
                    y[cols[p], b, 1] -= t1
                    y[cols[p], b, 2] -= t2
                    y[cols[p], b, 3] -= t3
        for k in range(m - 1, -1, -1):
            start = row_start[k]
            for p in range(start + 1, row_start[k + 1]):
                for i in range(nb):
                    t0 = t1 = t2 = t3 = 0.0
                    for b in range(nb):
                        u = U[p, i, b]
                        t0 += u * y[cols[p], b, 0]
                        t1 += u * y[cols[p], b, 1]
                        t2 += u * y[cols[p], b, 2]
                        t3 += u * y[cols[p], b, 3]
                    y[k, i, 0] -= t0
                    y[k, i, 1] -= t1
                    y[k, i, 2] -= t2
                    y[k, i, 3] -= t3
            for i in range(nb - 1, -1, -1):
                for b in range(i + 1, nb):
                    for j in range(4):
                        y[k, i, j] -= U[start, i, b] * y[k, b, j]
                scale = 1.0 / U[start, i, i]
                for j in range(4):
                    y[k, i, j] *= scale
        for j in range(count):
            x[first + j] = y[:, :, j]


@parallel_kernel(fastmath=SUMS)
def invert_blocks(unknowns, row_start, cols, Z):
    """A factor becomes, in place, the inverse of its matrix where it has blocks itself.

    From the last row to the first (Takahashi, Fagan and Chin, "Formation of a sparse bus impedance matrix", 1973): with
    W = D^-1 U the row left of its diagonal block D, the inverse is -W Z on the right and D^-1 D^-T + W Z W' on the
    diagonal, Z being the inverse of the rows after it.
    """
    nb, m = columns(unknowns), len(row_start) - 1
    widest = 1
    for k in range(m):
        widest = max(widest, row_start[k + 1] - row_start[k])
    W, flipped = np.empty((widest, nb, nb)), np.empty((widest, nb, nb))
    D_inv = np.zeros((nb, nb))
    for k in range(m - 1, -1, -1):
        start, end = row_start[k], row_start[k + 1]
        for j in range(nb):
            for i in range(j, -1, -1):
                v = 1.0 if i == j else 0.0
                for c in range(i + 1, j + 1):
                    v -= Z[start, i, c] * D_inv[c, j]
                D_inv[i, j] = v / Z[start, i, i]
        for p in range(start + 1, end):
            for i in range(nb):
                for b in range(nb):
                    v = 0.0
                    for c in range(i, nb):
                        v += D_inv[i, c] * Z[p, c, b]
                    W[p - start, i, b] = flipped[p - start, b, i] = v
        # blocks on the right are read and written here, but never the same
        for p in prange(start + 1, end):
            out, other = Z[p], np.empty((nb, nb))
            out[:] = 0.0
            col = cols[p]
            for q in range(start + 1, end):
                at = _place(row_start, cols, min(col, cols[q]), max(col, cols[q]))
                if q <= p:
                    _subtract_product(unknowns, flipped[q - start], Z[at], out)
                else:
                    for a in range(nb):
                        for b in range(nb):
                            other[a, b] = Z[at, b, a]
                    _subtract_product(unknowns, flipped[q - start], other, out)
        D = Z[start]
        for i in range(nb):
            for j in range(i, nb):
                v = 0.0
                for c in range(j, nb):
                    v += D_inv[i, c] * D_inv[j, c]
                D[i, j] = v
            for j in range(i):
                D[i, j] = 0.0
        for p in range(start + 1, end):
            for i in range(nb):
                for j in range(i, nb):
                    v = 0.0
                    for b in range(nb):
                        v += W[p - start, i, b] * Z[p, j, b]
                    D[i, j] -= v
        for i in range(nb):
            for j in range(i):
                D[i, j] = D[j, i]
