"""Maps of rectified pixels to raw ones: exact, by cubics between nodes, inverted, and as OpenCV takes them."""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel
from .projection import project, project_exact

_5, _16, _31, _LOW_HALF, _BIAS = np.int32(5), np.int32(16), np.int32(31), np.int32(0xFFFF), np.int32(1 << 20)


@kernel(forceinline=True)
def _ray(rays, u, v):
    """Direction (x, y, z) in the camera frame of a rectified pixel."""
    return (
        rays[0, 0] * u + rays[0, 1] * v + rays[0, 2],
        rays[1, 0] * u + rays[1, 1] * v + rays[1, 2],
        rays[2, 0] * u + rays[2, 1] * v + rays[2, 2],
    )


@kernel(forceinline=True)
def _raw_pixel(ok, intr, out):
    """The raw pixel that `project` found; without one, a pixel far outside of every photo.

    It is finite: a NaN is handled differently by OpenCV 4 and 5.
    """
    if ok:
        return intr[0] * out[0] + intr[2], intr[1] * out[1] + intr[3]
    return -1e6, -1e6


@kernel()
def fill_map(model, axis, sign, intr, lens, phi, rays, row0, map_x, map_y):
    """Raw pixel that saw each rectified pixel of the rows `row0 ...`.

    `rays` (3, 3) takes a rectified pixel (u, v, 1) to a direction in the camera frame.
    """
    out = np.empty(21)
    vel = np.zeros(3)
    rows, cols = map_x.shape
    for i in range(rows):
        # the clock of the last two pixels predicts that of the next
        t1 = t2 = math.nan
        for j in range(cols):
            x, y, z = _ray(rays, j, row0 + i)
            ok = project(model, axis, sign, lens, x, y, z, phi, vel, 2.0 * t1 - t2, out, False)
            t2 = t1
            t1 = sign * out[axis] if ok else math.nan
            map_x[i, j], map_y[i, j] = _raw_pixel(ok, intr, out)


@kernel()
def fill_map_at_depth(axis, sign, intr, lens, phi, vel, rays, inverse_depth, row0, map_x, map_y):
    """As `fill_map`, of the constant-motion model: what pixel [i, j] shows lies at its ray / inverse_depth[i, j].

    vel is in the camera frame; at an inverse depth of zero it moves nothing.
    """
    out = np.empty(21)
    rows, cols = map_x.shape
    for i in range(rows):
        t1 = t2 = math.nan
        for j in range(cols):
            x, y, z = _ray(rays, j, row0 + i)
            # the scale of a scene cannot be seen: the ray, and the velocity times the inverse depth, suffice
            ok = z > 0.0 and project_exact(
                axis, sign, lens, x, y, z, phi, vel, float(inverse_depth[i, j]), 2.0 * t1 - t2, out, False
            )
            t2 = t1
            t1 = sign * out[axis] if ok else math.nan
            map_x[i, j], map_y[i, j] = _raw_pixel(ok, intr, out)


@kernel(forceinline=True)
def _powers(x0, x1, x2, x3):
    """Coefficients of the cubic through the values at 0, 1, 2, 3, by powers of the place."""
    x1, x2, x3 = x1 - x0, x2 - x0, x3 - x0
    return x0, 3.0 * x1 - 1.5 * x2 + x3 / 3.0, -2.5 * x1 + 2.0 * x2 - 0.5 * x3, 0.5 * (x1 - x2) + x3 / 6.0


@kernel(forceinline=True)
def _nodes_of_row(nodes, p, s, column):
    """Values (n,) at the columns of nodes, in a row of pixels at the place s, 0 to 3, of the row p of patches."""
    w0, w1 = (1.0 - s) * (2.0 - s) * (3.0 - s) / 6.0, s * (2.0 - s) * (3.0 - s) / 2.0
    w2, w3 = s * (1.0 - s) * (s - 3.0) / 2.0, s * (1.0 - s) * (2.0 - s) / 6.0
    a, b, c, d = 3 * p, 3 * p + 1, 3 * p + 2, 3 * p + 3
    for k in range(len(column)):
        column[k] = w0 * nodes[a, k] + w1 * nodes[b, k] + w2 * nodes[c, k] + w3 * nodes[d, k]


@kernel(forceinline=True)
def _interpolate_row(column_x, column_y, k, at, low, right, bottom, row_x, row_y, row_seen):
    """A row of a patch from its nodes k ... k + 3; pixels between low and right, or bottom, are seen.

    The number of pixels that are not seen is returned.
    """
    x0, xa, xb, xc = _powers(column_x[k], column_x[k + 1], column_x[k + 2], column_x[k + 3])
    y0, ya, yb, yc = _powers(column_y[k], column_y[k + 1], column_y[k + 2], column_y[k + 3])
    outside = 0
    for j in range(len(row_x)):
        t = at[j]
        x = x0 + t * (xa + t * (xb + t * xc))
        y = y0 + t * (ya + t * (yb + t * yc))
        row_x[j] = x
        row_y[j] = y
        inside = (x > low) & (x < right) & (y > low) & (y < bottom)
        row_seen[j] = 255 if inside else 0
        outside += 0 if inside else 1
    return outside


@kernel()
def interpolate_map(
    model, axis, sign, intr, lens, phi, rays, nodes_x, nodes_y, smooth, spacing, band, edge, width, height, row0,
    map_x, map_y, seen,
):  # fmt: skip
    """As `fill_map`, by cubics between nodes of the grid, with the pixels that see the raw photo.

    Patches of 3 x 3 cells have 4 x 4 of the nodes, (3 m + 1, 3 n + 1) in all, `spacing` pixels apart. Exact instead are
    patches that are not `smooth` (m, n), and pixels within `band` of where seeing ends, `edge` pixels beyond the
    outermost centres of the raw photo (width, height). `seen` gets 255 or 0; the number of zeros is returned.
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
        _nodes_of_row(nodes_x, p, at[v - p * side], column_x)
        _nodes_of_row(nodes_y, p, at[v - p * side], column_y)
        for q in range(smooth.shape[1]):
            start = q * side
            n = min(side, cols - start)
            row_x, row_y, row_seen = line_x[start : start + n], line_y[start : start + n], line_seen[start : start + n]
            if smooth[p, q]:
                near = _interpolate_row(
                    column_x, column_y, 3 * q, at, low + band, right - band, bottom - band, row_x, row_y, row_seen
                )
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
                x, y, z = _ray(rays, start + j, v)
                ok = project(model, axis, sign, lens, x, y, z, phi, vel, 2.0 * t1 - t2, out, False)
                t2 = t1
                t1 = sign * out[axis] if ok else math.nan
                x, y = _raw_pixel(ok, intr, out)
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


@kernel()
def fixed_point(map_x, map_y, xy, fraction):
    """OpenCV's CV_16SC2 map, rounded to 1/32 pixel: `xy` is a view of (rows, cols, 2) int16 as (rows, cols) int32.

    It equals `cv2.convertMaps`, in a quarter of its time, since it uses 32-bit integers throughout, which vectorise.
    Positions beyond 32,767 px wrap around.
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
