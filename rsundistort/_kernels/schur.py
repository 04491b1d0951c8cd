"""Block normal equations and the elimination of points.

Observations are sorted by point (`track_start` (n+1,) are the ranges of their tracks); `frame_order` lists them by
photo (`frame_start` (m+1,)). Of each observation only the Jacobian J (o, 2, nb) of its
photo is stored: that of its point is minus that of the photo's centre, J_p = -J[:, :, 3:6]. Therefore the elimination
needs only a 2x2 matrix between the Jacobians of a pair of photos, and W = J'J_p is never written. `unknowns` stands for
nb, see `_jit.unknowns_of`: loops over a small block unroll. Every loop in parallel owns what it writes, so sums do not
depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload

from ._jit import SUMS, columns, kernel, parallel_kernel, prange

# Tracks that a thread takes at a time.
_CHUNK = 256
# Pivots of a point's block below this share of its diagonal are what rounding leaves: a parallax of a microradian.
_FLAT = 1e-12


@parallel_kernel()
def point_blocks(track_start, res, J, V, g_point):
    """V (n, 3, 3) = sum Jp'Jp and g (n, 3) = sum Jp'r."""
    n = len(V)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        for p in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            v00 = v01 = v02 = v11 = v12 = v22 = g0 = g1 = g2 = 0.0
            for k in range(track_start[p], track_start[p + 1]):
                for i in range(2):
                    a, b, c, r = J[k, i, 3], J[k, i, 4], J[k, i, 5], res[k, i]
                    v00 += a * a
                    v01 += a * b
                    v02 += a * c
                    v11 += b * b
                    v12 += b * c
                    v22 += c * c
                    g0 -= a * r
                    g1 -= b * r
                    g2 -= c * r
            V[p, 0, 0] = v00
            V[p, 0, 1] = V[p, 1, 0] = v01
            V[p, 0, 2] = V[p, 2, 0] = v02
            V[p, 1, 1] = v11
            V[p, 1, 2] = V[p, 2, 1] = v12
            V[p, 2, 2] = v22
            g_point[p, 0] = g0
            g_point[p, 1] = g1
            g_point[p, 2] = g2


@parallel_kernel()
def frame_gradients(frame_start, frame_order, res, J, diagonal, g_frame):
    """Diagonal (m, nb) of sum J'J and g (m, nb) = sum J'r."""
    nb = J.shape[2]
    for f in prange(len(g_frame)):
        diagonal[f] = 0.0
        g_frame[f] = 0.0
        for s in range(frame_start[f], frame_start[f + 1]):
            k = frame_order[s]
            r0, r1 = res[k, 0], res[k, 1]
            for a in range(nb):
                j0, j1 = J[k, 0, a], J[k, 1, a]
                diagonal[f, a] += j0 * j0 + j1 * j1
                g_frame[f, a] += j0 * r0 + j1 * r1


@kernel()
def _invert_spd3(A, damping, B):
    """B = (A + damping diag(A))^-1 of a symmetric positive 3x3 matrix; a generalised inverse where it is singular."""
    a, d, f = A[0, 0] * (1.0 + damping), A[1, 1] * (1.0 + damping), A[2, 2] * (1.0 + damping)
    b, c, e = A[0, 1], A[0, 2], A[1, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * c00 + b * c01 + c * c02
    if not det > _FLAT * a * d * f:
        _invert_flat3(A, damping, B)
        return
    B[0, 0] = c00 / det
    B[0, 1] = B[1, 0] = c01 / det
    B[0, 2] = B[2, 0] = c02 / det
    B[1, 1] = (a * f - c * c) / det
    B[1, 2] = B[2, 1] = (b * c - a * e) / det
    B[2, 2] = (a * d - b * b) / det


@kernel()
def _invert_flat3(A, damping, B):
    """The inverse of as many rows and columns of a 3x3 matrix as determine something, and zero for the others.

    A point without parallax stays where it is along the axis that is determined least; what its measurements say across
    it is kept. Any B with A B A = A gives the same reduced system, since the rows of the coupling are in A's range.
    """
    M = A.copy()
    for k in range(3):
        M[k, k] *= 1.0 + damping
    full = np.array([M[0, 0], M[1, 1], M[2, 2]])
    open_ = np.ones(3, np.bool_)
    for _ in range(3):
        best, share = -1, _FLAT
        for k in range(3):
            if open_[k] and M[k, k] > share * full[k]:
                best, share = k, M[k, k] / full[k]
        if best < 0:
            break
        open_[best] = False
        pivot = M[best, best]
        M[best, best] = 1.0
        for col in range(3):
            M[best, col] /= pivot
        for row in range(3):
            if row != best:
                factor = M[row, best]
                M[row, best] = 0.0
                for col in range(3):
                    M[row, col] -= factor * M[best, col]
    for row in range(3):
        for col in range(3):
            B[row, col] = 0.0 if open_[row] or open_[col] else M[row, col]


@parallel_kernel()
def invert_points(V, damping, V_inv):
    """V_inv (n, 3, 3) of the damped point blocks."""
    n = len(V)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        for p in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            _invert_spd3(V[p], damping, V_inv[p])


@intrinsic
def _add_product(typingctx, unknowns, S, i, J, k, n, m00, m01, m10, m11):
    """S[i] += J[k]' M J[n], rows of blocks as vectors.

    It is written in LLVM's own instructions: numba unrolls loops over so few columns into scalars, which takes four
    times as long.
    """

    def generate(context, builder, signature, args):
        columns = signature.args[0].count
        vector = ir.VectorType(ir.DoubleType(), columns)
        first = ir.Constant(ir.VectorType(ir.IntType(32), columns), [0] * columns)

        def row(array, block, r):
            ary = context.make_array(signature.args[array])(context, builder, value=args[array])
            at = [block, context.get_constant(types.intp, r), context.get_constant(types.intp, 0)]
            pointer = cgutils.get_item_pointer(context, builder, signature.args[array], ary, at)
            return builder.bitcast(pointer, vector.as_pointer())

        def times(value, x):
            filled = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.IntType(32)(0))
            return builder.fmul(builder.shuffle_vector(filled, filled, first), x, flags=("contract",))

        def plus(x, y):
            return builder.fadd(x, y, flags=("contract",))

        k0, k1, n0, n1 = (builder.load(row(3, block, r), align=8) for block in args[4:6] for r in range(2))
        m00, m01, m10, m11 = args[6:]
        l0, l1 = plus(times(m00, k0), times(m10, k1)), plus(times(m01, k0), times(m11, k1))
        for a in range(columns):
            pointer = row(1, args[2], a)
            l0a, l1a = (builder.extract_element(x, ir.IntType(32)(a)) for x in (l0, l1))
            total = plus(times(l1a, n1), plus(times(l0a, n0), builder.load(pointer, align=8)))
            builder.store(total, pointer, align=8)
        return context.get_dummy_value()

    return types.void(unknowns, S, i, J, k, n, m00, m01, m10, m11), generate


def add_product(unknowns, S, i, J, k, n, m00, m01, m10, m11):
    """S[i] += J[k]' M J[n], in a kernel."""
    raise NotImplementedError


@overload(add_product, jit_options={"fastmath": {"contract"}})
def _of_columns(unknowns, S, i, J, k, n, m00, m01, m10, m11):
    if isinstance(unknowns, types.BaseTuple):
        return lambda unknowns, S, i, J, k, n, m00, m01, m10, m11: _add_product(
            unknowns, S, i, J, k, n, m00, m01, m10, m11
        )

    def wide(unknowns, S, i, J, k, n, m00, m01, m10, m11):
        for a in range(unknowns):
            l0, l1 = m00 * J[k, 0, a] + m10 * J[k, 1, a], m01 * J[k, 0, a] + m11 * J[k, 1, a]
            for b in range(unknowns):
                S[i, a, b] += l0 * J[n, 0, b] + l1 * J[n, 1, b]

    return wide


@kernel(fastmath=SUMS)
def _times(x0, x1, x2, B, p):
    """Row (x0, x1, x2) times the symmetric matrix B[p]."""
    return (
        x0 * B[p, 0, 0] + x1 * B[p, 0, 1] + x2 * B[p, 0, 2],
        x0 * B[p, 0, 1] + x1 * B[p, 1, 1] + x2 * B[p, 1, 2],
        x0 * B[p, 0, 2] + x1 * B[p, 1, 2] + x2 * B[p, 2, 2],
    )


@kernel(forceinline=True, fastmath=SUMS)
def _between(u0, u1, u2, w0, w1, w2, J, k, n):
    """M of two measurements of a track, 2x2: 1 if k = n, less J_p,k V^-1 J_p,n'; u and w are rows of -J_p,k V^-1.

    J_p,n is minus J's columns of the centre: the sign is reversed, so that products with M are added.
    """
    c0, c1, c2 = J[n, 0, 3], J[n, 0, 4], J[n, 0, 5]
    d0, d1, d2 = J[n, 1, 3], J[n, 1, 4], J[n, 1, 5]
    own = 1.0 if n == k else 0.0
    return (
        u0 * c0 + u1 * c1 + u2 * c2 + own,
        u0 * d0 + u1 * d1 + u2 * d2,
        w0 * c0 + w1 * c1 + w2 * c2,
        w0 * d0 + w1 * d1 + w2 * d2 + own,
    )


@parallel_kernel(fastmath=SUMS)
def reduced_system(
    unknowns, frame_start, frame_order, frame_idx, point_idx, track_start, row_start, cols,
    J, V_inv, g_point, g_frame, diagonal, S, rhs,
):  # fmt: skip
    """S (blocks, nb, nb) = U + diag(diagonal) - W V^-1 W' (upper block triangle) and rhs (m, nb) = g - W V^-1 g_point.

    With W = J'J_p, W_k V^-1 W_n' = J_k' M J_n, where M = J_p,k V^-1 J_p,n' is 2x2; U = sum J'J goes with k = n.
    """
    nb = columns(unknowns)
    m = len(g_frame)
    for f in prange(m):
        slot = np.empty(m, np.int64)
        for i in range(row_start[f], row_start[f + 1]):
            slot[cols[i]] = i
            S[i] = 0.0
        for a in range(nb):
            rhs[f, a] = g_frame[f, a]
            S[row_start[f], a, a] = diagonal[f, a]
        for s in range(frame_start[f], frame_start[f + 1]):
            k = frame_order[s]
            p = point_idx[k]
            u0, u1, u2 = _times(-J[k, 0, 3], -J[k, 0, 4], -J[k, 0, 5], V_inv, p)
            w0, w1, w2 = _times(-J[k, 1, 3], -J[k, 1, 4], -J[k, 1, 5], V_inv, p)
            e0 = u0 * g_point[p, 0] + u1 * g_point[p, 1] + u2 * g_point[p, 2]
            e1 = w0 * g_point[p, 0] + w1 * g_point[p, 1] + w2 * g_point[p, 2]
            for a in range(nb):
                rhs[f, a] -= J[k, 0, a] * e0 + J[k, 1, a] * e1
            for n in range(track_start[p], track_start[p + 1]):
                if frame_idx[n] >= f:
                    m00, m01, m10, m11 = _between(u0, u1, u2, w0, w1, w2, J, k, n)
                    add_product(unknowns, S, slot[frame_idx[n]], J, k, n, m00, m01, m10, m11)


@kernel(forceinline=True)
def _add_product_to(row, l0, l1, r0, r1):
    """Add two products with a number to a row."""
    for b in range(len(row)):
        row[b] += l0 * r0[b] + l1 * r1[b]


@parallel_kernel(fastmath=SUMS)
def border_rows(
    frame_start, frame_order, frame_idx, point_idx, track_start, camera_of_frame,
    J, J_camera, V_inv, g_point, B, rhs,
):  # fmt: skip
    """The reduced system against the k unknowns of all cameras together, nc each, as a share of every photo f.

    B (m, nb + nc, k): rows of its own unknowns, then of its camera's (to be summed over the photos of a camera), and
    rhs (m, nc): -W V^-1 g_point of its camera.
    """
    nb, nc = J.shape[2], J_camera.shape[2]
    for f in prange(len(B)):
        r0, r1, l0, l1 = np.empty(nc), np.empty(nc), np.empty(nb + nc), np.empty(nb + nc)
        # long rows in one piece: B transposed, by camera
        sums = np.zeros((B.shape[2] // nc, nc, nb + nc))
        rhs[f] = 0.0
        for s in range(frame_start[f], frame_start[f + 1]):
            k = frame_order[s]
            p = point_idx[k]
            u0, u1, u2 = _times(-J[k, 0, 3], -J[k, 0, 4], -J[k, 0, 5], V_inv, p)
            w0, w1, w2 = _times(-J[k, 1, 3], -J[k, 1, 4], -J[k, 1, 5], V_inv, p)
            e0 = u0 * g_point[p, 0] + u1 * g_point[p, 1] + u2 * g_point[p, 2]
            e1 = w0 * g_point[p, 0] + w1 * g_point[p, 1] + w2 * g_point[p, 2]
            _add_product_to(rhs[f], -e0, -e1, J_camera[k, 0], J_camera[k, 1])
            l0[:nb], l1[:nb] = J[k, 0], J[k, 1]
            l0[nb:], l1[nb:] = J_camera[k, 0], J_camera[k, 1]
            n, end = track_start[p], track_start[p + 1]
            while n < end:
                # shares of one camera's photos in a track are summed before they are multiplied with the photo's own
                camera = camera_of_frame[frame_idx[n]]
                r0[:] = 0.0
                r1[:] = 0.0
                while n < end and camera_of_frame[frame_idx[n]] == camera:
                    m00, m01, m10, m11 = _between(u0, u1, u2, w0, w1, w2, J, k, n)
                    _add_product_to(r0, m00, m01, J_camera[n, 0], J_camera[n, 1])
                    _add_product_to(r1, m10, m11, J_camera[n, 0], J_camera[n, 1])
                    n += 1
                for b in range(nc):
                    _add_product_to(sums[camera, b], r0[b], r1[b], l0, l1)
        for camera in range(len(sums)):
            B[f, :, camera * nc : camera * nc + nc] = sums[camera].T


@parallel_kernel(fastmath=SUMS)
def group_gradients(
    frame_start, frame_order, point_idx, track_start, res, J, J_camera, V_inv, group, g_frame, g_camera
):  # fmt: skip
    """Shares of groups of measurements in J'r - W V^-1 Jp'r: g_frame (m, groups, nb), g_camera (m, groups, nc).

    A measurement k pulls at its point, and thereby at all photos n of its track: J_n' (1_nk - J_p,n V^-1 J_p,k') r_k.
    """
    for f in prange(len(g_frame)):
        g_frame[f] = 0.0
        g_camera[f] = 0.0
        for s in range(frame_start[f], frame_start[f + 1]):
            n = frame_order[s]
            p = point_idx[n]
            # J_p is minus these: the sign of their product stays
            u0, u1, u2 = _times(J[n, 0, 3], J[n, 0, 4], J[n, 0, 5], V_inv, p)
            w0, w1, w2 = _times(J[n, 1, 3], J[n, 1, 4], J[n, 1, 5], V_inv, p)
            # what the measurements of one group, which mostly follow each other, leave is summed first
            g, x, y = group[track_start[p]], 0.0, 0.0
            for k in range(track_start[p], track_start[p + 1]):
                if group[k] != g:
                    _add_product_to(g_frame[f, g], x, y, J[n, 0], J[n, 1])
                    _add_product_to(g_camera[f, g], x, y, J_camera[n, 0], J_camera[n, 1])
                    g, x, y = group[k], 0.0, 0.0
                r0, r1 = res[k, 0], res[k, 1]
                e0 = J[k, 0, 3] * r0 + J[k, 1, 3] * r1
                e1 = J[k, 0, 4] * r0 + J[k, 1, 4] * r1
                e2 = J[k, 0, 5] * r0 + J[k, 1, 5] * r1
                x -= u0 * e0 + u1 * e1 + u2 * e2
                y -= w0 * e0 + w1 * e1 + w2 * e2
                if k == n:
                    x += r0
                    y += r1
            _add_product_to(g_frame[f, g], x, y, J[n, 0], J[n, 1])
            _add_product_to(g_camera[f, g], x, y, J_camera[n, 0], J_camera[n, 1])


@parallel_kernel(fastmath=SUMS)
def back_substitute(track_start, frame_idx, V_inv, g_point, J, step_frame, step_point):
    """step_point (n, 3) = -V^-1 (g_point + sum Jp' J step_frame)."""
    nb = J.shape[2]
    n = len(V_inv)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        for p in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            t0, t1, t2 = g_point[p, 0], g_point[p, 1], g_point[p, 2]
            for k in range(track_start[p], track_start[p + 1]):
                f = frame_idx[k]
                x = y = 0.0
                for a in range(nb):
                    x += J[k, 0, a] * step_frame[f, a]
                    y += J[k, 1, a] * step_frame[f, a]
                t0 -= J[k, 0, 3] * x + J[k, 1, 3] * y
                t1 -= J[k, 0, 4] * x + J[k, 1, 4] * y
                t2 -= J[k, 0, 5] * x + J[k, 1, 5] * y
            for a in range(3):
                step_point[p, a] = -(V_inv[p, a, 0] * t0 + V_inv[p, a, 1] * t1 + V_inv[p, a, 2] * t2)
