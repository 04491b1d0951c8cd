"""The motion of each photo from its own measurements, with the scene fixed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from ..bundle import BundleOptions, BundleResult, bundle_adjust
from ..bundle.layout import motion_end
from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask
from ..model.path import cross_matrices
from ..model.projection import clock_of, project_points_with_jacobians, unproject_points

__all__ = ["PhotoMotions", "hidden_px", "photo_motions"]


# Cells of the chequerboard, across and down; places across and down at which the frame is sampled.
_BOARD, _LOOKED_AT = 8, 5
# Probability that noise alone makes a photo of a set contradict itself.
_CHANCE = 0.01


@dataclass(frozen=True)
class PhotoMotions:
    """Motion and evidence of each photo; pixels are the largest displacement anywhere in its frame, of first order.

    Attributes
    ----------
    shift_px : (m,) array
        By the motion.
    sigma_px : (m,) array
        Standard deviation of that, with the noise of the photo's own residuals.
    relative_sigma : (m,) array
        Root mean square of the standard deviations all over the frame, relative to that of the displacements.
    difference_px : (m,) array
        Between the motions from two halves of the photo's measurements; 0 where that may be noise.
    covered : (m,) array
        Share of the frame in which nine tenths of the measurements lie, across and down.
    """

    shift_px: Array
    sigma_px: Array
    relative_sigma: Array
    difference_px: Array
    covered: Array


def photo_motions(result: BundleResult) -> PhotoMotions:
    """Estimate the motion of each photo of a solution with a shutter separately.

    Its pose and motion are estimated again from each half of its measurements (left and right, read first and read
    last, the two colours of a chequerboard), with fixed points, under the prior on its motion: one step of Gauss-Newton
    from the solution, which is near.
    """
    rec = result.reconstruction
    nb = motion_end(rec.shutter_model)
    sigmas = np.repeat([result.phi_rms, result.velocity_rms * rec.baseline], 3)[: nb - 6]
    found = np.zeros((5, rec.num_images))
    for i, mine in enumerate(rec.observations.by_photo(rec.num_images)):
        if len(mine):
            prior = np.concatenate([np.zeros(6), (rec.frame_span()[i] / np.maximum(sigmas, 1e-12)) ** 2])
            photo = _Photo.of(rec, i, mine, result.sigma_px)
            sigmas_px = photo.motion_sigmas_px(result.covariances[i, 6:, 6:])
            shifts_px = photo.shifts_px(photo.motion[None])[0]
            # approximately, what is unsteady of the rotation displaces along the readout
            bent_px = rec.camera(i).K[0, 0] * np.linalg.norm(rec.bend[i, :, :3], axis=1)
            found[:, i] = (
                shifts_px.max(initial=0.0) + bent_px.max(initial=0.0),
                sigmas_px.max(initial=0.0),
                _rms(sigmas_px) / max(np.hypot(_rms(shifts_px), _rms(bent_px)), 1e-300),
                photo.difference_px(prior, _CHANCE / (3 * rec.num_images)),
                photo.covered,
            )
    return PhotoMotions(*found)


def hidden_px(result: BundleResult, options: BundleOptions) -> float:
    """How far rotations could have displaced pixels of photos that show none: one standard deviation, of half of them.

    It is that of rotations under a prior that the photos have not narrowed: where photos are few, an estimate of it
    says no more than that they show none. The solution is one without a shutter.
    """
    prior = options.phi_sigma or BundleOptions().phi_sigma_start
    wide = replace(options, phi_sigma=prior, loss="squared", outlier_rounds=0, sigma_px=result.sigma_px)
    return float(np.median(photo_motions(bundle_adjust(result.reconstruction, "rotation", wide)).sigma_px))


def _rms(values: Array) -> float:
    """Root mean square; 0 of none."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


@dataclass(frozen=True)
class _Photo:
    """A photo's measurements, linearised at the solution: whitened residuals (n, 2) and Jacobians (n, 2, nb).

    Unknowns: rotation and translation of the camera, phi, velocity, all in the camera frame. `frame` (k, 2, nb - 6) are
    the derivatives of places all over the frame, in pixels, by the motion.
    """

    residuals: Array
    J: Array
    xy: Array
    clock: Array
    motion: Array
    frame: Array
    size: Array
    along: int
    rotation: Array

    @classmethod
    def of(cls, rec: Reconstruction, i: int, mine: Index, sigma_px: float) -> _Photo:
        obs, camera, R = rec.observations, rec.camera(i), rec.R_cw[i]
        points_c = (rec.points_w[obs.point_idx[mine]] - rec.center_w[i]) @ R.T
        motion = rec.motion(i).in_camera(R)
        moving = rec.shutter_model == "constant-motion"
        xy, valid, J = project_points_with_jacobians(points_c, camera, motion, rec.shutter_model)
        mine, points_c = mine[valid], points_c[valid]
        blocks = [-J.point[valid] @ cross_matrices(points_c), -J.point[valid], J.phi[valid]]
        if moving:
            blocks[0] = blocks[0] - J.velocity[valid] @ cross_matrices(motion.velocity[None])
            blocks.append(J.velocity[valid])
        precision = 1.0 / (sigma_px * obs.sigma[mine])
        depth = float(np.median(points_c[:, 2])) if len(points_c) else 1.0
        across, down = (np.linspace(0, side - 1, _LOOKED_AT) for side in (camera.width, camera.height))
        places = np.stack(np.meshgrid(across, down), axis=2).reshape(-1, 2)
        rays, seen = unproject_points(places, camera, motion, rec.shutter_model)
        rays = depth * np.column_stack([rays, np.ones(len(rays))])[seen]
        _, seen, there = project_points_with_jacobians(rays, camera, motion, rec.shutter_model)
        by_motion = [there.phi[seen], there.velocity[seen]] if moving else [there.phi[seen]]
        return cls(
            (xy[valid] - obs.xy_raw[mine]) * precision[:, None],
            np.concatenate(blocks, axis=2) * precision[:, None, None],
            obs.xy_raw[mine],
            clock_of(camera, obs.xy_raw[mine]),
            np.concatenate([motion.phi, motion.velocity])[: 6 if moving else 3],
            np.concatenate(by_motion, axis=2),
            np.array([camera.width, camera.height], float),
            camera.clock_axis,
            R,
        )

    @property
    def covered(self) -> float:
        """Share of the frame."""
        if not len(self.xy):
            return 0.0
        return float(np.prod(np.ptp(np.quantile(self.xy, [0.05, 0.95], axis=0), axis=0) / self.size) / 0.9**2)

    def shifts_px(self, motions: Array) -> Array:
        """(k, f) displacements all over the frame by motions (k, nb - 6)."""
        return np.asarray(np.linalg.norm(np.einsum("fia,ka->kfi", self.frame, motions), axis=2))

    def motion_sigmas_px(self, covariance: Array) -> Array:
        """(f,) standard deviations of displacements by the motion of this covariance, velocities in the world."""
        rotation = np.eye(len(self.motion))
        rotation[3:, 3:] = self.rotation[: len(rotation) - 3, : len(rotation) - 3]
        covariance = rotation @ covariance @ rotation.T
        variance = np.einsum("fia,ab,fib->f", self.frame, covariance, self.frame)
        return np.asarray(np.sqrt(variance * self._noise(self.residuals, self.J.shape[2])))

    @staticmethod
    def _noise(residuals: Array, unknowns: int) -> float:
        """Variance of residuals relative to their weights; at least 1."""
        return max(1.0, float((residuals**2).sum()) / max(residuals.size - unknowns, 1))

    def _halves(self) -> Iterator[Mask]:
        """Measurements (n,) of one half."""
        for values in (self.xy[:, 1 - self.along], self.clock):
            yield values > np.median(values)
        yield np.floor(_BOARD * self.xy / self.size).sum(1) % 2 == 1

    def difference_px(self, prior: Array, chance: float) -> float:
        """Largest displacement between the motions of two halves; 0 if noise alone differs as much with this chance."""
        if len(self.xy) < 2 * self.J.shape[2]:
            return 0.0
        return max(self._difference_px(half, prior, chance) for half in self._halves())

    def _difference_px(self, half: Mask, prior: Array, chance: float) -> float:
        nb = self.J.shape[2]
        steps, covariances, noise = [], [], []
        for mine in (half, ~half):
            if mine.sum() < nb:
                return 0.0
            J, residuals = self.J[mine].reshape(-1, nb), self.residuals[mine].ravel()
            try:
                covariance = np.linalg.inv(J.T @ J + np.diag(prior))
            except np.linalg.LinAlgError:  # all measurements in one place
                return 0.0
            step = -covariance @ (J.T @ residuals + prior * np.concatenate([np.zeros(6), self.motion]))
            steps.append(step[6:])
            covariances.append(covariance)
            noise.append(self._noise(residuals + J @ step, nb))
        difference = steps[0] - steps[1]
        # the same prior draws both to zero: its effect on both is no difference
        first, second = covariances
        shared = (first * prior) @ second
        variance = (first + second - shared - shared.T)[6:, 6:] * max(noise)
        unlike = float(difference @ np.linalg.solve(variance, difference)) / len(difference)
        # Hotelling's: the noise is estimated from the same residuals
        if fdtrc(len(difference), max(self.residuals.size - 2 * nb, 1), unlike) > chance:
            return 0.0
        return float(self.shifts_px(difference[None]).max(initial=0.0))
