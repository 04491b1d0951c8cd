"""Errors of poses, motions and images against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..model import Solution
from ..model.array_types import Array
from ..model.checks import check_finite, check_kind, check_whole
from ..model.similarity import similarity_of

__all__ = ["MotionErrors", "PoseErrors", "align_points", "motion_errors", "pose_errors", "psnr", "rotation_angles_deg"]


@dataclass(frozen=True)
class PoseErrors:
    """Pose errors of the photos that both sides have.

    Attributes
    ----------
    names : tuple of str
        Photos compared.
    rotation_deg : (m,) array
        Angle left after the common rotation that best aligns all orientations.
    center : (m,) array
        Distance left after the similarity that best aligns the centres, in units of the truth's mean distance
        between consecutive centres; NaN where these are all in one place.
    """

    names: tuple[str, ...]
    rotation_deg: Array
    center: Array


@dataclass(frozen=True)
class MotionErrors:
    """Errors of phi in radians per frame, (m, 3), of the photos that both sides have."""

    names: tuple[str, ...]
    phi_rad_per_frame: Array


def rotation_angles_deg(R: Array) -> Array:
    """Angles (m,) of rotation matrices (m, 3, 3); exact also for tiny ones."""
    vee = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.linalg.norm(vee, axis=1) / 2
    cosine = (np.trace(R, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arctan2(sine, cosine))


def _best_rotation(moved: Array) -> Array:
    """Rotation nearest to a 3x3 matrix."""
    U, _, Vt = np.linalg.svd(moved)
    return U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt


def align_points(points: Array, true_points: Array) -> tuple[float, Array, Array]:
    """Similarity that best takes points (n, 3) to the true ones in the least-squares sense, after Umeyama (1991).

    Returns
    -------
    scale, R, shift
        `scale * R @ x + shift`; float, (3, 3), (3,).
    """
    points = check_finite(points, (None, 3), "points")
    true_points = check_finite(true_points, points.shape, "true_points")
    if len(points) < 3:
        raise InputError(f"{len(points)} points; a similarity needs at least three")
    found = similarity_of(points, true_points)
    return found.scale, found.R, found.shift


def pose_errors(solution: Solution, truth: Solution) -> PoseErrors:
    """Pose errors of a solution.

    Parameters
    ----------
    solution, truth : Solution
        Photos are matched by name.

    Raises
    ------
    InputError
        When fewer than three photos have poses on both sides.
    """
    for each, what in ((solution, "solution"), (truth, "truth")):
        check_kind(each, Solution, what)
    true_of = {image.name: image for image in truth.images if image.posed}
    pairs = [(image, true_of[image.name]) for image in solution.images if image.posed and image.name in true_of]
    if len(pairs) < 3:
        raise InputError(f"{len(pairs)} photos have a pose in both solution and truth; need at least three")
    R = np.array([a.R_cw for a, _ in pairs])
    R_true = np.array([b.R_cw for _, b in pairs])
    C = np.array([a.center_w for a, _ in pairs])
    C_true = np.array([b.center_w for _, b in pairs])
    # R_true = R A^T for the world rotation A that takes estimated to true coordinates
    A = _best_rotation(np.einsum("mji,mjk->ik", R_true, R))
    rotation = rotation_angles_deg(np.einsum("mij,kj,mlk->mil", R, A, R_true))
    step = np.linalg.norm(np.diff(C_true, axis=0), axis=1).mean()
    if not step > 0:
        return PoseErrors(tuple(a.name for a, _ in pairs), rotation, np.full(len(pairs), np.nan))
    scale, S, shift = align_points(C, C_true)
    left = np.linalg.norm(scale * C @ S.T + shift - C_true, axis=1)
    return PoseErrors(tuple(a.name for a, _ in pairs), rotation, left / step)


def motion_errors(solution: Solution, truth: Solution) -> MotionErrors:
    """Errors of phi of a solution; photos are matched by name.

    A readout that is taken to run the other way reverses the sign of phi and is no error.
    """
    for each, what in ((solution, "solution"), (truth, "truth")):
        check_kind(each, Solution, what)
    true_of = {image.name: image for image in truth.images if image.motion is not None}
    names, errors = [], []
    for image in solution.images:
        if image.motion is None or image.name not in true_of:
            continue
        true_image = true_of[image.name]
        assert true_image.motion is not None
        camera, true_camera = solution.cameras[image.camera_id], truth.cameras[true_image.camera_id]
        reverse = camera.clock_sign * true_camera.clock_sign
        names.append(image.name)
        # each by its own camera: with another focal length the same rotation has another phi
        true_phi = true_image.motion.phi * true_camera.frame_span
        errors.append(image.motion.phi * camera.frame_span - reverse * true_phi)
    if not names:
        raise InputError("no photo has a motion in both solution and truth")
    return MotionErrors(tuple(names), np.array(errors))


def psnr(image: NDArray[Any], truth: NDArray[Any], mask: NDArray[np.uint8] | None = None, margin_px: int = 2) -> float:
    """Peak signal-to-noise ratio in dB over the valid pixels.

    Parameters
    ----------
    image, truth : arrays of one shape and type
        uint8, uint16, or float in 0 to 1.
    mask : (h, w) uint8 array, optional
        255 where `image` is valid.
    margin_px : int
        Pixels nearer than this to an invalid one, or to the border, do not count: an interpolation that reaches beyond
        the raw photo is no error of the geometry.
    """
    for each, name in ((image, "image"), (truth, "truth"), *(() if mask is None else ((mask, "mask"),))):
        check_kind(each, np.ndarray, name)
        known = each.dtype in (np.uint8, np.uint16) or each.dtype.kind == "f"
        if not known or each.ndim not in (2, 3) or not each.size:
            raise InputError(
                f"{name} is {each.dtype} {each.shape}, expected uint8, uint16 or float in 0 to 1, (h, w[, channels])"
            )
        if each.dtype.kind == "f":
            check_finite(each, each.shape, name)
    if image.shape != truth.shape or image.dtype != truth.dtype:
        raise InputError(f"image {image.shape} {image.dtype} and truth {truth.shape} {truth.dtype} do not compare")
    if mask is not None and (mask.dtype != np.uint8 or mask.shape != image.shape[:2]):
        raise InputError(f"mask is {mask.dtype} {mask.shape}, expected uint8 {image.shape[:2]}")
    check_whole(margin_px, "margin_px", 0, max(image.shape[:2]))
    valid = np.full(image.shape[:2], 255, np.uint8) if mask is None else mask
    size = 2 * margin_px + 1
    kept = cv2.erode(valid, np.ones((size, size), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    if not kept.any():
        return float("nan")
    peak = float(np.iinfo(image.dtype).max) if np.issubdtype(image.dtype, np.integer) else 1.0
    mse = float(np.mean((image[kept].astype(np.float64) - truth[kept].astype(np.float64)) ** 2))
    return float("inf") if mse == 0 else 10.0 * float(np.log10(peak**2 / mse))
