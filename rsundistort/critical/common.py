"""Motions that all photos share and that measurements hardly determine: nodding against rising, and the like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..bundle import BundleOptions, BundleResult, Posterior
from ..model import Reconstruction
from ..model.array_types import Array, Index
from ..model.projection import clock_of

__all__ = ["CommonMotion", "clock_contrast", "common_motion", "row_phi"]

# Above this contrast of the clocks photos determine a common motion as well as others; as the limit of the measure.
_LOW = 0.15
# Half a pixel from the first row to the last, root mean square: less needs no remedy.
_SMALL_PX = 0.5 / np.sqrt(12.0)
# Of a photo's axes right, down and ahead.
_ROTATIONS, _WAYS = ("nodding", "panning", "rolling"), ("going sideways", "rising", "going ahead")
# Directions that are searched together; the weakest converges sooner.
_BLOCK = 4
_MOST_STEPS = 100


@dataclass(frozen=True)
class CommonMotion:
    """Uncertainty of the part of the motions that the photos share.

    Motions are in each photo's row frame: phi1, phi2 and phi3 of the paper in radians per frame, then, if the model has
    it, the velocity across the readout, along it and ahead in baselines per frame (k = 3 or 6).

    Attributes
    ----------
    covariance : (k, k) array
        Of the mean of the motions over the photos.
    weakest : (m, k) array
        One standard deviation of the change of motions whose uncertainty displaces the rectified photos most.
    shift_px : float
        Its displacement, root mean square over all measurements.
    shares : (k,) array
        Displacement by each of its components alone, as a share of all of them.
    contrast : float
        As of `clock_contrast`.
    by_column : bool
        Whether most photos were read out by columns.
    """

    covariance: Array
    weakest: Array
    shift_px: float
    shares: Array
    contrast: float
    by_column: bool

    @property
    def of_travel(self) -> bool:
        """Whether the model has a velocity."""
        return len(self.shares) > 3

    @property
    def sigma(self) -> Array:
        """(k,) standard deviations of the mean motion."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def correlation(self) -> Array:
        """(k, k) correlations of the mean motion."""
        sigma = np.maximum(self.sigma, 1e-300)
        return self.covariance / sigma[:, None] / sigma

    def as_json(self) -> dict[str, Any]:
        """Its content of `solution.json`."""
        return {
            "sigma_phi_rad_per_frame": self.sigma[:3].tolist(),
            "sigma_velocity_baselines_per_frame": self.sigma[3:].tolist(),
            "correlation": self.correlation.tolist(),
            "weakest": np.sqrt(np.mean(self.weakest**2, axis=0)).tolist(),
            "shift_px": self.shift_px,
            "clock_contrast": self.contrast,
            "weak": self.is_weak,
            "sentence": self.sentence,
        }

    @property
    def is_weak(self) -> bool:
        """Whether the photos' clocks hardly differ, so that little tells a common motion, and it matters here."""
        return self.of_travel and self.contrast < _LOW and not self.shift_px <= _SMALL_PX

    @property
    def sentence(self) -> str:
        """For people."""
        if not np.isfinite(self.shift_px):
            return "how the camera moved is not determined: the measurements leave it entirely open"
        amount = np.sqrt(np.mean(self.weakest**2, axis=0))
        rotation = int(np.argmax(self.shares[:3]))
        swap = [1, 0, 2] if self.by_column else [0, 1, 2]
        left = (
            f"in all photos together phi{rotation + 1} is uncertain by +-{1e3 * amount[rotation]:.2g} mrad a frame, "
            f"which is {self.shift_px:.2g} px in the rectified photos (one standard deviation)"
        )
        if not self.of_travel:
            return f"{_ROTATIONS[swap[rotation]]} is known worst: {left}"
        way = int(np.argmax(self.shares[3:]))
        how = "can hardly be distinguished" if self.is_weak else "are distinguished worst"
        return f"{_ROTATIONS[swap[rotation]]} and {_WAYS[swap[way]]} {how}: {left}"


def row_phi(reconstruction: Reconstruction) -> Index:
    """Components (m, 3) of phi that are each photo's phi1, phi2, phi3 of the paper, which reads rows."""
    by_row = np.array([reconstruction.camera(i).clock_axis == 1 for i in range(reconstruction.num_images)])
    return np.where(by_row[:, None], [0, 1, 2], [1, 0, 2]).astype(np.int64)


def _row_motion(rec: Reconstruction, nb: int) -> tuple[Array, Array]:
    """Derivatives (m, k, nb) of the motions in the row frame, and (m, nb - 6, k) those of the unknowns of them."""
    m, k = rec.num_images, nb - 6
    span, order = rec.frame_span(), row_phi(rec)
    forward, back = np.zeros((m, k, nb)), np.zeros((m, k, k))
    for i in range(m):
        sign = rec.camera(i).clock_sign
        by_rows = np.diag([1.0, 1.0, sign]) * sign
        rotation = by_rows if order[i, 0] == 0 else np.array([[0.0, -sign, 0.0], [sign, 0.0, 0.0], [0.0, 0.0, 1.0]])
        forward[i, :3, 6:9] = span[i] * rotation
        back[i, :3, :3] = rotation.T / span[i]
        if k > 3:
            # the velocity in the camera: it changes with the pose, too
            v = rec.R_cw[i] @ rec.velocity[i]
            across = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
            scale = span[i] / rec.baseline
            forward[i, 3:, 9:] = scale * rotation @ rec.R_cw[i]
            forward[i, 3:, :3] = -scale * rotation @ across
            back[i, 3:, 3:] = rec.R_cw[i].T @ rotation.T / scale
    return forward, back


def common_motion(
    result: BundleResult, options: BundleOptions | None = None, posterior: Posterior | None = None
) -> CommonMotion:
    """Uncertainty of the part of the motions that photos share, from the covariance of a solution with a shutter."""
    rec = result.reconstruction
    m, nb = result.covariances.shape[:2]
    forward, back = _row_motion(rec, nb)
    mean = forward.transpose(1, 0, 2) / m
    posterior = posterior or Posterior(result, options)
    covariance = np.einsum("imb,jmb->ij", mean, posterior.of_photos(mean))
    # motions in units of the displacement that they cause: `half` takes them there
    squares = np.einsum("mai,mab,mbj->mij", back, posterior.squared_shifts(), back)
    ridge = 1e-12 * np.trace(squares, axis1=1, axis2=2)[:, None, None] * np.eye(nb - 6) + 1e-300 * np.eye(nb - 6)
    half = np.linalg.cholesky(squares + ridge).transpose(0, 2, 1)
    seen = half @ forward

    def spread(x: Array) -> Array:
        """Covariance of the displacements times (j, m, k)."""
        moved = posterior.of_photos(np.einsum("jmk,mkb->jmb", x, seen))
        return np.einsum("mkb,jmb->jmk", seen, moved)

    x = np.random.default_rng(0).normal(size=(_BLOCK, m, nb - 6))
    value = 0.0
    for _ in range(_MOST_STEPS):
        q = np.linalg.qr(x.reshape(_BLOCK, -1).T)[0].T.reshape(x.shape)
        x = spread(q)
        if not np.isfinite(x).all():
            break
        before, value = value, float(np.linalg.norm(x[0]))
        if abs(value - before) <= 1e-4 * value:
            break
    direction = x[0] / np.linalg.norm(x[0])
    weakest = np.sqrt(value) * np.linalg.solve(half, direction[:, :, None])[:, :, 0]
    alone = np.sqrt(np.mean(weakest**2 * np.diagonal(squares, axis1=1, axis2=2), axis=0))
    by_row = np.mean(row_phi(rec)[:, 0] == 0)
    return CommonMotion(
        covariance=covariance,
        weakest=weakest,
        shift_px=float(np.sqrt(value / m)) if np.isfinite(x).all() else np.nan,
        shares=alone / max(float(alone.sum()), 1e-300),
        contrast=clock_contrast(rec),
        by_column=bool(by_row < 0.5),
    )


def clock_contrast(reconstruction: Reconstruction) -> float:
    """Difference of the clocks of the same points: 0 where a motion that all photos share leaves no trace in them.

    A motion of the world during the readout that is the same in all photos moves a point by its clock in each. If these
    are one clock of the point except for an offset and a factor of each photo, the offset is a change of the photo's
    pose, the factor one of its motion, and the rest a change of the scene's shape (docs/critical-motions.md). This is
    the root mean square of the clocks within the photos that is left when the best such clocks are subtracted: between
    0 and 1, and about the share of a motion of its own that a photo shows of a common one.
    """
    from scipy.sparse import coo_array, diags_array  # late: few need it

    rec, obs = reconstruction, reconstruction.observations
    m, shape = rec.num_images, (rec.num_points, rec.num_images)
    clock = np.empty(len(obs))
    for i, mine in enumerate(obs.by_photo(m)):
        clock[mine] = clock_of(rec.camera(i), obs.xy_raw[mine])
        clock[mine] -= clock[mine].mean() if len(mine) else 0.0
    clocks, ones = (
        coo_array((x, (obs.point_idx, obs.frame_idx)), shape=shape).tocsr() for x in (clock, np.ones(len(obs)))
    )
    weight = diags_array(1.0 / np.maximum(np.bincount(obs.point_idx, minlength=rec.num_points), 1))
    within = np.bincount(obs.frame_idx, clock**2, m)
    # of factors a and offsets b, the squares of a r + b less the mean of the point: a'Pa + 2 a'Qb + b'Rb
    P = np.diag(within) - (clocks.T @ weight @ clocks).toarray()
    Q = -(clocks.T @ weight @ ones).toarray()
    R = np.diag(np.bincount(obs.frame_idx, minlength=m)) - (ones.T @ weight @ ones).toarray()
    # one offset for all is free
    P -= Q @ np.linalg.pinv(R, rcond=1e-10, hermitian=True) @ Q.T
    scale = 1.0 / np.sqrt(np.maximum(within, 1e-300))
    least = np.linalg.eigvalsh(scale[:, None] * P * scale)[0]
    return float(np.sqrt(max(least, 0.0)))
