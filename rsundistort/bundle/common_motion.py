"""What the motions of a camera's photos have in common: the mean of their priors, which is solved for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask

__all__ = ["LEAST_PHOTOS", "CommonMotion", "MeansPrior", "MotionMeans", "prior_of_means"]


#: Photos whose motions have a mean. It has a prior of its own, so they need not be as many as its unknowns; with two it
#: would be as much each one's own. (`benchmarks/honest.py --only flights`: three to five photos.)
LEAST_PHOTOS = 3
# Ways to move together: `MeansPrior.of_ways` tells them.
_NUM_WAYS = 8
# How likely no motion in common is, by how likely each way is: photos share one as likely as not.
_NONE = float(_NUM_WAYS)
# Of any way to move. The measurements can still be asked.
_LEAST_PROBABILITY = 1e-4
# Photos that rest share one by odds of up to 14 (seven sets of fountain-small/gs): errors of the lens look like that.
_CERTAIN = 0.99
# Of the squares of what photos move by, as far as a motion in common that was not believed before explains it.
_LEAST_LEFT = 0.1


@dataclass(frozen=True, eq=False)
class MeansPrior:
    """Normal prior of the mean motion of a camera's photos.

    Attributes
    ----------
    covariance : (8, 8) array
        Of means as `CommonMotion` has them, in world units.
    probability : float
        How likely photos share a motion, which the covariance allows for; 0 before that is known.
    """

    covariance: Array
    probability: float = 0.0

    @classmethod
    def of_ways(cls, velocity: float, depth: float) -> MeansPrior:
        """Before anything is known, by the standard deviation of travels in common, and the depth of what is seen.

        The ways to move together, as likely as each other: of cameras that travel along their x, y, or z, of those that
        aim at what they pass along x or y, whose rotation is their travel by the depth, of those that are on their way
        from one photo to the next (travelling only, as drones that hold their gimbal do, and rotating as they do from
        photo to photo, as the frames of a video), and of those that travel and rotate as they like, by as much.
        """
        return cls(velocity**2 * _ways(depth).mean(axis=0))

    def scaled(self, unit: float) -> MeansPrior:
        """The same where lengths have other numbers, `unit` times as large."""
        units = np.repeat([1.0, unit], [3, 5])
        return replace(self, covariance=units[:, None] * self.covariance * units)

    def differs(self, other: MeansPrior, share: float) -> bool:
        """Whether a standard deviation differs by more than a share of the largest, among rotations or travels."""
        sigmas = (np.sqrt(np.diagonal(each.covariance)) for each in (self, other))
        (rotation, travel), (others, its) = (np.split(each, [3]) for each in sigmas)
        return any(
            bool((np.abs(one - another) > share * one.max()).any())
            for one, another in ((rotation, others), (travel, its))
        )

    @property
    def odds_against(self) -> float:
        """Of sharing none against sharing a motion; 0 before they are known.

        Times the square of a mean that was found, this is the variance of it that comes of not knowing which.
        """
        return (1.0 - self.probability) / self.probability if self.probability else 0.0


@dataclass(frozen=True)
class CommonMotion:
    """Means of the motions of each camera's photos.

    Attributes
    ----------
    values : (cameras, 8) array
        Rotation, radians per frame, and travel, baselines per frame, in the frame of the camera; and travels from
        photo to photo, without the rotation from one to the next and with it.
    prior : MeansPrior
        Their prior, in baselines.
    of_photos, deviations : (m, 6) array
        What photos are expected to move by it, in the frames of their cameras: rotation and travel, in the same units;
        and its standard deviations.
    probability : float
        How likely they share a motion, by these values; that of the prior is by those of the solve before.
    """

    values: Array
    prior: MeansPrior
    of_photos: Array
    deviations: Array
    probability: float

    @property
    def is_certain(self) -> bool:
        """Whether photos share a motion by odds of a hundred."""
        return self.probability > _CERTAIN

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square of a component of the photos' rotations and of their travels."""
        rotation, travel = np.sqrt((self.of_photos.reshape(-1, 2, 3) ** 2).mean((0, 2))).tolist()
        return rotation, travel


@dataclass(frozen=True)
class MotionMeans:
    """How the unknown motions of photos depend on the means of their cameras.

    The unknowns of means have standard normal priors.

    Attributes
    ----------
    directions : (m, 6, 8) array
        Motions, in the world frame per unit of the clock, by the unknowns. 0 for what a photo does not share.
    camera_idx : (m,) int array
        Camera of each photo.
    by_values : (m, 6, 8) array
        Motions, in the frames of the cameras per frame, by the means as `CommonMotion` has them, in world units.
    root : (8, 8) array
        These means by the unknowns.
    """

    directions: Array
    camera_idx: Index
    by_values: Array
    root: Array

    @classmethod
    def of(cls, reconstruction: Reconstruction, prior: MeansPrior, shares: Mask) -> MotionMeans:
        """The means of a reconstruction; `shares` (m, 6) says which components of its photos' motions have a mean."""
        by_values = np.concatenate(
            [np.tile(np.eye(6), (reconstruction.num_images, 1, 1)), _on_the_way(reconstruction)], axis=2
        )
        by_values *= shares[:, :, None]
        root = np.linalg.cholesky(prior.covariance)
        directions = by_values @ root / reconstruction.frame_span()[:, None, None]
        directions[:, 3:] = reconstruction.R_cw.transpose(0, 2, 1) @ directions[:, 3:]
        return cls(
            np.asarray(directions, np.float64), reconstruction.camera_idx, by_values, np.asarray(root, np.float64)
        )

    @property
    def by_unknowns(self) -> Array:
        """(m, 6, 8) motions, in the frames of the cameras per frame, by the unknowns."""
        return np.asarray(self.by_values @ self.root)

    def values(self, unknowns: Array) -> Array:
        """Means (cameras, 8) of unknowns (cameras, 8)."""
        return np.asarray(unknowns @ self.root.T)

    def unknowns(self, values: Array) -> Array:
        """Unknowns (cameras, 8) of means (cameras, 8)."""
        return np.asarray(np.linalg.solve(self.root, values.T).T)

    def of_photos(self, unknowns: Array, covariances: Array) -> tuple[Array, Array]:
        """Means (m, 6) of the photos, in their cameras' frames per frame, and their variances.

        By unknowns (cameras, 8) and their covariances (cameras, 8, 8).
        """
        by_unknowns, i = self.by_unknowns, self.camera_idx
        means = np.einsum("mak,mk->ma", by_unknowns, unknowns[i])
        return means, np.einsum("mak,mkl,mal->ma", by_unknowns, covariances[i], by_unknowns)

    def at(self, unknowns: Array) -> Array:
        """Motions (m, 6) of photos that move as the means of unknowns (cameras, 8) say."""
        return np.einsum("mak,mk->ma", self.directions, unknowns[self.camera_idx])

    def pull(self, weight: Array, motion: Array, unknowns: Array) -> Array:
        """Gradient (cameras, 8) of the photos' priors, of weights (m, 6), by the unknowns."""
        total = np.zeros_like(unknowns)
        by_photo = np.einsum("mak,ma->mk", self.directions, weight * (motion - self.at(unknowns)))
        np.add.at(total, self.camera_idx, -by_photo)
        return total

    def most_likely(self, weight: Array, motion: Array, num_cameras: int) -> Array:
        """Unknowns (cameras, 8) where their priors and those of motions (m, 6), of weights (m, 6), cost least."""
        total = np.zeros((num_cameras, *self.root.shape))
        np.add.at(total, self.camera_idx, np.einsum("mak,ma,mal->mkl", self.directions, weight, self.directions))
        pull = -self.pull(weight, motion, np.zeros((num_cameras, len(self.root))))
        return np.asarray(np.linalg.solve(total + np.eye(len(self.root)), pull[..., None])[..., 0], np.float64)


def _on_the_way(reconstruction: Reconstruction) -> Array:
    """(m, 6, 2) motions from the photos before to those after, in the cameras' frames: travels, and whole motions.

    By a travel of one unit. It is less where photos were taken closer together than usual, as by somebody who stops;
    not more where one was left out.
    """
    rec = reconstruction
    found = np.zeros((rec.num_images, 6))
    for camera in range(len(rec.cameras)):
        mine = np.flatnonzero(rec.camera_idx == camera)
        if len(mine) > 1:
            rotations = Rotation.from_matrix(rec.R_cw[mine[1:]] @ rec.R_cw[mine[:-1]].transpose(0, 2, 1)).as_rotvec()
            steps = np.hstack([rotations, np.diff(rec.center_w[mine], axis=0)])
            found[mine] = (np.vstack([steps[:1], steps]) + np.vstack([steps, steps[-1:]])) / 2
    found /= np.maximum(rec.baseline, np.linalg.norm(found[:, 3:], axis=1, keepdims=True))
    found[:, 3:] = np.einsum("mab,mb->ma", rec.R_cw, found[:, 3:])
    travels = np.hstack([np.zeros((rec.num_images, 3)), found[:, 3:]])
    return np.stack([travels, found], axis=2)


def _ways(depth: float) -> Array:
    """(8, 8, 8) covariances of means for travels of unit variance in common: `MeansPrior.of_ways` says of which."""
    travels = np.eye(8)[3:6]
    aiming = travels[:2].copy()
    aiming[:, :2] = [[0.0, 1.0 / depth], [-1.0 / depth, 0.0]]  # what is passed stays in the middle
    along = np.vstack([travels, aiming, np.eye(8)[6:]])
    free = np.diag(np.repeat([depth**-2.0, 1.0, 0.0], [3, 3, 2]))
    return np.concatenate([along[:, :, None] * along[:, None], free[None]])


def prior_of_means(
    unknowns: Array, covariances: Array, root: Array, velocity: float, depth: float, freedom: float
) -> MeansPrior:
    """Prior on means by what was found under another.

    Photos may share no motion. Then the mean of few of them is easily taken for one, and what level photos hardly
    show, nodding and rising, would be free in all of them at once, and the shape with it. So no motion in common, as
    likely at first as all ways together, competes with each way to move by its evidence (the marginal likelihood,
    Laplace's): "spike and slab" (George and McCulloch, 1993). A way has one axis, since evidence against a travel along
    the others, as of one who walks around a thing, says nothing of that one.

    With the probability P they share a motion, whose covariance V is that of the mixture of its ways; K is the
    precision of the measurements. The mean over both (Hoeting et al., "Bayesian model averaging", 1999) is P times that
    of a normal prior V. This is what the normal prior W gives with

        K W (1 + K W)^-1 = P K V (1 + K V)^-1

    so W is that (P V, where P is small, would be wide beside what the measurements tell, and the mean free).

    Parameters
    ----------
    unknowns, covariances, root : (cameras, 8), (cameras, 8, 8), (8, 8) array
        As found, and `MotionMeans.root` there.
    velocity : float
        Standard deviation of a travel in common, if there is one, world units per frame.
    depth : float
        Of what photos show, world units.
    freedom : float
        How many numbers decide what photos move by of their own, which is not known beforehand: they move more if they
        share less. The likelihood is marginal over that, too (of Student's t): else what is believed to be shared makes
        the rest so small that nothing but a motion in common could explain it.
    """
    # by the measurements alone: their precision, and that times what they say
    from_unknowns = np.linalg.inv(root)
    precision = np.linalg.inv(covariances)
    pull = np.einsum("cij,cj->ci", precision, unknowns) @ from_unknowns
    known = from_unknowns.T @ (precision - np.eye(len(root))) @ from_unknowns

    def gain(prior: Array) -> tuple[float, float]:
        """By how much squared deviations are smaller with a prior than without means, and the price of its width."""
        wider = np.eye(len(root)) + known @ prior
        squares = np.einsum("ci,ij,cj->c", pull, prior, np.linalg.solve(wider, pull[..., None])[..., 0])
        return float(squares.sum()), float(np.linalg.slogdet(wider)[1].sum())

    # what is left of the squares, in units of what photos move by of their own, with the means as they were found
    left, evidence = freedom + gain(root @ root.T)[0], [np.log(_NONE)]
    ways = velocity**2 * _ways(depth)
    for way in ways:
        fall, price = gain(way)
        by_unknown_size = -freedom * float(np.log1p(-min(fall / left, 1.0 - _LEAST_LEFT)))
        evidence.append(0.5 * (by_unknown_size - price))
    of_ways = np.maximum(softmax(evidence)[1:], _LEAST_PROBABILITY)
    probability = min(float(of_ways.sum()), 1.0)
    slab = np.linalg.cholesky(np.einsum("k,kab->ab", of_ways / of_ways.sum(), ways))
    exactness, vector = np.linalg.eigh(slab.T @ known.mean(axis=0) @ slab)
    width = probability / (1.0 + (1.0 - probability) * np.maximum(exactness, 0.0))
    side = slab @ vector
    return MeansPrior((side * width) @ side.T, probability)
