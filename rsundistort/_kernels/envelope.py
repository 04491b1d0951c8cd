"""Cholesky factor of a symmetric matrix inside its envelope.

Rows of the factor L are kept in bands of four, each band from its first column (a multiple of four) to its diagonal,
rows one after the other: entry (4 g + r, c) is data[offset[g] + r * (4 g + 4 - first[g]) + c - first[g]].
"""

from __future__ import annotations

import math

import numpy as np

from ._jit import SUMS, kernel, parallel_kernel, prange

# Number of bands that use a column of the factor together: with their own rows they fit in a processor's cache.
_TOGETHER = 8


@parallel_kernel()
def fill_envelope(place, row_start, cols, S, scale, first, offset, data):
    """Blocks into the envelope, scaled on both sides; place (m, nb) is each unknown's row, -1 if held.

    Rows past the last unknown, up to a multiple of four, are those of the identity.
    """
    data[:] = 0.0
    nb = place.shape[1]
    for g in range(len(first)):
        for r in range(4):
            data[offset[g] + r * (4 * g + 4 - first[g]) + 4 * g + r - first[g]] = 1.0
    for f in prange(len(row_start) - 1):
        for i in range(row_start[f], row_start[f + 1]):
            for a in range(nb):
                for b in range(nb):
                    row, col = place[f, a], place[cols[i], b]
                    value = S[i, a, b]
                    if row < col:
                        row, col = col, row
                        if cols[i] == f:
                            continue
                    g = row // 4
                    if col >= 0:
                        at = offset[g] + (row - 4 * g) * (4 * g + 4 - first[g]) + col - first[g]
                        data[at] = value * scale[row] * scale[col]


@kernel(fastmath=SUMS)
def _band_tile(data, first, offset, g, c):
    """Columns 4c to 4c + 3 of band g of the factor, from the columns before them; False if it is not positive."""
    fg, fc = first[g], first[c]
    wg, wc = 4 * g + 4 - fg, 4 * c + 4 - fc
    low = max(fg, fc)
    width = 4 * c - low
    a = offset[g] + low - fg
    b = offset[c] + low - fc
    a0, a1, a2, a3 = data[a:], data[a + wg :], data[a + 2 * wg :], data[a + 3 * wg :]
    b0, b1, b2, b3 = data[b:], data[b + wc :], data[b + 2 * wc :], data[b + 3 * wc :]
    s00 = s01 = s02 = s03 = s10 = s11 = s12 = s13 = 0.0
    s20 = s21 = s22 = s23 = s30 = s31 = s32 = s33 = 0.0
    for k in range(width):
        x0, x1, x2, x3 = a0[k], a1[k], a2[k], a3[k]
        y0, y1, y2, y3 = b0[k], b1[k], b2[k], b3[k]
        s00 += x0 * y0
        s01 += x0 * y1
        s02 += x0 * y2
        s03 += x0 * y3
        s10 += x1 * y0
        s11 += x1 * y1
        s12 += x1 * y2
        s13 += x1 * y3
        s20 += x2 * y0
        s21 += x2 * y1
        s22 += x2 * y2
        s23 += x2 * y3
        s30 += x3 * y0
        s31 += x3 * y1
        s32 += x3 * y2
        s33 += x3 * y3
    sums = ((s00, s01, s02, s03), (s10, s11, s12, s13), (s20, s21, s22, s23), (s30, s31, s32, s33))
    at, dia = offset[g] + 4 * c - fg, offset[c] + 4 * c - fc
    for i in range(4):
        row = at + i * wg
        for j in range(i + 1 if g == c else 4):
            v = data[row + j] - sums[i][j]
            for k in range(j):
                v -= data[row + k] * data[dia + j * wc + k]
            if g == c and i == j:
                if not v > 1e-15:  # of a unit diagonal
                    return False
                data[row + j] = math.sqrt(v)
            else:
                data[row + j] = v / data[dia + j * wc + j]
    return True


@parallel_kernel()
def factor_envelope(first, offset, panel, data):
    """Cholesky factor in place, `panel` bands at a time; False if the matrix is not positive."""
    bands = len(first)
    for start in range(0, bands, panel):
        stop = min(bands, start + panel)
        # bands of a panel do not need each other up to its first column; a few of them take each column together,
        # while it is at hand
        begin = first[start:stop].min() // 4
        if start > begin:
            for part in prange((stop - start + _TOGETHER - 1) // _TOGETHER):
                low = start + part * _TOGETHER
                for c in range(begin, start):
                    for g in range(low, min(stop, low + _TOGETHER)):
                        if first[g] <= 4 * c:
                            _band_tile(data, first, offset, g, c)
        for g in range(start, stop):
            for c in range(max(first[g] // 4, start), g + 1):
                if not _band_tile(data, first, offset, g, c):
                    return False
    return True


@parallel_kernel(fastmath=SUMS)
def solve_envelope(first, offset, data, B):
    """B (k, n): right-hand sides become solutions, n a multiple of four.

    Four are solved at a time, since reading the factor from memory dominates the time of a solution.
    """
    for quad in prange((len(B) + 3) // 4):
        j = 4 * quad
        last = len(B) - 1
        # those beyond the last repeat it, in a copy that is not read
        x0 = B[j]
        x1 = B[j + 1] if j + 1 <= last else B[last].copy()
        x2 = B[j + 2] if j + 2 <= last else B[last].copy()
        x3 = B[j + 3] if j + 3 <= last else B[last].copy()
        n = len(x0)
        begin = 0  # columns of the identity begin late
        while begin < n and x0[begin] == 0.0 and x1[begin] == 0.0 and x2[begin] == 0.0 and x3[begin] == 0.0:
            begin += 1
        for i in range(begin, n):
            g = i // 4
            fg = first[g]
            at = offset[g] + (i - 4 * g) * (4 * g + 4 - fg)
            t0 = t1 = t2 = t3 = 0.0
            for k in range(i - fg):
                d = data[at + k]
                t0 += d * x0[fg + k]
                t1 += d * x1[fg + k]
                t2 += d * x2[fg + k]
                t3 += d * x3[fg + k]
            d = 1.0 / data[at + i - fg]
            x0[i], x1[i], x2[i], x3[i] = (x0[i] - t0) * d, (x1[i] - t1) * d, (x2[i] - t2) * d, (x3[i] - t3) * d
        for i in range(n - 1, -1, -1):
            g = i // 4
            fg = first[g]
            at = offset[g] + (i - 4 * g) * (4 * g + 4 - fg)
            d = 1.0 / data[at + i - fg]
            t0, t1, t2, t3 = x0[i] * d, x1[i] * d, x2[i] * d, x3[i] * d
            x0[i], x1[i], x2[i], x3[i] = t0, t1, t2, t3
            for k in range(i - fg):
                d = data[at + k]
                x0[fg + k] -= t0 * d
                x1[fg + k] -= t1 * d
                x2[fg + k] -= t2 * d
                x3[fg + k] -= t3 * d


@kernel(fastmath=SUMS)
def _times_band(data, first, offset, g, h, V, out):
    """Add band h of the inverse (both triangles) times V (4, n) to out (4, n), in the columns after band g."""
    low, width = 4 * g + 4, 4 * h + 4 - first[h]
    at = offset[h] + low - first[h]
    z0, z1, z2, z3 = data[at:], data[at + width :], data[at + 2 * width :], data[at + 3 * width :]
    n = 4 * h - low
    for c in range(4):
        v, o = V[c, low:], out[c, low:]
        v0, v1, v2, v3 = v[n], v[n + 1], v[n + 2], v[n + 3]
        s0 = s1 = s2 = s3 = 0.0
        for k in range(n):
            s0 += z0[k] * v[k]
            s1 += z1[k] * v[k]
            s2 += z2[k] * v[k]
            s3 += z3[k] * v[k]
        for k in range(n):
            o[k] += z0[k] * v0 + z1[k] * v1 + z2[k] * v2 + z3[k] * v3
        o[n] += s0 + z0[n] * v0 + z1[n] * v1 + z2[n] * v2 + z3[n] * v3
        o[n + 1] += s1 + z1[n] * v0 + z1[n + 1] * v1 + z2[n + 1] * v2 + z3[n + 1] * v3
        o[n + 2] += s2 + z2[n] * v0 + z2[n + 1] * v1 + z2[n + 2] * v2 + z3[n + 2] * v3
        o[n + 3] += s3 + z3[n] * v0 + z3[n + 1] * v1 + z3[n + 2] * v2 + z3[n + 3] * v3


@parallel_kernel()
def invert_envelope(first, offset, parts, data):
    """A factor becomes, in place, the inverse of its matrix, inside the envelope only.

    From the last band to the first (Takahashi, Fagan and Chin, "Formation of a sparse bus impedance matrix", 1973):
    with D the diagonal block of a band of L and W what is below it, V = W D^-1, the inverse is -Z V below and
    D^-T D^-1 + V' Z V on the diagonal, Z being the inverse of the bands after it. `parts` of these are summed side by
    side; their number decides the rounding, not that of the threads.
    """
    bands = len(first)
    V, D_inv = np.zeros((4, 4 * bands)), np.zeros((4, 4))
    out = np.zeros((parts, 4, 4 * bands))
    for g in range(bands - 1, -1, -1):
        width = 4 * g + 4 - first[g]
        dia = offset[g] + 4 * g - first[g]
        for j in range(4):
            for i in range(j, 4):
                v = 1.0 if i == j else 0.0
                for k in range(j, i):
                    v -= data[dia + i * width + k] * D_inv[k, j]
                D_inv[i, j] = v / data[dia + i * width + i]
        last = g
        for h in range(g + 1, bands):
            if first[h] <= 4 * g:
                last = h
        stop = 4 * last + 4
        for h in range(g + 1, last + 1):
            for r in range(4):
                at = offset[h] + r * (4 * h + 4 - first[h]) + 4 * g - first[h]
                for c in range(4):
                    v = 0.0
                    if first[h] <= 4 * g:
                        for k in range(c, 4):
                            v += data[at + k] * D_inv[k, c]
                    V[c, 4 * h + r] = v
        for part in prange(parts):
            for c in range(4):
                for k in range(4 * g + 4, stop):
                    out[part, c, k] = 0.0
            for h in range(g + 1 + part, last + 1, parts):
                if first[h] <= 4 * g:
                    _times_band(data, first, offset, g, h, V, out[part])
        for part in range(1, parts):
            for c in range(4):
                for k in range(4 * g + 4, stop):
                    out[0, c, k] += out[part, c, k]
        for h in range(g + 1, last + 1):
            if first[h] <= 4 * g:
                for r in range(4):
                    at = offset[h] + r * (4 * h + 4 - first[h]) + 4 * g - first[h]
                    for c in range(4):
                        data[at + c] = -out[0, c, 4 * h + r]
        for i in range(4):
            for j in range(i + 1):
                v = 0.0
                for k in range(i, 4):
                    v += D_inv[k, i] * D_inv[k, j]
                for k in range(4 * g + 4, stop):
                    v += V[i, k] * out[0, j, k]
                data[dia + i * width + j] = v
