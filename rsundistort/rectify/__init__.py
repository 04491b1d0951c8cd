"""Rectification: grids, photos and points, both ways."""

from .maps import init_rectify_map
from .new_camera import optimal_new_camera
from .photo import INTERPOLATIONS, rectify
from .points import distort_points, largest_shift_px, undistort_points

__all__ = [
    "INTERPOLATIONS",
    "distort_points",
    "init_rectify_map",
    "largest_shift_px",
    "optimal_new_camera",
    "rectify",
    "undistort_points",
]
