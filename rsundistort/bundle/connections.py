"""What connects photos in the normal equations beside the points that they see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..model.array_types import Array, Index
from .structure import BlockPattern

__all__ = ["Border", "CommonPrior", "Coupling"]


@dataclass(frozen=True)
class Border:
    """Intrinsics that photos share: nc unknowns of each camera.

    Attributes
    ----------
    J : (o, 2, nc) array
        Weighted Jacobians of the observations, nc may be 0.
    camera_of_frame : (m,) int array
        Camera of each photo.
    prior_diag, prior_gradient : (cameras, nc) array
        Diagonal Hessian and gradient of the priors of the cameras.
    """

    J: Array
    camera_of_frame: Index
    prior_diag: Array
    prior_gradient: Array

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return len(self.prior_diag)

    def sum_photos(self, x: Array) -> Array:
        """Values of the photos (m, nc, ...) summed over those of each camera, (cameras * nc, ...)."""
        total = np.zeros((self.num_cameras, *x.shape[1:]))
        np.add.at(total, self.camera_of_frame, x)
        return total.reshape(self.num_cameras * x.shape[1], *x.shape[2:])


@dataclass(frozen=True)
class Coupling:
    """Residuals of a prior that connects pairs of photos, q pairs of r residuals.

    Attributes
    ----------
    first, second : (q,) int array
        The photos.
    res : (q, r) array
        Residuals in their standard deviations.
    J_first, J_second : (q, r, nb) array
        Their Jacobians.
    """

    first: Index
    second: Index
    res: Array
    J_first: Array
    J_second: Array

    def pull(self, residuals: Array, num_photos: int) -> Array:
        """J' times residuals (q, r): (m, nb)."""
        total = np.zeros((num_photos, self.J_first.shape[2]))
        for photo, J in ((self.first, self.J_first), (self.second, self.J_second)):
            np.add.at(total, photo, np.einsum("qra,qr->qa", J, residuals))
        return total

    def times(self, frame: Array) -> Array:
        """J'J times photos' values (..., m, nb)."""
        total = np.zeros_like(frame)
        moved = np.einsum("qra,...qa->...qr", self.J_first, frame[..., self.first, :])
        moved += np.einsum("qra,...qa->...qr", self.J_second, frame[..., self.second, :])
        for photo, J in ((self.first, self.J_first), (self.second, self.J_second)):
            pulled = np.einsum("qra,...qr->...qa", J, moved)
            np.add.at(np.moveaxis(total, -2, 0), photo, np.moveaxis(pulled, -2, 0))
        return total

    def diagonal(self, num_photos: int) -> Array:
        """Diagonal (m, nb) of J'J."""
        total = np.zeros((num_photos, self.J_first.shape[2]))
        for photo, J in ((self.first, self.J_first), (self.second, self.J_second)):
            np.add.at(total, photo, (J**2).sum(1))
        return total

    def add_to(self, S: Array, pattern: BlockPattern, scale: float = 1.0) -> None:
        """Add J'J to the blocks (blocks, nb, nb) of the photos' system, in place."""
        below = self.first > self.second  # only blocks above the diagonal are kept
        across = scale * np.einsum("qra,qrb->qab", self.J_first, self.J_second)
        np.add.at(
            S, pattern.find(self.first, self.second), np.where(below[:, None, None], across.transpose(0, 2, 1), across)
        )
        for photo, J in ((self.first, self.J_first), (self.second, self.J_second)):
            np.add.at(S, pattern.diagonal[photo], scale * np.einsum("qra,qrb->qab", J, J))


class CommonPrior(NamedTuple):
    """What the normal equations take of priors whose means photos share: weights (m, nb), derivatives (m, nb, h).

    The residual of an unknown x of a photo is sqrt(weight) (x - derivative mean), of its camera's h means.
    """

    weight: Array
    J: Array
