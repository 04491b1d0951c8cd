"""The matches that fit the poses of a reconstruction, and the photos that contradict the others."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..colmap.conventions import quiet_pycolmap
from ..model import Reconstruction
from ..model.projection import unproject_points
from .database import MatchedPhotos

__all__ = [
    "MIN_EXPLAINED",
    "TIGHT_PX",
    "FreedMatches",
    "Matches",
    "agreeing_photos",
    "distance_from_planes",
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
    """Matches under a reconstruction: rays without lens and shutter.

    Parameters
    ----------
    matched : MatchedPhotos
        Keypoints of at least the reconstruction's photos.
    reconstruction : Reconstruction
        Poses, motions and cameras.
    """

    def __init__(self, matched: MatchedPhotos, reconstruction: Reconstruction) -> None:
        index_of = {name: i for i, name in enumerate(reconstruction.image_names)}
        self.posed = np.array([index_of.get(name, -1) for name in matched.names])
        self._matched, self._rec = matched, reconstruction
        self._rays: dict[int, NDArray[np.float64]] = {}

    def _rays_of(self, photo: int) -> NDArray[np.float64]:
        if photo not in self._rays:
            rec, i = self._rec, int(self.posed[photo])
            xy, valid = unproject_points(
                self._matched.features[photo].xy_raw, rec.camera(i), rec.motion(i), rec.shutter_model
            )
            self._rays[photo] = np.column_stack([np.where(valid[:, None], xy, np.nan), np.ones(len(xy))])
        return self._rays[photo]

    def explained(self, first: int, second: int, matches: NDArray[np.integer]) -> NDArray[np.bool_]:
        """(n,) whether both rays of a match are within tight thresholds of the other's epipolar plane (Sampson).

        Photos are counted as in `matched`; none is explained where one of them has no pose.
        """
        i, j = int(self.posed[first]), int(self.posed[second])
        if i < 0 or j < 0:
            return np.zeros(len(matches), bool)
        rec, features = self._rec, self._matched.features
        distance = sampson_distance(
            self._rays_of(first)[matches[:, 0]], self._rays_of(second)[matches[:, 1]], rec.R_cw[j] @ rec.R_cw[i].T,
            rec.R_cw[j] @ (rec.center_w[i] - rec.center_w[j]),
        )  # fmt: skip
        allowed = [
            TIGHT_PX * features[k].step_px / float(rec.camera(posed).K[0, 0]) for k, posed in ((first, i), (second, j))
        ]
        return distance <= max(allowed)


#: Keypoints of two photos that match, by the pair of photos as in `MatchedPhotos`: (n, 2) int arrays.
Matches = dict[tuple[int, int], NDArray[np.int64]]


def read_matches(matched: MatchedPhotos) -> Matches:
    """All matches of a database."""
    pycolmap = quiet_pycolmap()
    with pycolmap.Database.open(matched.database) as db:
        pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in db.read_all_matches()[0]]
        return {(i - 1, j - 1): np.asarray(db.read_matches(i, j), np.int64) for i, j in pairs}


def read_verified(matched: MatchedPhotos) -> Matches:
    """Matches of a database that the epipolar geometry of their pair fits."""
    pycolmap = quiet_pycolmap()
    with pycolmap.Database.open(matched.database) as db:
        pair_ids, geometries = db.read_two_view_geometries()
    pairs = (pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids)
    found = zip(pairs, (np.asarray(each.inlier_matches, np.int64) for each in geometries), strict=True)
    return {(i - 1, j - 1): matches.reshape(-1, 2) for (i, j), matches in found}


def read_num_verified(matched: MatchedPhotos) -> dict[tuple[int, int], int]:
    """Number of matches of each pair that fit one loose epipolar geometry, from the database before new tracks."""
    pycolmap = quiet_pycolmap()
    with pycolmap.Database.open(matched.database) as db:
        pair_ids, counts = db.read_two_view_geometry_num_inliers()
    pairs = (pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids)
    return {(i - 1, j - 1): int(count) for (i, j), count in zip(pairs, counts, strict=True)}


def agreeing_photos(
    matched: MatchedPhotos,
    matches: Matches,
    num_verified: Mapping[tuple[int, int], int],
    reconstruction: Reconstruction,
) -> NDArray[np.bool_]:
    """Photos of a reconstruction that are connected: the largest set linked by pairs that fit it.

    A pair links two photos if their poses explain half of what a loose epipolar geometry does.

    Parameters
    ----------
    matched, matches, num_verified
        Photos, their matches, and how many of these such a geometry fits.
    reconstruction : Reconstruction
        Poses and motions.

    Returns
    -------
    (m,) bool array
        By photo of `matched`. False for the rest, which another pose may fit better, and for photos without a pose.
    """
    from scipy.sparse import coo_matrix  # late: few runs need it
    from scipy.sparse.csgraph import connected_components

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


def sampson_distance(
    x_1: NDArray[np.float64], x_2: NDArray[np.float64], R_21: NDArray[np.float64], t_21: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance of matches from a relative pose: to first order, the displacement of both that makes them fit.

    Parameters
    ----------
    x_1, x_2 : (n, 3) arrays
        Normalized coordinates and 1; NaN where there are none.
    R_21, t_21 : (3, 3) and (3,) arrays
        From the first camera to the second, `x_2 ~ R_21 X_1 + t_21`.

    Returns
    -------
    (n,) array
        In normalized coordinates; NaN where these are. Inf for two photos from one place, which have no planes.
    """
    length = float(np.linalg.norm(t_21))
    if length == 0.0:
        return np.full(len(x_1), np.inf)
    x, y, z = t_21 / length
    return distance_from_planes(x_1, x_2, np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R_21)


def distance_from_planes(
    x_1: NDArray[np.float64], x_2: NDArray[np.float64], E: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance of matches from the epipolar planes of an essential matrix, as in `sampson_distance`."""
    line_2, line_1 = x_1 @ E.T, x_2 @ E
    slope = np.sqrt((line_1[:, :2] ** 2).sum(1) + (line_2[:, :2] ** 2).sum(1))
    return np.asarray(np.abs((line_2 * x_2).sum(1)) / np.maximum(slope, 1e-300))
