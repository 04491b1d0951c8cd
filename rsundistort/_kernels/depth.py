"""Inverse depths of pixels, and the pixels that something nearer hides.

`field` is a map of inverse depths that is stretched over the rectified photo as `cv2.resize` does, `scale` (2,) its
pixels per pixel of the photo in x and y.
"""

from __future__ import annotations

import math

from ._jit import kernel

# Displacement in pixels from which a point counts as hidden: things that stand next to each other hide nothing.
_LEAST_PX = 1.0
_STEP_PX = 0.5
# A surface ends where it recedes this many times faster than the line of sight comes nearer.
EDGE = 4.0
# Pixels of the photo on a side of the tiles for which slopes of the field are known.
TILE_PX = 16


@kernel(forceinline=True)
def _sample(field, scale, u, v):
    """Bilinear, the border repeated."""
    rows, cols = field.shape
    x = min(max((u + 0.5) * scale[0] - 0.5, 0.0), cols - 1.0)
    y = min(max((v + 0.5) * scale[1] - 0.5, 0.0), rows - 1.0)
    j, i = min(int(x), max(cols - 2, 0)), min(int(y), max(rows - 2, 0))
    a, b = x - j, y - i
    k, m = min(j + 1, cols - 1), min(i + 1, rows - 1)
    top = field[i, j] + a * (field[i, k] - field[i, j])
    low = field[m, j] + a * (field[m, k] - field[m, j])
    return top + b * (low - top)


@kernel()
def sample_points(field, scale, xy, out):
    """Inverse depths (n,) of pixels (n, 2)."""
    for k in range(len(xy)):
        out[k] = _sample(field, scale, xy[k, 0], xy[k, 1])


@kernel()
def sample_rows(field, scale, row0, out):
    """Inverse depths (rows, cols) of the rows of the photo from row0 on."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = _sample(field, scale, j, row0 + i)


@kernel()
def mark_hidden(field, scale, nearest, slopes, epipoles, axis, row0, map_x, map_y):
    """Point the map far outside at pixels that the camera could not see when it read the row that shows them.

    A raw pixel is read at one moment, from one place. The line from a point at inverse depth w to that place runs, in
    the rectified photo, over the pixels ((u, v, 1) + m e) / (1 + m e_z), m > 0, at the inverse depths (w + m) / (1 + m
    e_z), where e is the place in homogeneous pixels: `epipoles` (lines, 3) has it for each line of the raw photo. The
    point is hidden if the line comes out of the front of something on its way; it may pass behind a thing and come out
    at its edge. `nearest` is the largest inverse depth of the field, `slopes` what it changes by at most per pixel
    around each tile.
    """
    rows, cols = map_x.shape
    last_line = len(epipoles) - 1.0
    for i in range(rows):
        v = float(row0 + i)
        for j in range(cols):
            if map_x[i, j] <= -1e6:
                continue
            u = float(j)
            at = min(max(map_y[i, j] if axis == 1 else map_x[i, j], 0.0), last_line)
            a = int(at)
            b, t = min(a + 1, len(epipoles) - 1), at - a
            e0 = epipoles[a, 0] + t * (epipoles[b, 0] - epipoles[a, 0])
            e1 = epipoles[a, 1] + t * (epipoles[b, 1] - epipoles[a, 1])
            e2 = epipoles[a, 2] + t * (epipoles[b, 2] - epipoles[a, 2])
            pixels_per_m = math.sqrt((e0 - u * e2) ** 2 + (e1 - v * e2) ** 2)
            w = _sample(field, scale, u, v)
            # the inverse depth of the line rises by the same amount at every pixel; nothing that rises less hides it
            if slopes[(row0 + i) // TILE_PX, j // TILE_PX] * pixels_per_m < 1.0 - w * e2:
                continue
            last = (nearest - w) / max(1.0 - nearest * e2, 1e-9)
            if not last * pixels_per_m > _LEAST_PX:
                continue
            m, step = _LEAST_PX / pixels_per_m, _STEP_PX / pixels_per_m
            behind = False
            surface = line = fall = 0.0
            while m < last and 1.0 + m * e2 > 0.0:
                inverse = 1.0 / (1.0 + m * e2)
                surface_before, line_before = surface, line
                surface = _sample(field, scale, (u + m * e0) * inverse, (v + m * e1) * inverse)
                line = (w + m) * inverse
                fall_before, fall = fall, surface_before - surface
                if behind and surface <= line:
                    behind = False
                    if max(fall, fall_before) <= EDGE * (line - line_before):
                        behind = True
                        break
                elif surface > line:
                    behind = True
                m += step
            if behind:
                map_x[i, j] = map_y[i, j] = -1e6


@kernel()
def fill_triangles(xy, values, triangles, out):
    """Interpolate values (n,) of points (n, 2) linearly within triangles (m, 3) of them, at the pixels of out."""
    rows, cols = out.shape
    for k in range(len(triangles)):
        a, b, c = triangles[k, 0], triangles[k, 1], triangles[k, 2]
        x, y = xy[a, 0], xy[a, 1]
        bx, by, cx, cy = xy[b, 0] - x, xy[b, 1] - y, xy[c, 0] - x, xy[c, 1] - y
        det = bx * cy - by * cx
        if det == 0.0:
            continue
        low_x, high_x = x + min(bx, cx, 0.0), x + max(bx, cx, 0.0)
        low_y, high_y = y + min(by, cy, 0.0), y + max(by, cy, 0.0)
        for i in range(max(math.ceil(low_y), 0), min(math.floor(high_y), rows - 1) + 1):
            for j in range(max(math.ceil(low_x), 0), min(math.floor(high_x), cols - 1) + 1):
                beta = ((j - x) * cy - (i - y) * cx) / det
                gamma = ((i - y) * bx - (j - x) * by) / det
                if beta >= 0.0 and gamma >= 0.0 and beta + gamma <= 1.0:
                    out[i, j] = values[a] + beta * (values[b] - values[a]) + gamma * (values[c] - values[a])
