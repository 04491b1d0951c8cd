"""Where a reconstruction's points would be measured, and by how much they were not; arrays as the kernels take them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._kernels import residuals
from .array_types import Array, Index, Mask
from .bend import bend_table
from .camera import Camera
from .field import lens_pixels
from .motion import check_shutter_model
from .reconstruction import Reconstruction

__all__ = [
    "camera_arrays",
    "motion_tables",
    "observed_lens_pixels",
    "plain_arrays",
    "reprojection_residuals",
    "shutter_displacements",
    "typical_px",
]


def camera_arrays(camera_idx: Index, cameras: Sequence[Camera], variation: Array) -> tuple[NDArray[Any], ...]:
    """Photo-to-camera indices, clock axes, signs, intrinsics and lenses as the kernels take them.

    Of cameras that vary from photo to photo (m, 3) each photo has its own.
    """
    intr, lens, axis, sign = zip(*(camera.kernel_args for camera in cameras), strict=True)
    if any(each.ndim == 2 for each in lens):  # among fisheyes a pinhole lens is one that is none
        lens = tuple(each if each.ndim == 2 else np.append(each, 0.0)[None] for each in lens)
    arrays = np.array(axis), np.array(sign), np.array(intr), np.array(lens)
    if not variation.any():
        return camera_idx, *arrays
    axes, signs, intrs, lenses = (each[camera_idx] for each in arrays)
    intrs[:, 2:] += intrs[:, :2] * variation[:, 1:]
    intrs[:, :2] *= np.exp(variation[:, :1])
    return np.arange(len(camera_idx)), axes, signs, intrs, lenses


def observed_lens_pixels(cameras: Sequence[Camera], camera_of_obs: Index, xy_raw: Array) -> Array:
    """Pixels (o, 2) of the lens models, those of the kernels, from measured ones."""
    if not any(camera.field.size for camera in cameras):
        return xy_raw
    xy = np.empty_like(xy_raw)
    for k, camera in enumerate(cameras):
        mine = camera_of_obs == k
        xy[mine] = lens_pixels(camera, xy_raw[mine])
    return xy


def plain_arrays(*arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """The arrays in one block of memory each that may be written: kernels are compiled for each kind that they meet."""
    return tuple(np.require(each, requirements=("C", "W")) for each in arrays)


def motion_tables(phi: Array, values: Array, clock: Array, R_cw: Array) -> Array:
    """Motions of photos with bends as the kernels take them: positions in the cameras' frames."""
    in_camera = np.concatenate([values[..., :3], np.einsum("mij,mnj->mni", R_cw, values[..., 3:])], axis=2)
    return bend_table(phi, clock[:, 0], clock[:, 1], in_camera)


def reprojection_residuals(reconstruction: Reconstruction, shutter_model: str | None = None) -> tuple[Array, Mask]:
    """Predicted minus measured pixels (o, 2) of the lens models, and which observations could be projected.

    Parameters
    ----------
    reconstruction : Reconstruction
        Poses, motions, points and measurements.
    shutter_model : str, optional
        Model to predict with; that of the reconstruction when left out.
    """
    model = check_shutter_model(shutter_model or reconstruction.shutter_model)
    obs = reconstruction.observations
    res = np.empty((len(obs), 2))
    valid = np.empty(len(obs), bool)
    phi = reconstruction.phi
    if reconstruction.bends:
        phi = motion_tables(phi, reconstruction.bend, reconstruction.bend_clock, reconstruction.R_cw)
    arrays = plain_arrays(
        *camera_arrays(reconstruction.camera_idx, reconstruction.cameras, reconstruction.variation),
        reconstruction.R_cw, reconstruction.center_w, phi, reconstruction.velocity,
        reconstruction.points_w, obs.frame_idx, obs.point_idx,
        observed_lens_pixels(reconstruction.cameras, reconstruction.camera_idx[obs.frame_idx], obs.xy_raw),
    )  # fmt: skip
    residuals.residuals(model, *arrays, res, valid)
    return res, valid


def shutter_displacements(reconstruction: Reconstruction) -> tuple[Array, Mask]:
    """By how much the motions displace the measurements, pixels (o, 2), and which of them could be projected."""
    moving, valid = reprojection_residuals(reconstruction)
    still, valid_still = reprojection_residuals(reconstruction, "global")
    return moving - still, valid & valid_still


def typical_px(reconstruction: Reconstruction, displacements: Array, valid: Mask) -> float:
    """Mean over the photos of the median length of displacements (o, 2): few photos may be all that moved.

    Only measurements that are `valid` (o,) count.
    """
    px = np.linalg.norm(displacements, axis=1)
    photos = [mine[valid[mine]] for mine in reconstruction.observations.by_photo(reconstruction.num_images)]
    return float(np.mean([np.median(px[mine]) for mine in photos if len(mine)] or [0.0]))
