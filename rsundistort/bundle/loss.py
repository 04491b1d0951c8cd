"""Robust losses of residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..model.array_types import Array

__all__ = ["LOSSES", "USUAL_SCALE", "Loss"]

#: Robust losses, with their codes in the kernels.
LOSSES: dict[str, int] = {"squared": 0, "huber": 1, "cauchy": 2, "soft-l1": 3}
#: Scale of a loss, in standard deviations of the noise, while its tails are not known.
USUAL_SCALE = 1.5


@dataclass(frozen=True)
class Loss:
    """A robust loss of residuals in units of the noise, `weight * rho`.

    Attributes
    ----------
    kind : str
        Of `LOSSES`.
    scale : float
        Length beyond which rho grows more slowly than the square.
    weight : float
        With it the mean curvature is that of squares: the loss weighs measurements against priors as squares do, and
        the inverse of the Hessian of squares is the covariance.
    """

    kind: str
    scale: float
    weight: float = 1.0

    @classmethod
    def none(cls) -> Loss:
        """Squares."""
        return cls("squared", USUAL_SCALE)

    def of_noise(self, factor: float) -> Loss:
        """The same loss of the same residuals in units of a noise that is so many times larger."""
        return replace(self, scale=self.scale / factor)

    @property
    def root(self) -> float:
        """Square root of the weight: residuals times this, with a scale as much larger, have the loss without it."""
        return float(np.sqrt(self.weight))

    def pull(self, square: Array) -> Array:
        """How much residuals of squared lengths (n,) pull, relative to squares: rho'."""
        s = square / self.scale**2
        if self.kind == "huber":
            return np.asarray(1.0 / np.sqrt(np.maximum(s, 1.0)))
        if self.kind == "cauchy":
            return np.asarray(1.0 / (1.0 + s))
        return np.asarray(1.0 / np.sqrt(1.0 + s)) if self.kind == "soft-l1" else np.ones_like(s)

    def curvature(self, square: Array) -> Array:
        """Half the trace of the Hessian of rho / 2 by the residual (n, 2): rho' + s rho''."""
        s, pull = square / self.scale**2, self.pull(square)
        if self.kind == "huber":
            return np.asarray(np.where(s > 1.0, 0.5, 1.0) * pull)
        if self.kind == "cauchy":
            return np.asarray(pull**2)
        return np.asarray(0.5 * (pull + pull**3)) if self.kind == "soft-l1" else pull
