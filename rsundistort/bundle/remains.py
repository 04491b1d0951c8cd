"""What a fit leaves in the residuals of each photo: a smooth warp, or lines that moved as nothing steady moves them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..model import Observations, Reconstruction
from ..model.array_types import Array, Mask
from ..model.bend import splines_at
from ..model.reprojection import reprojection_residuals

__all__ = ["CLIP", "WAVES", "agreement_of_waves", "errors_without", "half_across_readout", "warps", "waves"]

Functions = Callable[[Reconstruction, Observations], Array]

# Longer residuals, in standard deviations, count as this: a wrong match says nothing about the shutter.
CLIP = 5.0
# What a photo's residuals have in common is sought among polynomials of this degree in x and y, whatever bent it.
_DEGREE = 3
# And, of what a motion that is not steady leaves, among splines of so many values along the readout.
WAVES = 25
# Measurements for each coefficient of these, at least.
_PER_COEFFICIENT = 3
# Share of their squares that keeps coefficients finite that no measurement determines.
_RIDGE = 1e-6
# Standard deviation of the rotations that lines are taken to have beyond a steady motion, radians: of a trembling hand
# or of a motor's vibration. It keeps finite what a half shows hardly.
_ROTATED = 5e-4
_REWEIGHTED = 4


def half_across_readout(reconstruction: Reconstruction) -> Mask:
    """(n,) points on one side of the photos that show them, sides across the readout; half of all."""
    obs = reconstruction.observations
    of_photo = [reconstruction.camera(i) for i in range(reconstruction.num_images)]
    axis = np.array([1 - camera.clock_axis for camera in of_photo])[obs.frame_idx]
    size = np.array([(camera.width, camera.height) for camera in of_photo], float)[obs.frame_idx]
    rows = np.arange(len(obs))
    total = np.bincount(obs.point_idx, (obs.xy_raw / size)[rows, axis], reconstruction.num_points)
    place = total / np.maximum(np.bincount(obs.point_idx, minlength=reconstruction.num_points), 1)
    return np.asarray(place < np.median(place))


def warps(rec: Reconstruction, measured: Observations) -> Array:
    """(n, k) polynomials in the place of each measurement, products of Legendre's of up to `_DEGREE` together."""
    size = np.array([(camera.width, camera.height) for camera in rec.cameras])[rec.camera_idx][measured.frame_idx]
    along = 2 * (measured.xy_raw + 0.5) / size - 1
    x, y = (np.polynomial.legendre.legvander(along[:, k], _DEGREE) for k in (0, 1))
    return np.stack([x[:, i] * y[:, j] for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)], axis=1)


def _splines_along(rec: Reconstruction, measured: Observations, sites: int) -> Array:
    """(n, sites) splines along the readout at the place of each measurement."""
    camera = [rec.camera(i) for i in range(rec.num_images)]
    axis = np.array([each.clock_axis for each in camera])[measured.frame_idx]
    lines = np.array([each.num_lines for each in camera])[measured.frame_idx]
    place = (measured.xy_raw[np.arange(len(measured)), axis] + 0.5) / lines
    return splines_at(sites, np.clip(place, 0.0, 1.0))


def waves(rec: Reconstruction, measured: Observations, sites: int = WAVES) -> Array:
    """(n, k) the same with splines along the readout, through so many values."""
    return np.hstack([warps(rec, measured), _splines_along(rec, measured, sites)])


def errors_without(
    functions: Functions, rec: Reconstruction, fitted: Observations, measured: Observations, sigma_px: float
) -> Array:
    """As `clipped_errors`, once a smooth warp of each photo, fitted to other measurements, is taken out.

    What it takes away is what the model left, whatever it is: lens, focus, motion. What stays is noise, and matches
    that are wrong. The warp is a sum of `functions` (n, k) of the measurements' places, in x and in y.
    """
    (res, valid), (rest, seen) = (reprojection_residuals(replace(rec, observations=obs)) for obs in (fitted, measured))
    of_fitted, of_measured = functions(rec, fitted), functions(rec, measured)
    rest = np.array(rest)
    for mine, others in zip(fitted.by_photo(rec.num_images), measured.by_photo(rec.num_images), strict=True):
        mine = mine[valid[mine]]
        A, B = of_fitted[mine], of_measured[others]
        if len(mine) < _PER_COEFFICIENT * A.shape[1]:
            continue
        noise = sigma_px * fitted.sigma[mine, None]
        found = np.zeros((A.shape[1], 2))
        for _ in range(_REWEIGHTED):  # reweighted, so that wrong matches count little
            square = (((res[mine] - A @ found) / noise) ** 2).sum(1, keepdims=True)
            weight = 1.0 / noise / np.sqrt(1.0 + square / CLIP**2)
            weighed = A * weight**2
            normal = A.T @ weighed
            ridge = _RIDGE * float(np.trace(normal)) / len(normal)
            found = np.linalg.solve(normal + ridge * np.eye(len(normal)), weighed.T @ res[mine])
        rest[others] -= B @ found
    square = np.where(seen, (rest**2).sum(1) / (sigma_px * measured.sigma) ** 2, np.inf)
    return np.asarray(np.minimum(square, 2 * CLIP**2) / 2)


def _rotated(rec: Reconstruction, measured: Observations) -> Array:
    """(n, 2, 3) pixels a radian that each measurement moves by if its line rotates about the camera's axes.

    Without the lens: what is asked is whether two halves show the same.
    """
    K = np.stack([rec.camera(i).K for i in range(rec.num_images)])[measured.frame_idx]
    fx, fy = K[:, 0, 0], K[:, 1, 1]
    x, y = (measured.xy_raw[:, 0] - K[:, 0, 2]) / fx, (measured.xy_raw[:, 1] - K[:, 1, 2]) / fy
    across = np.stack([fx * x * y, -fx * (1 + x * x), fx * y], axis=1)
    return np.stack([across, np.stack([fy * (1 + y * y), -fy * x * y, -fy * x], axis=1)], axis=1)


def _curves(pixels: Array, A: Array, noise: Array, smooth: int) -> Array:
    """Coefficients of the columns of A (n, 2, k) behind the first `smooth`, which are free; the rest has a prior."""
    A, rest = A.reshape(-1, A.shape[2]), pixels.ravel()
    prior = np.diag(np.r_[np.zeros(smooth), np.full(A.shape[1] - smooth, _ROTATED**-2.0)])
    found = np.zeros(A.shape[1])
    for _ in range(_REWEIGHTED):
        square = (((rest - A @ found).reshape(-1, 2) / noise[:, None]) ** 2).sum(1)
        weight = np.repeat(1.0 / noise**2 / np.sqrt(1.0 + square / CLIP**2), 2)
        normal = (A.T * weight) @ A
        ridge = _RIDGE * float(np.trace(normal[:smooth, :smooth])) / smooth
        found = np.linalg.solve(normal + prior + ridge * np.eye(len(normal)), A.T @ (weight * rest))
    return np.asarray(found[smooth:])


def agreement_of_waves(rec: Reconstruction, sigma_px: float) -> float:
    """Correlation over photos, axes and lines of the rotations of lines that two halves of the scene show, -1 to 1.

    Beyond a smooth warp of each photo and whatever rotates as a polynomial of the clock, which other models have. Each
    axis counts by the pixels that it moves. Halves as in `half_across_readout`: a vibration rotates the whole line,
    what lens and matches leave differs. Linear, from the residuals, where a fit of each half would take many times as
    long.
    """
    obs = rec.observations
    res, valid = reprojection_residuals(rec)
    half = half_across_readout(rec)[obs.point_idx]
    smooth, rotated = warps(rec, obs), _rotated(rec, obs)
    lines = _splines_along(rec, obs, WAVES)
    low = np.polynomial.legendre.legvander(np.linspace(-1, 1, WAVES), _DEGREE)
    beyond = np.eye(WAVES) - low @ np.linalg.pinv(low)
    width = smooth.shape[1]
    both = np.zeros((2, rec.num_images, WAVES, 3))
    for side in (0, 1):
        for i, mine in enumerate(obs.by_photo(rec.num_images)):
            mine = mine[valid[mine] & (half[mine] == side)]
            A = np.zeros((len(mine), 2, 2 * width + 3 * WAVES))
            if 2 * len(mine) < A.shape[2]:
                continue
            A[:, 0, :width] = A[:, 1, width : 2 * width] = smooth[mine]
            A[:, :, 2 * width :] = np.einsum("na,nik->niak", lines[mine], rotated[mine]).reshape(len(mine), 2, -1)
            found = _curves(res[mine], A, sigma_px * obs.sigma[mine], 2 * width)
            both[side, i] = beyond @ found.reshape(WAVES, 3)
    one, other = both * np.sqrt((rotated**2).mean((0, 1)))
    scale = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return float((one * other).sum() / scale) if scale > 0 else 0.0
