"""nerfstudio's `transforms.json`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FormatError
from ..model import Camera, Solution

__all__ = ["read_transforms", "write_transforms"]


def _intrinsics(camera: Camera) -> dict[str, Any]:
    # nerfstudio takes COLMAP's principal point: pixel centres at 0.5
    K = camera.K
    return {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2] + 0.5,
        "cy": K[1, 2] + 0.5,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
    }


def read_transforms(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses R_cw (m, 3, 3) and center_w (m, 3) of a `transforms.json`."""
    try:
        frames = json.loads(path.read_text(encoding="utf-8"))["frames"]
        matrices = np.array([frame["transform_matrix"] for frame in frames], np.float64).reshape(-1, 4, 4)
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path} is no transforms.json: expected frames with a transform_matrix each") from error
    # back from OpenGL's axes; a matrix may hold a scale
    axes = matrices[:, :3, :3] @ np.diag([1.0, -1.0, -1.0])
    length = np.linalg.norm(axes, axis=1, keepdims=True)
    if not (length > 0).all():
        raise FormatError(f"{path}: a transform_matrix is no pose")
    return (axes / length).transpose(0, 2, 1), matrices[:, :3, 3]


def write_transforms(path: Path, solution: Solution, files: dict[str, tuple[str, str]]) -> None:
    """Write `transforms.json` of the rectified photos: OpenGL axes, a mask for every photo.

    Parameters
    ----------
    path : Path
        File to write.
    solution : Solution
        Poses and rectified cameras.
    files : dict of photo name to (image path, mask path)
        Relative to the file's folder; photos without are left out.
    """
    images = [image for image in solution.registered if image.posed and image.name in files]
    used: Sequence[str] = sorted({image.camera_id for image in images})
    value: dict[str, Any] = _intrinsics(solution.rectified_cameras[used[0]]) if len(used) == 1 else {}
    frames = []
    for image in images:
        assert image.R_cw is not None
        assert image.center_w is not None
        matrix = np.eye(4)
        # OpenCV looks along +z with y down, OpenGL along -z with y up
        matrix[:3, :3] = image.R_cw.T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = image.center_w
        frame: dict[str, Any] = {"file_path": files[image.name][0], "mask_path": files[image.name][1]}
        if len(used) > 1:
            frame.update(_intrinsics(solution.rectified_cameras[image.camera_id]))
        frame["transform_matrix"] = matrix.tolist()
        frames.append(frame)
    value["frames"] = frames
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
