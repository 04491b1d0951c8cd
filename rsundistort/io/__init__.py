"""Files: photos, cameras, solutions, COLMAP models, nerfstudio."""

from .cameras import camera_from_exif, check_camera_fits, parse_camera
from .colmap import read_colmap_poses, write_colmap_model
from .images import MAX_MEGAPIXELS, RAW_AS, Photo, list_photos, output_name, read_photo, write_image
from .lengths import read_known_lengths
from .metadata import Metadata
from .motions import read_known_motions
from .nerfstudio import read_transforms, write_transforms
from .outputs import output_folder
from .solution import read_solution, write_solution

__all__ = [
    "MAX_MEGAPIXELS",
    "RAW_AS",
    "Metadata",
    "Photo",
    "camera_from_exif",
    "check_camera_fits",
    "list_photos",
    "output_folder",
    "output_name",
    "parse_camera",
    "read_colmap_poses",
    "read_known_lengths",
    "read_known_motions",
    "read_photo",
    "read_solution",
    "read_transforms",
    "write_colmap_model",
    "write_image",
    "write_solution",
    "write_transforms",
]
