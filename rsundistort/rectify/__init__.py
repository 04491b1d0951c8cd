"""Rectification: grids, photos and points, both ways."""

from .maps import init_rectify_map
from .new_camera import optimal_new_camera
from .photo import INTERPOLATIONS, rectify
from .points import distort_points, largest_shift_px, translation_shift_px, undistort_points
from .sparse import depth_from_points, fit_plane, plane_in_camera, prefers_plane

__all__ = [
    "INTERPOLATIONS",
    "depth_from_points",
    "distort_points",
    "fit_plane",
    "init_rectify_map",
    "largest_shift_px",
    "optimal_new_camera",
    "plane_in_camera",
    "prefers_plane",
    "rectify",
    "translation_shift_px",
    "undistort_points",
]
