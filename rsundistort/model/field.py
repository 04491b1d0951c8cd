"""What a camera's lens model leaves: how far photos are from it, as a smooth field over the frame.

A pixel `xy_raw` of the photo is the pixel `xy_raw - field(xy_raw)` of the lens model. `Camera.field[j, i]` are pixels
in x and y at places spread evenly from the upper left corner of the photo to the lower right one; between them the
field is a cubic spline in x and in y: n places have n - 3 even spans between knots. Beyond the photo it is what it is
at the border.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .._kernels import field as kernels
from .array_types import Array

if TYPE_CHECKING:
    from .camera import Camera

__all__ = [
    "MOST_FIELD_PX",
    "PINHOLE_ENDS",
    "add_field",
    "excess_px",
    "field_basis",
    "field_over_frame",
    "field_slope",
    "fisheye_apart_px",
    "folds",
    "lens_pixels",
    "raw_pixels",
    "spline_coefficients",
    "steepest",
]


# Places across and down at which slopes are looked at.
_LOOKED_AT = 33
# Slope of a field; from 1 on a photo may fold.
_STEEPEST = 0.5
#: Largest field beside a lens model, root mean square over the frame: with more, it is not the model of this lens.
MOST_FIELD_PX = 0.5
# Angles from the axis between which a fisheye's radii are interpolated.
_ANGLES = 2000
#: A pinhole lens ends before 90 degrees.
PINHOLE_ENDS = np.radians(85.0)


def _splines(u: Array, count: int, slope: bool = False) -> Array:
    """(n, count) cubic B-splines at places (n,), 0 at one border and 1 at the other, or their derivatives."""
    spans = count - 3
    at = np.clip(u, 0.0, 1.0) * spans
    first = np.minimum(at.astype(np.int64), spans - 1)
    t = at - first
    s = 1.0 - t
    if slope:
        inside = (u >= 0) & (u <= 1)
        parts = np.array([-(s**2), 3 * t**2 - 4 * t, 4 * s - 3 * s**2, t**2]) / 2 * spans * inside
    else:
        parts = np.array([s**3, 3 * t**3 - 6 * t**2 + 4, 3 * s**3 - 6 * s**2 + 4, t**3]) / 6
    value = np.zeros((len(u), count))
    np.put_along_axis(value, first[:, None] + np.arange(4), parts.T, axis=1)
    return value


def spline_coefficients(field: Array) -> Array:
    """Coefficients (rows, cols, 2) of the B-splines that have the values of a field at its places."""
    across, down = (_splines(np.linspace(0, 1, n), n) for n in (field.shape[1], field.shape[0]))
    return np.einsum("jk,il,kla->jia", np.linalg.inv(down), np.linalg.inv(across), field)


def folds(field: Array, width: int, height: int) -> bool:
    """Whether a field is too steep for its photo: from a slope of 1 on it may fold."""
    return steepest(field, width, height) > _STEEPEST


def steepest(field: Array, width: int, height: int) -> float:
    """Largest slope of a field over a photo, a bound of its matrix norm."""
    spline, u = spline_coefficients(field), np.linspace(0, 1, _LOOKED_AT)
    rows, cols = field.shape[:2]
    by_x = np.einsum("nj,mi,jia->nma", _splines(u, rows), _splines(u, cols, True) / width, spline)
    by_y = np.einsum("nj,mi,jia->nma", _splines(u, rows, True) / height, _splines(u, cols), spline)
    return float((np.abs(by_x) + np.abs(by_y)).max())


def _places(camera: Camera, xy_raw: Array) -> Array:
    """(2, n) places in the frame, from 0 to 1."""
    return np.asarray(((xy_raw + 0.5) / [camera.width, camera.height]).T)


def field_basis(camera: Camera, shape: tuple[int, int], xy_raw: Array) -> Array:
    """(n, rows * cols) weights of the values of a field of that shape at pixels (n, 2) of the photo."""
    x, y = _places(camera, xy_raw)
    down, across = (
        _splines(u, n) @ np.linalg.inv(_splines(np.linspace(0, 1, n), n)) for u, n in zip((y, x), shape, strict=True)
    )
    return (down[:, :, None] * across[:, None]).reshape(len(xy_raw), shape[0] * shape[1])


def field_slope(camera: Camera, xy_raw: Array) -> Array:
    """(n, 2, 2) derivatives of a camera's field by the pixel of the photo."""
    (x, y), spline = _places(camera, xy_raw), camera.spline
    rows, cols = spline.shape[:2]
    by_x = np.einsum("nj,ni,jia->na", _splines(y, rows), _splines(x, cols, True) / camera.width, spline)
    by_y = np.einsum("nj,ni,jia->na", _splines(y, rows, True) / camera.height, _splines(x, cols), spline)
    return np.stack([by_x, by_y], axis=2)


def lens_pixels(camera: Camera, xy_raw: Array) -> Array:
    """Pixels (n, 2) of the lens model from those of the photo (n, 2)."""
    if not camera.field.size:
        return xy_raw
    xy = np.array(xy_raw)
    kernels.subtract_field(camera.spline, camera.width, camera.height, xy[None, :, 0], xy[None, :, 1])
    return xy


def raw_pixels(camera: Camera, xy_lens: Array) -> Array:
    """Pixels (n, 2) of the photo from those of the lens model (n, 2): the inverse of `lens_pixels`."""
    xy = np.array(xy_lens)
    add_field(camera, xy[None, :, 0], xy[None, :, 1])
    return xy


def add_field(camera: Camera, x: NDArray[np.floating], y: NDArray[np.floating]) -> None:
    """Take a map, x and y (rows, cols), from pixels of the lens model to those of the photo, in place."""
    if camera.field.size:
        kernels.add_field(camera.spline, camera.width, camera.height, x, y)


def excess_px(camera: Camera) -> float:
    """Root mean square of a camera's field over its frame, if no lens of its kind deviates by so much; else 0."""
    size_px = float(np.sqrt((field_over_frame(camera)[1] ** 2).sum(2).mean()))
    return size_px if size_px > MOST_FIELD_PX else 0.0


def fisheye_apart_px(camera: Camera) -> float:
    """By how many pixels a fisheye differs from the nearest pinhole lens; of a pinhole camera, an equidistant one.

    Root mean square over what lies ahead of the camera, after k1, k2, k3 and another focal length.
    """
    x, y = ((np.arange(_LOOKED_AT) + 0.5) / _LOOKED_AT * side - 0.5 for side in (camera.width, camera.height))
    radius = np.hypot(*np.meshgrid(x - camera.K[0, 2], y - camera.K[1, 2])).ravel() / camera.K[0, 0]
    angles = np.linspace(0.0, PINHOLE_ENDS, _ANGLES)
    dist = camera.dist if camera.lens == "fisheye" else np.zeros(0)
    radii = np.maximum.accumulate(angles * (1.0 + angles[:, None] ** (2 * np.arange(1, len(dist) + 1)) @ dist))
    radius = radius[radius < radii[-1]]
    tan = np.tan(np.interp(radius, radii, angles))[:, None] ** [1, 3, 5, 7]
    tan /= np.linalg.norm(tan, axis=0)
    apart = tan @ np.linalg.lstsq(tan, radius)[0] - radius
    return float(camera.K[0, 0] * np.sqrt((apart**2).mean()))


def field_over_frame(camera: Camera, across: int = 33, down: int = 25) -> tuple[Array, Array]:
    """Places (down, across, 2) spread evenly over a photo, and a camera's field there, pixels; zero without one."""
    x, y = ((np.arange(n) + 0.5) / n * side - 0.5 for n, side in ((across, camera.width), (down, camera.height)))
    xy = np.stack(np.meshgrid(x, y), axis=2)
    return xy, xy - lens_pixels(camera, xy.reshape(-1, 2)).reshape(xy.shape)
