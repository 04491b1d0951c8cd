"""COLMAP's cameras and ours."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import FormatError, format_errors
from ..model import Camera
from ..model.array_types import Array
from ..model.projection import project_points
from .conventions import HALF, import_pycolmap

__all__ = ["FIT_PX", "camera_from_colmap", "camera_to_colmap", "nearest_camera", "pinhole_to_colmap", "refined_camera"]

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

#: How far a camera that is fitted to one of another model may be off anywhere in the photo.
FIT_PX = 0.05


def camera_from_colmap(found: Any, where: str) -> Camera:
    """Our camera of a `pycolmap.Camera`; `where` names it in errors."""
    if found.model_name not in _LENSES:
        return _fitted_camera(found, where)
    lens, length = _LENSES[found.model_name]
    extra = np.array(found.params)[list(found.extra_params_idxs())]
    dist = np.zeros(length)
    dist[: len(extra)] = extra
    K = [
        [found.focal_length_x, 0, found.principal_point_x - HALF],
        [0, found.focal_length_y, found.principal_point_y - HALF],
        [0, 0, 1],
    ]
    with format_errors(where, ValueError):
        return Camera(found.width, found.height, np.array(K), dist, lens=lens)


def _fitted_camera(found: Any, where: str) -> Camera:
    """The camera of ours nearest to one of a model that is not, if no ray of its photo misses by more than 0.05 px.

    Lenses of FOV or a division model bend rays by a smooth function of the radius, which four coefficients of a fisheye
    or six of a rational lens follow closely; prisms they do not.
    """
    width, height = found.width, found.height
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, width, 41), np.linspace(0, height, 31)))
    xy = np.column_stack([x, y])
    rays = np.array(found.cam_from_img(xy), np.float64) if found.model_name != "EQUIRECTANGULAR" else xy[:0]
    best, miss = None, np.inf
    if len(rays) and rays.shape[1] == 2 and np.isfinite(rays).all():
        f, cx, cy = found.mean_focal_length(), found.principal_point_x - HALF, found.principal_point_y - HALF
        best, miss = nearest_camera(
            rays, xy - HALF, Camera(width, height, np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]]))
        )
    if best is None or miss > FIT_PX:
        near = "" if best is None else f", which no camera of ours follows to {FIT_PX} px (to {miss:.2g} px)"
        raise FormatError(f"{where} is {found.model_name}{near}; expected one of {', '.join(_LENSES)}")
    return best


def nearest_camera(rays: Array, xy_raw: Array, start: Camera) -> tuple[Camera | None, float]:
    """The camera of ours that shows rays nearest to given pixels, and by how many pixels the worst one misses.

    Parameters
    ----------
    rays : (n, 2) array
        Normalized coordinates.
    xy_raw : (n, 2) array
        Where the photo shows them, integer centres.
    start : Camera
        Size, and the K to begin with.

    Returns
    -------
    camera : Camera or None
        Of a fisheye or a rational lens, whichever misses less; None where neither can be.
    miss_px : float
        The largest error in x or y.
    """
    from scipy.optimize import least_squares  # late: ten megabytes that hardly anybody needs

    best, miss = None, np.inf
    ahead = np.column_stack([rays, np.ones(len(rays))])
    K0 = [start.K[0, 0], start.K[1, 1], start.K[0, 2], start.K[1, 2]]

    def camera_of(p: Array, lens: str) -> Camera:
        K = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]])
        return Camera(start.width, start.height, K, p[4:], lens=lens)

    def error_px(p: Array, lens: str) -> Array:
        seen = project_points(ahead, camera_of(p, lens), None, "global")[0]
        return np.nan_to_num(seen - xy_raw, nan=1e3, posinf=1e3, neginf=-1e3).ravel()

    for lens, length in (("fisheye", 4), ("pinhole", 8)):
        with suppress(ValueError):
            p = least_squares(error_px, [*K0, *np.zeros(length)], x_scale="jac", max_nfev=200, args=(lens,)).x
            now = float(np.abs(error_px(p, lens)).max())
            if now < miss:
                best, miss = camera_of(p, lens), now
    return best, miss


def pinhole_to_colmap(camera: Camera, camera_id: int) -> Any:
    """The `pycolmap.Camera` of a camera without its lens."""
    return _colmap_camera(camera, "PINHOLE", [], camera_id)


def camera_to_colmap(camera: Camera, calibrated: bool, camera_id: int) -> Any:
    """The `pycolmap.Camera` of a camera without its lens, which only a fisheye keeps; else one that can be refined."""
    fisheye = camera.lens == "fisheye"
    if not calibrated:
        model = "SIMPLE_RADIAL_FISHEYE" if fisheye else "SIMPLE_RADIAL"
        result = _colmap_camera(camera, model, [camera.coefficients["k1"]], camera_id)
    elif fisheye:
        result = _colmap_camera(camera, "OPENCV_FISHEYE", list(camera.coefficients.values()), camera_id)
    else:
        result = pinhole_to_colmap(camera, camera_id)
    result.has_prior_focal_length = True
    return result


def _colmap_camera(camera: Camera, model: str, coefficients: list[float], camera_id: int) -> Any:
    """One of a model whose lens takes these coefficients."""
    pycolmap = import_pycolmap()

    K = camera.K
    focal = [K[0, 0]] if model.startswith("SIMPLE_") else [K[0, 0], K[1, 1]]
    params = [*focal, K[0, 2] + HALF, K[1, 2] + HALF, *coefficients]
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params, camera_id=camera_id)


def refined_camera(refined: Any, camera: Camera) -> Camera:
    """Our camera of a SIMPLE_RADIAL or SIMPLE_RADIAL_FISHEYE camera that mapping refined."""
    f, cx, cy, k1 = refined.params
    K = [[f, 0, cx - HALF], [0, f, cy - HALF], [0, 0, 1]]
    return replace(camera, K=np.array(K), dist=np.array([k1, 0, 0, 0]))
