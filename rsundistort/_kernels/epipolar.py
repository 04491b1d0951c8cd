"""Distances of matches from their epipolar planes in two photos with a shutter each, and their normal equations."""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel
from .motion import rodrigues, rotate


@kernel(forceinline=True)
def freed(phi, clock, ray):
    """Exp(-clock phi) ray, and the factors of that rotation."""
    w0, w1, w2 = -clock * phi[0], -clock * phi[1], -clock * phi[2]
    a, b = rodrigues(w0 * w0 + w1 * w1 + w2 * w2)
    x, y, z = rotate(w0, w1, w2, a, b, ray[0], ray[1], ray[2])
    return x, y, z, a, b


@kernel(forceinline=True)
def slope_squared(phi, clock, slopes, rate, x, y, z, a, b, g0, g1, g2):
    """Square of the derivative by the raw pixel of g . Exp(-clock phi) ray, which is x, y, z; the clock moves, too."""
    by_clock = -(g0 * (phi[1] * z - phi[2] * y) + g1 * (phi[2] * x - phi[0] * z) + g2 * (phi[0] * y - phi[1] * x))
    # back into the frame of the ray: the inverse rotation
    w0, w1, w2 = -clock * phi[0], -clock * phi[1], -clock * phi[2]
    k0, k1, k2 = rotate(w0, w1, w2, -a, b, g0, g1, g2)
    u = k0 * slopes[0, 0] + k1 * slopes[0, 1] + k2 * slopes[0, 2] + rate[0] * by_clock
    v = k0 * slopes[1, 0] + k1 * slopes[1, 1] + k2 * slopes[1, 2] + rate[1] * by_clock
    return u * u + v * v


@kernel(forceinline=True)
def by_phi(phi, clock, x, y, z, a, b, g0, g1, g2):
    """Derivative by phi of g . Exp(-clock phi) ray, which is x, y, z, to first order in the rotation."""
    # Exp(w + dw) = Exp(L dw) Exp(w), L = I + [w] / 2 to first order
    c0, c1, c2 = y * g2 - z * g1, z * g0 - x * g2, x * g1 - y * g0
    h = -0.5 * clock
    return (
        -clock * (c0 - h * (phi[1] * c2 - phi[2] * c1)),
        -clock * (c1 - h * (phi[2] * c0 - phi[0] * c2)),
        -clock * (c2 - h * (phi[0] * c1 - phi[1] * c0)),
    )


@kernel(forceinline=True)
def plane_terms(ray_1, slopes_1, clock_1, rate_1, ray_2, slopes_2, clock_2, rate_2, R, t, phi_1, phi_2):
    """The geometry of one match x_1, x_2 without the shutter, and of its error e = x_2 . t x (R x_1).

    x_1 and x_2 with the factors of their rotations (5 and 5 numbers), R x_1, and the derivatives of e by x_2, by R x_1
    and by x_1 (3 each); the square of e's derivative by the raw pixels of both.
    """
    x, y, z, a_1, b_1 = freed(phi_1, clock_1, ray_1)
    p, q, r, a_2, b_2 = freed(phi_2, clock_2, ray_2)
    X = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
    Y = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
    Z = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
    n0, n1, n2 = t[1] * Z - t[2] * Y, t[2] * X - t[0] * Z, t[0] * Y - t[1] * X
    m0, m1, m2 = q * t[2] - r * t[1], r * t[0] - p * t[2], p * t[1] - q * t[0]
    h0 = R[0, 0] * m0 + R[1, 0] * m1 + R[2, 0] * m2
    h1 = R[0, 1] * m0 + R[1, 1] * m1 + R[2, 1] * m2
    h2 = R[0, 2] * m0 + R[1, 2] * m1 + R[2, 2] * m2
    square = slope_squared(phi_1, clock_1, slopes_1, rate_1, x, y, z, a_1, b_1, h0, h1, h2)
    square += slope_squared(phi_2, clock_2, slopes_2, rate_2, p, q, r, a_2, b_2, n0, n1, n2)
    return x, y, z, a_1, b_1, p, q, r, a_2, b_2, X, Y, Z, n0, n1, n2, m0, m1, m2, h0, h1, h2, square


@kernel()
def sampson(rays_1, slopes_1, clock_1, rate_1, rays_2, slopes_2, clock_2, rate_2, R, t, phi_1, phi_2, distance):
    """Signed Sampson distance of each match, in pixels of the raw photos; inf where no pixel would change it."""
    for k in range(len(clock_1)):
        _, _, _, _, _, p, q, r, _, _, _, _, _, n0, n1, n2, _, _, _, _, _, _, square = plane_terms(
            rays_1[k], slopes_1[k], clock_1[k], rate_1, rays_2[k], slopes_2[k], clock_2[k], rate_2, R, t, phi_1, phi_2
        )  # fmt: skip
        distance[k] = (n0 * p + n1 * q + n2 * r) / math.sqrt(square) if square > 0.0 else np.inf


@kernel()
def pair_system(
    rays_1, slopes_1, clock_1, rate_1, rays_2, slopes_2, clock_2, rate_2, R, t, across, phi_1, phi_2, width, H, g
):  # fmt: skip
    """Normal equations (11, 11), (11,) of the squared Sampson distances under a robust loss of a width in pixels.

    The loss is Geman and McClure's, width^2 x / (1 + x) of x = (distance / width)^2; what is returned is its sum. The
    unknowns: a rotation w, R becoming Exp(w) R; t along `across` (2, 3); phi of the first and of the second photo. The
    distances' denominators count as constants.
    """
    H[:], g[:] = 0.0, 0.0
    J = np.empty(11)
    cost = 0.0
    for k in range(len(clock_1)):
        x, y, z, a_1, b_1, p, q, r, a_2, b_2, X, Y, Z, n0, n1, n2, m0, m1, m2, h0, h1, h2, square = plane_terms(
            rays_1[k], slopes_1[k], clock_1[k], rate_1, rays_2[k], slopes_2[k], clock_2[k], rate_2, R, t, phi_1, phi_2
        )  # fmt: skip
        if not square > 0.0:
            cost += width * width
            continue
        e = n0 * p + n1 * q + n2 * r
        J[0], J[1], J[2] = Y * m2 - Z * m1, Z * m0 - X * m2, X * m1 - Y * m0
        # e = t . (R x_1) x x_2
        c0, c1, c2 = Y * r - Z * q, Z * p - X * r, X * q - Y * p
        J[3] = across[0, 0] * c0 + across[0, 1] * c1 + across[0, 2] * c2
        J[4] = across[1, 0] * c0 + across[1, 1] * c1 + across[1, 2] * c2
        J[5], J[6], J[7] = by_phi(phi_1, clock_1[k], x, y, z, a_1, b_1, h0, h1, h2)
        J[8], J[9], J[10] = by_phi(phi_2, clock_2[k], p, q, r, a_2, b_2, n0, n1, n2)
        relative = e * e / (square * width * width)
        cost += width * width * relative / (1.0 + relative)
        weight = 1.0 / (square * (1.0 + relative) * (1.0 + relative))
        for i in range(11):
            g[i] += weight * J[i] * e
            for j in range(i + 1):
                H[i, j] += weight * J[i] * J[j]
    for i in range(11):
        for j in range(i):
            H[j, i] = H[i, j]
    return cost
