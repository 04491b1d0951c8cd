"""The row models as functions of arrays: camera-frame points to pixels, and pixels to ideal directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .._kernels import projection as kernels
from .array_types import Array, Mask
from .camera import Camera
from .checks import check_array, check_kind
from .field import field_slope, lens_pixels, raw_pixels
from .motion import RowMotion, check_shutter_model

__all__ = [
    "ProjectionJacobians",
    "at_depth",
    "clock_of",
    "motion_of",
    "project_points",
    "project_points_with_jacobians",
    "unproject_points",
]


@dataclass(frozen=True)
class ProjectionJacobians:
    """Derivatives of pixels (n, 2, 3), lengths and radians per unit of the clock.

    In the camera-frame point, in phi, and in the camera-frame velocity (zero for models without translation).
    """

    point: Array
    phi: Array
    velocity: Array


def motion_of(camera: Camera, motion: RowMotion | None) -> RowMotion:
    """The motion, or none where it was left out; refused where one of both is something else."""
    check_kind(camera, Camera, "camera")
    if motion is None:
        return RowMotion()
    check_kind(motion, RowMotion, "motion")
    return motion


def project_points(
    points_c: ArrayLike, camera: Camera, motion: RowMotion | None = None, shutter_model: str = "rotation"
) -> tuple[Array, Mask]:
    """Pixels where a rolling-shutter photo shows points of the camera frame.

    Parameters
    ----------
    points_c : (n, 3) array
        Points in the camera frame at the reference row, x right, y down, z ahead; any unit of length.
    camera : Camera
        Intrinsics, lens and readout direction.
    motion : RowMotion, optional
        Motion during the readout, its velocity in the camera frame too; none when left out.
    shutter_model : {"global", "two-step", "linearized", "rotation", "constant-motion"}
        Row model: paper Eqs. 8-9, Eq. 5, Eq. 2 without translation, or Eq. 2 whole, which alone heeds the velocity.

    Returns
    -------
    xy_raw : (n, 2) array
        Pixels, integer centres; NaN where invalid.
    valid : (n,) bool array
        False for points not ahead of the camera (also of a fisheye: 90 degrees and more from the axis), beyond the fold
        of the lens model, or seen by no single row.

    Examples
    --------
    >>> camera = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> project_points([[0.0, 0.5, 5.0]], camera, RowMotion([0.1, 0, 0]))[0].round(3)
    array([[320.   , 285.417]])
    """
    points = np.ascontiguousarray(check_array(points_c, (None, 3), "points_c"))
    motion = motion_of(camera, motion)
    intr, lens, axis, sign = camera.kernel_args
    xy, valid = np.empty((len(points), 2)), np.empty(len(points), bool)
    model = check_shutter_model(shutter_model)
    velocity = _velocity(motion, shutter_model)
    kernels.project_points(model, axis, sign, intr, lens, points, motion.kernel_phi, velocity, xy, valid)
    return (raw_pixels(camera, xy) if camera.field.size else xy), valid


def project_points_with_jacobians(
    points_c: ArrayLike, camera: Camera, motion: RowMotion | None = None, shutter_model: str = "rotation"
) -> tuple[Array, Mask, ProjectionJacobians]:
    """As `project_points`, with the exact derivatives of the pixels (the implicit row's included)."""
    points = np.ascontiguousarray(check_array(points_c, (None, 3), "points_c"))
    motion = motion_of(camera, motion)
    intr, lens, axis, sign = camera.kernel_args
    n = len(points)
    xy, valid = np.empty((n, 2)), np.empty(n, bool)
    J_point, J_phi, J_velocity = (np.empty((n, 2, 3)) for _ in range(3))
    model = check_shutter_model(shutter_model)
    velocity = _velocity(motion, shutter_model)
    kernels.project_jacobians(
        model, axis, sign, intr, lens, points, motion.kernel_phi, velocity, xy, J_point, J_phi, J_velocity, valid
    )
    if camera.field.size:
        xy = raw_pixels(camera, xy)
        by_lens = np.eye(2) - field_slope(camera, np.where(valid[:, None], xy, 0.0))
        for J in (J_point, J_phi, J_velocity):
            J[:] = np.linalg.solve(by_lens, J)
    return xy, valid, ProjectionJacobians(J_point, J_phi, J_velocity)


def _velocity(motion: RowMotion, shutter_model: str) -> Array:
    """In the camera's frame; models that know no velocity take any."""
    return motion.velocity_in_camera if shutter_model == "constant-motion" else motion.velocity.copy()


def clock_of(camera: Camera, xy_raw: Array) -> Array:
    """(n,) clock r at which a camera read raw pixels (n, 2); 0 at the line of the principal point."""
    intr, _, axis, sign = camera.kernel_args
    return np.asarray(sign * (lens_pixels(camera, xy_raw)[:, axis] - intr[2 + axis]) / intr[axis])


def at_depth(ideal: Array, xy_raw: Array, camera: Camera, motion: RowMotion, depth: Array) -> Array:
    """Ideal coordinates (n, 2) under the constant-motion model, of those that `unproject_points` found at infinity.

    Parameters
    ----------
    ideal, xy_raw : (n, 2) array
        Normalised coordinates at infinity, and the pixels that they are of.
    camera, motion
        As in `project_points`.
    depth : (n,) array
        z of the points at the reference row.
    """
    # when its row was read, the camera stood at p(r) and saw the point p(r) + s (x', y', 1)
    moved = motion.as_in("camera").at(clock_of(camera, xy_raw))[1] / depth[:, None]
    return np.asarray(ideal * (1.0 - moved[:, 2:]) + moved[:, :2])


def unproject_points(
    xy_raw: ArrayLike, camera: Camera, motion: RowMotion | None = None, shutter_model: str = "rotation"
) -> tuple[Array, Mask]:
    """Ideal normalised coordinates (x', y') at the reference row of pixels of a rolling-shutter photo.

    Parameters
    ----------
    xy_raw : (n, 2) array
        Pixels, integer centres.
    camera, motion, shutter_model
        As in `project_points`, of which this is the inverse.

    Returns
    -------
    xy_norm : (n, 2) array
        Global-shutter, lens-free coordinates x/z, y/z; NaN where invalid.
    valid : (n,) bool array
        False beyond the fold of the lens model, for pixels of a fisheye 90 degrees or more from the axis, and where the
        row model has no inverse.
    """
    motion = motion_of(camera, motion)
    xy = lens_pixels(camera, np.ascontiguousarray(check_array(xy_raw, (None, 2), "xy_raw")))
    intr, lens, axis, sign = camera.kernel_args
    ideal, valid = np.empty_like(xy), np.empty(len(xy), bool)
    kernels.unproject_points(
        check_shutter_model(shutter_model), axis, sign, intr, lens, xy, motion.kernel_phi, ideal, valid
    )
    return ideal, valid
