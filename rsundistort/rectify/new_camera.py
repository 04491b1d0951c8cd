"""The camera of a rectified photo: how much to keep, how much to crop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..model import Camera, RowMotion
from ..model.projection import unproject_points

__all__ = ["optimal_new_camera"]


def _border(camera: Camera) -> list[NDArray[np.float64]]:
    """Pixels of the left, right, top and bottom border of the raw photo."""
    w, h = camera.width - 1.0, camera.height - 1.0
    u, v = np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float)
    return [
        np.column_stack([np.zeros_like(v), v]),
        np.column_stack([np.full_like(v, w), v]),
        np.column_stack([u, np.zeros_like(u)]),
        np.column_stack([u, np.full_like(u, h)]),
    ]


def optimal_new_camera(
    camera: Camera,
    motion: RowMotion | None = None,
    shutter_model: str = "rotation",
    alpha: float = 0.0,
    size: tuple[int, int] | None = None,
) -> tuple[Camera, tuple[int, int, int, int]]:
    """Pinhole camera of the rectified photo, in the manner of `cv2.getOptimalNewCameraMatrix`.

    The borders of the raw photo are walked pixel by pixel, so that the answer is exact also with strong motion. Pixels
    keep the shape (fx : fy) that they have in the raw photo. The wider a fisheye, the less this is what one wants: the
    middle shrinks as the border is stretched, and a border 90 degrees from the axis is refused.

    Parameters
    ----------
    camera, motion, shutter_model
        As in `init_rectify_map`.
    alpha : float
        0: no empty pixel; 1: every raw pixel is kept; between: between.
    size : (width, height), optional
        Size of the rectified photo; the camera's own when left out.

    Returns
    -------
    new_camera : Camera
        Without distortion.
    roi : (x, y, width, height)
        Rectangle of the rectified photo without empty pixels.
    """
    if not 0.0 <= alpha <= 1.0:
        raise InputError(f"alpha={alpha}, expected 0 to 1")
    width, height = size or (camera.width, camera.height)
    if width < 2 or height < 2:
        raise InputError(f"size={size}, expected (width, height) of at least 2")
    left, right, top, bottom = (unproject_points(b, camera, motion, shutter_model)[0] for b in _border(camera))
    edges = np.vstack([left, right, top, bottom])
    if not np.isfinite(edges).all():
        if camera.lens == "fisheye":
            raise InputError(
                "the photo's border has no place in a pinhole photo: it lies 90 degrees or more from the axis, or the "
                "lens folds before; check dist, or make a camera of your own, as camera.pinhole() does with the same K"
            )
        raise InputError("the photo's border has no place without lens and shutter; check dist and phi")
    inner_lo = np.array([left[:, 0].max(), top[:, 1].max()])
    inner_hi = np.array([right[:, 0].min(), bottom[:, 1].min()])
    outer_lo, outer_hi = edges.min(0), edges.max(0)
    if (inner_hi <= inner_lo).any():
        raise InputError("no rectangle without empty pixels exists; check dist and phi")
    span = np.array([width - 1.0, height - 1.0])
    shape = np.array([camera.K[0, 0], camera.K[1, 1]]) / camera.K[0, 0]
    # one zoom for both axes: the tighter one for the inner rectangle, the wider one for the outer
    zoom_inner = (span / (inner_hi - inner_lo) / shape).max()
    zoom_outer = (span / (outer_hi - outer_lo) / shape).min()
    zoom = zoom_inner ** (1.0 - alpha) * zoom_outer**alpha
    middle = (1.0 - alpha) * (inner_lo + inner_hi) / 2 + alpha * (outer_lo + outer_hi) / 2
    f = zoom * shape
    c = span / 2 - f * middle
    new = Camera(width, height, np.array([[f[0], 0, c[0]], [0, f[1], c[1]], [0, 0, 1]]), readout=camera.readout)
    lo = np.clip(np.ceil(f * inner_lo + c - 1e-6), 0, span).astype(int)
    hi = np.clip(np.floor(f * inner_hi + c + 1e-6), 0, span).astype(int)
    return new, (int(lo[0]), int(lo[1]), int(hi[0] - lo[0] + 1), int(hi[1] - lo[1] + 1))
