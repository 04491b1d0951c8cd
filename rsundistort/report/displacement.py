"""The displacement of a photo's pixels by the shutter."""

from __future__ import annotations

import numpy as np

from ..model import Camera, Solution, SolvedImage
from ..model.array_types import Array
from ..rectify import distort_points, undistort_points

__all__ = ["displacement_field"]


def displacement_field(
    solution: Solution, image: SolvedImage, depth: float | None = None, across: int = 12
) -> tuple[Array, Array]:
    """Where a photo shows things, and where a global shutter would have shown them.

    Parameters
    ----------
    image : SolvedImage
        A registered photo.
    depth : float, optional
        How far away what it shows is, which the constant-motion model needs; at infinity when left out.
    across : int
        Arrows over the longer side.

    Returns
    -------
    raw, still : (n, 2) arrays
        Raw pixels with the lens's distortion in both; `still` lies on a grid.
    """
    camera = solution.cameras[image.camera_id]
    still = _grid(camera, across)
    motion = image.taken_out
    if motion is None:
        return still, still
    motion = motion if image.R_cw is None else motion.in_camera(image.R_cw)
    rays = undistort_points(still, camera, None, "global")
    seen = np.isfinite(rays).all(1)
    still, rays = still[seen], rays[seen]
    at = None
    if solution.shutter_model == "constant-motion" and depth is not None and np.isfinite(depth) and depth > 0:
        at = np.full(len(rays), depth)
    raw = distort_points(rays, camera, motion, solution.shutter_model, depth=at)
    with np.errstate(invalid="ignore"):
        seen = ((raw >= -0.5) & (raw <= [camera.width - 0.5, camera.height - 0.5])).all(1)
    return raw[seen], still[seen]


def _grid(camera: Camera, across: int) -> Array:
    """Middles of square cells over the photo."""
    step = max(camera.width, camera.height) / across
    u, v = (np.arange(step / 2, size, step) for size in (camera.width, camera.height))
    x, y = np.meshgrid(u + (camera.width - u[-1] - u[0]) / 2, v + (camera.height - v[-1] - v[0]) / 2)
    return np.column_stack([x.ravel(), y.ravel()])
