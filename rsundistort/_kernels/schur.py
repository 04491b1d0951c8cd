"""Block normal equations and the elimination of points.

Observations are sorted by point (`point_start` (n+1,) are their ranges); `frame_order` lists them by photo
(`frame_start` (m+1,)). Every loop in parallel owns what it writes, so sums do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from ._jit import kernel, parallel_kernel, prange


@parallel_kernel()
def point_blocks(point_start, res, J_frame, J_point, V, g_point, W):
    """V (n, 3, 3) = sum Jp'Jp, g (n, 3) = sum Jp'r and W (o, nb, 3) = Jf'Jp."""
    nb = J_frame.shape[2]
    for p in prange(len(V)):
        V[p] = 0.0
        g_point[p] = 0.0
        for k in range(point_start[p], point_start[p + 1]):
            for i in range(2):
                for a in range(3):
                    ja = J_point[k, i, a]
                    g_point[p, a] += ja * res[k, i]
                    for b in range(3):
                        V[p, a, b] += ja * J_point[k, i, b]
            for a in range(nb):
                for b in range(3):
                    W[k, a, b] = J_frame[k, 0, a] * J_point[k, 0, b] + J_frame[k, 1, a] * J_point[k, 1, b]


@parallel_kernel()
def frame_blocks(frame_start, frame_order, res, J_frame, U, g_frame):
    """U (m, nb, nb) = sum Jf'Jf and g (m, nb) = sum Jf'r."""
    nb = J_frame.shape[2]
    for f in prange(len(U)):
        U[f] = 0.0
        g_frame[f] = 0.0
        for s in range(frame_start[f], frame_start[f + 1]):
            k = frame_order[s]
            for i in range(2):
                for a in range(nb):
                    ja = J_frame[k, i, a]
                    g_frame[f, a] += ja * res[k, i]
                    for b in range(a + 1):
                        U[f, a, b] += ja * J_frame[k, i, b]
        for a in range(nb):
            for b in range(a):
                U[f, b, a] = U[f, a, b]


@kernel()
def _invert_spd3(A, damping, B):
    """B = (A + damping diag(A))^-1 of a symmetric positive 3x3 matrix; zero where it is singular."""
    a, d, f = A[0, 0] * (1.0 + damping), A[1, 1] * (1.0 + damping), A[2, 2] * (1.0 + damping)
    b, c, e = A[0, 1], A[0, 2], A[1, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * c00 + b * c01 + c * c02
    # a product of the diagonal that cancels to nothing: the point has no parallax, it is left where it is
    if not det > 1e-14 * a * d * f:
        B[:] = 0.0
        return
    B[0, 0] = c00 / det
    B[0, 1] = B[1, 0] = c01 / det
    B[0, 2] = B[2, 0] = c02 / det
    B[1, 1] = (a * f - c * c) / det
    B[1, 2] = B[2, 1] = (b * c - a * e) / det
    B[2, 2] = (a * d - b * b) / det


@parallel_kernel()
def eliminate_points(point_start, V, g_point, W, damping, V_inv, WV):
    """V_inv (n, 3, 3) of the damped point blocks and WV (o, nb, 3) = W V_inv."""
    nb = W.shape[1]
    for p in prange(len(V)):
        _invert_spd3(V[p], damping, V_inv[p])
        for k in range(point_start[p], point_start[p + 1]):
            for a in range(nb):
                for b in range(3):
                    WV[k, a, b] = (
                        W[k, a, 0] * V_inv[p, 0, b] + W[k, a, 1] * V_inv[p, 1, b] + W[k, a, 2] * V_inv[p, 2, b]
                    )


@kernel()
def _neighbours(f, frame_start, frame_order, frame_idx, point_idx, point_start, slot, found):
    """Photos >= f that share a point with f, ascending in found[:count]; slot (m,) is scratch of -1."""
    count = 0
    slot[f] = 0
    found[0] = f
    count = 1
    for s in range(frame_start[f], frame_start[f + 1]):
        p = point_idx[frame_order[s]]
        for k in range(point_start[p], point_start[p + 1]):
            g = frame_idx[k]
            if g > f and slot[g] < 0:
                slot[g] = 0
                found[count] = g
                count += 1
    found[:count].sort()
    return count


@kernel()
def covisible_counts(frame_start, frame_order, frame_idx, point_idx, point_start, counts):
    """Number of photos >= f that each photo f shares points with, itself included."""
    m = len(counts)
    slot = np.full(m, -1)
    found = np.empty(m, np.int64)
    for f in range(m):
        counts[f] = _neighbours(f, frame_start, frame_order, frame_idx, point_idx, point_start, slot, found)
        for i in range(counts[f]):
            slot[found[i]] = -1


@kernel()
def covisible_columns(frame_start, frame_order, frame_idx, point_idx, point_start, row_start, cols):
    """Block columns of the upper triangle of the reduced system, ascending in each block row."""
    m = len(row_start) - 1
    slot = np.full(m, -1)
    found = np.empty(m, np.int64)
    for f in range(m):
        count = _neighbours(f, frame_start, frame_order, frame_idx, point_idx, point_start, slot, found)
        for i in range(count):
            cols[row_start[f] + i] = found[i]
            slot[found[i]] = -1


@parallel_kernel()
def reduced_system(
    frame_start, frame_order, frame_idx, point_idx, point_start, row_start, cols,
    U, g_frame, g_point, W, WV, damping, S, rhs,
):  # fmt: skip
    """S (blocks, nb, nb) = U - W V^-1 W' (upper block triangle) and rhs (m, nb) = g - W V^-1 g_point."""
    m = len(U)
    nb = U.shape[1]
    for f in prange(m):
        slot = np.empty(m, np.int64)
        for i in range(row_start[f], row_start[f + 1]):
            slot[cols[i]] = i
            S[i] = 0.0
        for a in range(nb):
            rhs[f, a] = g_frame[f, a]
            for b in range(nb):
                S[row_start[f], a, b] = U[f, a, b]
            S[row_start[f], a, a] += damping * U[f, a, a]
        for s in range(frame_start[f], frame_start[f + 1]):
            k = frame_order[s]
            p = point_idx[k]
            for a in range(nb):
                rhs[f, a] -= WV[k, a, 0] * g_point[p, 0] + WV[k, a, 1] * g_point[p, 1] + WV[k, a, 2] * g_point[p, 2]
            for n in range(point_start[p], point_start[p + 1]):
                if frame_idx[n] >= f:
                    block = S[slot[frame_idx[n]]]
                    for a in range(nb):
                        w0, w1, w2 = WV[k, a, 0], WV[k, a, 1], WV[k, a, 2]
                        for b in range(nb):
                            block[a, b] -= w0 * W[n, b, 0] + w1 * W[n, b, 1] + w2 * W[n, b, 2]


@parallel_kernel()
def back_substitute(point_start, frame_idx, V_inv, g_point, W, step_frame, step_point):
    """step_point (n, 3) = -V^-1 (g_point + sum W' step_frame)."""
    nb = W.shape[1]
    for p in prange(len(V_inv)):
        t0, t1, t2 = g_point[p, 0], g_point[p, 1], g_point[p, 2]
        for k in range(point_start[p], point_start[p + 1]):
            f = frame_idx[k]
            for a in range(nb):
                d = step_frame[f, a]
                t0 += W[k, a, 0] * d
                t1 += W[k, a, 1] * d
                t2 += W[k, a, 2] * d
        for a in range(3):
            step_point[p, a] = -(V_inv[p, a, 0] * t0 + V_inv[p, a, 1] * t1 + V_inv[p, a, 2] * t2)
