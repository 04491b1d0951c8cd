"""Rotations, and the path of a camera during its readout."""

from __future__ import annotations

import math

from ._jit import kernel


@kernel(forceinline=True)
def rodrigues(t2):
    """The factors sin t / t and (1 - cos t) / t^2 of an angle t given by its square, to rounding at any angle."""
    if t2 < 0.25:  # what is left out is below t^14 / 15! = 5e-17
        a = t2 * (1 / 5040 - t2 * (1 / 362880 - t2 * (1 / 39916800 - t2 * (1 / 6227020800))))
        b = t2 * (1 / 40320 - t2 * (1 / 3628800 - t2 * (1 / 479001600 - t2 * (1 / 87178291200))))
        return 1.0 - t2 * (1 / 6 - t2 * (1 / 120 - a)), 0.5 - t2 * (1 / 24 - t2 * (1 / 720 - b))
    t = math.sqrt(t2)
    h = math.sin(0.5 * t) / t
    return math.sin(t) / t, 2.0 * h * h


@kernel(forceinline=True)
def third_factor(t2, a):
    """(t - sin t) / t^3 of an angle t given by its square, and a = sin t / t."""
    if t2 < 0.25:
        c = t2 * (1 / 362880 - t2 * (1 / 39916800 - t2 * (1 / 6227020800 - t2 * (1 / 1307674368000))))
        return 1 / 6 - t2 * (1 / 120 - t2 * (1 / 5040 - c))
    return (1.0 - a) / t2


@kernel(forceinline=True)
def rotate(w0, w1, w2, a, b, x, y, z):
    """(I + a [w] + b [w]^2) (x, y, z).

    With a, b of `rodrigues` this is Exp(w); with b and the third factor it is the left Jacobian L of SO(3),
    Exp(w + dw) = Exp(L dw) Exp(w) to first order. The transpose of either has -a.
    """
    c0, c1, c2 = w1 * z - w2 * y, w2 * x - w0 * z, w0 * y - w1 * x
    return (
        x + a * c0 + b * (w1 * c2 - w2 * c1),
        y + a * c1 + b * (w2 * c0 - w0 * c2),
        z + a * c2 + b * (w0 * c1 - w1 * c0),
    )


@kernel(forceinline=True)
def path(phi, vel, moving, t):
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
    rate = 1.0 / phi[0, 4]
    i, u, beyond = interval(phi.shape[0] // 4, (t - phi[0, 3]) * rate)
    i = 1 + 4 * i
    w0, d0 = cubic(phi, i, 0, u, beyond)
    w1, d1 = cubic(phi, i, 1, u, beyond)
    w2, d2 = cubic(phi, i, 2, u, beyond)
    w0, w1, w2 = w0 + t * phi[0, 0], w1 + t * phi[0, 1], w2 + t * phi[0, 2]
    d0, d1, d2 = d0 * rate + phi[0, 0], d1 * rate + phi[0, 1], d2 * rate + phi[0, 2]
    if moving == 0.0:
        return w0, w1, w2, d0, d1, d2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    p0, e0 = cubic(phi, i, 3, u, beyond)
    p1, e1 = cubic(phi, i, 4, u, beyond)
    p2, e2 = cubic(phi, i, 5, u, beyond)
    p0, p1, p2 = moving * (p0 + t * vel[0]), moving * (p1 + t * vel[1]), moving * (p2 + t * vel[2])
    e0, e1, e2 = moving * (e0 * rate + vel[0]), moving * (e1 * rate + vel[1]), moving * (e2 * rate + vel[2])
    return w0, w1, w2, d0, d1, d2, p0, p1, p2, e0, e1, e2


@kernel(forceinline=True)
def interval(n, s):
    """The interval of a place s among n of length 1, the place in it, and the distance beyond the first or the last."""
    i = min(max(int(min(max(s, 0.0), float(n))), 0), n - 1)
    u = min(max(s - i, 0.0), 1.0)
    return i, u, s - i - u


@kernel(forceinline=True)
def cubic(table, i, column, u, beyond):
    """Value and derivative of a cubic, whose coefficients are rows i to i + 3, at u and along the tangent there."""
    a, b, c, d = table[i, column], table[i + 1, column], table[i + 2, column], table[i + 3, column]
    slope = b + u * (2.0 * c + u * 3.0 * d)
    return a + u * (b + u * (c + u * d)) + beyond * slope, slope


@kernel(forceinline=True)
def moves(w0, w1, w2, f0, f1, f2, phi, exact, a, b, q0, q1, q2):
    """Derivative by the clock of q = Exp(w) x: that of w is f. If it is not to be exact, w is taken to be along f."""
    if exact and phi.ndim == 2:
        # of a steady motion w is along f, and L f = f
        c = third_factor(w0 * w0 + w1 * w1 + w2 * w2, a)
        f0, f1, f2 = rotate(w0, w1, w2, b, c, f0, f1, f2)
    return f1 * q2 - f2 * q1, f2 * q0 - f0 * q2, f0 * q1 - f1 * q0


@kernel(forceinline=True)
def _steady(phi, k):
    """Phi itself, or that of a motion that is not steady."""
    return phi[k] if phi.ndim == 1 else phi[0, k]


@kernel(forceinline=True)
def row_phi(axis, sign, phi):
    """The motion phi as row readout from top to bottom would need it, after exchanging x and y for columns.

    An exchange of x and y is a reflection S, and S Exp(w) S = Exp(-S w): so columns take -S phi.
    """
    f0, f1, f2 = _steady(phi, 0), _steady(phi, 1), _steady(phi, 2)
    if axis == 1:
        return sign * f0, sign * f1, sign * f2
    return -sign * f1, -sign * f0, -sign * f2
