"""The points' own blocks of the normal equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._kernels import schur
from ..model.array_types import Array, Index
from .structure import Structure

__all__ = ["PointTerms", "largest_step", "moved_points", "nearest_photos"]


# A step takes a point to so many times its distance at most: one that asks for more wants it at infinity, or beyond.
_FURTHEST = 10.0


def nearest_photos(points_w: Array, center_w: Array, structure: Structure) -> Index:
    """(n,) the photo nearest to each point of a structure, of those that measured it."""
    away = np.linalg.norm(points_w[structure.point_idx] - center_w[structure.frame_idx], axis=1)
    least = np.minimum.reduceat(away, structure.track_start[:-1])
    nearest = np.flatnonzero(away == least[structure.point_idx])
    first = np.searchsorted(structure.point_idx[nearest], np.arange(len(least)))
    return structure.frame_idx[nearest[first]]


def moved_points(points_w: Array, steps: Array, center_w: Array) -> Array:
    """Points (n, 3) after steps, to first order X + step, that change the direction from a centre and inverse distance.

    Rays of little parallax tell inverse depth, and that with normal errors; a step of the depth itself would take such
    points through the centre, to behind the camera (Civera et al., "Inverse depth parametrization", 2008).
    """
    away = points_w - center_w
    along = np.einsum("na,na->n", steps, away) / np.maximum(np.einsum("na,na->n", away, away), 1e-300)
    along = along[:, None]
    return center_w + (away + steps - along * away) / np.maximum(1.0 - along, 1.0 / _FURTHEST)


def largest_step(points_w: Array, steps: Array, middle_w: Array, size: float) -> float:
    """Largest step of points (n, 3) in sizes of the scene, or in their own distance from its middle if that is larger.

    A far point moves a lot along its ray without moving in any photo.
    """
    far = points_w - middle_w
    distance = np.maximum(np.sqrt(np.einsum("na,na->n", far, far)), size)
    return float((np.abs(steps) / distance[:, None]).max(initial=0))


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
