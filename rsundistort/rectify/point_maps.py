"""Points both ways between raw and rectified photos, in the manner of `cv2`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from .._kernels.depth import EDGE
from ..errors import InputError
from ..model import AtInfinity, Camera, Depth, DepthMap, Plane, RowMotion
from ..model.array_types import Array
from ..model.checks import check_array, check_finite, check_numbers
from ..model.depth import check_depth
from ..model.projection import clock_of, motion_of, project_points, unproject_points
from .maps import check_rectified, rectified_rays
from .pixel_depths import inverse_depth_at

__all__ = ["bend_px", "distort_points", "largest_shift_px", "undistort_points"]

# A line through a depth map is followed in steps of half a pixel; bisection ends at rounding.
_STEPS_PER_PX = 2
_BISECTIONS = 50


def _homogeneous(xy: Array) -> Array:
    """(n, 3) points of z = 1; those that are no numbers become NaN, since infinity times zero is none."""
    xy = np.where(np.isfinite(xy).all(1, keepdims=True), xy, np.nan)
    return np.column_stack([xy, np.ones(len(xy))])


def _inverse_depths(depth: Depth | Array, xy: Array, rays: Array) -> Array:
    """(n,) inverse depths of rectified pixels (n, 2)."""
    return 1.0 / depth if isinstance(depth, np.ndarray) else inverse_depth_at(depth, xy, rays)


def _checked(
    points: ArrayLike,
    camera: Camera,
    motion: RowMotion | None,
    R: ArrayLike | None,
    P: ArrayLike | None,
    depth: Depth | ArrayLike | None,
) -> tuple[Array, tuple[int, ...], RowMotion, Array, Depth | Array]:
    """Arguments of both directions: points (n, 2), their shape, the motion, rays of `rectified_rays`, and the depth."""
    xy = check_numbers(points, "points")
    if xy.ndim not in (2, 3) or xy.shape[-1] != 2 or (xy.ndim == 3 and 1 not in xy.shape[:2]):
        raise InputError(f"points.shape={xy.shape}, expected (N, 2), (N, 1, 2) or (1, N, 2)")
    flat = xy.reshape(-1, 2)
    if depth is None:
        depth = AtInfinity()
    elif not isinstance(depth, AtInfinity | Plane | DepthMap):
        depth = check_array(depth, (len(flat),), "depth")
        if not (depth > 0).all():
            raise InputError("depth holds a number that is not positive; inf is far")
    if isinstance(depth, DepthMap) and P is None:
        raise InputError("a depth map has the pixels of the rectified photo: P is needed")
    K = np.eye(3) if P is None else check_finite(P, (3, None), "P")
    rays = rectified_rays(K[:, :3] if K.shape[1] == 4 else K, R, camera, "P")
    return flat, xy.shape, motion_of(camera, motion), rays, depth


def _rectified(
    xy: Array, camera: Camera, motion: RowMotion, shutter_model: str, rays: Array, depth: Depth | Array
) -> Array:
    """Rectified pixels (n, 2) of raw pixels; rays (3, 3) as of `rectified_rays`."""
    ideal, _ = unproject_points(xy, camera, motion, shutter_model)
    q = _homogeneous(ideal) @ np.linalg.inv(rays).T
    with np.errstate(invalid="ignore"):
        q[~(q[:, 2] > 0)] = np.nan
    xy_rect = q[:, :2] / q[:, 2:]
    if shutter_model != "constant-motion" or not motion.moves or isinstance(depth, AtInfinity):
        return xy_rect
    # Where the camera had got to when it read the row, in homogeneous pixels; what the raw pixel shows lies on the line
    # from there, which starts at infinity where the rotation alone takes the pixel.
    moved = np.linalg.solve(rays, motion.as_in("camera").at(clock_of(camera, xy))[1].T).T

    def on_line(inverse: Array) -> Array:
        w = inverse[:, None]
        return xy_rect * (1 - w * moved[:, 2:]) + w * moved[:, :2]

    if isinstance(depth, Plane):
        # the point moved + s q of the plane has the depth moved_z + s
        normal = depth.normal @ rays / depth.distance
        along, start = _homogeneous(xy_rect) @ normal, moved @ normal
        return on_line(np.where(along > 0, along / (1 - start + along * moved[:, 2]), 0.0))
    if isinstance(depth, DepthMap):
        longest = np.nanmax(np.hypot(*(moved[:, :2] - moved[:, 2:] * xy_rect).T), initial=0.0) * depth.inverse.max()
        return on_line(_first_hit(depth, on_line, len(xy), int(_STEPS_PER_PX * longest) + 1))
    return on_line(_inverse_depths(depth, xy, rays))


def _first_hit(depth: DepthMap, on_line: Callable[[Array], Array], num: int, steps: int) -> Array:
    """Inverse depths (n,) where lines that come from the camera first meet a depth map: a march, then bisection.

    A line may pass behind the edge of a thing; it meets it there only if it does not come out again.
    """

    def field(w: Array) -> Array:
        return inverse_depth_at(depth, on_line(w), np.eye(3))

    marks = np.linspace(float(depth.inverse.max()), 0.0, steps + 1)
    rise_of_edge = EDGE * marks[0] / steps
    surface = field(np.full(num, marks[0]))
    behind = surface >= marks[0]
    # brackets of the first place that counts, and whether that is a surface
    near, far, met = np.full(num, marks[0]), np.full(num, marks[0]), behind.copy()
    for last, mark in pairwise(marks):
        before, surface = surface, field(np.full(num, mark))
        now = surface >= mark
        enters = now & ~behind & ~met
        near[enters], far[enters] = last, mark
        met |= enters & (surface - before <= rise_of_edge)
        behind = now
    for _ in range(_BISECTIONS):
        w = 0.5 * (near + far)
        now = field(w) >= w
        far, near = np.where(now, w, far), np.where(now, near, w)
    return far


def undistort_points(
    points: ArrayLike,
    camera: Camera,
    motion: RowMotion | None = None,
    shutter_model: str = "rotation",
    R: ArrayLike | None = None,
    P: ArrayLike | None = None,
    depth: Depth | ArrayLike | None = None,
) -> Array:
    """Where raw pixels lie without lens and shutter, in the manner of `cv2.undistortPoints`.

    Parameters
    ----------
    points : (n, 2), (n, 1, 2) or (1, n, 2) array
        Pixels of the raw photo, integer centres.
    camera, motion, shutter_model
        As in `init_rectify_map`.
    R : (3, 3) array, optional
        Rotation from the camera frame to the rectified one.
    P : (3, 3) or (3, 4) array, optional
        Pinhole matrix of the rectified photo; a fourth column is ignored, as by `cv2`. Without it the result is in
        normalised coordinates.
    depth : AtInfinity, Plane, DepthMap or (n,) array, optional
        How far the points are, which constant-motion needs: as in `init_rectify_map` (a map needs P, of which it has
        the pixels), or each point's z in the rectified frame at the reference row. At infinity when left out.

    Returns
    -------
    array of the shape of `points`
        NaN where the lens or the shutter model has no inverse. Where the rectified photo hides what a raw pixel shows,
        the edge of what hides it.
    """
    xy, shape, motion, rays, depth = _checked(points, camera, motion, R, P, depth)
    return _rectified(xy, camera, motion, shutter_model, rays, depth).reshape(shape)


def distort_points(
    points: ArrayLike,
    camera: Camera,
    motion: RowMotion | None = None,
    shutter_model: str = "rotation",
    R: ArrayLike | None = None,
    P: ArrayLike | None = None,
    depth: Depth | ArrayLike | None = None,
) -> Array:
    """Raw pixels that show points of the rectified photo: the inverse of `undistort_points`.

    Parameters
    ----------
    points : (n, 2), (n, 1, 2) or (1, n, 2) array
        Pixels of the rectified photo if `P` is given, else normalised coordinates.
    camera, motion, shutter_model, R, P, depth
        As in `undistort_points`.

    Returns
    -------
    array of the shape of `points`
        Pixels of the raw photo; NaN where none shows the point.
    """
    xy, shape, motion, rays, depth = _checked(points, camera, motion, R, P, depth)
    points_c = _homogeneous(xy) @ rays.T
    if shutter_model != "constant-motion":
        return project_points(points_c, camera, motion, shutter_model)[0].reshape(shape)
    inverse = _inverse_depths(depth, xy, rays)
    raw, _ = project_points(points_c, camera, motion, "rotation")
    near = inverse > 0
    raw[near], _ = project_points(points_c[near] / inverse[near, None], camera, motion, shutter_model)
    return raw.reshape(shape)


def largest_shift_px(
    camera: Camera,
    motion: RowMotion,
    shutter_model: str = "rotation",
    depth: Depth | None = None,
    new_camera: Camera | None = None,
) -> float:
    """Largest displacement in pixels that the shutter causes anywhere in a photo.

    It is looked for on a grid of 33 x 33 raw pixels that holds the border and the corners; with a depth, on one of 97 x
    65 pixels of the rectified photo (`new_camera`, else of the camera's own size and K).
    """
    motion = motion_of(camera, motion)
    if new_camera is not None:
        check_rectified(new_camera)
    check_depth(depth)
    if depth is None or isinstance(depth, AtInfinity) or shutter_model != "constant-motion":
        u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33))
        raw = np.column_stack([u.ravel(), v.ravel()])
        ideal, valid = unproject_points(raw, camera, motion, shutter_model)
        still, seen = project_points(_homogeneous(ideal)[valid], camera, None, "global")
        shift = np.linalg.norm(still - raw[valid], axis=1)[seen]
        return float(check_finite(shift, (None,), "shift").max(initial=0.0))
    xy, K = _rectified_grid(camera, new_camera)
    raw = distort_points(xy, camera, motion, shutter_model, P=K, depth=depth)
    return _largest(camera, raw, distort_points(xy, camera, P=K))


def bend_px(camera: Camera, motion: RowMotion, depth: float = np.inf) -> float:
    """Largest displacement in pixels by which a photo departs from one that the nearest steady motion would have taken.

    What is left where a motion is described by two poses, or by one rate; 0 where it is steady.

    Parameters
    ----------
    camera, motion
        As in `init_rectify_map`, the motion in the camera frame.
    depth : float
        Of what is shown, in the units of the velocity; at infinity travel moves nothing.
    """
    if motion.bend is None:
        return 0.0
    near, rotation, way = motion.steady(*camera.clock_range)
    # along the readout four for each reading of the bend
    num = [33, 33]
    num[camera.clock_axis] = max(33, 4 * len(motion.bend.values))
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, num[0]), np.linspace(0, camera.height - 1, num[1]))
    raw = np.column_stack([u.ravel(), v.ravel()])
    ideal, valid = unproject_points(raw, camera, motion)
    points = _homogeneous(ideal)[valid]
    model = "constant-motion" if np.isfinite(depth) else "rotation"
    if np.isfinite(depth):
        points = depth * points + motion.as_in("camera").at(clock_of(camera, raw[valid]))[1] - way
    # the camera of the bent motion is the world here
    near = replace(near, frame="world").in_camera(rotation)
    moved, seen = project_points(points @ rotation.T, camera, near, model)
    return float(np.linalg.norm(moved - raw[valid], axis=1)[seen].max(initial=0.0))


def translation_shift_px(camera: Camera, motion: RowMotion, depth: Depth, new_camera: Camera | None = None) -> float:
    """Largest displacement in pixels that the translation causes in a photo, against what is at infinity.

    Parameters
    ----------
    camera, motion, depth
        As in `init_rectify_map`, of the constant-motion model.
    new_camera : Camera, optional
        Of the rectified photo.
    """
    xy, K = _rectified_grid(camera, new_camera)
    at_depth, far = (distort_points(xy, camera, motion, "constant-motion", P=K, depth=d) for d in (depth, None))
    return _largest(camera, at_depth, far)


def _rectified_grid(camera: Camera, new_camera: Camera | None) -> tuple[Array, Array]:
    """Pixels (n, 2) over a rectified photo, its border among them, and its K."""
    new = camera.pinhole() if new_camera is None else check_rectified(new_camera)
    u, v = np.meshgrid(np.linspace(0, new.width - 1, 97), np.linspace(0, new.height - 1, 65))
    return np.column_stack([u.ravel(), v.ravel()]), new.K


def _largest(camera: Camera, raw: Array, other: Array) -> float:
    """Largest distance of raw pixels (n, 2) from others, of those that lie in the photo."""
    with np.errstate(invalid="ignore"):
        inside = ((raw >= 0) & (raw <= [camera.width - 1, camera.height - 1])).all(1)
    shift = np.linalg.norm(raw - other, axis=1)[inside]
    return float(shift[np.isfinite(shift)].max(initial=0.0))
