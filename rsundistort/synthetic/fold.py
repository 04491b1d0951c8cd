"""Refuses motions so fast that the rows fold over: one direction, or one point, seen by two rows.

Plain NumPy and OpenCV, through the lens by differences: it shares nothing with the kernels.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..model.array_types import Array
from ..model.camera import Camera
from ..model.motion import RowMotion
from .lens import clock_at, distort_rays, undistort_to_rays

__all__ = ["check_no_fold"]

#: Pixels of the grid along each side; the speed is smooth, and largest at the border, which the grid holds. Along the
#: readout there are four for each interval of a bend, whose speed is a parabola.
_GRID = 33

#: Step of the difference, in units of the clock: its error is 1e-9, rounding makes 1e-11 of it.
_STEP = 1e-5

#: A pixel whose ray does not come back to it (pixels) lies beyond what the lens model can show.
_LENS_PX = 0.5


def check_no_fold(name: str, camera: Camera, motion: RowMotion, depth: ArrayLike | None = None) -> None:
    """Refuse a motion that lets two rows of a photo see the same thing.

    A point is seen when the clock reaches its row. Where its image runs along the readout as fast as the clock, the
    rows pile up on it; where it runs faster, two rows see it, and the photo has no inverse. The image of a direction at
    (c, r) runs, when the camera rotates, at

        top-to-bottom:  -phi1 (1 + r^2) + phi2 r c + phi3 c    (rows a row)
        left-to-right:   phi2 (1 + c^2) - phi1 r c - phi3 r    (columns a column)

    and at minus that where the readout is reversed. It must stay below 1. A bend adds its own rate to phi and velocity.

    Parameters
    ----------
    camera : Camera
        Its size, lens and readout.
    motion : RowMotion
        During the readout, its velocity and the positions of its bend in the camera frame at clock zero.
    depth : float or (h, w) array, optional
        z in the camera of the nearest thing, world units: of the whole photo or of each pixel, at the moment its row is
        read; inf where nothing is. Only infinity when left out. The speed is linear in 1/depth, so what holds at this
        depth and at infinity holds between them.

    Raises
    ------
    InputError
        Names the photo, and the pixel where the image runs fastest.
    """
    num = [_GRID, _GRID]
    if motion.bend is not None:
        num[camera.clock_axis] = max(_GRID, 4 * len(motion.bend.values) - 3)
    uv = np.stack(np.meshgrid(_stations(camera.width, num[0]), _stations(camera.height, num[1])), -1).reshape(-1, 2)
    speeds = [_line_speed(camera, uv, motion, np.zeros(len(uv)))]
    if depth is not None and motion.moves:
        near = _nearest(camera, uv, np.asarray(depth, np.float64))
        if not (near > 0).all():  # also NaN
            raise InputError(f"{name}: a depth of {np.min(near):g}; expected positive ones, in front of the camera")
        speeds.append(_line_speed(camera, uv, motion, 1 / near))
    speed = np.max(speeds, axis=0)
    if not np.isfinite(speed).any():
        raise InputError(f"{name}: the lens model shows nothing at any pixel of the photo")
    worst = int(np.nanargmax(speed))
    if speed[worst] >= 1:
        axis = camera.clock_axis
        line = ("column", "row")[axis]
        raise InputError(
            f"the {line}s of {name} fold over: at pixel ({uv[worst, 0]:.0f}, {uv[worst, 1]:.0f}) the image runs on by "
            f"{speed[worst]:.2f} {line}s while one is read, so that two of them see the same; give a slower motion"
        )


def _stations(length: int, num: int) -> Array:
    """Pixels along a side, whole numbers, with both ends."""
    return np.unique(np.round(np.linspace(0, length - 1, num)))


def _nearest(camera: Camera, uv: Array, depth: Array) -> Array:
    """Smallest depth within the cell of the grid around each of its pixels (n, 2)."""
    if depth.ndim == 0:
        return np.full(len(uv), float(depth))
    if depth.shape != (camera.height, camera.width):
        raise InputError(f"depth.shape={depth.shape}, expected a number or {(camera.height, camera.width)}")
    # NaN would be lost in the erosion
    known = np.where(np.isnan(depth), -1.0, depth)
    cell = np.ones([2 * (length // (_GRID - 1) // 2) + 3 for length in depth.shape], np.uint8)
    nearest = cv2.erode(known, cell, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(nearest[uv[:, 1].astype(int), uv[:, 0].astype(int)], np.float64)


def _line_speed(camera: Camera, uv: Array, motion: RowMotion, inverse_depth: Array) -> Array:
    """Lines (n,) by which the image of what pixels (n, 2) see runs on while one line is read; NaN beyond the lens."""
    K = camera.K
    axis, sign = camera.clock_axis, camera.clock_sign
    clock = clock_at(camera, uv[:, axis])
    norm = undistort_to_rays(uv, camera)
    known = np.asarray(np.isfinite(norm).all(axis=1))
    rays = np.column_stack([np.where(known[:, None], norm, 0.0), np.ones(len(uv))])
    rotated, gone = motion.at(clock)
    level = Rotation.from_rotvec(-rotated).apply(rays)
    # small against the distance of what comes towards the camera
    fastest = float(np.abs((motion.at(clock + _STEP)[1] - gone) * inverse_depth[:, None]).max()) / _STEP
    step = _STEP / max(1.0, fastest)

    def position(late: float) -> Array:
        """Pixels (n, 2) of what the rays see, `late` after its own moment."""
        # X(t) = Exp(theta(t)) (X(0) - way(t)), so the camera's way is rotated by all of the time gone
        rotation, way = motion.at(clock + late)
        return distort_rays(Rotation.from_rotvec(rotation).apply(level - (way - gone) * inverse_depth[:, None]), camera)

    known &= np.linalg.norm(position(0.0) - uv, axis=1) < _LENS_PX
    moved_px = (position(step) - position(-step))[:, axis]
    return np.where(known, sign * moved_px / K[axis, axis] / (2 * step), np.nan)
