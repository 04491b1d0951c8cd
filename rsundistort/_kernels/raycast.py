"""Ray caster of the synthetic scenes: nearest hits, shadows, sky light, textures.

It shares no function with the row models that it checks. Conventions of every function here: `geometry`
and `look` are the tuples that `synthetic.scene.Scene` builds. A patch is a parallelogram (or the triangle
that is half of it), origin + s*edge_a + t*edge_b, whose front is the side of cross(edge_a, edge_b); it is
seen from both sides. `geometry` = (planes (p, 12): unit normal, its offset, and the dual vectors that give s
and t with their offsets; is_triangle (p,); node_bounds (n, 6): min and max; node_links (n, 3): first patch,
number of patches (0: an inner node, whose children are the next node and the one named third), second child).
"""

from __future__ import annotations

import math

import numpy as np

from ._jit import kernel, parallel_kernel, prange

# Rays that start on a surface leave it by this much (metres), or they would hit it again.
_LIFT = 1e-4
# Coordinates on a patch may exceed [0, 1] by this: no ray slips through an edge that two patches share.
_EDGE = 1e-9
_STACK = 64


@kernel()
def _safe_inverse(x):
    """Reciprocal of a direction component, finite for the slab test."""
    return 1.0 / x if abs(x) > 1e-12 else math.copysign(1e12, x)


@kernel()
def _enters(bounds, node, ox, oy, oz, ix, iy, iz, far):
    """Distance at which the ray enters a node's box, or inf when it misses it before `far`."""
    a, b = (bounds[node, 0] - ox) * ix, (bounds[node, 3] - ox) * ix
    near, end = min(a, b), max(a, b)
    a, b = (bounds[node, 1] - oy) * iy, (bounds[node, 4] - oy) * iy
    near, end = max(near, min(a, b)), min(end, max(a, b))
    a, b = (bounds[node, 2] - oz) * iz, (bounds[node, 5] - oz) * iz
    near, end = max(near, min(a, b)), min(end, max(a, b))
    return near if near <= end and end >= 0.0 and near < far else np.inf


@kernel()
def _hit(planes, is_triangle, p, ox, oy, oz, dx, dy, dz, far):
    """Ray parameter of the hit with patch p and the coordinates on it; inf if there is none before `far`."""
    q = planes[p]
    slope = q[0] * dx + q[1] * dy + q[2] * dz
    if slope == 0.0:
        return np.inf, 0.0, 0.0
    d = (q[3] - q[0] * ox - q[1] * oy - q[2] * oz) / slope
    if not 1e-9 < d < far:
        return np.inf, 0.0, 0.0
    x, y, z = ox + d * dx, oy + d * dy, oz + d * dz
    s = q[4] * x + q[5] * y + q[6] * z - q[7]
    t = q[8] * x + q[9] * y + q[10] * z - q[11]
    if s < -_EDGE or t < -_EDGE or s > 1.0 + _EDGE or t > 1.0 + _EDGE:
        return np.inf, 0.0, 0.0
    if is_triangle[p] and s + t > 1.0 + _EDGE:
        return np.inf, 0.0, 0.0
    return d, s, t


@kernel()
def _nearest(geometry, stack, ox, oy, oz, dx, dy, dz, any_hit):
    """Patch (-1: none), ray parameter and coordinates of the nearest hit, or of any hit if that will do."""
    planes, is_triangle, bounds, links = geometry
    ix, iy, iz = _safe_inverse(dx), _safe_inverse(dy), _safe_inverse(dz)
    best, best_s, best_t, patch = np.inf, 0.0, 0.0, -1
    count = 0
    if _enters(bounds, 0, ox, oy, oz, ix, iy, iz, best) < np.inf:
        stack[0] = 0
        count = 1
    while count > 0:
        count -= 1
        node = stack[count]
        first, number = links[node, 0], links[node, 1]
        if number > 0:
            for p in range(first, first + number):
                d, s, t = _hit(planes, is_triangle, p, ox, oy, oz, dx, dy, dz, best)
                if d < best:
                    best, best_s, best_t, patch = d, s, t, p
                    if any_hit:
                        return patch, best, best_s, best_t
            continue
        left, right = node + 1, links[node, 2]
        d_left = _enters(bounds, left, ox, oy, oz, ix, iy, iz, best)
        d_right = _enters(bounds, right, ox, oy, oz, ix, iy, iz, best)
        if d_left > d_right:  # the nearer child is taken first, so it goes on the stack last
            left, right = right, left
            d_left, d_right = d_right, d_left
        if d_right < np.inf:
            stack[count] = right
            count += 1
        if d_left < np.inf:
            stack[count] = left
            count += 1
    return patch, best, best_s, best_t


@parallel_kernel()
def cast_rays(geometry, origins_w, directions_w, patch, distance):
    """Nearest patch (-1: none) and ray parameter (inf: none) of each ray (n, 3)."""
    for k in prange(len(origins_w)):
        stack = np.empty(_STACK, np.int64)
        o, d = origins_w[k], directions_w[k]
        hit = _nearest(geometry, stack, o[0], o[1], o[2], d[0], d[1], d[2], False)
        patch[k] = hit[0]
        distance[k] = hit[1]


@parallel_kernel()
def bake_light(geometry, light_grid, corners, directions, sun, light):
    """Light that reaches each patch from the sky and, once reflected, from the sun.

    `light` (sum of grids, 2): share of the sky seen, and mean sunlight on what hides the rest; at the
    vertices of a grid on each patch, `light_grid` (p, 3): first vertex, cells along a and b. `corners`
    (p, 3, 3): origin and edges. `directions` (n, 3): cosine-distributed about +z. `sun` (3,): towards it.
    """
    planes = geometry[0]
    for p in prange(len(corners)):
        stack = np.empty(_STACK, np.int64)
        nx, ny, nz = planes[p, 0], planes[p, 1], planes[p, 2]
        # frame about the normal without a branch on its direction (Duff et al. 2017)
        sign = math.copysign(1.0, nz)
        a = -1.0 / (sign + nz)
        b = nx * ny * a
        start, na, nb = light_grid[p]
        for j in range(nb + 1):
            for i in range(na + 1):
                # kept off the edges, where a neighbouring wall would swallow the rays
                s = min(max(i / na, 0.01), 0.99)
                t = min(max(j / nb, 0.01), 0.99)
                x = corners[p, 0, 0] + s * corners[p, 1, 0] + t * corners[p, 2, 0] + 0.01 * nx
                y = corners[p, 0, 1] + s * corners[p, 1, 1] + t * corners[p, 2, 1] + 0.01 * ny
                z = corners[p, 0, 2] + s * corners[p, 1, 2] + t * corners[p, 2, 2] + 0.01 * nz
                open_sky = 0.0
                bounce = 0.0
                for k in range(len(directions)):
                    u, v, w = directions[k]
                    dx = u * (1.0 + sign * nx * nx * a) + v * b + w * nx
                    dy = u * sign * b + v * (sign + ny * ny * a) + w * ny
                    dz = -u * sign * nx - v * ny + w * nz
                    hit, d, _, _ = _nearest(geometry, stack, x, y, z, dx, dy, dz, False)
                    if hit < 0:
                        open_sky += 1.0 if dz > 0.0 else 0.3
                        continue
                    side = planes[hit, 0] * dx + planes[hit, 1] * dy + planes[hit, 2] * dz
                    side = -1.0 if side > 0.0 else 1.0
                    hx, hy, hz = side * planes[hit, 0], side * planes[hit, 1], side * planes[hit, 2]
                    lambert = hx * sun[0] + hy * sun[1] + hz * sun[2]
                    if lambert > 0.0:
                        qx, qy, qz = x + d * dx + _LIFT * hx, y + d * dy + _LIFT * hy, z + d * dz + _LIFT * hz
                        if _nearest(geometry, stack, qx, qy, qz, sun[0], sun[1], sun[2], True)[0] < 0:
                            bounce += lambert
                light[start + j * (na + 1) + i, 0] = open_sky / len(directions)
                light[start + j * (na + 1) + i, 1] = bounce / len(directions)


@kernel()
def _bilinear(texels, decode, start, rows, cols, x, y, weight, rgb):
    """Add weight times the texture, which repeats, at texel coordinates (x, y) with integer centres."""
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = x - x0, y - y0
    i0, j0 = int(y0) % rows, int(x0) % cols
    i1, j1 = (i0 + 1) % rows, (j0 + 1) % cols
    a, b = start + i0 * cols, start + i1 * cols
    w00, w01 = weight * (1.0 - fx) * (1.0 - fy), weight * fx * (1.0 - fy)
    w10, w11 = weight * (1.0 - fx) * fy, weight * fx * fy
    for c in range(3):
        rgb[c] += (
            w00 * decode[texels[a + j0, c]]
            + w01 * decode[texels[a + j1, c]]
            + w10 * decode[texels[b + j0, c]]
            + w11 * decode[texels[b + j1, c]]
        )


@kernel()
def _albedo(look, p, s, t, footprint_m, rgb):
    """Colour of patch p at (s, t), averaged over about footprint_m: trilinear in the texture's pyramid."""
    texture_of, offset_m, axes_m, texels, decode, levels, first_level, size_m = look[:8]
    texture = texture_of[p]
    top, end = first_level[texture], first_level[texture + 1]
    u = (offset_m[p, 0] + s * axes_m[p, 0] + t * axes_m[p, 2]) / size_m[texture, 0]
    v = (offset_m[p, 1] + s * axes_m[p, 1] + t * axes_m[p, 3]) / size_m[texture, 1]
    lod = math.log2(max(footprint_m * levels[top, 2] / size_m[texture, 0], 1.0))
    lod = min(lod, end - top - 1.0)
    low = int(lod)
    share = lod - low
    rgb[:] = 0.0
    for k in range(2):
        weight = share if k else 1.0 - share
        if weight > 0.0:
            start, rows, cols = levels[top + low + k]
            _bilinear(texels, decode, start, rows, cols, u * cols - 0.5, v * rows - 0.5, weight, rgb)


@kernel()
def _baked(light, light_grid, p, s, t, channel):
    """Baked light at (s, t) of patch p, bilinear between the vertices of its grid."""
    start, na, nb = light_grid[p]
    x, y = min(max(s, 0.0), 1.0) * na, min(max(t, 0.0), 1.0) * nb
    i, j = min(int(x), na - 1), min(int(y), nb - 1)
    fx, fy = x - i, y - j
    k = start + j * (na + 1) + i
    low = (1.0 - fx) * light[k, channel] + fx * light[k + 1, channel]
    high = (1.0 - fx) * light[k + na + 1, channel] + fx * light[k + na + 2, channel]
    return (1.0 - fy) * low + fy * high


@kernel()
def _sky(sky, dx, dy, dz, rgb):
    """Add the sky (rows: zenith to horizon, columns: once round) in a direction; below it, its last row."""
    rows, cols = sky.shape[:2]
    x = (math.atan2(dy, dx) / (2.0 * math.pi) + 0.5) * cols - 0.5
    y = math.acos(dz / math.sqrt(dx * dx + dy * dy + dz * dz)) / (0.5 * math.pi) * rows - 0.5
    y = min(max(y, 0.0), rows - 1.001)
    x0, i = math.floor(x), int(y)
    fx, fy = x - x0, y - i
    j0 = int(x0) % cols
    j1 = (j0 + 1) % cols
    for c in range(3):
        low = (1.0 - fx) * sky[i, j0, c] + fx * sky[i, j1, c]
        high = (1.0 - fx) * sky[i + 1, j0, c] + fx * sky[i + 1, j1, c]
        rgb[c] += (1.0 - fy) * low + fy * high


@parallel_kernel()
def render_rows(geometry, look, R_cw, center_w, by_column, first_row, xy_norm, spacing, suns, image):
    """Mean radiance (rows, cols, 3) of the pixels of a strip that starts at first_row.

    `xy_norm` (rows, cols, n, 2): ideal normalised coordinates of the n samples of each pixel, `spacing` between them in
    the same units. `R_cw` (lines, times, 3, 3) and `center_w` (lines, times, 3): poses of each sensor line at moments
    of its exposure, one for each sample; lines are rows, or columns if by_column. `suns` (n, 3): towards the
    point of the sun's disc that sample k looks at.
    """
    light, light_grid, sky, colours = look[8:]
    rows, cols, n = xy_norm.shape[:3]
    times = R_cw.shape[1]
    for i in prange(rows):
        stack = np.empty(_STACK, np.int64)
        rgb = np.empty(3)
        total = np.empty(3)
        planes = geometry[0]
        for j in range(cols):
            line = j if by_column else first_row + i
            total[:] = 0.0
            for k in range(n):
                # numbers, not views: views of arrays count references, which threads wait for
                m = k % times
                ox, oy, oz = center_w[line, m, 0], center_w[line, m, 1], center_w[line, m, 2]
                x, y = xy_norm[i, j, k, 0], xy_norm[i, j, k, 1]
                dx = R_cw[line, m, 0, 0] * x + R_cw[line, m, 1, 0] * y + R_cw[line, m, 2, 0]
                dy = R_cw[line, m, 0, 1] * x + R_cw[line, m, 1, 1] * y + R_cw[line, m, 2, 1]
                dz = R_cw[line, m, 0, 2] * x + R_cw[line, m, 1, 2] * y + R_cw[line, m, 2, 2]
                p, d, s, t = _nearest(geometry, stack, ox, oy, oz, dx, dy, dz, False)
                if p < 0:
                    _sky(sky, dx, dy, dz, total)
                    continue
                nx, ny, nz = planes[p, 0], planes[p, 1], planes[p, 2]
                slope = nx * dx + ny * dy + nz * dz
                front = slope < 0.0
                if not front:
                    nx, ny, nz = -nx, -ny, -nz
                # length of the sample's footprint on the surface, along its slant
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                _albedo(look, p, s, t, d * spacing * length / max(abs(slope), 0.05 * length), rgb)
                sunlight = nx * suns[k, 0] + ny * suns[k, 1] + nz * suns[k, 2]
                if sunlight > 0.0:
                    qx, qy, qz = ox + d * dx + _LIFT * nx, oy + d * dy + _LIFT * ny, oz + d * dz + _LIFT * nz
                    hit = _nearest(geometry, stack, qx, qy, qz, suns[k, 0], suns[k, 1], suns[k, 2], True)[0]
                    sunlight = sunlight if hit < 0 else 0.0
                else:
                    sunlight = 0.0
                open_sky = _baked(light, light_grid, p, s, t, 0) if front else 0.3
                bounce = _baked(light, light_grid, p, s, t, 1) if front else 0.1
                for c in range(3):
                    lit = sunlight * colours[0, c] + open_sky * colours[1, c] + bounce * colours[2, c]
                    total[c] += rgb[c] * lit
            for c in range(3):
                image[i, j, c] = total[c] / n
