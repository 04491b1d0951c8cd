"""Solutions of the same photos beside each other: which one explains more, and whether they agree."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from scipy.spatial.transform import Rotation

from ..bundle import BundleResult
from ..bundle.held_out import MIN_FALL
from ..model import Reconstruction
from ..model.reprojection import reprojection_residuals
from ..model.similarity import similarity_of
from ..sfm import LEAST_TIES, SIFT_PX, connected_photos

__all__ = [
    "agree",
    "consistent",
    "explains_most",
    "explains_variation",
    "leaves_less",
    "leaves_no_more",
    "needs_other_lens",
    "num_explained",
    "num_of_one_scale",
    "photos_apart",
    "same_places",
]

# Of the noise of features: farther from its prediction no measurement is explained.
_MOST_SIGMAS = 3.0
# Two solutions agree on a photo if its rotations are closer, in radians, and its places, seen from the scene: a right
# one is right to a degree.
_AGREE_RAD = np.radians(2.0)


def num_explained(reconstruction: Reconstruction, without: Collection[str] = ()) -> int:
    """How many measurements lie as near to their predictions as the noise of features lets them.

    Those of some photos can be left out.
    """
    rec = reconstruction
    residuals, valid = reprojection_residuals(rec)
    within = _MOST_SIGMAS * SIFT_PX * rec.observations.sigma
    counts = ~np.isin(rec.image_names, [*without])[rec.observations.frame_idx]
    return int((counts & valid & (np.linalg.norm(residuals, axis=1) <= within)).sum())


def num_of_one_scale(reconstruction: Reconstruction) -> int:
    """Photos of the largest part of which nothing could be scaled against the rest."""
    return int(connected_photos(reconstruction, LEAST_TIES, in_common=2).sum())


def agree(rec: Reconstruction, other: Reconstruction) -> bool:
    """Whether photos of two solutions, of which they share some, look the same ways."""
    return not {*rec.image_names}.isdisjoint(other.image_names) and not photos_apart(rec, other)


def consistent(rec: Reconstruction, other: Reconstruction) -> bool:
    """Whether photos of both solutions look the same ways and are in the same places, whatever their frames."""
    both = [name for name in rec.image_names if name in other.image_names]
    if not both:
        return False
    places, targets = (each.center_w[[each.image_names.index(name) for name in both]] for each in (other, rec))
    moved = similarity_of(places, targets).of_reconstruction(other)
    return agree(rec, moved) and same_places(rec, moved)


def photos_apart(rec: Reconstruction, other: Reconstruction) -> list[str]:
    """Photos of both solutions that look another way in one than in the other."""
    both = [name for name in rec.image_names if name in other.image_names]
    if not both:
        return []
    of_rec, of_other = (each.R_cw[[each.image_names.index(name) for name in both]] for each in (rec, other))
    steps = Rotation.from_matrix(np.einsum("mji,mjk->mik", of_rec, of_other))
    apart = (steps * steps.mean().inv()).magnitude() >= _AGREE_RAD
    return [name for name, is_apart in zip(both, apart.tolist(), strict=True) if is_apart]


def same_places(rec: Reconstruction, other: Reconstruction) -> bool:
    """Whether the photos of two solutions in one frame are in the same places, as seen from what they show."""
    index_of = {name: i for i, name in enumerate(other.image_names)}
    obs = rec.observations
    for center, name, mine in zip(rec.center_w, rec.image_names, obs.by_photo(rec.num_images), strict=True):
        away = np.linalg.norm(rec.points_w[obs.point_idx[mine]] - center, axis=1)
        depth = np.median(away) if len(mine) else 0.0
        if name in index_of and not np.linalg.norm(other.center_w[index_of[name]] - center) <= _AGREE_RAD * depth:
            return False
    return True


def explains_most(other: BundleResult, before: BundleResult) -> bool:
    """Whether one result explains most of what another leaves."""
    return bool(2 * other.sigma_px**2 < before.sigma_px**2)


def leaves_less(other: BundleResult, before: BundleResult) -> bool:
    """Whether one result leaves less than another, by more than noise may."""
    return bool(other.sigma_px**2 < (1 - MIN_FALL) * before.sigma_px**2)


def leaves_no_more(other: BundleResult, before: BundleResult) -> bool:
    """Whether one result leaves no more than another, but for what noise may."""
    return bool(other.sigma_px**2 <= (1 + MIN_FALL) * before.sigma_px**2)


def needs_other_lens(rec: Reconstruction) -> bool:
    """Whether photos need more than a lens of the model: one that varies, or a residual field."""
    return rec.varies or any(camera.field.size for camera in rec.cameras)


def explains_variation(other: BundleResult, before: BundleResult) -> bool:
    """Whether one result leaves no more than another, but for what noise may, which needs a lens that varies for it."""
    return leaves_no_more(other, before) and before.reconstruction.varies and not other.reconstruction.varies
