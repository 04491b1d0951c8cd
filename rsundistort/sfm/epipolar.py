"""The matches that fit the poses and motions of a reconstruction, and the photos that contradict the others."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from ..colmap.conventions import quiet_pycolmap
from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask
from ..model.projection import clock_of, unproject_points
from .database import MatchedPhotos

__all__ = [
    "MIN_EXPLAINED",
    "TIGHT_PX",
    "FreedMatches",
    "Matches",
    "agreeing_photos",
    "distance_from_planes",
    "matches_that_fit",
    "photo_pairs",
    "read_matches",
    "read_num_verified",
    "read_verified",
    "sampson_distance",
]

#: Largest distance of a measurement from its prediction, in pixels of the image that the features were detected in.
TIGHT_PX = 2.0
#: A pair with fewer matches that fit may have only such as fit by chance.
MIN_EXPLAINED = 15

# Of the matches of two photos that one loose epipolar geometry fits, the poses of both must explain this share.
_LEAST_SHARE = 0.5


class FreedMatches:
    """Matches under a reconstruction: rays without lens and shutter, from where the camera was when it read them.

    The keypoints are those of the reconstruction's photos at least.
    """

    def __init__(self, matched: MatchedPhotos, reconstruction: Reconstruction) -> None:
        index_of = {name: i for i, name in enumerate(reconstruction.image_names)}
        self.posed = np.array([index_of.get(name, -1) for name in matched.names])
        self._matched, self._rec = matched, reconstruction
        self._rays: dict[int, Array] = {}
        self._centers: dict[int, Array] = {}

    def _rays_of(self, photo: int) -> Array:
        if photo not in self._rays:
            rec, i = self._rec, int(self.posed[photo])
            xy, valid = unproject_points(
                self._matched.features[photo].xy_raw, rec.camera(i), rec.motion(i), rec.shutter_model
            )
            self._rays[photo] = np.column_stack([np.where(valid[:, None], xy, np.nan), np.ones(len(xy))])
        return self._rays[photo]

    def _centers_of(self, photo: int) -> Array:
        """(n, 3) where the camera was, or (3,) if it did not travel."""
        if photo not in self._centers:
            rec, i = self._rec, int(self.posed[photo])
            center, motion = rec.center_w[i], rec.motion(i)
            if rec.shutter_model == "constant-motion" and motion.moves:
                center = center + motion.at(clock_of(rec.camera(i), self._matched.features[photo].xy_raw))[1]
            self._centers[photo] = center
        return self._centers[photo]

    def _centers_at(self, photo: int, keypoints: NDArray[np.integer]) -> Array:
        center = self._centers_of(photo)
        return center if center.ndim == 1 else center[keypoints]

    def explained(self, first: int, second: int, matches: NDArray[np.integer]) -> Mask:
        """(n,) whether both rays of a match are within tight thresholds of the other's epipolar plane (Sampson).

        Photos are counted as in `matched`; none is explained where one of them has no pose.
        """
        i, j = int(self.posed[first]), int(self.posed[second])
        if i < 0 or j < 0:
            return np.zeros(len(matches), bool)
        rec, features = self._rec, self._matched.features
        centers = [self._centers_at(k, matches[:, side]) for side, k in enumerate((first, second))]
        distance = sampson_distance(
            self._rays_of(first)[matches[:, 0]], self._rays_of(second)[matches[:, 1]], rec.R_cw[j] @ rec.R_cw[i].T,
            (centers[0] - centers[1]) @ rec.R_cw[j].T,
        )  # fmt: skip
        allowed = [
            TIGHT_PX * features[k].step_px / float(rec.camera(posed).K[0, 0]) for k, posed in ((first, i), (second, j))
        ]
        return distance <= max(allowed)

    def depths(self, matches: Matches) -> dict[int, Array]:
        """Depths (n,) of keypoints at the reference row, of all photos if any travelled while it was read, else none.

        By the mean of the inverse depths that a keypoint's matches give, by the information that they have of it; inf
        where it has none. Photos are counted as in `matched`.
        """
        rec, found = self._rec, dict[int, Array]()
        if rec.shutter_model != "constant-motion" or not any(rec.motion(i).moves for i in range(rec.num_images)):
            return found
        total = {k: np.zeros((2, len(self._rays_of(k)))) for k in np.flatnonzero(self.posed >= 0).tolist()}
        for pair, rows in matches.items():
            # directions in the world, and where they are seen from
            ray = [self._rays_of(k)[rows[:, side]] @ rec.R_cw[self.posed[k]] for side, k in enumerate(pair)]
            center = [self._centers_at(k, rows[:, side]) for side, k in enumerate(pair)]
            normal, base = np.cross(*ray), center[1] - center[0]
            for k, keypoint, own, other in ((pair[0], rows[:, 0], *ray), (pair[1], rows[:, 1], *ray[::-1])):
                # where both rays are nearest to each other
                depth = (np.cross(base, other) * normal).sum(1)
                weight = np.where(depth > 0, (np.cross(base, own) ** 2).sum(1), 0.0)
                inverse = (normal**2).sum(1) / np.where(depth > 0, depth, 1.0)
                np.add.at(total[k][0], keypoint, weight * inverse)
                np.add.at(total[k][1], keypoint, weight)
        for k, (weighted, weights) in total.items():
            i = int(self.posed[k])
            along = (self._centers_of(k) - rec.center_w[i]) @ rec.R_cw[i, 2]
            # what is at the camera, or behind it, is noise
            known = weighted > 0
            found[k] = np.where(known, weights / np.where(known, weighted, 1.0) + along, np.inf)
        return found


#: Keypoints of two photos that match, by the pair of photos as in `MatchedPhotos`: (n, 2) int arrays.
Matches = dict[tuple[int, int], Index]


def photo_pairs(ids: Iterable[int]) -> list[tuple[int, int]]:
    """The pairs of photos, counted as in `MatchedPhotos`, of a database's ids of pairs."""
    return [(i - 1, j - 1) for i, j in map(quiet_pycolmap().pair_id_to_image_pair, ids)]


def read_matches(matched: MatchedPhotos) -> Matches:
    """All matches of a database."""
    with quiet_pycolmap().Database.open(matched.database) as db:
        pairs = photo_pairs(db.read_all_matches()[0])
        return {(i, j): np.asarray(db.read_matches(i + 1, j + 1), np.int64) for i, j in pairs}


def matches_that_fit(matched: MatchedPhotos, reconstruction: Reconstruction) -> Matches:
    """The matches of a database that fit poses, of pairs where these are not too few."""
    freed, found = FreedMatches(matched, reconstruction), Matches()
    for pair, matches in read_matches(matched).items():
        if (freed.posed[list(pair)] >= 0).all():
            fitting = matches[freed.explained(*pair, matches)]
            if len(fitting) >= MIN_EXPLAINED:
                found[pair] = fitting
    return found


def read_verified(matched: MatchedPhotos) -> Matches:
    """Matches of a database that the epipolar geometry of their pair fits."""
    with quiet_pycolmap().Database.open(matched.database) as db:
        ids, geometries = db.read_two_view_geometries()
    found = (np.asarray(each.inlier_matches, np.int64).reshape(-1, 2) for each in geometries)
    return dict(zip(photo_pairs(ids), found, strict=True))


def read_num_verified(matched: MatchedPhotos) -> dict[tuple[int, int], int]:
    """Number of matches of each pair that fit one loose epipolar geometry, from the database before new tracks."""
    with quiet_pycolmap().Database.open(matched.database) as db:
        ids, counts = db.read_two_view_geometry_num_inliers()
    return dict(zip(photo_pairs(ids), map(int, counts), strict=True))


def agreeing_photos(
    matched: MatchedPhotos,
    matches: Matches,
    num_verified: Mapping[tuple[int, int], int],
    reconstruction: Reconstruction,
) -> Mask:
    """Photos of a reconstruction that are connected: the largest set linked by pairs that fit it.

    A pair links two photos if their poses explain half of what a loose epipolar geometry does.

    Parameters
    ----------
    matched, matches, num_verified
        Photos, their matches, and how many of these such a geometry fits.

    Returns
    -------
    (m,) bool array
        By photo of `matched`. False for the rest, which another pose may fit better, and for photos without a pose.
    """
    freed = FreedMatches(matched, reconstruction)
    posed = freed.posed >= 0
    linked = [
        pair
        for pair, count in num_verified.items()
        if count >= MIN_EXPLAINED
        and pair in matches  # a database of another program may hold what was verified alone
        and posed[list(pair)].all()
        and freed.explained(*pair, matches[pair]).sum() >= _LEAST_SHARE * count
    ]
    m = len(matched.names)
    first, second = np.array(linked, int).reshape(-1, 2).T
    part = connected_components(coo_matrix((np.ones(len(linked)), (first, second)), (m, m)), directed=False)[1]
    sizes = np.bincount(part[posed], minlength=part.max() + 1)
    return np.asarray(posed & (part == np.argmax(sizes)))


def sampson_distance(x_1: Array, x_2: Array, R_21: Array, t_21: Array) -> Array:
    """Distance of matches from a relative pose: to first order, the displacement of both that makes them fit.

    Parameters
    ----------
    x_1, x_2 : (n, 3) arrays
        Normalized coordinates and 1; NaN where there are none.
    R_21, t_21 : (3, 3) and (3,) or (n, 3) arrays
        From the first camera to the second, `x_2 ~ R_21 X_1 + t_21`; of each match, if the cameras travelled.

    Returns
    -------
    (n,) array
        In normalized coordinates; NaN where these are. Inf for two photos from one place, which have no planes.
    """
    length = np.linalg.norm(t_21, axis=-1, keepdims=True)
    t_21 = t_21 / np.maximum(length, 1e-300)
    distance = _distance_from_lines(x_2, np.cross(x_2, t_21) @ R_21, np.cross(t_21, x_1 @ R_21.T))
    return np.where(length[..., 0] > 0, distance, np.inf)


def distance_from_planes(x_1: Array, x_2: Array, E: Array) -> Array:
    """Distance of matches from the epipolar planes of an essential matrix, as in `sampson_distance`."""
    return _distance_from_lines(x_2, x_2 @ E, x_1 @ E.T)


def _distance_from_lines(x_2: Array, line_1: Array, line_2: Array) -> Array:
    """Sampson's distance by the epipolar lines (n, 3) in both photos."""
    slope = np.sqrt((line_1[:, :2] ** 2).sum(1) + (line_2[:, :2] ** 2).sum(1))
    return np.asarray(np.abs((line_2 * x_2).sum(1)) / np.maximum(slope, 1e-300))
