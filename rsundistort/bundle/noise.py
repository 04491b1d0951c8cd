"""The noise of measurements, and the robust loss that suits its tails, both from the residuals of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array
from ..model.reprojection import reprojection_residuals
from .bundle_options import BundleOptions
from .loss import Loss

__all__ = ["noise_and_loss"]

# Scales that are compared. The residuals of real photos ask for still smaller ones, to which they owe a part of their
# tails: warped photos then have the same errors, and take half as many steps again.
_SCALES = np.geomspace(1.0, 30.0, 48)
# Quantiles that stand for all residuals.
_QUANTILES = 2048


def noise_and_loss(reconstruction: Reconstruction, shutter_model: str, options: BundleOptions) -> tuple[float, Loss]:
    """Robust standard deviation of the noise's parts in pixels, of measurements whose relative sigma is 1; or as given.

    And the loss: of soft L1 with the most likely scale, unless it is given. Its density exp(-rho / 2) is the hyperbolic
    distribution (Barndorff-Nielsen, "Exponentially decreasing distributions for the logarithm of particle size", 1977):
    of two components, with the noise's own scale c / k beside that of the loss c,

        p(r) = exp(k^2 - k^2 sqrt(1 + r^2 / c^2)) k^4 / (2 pi c^2 (1 + k^2))

    which is normal for a large k, and has exponential tails for a small one: features of photos have k = 0.7 to 0.9.
    """
    loss = options.usual_loss
    res, valid = reprojection_residuals(reconstruction, shutter_model)
    if not valid.any():
        return max(1.0, options.min_sigma_px), loss
    res = (res / reconstruction.observations.sigma[:, None])[valid]
    bends = max(reconstruction.bend.shape[1] - 2, 0)
    unknowns = (9 + 3 * bends) * reconstruction.num_images + 3 * reconstruction.num_points
    # median of |x| of a normal variable is 0.6745 sigma; residuals of a fit are shorter than the noise
    shrink = np.sqrt(max(1.0 - unknowns / (2.0 * len(valid)), 0.1))
    sigma = max(float(np.median(np.abs(res))) / 0.6745 / shrink, options.min_sigma_px)
    sigma_px = options.sigma_px or sigma
    square = (res**2).sum(1) / (shrink * sigma_px) ** 2
    if loss.kind == "soft-l1" and options.loss_scale is None:
        unit = sigma / sigma_px
        loss = replace(loss, scale=unit * _most_likely_scale(square / unit**2))
    return sigma_px, replace(loss, weight=1.0 / float(loss.curvature(square).mean()))


def _most_likely_scale(square: Array) -> float:
    """The scale c of the hyperbolic distribution with the largest likelihood of squared lengths (n,).

    For each c the best q = k^2 has a closed form: with m the mean of sqrt(1 + r^2 / c^2) - 1, where the derivative of
    q m - log(q^2 / (1 + q)) vanishes.
    """
    # of sorted values: np.quantile selects each of so many quantiles
    at = (np.arange(_QUANTILES) + 0.5) / _QUANTILES * (len(square) - 1)
    square = np.interp(at, np.arange(len(square)), np.sort(square))
    m = np.maximum((np.sqrt(1.0 + square / _SCALES[:, None] ** 2) - 1.0).mean(1), 1e-9)  # of exact measurements, 0
    q = (1.0 - m + np.sqrt((1.0 - m) ** 2 + 8.0 * m)) / (2.0 * m)
    return float(_SCALES[np.argmin(q * m - np.log(q**2 / (1.0 + q)) + 2.0 * np.log(_SCALES))])
