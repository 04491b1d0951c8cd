"""Folders of photos with a known truth: rendered, or warped from real ones."""

from .render_folder import SceneOptions, simulate_scene
from .warp_folder import WarpOptions, read_motion_file, simulate_warp

__all__ = ["SceneOptions", "WarpOptions", "read_motion_file", "simulate_scene", "simulate_warp"]
