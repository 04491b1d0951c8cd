"""Lens, rotations and row models, and the loops over them: points, pixels, residual blocks, grids.

One file, because numba's cache does not notice a changed callee elsewhere. Conventions of every function here:
`lens` is (13,): OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 and the squared undistorted radius where the radial part
folds; or (1, 14), where it may be a fisheye: then the last number is 1, and k1 k2 k3 k4 have the places of these names;
`axis` is the component of the image that the clock follows (1: rows, 0: columns) and `sign` its direction;
`model` is a code of `model.motion.SHUTTER_MODELS`; `intr` is (4,): fx fy cx cy; `phi` is (3,), or the table of a motion
that is not steady, see `_path`. Of several photos there is one more dimension.
"""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel, parallel_kernel, prange

GLOBAL, TWO_STEP, LINEARIZED, ROTATION, CONSTANT_MOTION = 0, 1, 2, 3, 4

# Newton on the row takes its last step from a gap below this (normalised units): the step squares the gap, and the
# curvature of the gap is of the order of phi, so 1e-17 is left.
_LAST_GAP = 1e-8
# Derivatives are taken at the row itself: they change as the gap does.
_SAME_ROW = 1e-13
# Newton in the plane and on cubics stops at steps below this.
_ROW_TOL = 1e-14
_MAX_NEWTON = 30
_CHUNK = 512
_STILL = np.zeros(3)


@kernel(forceinline=True)
def _pinhole(lens, x, y):
    """As `_lens`, of OpenCV's pinhole lens model."""
    s = x * x + y * y
    num = 1.0 + s * (lens[0] + s * (lens[1] + s * lens[4]))
    den = 1.0 + s * (lens[5] + s * (lens[6] + s * lens[7]))
    dnum = lens[0] + s * (2.0 * lens[1] + s * 3.0 * lens[4])
    dden = lens[5] + s * (2.0 * lens[6] + s * 3.0 * lens[7])
    inverse = 1.0 / den
    g = num * inverse
    dg = (dnum - g * dden) * inverse
    p1, p2 = lens[2], lens[3]
    xd = x * g + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x) + s * (lens[8] + s * lens[9])
    yd = y * g + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y + s * (lens[10] + s * lens[11])
    ts = lens[8] + 2.0 * s * lens[9]
    tt = lens[10] + 2.0 * s * lens[11]
    xx = g + 2.0 * x * x * dg + 2.0 * p1 * y + 6.0 * p2 * x + 2.0 * x * ts
    xy = 2.0 * x * y * dg + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * y * ts
    yx = 2.0 * x * y * dg + 2.0 * p1 * x + 2.0 * p2 * y + 2.0 * x * tt
    yy = g + 2.0 * y * y * dg + 6.0 * p1 * y + 2.0 * p2 * x + 2.0 * y * tt
    return xd, yd, xx, xy, yx, yy, s <= lens[12]


@kernel()
def _unpinhole(lens, xd, yd):
    """As `_unlens`, of OpenCV's pinhole lens model: damped Newton in the plane."""
    x, y = xd, yd
    s = x * x + y * y
    if s > 0.81 * lens[12]:  # start inside the fold, else Newton runs to the wrong side of it
        shrink = 0.9 * math.sqrt(lens[12] / s)
        x *= shrink
        y *= shrink
    for _ in range(_MAX_NEWTON):
        px, py, xx, xy, yx, yy, ok = _pinhole(lens, x, y)
        ex, ey = px - xd, py - yd
        det = xx * yy - xy * yx
        dx = (yy * ex - xy * ey) / det
        dy = (xx * ey - yx * ex) / det
        if not (abs(dx) < 1e6 and abs(dy) < 1e6):
            return x, y, False
        step = 1.0
        while step > 1e-3:
            nx, ny = x - step * dx, y - step * dy
            if nx * nx + ny * ny <= lens[12]:
                break
            step *= 0.5
        x -= step * dx
        y -= step * dy
        if abs(dx) + abs(dy) < _ROW_TOL * (1.0 + abs(x) + abs(y)):
            break
    px, py, xx, xy, yx, yy, ok = _pinhole(lens, x, y)
    ok = ok and abs(px - xd) + abs(py - yd) < 1e-11 * (1.0 + abs(xd) + abs(yd))
    return x, y, ok


@kernel(forceinline=True)
def _fisheye_radius(lens, angle):
    """Radius in the image of an angle from the axis (Kannala and Brandt 2006, Eq. 6), and its derivative."""
    s = angle * angle
    r = angle * (1.0 + s * (lens[0] + s * (lens[1] + s * (lens[4] + s * lens[5]))))
    return r, 1.0 + s * (3.0 * lens[0] + s * (5.0 * lens[1] + s * (7.0 * lens[4] + s * 9.0 * lens[5])))


@kernel()
def _fisheye(lens, x, y):
    """As `_lens`, of a fisheye."""
    s = x * x + y * y
    r = math.sqrt(s)
    if r == 0.0:
        return x, y, 1.0, 0.0, 0.0, 1.0, True
    radius, slope = _fisheye_radius(lens, math.atan(r))
    # along the radius and across it
    along, across = slope / (1.0 + s), radius / r
    ux, uy = x / r, y / r
    xy = (along - across) * ux * uy
    xx, yy = along * ux * ux + across * uy * uy, along * uy * uy + across * ux * ux
    return x * across, y * across, xx, xy, xy, yy, s <= lens[12]


@kernel()
def _unfisheye(lens, xd, yd):
    """As `_unlens`, of a fisheye: Newton on the angle, kept between bounds. No ray at 90 degrees and beyond."""
    radius = math.sqrt(xd * xd + yd * yd)
    if radius == 0.0:
        return xd, yd, True
    low, high = 0.0, math.atan(math.sqrt(lens[12]))
    if not radius < _fisheye_radius(lens, high)[0]:
        return xd, yd, False
    angle = min(radius, high)
    for _ in range(_MAX_NEWTON):
        r, slope = _fisheye_radius(lens, angle)
        if r > radius:
            high = angle
        else:
            low = angle
        step = (r - radius) / slope
        angle -= step
        if not (low <= angle <= high):
            step = math.inf
            angle = 0.5 * (low + high)
        if abs(step) < _ROW_TOL:
            break
    scale = math.tan(angle) / radius
    return xd * scale, yd * scale, abs(_fisheye_radius(lens, angle)[0] - radius) < 1e-11


@kernel(forceinline=True)
def _lens(lens, x, y):
    """Distorted coordinates with their derivatives: xd, yd, dxd/dx, dxd/dy, dyd/dx, dyd/dy, ok."""
    # Numba decides this when it compiles, for each number of dimensions on its own. Asking at run time would cost where
    # no fisheye is: 20 to 40 % of a grid, 5 to 10 % of the residuals.
    if lens.ndim == 1:
        return _pinhole(lens, x, y)
    if lens[0, 13] != 0.0:
        return _fisheye(lens[0], x, y)
    return _pinhole(lens[0], x, y)


@kernel()
def _unlens(lens, xd, yd):
    """Undistorted coordinates of the distorted ones: x, y, ok."""
    if lens.ndim == 1:
        return _unpinhole(lens, xd, yd)
    if lens[0, 13] != 0.0:
        return _unfisheye(lens[0], xd, yd)
    return _unpinhole(lens[0], xd, yd)


@kernel(forceinline=True)
def _rodrigues(t2):
    """Of an angle t given by its square: sin t / t and (1 - cos t) / t^2, to rounding at any angle."""
    if t2 < 0.25:  # what is left out is below t^14 / 15! = 5e-17
        a = t2 * (1 / 5040 - t2 * (1 / 362880 - t2 * (1 / 39916800 - t2 * (1 / 6227020800))))
        b = t2 * (1 / 40320 - t2 * (1 / 3628800 - t2 * (1 / 479001600 - t2 * (1 / 87178291200))))
        return 1.0 - t2 * (1 / 6 - t2 * (1 / 120 - a)), 0.5 - t2 * (1 / 24 - t2 * (1 / 720 - b))
    t = math.sqrt(t2)
    h = math.sin(0.5 * t) / t
    return math.sin(t) / t, 2.0 * h * h


@kernel(forceinline=True)
def _third_factor(t2, a):
    """(t - sin t) / t^3 of an angle t given by its square, and a = sin t / t."""
    if t2 < 0.25:
        c = t2 * (1 / 362880 - t2 * (1 / 39916800 - t2 * (1 / 6227020800 - t2 * (1 / 1307674368000))))
        return 1 / 6 - t2 * (1 / 120 - t2 * (1 / 5040 - c))
    return (1.0 - a) / t2


@kernel(forceinline=True)
def _turn(w0, w1, w2, a, b, x, y, z):
    """(I + a [w] + b [w]^2) (x, y, z).

    With a, b of `_rodrigues` this is Exp(w); with b and the third factor it is the left Jacobian L of SO(3),
    Exp(w + dw) = Exp(L dw) Exp(w) to first order. The transpose of either has -a.
    """
    c0, c1, c2 = w1 * z - w2 * y, w2 * x - w0 * z, w0 * y - w1 * x
    return (
        x + a * c0 + b * (w1 * c2 - w2 * c1),
        y + a * c1 + b * (w2 * c0 - w0 * c2),
        z + a * c2 + b * (w0 * c1 - w1 * c0),
    )


@kernel(forceinline=True)
def _row_phi(axis, sign, phi):
    """The motion phi as row readout from top to bottom would need it, after exchanging x and y for columns.

    An exchange of x and y is a reflection S, and S Exp(w) S = Exp(-S w): so columns take -S phi.
    """
    f0, f1, f2 = _steady(phi, 0), _steady(phi, 1), _steady(phi, 2)
    if axis == 1:
        return sign * f0, sign * f1, sign * f2
    return -sign * f1, -sign * f0, -sign * f2


@kernel(forceinline=True)
def _path(phi, vel, moving, t):
    """Rotation vector and position of the camera when the clock shows t, and their derivatives by it, 12 numbers.

    phi is (3,) of a steady motion: t phi and t moving vel. Of another it is (1 + 4 n, 6), how far that departs from it:
    phi, where the frame begins and the length of each of n intervals of it; then for each interval four rows of the
    coefficients of powers of the place in it, 0 to 1: of the rotation vector, and of the position, that `moving` times.
    Before the frame and behind it both go on along their tangents.
    """
    if phi.ndim == 1:
        f0, f1, f2 = phi[0], phi[1], phi[2]
        v0, v1, v2 = moving * vel[0], moving * vel[1], moving * vel[2]
        return t * f0, t * f1, t * f2, f0, f1, f2, t * v0, t * v1, t * v2, v0, v1, v2
    i, u, beyond = _interval(phi.shape[0] // 4, (t - phi[0, 3]) / phi[0, 4])
    rate = 1.0 / phi[0, 4]
    i = 1 + 4 * i
    w0, d0 = _cubic(phi, i, 0, u, beyond)
    w1, d1 = _cubic(phi, i, 1, u, beyond)
    w2, d2 = _cubic(phi, i, 2, u, beyond)
    w0, w1, w2 = w0 + t * phi[0, 0], w1 + t * phi[0, 1], w2 + t * phi[0, 2]
    d0, d1, d2 = d0 * rate + phi[0, 0], d1 * rate + phi[0, 1], d2 * rate + phi[0, 2]
    if moving == 0.0:
        return w0, w1, w2, d0, d1, d2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    p0, e0 = _cubic(phi, i, 3, u, beyond)
    p1, e1 = _cubic(phi, i, 4, u, beyond)
    p2, e2 = _cubic(phi, i, 5, u, beyond)
    p0, p1, p2 = moving * (p0 + t * vel[0]), moving * (p1 + t * vel[1]), moving * (p2 + t * vel[2])
    e0, e1, e2 = moving * (e0 * rate + vel[0]), moving * (e1 * rate + vel[1]), moving * (e2 * rate + vel[2])
    return w0, w1, w2, d0, d1, d2, p0, p1, p2, e0, e1, e2


@kernel(forceinline=True)
def _interval(n, s):
    """Of a place s in n intervals of length 1: which one, where in it, and how far beyond the first or the last."""
    i = min(max(int(min(max(s, 0.0), float(n))), 0), n - 1)
    u = min(max(s - i, 0.0), 1.0)
    return i, u, s - i - u


@kernel(forceinline=True)
def _cubic(table, i, column, u, beyond):
    """Value and derivative of a cubic, whose coefficients are rows i to i + 3, at u and along the tangent there."""
    a, b, c, d = table[i, column], table[i + 1, column], table[i + 2, column], table[i + 3, column]
    slope = b + u * (2.0 * c + u * 3.0 * d)
    return a + u * (b + u * (c + u * d)) + beyond * slope, slope


@kernel(forceinline=True)
def _steady(phi, k):
    """Phi itself, or that of a motion that is not steady."""
    return phi[k] if phi.ndim == 1 else phi[0, k]


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
def _project(model, axis, sign, lens, x, y, z, phi, vel, start, out, jac):
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
        return _project_exact(axis, sign, lens, x, y, z, phi, vel, moving, start, out, jac)
    if model == GLOBAL:
        xd, yd, xx, xy, yx, yy, ok = _lens(lens, X, Y)
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
    q0, q1, q2 = _row_phi(axis, sign, phi)
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
    xd, yd, xx, xy, yx, yy, ok = _lens(lens, C, R)
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
def _moves(w0, w1, w2, f0, f1, f2, phi, a, b, q0, q1, q2):
    """Derivative by the clock of q = Exp(w) x: that of w is f."""
    if phi.ndim == 2:
        # of a steady motion w is along f, and L f = f
        c = _third_factor(w0 * w0 + w1 * w1 + w2 * w2, a)
        f0, f1, f2 = _turn(w0, w1, w2, b, c, f0, f1, f2)
    return f1 * q2 - f2 * q1, f2 * q0 - f0 * q2, f0 * q1 - f1 * q0


@kernel(forceinline=True)
def _project_exact(axis, sign, lens, x, y, z, phi, vel, moving, start, out, jac):
    """Paper Eq. 2 whole, q(t) = Exp(w(t)) (x - p(t)), with t the distorted row (or column) that the sensor read.

    w and p are those of `_path`; with moving = 0 it is the rotation model. For `start` and `out` see `_project`.
    """
    t = start
    if t != t:
        xd, yd, xx, xy, yx, yy, ok = _lens(lens, x / z, y / z)
        t = sign * (yd if axis == 1 else xd)
    for _ in range(_MAX_NEWTON):
        w0, w1, w2, f0, f1, f2, p0, p1, p2, v0, v1, v2 = _path(phi, vel, moving, t)
        angle2 = w0 * w0 + w1 * w1 + w2 * w2
        a, b = _rodrigues(angle2)
        q0, q1, q2 = _turn(w0, w1, w2, a, b, x - p0, y - p1, z - p2)
        if not q2 > 0.0:
            return False
        d0, d1, d2 = _moves(w0, w1, w2, f0, f1, f2, phi, a, b, q0, q1, q2)
        if moving != 0.0:
            e0, e1, e2 = _turn(w0, w1, w2, a, b, v0, v1, v2)
            d0, d1, d2 = d0 - e0, d1 - e1, d2 - e2
        inverse = 1.0 / q2
        X, Y = q0 * inverse, q1 * inverse
        xd, yd, xx, xy, yx, yy, ok = _lens(lens, X, Y)
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
    c = _third_factor(angle2, a)
    out[20] = t
    row0, row1 = (yx, yy) if axis == 1 else (xx, xy)
    for i in range(2):
        # derivatives of a distorted coordinate by X and Y: at a fixed t, and as the implicit row moves
        ux, uy, ut = (xx, xy, xt) if i == 0 else (yx, yy, yt)
        s = -sign * ut / slope
        ux, uy = (ux + s * row0) * inverse, (uy + s * row1) * inverse
        uz = -(ux * X + uy * Y)
        # point: dq = E dx; position: dq = -E dp; rotation: dq = -[q] L dw
        p0, p1, p2 = _turn(w0, w1, w2, -a, b, ux, uy, uz)
        out[2 + 3 * i], out[3 + 3 * i], out[4 + 3 * i] = p0, p1, p2
        out[14 + 3 * i], out[15 + 3 * i], out[16 + 3 * i] = -moving * p0, -moving * p1, -moving * p2
        c0, c1, c2 = q1 * uz - q2 * uy, q2 * ux - q0 * uz, q0 * uy - q1 * ux
        p0, p1, p2 = _turn(w0, w1, w2, -b, c, c0, c1, c2)
        out[8 + 3 * i], out[9 + 3 * i], out[10 + 3 * i] = p0, p1, p2
    return ok


@kernel()
def _unproject(model, axis, sign, lens, xd, yd, phi):
    """Ideal normalised coordinates at the reference row of a distorted normalised pixel: x', y', ok."""
    C, R, ok = _unlens(lens, xd, yd)
    if model == GLOBAL or not ok:
        return C, R, ok
    if model >= ROTATION:
        t = sign * (yd if axis == 1 else xd)
        w0, w1, w2, _, _, _, _, _, _, _, _, _ = _path(phi, _STILL, 0.0, t)
        a, b = _rodrigues(w0 * w0 + w1 * w1 + w2 * w2)
        X, Y, W = _turn(-w0, -w1, -w2, a, b, C, R, 1.0)
        return X / W, Y / W, W > 0.0
    q0, q1, q2 = _row_phi(axis, sign, phi)
    if axis == 0:
        C, R = R, C
    if model == TWO_STEP:
        Y2 = R / (1.0 - q0)
        X2 = C - q1 * Y2
        Y = Y2
        for _ in range(_MAX_NEWTON):
            f = Y * (1.0 + q2 * (X2 + q2 * Y * Y)) - Y2
            step = f / (1.0 + q2 * (X2 + 3.0 * q2 * Y * Y))
            Y -= step
            if abs(step) < _ROW_TOL * (1.0 + abs(Y)):
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
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        out = np.empty(21)
        for k in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            p = points_c[k]
            valid[k] = _project(model, axis, sign, lens, p[0], p[1], p[2], phi, vel, math.nan, out, False)
            xy[k, 0] = intr[0] * out[0] + intr[2] if valid[k] else np.nan
            xy[k, 1] = intr[1] * out[1] + intr[3] if valid[k] else np.nan


@kernel()
def project_jacobians(model, axis, sign, intr, lens, points_c, phi, vel, xy, J_point, J_phi, J_vel, valid):
    """As `project_points`, with derivatives of the pixels (n, 2, 3) in the point, phi and velocity."""
    out = np.empty(21)
    for k in range(len(points_c)):
        p = points_c[k]
        valid[k] = _project(model, axis, sign, lens, p[0], p[1], p[2], phi, vel, math.nan, out, True)
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
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        for k in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            xd = (xy[k, 0] - intr[2]) / intr[0]
            yd = (xy[k, 1] - intr[3]) / intr[1]
            x, y, ok = _unproject(model, axis, sign, lens, xd, yd, phi)
            valid[k] = ok
            ideal[k, 0] = x if ok else np.nan
            ideal[k, 1] = y if ok else np.nan


@kernel()
def interpolate_map(
    model, axis, sign, intr, lens, phi, rays, nodes_x, nodes_y, smooth, spacing, band, edge, width, height, row0,
    map_x, map_y, seen,
):  # fmt: skip
    """As `fill_map` for the rows `row0 ...`, by cubics between nodes of the grid; and which pixels see the raw photo.

    Patches of 3 x 3 cells have 4 x 4 of the nodes, (3 m + 1, 3 n + 1) in all, `spacing` pixels apart. Exact instead are
    patches that are not `smooth` (m, n), and pixels within `band` of where seeing ends, `edge` pixels beyond the
    outermost centres of the raw photo (width, height). `seen` gets 255 or 0; returned is how many are 0.
    """
    out = np.empty(21)
    vel = np.zeros(3)
    rows, cols = map_x.shape
    num = nodes_x.shape[1]
    column_x, column_y = np.empty(num), np.empty(num)
    side = 3 * spacing
    at = np.arange(side) / spacing
    low, right, bottom = -edge, width - 1.0 + edge, height - 1.0 + edge
    unseen = 0
    for i in range(rows):
        v = row0 + i
        line_x, line_y, line_seen = map_x[i], map_y[i], seen[i]
        p = v // side
        s = at[v - p * side]
        w0, w1 = (1.0 - s) * (2.0 - s) * (3.0 - s) / 6.0, s * (2.0 - s) * (3.0 - s) / 2.0
        w2, w3 = s * (1.0 - s) * (s - 3.0) / 2.0, s * (1.0 - s) * (2.0 - s) / 6.0
        a, b, c, d = 3 * p, 3 * p + 1, 3 * p + 2, 3 * p + 3
        for k in range(num):
            column_x[k] = w0 * nodes_x[a, k] + w1 * nodes_x[b, k] + w2 * nodes_x[c, k] + w3 * nodes_x[d, k]
            column_y[k] = w0 * nodes_y[a, k] + w1 * nodes_y[b, k] + w2 * nodes_y[c, k] + w3 * nodes_y[d, k]
        for q in range(smooth.shape[1]):
            start = q * side
            n = min(side, cols - start)
            row_x, row_y, row_seen = line_x[start : start + n], line_y[start : start + n], line_seen[start : start + n]
            near = n
            if smooth[p, q]:
                # by powers of the place in the patch
                x0, y0 = column_x[3 * q], column_y[3 * q]
                x1, y1 = column_x[3 * q + 1] - x0, column_y[3 * q + 1] - y0
                x2, y2 = column_x[3 * q + 2] - x0, column_y[3 * q + 2] - y0
                x3, y3 = column_x[3 * q + 3] - x0, column_y[3 * q + 3] - y0
                xa, ya = 3.0 * x1 - 1.5 * x2 + x3 / 3.0, 3.0 * y1 - 1.5 * y2 + y3 / 3.0
                xb, yb = -2.5 * x1 + 2.0 * x2 - 0.5 * x3, -2.5 * y1 + 2.0 * y2 - 0.5 * y3
                xc, yc = 0.5 * (x1 - x2) + x3 / 6.0, 0.5 * (y1 - y2) + y3 / 6.0
                near = 0
                x_in, x_out, y_in, y_out = low + band, right - band, low + band, bottom - band
                for j in range(n):
                    t = at[j]
                    x = x0 + t * (xa + t * (xb + t * xc))
                    y = y0 + t * (ya + t * (yb + t * yc))
                    row_x[j] = x
                    row_y[j] = y
                    safe = (x > x_in) & (x < x_out) & (y > y_in) & (y < y_out)
                    row_seen[j] = 255 if safe else 0
                    near += 0 if safe else 1
            if near == 0:
                continue
            t1 = t2 = math.nan
            for j in range(n):
                x, y = float(row_x[j]), float(row_y[j])
                if smooth[p, q]:
                    if row_seen[j]:
                        t1 = math.nan
                        continue
                    if x < low - band or x > right + band or y < low - band or y > bottom + band:
                        t1 = math.nan
                        unseen += 1
                        continue
                u = start + j
                x = rays[0, 0] * u + rays[0, 1] * v + rays[0, 2]
                y = rays[1, 0] * u + rays[1, 1] * v + rays[1, 2]
                z = rays[2, 0] * u + rays[2, 1] * v + rays[2, 2]
                ok = _project(model, axis, sign, lens, x, y, z, phi, vel, 2.0 * t1 - t2, out, False)
                t2 = t1
                t1 = sign * out[axis] if ok else math.nan
                x = intr[0] * out[0] + intr[2] if ok else -1e6
                y = intr[1] * out[1] + intr[3] if ok else -1e6
                row_x[j] = x
                row_y[j] = y
                row_seen[j] = 255 if low <= x <= right and low <= y <= bottom else 0
                unseen += 0 if row_seen[j] else 1
    return unseen


@kernel()
def invert_map(map_x, map_y, back_x, back_y):
    """For the pixels of the source of a map, where the map points to them: back_x, back_y of the source's size.

    Each cell of four neighbours is a bilinear patch that holds some pixels of the source. Those that no cell holds, or
    that an earlier cell held, are left as they are; back_x must be below -1e5 at first.
    """
    rows, cols = map_x.shape
    height, width = back_x.shape
    slack = 1e-3  # of a cell: float32 rounds
    for i in range(rows - 1):
        for j in range(cols - 1):
            x0, y0 = float(map_x[i, j]), float(map_y[i, j])
            x1, y1 = float(map_x[i, j + 1]), float(map_y[i, j + 1])
            x2, y2 = float(map_x[i + 1, j]), float(map_y[i + 1, j])
            x3, y3 = float(map_x[i + 1, j + 1]), float(map_y[i + 1, j + 1])
            if min(min(x0, x1), min(x2, x3)) < -1e5:
                continue
            left, right = min(min(x0, x1), min(x2, x3)), max(max(x0, x1), max(x2, x3))
            top, bottom = min(min(y0, y1), min(y2, y3)), max(max(y0, y1), max(y2, y3))
            if not (right > -1.0 and left < width and bottom > -1.0 and top < height):
                continue
            ax, ay, bx, by, cx, cy = x1 - x0, y1 - y0, x2 - x0, y2 - y0, x0 - x1 - x2 + x3, y0 - y1 - y2 + y3
            # a pixel on the rim may lie outside by a rounding
            for v in range(max(0, math.ceil(top - slack)), min(height - 1, math.floor(bottom + slack)) + 1):
                for u in range(max(0, math.ceil(left - slack)), min(width - 1, math.floor(right + slack)) + 1):
                    if back_x[v, u] > -1e5:
                        continue
                    s = t = 0.5
                    for _ in range(8):
                        ex = x0 + s * ax + t * bx + s * t * cx - u
                        ey = y0 + s * ay + t * by + s * t * cy - v
                        xs, xt, ys, yt = ax + t * cx, bx + s * cx, ay + t * cy, by + s * cy
                        det = xs * yt - xt * ys
                        ds, dt = (yt * ex - xt * ey) / det, (xs * ey - ys * ex) / det
                        s -= ds
                        t -= dt
                        if not abs(ds) + abs(dt) > 1e-9:
                            break
                    if -slack <= s <= 1.0 + slack and -slack <= t <= 1.0 + slack:
                        back_x[v, u] = j + s
                        back_y[v, u] = i + t


_5, _16, _31, _LOW_HALF, _BIAS = np.int32(5), np.int32(16), np.int32(31), np.int32(0xFFFF), np.int32(1 << 20)


@kernel()
def fixed_point(map_x, map_y, xy, fraction):
    """OpenCV's CV_16SC2 map, rounded to 1/32 pixel: `xy` is a view of (rows, cols, 2) int16 as (rows, cols) int32.

    As `cv2.convertMaps`, at a quarter of its time: 32-bit integers throughout, which vectorise. Positions beyond 32,767
    px wrap around.
    """
    rows, cols = map_x.shape
    for i in range(rows):
        line_x, line_y, line_xy, line_fraction = map_x[i], map_y[i], xy[i], fraction[i]
        for j in range(cols):
            # cut off, which rounds to the nearest once biased by a half and to above zero
            x = np.int32(np.float64(line_x[j]) * 32.0 + 1048576.5) - _BIAS
            y = np.int32(np.float64(line_y[j]) * 32.0 + 1048576.5) - _BIAS
            line_xy[j] = ((y >> _5) << _16) | ((x >> _5) & _LOW_HALF)
            line_fraction[j] = np.uint16(((y & _31) << _5) | (x & _31))


@kernel()
def clear_unseen(seen, values):
    """Zero the bytes (rows, cols, n) of pixels that were not seen."""
    rows, cols = seen.shape
    for i in range(rows):
        for j in range(cols):
            if seen[i, j] == 0:
                values[i, j] = 0


@kernel()
def fill_map(model, axis, sign, intr, lens, phi, rays, row0, col0, map_x, map_y):
    """Raw pixel that saw each rectified pixel, for the block of the grid that starts at (row0, col0).

    `rays` (3, 3) takes a rectified pixel (u, v, 1) to a direction in the camera frame. Where no raw pixel
    answers, the map points far outside every photo (finite: a NaN is handled differently by OpenCV 4 and 5).
    """
    out = np.empty(21)
    vel = np.zeros(3)
    rows, cols = map_x.shape
    for i in range(rows):
        v = row0 + i
        # the clock of the last two pixels foretells that of the next
        t1 = t2 = math.nan
        for j in range(cols):
            u = col0 + j
            x = rays[0, 0] * u + rays[0, 1] * v + rays[0, 2]
            y = rays[1, 0] * u + rays[1, 1] * v + rays[1, 2]
            z = rays[2, 0] * u + rays[2, 1] * v + rays[2, 2]
            ok = _project(model, axis, sign, lens, x, y, z, phi, vel, 2.0 * t1 - t2, out, False)
            t2 = t1
            t1 = sign * out[axis] if ok else math.nan
            if ok:
                map_x[i, j] = intr[0] * out[0] + intr[2]
                map_y[i, j] = intr[1] * out[1] + intr[3]
            else:
                map_x[i, j] = -1e6
                map_y[i, j] = -1e6


@kernel()
def fill_map_at_depth(axis, sign, intr, lens, phi, vel, rays, inverse_depth, row0, col0, map_x, map_y):
    """As `fill_map`, of the constant-motion model: what pixel [i, j] shows lies at its ray / inverse_depth[i, j].

    vel is in the camera frame; at an inverse depth of zero it moves nothing.
    """
    out = np.empty(21)
    rows, cols = map_x.shape
    for i in range(rows):
        v = row0 + i
        t1 = t2 = math.nan
        for j in range(cols):
            u = col0 + j
            x = rays[0, 0] * u + rays[0, 1] * v + rays[0, 2]
            y = rays[1, 0] * u + rays[1, 1] * v + rays[1, 2]
            z = rays[2, 0] * u + rays[2, 1] * v + rays[2, 2]
            # the scale of a scene does not show: the ray, and the velocity times the inverse depth
            ok = z > 0.0 and _project_exact(
                axis, sign, lens, x, y, z, phi, vel, float(inverse_depth[i, j]), 2.0 * t1 - t2, out, False
            )
            t2 = t1
            t1 = sign * out[axis] if ok else math.nan
            map_x[i, j] = intr[0] * out[0] + intr[2] if ok else -1e6
            map_y[i, j] = intr[1] * out[1] + intr[3] if ok else -1e6


# The most of the curvature along a residual that a robust loss takes away. All of it would send points of two photos
# whose rays miss each other far off, and damp the step of everything else until it hardly moves; none of it makes
# convergence linear. (Steps of a solve of aligned tracks: 125 with 0.99, 88 with 0.5, 49 with 0.3, 50 with none.)
_MOST_SHARE = 0.3


@kernel(forceinline=True)
def _loss(kind, s, scale2):
    """Robust loss rho(s) of a squared residual, rho'(s), and the share of curvature that it takes away along r.

    Kinds: 0 squared, 1 Huber, 2 Cauchy, 3 soft L1. The share is -2 s rho''/rho' as far as `_MOST_SHARE`, so that the
    Hessian rho' J'(I - share r r'/s) J stays well within the positive.
    """
    if kind == 1 and s > scale2:
        root = math.sqrt(s * scale2)
        return 2.0 * root - scale2, root / s, _MOST_SHARE
    if kind == 2:
        w = 1.0 / (1.0 + s / scale2)
        return scale2 * math.log1p(s / scale2), w, min(2.0 * s / scale2 * w, _MOST_SHARE)
    if kind == 3:
        q = math.sqrt(1.0 + s / scale2)
        return 2.0 * scale2 * (q - 1.0), 1.0 / q, min(s / (s + scale2), _MOST_SHARE)
    return s, 1.0, 0.0


# What an observation costs that cannot be projected (behind the camera): its point must not profit from it.
_INVALID_PX = 100.0


@kernel(forceinline=True)
def _camera_frame(R, center, velocity, point, vel_c):
    """Point in the camera frame at the reference row (x, y, z), and the velocity there in vel_c."""
    d0, d1, d2 = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    for a in range(3):
        vel_c[a] = R[a, 0] * velocity[0] + R[a, 1] * velocity[1] + R[a, 2] * velocity[2]
    return (
        R[0, 0] * d0 + R[0, 1] * d1 + R[0, 2] * d2,
        R[1, 0] * d0 + R[1, 1] * d1 + R[1, 2] * d2,
        R[2, 0] * d0 + R[2, 1] * d1 + R[2, 2] * d2,
    )


@kernel(forceinline=True)
def _measured_row(axis, sign, intr, xy):
    """Where the search for a measurement's row starts: from elsewhere, what one kernel sees another may not."""
    return sign * (xy[axis] - intr[2 + axis]) / intr[axis]


@parallel_kernel()
def residuals(
    model, camera_of_frame, axes, signs, intrs, lenses, R_cw, center_w, phi, vel_w, points_w,
    frame_idx, point_idx, xy_raw, res, valid,
):  # fmt: skip
    """Reprojection residuals (o, 2) in pixels: predicted minus measured."""
    o = len(frame_idx)
    for chunk in prange((o + _CHUNK - 1) // _CHUNK):
        out = np.empty(21)
        vel_c = np.empty(3)
        for k in range(chunk * _CHUNK, min(o, (chunk + 1) * _CHUNK)):
            f = frame_idx[k]
            c = camera_of_frame[f]
            x, y, z = _camera_frame(R_cw[f], center_w[f], vel_w[f], points_w[point_idx[k]], vel_c)
            row = _measured_row(axes[c], signs[c], intrs[c], xy_raw[k])
            valid[k] = _project(model, axes[c], signs[c], lenses[c], x, y, z, phi[f], vel_c, row, out, False)
            for i in range(2):
                res[k, i] = intrs[c, i] * out[i] + intrs[c, 2 + i] - xy_raw[k, i] if valid[k] else _INVALID_PX


@parallel_kernel()
def residual_costs(
    model, camera_of_frame, axes, signs, intrs, lenses, R_cw, center_w, phi, vel_w, points_w,
    frame_idx, point_idx, xy_raw, sigma_px, loss_kind, loss_scale, clock, cost,
):  # fmt: skip
    """Robust cost, as in `residual_blocks`, summed over chunks of observations: cost (c,) for any c.

    The rows (o,) that the model predicts are left in `clock`, NaN where there is none, for `residual_blocks`.
    """
    o = len(frame_idx)
    scale2 = loss_scale * loss_scale
    size = (o + len(cost) - 1) // len(cost)
    for chunk in prange(len(cost)):
        out = np.empty(21)
        vel_c = np.empty(3)
        total = 0.0
        for k in range(chunk * size, min(o, (chunk + 1) * size)):
            f = frame_idx[k]
            c = camera_of_frame[f]
            x, y, z = _camera_frame(R_cw[f], center_w[f], vel_w[f], points_w[point_idx[k]], vel_c)
            s = 2.0 * (_INVALID_PX / sigma_px[k]) ** 2
            row = _measured_row(axes[c], signs[c], intrs[c], xy_raw[k])
            if _project(model, axes[c], signs[c], lenses[c], x, y, z, phi[f], vel_c, row, out, False):
                ex = intrs[c, 0] * out[0] + intrs[c, 2] - xy_raw[k, 0]
                ey = intrs[c, 1] * out[1] + intrs[c, 3] - xy_raw[k, 1]
                s = (ex * ex + ey * ey) / sigma_px[k] ** 2
                clock[k] = signs[c] * out[axes[c]]
            else:
                clock[k] = np.nan
            total += 0.5 * _loss(loss_kind, s, scale2)[0]
        cost[chunk] = total


@kernel(forceinline=True)
def _by_bends(bends, ways, table, R, t, u, v, v0, v1, v2, out, J):
    """The last columns J of `residual_blocks`."""
    at, s, beyond = _interval(len(bends) // 4, (t - table[0, 3]) / table[0, 4])
    turns = bends.shape[1]
    first = len(J) - 3 * (turns + ways)
    for j in range(turns):
        by, _ = _cubic(bends, 4 * at, j, s, beyond)
        for b in range(3):
            J[first + 3 * j + b] = by * (u * out[8 + b] + v * out[11 + b])
            if j < ways:
                J[first + 3 * (turns + j) + b] = by * (v0 * R[0, b] + v1 * R[1, b] + v2 * R[2, b])


@parallel_kernel()
def residual_blocks(
    model, camera_of_frame, axes, signs, intrs, lenses, R_cw, center_w, phi, vel_w, points_w,
    frame_idx, point_idx, xy_raw, sigma_px, loss_kind, loss_scale, clock, nb, bends, ways, res, J_frame, cost,
):  # fmt: skip
    """Whitened, robustly weighted residuals (o, 2) with their Jacobians, and the cost summed over chunks: cost (c,).

    J_frame is (o, 2, >= nb): rotation increment (left, camera frame), centre, phi from nb = 9 on, and velocity (world
    frame) when nb = 12. Of motions that are not steady the last columns are by the coefficients of the rotation along
    the functions of `bends` (4 n, k), tables as in `_path`, three after three, and then by those of the position (world
    frame) along the first `ways` of them. Columns between these are left alone. The Jacobian of the point is minus that
    of the centre. `clock` (o,) is where the search for the row starts, NaN: where it was measured; sigma_px is (o,).
    Observations that cannot be projected get zero Jacobians and cost 100 px.
    """
    o = len(frame_idx)
    scale2 = loss_scale * loss_scale
    size = (o + len(cost) - 1) // len(cost)
    for chunk in prange(len(cost)):
        out = np.empty(21)
        vel_c = np.empty(3)
        total = 0.0
        for k in range(chunk * size, min(o, (chunk + 1) * size)):
            f = frame_idx[k]
            c = camera_of_frame[f]
            R = R_cw[f]
            x, y, z = _camera_frame(R, center_w[f], vel_w[f], points_w[point_idx[k]], vel_c)
            row = clock[k] if clock[k] == clock[k] else _measured_row(axes[c], signs[c], intrs[c], xy_raw[k])
            if not _project(model, axes[c], signs[c], lenses[c], x, y, z, phi[f], vel_c, row, out, True):
                total += 0.5 * _loss(loss_kind, 2.0 * (_INVALID_PX / sigma_px[k]) ** 2, scale2)[0]
                res[k] = 0.0
                J_frame[k] = 0.0
                continue
            precision = 1.0 / sigma_px[k]
            r0 = (intrs[c, 0] * out[0] + intrs[c, 2] - xy_raw[k, 0]) * precision
            r1 = (intrs[c, 1] * out[1] + intrs[c, 3] - xy_raw[k, 1]) * precision
            s = r0 * r0 + r1 * r1
            rho, weight, share = _loss(loss_kind, s, scale2)
            total += 0.5 * rho
            # J <- sqrt(rho') (I - a n n') J and r <- sqrt(rho') r / (1 - a), n = r/|r|: the gradient stays rho' J'r
            # and J'J becomes the Hessian of `_loss`
            w = math.sqrt(weight)
            keep = math.sqrt(1.0 - share)
            a_s = (1.0 - keep) / s if s > 0.0 else 0.0
            m00, m01, m11 = w * (1.0 - a_s * r0 * r0), -w * a_s * r0 * r1, w * (1.0 - a_s * r1 * r1)
            res[k, 0] = r0 * w / keep
            res[k, 1] = r1 * w / keep
            g0, g1 = intrs[c, 0] * precision, intrs[c, 1] * precision
            t = out[20]
            _, _, _, _, _, _, p0, p1, p2, _, _, _ = _path(phi[f], vel_c, 1.0, t)
            for i in range(2):
                u, v = (m00 * g0, m01 * g1) if i == 0 else (m01 * g0, m11 * g1)
                a0, a1, a2 = u * out[2] + v * out[5], u * out[3] + v * out[6], u * out[4] + v * out[7]
                v0, v1, v2 = u * out[14] + v * out[17], u * out[15] + v * out[18], u * out[16] + v * out[19]
                # x_c = Exp(delta) R d and p_c = Exp(delta) R p
                J_frame[k, i, 0] = a2 * y - a1 * z + v2 * p1 - v1 * p2
                J_frame[k, i, 1] = a0 * z - a2 * x + v0 * p2 - v2 * p0
                J_frame[k, i, 2] = a1 * x - a0 * y + v1 * p0 - v0 * p1
                for b in range(3):
                    J_frame[k, i, 3 + b] = -(a0 * R[0, b] + a1 * R[1, b] + a2 * R[2, b])
                if nb > 6:
                    for b in range(3):
                        J_frame[k, i, 6 + b] = t * (u * out[8 + b] + v * out[11 + b])
                if nb > 9:
                    for b in range(3):
                        J_frame[k, i, 9 + b] = t * (v0 * R[0, b] + v1 * R[1, b] + v2 * R[2, b])
                if phi.ndim == 3:
                    _by_bends(bends, ways, phi[f], R, t, u, v, v0, v1, v2, out, J_frame[k, i])
        cost[chunk] = total


@kernel()
def _pinhole_basis(lens, x, y, d):
    s = x * x + y * y
    den = 1.0 + s * (lens[5] + s * (lens[6] + s * lens[7]))
    d[0, 0], d[0, 1] = x * s / den, y * s / den
    d[1, 0], d[1, 1] = s * d[0, 0], s * d[0, 1]
    d[2, 0], d[2, 1] = 2.0 * x * y, s + 2.0 * y * y
    d[3, 0], d[3, 1] = s + 2.0 * x * x, 2.0 * x * y
    d[4, 0], d[4, 1] = s * d[1, 0], s * d[1, 1]
    d[5, 0] = d[5, 1] = 0.0


@kernel()
def _fisheye_basis(x, y, d):
    r = math.sqrt(x * x + y * y)
    angle = math.atan(r)
    scale = angle / r if r > 0.0 else 1.0
    d[:] = 0.0
    for k in (0, 1, 4, 5):
        scale *= angle * angle
        d[k, 0], d[k, 1] = x * scale, y * scale


@kernel()
def _lens_basis(lens, x, y, d):
    """Derivatives (6, 2) of the distorted coordinates by k1 k2 p1 p2 k3 and a fisheye's k4."""
    if lens.ndim == 1:
        _pinhole_basis(lens, x, y, d)
    elif lens[0, 13] != 0.0:
        _fisheye_basis(x, y, d)
    else:
        _pinhole_basis(lens[0], x, y, d)


@kernel()
def _lens_jacobian(model, axis, sign, lens, x, y, z, phi, vel, xd, yd, d):
    """Derivatives d (6, 2), as of `_lens_basis`, of the distorted coordinates (xd, yd) that `_project` found.

    The exact models read the row from the distorted image, so a change of the lens moves it; the others apply the lens
    last.
    """
    if model < ROTATION:
        X, Y, _ = _unlens(lens, xd, yd)
        _lens_basis(lens, X, Y, d)
        return
    moving = 1.0 if model == CONSTANT_MOTION else 0.0
    t = sign * (yd if axis == 1 else xd)
    w0, w1, w2, f0, f1, f2, p0, p1, p2, v0, v1, v2 = _path(phi, vel, moving, t)
    a, b = _rodrigues(w0 * w0 + w1 * w1 + w2 * w2)
    q0, q1, q2 = _turn(w0, w1, w2, a, b, x - p0, y - p1, z - p2)
    e0, e1, e2 = _turn(w0, w1, w2, a, b, v0, v1, v2)
    d0, d1, d2 = _moves(w0, w1, w2, f0, f1, f2, phi, a, b, q0, q1, q2)
    d0, d1, d2 = d0 - e0, d1 - e1, d2 - e2
    X, Y = q0 / q2, q1 / q2
    _, _, xx, xy, yx, yy, _ = _lens(lens, X, Y)
    dX, dY = (d0 - X * d2) / q2, (d1 - Y * d2) / q2
    at, bt = xx * dX + xy * dY, yx * dX + yy * dY
    slope = sign * (bt if axis == 1 else at) - 1.0
    _lens_basis(lens, X, Y, d)
    for k in range(6):
        dt = -sign * (d[k, 1] if axis == 1 else d[k, 0]) / slope
        d[k, 0] += at * dt
        d[k, 1] += bt * dt


@parallel_kernel()
def intrinsic_blocks(
    model, camera_of_frame, axes, signs, intrs, lenses, R_cw, center_w, phi, vel_w, points_w,
    frame_idx, point_idx, xy_raw, sigma_px, loss_kind, loss_scale, clock, unknowns, J_camera,
):  # fmt: skip
    """Jacobians (o, 2, nc) by the intrinsics of each observation's camera, weighted as in `residual_blocks`.

    `clock` is as there.
    `unknowns` (nc,) are codes: 0 log f (both), 1 log fx, 2 log fy, 3 cx / fx, 4 cy / fy, 5 to 10 k1 k2 p1 p2 k3 k4.
    """
    o = len(frame_idx)
    scale2 = loss_scale * loss_scale
    for chunk in prange((o + _CHUNK - 1) // _CHUNK):
        out = np.empty(21)
        d = np.empty((6, 2))
        vel_c = np.empty(3)
        for k in range(chunk * _CHUNK, min(o, (chunk + 1) * _CHUNK)):
            f = frame_idx[k]
            c = camera_of_frame[f]
            axis, sign, lens = axes[c], signs[c], lenses[c]
            J_camera[k] = 0.0
            x, y, z = _camera_frame(R_cw[f], center_w[f], vel_w[f], points_w[point_idx[k]], vel_c)
            row = clock[k] if clock[k] == clock[k] else _measured_row(axis, sign, intrs[c], xy_raw[k])
            if not _project(model, axis, sign, lens, x, y, z, phi[f], vel_c, row, out, False):
                continue
            xd, yd = out[0], out[1]
            r0 = (intrs[c, 0] * xd + intrs[c, 2] - xy_raw[k, 0]) / sigma_px[k]
            r1 = (intrs[c, 1] * yd + intrs[c, 3] - xy_raw[k, 1]) / sigma_px[k]
            s = r0 * r0 + r1 * r1
            _, weight, share = _loss(loss_kind, s, scale2)
            w = math.sqrt(weight)
            a_s = (1.0 - math.sqrt(1.0 - share)) / s if s > 0.0 else 0.0
            m00, m01, m11 = w * (1.0 - a_s * r0 * r0), -w * a_s * r0 * r1, w * (1.0 - a_s * r1 * r1)
            g0, g1 = intrs[c, 0] / sigma_px[k], intrs[c, 1] / sigma_px[k]
            _lens_jacobian(model, axis, sign, lens, x, y, z, phi[f], vel_c, xd, yd, d)
            for i in range(len(unknowns)):
                code = unknowns[i]
                if code >= 5:
                    u, v = d[code - 5, 0], d[code - 5, 1]
                else:
                    u = xd if code < 2 else (1.0 if code == 3 else 0.0)
                    v = yd if code == 0 or code == 2 else (1.0 if code == 4 else 0.0)
                J_camera[k, 0, i] = m00 * g0 * u + m01 * g1 * v
                J_camera[k, 1, i] = m01 * g0 * u + m11 * g1 * v
