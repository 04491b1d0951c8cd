"""All that is pycolmap's and ours: cameras, poses, models in files, how it logs."""

from .cameras_and_poses import read_colmap_cameras, read_colmap_poses
from .rectified_model import write_colmap_model
from .workspace import write_colmap_workspace

__all__ = ["read_colmap_cameras", "read_colmap_poses", "write_colmap_model", "write_colmap_workspace"]
