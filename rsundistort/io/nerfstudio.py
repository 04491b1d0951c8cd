"""nerfstudio's `transforms.json`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FormatError, InputError
from ..model import Camera, Solution
from ..model.array_types import Array
from .json_text import read_json
from .rules import Numbers, check
from .usd import FLIP

__all__ = ["read_transforms", "write_transforms"]


def intrinsics(camera: Camera) -> dict[str, Any]:
    """What `transforms.json` says of a camera: nerfstudio's keys, and `is_fisheye` of instant-ngp.

    Raises
    ------
    InputError
        When its lens has more coefficients than k1, k2, p1, p2 and k3; of a fisheye four.
    """
    # both take COLMAP's principal point: pixel centres at 0.5
    K, lens = camera.K, camera.coefficients
    value: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if camera.lens == "fisheye" else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2] + 0.5,
        "cy": K[1, 2] + 0.5,
    }
    if camera.lens == "fisheye":
        # no p1, p2: instant-ngp keeps them where a fisheye has k3 and k4
        return value | {"is_fisheye": True} | lens
    others = [name for name, number in lens.items() if number and name not in ("k1", "k2", "p1", "p2", "k3")]
    if others:
        raise InputError(f"transforms.json has no room for the lens coefficients {', '.join(others)}")
    return value | {name: lens[name] for name in ("k1", "k2", "p1", "p2")} | ({"k3": lens["k3"]} if lens["k3"] else {})


def camera_to_world(R_cw: Array, center_w: Array) -> list[list[float]]:
    """The (4, 4) `transform_matrix` of a pose."""
    matrix = np.eye(4)
    # OpenCV looks along +z with y down, OpenGL along -z with y up
    matrix[:3, :3] = R_cw.T @ FLIP
    matrix[:3, 3] = center_w
    found: list[list[float]] = matrix.tolist()
    return found


def read_transforms(path: Path) -> tuple[Array, Array]:
    """Poses R_cw (m, 3, 3) and center_w (m, 3) of a `transforms.json`."""
    value = read_json(path)
    try:
        check(value, {"frames": [{"transform_matrix": Numbers(4, 4)}]})
    except FormatError as error:
        raise FormatError(f"{path} is no transforms.json: {error}") from error
    matrices = np.array([frame["transform_matrix"] for frame in value["frames"]], np.float64).reshape(-1, 4, 4)
    # back from OpenGL's axes; a matrix may hold a scale
    axes = matrices[:, :3, :3] @ FLIP
    with np.errstate(over="ignore"):
        length = np.linalg.norm(axes, axis=1, keepdims=True)
    if not ((length > 0) & np.isfinite(length)).all():
        raise FormatError(f"{path}: a transform_matrix is no pose")
    return (axes / length).transpose(0, 2, 1), matrices[:, :3, 3]


def write_transforms(
    path: Path, solution: Solution, files: Mapping[str, tuple[str, str]], points: str | None = None
) -> None:
    """Write `transforms.json` of the rectified photos: OpenGL axes, a mask for every photo.

    Parameters
    ----------
    solution : Solution
        Poses and rectified cameras.
    files : mapping of photo name to (image path, mask path)
        Relative to the file's folder; photos without are left out.
    points : str, optional
        PLY file of points in the frame of the poses, relative too: splatfacto starts from them.
    """
    images = [image for image in solution.registered if image.posed and image.name in files]
    frames = []
    for image in images:
        assert image.R_cw is not None
        assert image.center_w is not None
        image_path, mask_path = files[image.name]
        matrix = camera_to_world(image.R_cw, image.center_w)
        frames.append({"file_path": image_path, "mask_path": mask_path, "transform_matrix": matrix})
    write_frames(path, frames, [solution.rectified_cameras[image.camera_id] for image in images], points)


def write_frames(
    path: Path,
    frames: Sequence[Mapping[str, Any]],
    cameras: Sequence[Camera],
    points: str | None = None,
    common: Mapping[str, Any] | None = None,
) -> None:
    """Write a `transforms.json` with what is `common`: intrinsics too if all frames share a camera, else with each."""
    value: dict[str, Any] = dict(common or {})
    if points is not None:
        value["ply_file_path"] = points
    if cameras:
        # nerfstudio looks for the model nowhere else
        value["camera_model"] = intrinsics(cameras[0])["camera_model"]
    if len(set(cameras)) == 1:
        value |= intrinsics(cameras[0])
        value["frames"] = [dict(frame) for frame in frames]
    else:
        value["frames"] = [{**intrinsics(camera), **frame} for frame, camera in zip(frames, cameras, strict=True)]
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")
