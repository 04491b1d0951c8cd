"""Known positions: of photos, by GPS, and of points on the ground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..model import ControlPoint, Reconstruction
from ..model.array_types import Array, Index
from .intrinsics import prior_weight

__all__ = ["KnownPlaces", "PlaceResiduals", "point_of", "stacked"]


# Photos and points that must have a place for these to hold a frame.
_LEAST = 3


@dataclass(frozen=True)
class KnownPlaces:
    """Places in the frame of the reconstruction, which they hold: it must be near to it.

    Parameters
    ----------
    photos : mapping of photo name to (center_w, sigma)
        Places of cameras and their standard deviations along the axes of the world, (3,) each. Their tails are heavy,
        as those of a prior on a camera: a GPS that was off by far is given up.
    points : sequence of ControlPoint
        Points of the reconstruction, identified by one of their measurements; check points hold nothing. Places are in
        the frame of the reconstruction, too.
    velocities : mapping of photo name to (velocity, sigma)
        Of cameras, (3,) each, world units per unit of the clock.
    """

    photos: Mapping[str, tuple[ArrayLike, ArrayLike]]
    points: Sequence[ControlPoint] = ()
    velocities: Mapping[str, tuple[ArrayLike, ArrayLike]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, (place, sigma) in (*self.photos.items(), *self.velocities.items()):
            values, sigmas = np.asarray(place, np.float64), np.asarray(sigma, np.float64)
            if values.shape != (3,) or not np.isfinite(values).all():
                raise InputError(f"known place or velocity of {name!r}: {place!r}, expected three finite numbers")
            if sigmas.shape != (3,) or not ((sigmas > 0) & (sigmas < np.inf)).all():
                raise InputError(
                    f"known place or velocity of {name!r}: sigma {sigma!r}, expected three positive numbers"
                )

    def __bool__(self) -> bool:
        return bool(self.photos) or any(not point.is_check for point in self.points)


def point_of(reconstruction: Reconstruction, control: ControlPoint) -> int | None:
    """The point of a reconstruction of a control point, by a measurement that is no outlier."""
    obs = reconstruction.observations
    for name, xy in control.seen.items():
        if name in reconstruction.image_names:
            mine = obs.frame_idx == reconstruction.image_names.index(name)
            same = np.flatnonzero(mine & (np.abs(obs.xy_raw - xy) < 1e-9).all(1))
            if len(same):
                return int(obs.point_idx[same[0]])
    return None


class PlaceResiduals:
    """Residuals of known places in a state: of centres and of points in their standard deviations.

    Fewer than three places hold no frame, and say nothing.

    Attributes
    ----------
    holds_frame : bool
        Whether the gauge is theirs.
    moving : (k,) int array
        Photos whose velocity is known.
    velocity, velocity_sigma : (k, 3) array
        That, and its standard deviation.
    """

    def __init__(self, reconstruction: Reconstruction, known: KnownPlaces) -> None:
        index = {name: i for i, name in enumerate(reconstruction.image_names)}
        photos = {index[name]: each for name, each in known.photos.items() if name in index}
        controls = {point_of(reconstruction, each): each for each in known.points if not each.is_check}
        points = {k: each for k, each in controls.items() if k is not None}
        self.holds_frame = len(photos) + len(points) >= _LEAST
        if not self.holds_frame:
            photos, points = {}, {}
        self._photo: Index = np.array(list(photos), np.int64)
        self._point: Index = np.array(list(points), np.int64)
        velocities = {
            index[name]: each for name, each in known.velocities.items() if name in index and self.holds_frame
        }
        self.moving: Index = np.array(list(velocities), np.int64)
        self.velocity, self.velocity_sigma = stacked([*velocities.values()])
        self._center, self._photo_sigma = stacked([(place, sigma) for place, sigma in photos.values()])
        self._place, self._point_sigma = stacked([(each.place_m, each.sigma_m) for each in points.values()])

    def cost(self, center_w: Array, points_w: Array) -> float:
        """Their cost."""
        costs = prior_weight((self._of_photos(center_w) ** 2).sum(1))[0]
        return float(costs.sum()) + 0.5 * float((self._of_points(points_w) ** 2).sum())

    def on_photos(self, center_w: Array) -> tuple[Array, Array]:
        """Diagonal Hessian and gradient (m, 3) by the centres; a place that is far off has little weight."""
        residual = self._of_photos(center_w)
        weight = prior_weight((residual**2).sum(1))[1][:, None]
        diagonal, gradient = np.zeros((2, len(center_w), 3))
        diagonal[self._photo] = weight / self._photo_sigma**2
        gradient[self._photo] = weight * residual / self._photo_sigma
        return diagonal, gradient

    def on_points(self, points_w: Array) -> tuple[Index, Array, Array]:
        """Points (k,) that have a place, with the diagonal Hessian and the gradient (k, 3) by them."""
        return self._point, self._point_sigma**-2.0, self._of_points(points_w) / self._point_sigma

    def _of_photos(self, center_w: Array) -> Array:
        return (center_w[self._photo] - self._center) / self._photo_sigma

    def _of_points(self, points_w: Array) -> Array:
        return (points_w[self._point] - self._place) / self._point_sigma


def stacked(pairs: Sequence[tuple[ArrayLike, ArrayLike]]) -> tuple[Array, Array]:
    """Values and standard deviations, (k, 3) each."""
    values = np.array([place for place, _ in pairs], np.float64).reshape(-1, 3)
    return values, np.array([sigma for _, sigma in pairs], np.float64).reshape(-1, 3)
