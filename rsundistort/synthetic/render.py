"""Photos of a synthetic scene, row by row as a rolling shutter takes them, and their ground truth.

This is the judge of the row models, so it goes the other way round: pixel to ray, with a true rotation per
sensor line from SciPy, and shares no code with the kernels that go from the world to the pixel.
"""

from __future__ import annotations

from math import gcd
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from .._kernels import raycast
from ..errors import InputError
from ..model.array_types import Array
from ..model.camera import Camera
from ..model.checks import check_finite
from .lens import clock_at, distort_rays, undistort_to_rays
from .recipe import Noise, View
from .scene import Scene

__all__ = ["add_noise", "line_poses", "pixel_rays", "render_depth", "render_view", "rs_shift_px"]

_STRIP_ROWS = 64  # keeps the sample coordinates of a strip to some 16 MB


def line_poses(camera: Camera, view: View, delay: float = 0.0) -> tuple[Array, Array]:
    """Pose of the camera at each sensor line.

    Parameters
    ----------
    camera : Camera
        Its readout says whether lines are rows or columns and which is read first.
    delay : float
        Time after the middle of the line's exposure, in units of the clock.

    Returns
    -------
    R_cw : (lines, 3, 3) array
        World to camera: Exp(theta(tau)) @ view.R_cw, tau the clock of the line plus the delay; theta is tau*phi and
        what the motion's bend adds.
    center_w : (lines, 3) array
        view.center_w + tau*velocity, and what the bend adds.
    """
    rotation, way = view.motion.at(clock_at(camera, np.arange(camera.num_lines)) + delay)
    return Rotation.from_rotvec(rotation).as_matrix() @ view.R_cw, view.center_w + way


def pixel_rays(camera: Camera, view: View, uv_raw: ArrayLike) -> tuple[Array, Array]:
    """World rays along which the centres of raw pixels see.

    Parameters
    ----------
    uv_raw : (n, 2) array
        Raw pixels; between lines the clock runs on.

    Returns
    -------
    origins_w, directions_w : (n, 3) array
        World frame; the directions have depth 1 in the camera.
    """
    uv = check_finite(uv_raw, (None, 2), "uv_raw")
    rays_c = np.column_stack([undistort_to_rays(uv, camera), np.ones(len(uv))])
    # of whole photos there are few
    tau, line = np.unique(clock_at(camera, uv[:, camera.clock_axis]), return_inverse=True)
    rotation, way = view.motion.at(tau)
    return view.center_w + way[line], Rotation.from_rotvec(-rotation)[line].apply(rays_c) @ view.R_cw


def _develop(radiance: Array, exposure: float) -> NDArray[np.uint8]:
    """8-bit BGR of linear RGB radiance: a curve with a soft shoulder that is white at 4, then gamma."""
    x = exposure * radiance
    tone = np.clip(x * (1 + x / 16) / (1 + x), 0, 1)  # Reinhard's curve
    return np.round(255 * tone[..., ::-1] ** (1 / 2.2)).astype(np.uint8)


def _footprint(num: int, spread_px: float) -> Array:
    """Offsets (num, 2) of a pixel's samples in pixels: a Gaussian in num strata of equal probability.

    No two samples share a row or a column of strata: a lattice would render nearly level edges in a few steps only, and
    it is there that a rectified photo would differ from its global-shutter reference (by 2 dB with a 4 x 4 lattice).
    """
    quantile = np.array([NormalDist(0, spread_px).inv_cdf((k + 0.5) / num) for k in range(num)])
    stride = next(s for s in range(int(0.618 * num) or 1, 0, -1) if gcd(s, num) == 1)
    return np.stack([quantile, quantile[np.arange(num) * stride % num]], 1)


def render_view(
    scene: Scene, camera: Camera, view: View, *, samples: int = 16, spread_px: float = 0.6, exposure: float = 1.0
) -> NDArray[np.uint8]:
    """The photo that a camera takes of a scene.

    Parameters
    ----------
    view : View
        Pose at mid-frame, motion and exposure: the samples of a pixel are spread over the exposure of its line.
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
    if samples < 1 or not spread_px > 0 or not exposure > 0:
        raise InputError(f"samples={samples}, spread_px={spread_px}, exposure={exposure}; all must be positive")
    offsets = _footprint(samples, spread_px)
    spacing = 2.4 * spread_px / samples**0.5 / float(camera.K[0, 0])
    # moments of the exposure, mixed so that they do not go with the place in the pixel
    moments = [((k * 7 + 3) % samples + 0.5) / samples - 0.5 for k in range(samples)] if view.exposure else [0.0]
    poses = [line_poses(camera, view, moment * view.exposure) for moment in moments]
    R_cw, center_w = (np.ascontiguousarray(np.stack(each, axis=1)) for each in zip(*poses, strict=True))
    by_column = camera.clock_axis == 0
    suns = scene.light.sun_directions(samples)
    image = np.empty((camera.height, camera.width, 3))
    for row in range(0, camera.height, _STRIP_ROWS):
        strip = image[row : row + _STRIP_ROWS]
        v, u = np.mgrid[row : row + len(strip), : camera.width].astype(float)
        # All samples of a pixel have the pose of its line, whatever their offset: that is how a line exposes.
        xy_norm = undistort_to_rays(np.stack([u, v], -1)[:, :, None] + offsets, camera)
        raycast.render_rows(scene.geometry, scene.look, R_cw, center_w, by_column, row, xy_norm, spacing, suns, strip)
    return _develop(image, exposure)


def rs_shift_px(scene: Scene, camera: Camera, view: View) -> float:
    """Largest displacement in pixels that the shutter caused in a photo, over its pixel grid.

    Compared with the photo that the same lens would have taken in the mid pose at once.
    """
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    uv = np.stack([u.ravel(), v.ravel()], 1)
    origins, directions = pixel_rays(camera, view, uv)
    if view.motion.moves:
        distance = scene.cast(origins, directions)[1]
        met = np.isfinite(distance)
        directions[met] = origins[met] + distance[met, None] * directions[met] - view.center_w
    ideal = distort_rays(directions @ view.R_cw.T, camera)
    return float(np.linalg.norm(ideal - uv, axis=1).max())


def render_depth(scene: Scene, camera: Camera, view: View) -> NDArray[np.float32]:
    """Depth that the centre of each pixel sees, in the camera at the moment of its line.

    Returns
    -------
    depth : (height, width) float32 array
        z in the camera, world units; inf where nothing is.
    """
    depth = np.empty((camera.height, camera.width), np.float32)
    for row in range(0, camera.height, _STRIP_ROWS):
        strip = depth[row : row + _STRIP_ROWS]
        v, u = np.mgrid[row : row + len(strip), : camera.width].astype(float)
        # directions have depth 1, so the distance along them is the depth
        distance = scene.cast(*pixel_rays(camera, view, np.stack([u.ravel(), v.ravel()], 1)))[1]
        strip[:] = distance.reshape(strip.shape)
    return depth


def add_noise(photo: NDArray[np.uint8], noise: Noise, seed: int, number: int) -> NDArray[np.uint8]:
    """The photo with the noise of the sensor, drawn for the photo of this number."""
    if not (noise.read_grey or noise.shot_grey):
        return photo
    rng = np.random.default_rng([seed, 4, number])
    spread = np.sqrt(noise.read_grey**2 + noise.shot_grey**2 * photo / 255.0)
    return np.clip(np.round(photo + spread * rng.standard_normal(photo.shape)), 0, 255).astype(np.uint8)
