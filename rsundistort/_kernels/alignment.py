"""Subpixel alignment of small windows of photos with each other (Lucas and Kanade, inverse compositional).

A window is a grid of samples around a place: sample (s, t), s and t from -HALF to HALF, lies at `centre + M (s, t)`,
where `M` (2, 2) holds the pixels to a sample. Patches are cut-outs of photos that windows lie in.
"""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel, parallel_kernel, prange

#: Samples on each side of a window's centre.
HALF = 7
_SIDE = 2 * HALF + 1
_SAMPLES = _SIDE * _SIDE
# Weights of the samples, larger in the middle. A sum within the kernel would depend on the number of threads.
_WEIGHT = np.exp(-0.5 * (np.add.outer(*2 * (np.arange(-HALF, HALF + 1) ** 2,)) / (0.6 * HALF) ** 2)).ravel()
_TOTAL = float(_WEIGHT.sum())
_MOST_STEPS = 30
# Number of steps that only shift the window, before it may also rotate, stretch and shear.
_SHIFTS = 2
# of the centre, in samples: it has come to rest; it is lost
_AT_REST, _LOST = 0.01, 4.0


@kernel(forceinline=True)
def _line(row, j, u0, u1, u2, u3):
    """Weighted sum of four pixels of a row."""
    return u0 * row[j] + u1 * row[j + 1] + u2 * row[j + 2] + u3 * row[j + 3]


@kernel(forceinline=True)
def _cubic(patch, x, y):
    """Bicubic (Keys, a = -1/2) value at a place; the caller makes sure that four pixels lie around it."""
    j, i = int(x), int(y)
    a, b = x - j, y - i
    u0, u1 = a * (-0.5 + a * (1.0 - 0.5 * a)), 1.0 + a * a * (-2.5 + 1.5 * a)
    u2, u3 = a * (0.5 + a * (2.0 - 1.5 * a)), a * a * (-0.5 + 0.5 * a)
    v0, v1 = b * (-0.5 + b * (1.0 - 0.5 * b)), 1.0 + b * b * (-2.5 + 1.5 * b)
    v2, v3 = b * (0.5 + b * (2.0 - 1.5 * b)), b * b * (-0.5 + 0.5 * b)
    upper = v0 * _line(patch[i - 1], j - 1, u0, u1, u2, u3) + v1 * _line(patch[i], j - 1, u0, u1, u2, u3)
    lower = v2 * _line(patch[i + 1], j - 1, u0, u1, u2, u3) + v3 * _line(patch[i + 2], j - 1, u0, u1, u2, u3)
    return upper + lower


@kernel()
def _sample(patch, x, y, M, half, out):
    """Values of a window of (2 half + 1)^2 samples, row by row; False if it leaves the patch."""
    rows, cols = patch.shape
    # its corners say whether it lies inside
    reach_x = half * (abs(M[0, 0]) + abs(M[0, 1]))
    reach_y = half * (abs(M[1, 0]) + abs(M[1, 1]))
    if not (x - reach_x >= 1.0 and x + reach_x < cols - 2.0 and y - reach_y >= 1.0 and y + reach_y < rows - 2.0):
        return False
    n = 0
    for t in range(-half, half + 1):
        for s in range(-half, half + 1):
            out[n] = _cubic(patch, x + M[0, 0] * s + M[0, 1] * t, y + M[1, 0] * s + M[1, 1] * t)
            n += 1
    return True


@kernel()
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


@kernel()
def _jacobian(wide, weight, total, template, length, J):
    """Derivatives (samples, 6) of the normalised template.

    They are by the four entries of the matrix that deforms the window, and by its two shifts; `wide` is one sample
    wider all around.
    """
    width = _SIDE + 2
    mean, along = np.zeros(6), np.zeros(6)
    for i in range(_SIDE):
        for j in range(_SIDE):
            n, at = i * _SIDE + j, (i + 1) * width + j + 1
            s, t = float(j - HALF), float(i - HALF)
            du = (wide[at + 1] - wide[at - 1]) / (2.0 * length)
            dv = (wide[at + width] - wide[at - width]) / (2.0 * length)
            J[n, 0], J[n, 1], J[n, 2], J[n, 3], J[n, 4], J[n, 5] = du * s, du * t, dv * s, dv * t, du, dv
            for k in range(6):
                mean[k] += weight[n] * J[n, k] / total
                along[k] += weight[n] * J[n, k] * template[n]
    for n in range(_SAMPLES):
        for k in range(6):
            J[n, k] -= mean[k] + along[k] * template[n]


@kernel()
def _gradient(values, template, weight, J, g):
    """The weighted sum of squared differences, and its derivatives (6,)."""
    least = 0.0
    g0, g1, g2, g3, g4, g5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(_SAMPLES):
        rest = values[n] - template[n]
        weighted = weight[n] * rest
        least += weighted * rest
        g0 += weighted * J[n, 0]
        g1 += weighted * J[n, 1]
        g2 += weighted * J[n, 2]
        g3 += weighted * J[n, 3]
        g4 += weighted * J[n, 4]
        g5 += weighted * J[n, 5]
    g[0], g[1], g[2], g[3], g[4], g[5] = g0, g1, g2, g3, g4, g5
    return least


@kernel()
def _align_one(template_patch, patch, place, M, weight, total, least_contrast, centre, covariance):
    """One pair of windows; the correlation, NaN where they could not be aligned."""
    wide = np.empty((_SIDE + 2) * (_SIDE + 2))
    if not _sample(template_patch, place[0, 0], place[0, 1], M[0], HALF + 1, wide):
        return np.nan
    template, values, J = np.empty(_SAMPLES), np.empty(_SAMPLES), np.empty((_SAMPLES, 6))
    for i in range(_SIDE):
        for j in range(_SIDE):
            template[i * _SIDE + j] = wide[(i + 1) * (_SIDE + 2) + j + 1]
    length = _normalise(template, weight, total)
    if length < least_contrast * math.sqrt(total):
        return np.nan
    _jacobian(wide, weight, total, template, length, J)
    H = np.zeros((6, 6))
    for n in range(_SAMPLES):
        for k in range(6):
            for m in range(k + 1):
                H[k, m] += weight[n] * J[n, k] * J[n, m]
    for k in range(6):
        # a direction without texture in the window does not determine its unknowns, which stay as they are
        H[k, k] += 1e-3 * H[k, k] + 1e-9
        for m in range(k):
            H[m, k] = H[k, m]
    inverse = np.linalg.inv(H)
    det = H[4, 4] * H[5, 5] - H[4, 5] * H[5, 4]
    g, d = np.zeros(6), np.zeros(6)
    x, y, W = place[1, 0], place[1, 1], M[1].copy()
    reach = _LOST * math.sqrt(abs(W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0]))
    for step in range(_MOST_STEPS):
        if not _sample(patch, x, y, W, HALF, values) or _normalise(values, weight, total) <= 0.0:
            return np.nan
        least = _gradient(values, template, weight, J, g)
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
