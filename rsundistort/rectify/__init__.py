"""Rectification: grids, photos and points, both ways."""

from .grid import MAP_KINDS, RemapGrid
from .maps import init_rectify_map
from .new_camera import ViewOptions, optimal_new_camera, rectified_roi, rectified_view, steadiest_pinhole
from .photo import INTERPOLATIONS, rectify
from .point_depths import depth_from_points, fit_plane, plane_in_camera, prefers_plane
from .point_maps import bend_px, distort_points, largest_shift_px, translation_shift_px, undistort_points

__all__ = [
    "INTERPOLATIONS",
    "MAP_KINDS",
    "RemapGrid",
    "ViewOptions",
    "bend_px",
    "depth_from_points",
    "distort_points",
    "fit_plane",
    "init_rectify_map",
    "largest_shift_px",
    "optimal_new_camera",
    "plane_in_camera",
    "prefers_plane",
    "rectified_roi",
    "rectified_view",
    "rectify",
    "steadiest_pinhole",
    "translation_shift_px",
    "undistort_points",
]
