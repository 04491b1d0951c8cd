"""What the motions of a camera's photos have in common: the mean of their priors, which is solved for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask

__all__ = ["LEAST_PHOTOS", "CommonMotion", "MotionMeans"]


#: Photos whose motions have a mean. It has a prior of its own, so they need not be as many as its unknowns; with two it
#: would be as much each one's own. (`benchmarks/honest.py --only flights`: three to five photos.)
LEAST_PHOTOS = 3


@dataclass(frozen=True)
class CommonMotion:
    """Means of the motions of each camera's photos, in the frame of the camera.

    Attributes
    ----------
    values : (cameras, 6) array
        Rotation, radians per frame, and travel, baselines per frame.
    deviations : (cameras, 6) array
        Their standard deviations.
    sigmas : (6,) tuple of float
        Those of their priors, whose means are zero.
    """

    values: Array
    deviations: Array
    sigmas: tuple[float, ...]


@dataclass(frozen=True)
class MotionMeans:
    """How the unknown motions of photos depend on the means of their cameras.

    Attributes
    ----------
    directions : (m, 6, 6) array
        Motions, in the world frame per unit of the clock, by means, in the frame of the camera per frame. 0 for what a
        photo does not share.
    camera_idx : (m,) int array
        Camera of each photo.
    sigmas : (6,) array
        Standard deviations of the priors on the means: radians, and world units.
    """

    directions: Array
    camera_idx: Index
    sigmas: Array

    @classmethod
    def of(cls, reconstruction: Reconstruction, sigmas: tuple[float, ...], shares: Mask) -> MotionMeans:
        """The means of a reconstruction; `shares` (m, 6) says which components of its photos' motions have a mean."""
        directions = np.zeros((reconstruction.num_images, 6, 6))
        directions[:, :3, :3] = np.eye(3)
        directions[:, 3:, 3:] = reconstruction.R_cw.transpose(0, 2, 1)
        directions *= shares[:, :, None] / reconstruction.frame_span()[:, None, None]
        return cls(directions, reconstruction.camera_idx, np.array(sigmas))

    def at(self, means: Array) -> Array:
        """Motions (m, 6) of photos that move as the means (cameras, 6) say."""
        return np.einsum("mak,mk->ma", self.directions, means[self.camera_idx])

    def pull(self, weight: Array, motion: Array, means: Array) -> Array:
        """Gradient (cameras, 6) of the photos' priors, of weights (m, 6), by the means."""
        total = np.zeros_like(means)
        by_photo = np.einsum("mak,ma->mk", self.directions, weight * (motion - self.at(means)))
        np.add.at(total, self.camera_idx, -by_photo)
        return total

    def most_likely(self, weight: Array, motion: Array, num_cameras: int) -> Array:
        """Means (cameras, 6) where the priors of motions (m, 6), of weights (m, 6), and of the means cost least."""
        total = np.zeros((num_cameras, 6, 6))
        np.add.at(total, self.camera_idx, np.einsum("mak,ma,mal->mkl", self.directions, weight, self.directions))
        pull = -self.pull(weight, motion, np.zeros((num_cameras, 6)))
        return np.asarray(np.linalg.solve(total + np.diag(self.sigmas**-2.0), pull[..., None])[..., 0], np.float64)
