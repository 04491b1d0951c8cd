"""Factor of a symmetric matrix of blocks, of which most are zero: U' U with U block upper triangular.

Block row k has size[k] rows, which stand one after the other in data[start[k]:start[k + 1]]: the blocks of columns
cols[i] >= k, row_start[k] <= i < row_start[k + 1], ascending from the diagonal, with those that the factorisation
fills. Block i begins in column[i] of these rows, so that blocks of neighbouring columns lie side by side, and products
run along all of them at once.
"""

from __future__ import annotations

import math

import numpy as np

from ._jit import SUMS, kernel, parallel_kernel, prange

# Columns of a product that are taken together: with three rows of a factor they fit in a processor's cache.
_TOGETHER = 512


@kernel()
def eliminate(row_start, cols, weight, order, joined):
    """An order in which block rows fill few blocks, each time the one with the lightest neighbours (minimum degree).

    weight (n,) are the sizes of the block rows; joined (n, n) bool, false before, gets the neighbours of each row when
    it is eliminated, without the diagonal.
    """
    n = len(order)
    for f in range(n):
        for i in range(row_start[f], row_start[f + 1]):
            if cols[i] != f:
                joined[f, cols[i]] = joined[cols[i], f] = True
    degree = np.empty(n, np.int64)
    for f in range(n):
        degree[f] = (joined[f] * weight).sum()
    left = np.ones(n, np.bool_)
    for step in range(n):
        best = -1
        for f in range(n):
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
            degree[f] = (joined[f] * weight).sum()


@kernel(forceinline=True)
def _place(row_start, cols, row, col):
    """Where a block of the upper triangle stands; -1 if it is not there."""
    low, high = row_start[row], row_start[row + 1] - 1
    while low < high:
        middle = (low + high) // 2
        if cols[middle] < col:
            low = middle + 1
        else:
            high = middle
    return low if cols[low] == col else -1


@parallel_kernel()
def fill_blocks(row_start, cols, column, start, size, first, second, S, scale, free, rank, begin, data):
    """Blocks S (blocks, nb, nb) of photos first[i] and second[i] into the data, scaled.

    A photo's unknowns are those of parts, begin[a] to begin[a + 1], each a block row: rank (m, parts). scale, free
    (m, nb); rows of held unknowns are those of the identity. Blocks that are not there are zero in S.
    """
    parts = rank.shape[1]
    data[:] = 0.0
    for i in prange(len(S)):
        f, g = first[i], second[i]
        for a in range(parts):
            # of a photo with itself each pair of parts once
            for b in range(a if f == g else 0, parts):
                row, col = rank[f, a], rank[g, b]
                at = _place(row_start, cols, min(row, col), max(row, col))
                if at < 0:
                    continue
                low = min(row, col)
                wide = (start[low + 1] - start[low]) // size[low]
                where = start[low] + column[at]
                for p in range(begin[a], begin[a + 1]):
                    for q in range(begin[b], begin[b + 1]):
                        value = S[i, p, q] * scale[f, p] * scale[g, q] * free[f, p] * free[g, q]
                        if row <= col:
                            data[where + (p - begin[a]) * wide + q - begin[b]] = value
                        else:
                            data[where + (q - begin[b]) * wide + p - begin[a]] = value
    for f in prange(len(rank)):
        for a in range(parts):
            row = rank[f, a]
            wide = (start[row + 1] - start[row]) // size[row]
            for p in range(size[row]):
                if not free[f, begin[a] + p]:
                    data[start[row] + p * wide + p] = 1.0


@kernel(fastmath=SUMS)
def _subtract_product(A, at, A_wide, h, w, B, begin, B_wide, out, to, wide, n):
    """A' B from out: h rows of A (w columns from `at`) and of B (n columns from `begin`), w rows of out from `to`.

    All are rows in one-dimensional data, so many values apart. Six rows of out and three of the others are taken at a
    time: what is loaded serves several products.
    """
    whole, three = w // 6 * 6, h // 3 * 3
    for low in range(0, n, _TOGETHER):
        m = min(_TOGETHER, n - low)
        for c in range(0, three, 3):
            b = begin + c * B_wide + low
            b0, b1, b2 = B[b : b + m], B[b + B_wide :], B[b + 2 * B_wide :]
            for a in range(0, whole, 6):
                s = at + c * A_wide + a
                u0, u1, u2 = A[s], A[s + A_wide], A[s + 2 * A_wide]
                v0, v1, v2 = A[s + 1], A[s + A_wide + 1], A[s + 2 * A_wide + 1]
                w0, w1, w2 = A[s + 2], A[s + A_wide + 2], A[s + 2 * A_wide + 2]
                x0, x1, x2 = A[s + 3], A[s + A_wide + 3], A[s + 2 * A_wide + 3]
                y0, y1, y2 = A[s + 4], A[s + A_wide + 4], A[s + 2 * A_wide + 4]
                z0, z1, z2 = A[s + 5], A[s + A_wide + 5], A[s + 2 * A_wide + 5]
                t = to + a * wide + low
                o0, o1, o2 = out[t:], out[t + wide :], out[t + 2 * wide :]
                o3, o4, o5 = out[t + 3 * wide :], out[t + 4 * wide :], out[t + 5 * wide :]
                for k in range(m):
                    p, q, r = b0[k], b1[k], b2[k]
                    o0[k] -= u0 * p + u1 * q + u2 * r
                    o1[k] -= v0 * p + v1 * q + v2 * r
                    o2[k] -= w0 * p + w1 * q + w2 * r
                    o3[k] -= x0 * p + x1 * q + x2 * r
                    o4[k] -= y0 * p + y1 * q + y2 * r
                    o5[k] -= z0 * p + z1 * q + z2 * r
        for c in range(h):
            b = begin + c * B_wide + low
            row = B[b : b + m]
            # rows of out that are left, and rows of both
            for a in range(whole if c < three else 0, w):
                x, o = A[at + c * A_wide + a], out[to + a * wide + low :]
                for k in range(m):
                    o[k] -= x * row[k]


@kernel(forceinline=True)
def _run(cols, column, size, q, end, at, last):
    """Blocks from q on, before `end`, that lie side by side in another row, too, from `at` or later, before `last`.

    Where they begin there, how many they are, and how many columns they have.
    """
    while cols[at] != cols[q]:
        at += 1
    run = 1
    while q + run < end and at + run < last and cols[at + run] == cols[q + run]:
        run += 1
    return at, run, column[q + run - 1] + size[cols[q + run - 1]] - column[q]


@kernel(forceinline=True)
def _together(cols, column, size, p, end):
    """Blocks from p on, before `end`, of columns that follow each other: how many, and how many columns they have."""
    run = 1
    while p + run < end and cols[p + run] == cols[p] + run:
        run += 1
    return run, column[p + run - 1] + size[cols[p + run - 1]] - column[p]


@parallel_kernel(fastmath=SUMS)
def factor_blocks(row_start, cols, column, start, size, data):
    """The factor in place of the matrix; False if that is not positive."""
    for k in range(len(size)):
        h, base = size[k], start[k]
        wide = (start[k + 1] - base) // h
        for i in range(h):
            own = data[base + i * wide : base + (i + 1) * wide]
            if not own[i] > 1e-15:  # of a unit diagonal
                return False
            x = 1.0 / math.sqrt(own[i])
            for b in range(i, wide):
                own[b] *= x
            for r in range(i + 1, h):
                x, row = own[r], data[base + r * wide : base + (r + 1) * wide]
                for b in range(r, wide):
                    row[b] -= x * own[b]
        end = row_start[k + 1]
        for p in prange(row_start[k] + 1, end):
            to = cols[p]
            w, last = size[to], row_start[to + 1]
            to_wide = (start[to + 1] - start[to]) // w
            at, q = row_start[to], p
            while q < end:
                at, run, n = _run(cols, column, size, q, end, at, last)
                _subtract_product(
                    data, base + column[p], wide, h, w, data, base + column[q], wide, data, start[to] + column[at],
                    to_wide, n,
                )  # fmt: skip
                q += run
                at += run
    return True


@kernel(fastmath=SUMS)
def _take_from(data, at, wide, h, s, n, y, to):
    """Rows of n values of the data, h of them and six at a time, times s (h, 4), from y (., 4) from `to` on."""
    six = h // 6 * 6
    for i in range(0, six, 6):
        r = at + i * wide
        u0, u1, u2 = data[r : r + n], data[r + wide :], data[r + 2 * wide :]
        u3, u4, u5 = data[r + 3 * wide :], data[r + 4 * wide :], data[r + 5 * wide :]
        a, b, c, d, e, f = s[i], s[i + 1], s[i + 2], s[i + 3], s[i + 4], s[i + 5]
        a0, b0, c0, d0, e0, f0 = a[0], b[0], c[0], d[0], e[0], f[0]
        a1, b1, c1, d1, e1, f1 = a[1], b[1], c[1], d[1], e[1], f[1]
        a2, b2, c2, d2, e2, f2 = a[2], b[2], c[2], d[2], e[2], f[2]
        a3, b3, c3, d3, e3, f3 = a[3], b[3], c[3], d[3], e[3], f[3]
        for k in range(n):
            v0, v1, v2, v3, v4, v5 = u0[k], u1[k], u2[k], u3[k], u4[k], u5[k]
            o = y[to + k]
            o[0] -= v0 * a0 + v1 * b0 + v2 * c0 + v3 * d0 + v4 * e0 + v5 * f0
            o[1] -= v0 * a1 + v1 * b1 + v2 * c1 + v3 * d1 + v4 * e1 + v5 * f1
            o[2] -= v0 * a2 + v1 * b2 + v2 * c2 + v3 * d2 + v4 * e2 + v5 * f2
            o[3] -= v0 * a3 + v1 * b3 + v2 * c3 + v3 * d3 + v4 * e3 + v5 * f3
    for i in range(six, h):
        u, a0, a1, a2, a3 = data[at + i * wide :], s[i, 0], s[i, 1], s[i, 2], s[i, 3]
        for k in range(n):
            v, o = u[k], y[to + k]
            o[0] -= v * a0
            o[1] -= v * a1
            o[2] -= v * a2
            o[3] -= v * a3


@kernel(fastmath=SUMS)
def _take_sums(data, at, wide, h, s, n, y, to):
    """Rows of n values of the data, h of them, times y (n, 4), from `to` on, from s (h, 4); three at a time."""
    three = h // 3 * 3
    for i in range(0, three, 3):
        r = at + i * wide
        u0, u1, u2 = data[r : r + n], data[r + wide :], data[r + 2 * wide :]
        a0 = a1 = a2 = a3 = b0 = b1 = b2 = b3 = c0 = c1 = c2 = c3 = 0.0
        for k in range(n):
            o, v0, v1, v2 = y[to + k], u0[k], u1[k], u2[k]
            y0, y1, y2, y3 = o[0], o[1], o[2], o[3]
            a0 += v0 * y0
            a1 += v0 * y1
            a2 += v0 * y2
            a3 += v0 * y3
            b0 += v1 * y0
            b1 += v1 * y1
            b2 += v1 * y2
            b3 += v1 * y3
            c0 += v2 * y0
            c1 += v2 * y1
            c2 += v2 * y2
            c3 += v2 * y3
        a, b, c = s[i], s[i + 1], s[i + 2]
        a[0] -= a0
        a[1] -= a1
        a[2] -= a2
        a[3] -= a3
        b[0] -= b0
        b[1] -= b1
        b[2] -= b2
        b[3] -= b3
        c[0] -= c0
        c[1] -= c1
        c[2] -= c2
        c[3] -= c3
    for i in range(three, h):
        u = data[at + i * wide :]
        for j in range(4):
            t = 0.0
            for k in range(n):
                t += u[k] * y[to + k, j]
            s[i, j] -= t


@parallel_kernel(fastmath=SUMS)
def solve_blocks(row_start, cols, column, start, size, position, data, x):
    """Right-hand sides x (k, unknowns) become solutions; block row i has the unknowns from position[i] on.

    Four are solved at a time, since reading the factor from memory dominates the time of a solution.
    """
    rows = len(size)
    for quad in prange((len(x) + 3) // 4):
        first, count = 4 * quad, min(4, len(x) - 4 * quad)
        # those beyond the last are zero
        y = np.zeros((x.shape[1], 4))
        for j in range(count):
            y[:, j] = x[first + j]
        for k in range(rows):
            h = size[k]
            wide, own = (start[k + 1] - start[k]) // h, position[k]
            for i in range(h):
                row = data[start[k] + i * wide :]
                d = 1.0 / row[i]
                for j in range(4):
                    y[own + i, j] *= d
                for b in range(i + 1, h):
                    for j in range(4):
                        y[own + b, j] -= row[b] * y[own + i, j]
            p, end = row_start[k] + 1, row_start[k + 1]
            while p < end:
                run, n = _together(cols, column, size, p, end)
                _take_from(data, start[k] + column[p], wide, h, y[own : own + h], n, y, position[cols[p]])
                p += run
        for k in range(rows - 1, -1, -1):
            h = size[k]
            wide, own = (start[k + 1] - start[k]) // h, position[k]
            p, end = row_start[k] + 1, row_start[k + 1]
            while p < end:
                run, n = _together(cols, column, size, p, end)
                _take_sums(data, start[k] + column[p], wide, h, y[own : own + h], n, y, position[cols[p]])
                p += run
            for i in range(h - 1, -1, -1):
                row = data[start[k] + i * wide :]
                for b in range(i + 1, h):
                    for j in range(4):
                        y[own + i, j] -= row[b] * y[own + b, j]
                d = 1.0 / row[i]
                for j in range(4):
                    y[own + i, j] *= d
        for j in range(count):
            x[first + j] = y[:, j]


@kernel(fastmath=SUMS)
def _subtract_outer(A, at, A_wide, h, B, begin, B_wide, w, out, to, wide, n):
    """A B' from out: h rows of A and w of B, n columns from `at` and `begin`; two of each at a time."""
    for i in range(0, h, 2):
        i2 = min(i + 1, h - 1)
        a0, a1 = A[at + i * A_wide : at + i * A_wide + n], A[at + i2 * A_wide :]
        for j in range(0, w, 2):
            j2 = min(j + 1, w - 1)
            b0, b1 = B[begin + j * B_wide :], B[begin + j2 * B_wide :]
            s00 = s01 = s10 = s11 = 0.0
            for k in range(n):
                s00 += a0[k] * b0[k]
                s01 += a0[k] * b1[k]
                s10 += a1[k] * b0[k]
                s11 += a1[k] * b1[k]
            out[to + i * wide + j] -= s00
            if j2 > j:
                out[to + i * wide + j2] -= s01
            if i2 > i:
                out[to + i2 * wide + j] -= s10
                if j2 > j:
                    out[to + i2 * wide + j2] -= s11


@parallel_kernel(fastmath=SUMS)
def invert_blocks(row_start, cols, column, start, size, parts, data):
    """A factor becomes, in place, the inverse of its matrix where it has blocks itself.

    From the last row to the first (Takahashi, Fagan and Chin, "Formation of a sparse bus impedance matrix", 1973): with
    W = D^-1 U the row left of its diagonal block D, the inverse is -W Z on the right and D^-1 D^-T + W Z W' on the
    diagonal, Z being the inverse of the rows after it. `parts` of W Z are summed side by side; their number decides the
    rounding, not that of the threads.
    """
    rows = len(size)
    widest, tallest = 1, 1
    for k in range(rows):
        tallest = max(tallest, size[k])
        widest = max(widest, (start[k + 1] - start[k]) // size[k])
    W, flipped = np.empty(tallest * widest), np.empty(widest * tallest)
    sums = np.empty((parts, tallest * widest))
    D_inv = np.zeros((tallest, tallest))
    for k in range(rows - 1, -1, -1):
        h, base, begin, end = size[k], start[k], row_start[k], row_start[k + 1]
        wide = (start[k + 1] - base) // h
        n = wide - h  # on the right of the diagonal block
        for j in range(h):
            for i in range(j, -1, -1):
                v = 1.0 if i == j else 0.0
                for c in range(i + 1, j + 1):
                    v -= data[base + i * wide + c] * D_inv[c, j]
                D_inv[i, j] = v / data[base + i * wide + i]
        for i in range(h):
            own = W[i * n : (i + 1) * n]
            own[:] = 0.0
            for c in range(i, h):
                x, row = D_inv[i, c], data[base + c * wide + h : base + (c + 1) * wide]
                for b in range(n):
                    own[b] += x * row[b]
            for b in range(n):
                flipped[b * h + i] = own[b]
        used = parts if end - begin > 2 * parts else 1
        for part in prange(used):
            out = sums[part]
            out[: h * n] = 0.0
            for p in range(begin + 1 + part, end, used):
                row, a = cols[p], column[p] - h
                w, last = size[row], row_start[row + 1]
                row_wide = (start[row + 1] - start[row]) // w
                at, q = row_start[row], p
                while q < end:
                    at, run, m = _run(cols, column, size, q, end, at, last)
                    Z, b = start[row] + column[at], column[q] - h
                    _subtract_product(flipped, a * h, h, w, h, data, Z, row_wide, out, b, n, m)
                    # and what is below the diagonal of Z, which is that row's mirror image
                    skip = w if q == p else 0
                    if m > skip:
                        _subtract_outer(W, b + skip, n, h, data, Z + skip, row_wide, w, out, a, n, m - skip)
                    q += run
                    at += run
        for part in range(1, used):
            for i in range(h * n):
                sums[0, i] += sums[part, i]
        for i in range(h):
            for b in range(n):
                data[base + i * wide + h + b] = sums[0, i * n + b]
        for i in range(h):
            for j in range(i, h):
                v = 0.0
                for c in range(j, h):
                    v += D_inv[i, c] * D_inv[j, c]
                own, other = W[i * n : (i + 1) * n], sums[0, j * n : (j + 1) * n]
                for b in range(n):
                    v -= own[b] * other[b]
                data[base + i * wide + j] = data[base + j * wide + i] = v
