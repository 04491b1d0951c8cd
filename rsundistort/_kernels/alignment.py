"""Subpixel alignment of small windows of photos with each other (Lucas and Kanade, inverse compositional).

A window is a grid of samples around a place: sample (s, t), s and t from -HALF to HALF, lies at `centre + M (s, t)`,
where `M` (2, 2) holds the pixels to a sample. Patches are cut-outs of photos that windows lie in.
"""

from __future__ import annotations

import math

import numpy as np

from ._jit import SUMS, kernel, parallel_kernel, prange

#: Samples on each side of a window's centre.
HALF = 7
_SIDE = 2 * HALF + 1
_SAMPLES = _SIDE * _SIDE
# Weights of the samples, larger in the middle. A sum within the kernel would depend on the number of threads.
_WEIGHT = np.exp(-0.5 * (np.add.outer(*2 * (np.arange(-HALF, HALF + 1) ** 2,)) / (0.6 * HALF) ** 2)).ravel()
_TOTAL = float(_WEIGHT.sum())
# Column and row of the samples in the window.
_S = np.tile(np.arange(-HALF, HALF + 1, dtype=np.float32), _SIDE)
_T = np.repeat(np.arange(-HALF, HALF + 1, dtype=np.float32), _SIDE)
_MOST_STEPS = 30
# Number of steps that only shift the window, before it may also rotate, stretch and shear.
_SHIFTS = 2
# of the centre, in samples: it has come to rest; it is lost
_AT_REST, _LOST = 0.01, 4.0


@kernel(forceinline=True)
def _line(flat, at, u0, u1, u2, u3):
    """Weighted sum of four pixels of a row."""
    return u0 * flat[at] + u1 * flat[at + 1] + u2 * flat[at + 2] + u3 * flat[at + 3]


@kernel(forceinline=True)
def _cubic(flat, cols, x, y):
    """Bicubic (Keys, a = -1/2) value at a place; the caller makes sure that four pixels lie around it."""
    j, i = int(x), int(y)
    a, b = x - np.float32(j), y - np.float32(i)
    half, one, half3, two, half5 = np.float32(0.5), np.float32(1.0), np.float32(1.5), np.float32(2.0), np.float32(2.5)
    u0, u1 = a * (-half + a * (one - half * a)), one + a * a * (-half5 + half3 * a)
    u2, u3 = a * (half + a * (two - half3 * a)), a * a * (-half + half * a)
    v0, v1 = b * (-half + b * (one - half * b)), one + b * b * (-half5 + half3 * b)
    v2, v3 = b * (half + b * (two - half3 * b)), b * b * (-half + half * b)
    at = (i - 1) * cols + j - 1
    upper = v0 * _line(flat, at, u0, u1, u2, u3) + v1 * _line(flat, at + cols, u0, u1, u2, u3)
    at += 2 * cols
    lower = v2 * _line(flat, at, u0, u1, u2, u3) + v3 * _line(flat, at + cols, u0, u1, u2, u3)
    return upper + lower


@kernel(forceinline=True)
def _lies_inside(rows, cols, x, y, M, half):
    """Whether a window of (2 half + 1)^2 samples leaves no patch: its corners say so."""
    reach_x = half * (abs(M[0, 0]) + abs(M[0, 1]))
    reach_y = half * (abs(M[1, 0]) + abs(M[1, 1]))
    # a thousandth of a pixel is more than the rounding of a place in single precision
    left, top, right, bottom = x - reach_x, y - reach_y, x + reach_x, y + reach_y
    return left >= 1.001 and right < cols - 2.001 and top >= 1.001 and bottom < rows - 2.001


@kernel(fastmath=SUMS)
def _flatten(patch, flat):
    """A patch in single precision and without its mean, which would cost digits."""
    rows, cols = patch.shape
    total = 0
    for i in range(rows):
        for j in range(cols):
            total += patch[i, j]
    mean = np.float32(total / (rows * cols))
    for i in range(rows):
        for j in range(cols):
            flat[i * cols + j] = np.float32(patch[i, j]) - mean


@kernel()
def _sample(flat, cols, x, y, M, half, out):
    """Values of a window of (2 half + 1)^2 samples, row by row."""
    n = 0
    for t in range(-half, half + 1):
        for s in range(-half, half + 1):
            at_x, at_y = x + M[0, 0] * s + M[0, 1] * t, y + M[1, 0] * s + M[1, 1] * t
            out[n] = _cubic(flat, cols, np.float32(at_x), np.float32(at_y))
            n += 1


@kernel(fastmath=SUMS)
def _normalise(values, weight, total):
    """Subtract the mean and scale to a weighted length of one, without brightness and contrast; the length before."""
    mean, square = 0.0, 0.0
    for n in range(_SAMPLES):
        mean += weight[n] * values[n]
    mean /= total
    for n in range(_SAMPLES):
        values[n] -= mean
        square += weight[n] * values[n] * values[n]
    length = math.sqrt(square)
    if length > 0.0:
        for n in range(_SAMPLES):
            values[n] /= length
    return length


@kernel(fastmath=SUMS)
def _dot(a, b):
    """Sum of the products."""
    total = 0.0
    for n in range(_SAMPLES):
        total += a[n] * b[n]
    return total


@kernel()
def _jacobian(wide, weight, total, template, length, J):
    """Derivatives (6, samples) of the normalised template.

    They are by the four entries of the matrix that deforms the window, and by its two shifts; `wide` is one sample
    wider all around.
    """
    width = _SIDE + 2
    for i in range(_SIDE):
        for j in range(_SIDE):
            n, at = i * _SIDE + j, (i + 1) * width + j + 1
            s, t = float(j - HALF), float(i - HALF)
            du = (wide[at + 1] - wide[at - 1]) / (2.0 * length)
            dv = (wide[at + width] - wide[at - width]) / (2.0 * length)
            J[0, n], J[1, n], J[2, n], J[3, n], J[4, n], J[5, n] = du * s, du * t, dv * s, dv * t, du, dv
    weighted = weight * template
    for k in range(6):
        mean, along = _dot(weight, J[k]) / total, _dot(weighted, J[k])
        for n in range(_SAMPLES):
            J[k, n] -= mean + along * template[n]


@kernel(fastmath=SUMS)
def _sums(flat, cols, x, y, M, weights, out):
    """Weighted sums of the values of a window, of their squares, and of their products with template and Jacobian."""
    m00, m01, m10, m11 = np.float32(M[0, 0]), np.float32(M[0, 1]), np.float32(M[1, 0]), np.float32(M[1, 1])
    x0, y0, zero = np.float32(x), np.float32(y), np.float32(0.0)
    total, square, along, g0, g1, g2, g3, g4, g5 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for n in range(_SAMPLES):
        v = _cubic(flat, cols, x0 + m00 * _S[n] + m01 * _T[n], y0 + m10 * _S[n] + m11 * _T[n])
        weighted = weights[0, n] * v
        total += weighted
        square += weighted * v
        along += weights[1, n] * v
        g0 += weights[2, n] * v
        g1 += weights[3, n] * v
        g2 += weights[4, n] * v
        g3 += weights[5, n] * v
        g4 += weights[6, n] * v
        g5 += weights[7, n] * v
    out[0], out[1], out[2] = total, square, along
    out[3], out[4], out[5], out[6], out[7], out[8] = g0, g1, g2, g3, g4, g5


@kernel()
def _align_one(template_patch, patch, place, M, weight, total, least_contrast, centre, covariance):
    """One pair of windows; the correlation, NaN where they could not be aligned."""
    rows, cols = patch.shape
    if not _lies_inside(rows, cols, place[0, 0], place[0, 1], M[0], HALF + 1):
        return np.nan
    flat = np.empty(rows * cols, np.float32)
    wide = np.empty((_SIDE + 2) * (_SIDE + 2))
    _flatten(template_patch, flat)
    _sample(flat, cols, place[0, 0], place[0, 1], M[0], HALF + 1, wide)
    template, J = np.empty(_SAMPLES), np.empty((6, _SAMPLES))
    for i in range(_SIDE):
        for j in range(_SIDE):
            template[i * _SIDE + j] = wide[(i + 1) * (_SIDE + 2) + j + 1]
    length = _normalise(template, weight, total)
    if length < least_contrast * math.sqrt(total):
        return np.nan
    _jacobian(wide, weight, total, template, length, J)
    H, weights = np.empty((6, 6)), np.empty((8, _SAMPLES), np.float32)
    weights[0], weights[1] = weight, weight * template
    for k in range(6):
        weighted = weight * J[k]
        weights[2 + k] = weighted
        for m in range(k + 1):
            H[k, m] = H[m, k] = _dot(weighted, J[m])
        # a direction without texture in the window does not determine its unknowns, which stay as they are
        H[k, k] += 1e-3 * H[k, k] + 1e-9
    inverse = np.linalg.inv(H)
    det = H[4, 4] * H[5, 5] - H[4, 5] * H[5, 4]
    _flatten(patch, flat)
    sums, d = np.empty(9), np.zeros(6)
    g = sums[3:]
    x, y, W = place[1, 0], place[1, 1], M[1].copy()
    reach = _LOST * math.sqrt(abs(W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0]))
    for step in range(_MOST_STEPS):
        if not _lies_inside(rows, cols, x, y, W, HALF):
            return np.nan
        _sums(flat, cols, x, y, W, weights, sums)
        square = sums[1] - sums[0] * sums[0] / total
        if square <= 0.0:
            return np.nan
        # brightness and contrast fall out: template and Jacobian have no mean, and the latter nothing of the former
        for k in range(2, 9):
            sums[k] /= math.sqrt(square)
        least = max(2.0 - 2.0 * sums[2], 0.0)
        if step < _SHIFTS:
            s, t = (H[5, 5] * g[4] - H[4, 5] * g[5]) / det, (H[4, 4] * g[5] - H[5, 4] * g[4]) / det
        else:
            for k in range(6):
                d[k] = 0.0
                for m in range(6):
                    d[k] += inverse[k, m] * g[m]
            s, t = d[4], d[5]
            # the inverse of what would bring the template onto the image
            stretch = (1.0 + d[0]) * (1.0 + d[3]) - d[1] * d[2]
            if abs(stretch - 1.0) > 0.5:
                return np.nan
            for k in range(2):
                a, b = W[k, 0], W[k, 1]
                W[k, 0] = (a * (1.0 + d[3]) - b * d[2]) / stretch
                W[k, 1] = (b * (1.0 + d[0]) - a * d[1]) / stretch
        x -= W[0, 0] * s + W[0, 1] * t
        y -= W[1, 0] * s + W[1, 1] * t
        if math.hypot(x - place[1, 0], y - place[1, 1]) > reach:
            return np.nan
        if step >= _SHIFTS and math.hypot(s, t) < _AT_REST:
            # the model of the difference has eight unknowns: six, brightness and contrast
            noise = least / max(total - 8.0, 1.0)
            centre[0], centre[1] = x, y
            for k in range(2):
                for m in range(2):
                    covariance[k, m] = 0.0
                    for i in range(2):
                        for j in range(2):
                            covariance[k, m] += noise * W[k, i] * inverse[4 + i, 4 + j] * W[m, j]
            return 1.0 - 0.5 * least
    return np.nan


@parallel_kernel()
def align(patches, first, second, place, M, least_contrast, centre, correlation, covariance):
    """Where the windows of second patches show what those of first ones do.

    Parameters
    ----------
    patches : (n, rows, cols) uint8 array
        Cut-outs of photos.
    first, second : (p,) int arrays
        Patches to align.
    place : (p, 2, 2) array
        Places of the window's centre in the first and, as far as known, in the second.
    M : (p, 2, 2, 2) array
        Pixels per sample in both.
    least_contrast : float
        Standard deviation below which a window holds nothing to align.
    centre : (p, 2) array
        Output: the place in the second, where they could be aligned.
    correlation : (p,) array
        Output: weighted normalised cross-correlation there; NaN where they could not be aligned.
    covariance : (p, 2, 2) array
        Output: covariance of the centre there, in pixels of the second patch, by the remaining differences.
    """
    for p in prange(len(first)):
        correlation[p] = _align_one(
            patches[first[p]], patches[second[p]], place[p], M[p], _WEIGHT, _TOTAL, least_contrast, centre[p],
            covariance[p],
        )  # fmt: skip
