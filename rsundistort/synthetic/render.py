"""Photos of a synthetic scene, row by row as a rolling shutter takes them, and their ground truth.

This is the judge of the row models, so it goes the other way round: pixel to ray, with a true rotation per
sensor line from SciPy, and shares no code with the kernels that go from the world to the pixel.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from importlib.metadata import version
from math import gcd
from pathlib import Path
from statistics import NormalDist
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from .._kernels import raycast
from ..errors import FileError
from ..model.camera import READOUTS, Camera
from ..model.checks import check_finite
from ..model.motion import RowMotion
from .lens import undistort_to_rays
from .recipe import Recipe, View, load_recipe
from .scene import Scene

__all__ = ["line_poses", "pixel_rays", "render_scene", "render_view", "rs_shift_px"]

_STRIP_ROWS = 64  # keeps the sample coordinates of a strip to some 16 MB


def line_poses(camera: Camera, view: View) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pose of the camera at each sensor line.

    Parameters
    ----------
    camera : Camera
        Its readout says whether lines are rows or columns and which is read first.
    view : View
        Pose at the line of the principal point, and the motion.

    Returns
    -------
    R_cw : (lines, 3, 3) array
        World to camera: Exp(tau*phi) @ view.R_cw, tau the clock of the line.
    center_w : (lines, 3) array
        view.center_w + tau*velocity.
    """
    axis, sign = READOUTS[camera.readout]
    lines = np.arange(camera.height if axis == 1 else camera.width)
    tau = sign * (lines - camera.K[axis, 2]) / camera.K[axis, axis]
    turn = Rotation.from_rotvec(tau[:, None] * view.motion.phi).as_matrix()
    return turn @ view.R_cw, view.center_w + tau[:, None] * view.motion.velocity


def _normalised(camera: Camera, uv_raw: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ideal normalised coordinates (..., 2) of raw pixels: the lens undone, not the shutter."""
    K = camera.K
    if not camera.dist.any():
        return (uv_raw - K[:2, 2]) / np.diag(K)[:2]
    return undistort_to_rays(uv_raw, K, camera.dist)


def pixel_rays(camera: Camera, view: View, uv_raw: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World rays along which the centres of raw pixels see.

    Parameters
    ----------
    camera : Camera
        Intrinsics, lens and readout.
    view : View
        Pose and motion.
    uv_raw : (n, 2) array
        Raw pixels; between lines the clock runs on.

    Returns
    -------
    origins_w, directions_w : (n, 3) array
        World frame; the directions have depth 1 in the camera.
    """
    uv = check_finite(uv_raw, (None, 2), "uv_raw")
    axis, sign = READOUTS[camera.readout]
    tau = sign * (uv[:, axis] - camera.K[axis, 2]) / camera.K[axis, axis]
    rays_c = np.column_stack([_normalised(camera, uv), np.ones(len(uv))])
    turn = Rotation.from_rotvec(tau[:, None] * view.motion.phi)
    return view.center_w + tau[:, None] * view.motion.velocity, turn.inv().apply(rays_c) @ view.R_cw


def _develop(radiance: NDArray[np.float64], exposure: float) -> NDArray[np.uint8]:
    """8-bit BGR of linear RGB radiance: a curve with a soft shoulder that is white at 4, then gamma."""
    x = exposure * radiance
    tone = np.clip(x * (1 + x / 16) / (1 + x), 0, 1)  # Reinhard's curve
    return np.round(255 * tone[..., ::-1] ** (1 / 2.2)).astype(np.uint8)


def _footprint(num: int, spread_px: float) -> NDArray[np.float64]:
    """Offsets (num, 2) of a pixel's samples in pixels: a Gaussian in num strata of equal probability.

    No two samples share a row or a column of strata: a lattice would render nearly level edges in a few steps
    only, and it is there that a rectified photo would differ from its twin (by 2 dB with a 4 x 4 lattice).
    """
    quantile = np.array([NormalDist(0, spread_px).inv_cdf((k + 0.5) / num) for k in range(num)])
    stride = next(s for s in range(int(0.618 * num) or 1, 0, -1) if gcd(s, num) == 1)
    return np.stack([quantile, quantile[np.arange(num) * stride % num]], 1)


def render_view(
    scene: Scene,
    camera: Camera,
    view: View,
    *,
    samples: int = 16,
    spread_px: float = 0.6,
    exposure: float = 1.0,
) -> NDArray[np.uint8]:
    """The photo that a camera takes of a scene.

    Parameters
    ----------
    scene : Scene
        What is there.
    camera : Camera
        Size, intrinsics, lens and readout.
    view : View
        Pose at mid-frame, and motion.
    samples : int
        A pixel is the mean of this many rays.
    spread_px : float
        Standard deviation of a pixel's footprint, lens and pixel together; 0.29 is the bare pixel.
    exposure : float
        Factor on the radiance.

    Returns
    -------
    photo : (height, width, 3) uint8 array
        BGR.
    """
    offsets = _footprint(samples, spread_px)
    spacing = 2.4 * spread_px / samples**0.5 / float(camera.K[0, 0])
    R_cw, center_w = line_poses(camera, view)
    by_column = READOUTS[camera.readout][0] == 0
    suns = scene.light.sun_directions(samples)
    image = np.empty((camera.height, camera.width, 3))
    for row in range(0, camera.height, _STRIP_ROWS):
        strip = image[row : row + _STRIP_ROWS]
        v, u = np.mgrid[row : row + len(strip), : camera.width].astype(float)
        # All samples of a pixel have the pose of its line, whatever their offset: that is how a line exposes.
        xy_norm = _normalised(camera, np.stack([u, v], -1)[:, :, None] + offsets)
        raycast.render_rows(scene.geometry, scene.look, R_cw, center_w, by_column, row, xy_norm, spacing, suns, strip)
    return _develop(image, exposure)


def rs_shift_px(scene: Scene, camera: Camera, view: View) -> float:
    """Largest displacement in pixels that the shutter caused in a photo, over its pixel grid.

    Compared with the photo that the same lens would have taken in the mid pose at once.
    """
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    uv = np.stack([u.ravel(), v.ravel()], 1)
    origins, directions = pixel_rays(camera, view, uv)
    if view.motion.velocity.any():
        distance = scene.cast(origins, directions)[1]
        met = np.isfinite(distance)
        directions[met] = origins[met] + distance[met, None] * directions[met] - view.center_w
    R_cw = np.ascontiguousarray(view.R_cw)
    ideal = cv2.projectPoints(directions, cv2.Rodrigues(R_cw)[0], np.zeros(3), camera.K, camera.dist)[0]
    return float(np.linalg.norm(ideal[:, 0] - uv, axis=1).max())


def _truth_image(recipe: Recipe, view: View) -> dict[str, Any]:
    return {
        "name": view.name,
        "camera_id": "1",
        "registered": True,
        "R_cw": view.R_cw.tolist(),
        "center_w": view.center_w.tolist(),
        "phi": view.motion.phi.tolist(),
        "velocity": view.motion.velocity.tolist(),
        "aspect": view.motion.aspect,
        "skew": view.motion.skew,
        "sigma_phi": None,
        "num_observations": 0,
        "rms_px": None,
        "rs_shift_px": rs_shift_px(recipe.scene, recipe.camera, view),
    }


def _truth(recipe: Recipe) -> dict[str, Any]:
    """The ground truth in the format of a solution."""
    camera = recipe.camera
    size_and_K = {"width": camera.width, "height": camera.height, "K": camera.K.tolist()}
    return {
        "format": "rsundistort-solution",
        "version": 1,
        "generator": {"rsundistort": version("rsundistort")},
        "options": {"recipe": recipe.name, "seed": recipe.scene.seed},
        "cameras": {"1": {**size_and_K, "dist": camera.dist.tolist(), "readout": camera.readout}},
        "rectified_cameras": {"1": size_and_K},
        "shutter_model": "rotation",
        "images": [_truth_image(recipe, view) for view in recipe.views],
        "critical_motion": None,
        "quality": {"num_points": 0, "num_observations": 0, "rms_px": None, "held_out_rms_px": {}},
        "stages": [],
    }


def _write_json(path: Path, value: dict[str, Any]) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def render_scene(
    recipe: str | Path | Recipe,
    out_dir: str | Path,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render a recipe: photos with a rolling shutter, their twins without, camera and ground truth.

    Writes photos/NAME, global/NAME, camera.json, ground_truth.json and a copy of the recipe.

    Parameters
    ----------
    recipe : path or Recipe
        What to render.
    out_dir : path
        Folder to write; made if need be.
    overwrite : bool
        Replace what an earlier run left; else that is an error.
    progress : callable, optional
        Called with (photos done, photos in all) after each photo.
    """
    source = None if isinstance(recipe, Recipe) else Path(recipe)
    loaded = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    out = Path(out_dir)
    existing = [name for name in ("photos", "global", "camera.json", "ground_truth.json") if (out / name).exists()]
    if existing and not overwrite:
        raise FileError(f"{out} already holds {', '.join(existing)}; ask for overwriting, or choose another folder")
    try:
        for folder in ("photos", "global"):
            (out / folder).mkdir(parents=True, exist_ok=True)
        camera = loaded.camera
        for done, view in enumerate(loaded.views):
            still = View(view.name, view.R_cw, view.center_w, RowMotion())
            for folder, each in (("photos", view), ("global", still)):
                photo = render_view(loaded.scene, camera, each, **loaded.render_options)
                (out / folder / view.name).write_bytes(_encode_jpeg(photo, loaded.jpeg_quality))
            if progress is not None:
                progress(done + 1, len(loaded.views))
        described = {"width": camera.width, "height": camera.height, "K": camera.K.tolist()}
        _write_json(out / "camera.json", {**described, "dist": camera.dist.tolist(), "readout": camera.readout})
        _write_json(out / "ground_truth.json", _truth(loaded))
        if source is not None and source.resolve() != (out / "recipe.json").resolve():
            shutil.copyfile(source, out / "recipe.json")
    except OSError as error:
        raise FileError(f"cannot write to {out}: {error}") from error


def _encode_jpeg(photo: NDArray[np.uint8], quality: int) -> bytes:
    """The JPEG file of a BGR photo; the same bytes for the same pixels, quality and libjpeg."""
    # chroma at full size: halved, it alone costs 2 dB
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return bytes(cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling])[1])
