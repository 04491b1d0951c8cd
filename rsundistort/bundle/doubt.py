"""What is added to covariances for errors that no residual shows: of a calibration, and of the choice of a model.

A principal point and a tangential distortion that are off together look like a phi3 that all photos share: to second
order

    (cx, p2) = (3, 1) e:    e (3 x^2 + y^2, 2 x y) - 3 e (x^2, x y) = e (y^2, -x y)

after the rotation that makes up for the principal point. The estimate then goes wrong by H^-1 g, where H is the Hessian
and g the change of the gradient of the calibration's prior. It is no noise, and the jackknife cannot see it, so the
covariance of that is added (`GuessedCameras.decentring`). The estimate itself trusts the calibration: a prior that was
as wide as such errors would lose what exact calibrations know (courtyard: rotations wrong by 0.014 degrees, not 0.008).

A model that predicts held-out measurements about as well as the one that is kept may have other motions: over flat
ground, a velocity looks like a rotation. If it is right with the probability p, the second moment of the estimate's
error has p d d' beside the covariances, where d is what the one differs by from the other (averaging over models;
Hoeting et al., "Bayesian model averaging", 1999).

Photos share a motion or none. The mean of the two, M, is P times the motion if they share one, with the probability P;
its second moment has P (1 - P) (M / P)^2 = M^2 (1 - P) / P beside that of either (`MeansPrior.odds_against`), and
what follows from the mean moves with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ..model import Reconstruction
from ..model.array_types import Array, Index
from ..model.similarity import Similarity
from .bundle_options import BundleOptions
from .common_motion import MeansPrior
from .layout import motion_end
from .normal_equations import Function, NormalEquations

__all__ = ["Doubt", "steps_after", "steps_to"]


@dataclass(frozen=True)
class Doubt:
    """How far r errors, each of one standard deviation, move the estimate.

    Attributes
    ----------
    pulls : (r, k) array
        The change of the gradient of the priors on the cameras' unknowns.
    photos : (r, m, nb) array
        How far the unknowns of the photos move.
    cameras : (r, k) array
        The same of all cameras.
    """

    pulls: Array
    photos: Array
    cameras: Array

    @classmethod
    def of(
        cls, equations: NormalEquations, options: BundleOptions, rec: Reconstruction, heavy: bool = True,
        *, prior: MeansPrior | None = None, means: Array | None = None,
    ) -> Doubt:  # fmt: skip
        """At the solution that has these equations; NaN where the system cannot be factored.

        The means (cameras, k), the last unknowns of each camera, if they have a prior.
        """
        cameras = rec.cameras
        c, names = equations.num_cameras, options.refine
        of_each = np.zeros((2, c, c, equations.num_shared // c))
        if options.guessed is not None:
            each = np.arange(c)
            of_each[:, each, each, : len(names)] = options.guessed.pulls_of_decentring(cameras, names, heavy)
        pulls = of_each.reshape(2 * c, -1)
        pulls = pulls[pulls.any(1)]
        if prior is not None and means is not None and means.any():
            pulls = np.vstack([pulls, _pull_of_means(equations, np.sqrt(prior.odds_against) * means)])
        unmoved = np.zeros((len(pulls), equations.num_photos, equations.blocks[1].shape[2]))
        photos, moved = equations.times(unmoved, pulls) if len(pulls) else (unmoved, pulls)
        if not options.rival:
            return cls(pulls, photos, moved)
        steps, end = np.zeros((1, *photos.shape[1:])), motion_end(rec.shutter_model)
        for each, name in zip(steps[0], rec.image_names, strict=True):
            each[:end] = options.rival.get(name, (0.0,) * end)[:end]
        none = np.zeros((1, equations.num_shared))
        return cls(*(np.concatenate(each) for each in ((pulls, none), (photos, steps), (moved, none))))

    @property
    def of_photos(self) -> Array:
        """(m, nb, nb) covariances of each photo's unknowns."""
        return np.einsum("rma,rmb->mab", self.photos, self.photos)

    @property
    def of_cameras(self) -> Array:
        """(k, k) covariance of the unknowns of all cameras."""
        return self.cameras.T @ self.cameras

    def with_last(self, camera_idx: Index, per_camera: int) -> Array:
        """(m, nb) covariances of photos' unknowns with the last of their camera."""
        last = self.cameras[:, (camera_idx + 1) * per_camera - 1]
        return np.einsum("rma,rm->ma", self.photos, last)

    def times(self, photos: Array, cameras: Array | None = None) -> tuple[Array, Array]:
        """The covariance times stacks of values of photos (n, m, nb) and of cameras (n, k)."""
        along = np.einsum("rma,nma->nr", self.photos, photos)
        if cameras is not None:
            along += cameras @ self.cameras.T
        return np.einsum("nr,rma->nma", along, self.photos), along @ self.cameras

    def of_function(self, found: Function) -> tuple[float, Array]:
        """Variance of a function of the points, and its covariance (m, nb) with the photos' unknowns."""
        moved = self.pulls @ found.with_cameras
        return float(moved @ moved), np.einsum("r,rma->ma", moved, self.photos)


def _pull_of_means(equations: NormalEquations, means: Array) -> Array:
    """(k,) change of the gradient of the cameras' unknowns that moves the means by (cameras, n)."""
    c, n = means.shape
    last = (np.arange(1, c + 1)[:, None] * (equations.num_shared // c) - n + np.arange(n)).ravel()
    units = np.eye(equations.num_shared)[last]
    none = np.zeros((len(units), equations.num_photos, equations.blocks[1].shape[2]))
    covariance = equations.times(none, units)[1][:, last]
    return np.asarray(np.linalg.solve(covariance, means.ravel()) @ units)


def steps_after(
    steps: Mapping[str, Sequence[float]], before: Reconstruction, after: Reconstruction
) -> dict[str, tuple[float, ...]]:
    """Steps of photos, as `steps_to` returns them, of a reconstruction that a similarity has moved since."""
    R, scale = after.R_cw[0].T @ before.R_cw[0], after.baseline / before.baseline
    moved = {}
    for name, each in steps.items():
        rotation, centre, phi, velocity = np.reshape(each, (4, 3))
        moved[name] = tuple(np.concatenate([rotation, scale * R @ centre, phi, scale * R @ velocity]).tolist())
    return moved


def steps_to(other: Reconstruction, rec: Reconstruction) -> Array:
    """(m, 12) by how much rotation, centre, phi and velocity of the same photos differ, in the frame of the second."""
    U, _, Vt = np.linalg.svd(np.einsum("mji,mjk->ik", rec.R_cw, other.R_cw))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    X, Y = ((each.center_w - each.center_w.mean(0)) for each in (other, rec))
    scale = float(np.sum(Y * (X @ R.T)) / np.sum(X**2))
    other = Similarity(scale, R, rec.center_w.mean(0) - scale * R @ other.center_w.mean(0)).of_reconstruction(other)
    turned = Rotation.from_matrix(other.R_cw @ rec.R_cw.transpose(0, 2, 1)).as_rotvec()
    # each by its own camera: with another focal length the same motion has other rates
    pace = (other.frame_span() / rec.frame_span())[:, None]
    moved = (other.center_w - rec.center_w, pace * other.phi - rec.phi, pace * other.velocity - rec.velocity)
    return np.hstack([turned, *moved])
