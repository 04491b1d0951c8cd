"""The points' own blocks of the normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .._kernels import schur

__all__ = ["PointTerms"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class PointTerms:
    """What is known of points beside their measurements.

    Attributes
    ----------
    lengths : tuple of (q,) and (q, n, 3) arrays
        Residuals on few points and their Jacobian.
    rays : (n, 3) array, optional
        Directions along which no point moves, where all photos are taken from one place.
    places : tuple of (k,), (k, 3) and (k, 3) arrays, optional
        Points with a prior of their own, its diagonal Hessian and its gradient.
    """

    lengths: tuple[Array, Array]
    rays: Array | None = None
    places: tuple[Index, Array, Array] | None = None

    def blocks(self, track_start: Index, res: Array, J: Array) -> tuple[Array, Array]:
        """Hessians (n, 3, 3), without those of lengths, which connect points, and gradients (n, 3).

        Parameters
        ----------
        track_start : (n + 1,) int array
            Ranges of the points in the measurements.
        res, J : (o, 2), (o, 2, >= 6) array
            Weighted residuals, and Jacobians of which 3 to 5 are by the photos' centres: minus those by the points.
        """
        n = len(track_start) - 1
        V, g = np.empty((n, 3, 3)), np.empty((n, 3))
        schur.point_blocks(track_start, res, J, V, g)
        if self.rays is not None:
            # any weight holds what nothing pulls at
            unit = self.rays / np.linalg.norm(self.rays, axis=1)[:, None]
            weight = np.trace(V, axis1=1, axis2=2)[:, None, None]
            V += weight * unit[:, :, None] * unit[:, None]
        if self.places is not None:
            V[self.places[0][:, None], np.arange(3), np.arange(3)] += self.places[1]
            g[self.places[0]] += self.places[2]
        g += np.einsum("q,qna->na", *self.lengths)
        return V, g

    def steps(self, track_start: Index, res: Array, J: Array) -> Array:
        """Gauss-Newton steps (n, 3) of the points alone, the photos being held; see `blocks`."""
        V, g = self.blocks(track_start, res, J)
        V_inv = np.empty_like(V)
        schur.invert_points(V, 0.0, V_inv)
        return -np.einsum("nij,nj->ni", V_inv, g)
