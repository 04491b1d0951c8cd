"""Rectification: grids, photos and points, both ways."""

from .coarse import TOLERANCE_PX, CoarseGrid, coarse_grid
from .grid import MAP_KINDS, RemapGrid, remap_grid
from .maps import init_rectify_map
from .new_camera import ViewOptions, optimal_new_camera, rectified_roi, rectified_view
from .photo import INTERPOLATIONS, rectify
from .points import distort_points, largest_shift_px, undistort_points

__all__ = [
    "INTERPOLATIONS",
    "MAP_KINDS",
    "TOLERANCE_PX",
    "CoarseGrid",
    "RemapGrid",
    "ViewOptions",
    "coarse_grid",
    "distort_points",
    "init_rectify_map",
    "largest_shift_px",
    "optimal_new_camera",
    "rectified_roi",
    "rectified_view",
    "rectify",
    "remap_grid",
    "undistort_points",
]
