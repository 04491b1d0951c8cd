"""Points both ways between raw and rectified photos, in the manner of `cv2`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..model import Camera, RowMotion
from ..model.checks import check_finite
from ..model.projection import project_points, unproject_points
from .maps import rectified_rays

__all__ = ["distort_points", "largest_shift_px", "undistort_points"]


def _as_list(points: ArrayLike, name: str) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """Points (n, 2) of any of cv2's shapes: (n, 2), (n, 1, 2), (1, n, 2)."""
    array = np.asarray(points, np.float64)
    if array.ndim not in (2, 3) or array.shape[-1] != 2 or (array.ndim == 3 and 1 not in array.shape[:2]):
        raise InputError(f"{name}.shape={array.shape}, expected (N, 2), (N, 1, 2) or (1, N, 2)")
    return array.reshape(-1, 2), array.shape


def undistort_points(
    points: ArrayLike,
    camera: Camera,
    motion: RowMotion | None = None,
    shutter_model: str = "rotation",
    R: ArrayLike | None = None,
    P: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Where raw pixels lie without lens and shutter, in the manner of `cv2.undistortPoints`.

    Parameters
    ----------
    points : (n, 2), (n, 1, 2) or (1, n, 2) array
        Pixels of the raw photo, integer centres.
    camera, motion, shutter_model
        As in `init_rectify_map`.
    R : (3, 3) array, optional
        Rotation from the camera frame to the rectified one.
    P : (3, 3) array, optional
        Pinhole matrix of the rectified photo. Without it the result is in normalised coordinates.

    Returns
    -------
    array of the shape of `points`
        NaN where the lens or the shutter model has no inverse.
    """
    xy, shape = _as_list(points, "points")
    ideal, _ = unproject_points(xy, camera, motion, shutter_model)
    to_rectified = np.linalg.inv(rectified_rays(np.eye(3) if P is None else P, R, camera))
    q = np.column_stack([ideal, np.ones(len(ideal))]) @ to_rectified.T
    with np.errstate(invalid="ignore"):
        q[~(q[:, 2] > 0)] = np.nan
    return (q[:, :2] / q[:, 2:]).reshape(shape)


def distort_points(
    points: ArrayLike,
    camera: Camera,
    motion: RowMotion | None = None,
    shutter_model: str = "rotation",
    R: ArrayLike | None = None,
    P: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Raw pixels that show points of the rectified photo: the inverse of `undistort_points`.

    Parameters
    ----------
    points : (n, 2), (n, 1, 2) or (1, n, 2) array
        Pixels of the rectified photo if `P` is given, else normalised coordinates.
    camera, motion, shutter_model, R, P
        As in `undistort_points`.

    Returns
    -------
    array of the shape of `points`
        Pixels of the raw photo; NaN where none shows the point.
    """
    xy, shape = _as_list(points, "points")
    rays = rectified_rays(np.eye(3) if P is None else P, R, camera)
    raw, _ = project_points(np.column_stack([xy, np.ones(len(xy))]) @ rays.T, camera, motion, shutter_model)
    return raw.reshape(shape)


def largest_shift_px(camera: Camera, motion: RowMotion, shutter_model: str = "rotation") -> float:
    """Largest displacement in pixels that the shutter causes anywhere in a photo.

    It is looked for on a grid of 33 x 33 raw pixels that holds the border and the corners.
    """
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33))
    raw = np.column_stack([u.ravel(), v.ravel()])
    ideal, valid = unproject_points(raw, camera, motion, shutter_model)
    still, seen = project_points(np.column_stack([ideal, np.ones(len(ideal))])[valid], camera, None, "global")
    shift = np.linalg.norm(still - raw[valid], axis=1)[seen]
    return float(check_finite(shift, (None,), "shift").max(initial=0.0))
