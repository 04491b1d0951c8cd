"""Files: photos, cameras, solutions, COLMAP models, nerfstudio."""

from .cameras import camera_from_exif, check_camera_fits, parse_camera
from .colmap import read_colmap_poses, write_colmap_model
from .gyro import GyroLog, gyro_offset, motions_from_gyro, read_gyro, read_photo_times
from .images import Photo, list_photos, output_name, read_photo, write_image
from .lengths import read_known_lengths
from .motions import read_known_motions
from .nerfstudio import read_transforms, write_transforms
from .outputs import output_folder
from .readout_times import readout_time
from .solution import read_solution, write_solution
from .video import VideoFrames, extract_frames, is_video

__all__ = [
    "GyroLog",
    "Photo",
    "VideoFrames",
    "camera_from_exif",
    "check_camera_fits",
    "extract_frames",
    "gyro_offset",
    "is_video",
    "list_photos",
    "motions_from_gyro",
    "output_folder",
    "output_name",
    "parse_camera",
    "read_colmap_poses",
    "read_gyro",
    "read_known_lengths",
    "read_known_motions",
    "read_photo",
    "read_photo_times",
    "read_solution",
    "read_transforms",
    "readout_time",
    "write_colmap_model",
    "write_image",
    "write_solution",
    "write_transforms",
]
