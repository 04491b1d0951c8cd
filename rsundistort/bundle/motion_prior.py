"""The prior of what each photo's motion has of its own: Student's t, since hands hold still, and sometimes jerk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask
from .bundle_options import BundleOptions

__all__ = ["SIGMA_OF_SCALE", "MotionPrior", "tail_weight"]


# Degrees of freedom. Under a normal prior of an estimated width one photo that jerked draws all others the other way,
# by what photos hardly show of the motion that they share. Of eight photos, a mean that only the prior decides is wrong
# by 1.07 times as much as with a normal prior if motions are normal, by a third if each has a size of its own, and by a
# fiftieth if one was bumped (tests/test_motion_prior.py).
_FREEDOM = 4.0
#: Standard deviation of normal motions of which a scale of 1 is estimated (the same tests).
SIGMA_OF_SCALE = 1.15


def tail_weight(square: Array, num: int | Index = 3) -> Array:
    """Weights of normal priors that pull as Student's t does.

    Parameters
    ----------
    square : (...) array
        Squared deviations in units of the scale, summed over `num` components.
    """
    return (_FREEDOM + num) / (_FREEDOM + square)


@dataclass(frozen=True)
class MotionPrior:
    """Priors on rotations, and on velocities, of photos beside the mean; their three components are one deviation.

    Attributes
    ----------
    precision : (m, k) array
        Of the scale, per unit of the clock; k is 0, 3 or 6.
    limit : (m, k) array
        Precision of what limits a motion besides, a normal density; 0 where nothing does.
    has_tails : (k / 3,) bool array
        Whether the prior is Student's t; else it is normal.
    """

    precision: Array
    limit: Array
    has_tails: Mask

    @classmethod
    def of(
        cls, reconstruction: Reconstruction, options: BundleOptions, phi_sigma: float, velocity_sigma: float, num: int
    ) -> MotionPrior:
        """Those of `num` unknowns of a photo, of standard deviations per frame, with the photos' own limits.

        A standard deviation that is given is that of a normal prior.
        """
        m, kinds = reconstruction.num_images, num // 3
        if options.path is not None:  # which says it all
            return cls(np.zeros((m, num)), np.zeros((m, num)), np.zeros(kinds, bool))
        most = np.array([options.phi_limits.get(name, np.inf) for name in reconstruction.image_names])
        bounded = np.isfinite(most) & (num > 3)
        depths = [reconstruction.median_depth(i) if each else 1.0 for i, each in enumerate(bounded)]
        sigmas = np.full((m, 2), [phi_sigma, velocity_sigma]), np.stack([most, most * depths], axis=1)
        span = reconstruction.frame_span()[:, None]
        precision, limit = (np.repeat((span / each) ** 2, 3, axis=1)[:, :num] for each in sigmas)
        estimated = np.array([options.phi_sigma is None, options.velocity_sigma is None])
        return cls(precision, limit, estimated[:kinds])

    def weight(self, own: Array) -> Array:
        """Weights (m, k) that draw deviations (m, k) from the mean as the prior does."""
        return self.precision * np.repeat(self._tails(own), 3, axis=1) + self.limit

    def information(self, own: Array) -> Array:
        """(m, k) what the prior tells of motions, or of their mean, at deviations (m, k).

        Student's t tells less than its weights say, by Fisher's information: the weights depend on what they weigh.
        """
        return self.precision * np.repeat(self.relative_information(own), 3, axis=1) + self.limit

    def relative_information(self, own: Array) -> Array:
        """(m, k / 3) information by that of a normal prior of the same scale, without limits."""
        return np.where(self.has_tails, (_FREEDOM + 3) / (_FREEDOM + 5), 1.0) * self._tails(own)

    def _tails(self, own: Array) -> Array:
        return np.where(self.has_tails, tail_weight(self._squares(own)), 1.0)

    def cost(self, own: Array) -> float:
        """Minus the log of the density of deviations (m, k), but for a constant."""
        square = self._squares(own)
        tails = (_FREEDOM + 3) * np.log1p(square / _FREEDOM)
        return 0.5 * float(np.where(self.has_tails, tails, square).sum() + (self.limit * own**2).sum())

    def _squares(self, own: Array) -> Array:
        """(m, k / 3) in units of the scale."""
        return (self.precision * own**2).reshape(len(own), -1, 3).sum(axis=2)
