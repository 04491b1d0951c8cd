"""Files: photos, cameras, solutions, COLMAP models, nerfstudio."""

from ..colmap import read_colmap_cameras, read_colmap_poses, write_colmap_model, write_colmap_workspace
from .cameras import CameraFile, check_camera_fits, read_camera_file
from .depth_maps import find_depth_maps, read_depth_map
from .gpmf import has_telemetry, read_gpmf
from .groups import group_of, groups_of, guess_readouts
from .gyro import GyroLog, bends_from_gyro, gyro_offset, motions_from_gyro, read_gyro, read_photo_times
from .masks import find_masks, read_mask
from .motions import read_known_motions
from .nerfstudio import read_transforms, write_transforms
from .outputs import output_folder
from .photos.exif_facts import ExifFacts, camera_from_exif, facts_of_exif, focal_from_exif, read_exif
from .photos.gps import GpsFix
from .photos.images import MAX_MEGAPIXELS, RAW_AS, Photo, list_photos, output_name, read_photo, write_image
from .photos.metadata import Metadata
from .readout_times import readout_time
from .shutter_poses import write_shutter_poses
from .solution_json import read_solution, write_solution
from .surveyed import read_control_points, read_known_lengths
from .trajectory import write_path, write_point_cloud, write_trajectory
from .video import VideoFrames, extract_frames, is_video

__all__ = [
    "MAX_MEGAPIXELS",
    "RAW_AS",
    "CameraFile",
    "ExifFacts",
    "GpsFix",
    "GyroLog",
    "Metadata",
    "Photo",
    "VideoFrames",
    "bends_from_gyro",
    "camera_from_exif",
    "check_camera_fits",
    "extract_frames",
    "facts_of_exif",
    "find_depth_maps",
    "find_masks",
    "focal_from_exif",
    "group_of",
    "groups_of",
    "guess_readouts",
    "gyro_offset",
    "has_telemetry",
    "is_video",
    "list_photos",
    "motions_from_gyro",
    "output_folder",
    "output_name",
    "read_camera_file",
    "read_colmap_cameras",
    "read_colmap_poses",
    "read_control_points",
    "read_depth_map",
    "read_exif",
    "read_gpmf",
    "read_gyro",
    "read_known_lengths",
    "read_known_motions",
    "read_mask",
    "read_photo",
    "read_photo_times",
    "read_solution",
    "read_transforms",
    "readout_time",
    "write_colmap_model",
    "write_colmap_workspace",
    "write_image",
    "write_path",
    "write_point_cloud",
    "write_shutter_poses",
    "write_solution",
    "write_trajectory",
    "write_transforms",
]
