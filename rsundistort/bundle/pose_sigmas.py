"""Standard deviations of poses, whatever the frame of the world is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array, Mask
from .bundle_options import BundleOptions, BundleResult
from .known_positions import PlaceResiduals
from .posterior import Posterior, gauge_directions

__all__ = ["PoseCovariances", "pose_covariances"]

# A similarity makes up for all that may be wrong with two centres.
_LEAST = 3


@dataclass(frozen=True)
class PoseCovariances:
    """Covariances of the photos' poses, in their camera frames, so that no similarity of the world changes them.

    Attributes
    ----------
    rotation : (m, 3, 3) array
        Of rotations (left), radians squared.
    center : (m, 3, 3) array
        Of centres, squared baselines of the reconstruction.
    """

    rotation: Array
    center: Array

    def take(self, keep: Mask, baseline: float) -> PoseCovariances:
        """Those of some photos (m,), whose baseline is given in baselines of all."""
        return PoseCovariances(self.rotation[keep], self.center[keep] / baseline**2)

    @property
    def sigma_rotation(self) -> Array:
        """(m, 3) standard deviations of rotations about the axes of the cameras, radians."""
        return _deviations(self.rotation)

    def sigma_center(self, R_cw: Array, baseline: float) -> Array:
        """(m, 3) standard deviations of centres along the axes of a world of these rotations (m, 3, 3) and baseline."""
        return baseline * _deviations(R_cw.transpose(0, 2, 1) @ self.center @ R_cw)


def pose_covariances(result: BundleResult, options: BundleOptions | None = None) -> PoseCovariances | None:
    """Covariances of the poses of a result, beside what the choice of the world's frame leaves open.

    Rotations are those left after the common rotation that fits all best, centres those after the similarity that does,
    as `evaluation.pose_errors` compares them: to first order both project the changes of the frame off. Where known
    places hold the frame, nothing is projected off.

    Parameters
    ----------
    result : BundleResult
        Of any shutter model; None of frames that have rotations only, and of fewer than three photos.
    options : BundleOptions, optional
        Of the adjustment: its constraints, known motions and refined intrinsics count.
    """
    options = options or BundleOptions()
    rec = result.reconstruction
    rotation_only = options.path is not None and options.path.rotation_only
    if rec.num_images < _LEAST or rotation_only:
        return None
    rotation, center = result.covariances[:, :3, :3], result.covariances[:, 3:6, 3:6]
    if options.places is None or not PlaceResiduals(rec, options.places).holds_frame:
        posterior, moves = Posterior(result, options), gauge_directions(result)
        rotation = _without(posterior, rotation, moves[:3], 0)
        center = _without(posterior, center, moves, 3)
    return PoseCovariances(rotation, _in_cameras(center, rec))


def _without(posterior: Posterior, blocks: Array, moves: Array, first: int) -> Array:
    """(m, 3, 3) blocks of P C P, P projecting off moves (k, m, nb) of three unknowns of each photo from `first` on.

    `blocks` are those of C. Of the whole of it no more than its products with the moves is needed.
    """
    k, m, nb = moves.shape
    own = slice(first, first + 3)
    U = np.linalg.qr(moves[:, :, own].reshape(k, -1).T)[0].T.reshape(k, m, 3)
    vectors = np.zeros((k, m, nb))
    vectors[:, :, own] = U
    moved = posterior.of_photos(vectors)[:, :, own]
    cross = np.einsum("kma,kmb->mab", moved, U)
    inner = np.einsum("kma,lma->kl", U, moved)
    return blocks - cross - cross.transpose(0, 2, 1) + np.einsum("kma,kl,lmb->mab", U, inner, U)


def _in_cameras(covariances: Array, rec: Reconstruction) -> Array:
    """Covariances (m, 3, 3) of vectors of the world, in camera frames and baselines."""
    return rec.R_cw @ covariances @ rec.R_cw.transpose(0, 2, 1) / rec.baseline**2


def _deviations(covariances: Array) -> Array:
    """(m, 3) square roots of the diagonals."""
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
