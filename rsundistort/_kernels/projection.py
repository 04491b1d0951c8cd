"""The row models: a point of the camera's frame into the pixel that shows it, a pixel into its direction."""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel, parallel_kernel, prange
from .lens import MAX_NEWTON, ROW_TOL, distort, undistort
from .motion import moves, path, rodrigues, rotate, row_phi, third_factor

GLOBAL, TWO_STEP, LINEARIZED, ROTATION, CONSTANT_MOTION = 0, 1, 2, 3, 4

# Points that a thread takes at once.
CHUNK = 512
# Newton on the row takes its last step from a gap below this (normalised units): the step squares the gap, and the
# curvature of the gap is of the order of phi, so 1e-17 is left. Of a motion that is not steady, whose derivative is
# approximate, a hundredth of the gap is left at the most.
_LAST_GAP = 1e-8
# Derivatives are taken at the row itself: they change as the gap does.
_SAME_ROW = 1e-13
_STILL = np.zeros(3)


@kernel(forceinline=True)
def _shutter_two_step(X, Y, q0, q1, q2, d):
    """Paper Eqs. 8-9 for row readout; d gets C, R and their derivatives in X, Y, q (2 + 2 x 5)."""
    X2 = X - q2 * Y * Y
    Y2 = Y + q2 * X * Y
    aspect = 1.0 - q0
    d[0] = X2 + q1 * Y2
    d[1] = aspect * Y2
    yx, yy, yq = q2 * Y, 1.0 + q2 * X, X * Y
    d[2] = 1.0 + q1 * yx
    d[3] = -2.0 * q2 * Y + q1 * yy
    d[4] = 0.0
    d[5] = Y2
    d[6] = -Y * Y + q1 * yq
    d[7] = aspect * yx
    d[8] = aspect * yy
    d[9] = -Y2
    d[10] = 0.0
    d[11] = aspect * yq
    return aspect > 0.0 and yy > 0.0


@kernel(forceinline=True)
def _shutter_linearized(X, Y, q0, q1, q2, d):
    """Paper Eq. 5 for row readout, with the implicit row solved in closed form; d as in the two-step model."""
    a = q0 * Y - q1 * X
    b = 1.0 + q0 - q2 * X
    disc = b * b + 4.0 * a * Y
    if not (disc > 0.0 and b > 0.0):
        return False
    root = math.sqrt(disc)
    r = 2.0 * Y / (b + root)
    D = 1.0 + r * a
    if not D > 0.0:
        return False
    m = q1 - q2 * Y
    c = (X + r * m) / D
    d[0] = c
    d[1] = r
    r2 = r * r
    # root is the derivative of a r^2 + b r - y' with respect to r
    d[7] = (q1 * r2 + q2 * r) / root
    d[8] = (1.0 - q0 * r2) / root
    d[9] = -(Y * r2 + r) / root
    d[10] = X * r2 / root
    d[11] = X * r / root
    ca = r * c / D
    cr = (m - a * c) / D
    d[2] = (1.0 + ca * q1 * D) / D + cr * d[7]
    d[3] = (-r * q2 - ca * q0 * D) / D + cr * d[8]
    d[4] = -ca * Y + cr * d[9]
    d[5] = r / D + ca * X + cr * d[10]
    d[6] = -r * Y / D + cr * d[11]
    return True


@kernel(forceinline=True)
def project(model, axis, sign, lens, x, y, z, phi, vel, start, out, jac):
    """One camera-frame point into distorted normalised coordinates out[:2]; True when it is valid.

    The exact models search the row from `start`; when that is NaN, from the row of a camera that does not move.

    With jac: out[2:8] derivative with respect to the point (2, 3), out[8:14] to the rotation at the row and out[14:20]
    to the position there, which only the constant-motion model uses. Times out[20], the clock, they are those with
    respect to phi and to the velocity. The approximate models have those at once, and a one.
    """
    if not z > 0.0:
        return False
    X = x / z
    Y = y / z
    out[20] = 1.0
    if model >= ROTATION:
        moving = 1.0 if model == CONSTANT_MOTION else 0.0
        return project_exact(axis, sign, lens, x, y, z, phi, vel, moving, start, out, jac)
    if model == GLOBAL:
        xd, yd, xx, xy, yx, yy, ok = distort(lens, X, Y)
        out[0] = xd
        out[1] = yd
        if jac:
            out[2] = xx / z
            out[3] = xy / z
            out[4] = -(xx * X + xy * Y) / z
            out[5] = yx / z
            out[6] = yy / z
            out[7] = -(yx * X + yy * Y) / z
            for k in range(8, 20):
                out[k] = 0.0
        return ok
    q0, q1, q2 = row_phi(axis, sign, phi)
    d = out[8:20]  # used as scratch; overwritten below
    if axis == 0:
        X, Y = Y, X
    if model == TWO_STEP:
        if not _shutter_two_step(X, Y, q0, q1, q2, d):
            return False
    elif not _shutter_linearized(X, Y, q0, q1, q2, d):
        return False
    C, R = d[0], d[1]
    Cx, Cy, C0, C1, C2 = d[2], d[3], d[4], d[5], d[6]
    Rx, Ry, R0, R1, R2 = d[7], d[8], d[9], d[10], d[11]
    if axis == 0:
        C, R = R, C
        X, Y = Y, X
        Cx, Cy, Rx, Ry = Ry, Rx, Cy, Cx
        C0, C1, C2, R0, R1, R2 = -sign * R1, -sign * R0, -sign * R2, -sign * C1, -sign * C0, -sign * C2
    elif sign < 0:
        C0, C1, C2, R0, R1, R2 = -C0, -C1, -C2, -R0, -R1, -R2
    xd, yd, xx, xy, yx, yy, ok = distort(lens, C, R)
    out[0] = xd
    out[1] = yd
    if jac:
        ux, uy = xx * Cx + xy * Rx, xx * Cy + xy * Ry
        vx, vy = yx * Cx + yy * Rx, yx * Cy + yy * Ry
        out[2] = ux / z
        out[3] = uy / z
        out[4] = -(ux * X + uy * Y) / z
        out[5] = vx / z
        out[6] = vy / z
        out[7] = -(vx * X + vy * Y) / z
        out[8] = xx * C0 + xy * R0
        out[9] = xx * C1 + xy * R1
        out[10] = xx * C2 + xy * R2
        out[11] = yx * C0 + yy * R0
        out[12] = yx * C1 + yy * R1
        out[13] = yx * C2 + yy * R2
        for k in range(14, 20):
            out[k] = 0.0
    return ok


@kernel(forceinline=True)
def project_exact(axis, sign, lens, x, y, z, phi, vel, moving, start, out, jac):
    """Paper Eq. 2 whole, q(t) = Exp(w(t)) (x - p(t)), with t the distorted row (or column) that the sensor read.

    w and p are those of `path`; with moving = 0 it is the rotation model. For `start` and `out` see `project`.
    """
    t = start
    if t != t:
        xd, yd, xx, xy, yx, yy, ok = distort(lens, x / z, y / z)
        t = sign * (yd if axis == 1 else xd)
    for _ in range(MAX_NEWTON):
        w0, w1, w2, f0, f1, f2, p0, p1, p2, v0, v1, v2 = path(phi, vel, moving, t)
        angle2 = w0 * w0 + w1 * w1 + w2 * w2
        a, b = rodrigues(angle2)
        q0, q1, q2 = rotate(w0, w1, w2, a, b, x - p0, y - p1, z - p2)
        if not q2 > 0.0:
            return False
        # without derivatives, it only has to lead to the row
        d0, d1, d2 = moves(w0, w1, w2, f0, f1, f2, phi, jac, a, b, q0, q1, q2)
        if moving != 0.0:
            e0, e1, e2 = rotate(w0, w1, w2, a, b, v0, v1, v2)
            d0, d1, d2 = d0 - e0, d1 - e1, d2 - e2
        inverse = 1.0 / q2
        X, Y = q0 * inverse, q1 * inverse
        xd, yd, xx, xy, yx, yy, ok = distort(lens, X, Y)
        dX, dY = (d0 - X * d2) * inverse, (d1 - Y * d2) * inverse
        xt, yt = xx * dX + xy * dY, yx * dX + yy * dY
        slope = sign * (yt if axis == 1 else xt) - 1.0
        if not slope < -1e-3:  # the rows fold over: a row would see the point twice
            return False
        gap = sign * (yd if axis == 1 else xd) - t
        if abs(gap) < (_SAME_ROW if jac else _LAST_GAP):
            break
        t -= gap / slope
    else:
        return False
    # the last step, along the tangent
    out[0] = xd - xt * gap / slope
    out[1] = yd - yt * gap / slope
    if not jac:
        return ok
    c = third_factor(angle2, a)
    out[20] = t
    row0, row1 = (yx, yy) if axis == 1 else (xx, xy)
    for i in range(2):
        # derivatives of a distorted coordinate by X and Y: at a fixed t, and as the implicit row moves
        ux, uy, ut = (xx, xy, xt) if i == 0 else (yx, yy, yt)
        s = -sign * ut / slope
        ux, uy = (ux + s * row0) * inverse, (uy + s * row1) * inverse
        uz = -(ux * X + uy * Y)
        # point: dq = E dx; position: dq = -E dp; rotation: dq = -[q] L dw
        p0, p1, p2 = rotate(w0, w1, w2, -a, b, ux, uy, uz)
        out[2 + 3 * i], out[3 + 3 * i], out[4 + 3 * i] = p0, p1, p2
        out[14 + 3 * i], out[15 + 3 * i], out[16 + 3 * i] = -moving * p0, -moving * p1, -moving * p2
        c0, c1, c2 = q1 * uz - q2 * uy, q2 * ux - q0 * uz, q0 * uy - q1 * ux
        p0, p1, p2 = rotate(w0, w1, w2, -b, c, c0, c1, c2)
        out[8 + 3 * i], out[9 + 3 * i], out[10 + 3 * i] = p0, p1, p2
    return ok


@kernel()
def unproject(model, axis, sign, lens, xd, yd, phi):
    """Ideal normalised coordinates at the reference row of a distorted normalised pixel: x', y', ok."""
    C, R, ok = undistort(lens, xd, yd)
    if model == GLOBAL or not ok:
        return C, R, ok
    if model >= ROTATION:
        t = sign * (yd if axis == 1 else xd)
        w0, w1, w2, _, _, _, _, _, _, _, _, _ = path(phi, _STILL, 0.0, t)
        a, b = rodrigues(w0 * w0 + w1 * w1 + w2 * w2)
        X, Y, W = rotate(-w0, -w1, -w2, a, b, C, R, 1.0)
        return X / W, Y / W, W > 0.0
    q0, q1, q2 = row_phi(axis, sign, phi)
    if axis == 0:
        C, R = R, C
    if model == TWO_STEP:
        Y2 = R / (1.0 - q0)
        X2 = C - q1 * Y2
        Y = Y2
        for _ in range(MAX_NEWTON):
            f = Y * (1.0 + q2 * (X2 + q2 * Y * Y)) - Y2
            step = f / (1.0 + q2 * (X2 + 3.0 * q2 * Y * Y))
            Y -= step
            if abs(step) < ROW_TOL * (1.0 + abs(Y)):
                break
        X = X2 + q2 * Y * Y
        ok = 1.0 - q0 > 0.0 and 1.0 + q2 * X > 0.0 and abs(Y * (1.0 + q2 * X) - Y2) < 1e-11 * (1.0 + abs(Y2))
    else:
        # (I + [w]x)^-1 = (I + w w' - [w]x) / (1 + |w|^2), w = R q; the scale drops out
        w0, w1, w2 = R * q0, R * q1, R * q2
        dot = w0 * C + w1 * R + w2
        X = C + w0 * dot - (w1 - w2 * R)
        Y = R + w1 * dot - (w2 * C - w0)
        W = 1.0 + w2 * dot - (w0 * R - w1 * C)
        ok = W > 0.0
        X /= W
        Y /= W
    if axis == 0:
        X, Y = Y, X
    return X, Y, ok


@parallel_kernel()
def project_points(model, axis, sign, intr, lens, points_c, phi, vel, xy, valid):
    """Camera-frame points (n, 3) into pixels xy (n, 2); one motion for all of them."""
    n = len(points_c)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        out = np.empty(21)
        for k in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            p = points_c[k]
            valid[k] = project(model, axis, sign, lens, p[0], p[1], p[2], phi, vel, math.nan, out, False)
            xy[k, 0] = intr[0] * out[0] + intr[2] if valid[k] else np.nan
            xy[k, 1] = intr[1] * out[1] + intr[3] if valid[k] else np.nan


@kernel()
def project_jacobians(model, axis, sign, intr, lens, points_c, phi, vel, xy, J_point, J_phi, J_vel, valid):
    """As `project_points`, with derivatives of the pixels (n, 2, 3) in the point, phi and velocity."""
    out = np.empty(21)
    for k in range(len(points_c)):
        p = points_c[k]
        valid[k] = project(model, axis, sign, lens, p[0], p[1], p[2], phi, vel, math.nan, out, True)
        if not valid[k]:
            out[:] = np.nan
        for i in range(2):
            f = intr[i]
            xy[k, i] = f * out[i] + intr[2 + i]
            for j in range(3):
                J_point[k, i, j] = f * out[2 + 3 * i + j]
                J_phi[k, i, j] = f * out[20] * out[8 + 3 * i + j]
                J_vel[k, i, j] = f * out[20] * out[14 + 3 * i + j]


@parallel_kernel()
def unproject_points(model, axis, sign, intr, lens, xy, phi, ideal, valid):
    """Pixels (n, 2) into ideal normalised coordinates (n, 2) at the reference row."""
    n = len(xy)
    for chunk in prange((n + CHUNK - 1) // CHUNK):
        for k in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
            xd = (xy[k, 0] - intr[2]) / intr[0]
            yd = (xy[k, 1] - intr[3]) / intr[1]
            x, y, ok = unproject(model, axis, sign, lens, xd, yd, phi)
            valid[k] = ok
            ideal[k, 0] = x if ok else np.nan
            ideal[k, 1] = y if ok else np.nan
