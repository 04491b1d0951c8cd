"""A smooth field over a photo: cubic B-splines on a few even knots, of coefficients (rows, cols, 2)."""

from __future__ import annotations

from ._jit import kernel

# A fold is refused where fields are made, so that the fixed point halves its error at least, mostly divides it by 100.
_MAX_STEPS = 60
_REACHED_PX = 1e-12


@kernel(forceinline=True)
def _weights(t):
    """The four cubics that do not vanish at t, 0 to 1, between two knots."""
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        (3 * t * t * t - 6 * t * t + 4) / 6.0,
        (3 * s * s * s - 6 * s * s + 4) / 6.0,
        t * t * t / 6.0,
    )


@kernel()
def _value(spline, width, height, x, y):
    """The field (dx, dy) at a pixel; beyond the photo that at its border."""
    u = min(max((x + 0.5) / width, 0.0), 1.0) * (spline.shape[1] - 3)
    v = min(max((y + 0.5) / height, 0.0), 1.0) * (spline.shape[0] - 3)
    i, j = min(int(u), spline.shape[1] - 4), min(int(v), spline.shape[0] - 4)
    across, down = _weights(u - i), _weights(v - j)
    dx, dy = 0.0, 0.0
    for b in range(4):
        for a in range(4):
            w = down[b] * across[a]
            dx += w * spline[j + b, i + a, 0]
            dy += w * spline[j + b, i + a, 1]
    return dx, dy


@kernel()
def subtract_field(spline, width, height, x, y):
    """Pixels of the lens model from those of the photo, x and y (rows, cols), in place; NaN stays."""
    for j in range(x.shape[0]):
        for i in range(x.shape[1]):
            if x[j, i] == x[j, i]:
                dx, dy = _value(spline, width, height, x[j, i], y[j, i])
                x[j, i] -= dx
                y[j, i] -= dy


@kernel()
def add_field(spline, width, height, x, y):
    """Pixels of the photo from those of the lens model: the inverse of `subtract_field`, a fixed point."""
    for j in range(x.shape[0]):
        for i in range(x.shape[1]):
            x0, y0 = float(x[j, i]), float(y[j, i])
            if x0 != x0:
                continue
            dx, dy = 0.0, 0.0
            for _ in range(_MAX_STEPS):
                before_x, before_y = dx, dy
                dx, dy = _value(spline, width, height, x0 + dx, y0 + dy)
                if abs(dx - before_x) + abs(dy - before_y) < _REACHED_PX:
                    break
            x[j, i] = x0 + dx
            y[j, i] = y0 + dy
