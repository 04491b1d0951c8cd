"""COLMAP models: cameras and poses in, the model of the rectified photos out."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FormatError, InputError
from ..model import Camera, Reconstruction
from ..model.checks import check_photo_name
from ..model.projection import at_depth, project_points, unproject_points
from .colmap_files import check_colmap_cameras, check_colmap_files

__all__ = [
    "ModelIds",
    "camera_from_colmap",
    "colmap_model",
    "read_colmap_cameras",
    "read_colmap_poses",
    "rectified_keypoints",
    "write_colmap_model",
]

# COLMAP's pixel centres are at 0.5, ours at 0
_HALF = 0.5

# COLMAP's camera models that are ours with some of the coefficients zero: the lens, the number of coefficients
_LENSES = {
    "SIMPLE_PINHOLE": ("pinhole", 0),
    "PINHOLE": ("pinhole", 0),
    "SIMPLE_RADIAL": ("pinhole", 4),
    "RADIAL": ("pinhole", 4),
    "OPENCV": ("pinhole", 4),
    "FULL_OPENCV": ("pinhole", 8),
    "SIMPLE_FISHEYE": ("fisheye", 0),
    "FISHEYE": ("fisheye", 0),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", 4),
    "RADIAL_FISHEYE": ("fisheye", 4),
    "OPENCV_FISHEYE": ("fisheye", 4),
}


@dataclass(frozen=True)
class ModelIds:
    """Names by which COLMAP knows the parts of a reconstruction.

    Attributes
    ----------
    cameras, images, points : sequences of int
        Ids of its cameras, photos and points.
    """

    cameras: Sequence[int]
    images: Sequence[int]
    points: Sequence[int]

    @classmethod
    def in_order(cls, rec: Reconstruction) -> ModelIds:
        """Counted from one."""
        return cls(*(range(1, 1 + count) for count in (len(rec.cameras), rec.num_images, rec.num_points)))


#: How far a camera that is fitted to one of another model may be off anywhere in the photo.
_FIT_PX = 0.05


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
    cameras = {}
    for camera_id in sorted(model.cameras):
        cameras[str(camera_id)] = camera_from_colmap(model.cameras[camera_id], f"{path}: camera {camera_id}")
    return cameras, {_name(image, path): str(image.camera_id) for image in model.images.values()}


def _name(image: Any, where: Path) -> str:
    try:
        return check_photo_name(image.name)
    except InputError as error:
        raise FormatError(f"{where}: {error}") from error


def camera_from_colmap(found: Any, where: str) -> Camera:
    """Our camera of a `pycolmap.Camera`; `where` names it in errors."""
    if found.model_name not in _LENSES:
        return _fitted_camera(found, where)
    lens, length = _LENSES[found.model_name]
    extra = np.array(found.params)[list(found.extra_params_idxs())]
    dist = np.zeros(length)
    dist[: len(extra)] = extra
    K = [
        [found.focal_length_x, 0, found.principal_point_x - _HALF],
        [0, found.focal_length_y, found.principal_point_y - _HALF],
        [0, 0, 1],
    ]
    try:
        return Camera(found.width, found.height, np.array(K), dist, lens=lens)
    except ValueError as error:
        raise FormatError(f"{where}: {error}") from error


def _fitted_camera(found: Any, where: str) -> Camera:
    """The camera of ours nearest to one of a model that is not, if no ray of its photo misses by more than 0.05 px.

    Lenses of FOV or a division model bend rays by a smooth function of the radius, which four coefficients of a fisheye
    or six of a rational lens follow closely; prisms they do not.
    """
    from scipy.optimize import least_squares  # late: ten megabytes that hardly anybody needs

    width, height = found.width, found.height
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, width, 41), np.linspace(0, height, 31)))
    xy = np.column_stack([x, y])
    rays = np.array(found.cam_from_img(xy), np.float64) if found.model_name != "EQUIRECTANGULAR" else xy[:0]
    best, miss = None, np.inf
    if len(rays) and rays.shape[1] == 2 and np.isfinite(rays).all():
        K0 = [found.mean_focal_length(), found.mean_focal_length(), found.principal_point_x, found.principal_point_y]
        for lens, length in (("fisheye", 4), ("pinhole", 8)):

            def camera_of(p: NDArray[np.float64], lens: str = lens) -> Camera:
                K = np.array([[p[0], 0, p[2] - _HALF], [0, p[1], p[3] - _HALF], [0, 0, 1]])
                return Camera(width, height, K, p[4:], lens=lens)

            def error_px(p: NDArray[np.float64], camera_of: Any = camera_of) -> NDArray[np.float64]:
                ahead = np.column_stack([rays, np.ones(len(rays))])
                seen = project_points(ahead, camera_of(p), None, "global")[0] + _HALF
                return np.nan_to_num(seen - xy, nan=1e3, posinf=1e3, neginf=-1e3).ravel()

            try:
                p = least_squares(error_px, [*K0, *np.zeros(length)], x_scale="jac", max_nfev=200).x
                now = float(np.abs(error_px(p)).max())
                if now < miss:
                    best, miss = camera_of(p), now
            except ValueError:
                continue
    if best is None or miss > _FIT_PX:
        near = "" if best is None else f", which no camera of ours follows to {_FIT_PX} px (to {miss:.2g} px)"
        raise FormatError(f"{where} is {found.model_name}{near}; expected one of {', '.join(_LENSES)}")
    return best


def _read_model(path: Path) -> Any:
    """The model of a camera file, with its images where they lie beside it."""
    import pycolmap

    pycolmap.logging.minloglevel = 3
    suffix = ".bin" if path.suffix.lower() == ".bin" else ".txt"
    model = pycolmap.Reconstruction()
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
    import pycolmap

    check_colmap_files(folder)
    try:
        model = pycolmap.Reconstruction(folder)
    except Exception as error:  # pycolmap raises what its C++ raised
        raise FileError(f"{folder} is no COLMAP model: {error}") from error
    ids = sorted(model.cameras)
    cameras = []
    for camera_id in ids:
        camera = model.cameras[camera_id]
        if not any_lens and camera.model_name not in ("PINHOLE", "SIMPLE_PINHOLE"):
            raise FormatError(f"{folder}: camera {camera_id} is {camera.model_name}, expected PINHOLE")
        K = np.array(camera.calibration_matrix())
        K[:2, 2] -= _HALF
        cameras.append(Camera(camera.width, camera.height, K))
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    place = {image.image_id: k for k, image in enumerate(images)}
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    points, frame, point = [], [], []
    for number, point_id in enumerate(sorted(model.point3D_ids())):
        points.append(model.points3D[point_id].xyz)
        for image_id in sorted({element.image_id for element in model.points3D[point_id].track.elements}):
            frame.append(place[image_id])
            point.append(number)
    return (
        cameras,
        [_name(image, folder) for image in images],
        np.array([ids.index(image.camera_id) for image in images], np.int64),
        poses[:, :, :3],
        -np.einsum("mji,mj->mi", poses[:, :, :3], poses[:, :, 3]),
        np.array(points).reshape(-1, 3),
        np.array(frame, np.int64),
        np.array(point, np.int64),
    )


def rectified_keypoints(reconstruction: Reconstruction, rectified: list[Camera]) -> NDArray[np.float64]:
    """(o, 2) where the measurements lie in the rectified photos, pixels with integer centres.

    Parameters
    ----------
    reconstruction : Reconstruction
        Measurements in raw pixels.
    rectified : list of Camera
        New camera of each camera of the reconstruction.
    """
    obs = reconstruction.observations
    xy = np.full((len(obs), 2), np.nan)
    for i, of_photo in enumerate(obs.by_photo(reconstruction.num_images)):
        motion = reconstruction.motion(i).in_camera(reconstruction.R_cw[i])
        ideal, _ = unproject_points(
            obs.xy_raw[of_photo], reconstruction.camera(i), motion, reconstruction.shutter_model
        )
        if reconstruction.shutter_model == "constant-motion":
            # where the rectified photo shows the point depends on how far away it is
            X_w = reconstruction.points_w[obs.point_idx[of_photo]]
            depth = (X_w - reconstruction.center_w[i]) @ reconstruction.R_cw[i, 2]
            ideal = at_depth(ideal, obs.xy_raw[of_photo], reconstruction.camera(i), motion, depth)
        K = rectified[int(reconstruction.camera_idx[i])].K
        xy[of_photo] = ideal @ K[:2, :2].T + K[:2, 2]
    return xy


def colmap_model(
    reconstruction: Reconstruction,
    rectified: list[Camera],
    names: Sequence[str | None],
    colors: NDArray[np.uint8] | None = None,
    ids: ModelIds | None = None,
) -> Any:
    """The `pycolmap.Reconstruction` of the rectified photos: PINHOLE cameras, and where the photos show the points.

    Parameters
    ----------
    reconstruction : Reconstruction
        Poses, motions, points and raw measurements.
    rectified : list of Camera
        New camera of each camera of the reconstruction.
    names : sequence of str or None
        File names of the rectified photos; those without are left out.
    colors : (n, 3) uint8 array, optional
        Red, green, blue of the points.
    ids : ModelIds, optional
        Counted from one when left out.
    """
    import pycolmap

    ids = ids or ModelIds.in_order(reconstruction)
    model = pycolmap.Reconstruction()
    used = set(reconstruction.camera_idx.tolist())
    for index, camera in enumerate(rectified):
        if index not in used:
            continue
        K = camera.K
        params = [K[0, 0], K[1, 1], K[0, 2] + _HALF, K[1, 2] + _HALF]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model="PINHOLE", width=camera.width, height=camera.height, params=params, camera_id=ids.cameras[index]
            )
        )
    obs = reconstruction.observations
    xy = rectified_keypoints(reconstruction, rectified)
    usable = np.asarray(np.isfinite(xy).all(1))
    by_photo = obs.by_photo(reconstruction.num_images)
    place = np.full(len(obs), -1)
    for i, name in enumerate(names):
        if name is None:
            continue
        of_photo = by_photo[i][usable[by_photo[i]]]
        place[of_photo] = np.arange(len(of_photo))
        image = pycolmap.Image(
            name=name,
            keypoints=xy[of_photo] + _HALF,
            camera_id=ids.cameras[int(reconstruction.camera_idx[i])],
            image_id=ids.images[i],
        )
        R = reconstruction.R_cw[i]
        pose = pycolmap.Rigid3d(np.column_stack([R, -R @ reconstruction.center_w[i]]))
        model.add_image_with_trivial_frame(image, pose)
    order = np.argsort(obs.point_idx, kind="stable")
    bounds = np.searchsorted(obs.point_idx[order], np.arange(reconstruction.num_points + 1))
    for p in range(reconstruction.num_points):
        track = pycolmap.Track()
        for k in order[bounds[p] : bounds[p + 1]]:
            if place[k] >= 0:
                track.add_element(ids.images[int(obs.frame_idx[k])], int(place[k]))
        color = np.zeros(3, np.uint8) if colors is None else colors[p]
        if track.length() >= 2:
            point = pycolmap.Point3D(xyz=reconstruction.points_w[p], color=color, track=track)
            model.add_point3D_with_id(ids.points[p], point)
            for element in track.elements:
                model.images[element.image_id].set_point3D_for_point2D(element.point2D_idx, ids.points[p])
    model.update_point_3d_errors()
    return model


def write_colmap_model(folder: Path, *model: Any, text: bool = False) -> None:
    """Write cameras, images, points3D, and rigs, frames, of `colmap_model(*model)`, as `.bin` or as `.txt`."""
    folder.mkdir(parents=True, exist_ok=True)
    found = colmap_model(*model)
    if text:
        found.write_text(folder)
    else:
        found.write(folder)
