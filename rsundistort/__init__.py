"""Rolling-shutter structure from motion: photos in, rectified photos and camera poses out.

After E. Ito and T. Okatani, "Self-calibration-based Approach to Critical Motion Sequences of Rolling-shutter Structure
from Motion", CVPR 2017. Functions are used in the manner of `cv2`:

>>> import rsundistort as rs
>>> camera = rs.Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
>>> motion = rs.RowMotion([0.05, 0.02, -0.03])
>>> rs.distort_points([[320.0, 240.0]], camera, motion, P=camera.K)
array([[320., 240.]])
"""

from .analysis import analyze, evaluate
from .batch import RectifyOptions, rectify_folder
from .bundle import BundleOptions, BundleResult, GuessedCameras, bundle_adjust, climb
from .critical import CriticalMotion, critical_motion
from .errors import (
    FileError,
    FileKindWarning,
    FormatError,
    InputError,
    MetadataWarning,
    ReconstructionError,
    RsUndistortError,
    RsUndistortWarning,
    SkippedPhotoWarning,
)
from .evaluation import motion_errors, pose_errors, psnr
from .input import GyroOptions
from .io import read_solution, write_solution
from .model import (
    AtInfinity,
    Camera,
    DepthMap,
    KnownLength,
    Observations,
    Plane,
    Reconstruction,
    RowMotion,
    Solution,
    SolvedImage,
)
from .model.projection import project_points, unproject_points
from .rectify import (
    RemapGrid,
    ViewOptions,
    distort_points,
    init_rectify_map,
    largest_shift_px,
    optimal_new_camera,
    rectify,
    remap_grid,
    undistort_points,
)
from .simulate import SceneOptions, WarpOptions, simulate_scene, simulate_warp
from .solve import RunOptions, SolveOptions, run, solve, solve_model

__version__ = "0.1.0"

__all__ = [
    "AtInfinity",
    "BundleOptions",
    "BundleResult",
    "Camera",
    "CriticalMotion",
    "DepthMap",
    "FileError",
    "FileKindWarning",
    "FormatError",
    "GuessedCameras",
    "GyroOptions",
    "InputError",
    "KnownLength",
    "MetadataWarning",
    "Observations",
    "Plane",
    "Reconstruction",
    "ReconstructionError",
    "RectifyOptions",
    "RemapGrid",
    "RowMotion",
    "RsUndistortError",
    "RsUndistortWarning",
    "RunOptions",
    "SceneOptions",
    "SkippedPhotoWarning",
    "Solution",
    "SolveOptions",
    "SolvedImage",
    "ViewOptions",
    "WarpOptions",
    "analyze",
    "bundle_adjust",
    "climb",
    "critical_motion",
    "distort_points",
    "evaluate",
    "init_rectify_map",
    "largest_shift_px",
    "motion_errors",
    "optimal_new_camera",
    "pose_errors",
    "project_points",
    "psnr",
    "read_solution",
    "rectify",
    "rectify_folder",
    "remap_grid",
    "run",
    "simulate_scene",
    "simulate_warp",
    "solve",
    "solve_model",
    "undistort_points",
    "unproject_points",
    "write_solution",
]
