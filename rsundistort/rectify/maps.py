"""Grids: for each pixel of the new pinhole photo, which raw pixel saw it. Lens and shutter in one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .._kernels import maps as kernels
from ..errors import InputError
from ..model import AtInfinity, Camera, Depth, RowMotion, check_shutter_model
from ..model.array_types import Array
from ..model.checks import check_finite, check_kind, check_rotation, check_size
from ..model.depth import check_depth
from ..model.field import add_field
from ..model.projection import motion_of
from .pixel_depths import DepthRows

__all__ = ["check_rectified", "fill_rows", "init_rectify_map", "rectified_rays", "seen_by"]

#: A raw position this far (pixels) beyond the outermost pixel centre still counts as seen: rounding of float32 maps.
EDGE_PX = 1e-3


def rectified_rays(new_K: ArrayLike | None, R: ArrayLike | None, camera: Camera, name: str = "new_K") -> Array:
    """(3, 3) matrix from rectified pixels (u, v, 1) to directions in the camera frame."""
    K = camera.K if new_K is None else check_finite(new_K, (3, 3), name)
    rotation = np.eye(3) if R is None else check_rotation(R, "R")
    scaled = K / max(np.abs(K).max(), 1e-300)
    if abs(np.linalg.det(scaled)) < 1e-18:
        raise InputError(f"{name} is singular")
    return rotation.T @ np.linalg.inv(K)


def check_rectified(new_camera: Camera) -> Camera:
    """The camera of a rectified photo; refused if it is none, or has a lens."""
    check_kind(new_camera, Camera, "new_camera")
    if not new_camera.is_pinhole:
        raise InputError("new_camera has lens distortion; a rectified photo has none")
    return new_camera


def fill_rows(
    camera: Camera,
    motion: RowMotion,
    shutter_model: str,
    rays: Array,
    row0: int,
    map_x: NDArray[np.float32],
    map_y: NDArray[np.float32],
    depth: DepthRows | None = None,
) -> None:
    """Fill the rows `row0 ...` of a grid; where no raw pixel answers, the grid points far outside."""
    intr, lens, axis, sign = camera.kernel_args
    model = check_shutter_model(shutter_model)
    if depth is not None and depth.matters(shutter_model):
        inverse = depth.inverse(row0, map_x.shape)
        kernels.fill_map_at_depth(
            axis, sign, intr, lens, motion.kernel_phi, motion.velocity_in_camera, rays, inverse, row0, map_x, map_y
        )
        depth.mark_hidden(row0, map_x, map_y)
    else:
        kernels.fill_map(model, axis, sign, intr, lens, motion.kernel_phi, rays, row0, map_x, map_y)
    add_field(camera, map_x, map_y)


def seen_by(map_x: NDArray[np.float32], map_y: NDArray[np.float32], width: int, height: int) -> NDArray[np.uint8]:
    """255 where a map points into a photo of width x height pixels, else 0."""
    seen = cv2.inRange(map_x, -EDGE_PX, width - 1 + EDGE_PX)
    return np.asarray(cv2.bitwise_and(seen, cv2.inRange(map_y, -EDGE_PX, height - 1 + EDGE_PX)))


def init_rectify_map(
    camera: Camera,
    motion: RowMotion | None = None,
    shutter_model: str = "rotation",
    R: ArrayLike | None = None,
    new_K: ArrayLike | None = None,
    size: tuple[int, int] | None = None,
    m1type: int = cv2.CV_32FC1,
    depth: Depth | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Maps for `cv2.remap` that take lens and shutter out of a photo, in the manner of `cv2.initUndistortRectifyMap`.

    A fisheye's photo becomes a pinhole's like any other; `R` rotates the view towards what lies far from the axis.

    Parameters
    ----------
    camera : Camera
        Of the raw photo.
    motion : RowMotion, optional
        During the readout, its velocity in the camera frame (`RowMotion.in_camera`); without it the result is
        `cv2.initUndistortRectifyMap`'s, or that of the same name in `cv2.fisheye`.
    shutter_model : {"rotation", "constant-motion", "two-step", "linearized", "global"}
        Row model; only constant-motion uses the velocity.
    R : (3, 3) array, optional
        Rotation from the camera frame to the rectified one.
    new_K : (3, 3) array, optional
        Pinhole matrix of the rectified photo; the camera's own when left out.
    size : (width, height), optional
        Size of the rectified photo; the camera's own when left out.
    m1type : {cv2.CV_32FC1, cv2.CV_32FC2, cv2.CV_16SC2}
        Kind of the maps.
    depth : AtInfinity, Plane or DepthMap, optional
        Depth of the scene, on which the effect of the velocity depends; at infinity when left out.

    Returns
    -------
    map1, map2 : arrays
        Raw pixel of each rectified pixel: x and y (CV_32FC1), xy and None (CV_32FC2), or OpenCV's fixed point
        (CV_16SC2). Where no raw pixel answers, or something nearer hid what it should show when its row was read, they
        point far outside of every photo.

    Examples
    --------
    >>> camera = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> map_x, map_y = init_rectify_map(camera, RowMotion([0.1, 0.0, 0.0]))
    >>> map_x.shape, round(float(map_y[340, 320]), 3)
    ((480, 640), 330.61)
    """
    motion = motion_of(camera, motion)
    check_depth(depth)
    width, height = check_size((camera.width, camera.height) if size is None else size)
    map_x = np.empty((height, width), np.float32)
    map_y = np.empty((height, width), np.float32)
    rays = rectified_rays(new_K, R, camera)
    rows = DepthRows(depth or AtInfinity(), camera, motion, rays, (width, height))
    fill_rows(camera, motion, shutter_model, rays, 0, map_x, map_y, rows)
    if m1type == cv2.CV_32FC1:
        return map_x, map_y
    if m1type == cv2.CV_32FC2:
        return np.dstack([map_x, map_y]), None
    if m1type == cv2.CV_16SC2:
        fixed: tuple[NDArray[np.float32], NDArray[np.float32]] = cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)
        return fixed
    raise InputError(f"m1type={m1type}, expected cv2.CV_32FC1, cv2.CV_32FC2 or cv2.CV_16SC2")
