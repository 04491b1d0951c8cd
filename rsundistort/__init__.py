"""Rolling-shutter structure from motion: photos in, rectified photos and camera poses out.

After E. Ito and T. Okatani, "Self-calibration-based Approach to Critical Motion Sequences of Rolling-shutter Structure
from Motion", CVPR 2017. Functions are used in the manner of `cv2`:

>>> import rsundistort as rs
>>> camera = rs.Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
>>> motion = rs.RowMotion([0.05, 0.02, -0.03])
>>> rs.distort_points([[320.0, 240.0]], camera, motion, P=camera.K)
array([[320., 240.]])
"""

from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

from ._former import by_former_name as _by_former_name
from .analysis import analyze, evaluate
from .batch import RectifyOptions, rectify_folder
from .bundle import BundleOptions, bundle_adjust
from .critical import critical_motion
from .errors import RsUndistortError, RsUndistortWarning
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
    undistort_points,
)
from .solve import RunOptions, SolveOptions, run, solve

__version__ = "0.1.0"

__all__ = [
    "AtInfinity",
    "BundleOptions",
    "Camera",
    "DepthMap",
    "GyroOptions",
    "KnownLength",
    "Observations",
    "Plane",
    "Reconstruction",
    "RectifyOptions",
    "RemapGrid",
    "RowMotion",
    "RsUndistortError",
    "RsUndistortWarning",
    "RunOptions",
    "Solution",
    "SolveOptions",
    "SolvedImage",
    "ViewOptions",
    "analyze",
    "bundle_adjust",
    "critical_motion",
    "distort_points",
    "evaluate",
    "init_rectify_map",
    "largest_shift_px",
    "optimal_new_camera",
    "project_points",
    "read_solution",
    "rectify",
    "rectify_folder",
    "run",
    "solve",
    "undistort_points",
    "unproject_points",
    "write_solution",
]

if not _TYPE_CHECKING:  # type checkers know the present names only

    def __getattr__(name: str) -> _Any:
        return _by_former_name(__name__, name)
