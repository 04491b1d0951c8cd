"""The path of a camera: poses and rates at moments, and the pose at any time between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from .checks import check_finite, check_index, check_rotations, frozen
from .motion import RowMotion

__all__ = ["CameraPath", "cross_matrices", "inverse_left_jacobians"]

Array = NDArray[np.float64]

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
    """(5, n) quintic functions of u: for value, slope and curvature at 1, and for slope and curvature at 0."""
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
        Moments of different parts are not connected: between them the video was cut.
    """

    time_s: Array
    R_cw: Array
    center_w: Array
    rate: Array
    velocity: Array
    rate_change: Array
    acceleration: Array
    part: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        m = len(self.time_s)
        if not m or (np.diff(self.time_s) <= 0).any():
            raise InputError("the times of a path must ascend, and there must be one")
        part = self.part if np.size(self.part) else np.zeros(m, np.int64)
        fields = {
            "time_s": check_finite(self.time_s, (m,), "time_s"),
            "R_cw": check_rotations(self.R_cw, m, "R_cw"),
            **{name: check_finite(getattr(self, name), (m, 3), name) for name in _VECTORS},
            "part": check_index(part, m, m, "part"),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, frozen(value))

    def moved(self, R: Array, origin: Array, scale: float) -> CameraPath:
        """The same in a world where x is scale R (x - origin)."""
        return replace(
            self,
            R_cw=self.R_cw @ R.T,
            center_w=scale * (self.center_w - origin) @ R.T,
            velocity=scale * self.velocity @ R.T,
            acceleration=scale * self.acceleration @ R.T,
        )

    def near(self, moment: int, offset_s: ArrayLike) -> tuple[Array, Array]:
        """Rotation vectors and positions (n, 3) against a moment's pose, so many seconds (n,) after it.

        `Exp(rotation) R_cw` and `center_w + position`. Up to the neighbouring moments these lie on the path; beyond
        them, and where there is none, they go on as the path does there.
        """
        offset = np.atleast_1d(np.asarray(offset_s, np.float64))
        turn, way = (
            offset[:, None] * slope + 0.5 * offset[:, None] ** 2 * bend
            for slope, bend in (
                (self.rate[moment], self.rate_change[moment]),
                (self.velocity[moment], self.acceleration[moment]),
            )
        )
        for other, on_this_side in ((moment - 1, offset < 0), (moment + 1, offset > 0)):
            joined = 0 <= other < len(self.time_s) and self.part[other] == self.part[moment]
            if joined and on_this_side.any():
                turn[on_this_side], way[on_this_side] = self._towards(moment, other, offset[on_this_side])
        return turn, way

    def _towards(self, moment: int, other: int, offset: Array) -> tuple[Array, Array]:
        """As `near`, on the side of one neighbour."""
        dt = self.time_s[other] - self.time_s[moment]
        xi = Rotation.from_matrix(self.R_cw[other] @ self.R_cw[moment].T).as_rotvec()
        J = inverse_left_jacobians(xi)
        step = self.center_w[other] - self.center_w[moment]
        u = np.minimum(offset / dt, 1.0)
        weights = _hermite(u) * np.array([1.0, dt, dt**2, dt, dt**2])[:, None]
        beyond = (offset - dt * u)[:, None]

        def along(end: tuple[Array, Array, Array], start: tuple[Array, Array]) -> Array:
            within: Array = weights.T @ np.stack([*end, *start])
            return within + beyond * end[1] + 0.5 * beyond**2 * end[2]

        return (
            along(
                (xi, J @ self.rate[other], J @ self.rate_change[other]), (self.rate[moment], self.rate_change[moment])
            ),
            along(
                (step, self.velocity[other], self.acceleration[other]),
                (self.velocity[moment], self.acceleration[moment]),
            ),
        )

    def row_motion(self, moment: int, clock_range: tuple[float, float], clock_s: float) -> RowMotion:
        """The motion of a frame of the path whose principal row is read at that moment.

        Parameters
        ----------
        moment : int
            Index of the frame.
        clock_range : (start, end)
            Of its camera (`Camera.clock_range`).
        clock_s : float
            Seconds to a unit of the clock.

        Returns
        -------
        RowMotion
            In the world, against the pose at that moment. Its bend is what the path departs by from its tangent there,
            so it need not be orthogonal to 1 and to the clock.
        """
        from .bend import Bend

        clock = np.linspace(*clock_range, _SITES)
        turn, way = self.near(moment, clock * clock_s)
        phi, velocity = clock_s * self.rate[moment], clock_s * self.velocity[moment]
        bend = Bend(*clock_range, turn - clock[:, None] * phi, way - clock[:, None] * velocity)
        return RowMotion(phi, velocity, bend, "world")
