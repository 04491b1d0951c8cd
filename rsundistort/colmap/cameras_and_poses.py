"""What COLMAP's models say without their measurements: cameras, and poses with points."""

from __future__ import annotations

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..errors import FileError, FormatError, format_errors
from ..model import Camera
from ..model.checks import check_photo_name
from .conventions import HALF, poses_of, quiet_pycolmap
from .file_checks import check_colmap_cameras, check_colmap_files, pycolmap_model
from .lenses import camera_from_colmap

__all__ = ["checked_name", "image_name", "read_colmap_cameras", "read_colmap_poses"]


def read_colmap_cameras(path: Path) -> tuple[dict[str, Camera], dict[str, str]]:
    """Cameras of a COLMAP model, with their lenses.

    Parameters
    ----------
    path : Path
        `cameras.bin` or `cameras.txt`, under any stem, or the folder that holds one of them, binary before text.

    Returns
    -------
    cameras : dict of camera id to Camera
        In pixels with integer centres.
    camera_of_image : dict of name to camera id
        Where the rest of the model lies beside the cameras, else empty.
    """
    if path.is_dir():
        path = path / "cameras.bin" if (path / "cameras.bin").is_file() else path / "cameras.txt"
    model = _read_model(path)
    found = model.cameras
    cameras = {str(key): camera_from_colmap(found[key], f"{path}: camera {key}") for key in sorted(found)}
    return cameras, {image_name(image, str(path)): str(image.camera_id) for image in model.images.values()}


def checked_name(name: str, where: str) -> str:
    """The name of a photo of the model that `where` names."""
    with format_errors(where):
        return check_photo_name(name)


def image_name(image: Any, where: str) -> str:
    """The name of a `pycolmap.Image` of the model that `where` names."""
    try:
        name = image.name
    except UnicodeDecodeError as error:  # pycolmap reads bytes, and decodes them when they are asked for
        raise FormatError(f"{where}: the name of image {image.image_id} is not UTF-8: {error.object!r}") from error
    return checked_name(name, where)


def _read_model(path: Path) -> Any:
    """The model of a camera file, with its images where they lie beside it."""
    suffix = ".bin" if path.suffix.lower() == ".bin" else ".txt"
    model = quiet_pycolmap().Reconstruction()
    read = model.read_binary if suffix == ".bin" else model.read_text
    rest = [f"images{suffix}", f"points3D{suffix}"]
    whole = path.name == f"cameras{suffix}" and all(path.with_name(name).is_file() for name in rest)
    if whole:
        check_colmap_files(path.parent)
    elif suffix == ".bin":
        check_colmap_cameras(path)
    try:
        if whole:
            read(path.parent)
        else:  # pycolmap reads whole models only
            with TemporaryDirectory() as alone:
                shutil.copyfile(path, Path(alone, f"cameras{suffix}"))
                for name in rest:
                    Path(alone, name).write_bytes(bytes(8) if suffix == ".bin" else b"")
                read(alone)
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror}") from error
    except Exception as error:  # pycolmap raises what its C++ raised
        raise FormatError(f"{path} is no whole COLMAP camera file: {' '.join(str(error).split())}") from error
    if not model.cameras:
        raise FormatError(f"{path} holds no camera")
    return model


def read_colmap_poses(folder: Path, any_lens: bool = False) -> tuple[Any, ...]:
    """Poses, points and tracks of a COLMAP model, without its measurements.

    Parameters
    ----------
    folder : Path
        With cameras, images and points3D, text or binary.
    any_lens : bool
        Whether cameras may have a lens distortion, which is left out; else they must be pinholes.

    Returns
    -------
    cameras, names, camera_idx, R_cw, center_w, points_w, frame_idx, point_idx
        As in `Reconstruction`.
    """
    model = pycolmap_model(folder)
    ids = sorted(model.cameras)
    cameras = []
    for camera_id in ids:
        camera = model.cameras[camera_id]
        if not any_lens and camera.model_name not in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise FormatError(f"{folder}: camera {camera_id} is {camera.model_name}, expected PINHOLE")
        K = np.array(camera.calibration_matrix())
        K[:2, 2] -= HALF
        cameras.append(Camera(camera.width, camera.height, K))
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    place = {image.image_id: k for k, image in enumerate(images)}
    R_cw, center_w = poses_of(images)
    points, frame, point = [], [], []
    for number, point_id in enumerate(sorted(model.point3D_ids())):
        points.append(model.points3D[point_id].xyz)
        for image_id in sorted({element.image_id for element in model.points3D[point_id].track.elements}):
            frame.append(place[image_id])
            point.append(number)
    return (
        cameras,
        [image_name(image, str(folder)) for image in images],
        np.array([ids.index(image.camera_id) for image in images], np.int64),
        R_cw,
        center_w,
        np.array(points).reshape(-1, 3),
        np.array(frame, np.int64),
        np.array(point, np.int64),
    )
