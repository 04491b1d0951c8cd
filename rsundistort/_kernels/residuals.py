"""Reprojection residuals, their robust cost, and their Jacobians by poses, motions and intrinsics."""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel, parallel_kernel, prange
from .lens import distort, lens_basis, undistort
from .motion import cubic, interval, moves, path, rodrigues, rotate
from .projection import CHUNK, CONSTANT_MOTION, GLOBAL, ROTATION, project

# Largest share of the curvature along a residual that a robust loss removes. Removing all of it would send points of
# two photos whose rays miss each other far off, and damp the step of everything else until it hardly moves; removing
# none makes convergence linear. (Steps of a solve of aligned tracks: 125 with 0.99, 88 with 0.5, 49 with 0.3, 50 with
# none.)
_MOST_SHARE = 0.3
# Cost of an observation that cannot be projected (behind the camera): its point must not profit from it.
_INVALID_PX = 100.0


@kernel(forceinline=True)
def _loss(kind, s, scale2):
    """Robust loss rho(s) of a squared residual, rho'(s), and the share of curvature that it removes along r.

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


@kernel(forceinline=True)
def _weights(kind, r0, r1, scale2):
    """Factors of a whitened residual r: rho, w, keep and the symmetric M = m00, m01, m11, for r w / keep and M J.

    J <- sqrt(rho') (I - a n n') J and r <- sqrt(rho') r / (1 - a), n = r/|r|: the gradient stays rho' J'r and J'J
    becomes the Hessian of `_loss`.
    """
    s = r0 * r0 + r1 * r1
    rho, weight, share = _loss(kind, s, scale2)
    w = math.sqrt(weight)
    keep = math.sqrt(1.0 - share)
    a_s = (1.0 - keep) / s if s > 0.0 else 0.0
    return rho, w, keep, w * (1.0 - a_s * r0 * r0), -w * a_s * r0 * r1, w * (1.0 - a_s * r1 * r1)


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
    """Where the search for a measurement's row starts; it must be the same in all kernels, for the same result."""
    return sign * (xy[axis] - intr[2 + axis]) / intr[axis]


@parallel_kernel()
def residuals(
    model, camera_of_frame, axes, signs, intrs, lenses, R_cw, center_w, phi, vel_w, points_w,
    frame_idx, point_idx, xy_raw, res, valid,
):  # fmt: skip
    """Reprojection residuals (o, 2) in pixels: predicted minus measured."""
    o = len(frame_idx)
    for chunk in prange((o + CHUNK - 1) // CHUNK):
        out = np.empty(21)
        vel_c = np.empty(3)
        for k in range(chunk * CHUNK, min(o, (chunk + 1) * CHUNK)):
            f = frame_idx[k]
            c = camera_of_frame[f]
            x, y, z = _camera_frame(R_cw[f], center_w[f], vel_w[f], points_w[point_idx[k]], vel_c)
            row = _measured_row(axes[c], signs[c], intrs[c], xy_raw[k])
            valid[k] = project(model, axes[c], signs[c], lenses[c], x, y, z, phi[f], vel_c, row, out, False)
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
            if project(model, axes[c], signs[c], lenses[c], x, y, z, phi[f], vel_c, row, out, False):
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
    at, s, beyond = interval(len(bends) // 4, (t - table[0, 3]) / table[0, 4])
    rotations = bends.shape[1]
    first = len(J) - 3 * (rotations + ways)
    for j in range(rotations):
        by, _ = cubic(bends, 4 * at, j, s, beyond)
        for b in range(3):
            J[first + 3 * j + b] = by * (u * out[8 + b] + v * out[11 + b])
            if j < ways:
                J[first + 3 * (rotations + j) + b] = by * (v0 * R[0, b] + v1 * R[1, b] + v2 * R[2, b])


@parallel_kernel()
def residual_blocks(
    model, camera_of_frame, axes, signs, intrs, lenses, R_cw, center_w, phi, vel_w, points_w,
    frame_idx, point_idx, xy_raw, sigma_px, loss_kind, loss_scale, clock, nb, bends, ways, res, J_frame, cost,
):  # fmt: skip
    """Whitened, robustly weighted residuals (o, 2) with their Jacobians, and the cost summed over chunks: cost (c,).

    J_frame is (o, 2, >= nb): rotation increment (left, camera frame), centre, phi from nb = 9 on, and velocity (world
    frame) when nb = 12. Of motions that are not steady the last columns are by the coefficients of the rotation along
    the functions of `bends` (4 n, k), tables as in `path`, three after three, and then by those of the position (world
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
            if not project(model, axes[c], signs[c], lenses[c], x, y, z, phi[f], vel_c, row, out, True):
                total += 0.5 * _loss(loss_kind, 2.0 * (_INVALID_PX / sigma_px[k]) ** 2, scale2)[0]
                res[k] = 0.0
                J_frame[k] = 0.0
                continue
            precision = 1.0 / sigma_px[k]
            r0 = (intrs[c, 0] * out[0] + intrs[c, 2] - xy_raw[k, 0]) * precision
            r1 = (intrs[c, 1] * out[1] + intrs[c, 3] - xy_raw[k, 1]) * precision
            rho, w, keep, m00, m01, m11 = _weights(loss_kind, r0, r1, scale2)
            total += 0.5 * rho
            res[k, 0] = r0 * w / keep
            res[k, 1] = r1 * w / keep
            g0, g1 = intrs[c, 0] * precision, intrs[c, 1] * precision
            t = out[20]
            _, _, _, _, _, _, p0, p1, p2, _, _, _ = path(phi[f], vel_c, 1.0, t)
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
def _lens_jacobian(model, axis, sign, lens, x, y, z, phi, vel, xd, yd, d):
    """Derivatives d (6, 2), as of `lens_basis`, of the distorted coordinates (xd, yd) that `project` found.

    The exact models read the row from the distorted image, so a change of the lens moves it; the others apply the lens
    last.
    """
    if model < ROTATION:
        X, Y = x / z, y / z
        if model != GLOBAL:
            X, Y, _ = undistort(lens, xd, yd)
        lens_basis(lens, X, Y, d)
        return
    moving = 1.0 if model == CONSTANT_MOTION else 0.0
    t = sign * (yd if axis == 1 else xd)
    w0, w1, w2, f0, f1, f2, p0, p1, p2, v0, v1, v2 = path(phi, vel, moving, t)
    a, b = rodrigues(w0 * w0 + w1 * w1 + w2 * w2)
    q0, q1, q2 = rotate(w0, w1, w2, a, b, x - p0, y - p1, z - p2)
    e0, e1, e2 = rotate(w0, w1, w2, a, b, v0, v1, v2)
    d0, d1, d2 = moves(w0, w1, w2, f0, f1, f2, phi, True, a, b, q0, q1, q2)
    d0, d1, d2 = d0 - e0, d1 - e1, d2 - e2
    X, Y = q0 / q2, q1 / q2
    _, _, xx, xy, yx, yy, _ = distort(lens, X, Y)
    dX, dY = (d0 - X * d2) / q2, (d1 - Y * d2) / q2
    at, bt = xx * dX + xy * dY, yx * dX + yy * dY
    slope = sign * (bt if axis == 1 else at) - 1.0
    lens_basis(lens, X, Y, d)
    for k in range(6):
        dt = -sign * (d[k, 1] if axis == 1 else d[k, 0]) / slope
        d[k, 0] += at * dt
        d[k, 1] += bt * dt


@parallel_kernel()
def intrinsic_blocks(
    model, camera_of_frame, axes, signs, intrs, lenses, R_cw, center_w, phi, vel_w, points_w,
    frame_idx, point_idx, xy_raw, sigma_px, loss_kind, loss_scale, clock, unknowns, variation, J_camera, J_photo,
):  # fmt: skip
    """Jacobians (o, 2, nc) by the intrinsics of each observation's camera, weighted as in `residual_blocks`.

    And those (o, 2, 3) by its photo's variation, of log f, cx / f and cy / f, or (o, 2, 0) where these are not wanted.
    `clock` is as there.
    `unknowns` (nc,) are codes: 0 log f (both), 1 log fx, 2 log fy, 3 cx / fx, 4 cy / fy, 5 to 10 k1 k2 p1 p2 k3 k4.
    `variation` (m, 3) is what photos have of these: shifts are in focal lengths of the camera, and follow its own.
    """
    o = len(frame_idx)
    scale2 = loss_scale * loss_scale
    for chunk in prange((o + CHUNK - 1) // CHUNK):
        out = np.empty(21)
        d = np.empty((6, 2))
        vel_c = np.empty(3)
        for k in range(chunk * CHUNK, min(o, (chunk + 1) * CHUNK)):
            f = frame_idx[k]
            c = camera_of_frame[f]
            axis, sign, lens = axes[c], signs[c], lenses[c]
            J_camera[k] = 0.0
            J_photo[k] = 0.0
            x, y, z = _camera_frame(R_cw[f], center_w[f], vel_w[f], points_w[point_idx[k]], vel_c)
            row = clock[k] if clock[k] == clock[k] else _measured_row(axis, sign, intrs[c], xy_raw[k])
            if not project(model, axis, sign, lens, x, y, z, phi[f], vel_c, row, out, False):
                continue
            xd, yd = out[0], out[1]
            r0 = (intrs[c, 0] * xd + intrs[c, 2] - xy_raw[k, 0]) / sigma_px[k]
            r1 = (intrs[c, 1] * yd + intrs[c, 3] - xy_raw[k, 1]) / sigma_px[k]
            _, _, _, m00, m01, m11 = _weights(loss_kind, r0, r1, scale2)
            g0, g1 = intrs[c, 0] / sigma_px[k], intrs[c, 1] / sigma_px[k]
            _lens_jacobian(model, axis, sign, lens, x, y, z, phi[f], vel_c, xd, yd, d)
            # focal lengths of the camera to one of the photo
            unit = np.exp(-variation[f, 0])
            for i in range(len(unknowns)):
                code = unknowns[i]
                if code >= 5:
                    u, v = d[code - 5, 0], d[code - 5, 1]
                elif code >= 3:
                    u, v = (unit, 0.0) if code == 3 else (0.0, unit)
                else:
                    u = xd + unit * variation[f, 1] if code < 2 else 0.0
                    v = yd + unit * variation[f, 2] if code != 1 else 0.0
                J_camera[k, 0, i] = m00 * g0 * u + m01 * g1 * v
                J_camera[k, 1, i] = m01 * g0 * u + m11 * g1 * v
            if J_photo.shape[2]:
                for i, m0, m1 in ((0, m00, m01), (1, m01, m11)):
                    J_photo[k, i, 0] = m0 * g0 * xd + m1 * g1 * yd
                    J_photo[k, i, 1] = m0 * g0 * unit
                    J_photo[k, i, 2] = m1 * g1 * unit
