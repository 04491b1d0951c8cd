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
_MOST_STEPS = 30
# steps that only shift the window, before it may also turn, stretch and shear
_SHIFTS = 5
# of the centre, in samples: it has come to rest; it is lost
_AT_REST, _LOST = 0.003, 4.0


@kernel(forceinline=True)
def _cubic(patch, x, y):
    """Bicubic (Keys, a = -1/2) value at a place; the caller sees to it that four pixels lie around."""
    j, i = math.floor(x), math.floor(y)
    a, b = x - j, y - i
    u0, u1 = a * (-0.5 + a * (1.0 - 0.5 * a)), 1.0 + a * a * (-2.5 + 1.5 * a)
    u2, u3 = a * (0.5 + a * (2.0 - 1.5 * a)), a * a * (-0.5 + 0.5 * a)
    v0, v1 = b * (-0.5 + b * (1.0 - 0.5 * b)), 1.0 + b * b * (-2.5 + 1.5 * b)
    v2, v3 = b * (0.5 + b * (2.0 - 1.5 * b)), b * b * (-0.5 + 0.5 * b)
    value = 0.0
    for k in range(4):
        row = patch[i - 1 + k]
        line = u0 * row[j - 1] + u1 * row[j] + u2 * row[j + 1] + u3 * row[j + 2]
        value += (v0 if k == 0 else v1 if k == 1 else v2 if k == 2 else v3) * line
    return value


@kernel()
def _sample(patch, x, y, M, half, out):
    """Values (2 half + 1, 2 half + 1) of a window; False if it leaves the patch."""
    rows, cols = patch.shape
    for t in range(-half, half + 1):
        for s in range(-half, half + 1):
            u = x + M[0, 0] * s + M[0, 1] * t
            v = y + M[1, 0] * s + M[1, 1] * t
            if not (1.0 <= u < cols - 2.0 and 1.0 <= v < rows - 2.0):
                return False
            out[t + half, s + half] = _cubic(patch, u, v)
    return True


@kernel()
def _normalised(values, weight, out):
    """Values without their mean and of weighted length one, so that brightness and contrast count for nothing."""
    total, mean, square = 0.0, 0.0, 0.0
    for i in range(_SIDE):
        for j in range(_SIDE):
            total += weight[i, j]
            mean += weight[i, j] * values[i, j]
    mean /= total
    for i in range(_SIDE):
        for j in range(_SIDE):
            out[i, j] = values[i, j] - mean
            square += weight[i, j] * out[i, j] ** 2
    length = math.sqrt(square)
    if length > 0.0:
        for i in range(_SIDE):
            for j in range(_SIDE):
                out[i, j] /= length
    return length


@kernel()
def _jacobian(wide, weight, template, length, J):
    """Derivatives (6, side, side) of the normalised template.

    In the four parts of what turns and stretches the window and its two shifts; wide is one sample wider all around.
    """
    total = 0.0
    for i in range(_SIDE):
        for j in range(_SIDE):
            s, t = float(j - HALF), float(i - HALF)
            du = (wide[i + 1, j + 2] - wide[i + 1, j]) / (2.0 * length)
            dv = (wide[i + 2, j + 1] - wide[i, j + 1]) / (2.0 * length)
            J[0, i, j], J[1, i, j], J[2, i, j], J[3, i, j] = du * s, du * t, dv * s, dv * t
            J[4, i, j], J[5, i, j] = du, dv
            total += weight[i, j]
    for k in range(6):
        mean, along = 0.0, 0.0
        for i in range(_SIDE):
            for j in range(_SIDE):
                mean += weight[i, j] * J[k, i, j]
                along += weight[i, j] * J[k, i, j] * template[i, j]
        mean /= total
        for i in range(_SIDE):
            for j in range(_SIDE):
                J[k, i, j] -= mean + along * template[i, j]


@parallel_kernel()
def align(patches, first, second, place, M, least_length, centre, correlation, covariance):
    """Where the windows of second patches show what those of first ones do.

    Parameters
    ----------
    patches : (n, rows, cols) float32 or uint8 array
        Cut-outs of photos.
    first, second : (p,) int arrays
        Patches to align.
    place : (p, 2, 2) array
        Of the window's centre in the first and, as far as known, in the second.
    M : (p, 2, 2, 2) array
        Pixels to a sample in both.
    least_length : float
        Root of the sum of squared contrasts below which a window holds nothing to align.
    centre : (p, 2) array
        Set: the place in the second. NaN where that failed.
    correlation : (p,) array
        Set: weighted normalised cross-correlation there.
    covariance : (p, 2, 2) array
        Set: of the centre, pixels of the second patch, as the rest of the differences has it.
    """
    weight = np.empty((_SIDE, _SIDE))
    for i in range(_SIDE):
        for j in range(_SIDE):
            weight[i, j] = math.exp(-0.5 * ((i - HALF) ** 2 + (j - HALF) ** 2) / (0.6 * HALF) ** 2)
    effective = weight.sum()
    for p in prange(len(first)):
        centre[p] = np.nan
        correlation[p] = np.nan
        covariance[p] = np.nan
        wide = np.empty((_SIDE + 2, _SIDE + 2))
        if not _sample(patches[first[p]], place[p, 0, 0], place[p, 0, 1], M[p, 0], HALF + 1, wide):
            continue
        template, values, image = np.empty((_SIDE, _SIDE)), np.empty((_SIDE, _SIDE)), np.empty((_SIDE, _SIDE))
        length = _normalised(wide[1:-1, 1:-1], weight, template)
        if length < least_length:
            continue
        J = np.empty((6, _SIDE, _SIDE))
        _jacobian(wide, weight, template, length, J)
        H = np.zeros((6, 6))
        for k in range(6):
            for m in range(k + 1):
                total = 0.0
                for i in range(_SIDE):
                    for j in range(_SIDE):
                        total += weight[i, j] * J[k, i, j] * J[m, i, j]
                H[k, m] = total
                H[m, k] = total
        for k in range(6):
            # what a window without texture along one direction cannot tell is left as it is
            H[k, k] += 1e-3 * H[k, k] + 1e-9
        inverse = np.linalg.inv(H)
        of_shifts = np.linalg.inv(np.ascontiguousarray(H[4:, 4:]))
        d = np.zeros(6)
        x, y, W = place[p, 1, 0], place[p, 1, 1], M[p, 1].copy()
        reach = _LOST * math.sqrt(abs(W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0]))
        good, least = False, 0.0
        for step in range(_MOST_STEPS):
            if not _sample(patches[second[p]], x, y, W, HALF, values):
                break
            if _normalised(values, weight, image) <= 0.0:
                break
            only = 4 if step < _SHIFTS else 0
            g = np.zeros(6)
            least = 0.0
            for i in range(_SIDE):
                for j in range(_SIDE):
                    rest = weight[i, j] * (image[i, j] - template[i, j])
                    least += rest * (image[i, j] - template[i, j])
                    for k in range(only, 6):
                        g[k] += rest * J[k, i, j]
            if only == 0:
                d[:] = inverse @ g
            else:
                d[4:] = of_shifts @ g[4:]
            shift_s, shift_t = d[4], d[5]
            if only == 0:
                # the inverse of what would bring the template onto the image
                a, b, c, e = 1.0 + d[0], d[1], d[2], 1.0 + d[3]
                det = a * e - b * c
                if abs(det - 1.0) > 0.5:
                    break
                B = np.array([[e / det, -b / det], [-c / det, a / det]])
                W = W @ B
            x -= W[0, 0] * shift_s + W[0, 1] * shift_t
            y -= W[1, 0] * shift_s + W[1, 1] * shift_t
            if math.hypot(x - place[p, 1, 0], y - place[p, 1, 1]) > reach:
                break
            if only == 0 and math.hypot(shift_s, shift_t) < _AT_REST:
                good = True
                break
        if not good:
            continue
        # both windows are noisy, and the model of their difference has eight unknowns
        noise = least / max(effective - 8.0, 1.0)
        of_shift = W @ np.ascontiguousarray(inverse[4:, 4:]) @ W.T
        centre[p, 0], centre[p, 1] = x, y
        correlation[p] = 1.0 - 0.5 * least
        covariance[p] = noise * of_shift
