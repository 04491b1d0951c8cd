"""Matching of photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colmap.conventions import quiet_pycolmap
from ..model import Camera
from ..model.array_types import Index
from .codebook import make_codebook
from .database import LOOSE, MatchedPhotos, verification_options, write_photos
from .descriptor_matches import DescriptorIndex, match_descriptors
from .epipolar import MIN_EXPLAINED, distance_from_planes, photo_pairs
from .features import Features

__all__ = ["LOOSE_PX", "close_px", "match_more", "match_photos", "verify_loosely"]

Pair = tuple[int, int]

#: Largest distance of matches from epipolar lines, in the pixels that features were detected in: COLMAP's own, and in
#: those of the photo, with room for the shutter.
CLOSE_PX, LOOSE_PX = 4.0, 4.0 * LOOSE
# A pair has room for the shutter if the close geometry keeps a smaller share of the matches that lie within the wide
# distance. Wide epipolar lines have any direction where there is hardly any parallax: photos that follow each other
# along a street come out in a wrong place by them, with the same matches.
_KEPT = 0.95
# Photos whose descriptors are kept sorted by words.
_INDICES = 256


def match_photos(
    database: Path,
    names: Sequence[str],
    features: Sequence[Features],
    cameras: Sequence[Camera],
    camera_idx: Index,
    *,
    calibrated: bool = True,
    focal_known: bool = True,
    within_px: float = LOOSE_PX,
    seed: int = 0,
    pairs: Index | None = None,
) -> MatchedPhotos:
    """Match photos with each other and verify the pairs, with room for shutter distortion.

    Parameters
    ----------
    database : Path
        File to make.
    names, features, cameras, camera_idx
        As in `MatchedPhotos`.
    calibrated : bool
        Whether the cameras are known.
    focal_known : bool
        Whether their focal lengths are, at least roughly; else pairs are verified without these.
    within_px : float
        Largest distance of verified matches from their epipolar lines, in the pixels of the photos. Pairs that lose
        few matches by that get the geometry of `CLOSE_PX`.
    pairs : (p, 2) int array, optional
        Pairs to match, as `choose_pairs` gives them; by default all.
    """
    matched = MatchedPhotos(database, tuple(names), tuple(features), tuple(cameras), camera_idx, calibrated, seed)
    with quiet_pycolmap().Database.open(database) as db:
        write_photos(db, matched)
        if not focal_known:
            for camera in db.read_all_cameras():
                camera.has_prior_focal_length = False
                db.update_camera(camera)
    match_more(matched, within_px=within_px, pairs=pairs)
    return matched


def match_more(matched: MatchedPhotos, *, within_px: float = LOOSE_PX, pairs: Index | None = None) -> None:
    """Match and verify further pairs of photos; those that were matched before stay as they are.

    The photos are those of `match_photos`, and get the matches; `within_px` and `pairs` are as there.
    """
    close = close_px(matched.features)
    asked = combinations(range(len(matched.names)), 2) if pairs is None else np.sort(pairs, axis=1).tolist()
    with quiet_pycolmap().Database.open(matched.database) as db:
        # pycolmap lists no pairs that were found to have none
        once = sorted({(first, second) for first, second in asked})
        new = [(first, second) for first, second in once if not db.exists_matches(first + 1, second + 1)]
    kinds = [0] if all(each.kind is None for each in matched.features) else [0, 1]
    matchers = [_matcher_of(matched, kind) for kind in kinds]
    with quiet_pycolmap().Database.open(matched.database) as db:
        for first, second in new:
            db.write_matches(first + 1, second + 1, np.vstack([match(first, second) for match in matchers]))
    _verify(matched, new, min(within_px, close))
    if close < within_px:  # with room for the shutter where the geometry without it loses matches
        with quiet_pycolmap().Database.open(matched.database) as db:
            lossy = [pair for pair in new if _loses_matches(db, *pair, close, within_px)]
        _verify(matched, lossy, within_px)


def _matcher_of(matched: MatchedPhotos, kind: int) -> Callable[[int, int], NDArray[np.uint32]]:
    """What gives the matches (k, 2) of two photos among their features of a kind."""
    which = [each.of_kind(kind) for each in matched.features]
    descriptors = [each.descriptors[mine] for each, mine in zip(matched.features, which, strict=True)]
    words = make_codebook(descriptors, matched.seed)
    index_of = lru_cache(_INDICES)(lambda photo: DescriptorIndex.of(descriptors[photo], words))

    def match(first: int, second: int) -> NDArray[np.uint32]:
        one, other = match_descriptors(index_of(first), index_of(second)).T
        return np.column_stack([which[first][one], which[second][other]]).astype(np.uint32)

    return match


def verify_loosely(matched: MatchedPhotos) -> None:
    """Verify all matches, by the keypoints of the database, with room for a shutter that is strong."""
    _verify(matched, sorted(_matched_pairs(matched)), LOOSE_PX)


def close_px(features: Sequence[Features]) -> float:
    """Largest distance from epipolar lines where neither lens nor shutter displaces anything, in pixels of photos."""
    return CLOSE_PX * float(np.median([each.step_px for each in features]))


def _loses_matches(db: Any, first: int, second: int, close: float, within_px: float) -> bool:
    """Whether clearly more matches lie within the wide distance of the epipolar lines than within the close one."""
    geometry = db.read_two_view_geometry(first + 1, second + 1)
    if geometry.E is None or len(geometry.inlier_matches) < MIN_EXPLAINED:
        return True
    matches = np.asarray(db.read_matches(first + 1, second + 1), np.int64)
    rays, focal_px = [], []
    for photo, keypoint in zip((first, second), matches.T, strict=True):
        camera = db.read_camera(db.read_image(photo + 1).camera_id)
        xy = db.read_keypoints(photo + 1)[keypoint, :2].astype(np.float64)
        rays.append(np.column_stack([camera.cam_from_img(xy), np.ones(len(xy))]))
        focal_px.append(camera.mean_focal_length())
    distance_px = distance_from_planes(rays[0], rays[1], geometry.E) * float(np.mean(focal_px))
    return bool((distance_px <= close).sum() < _KEPT * (distance_px <= within_px).sum())


def _verify(matched: MatchedPhotos, pairs: Sequence[Pair], within_px: float) -> None:
    """Verify pairs that have matches; geometries that they had are forgotten."""
    if pairs:
        with quiet_pycolmap().Database.open(matched.database) as db:
            for first, second in pairs:
                db.delete_two_view_geometry(first + 1, second + 1)
        options = verification_options(within_px, matched.seed)
        quiet_pycolmap().verify_matches(matched.database, _listed(matched, np.array(pairs)), options)


def _listed(matched: MatchedPhotos, pairs: Index) -> Path:
    """A file of pairs."""
    path = matched.database.with_name("pairs.txt")
    np.savetxt(path, np.asarray(pairs) + 1, fmt="%d")
    return path


def _matched_pairs(matched: MatchedPhotos) -> set[Pair]:
    """Pairs that have matches."""
    with quiet_pycolmap().Database.open(matched.database) as db:
        return set(photo_pairs(db.read_all_matches()[0]))
