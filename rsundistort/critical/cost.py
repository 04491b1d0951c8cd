"""The cost of the weakest change of shape in a given solution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..bundle import BundleOptions, BundleResult, Posterior, gauge_directions
from ..errors import InputError
from ..model import Reconstruction
from ..model.array_types import Array
from .common import CommonMotion, common_motion
from .degeneracy import CriticalMotion, critical_motion, readout_axes

__all__ = ["ShapeCost", "shape_cost"]

# Below this standard deviation of log k no remedy is needed: half a pixel over a thousand rows.
_SMALL = 0.0005

_MAX_POWER_STEPS = 200


@dataclass(frozen=True)
class ShapeCost:
    """Uncertainty of the shape of a solution.

    Attributes
    ----------
    sigma_log_k : float
        Standard deviation of the logarithm of the scene's scale along the mean readout axis, against the other two:
        that of the points, all photos' motions being unknown.
    weakest_sigma : float
        Standard deviation along the weakest mode of the whole system: the unit vector over all photos' unknowns with
        the largest variance, other than motions of the world. Rotations and phi in radians, lengths in baselines.
    weakest_share : float
        Share of the vertical scale in that mode: square of the correlation of the two, 0 to 1.
    """

    sigma_log_k: float
    weakest_sigma: float
    weakest_share: float
    degeneracy: CriticalMotion
    common: CommonMotion

    @property
    def is_flagged(self) -> bool:
        """Whether the poses are nearly critical, and this matters here."""
        return self.degeneracy.is_low and not self.sigma_log_k <= _SMALL

    @property
    def sentence(self) -> str:
        """For people."""
        return f"{self._of_height}; {self.common.sentence}" if self.common.is_weak else self._of_height

    @property
    def _of_height(self) -> str:
        if not np.isfinite(self.sigma_log_k):
            return "the height of the scene is not determined: the measurements leave it entirely open"
        percent = 100 * self.sigma_log_k
        value = f"{percent:.2g}" if percent < 0.1 else f"{percent:.{2 if percent < 1 else 1}f}"
        said = f"the height of the scene is uncertain by +-{value} % (one standard deviation)"
        if not self.is_flagged:
            return said
        if self.degeneracy.num_photos < 3:
            return f"{said}, because two photos never separate the shutter from the shape"
        if self.degeneracy.y_axis_spread_deg < 1:
            return f"{said}, because all cameras were held level"
        if self.degeneracy.y_axis_spread_deg < 15:
            return f"{said}, because all cameras were held nearly level"
        return f"{said}, because the cameras were not rotated against each other"


def _uncertainty(reconstruction: Reconstruction) -> Array:
    """(n,) uncertainty of each point along its worst direction, in units of a ray's angle times its length.

    Large where all who see a point stand in one place, as two copies of a photo do.
    """
    rec, obs = reconstruction, reconstruction.observations
    ray = rec.points_w[obs.point_idx] - rec.center_w[obs.frame_idx]
    square = np.maximum((ray**2).sum(1), 1e-300)[:, None, None]
    across = (np.eye(3) - ray[:, :, None] * ray[:, None, :] / square) / square
    information = np.zeros((rec.num_points, 3, 3))
    np.add.at(information, obs.point_idx, across)
    least = np.linalg.eigvalsh(information)[:, 0]
    return np.asarray(1.0 / np.sqrt(np.maximum(least, 1e-24 * np.maximum(np.median(least), 1e-300))))


def _log_scale(reconstruction: Reconstruction) -> Array:
    """(n, 3) the logarithm of the scene's scale along the axis of readout, as a linear function of small changes.

    Of the affine map B that takes the points to the changed ones best: log |B y| - log sqrt(det B / |B y|). Far points
    hardly count, their own noise is larger than the scene, nor do points that were seen from one place only.
    """
    rec = reconstruction
    axes = readout_axes(rec.R_cw, [rec.camera(i).readout for i in range(rec.num_images)])
    vertical = np.linalg.eigh(axes.T @ axes)[1][:, -1]
    x = rec.points_w - np.median(rec.points_w, axis=0)
    distance = np.linalg.norm(x, axis=1)
    weight = np.minimum(1.0, (np.median(distance) / np.maximum(distance, 1e-300)) ** 4)
    uncertainty = _uncertainty(rec)
    weight *= np.minimum(1.0, (np.median(uncertainty) / uncertainty) ** 2)
    x = rec.points_w - np.average(rec.points_w, axis=0, weights=weight)
    g = weight[:, None] * x @ np.linalg.pinv((weight[:, None] * x).T @ x)
    return 1.5 * (g @ vertical)[:, None] * vertical - 0.5 * g


def shape_cost(result: BundleResult, options: BundleOptions | None = None) -> ShapeCost:
    """Uncertainty of the shape of a solution, from its covariance and its poses.

    Parameters
    ----------
    result : BundleResult
        Of a model with a shutter.
    options : BundleOptions, optional
        Of the adjustment: its constraints, known motions and refined intrinsics count.

    Raises
    ------
    InputError
        The shutter model is global: its shape is not in question.
    """
    rec = result.reconstruction
    if rec.shutter_model == "global":
        raise InputError("a global shutter has no motion that could be confounded with the shape of the scene")
    covariance = Posterior(result, options)
    variance, with_photos = covariance.of_points(_log_scale(rec))
    # lengths in baselines: angles, phi and lengths are then of one size
    unit = np.ones(with_photos.shape[1])
    unit[3:6] = unit[9:] = rec.baseline
    basis = np.linalg.qr((gauge_directions(result) / unit).reshape(7, -1).T)[0]

    def free(x: Array) -> Array:
        return (x.ravel() - basis @ (basis.T @ x.ravel())).reshape(with_photos.shape)

    # power iterations with the covariance in the gauge of least variance: P C P, P projecting off motions of the world
    x = free(with_photos / unit)
    value = 0.0
    for _ in range(_MAX_POWER_STEPS):
        y = free(covariance.of_photos((x / unit)[None])[0] / unit)
        before, value = value, float(np.linalg.norm(y) / np.linalg.norm(x))
        x = y / np.linalg.norm(y)
        if not abs(value - before) > 1e-4 * value:
            break
    share = float((x * with_photos / unit).sum()) ** 2 / (variance * value)
    readout = [rec.camera(i).readout for i in range(rec.num_images)]
    return ShapeCost(
        sigma_log_k=float(np.sqrt(variance)),
        weakest_sigma=float(np.sqrt(value)),
        weakest_share=float(min(share, 1.0)),
        degeneracy=critical_motion(rec.R_cw, rec.center_w, readout),
        common=common_motion(result, options, covariance),
    )
