"""The path of a camera: poses and rates at moments, and the pose at any time between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..errors import InputError
from .array_types import Array, Index
from .checks import check_finite, check_index, check_rotations, frozen

__all__ = ["CameraPath", "cross_matrices", "inverse_left_jacobians"]


# Sites of the bend that a frame gets from the path: cubics on both sides of the principal row.
_SITES = 17
_VECTORS = ("center_w", "rate", "velocity", "rate_change", "acceleration")


def cross_matrices(x: Array) -> Array:
    """(..., 3, 3) matrices [x] of vectors (..., 3): [x] y = x x y."""
    zero = np.zeros(x.shape[:-1])
    rows = [[zero, -x[..., 2], x[..., 1]], [x[..., 2], zero, -x[..., 0]], [-x[..., 1], x[..., 0], zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def inverse_left_jacobians(xi: Array) -> Array:
    """(..., 3, 3) inverse left Jacobians of SO(3): log(Exp(d) Exp(xi)) = xi + J d (Barfoot 2017, Eq. 7.76)."""
    angle2 = np.einsum("...a,...a->...", xi, xi)
    small = angle2 < 1e-4
    angle = np.sqrt(np.where(small, 1.0, angle2))
    exact = 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    factor = np.where(small, 1.0 / 12.0 + angle2 / 720.0, exact)
    X = cross_matrices(xi)
    return np.eye(3) - 0.5 * X + factor[..., None, None] * (X @ X)


def _hermite(u: Array) -> Array:
    """(5, ...) quintic functions of u: for value, slope and curvature at 1, and for slope and curvature at 0."""
    v = 1 - u
    return np.stack(
        [
            u**3 * (10 - 15 * u + 6 * u**2),
            -(u**3) * v * (4 - 3 * u),
            0.5 * u**3 * v**2,
            u * v**3 * (1 + 3 * u),
            0.5 * u**2 * v**3,
        ]
    )


@dataclass(frozen=True)
class CameraPath:
    """Poses and rates of a camera at m moments.

    Between two moments the path is the polynomial of the fifth degree, in the rotation vector and in the position, that
    the poses, rates and accelerations of both fix: the mean of a path whose acceleration changes by white noise.

    Parameters
    ----------
    time_s : (m,) array
        Ascending.
    R_cw, center_w : (m, 3, 3), (m, 3) array
        `x_c = R_cw (X_w - center_w)`.
    rate : (m, 3) array
        Radians per second, in the camera frame: `dR_cw / dt = [rate] R_cw`.
    velocity : (m, 3) array
        World units per second, in the world.
    rate_change, acceleration : (m, 3) array
        How fast rate and velocity change, per second.
    part : (m,) int array, optional
        Moments of different parts are not connected: between them the video was cut. Any numbers, as some parts of a
        video may have no moment here.
    """

    time_s: Array
    R_cw: Array
    center_w: Array
    rate: Array
    velocity: Array
    rate_change: Array
    acceleration: Array
    part: Index = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        m = len(self.time_s)
        if not m or (np.diff(self.time_s) <= 0).any():
            raise InputError("the times of a path must ascend, and there must be one")
        part = self.part if np.size(self.part) else np.zeros(m, np.int64)
        fields = {
            "time_s": check_finite(self.time_s, (m,), "time_s"),
            "R_cw": check_rotations(self.R_cw, m, "R_cw"),
            **{name: check_finite(getattr(self, name), (m, 3), name) for name in _VECTORS},
            "part": check_index(part, m, np.iinfo(np.int64).max, "part"),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, frozen(value))

    def moved(self, R: Array, origin: Array, scale: float) -> CameraPath:
        """The path in a world where x is scale R (x - origin)."""
        return replace(
            self,
            R_cw=self.R_cw @ R.T,
            center_w=scale * (self.center_w - origin) @ R.T,
            velocity=scale * self.velocity @ R.T,
            acceleration=scale * self.acceleration @ R.T,
        )

    def around(self, moments: Index, offset: Array) -> tuple[Array, Array]:
        """Rotation vectors and positions (k, n, 3) against poses at moments (k,), so many seconds (n,) after each.

        `Exp(rotation) R_cw` and `center_w + position`. Up to the neighbouring moments these lie on the path; beyond
        them, and where there is none, they go on as the path does there.
        """
        rotation, way = (
            offset[:, None] * slope[moments, None] + 0.5 * offset[:, None] ** 2 * bend[moments, None]
            for slope, bend in ((self.rate, self.rate_change), (self.velocity, self.acceleration))
        )
        for step, on_this_side in ((-1, offset < 0), (1, offset > 0)):
            other = np.clip(moments + step, 0, len(self.time_s) - 1)
            joined = (other != moments) & (self.part[other] == self.part[moments])
            if joined.any() and on_this_side.any():
                there = np.ix_(joined, on_this_side)
                rotation[there], way[there] = self._towards(moments[joined], other[joined], offset[on_this_side])
        return rotation, way

    def _towards(self, moments: Index, others: Index, offset: Array) -> tuple[Array, Array]:
        """`around` on the side of one neighbour of each moment."""
        dt = self.time_s[others] - self.time_s[moments]
        xi = Rotation.from_matrix(self.R_cw[others] @ self.R_cw[moments].transpose(0, 2, 1)).as_rotvec()
        J = inverse_left_jacobians(xi)
        step = self.center_w[others] - self.center_w[moments]
        u = np.minimum(offset / dt[:, None], 1.0)
        weights = _hermite(u) * np.stack([np.ones_like(dt), dt, dt**2, dt, dt**2])[:, :, None]
        beyond = (offset - dt[:, None] * u)[:, :, None]

        def along(end: tuple[Array, Array, Array], start: tuple[Array, Array]) -> Array:
            within: Array = np.einsum("fkn,fka->kna", weights, np.stack([*end, *start]))
            return within + beyond * end[1][:, None] + 0.5 * beyond**2 * end[2][:, None]

        return (
            along(
                (xi, *(np.einsum("kab,kb->ka", J, each[others]) for each in (self.rate, self.rate_change))),
                (self.rate[moments], self.rate_change[moments]),
            ),
            along(
                (step, self.velocity[others], self.acceleration[others]),
                (self.velocity[moments], self.acceleration[moments]),
            ),
        )

    def row_motions(
        self, moments: ArrayLike, clock_range: tuple[float, float], clock_s: float
    ) -> tuple[Array, Array, Array]:
        """Motions of frames of the path whose principal rows are read at these moments.

        Parameters
        ----------
        moments : (k,) int array
            Indices of the frames.
        clock_range : (start, end)
            Of their camera (`Camera.clock_range`).
        clock_s : float
            Seconds to a unit of the clock.

        Returns
        -------
        phi, velocity : (k, 3) array
            Radians, and world units in the world, per unit of the clock, against the poses at these moments.
        bend : (k, n, 6) array
            Rotation and position, at even readings of the clock, by which the path departs from its tangents there, so
            that they need not be orthogonal to 1 and to the clock.
        """
        chosen = np.asarray(moments, np.int64)
        clock = np.linspace(*clock_range, _SITES)
        rotation, way = self.around(chosen, clock * clock_s)
        phi, velocity = clock_s * self.rate[chosen], clock_s * self.velocity[chosen]
        bend = np.concatenate(
            [rotation - clock[:, None] * phi[:, None], way - clock[:, None] * velocity[:, None]], axis=2
        )
        return phi, velocity, bend
