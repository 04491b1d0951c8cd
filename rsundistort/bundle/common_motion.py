"""What the motions of a camera's photos have in common: the mean of their priors, which is solved for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import softmax

from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask

__all__ = ["LEAST_PHOTOS", "NUM_WAYS", "CommonMotion", "MotionMeans", "sigmas_of_means"]


#: Photos whose motions have a mean. It has a prior of its own, so they need not be as many as its unknowns; with two it
#: would be as much each one's own. (`benchmarks/honest.py --only flights`: three to five photos.)
LEAST_PHOTOS = 3
#: Ways to move together: `MotionMeans.of` tells them.
NUM_WAYS = 7
# How likely no motion in common is, by how likely each way is: as a travel along any of three axes.
_NONE = 3.0
# Of any way to move: a hundredth of the travel that it would have. The measurements can still be asked.
_LEAST_PROBABILITY = 1e-4


@dataclass(frozen=True)
class CommonMotion:
    """Means of the motions of each camera's photos.

    Attributes
    ----------
    values : (cameras, 7) array
        Rotation, radians per frame, and travel, baselines per frame, in the frame of the camera; and travel along the
        path of the photos.
    deviations : (cameras, 7) array
        Their standard deviations.
    sigmas : (7,) tuple of float
        Standard deviations of their prior, baselines per frame, as `MotionMeans` takes them.
    """

    values: Array
    deviations: Array
    sigmas: tuple[float, ...]


@dataclass(frozen=True)
class MotionMeans:
    """How the unknown motions of photos depend on the means of their cameras.

    The unknowns of means have standard normal priors.

    Attributes
    ----------
    directions : (m, 6, 7) array
        Motions, in the world frame per unit of the clock, by the unknowns. 0 for what a photo does not share.
    camera_idx : (m,) int array
        Camera of each photo.
    by_values : (m, 6, 7) array
        Motions, in the frames of the cameras per frame, by the means as `CommonMotion` has them, in world units.
    root : (7, 7) array
        These means by the unknowns.
    """

    directions: Array
    camera_idx: Index
    by_values: Array
    root: Array

    @classmethod
    def of(cls, reconstruction: Reconstruction, sigmas: tuple[float, ...], shares: Mask) -> MotionMeans:
        """The means of a reconstruction; `shares` (m, 6) says which components of its photos' motions have a mean.

        `sigmas` are the standard deviations of travels in common, world units per frame: of cameras that travel along
        their x, y, or z, of those that aim at what they pass along x or y, whose rotation is their travel by the depth,
        of those that travel and rotate as they like, by as much, and of those that were on their way from one photo to
        the next, wherever they look.
        """
        by_values = np.zeros((reconstruction.num_images, 6, 7))
        by_values[:, :, :6] = np.eye(6)
        by_values[:, 3:, 6] = np.einsum("mab,mb->ma", reconstruction.R_cw, _headings(reconstruction))
        by_values *= shares[:, :, None]
        root = np.linalg.cholesky(np.einsum("k,kab->ab", np.square(sigmas), _ways(reconstruction.typical_depth)))
        directions = by_values @ root / reconstruction.frame_span()[:, None, None]
        directions[:, 3:] = reconstruction.R_cw.transpose(0, 2, 1) @ directions[:, 3:]
        return cls(
            np.asarray(directions, np.float64), reconstruction.camera_idx, by_values, np.asarray(root, np.float64)
        )

    def values(self, unknowns: Array) -> Array:
        """Means (cameras, 7) of unknowns (cameras, 7)."""
        return np.asarray(unknowns @ self.root.T)

    def unknowns(self, values: Array) -> Array:
        """Unknowns (cameras, 7) of means (cameras, 7)."""
        return np.asarray(np.linalg.solve(self.root, values.T).T)

    def at(self, unknowns: Array) -> Array:
        """Motions (m, 6) of photos that move as the means of unknowns (cameras, 7) say."""
        return np.einsum("mak,mk->ma", self.directions, unknowns[self.camera_idx])

    def pull(self, weight: Array, motion: Array, unknowns: Array) -> Array:
        """Gradient (cameras, 7) of the photos' priors, of weights (m, 6), by the unknowns."""
        total = np.zeros_like(unknowns)
        by_photo = np.einsum("mak,ma->mk", self.directions, weight * (motion - self.at(unknowns)))
        np.add.at(total, self.camera_idx, -by_photo)
        return total

    def most_likely(self, weight: Array, motion: Array, num_cameras: int) -> Array:
        """Unknowns (cameras, 7) where their priors and those of motions (m, 6), of weights (m, 6), cost least."""
        total = np.zeros((num_cameras, *self.root.shape))
        np.add.at(total, self.camera_idx, np.einsum("mak,ma,mal->mkl", self.directions, weight, self.directions))
        pull = -self.pull(weight, motion, np.zeros((num_cameras, len(self.root))))
        return np.asarray(np.linalg.solve(total + np.eye(len(self.root)), pull[..., None])[..., 0], np.float64)


def _headings(reconstruction: Reconstruction) -> Array:
    """(m, 3) travels of photos on their way, world units per frame: of baseline's length, from those before to those
    after.

    Less where photos were taken closer together, as by somebody who stops; no more where one was left out.
    """
    found = np.zeros((reconstruction.num_images, 3))
    for camera in range(len(reconstruction.cameras)):
        mine = np.flatnonzero(reconstruction.camera_idx == camera)
        if len(mine) > 1:
            found[mine] = np.gradient(reconstruction.center_w[mine], axis=0)
    length = np.linalg.norm(found, axis=1, keepdims=True) / reconstruction.baseline
    return found / (reconstruction.baseline * np.maximum(length, 1.0))


def _ways(depth: float) -> Array:
    """(7, 7, 7) covariances of means for travels of unit variance in common: `MotionMeans.of` says of which cameras."""
    travels = np.hstack([np.zeros((3, 3)), np.eye(3), np.zeros((3, 1))])
    aiming = travels[:2].copy()
    aiming[:, :2] = [[0.0, 1.0 / depth], [-1.0 / depth, 0.0]]  # what is passed stays in the middle
    along = np.vstack([travels, aiming])
    free, on_path = np.repeat([depth**-2.0, 1.0, 0.0], [3, 3, 1]), np.eye(7)[6]
    return np.concatenate([along[:, :, None] * along[:, None], [np.diag(free), np.diag(on_path)]])


def sigmas_of_means(
    unknowns: Array, covariances: Array, root: Array, velocity: float, depth: float
) -> tuple[float, ...]:
    """Standard deviations of the prior on means, as `MotionMeans` takes them, by what was found under another.

    Photos may share no motion. Then the mean of few of them is easily taken for one, and what level photos hardly
    show, nodding and rising, would be free in all of them at once, and the shape with it. So no motion in common, as
    likely at first as a travel along any axis, competes with each way to move by its evidence (the marginal likelihood,
    Laplace's), and the prior's covariance is that of their mixture: "spike and slab" (George and McCulloch, 1993), in
    which a slab is no wider than it is likely. A way has one axis, since evidence against a travel along the others, as
    of one who walks around a thing, says nothing of that one.

    Parameters
    ----------
    unknowns, covariances, root : (cameras, 7), (cameras, 7, 7), (7, 7) array
        As found, and `MotionMeans.root` there.
    velocity : float
        Standard deviation of a travel in common, if there is one, world units per frame.
    depth : float
        Of what photos show, world units.
    """
    # by the measurements alone: their precision, and that times what they say
    from_unknowns = np.linalg.inv(root)
    precision = np.linalg.inv(covariances)
    pull = np.einsum("cij,cj->ci", precision, unknowns) @ from_unknowns
    known = from_unknowns.T @ (precision - np.eye(len(root))) @ from_unknowns
    evidence = [np.log(_NONE)]
    for way in _ways(depth):
        prior = velocity**2 * way
        wider = np.eye(len(root)) + known @ prior
        gain = np.einsum("ci,ij,cj->c", pull, prior, np.linalg.solve(wider, pull[..., None])[..., 0])
        evidence.append(0.5 * float((gain - np.linalg.slogdet(wider)[1]).sum()))
    probability = np.maximum(softmax(evidence)[1:], _LEAST_PROBABILITY)
    return tuple((velocity * np.sqrt(probability)).tolist())
