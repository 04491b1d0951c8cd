"""Verification of pairs by a relative pose that knows the shutter, where the shutter is strong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..colmap.conventions import quiet_pycolmap
from ..model.array_types import Index
from .database import MatchedPhotos
from .epipolar import MIN_EXPLAINED, Matches, read_matches
from .matching import verify_loosely
from .relative_pose import (
    INLIER_PX,
    NO_SHUTTER,
    Pair,
    RelativePose,
    View,
    best_relative_pose,
    find_relative_pose,
    relative_poses,
)

__all__ = ["pair_of", "verify_with_shutter"]

# So many pairs of the most matches, and so many matches of each, show how strong the shutter is.
_ASKED, _MATCHES = 6, 300
# Pairs are worth it where photos rotated by so much while they were read, in radians, and where poses without a shutter
# lose such a share of the matches that they explain with one. What a lens does that nobody knows can look like either.
_STRONG_RAD, _LOST = 0.05, 0.05


def verify_with_shutter(matched: MatchedPhotos, is_strong: bool = False) -> float:
    """Add to the verified matches those that a relative pose with a shutter explains, where photos rotated by much.

    A few pairs show how strong the shutter is. Pairs of weak ones stay as they are: an essential matrix with loose
    thresholds takes all that is right there.

    Parameters
    ----------
    matched : MatchedPhotos
        Photos with their matches; verified ones are added to its database.
    is_strong : bool
        Whether it is known already that photos rotated by much.

    Returns
    -------
    float
        Prior standard deviation of the components of phi, in radians a frame.
    """
    matches = {pair: found for pair, found in read_matches(matched).items() if len(found) >= MIN_EXPLAINED}
    most = sorted(matches, key=lambda pair: (-len(matches[pair]), pair))[:_ASKED]
    if not most:
        return 0.0
    pairs = [pair_of(matched, pair, matches[pair][:_MATCHES]) for pair in most]
    poses, spread = relative_poses(pairs)
    if not is_strong and spread >= _STRONG_RAD:
        without = [best_relative_pose(pair, NO_SHUTTER) for pair in pairs]
        within_px = INLIER_PX * matched.step_px
        explained = _num_explained(poses, pairs, within_px)
        is_strong = _num_explained(without, pairs, within_px) < (1.0 - _LOST) * explained
    if is_strong:
        # a geometry that few pixels are wide holds for a part of the frame only
        verify_loosely(matched)
        _add_explained(matched, matches, spread)
    return spread


def _num_explained(poses: Sequence[RelativePose | None], pairs: Sequence[Pair], within_px: float) -> int:
    """Matches that lie near the epipolar planes of poses."""
    found = (
        (pose.distances_px(pair) < within_px).sum() for pose, pair in zip(poses, pairs, strict=True) if pose is not None
    )
    return int(sum(found))


def pair_of(matched: MatchedPhotos, pair: tuple[int, int], matches: Index) -> Pair:
    """The matches of two photos, as each shows them."""
    first, second = (
        View.of(matched.features[photo].xy_raw[matches[:, side]], matched.cameras[matched.camera_idx[photo]])
        for side, photo in enumerate(pair)
    )
    return Pair(first, second)


def _add_explained(matched: MatchedPhotos, matches: Matches, spread: float) -> None:
    """Write the matches that relative poses with such motions explain beside those that are verified already."""
    pycolmap = quiet_pycolmap()
    with pycolmap.Database.open(matched.database) as db:
        verified = set(db.read_two_view_geometry_num_inliers()[0])
        for (first, second), found in matches.items():
            views = pair_of(matched, (first, second), found)
            pose = find_relative_pose(views, spread)
            if pose is None:
                continue
            step_px = max(matched.features[photo].step_px for photo in (first, second))
            explained = found[pose.distances_px(views) < INLIER_PX * step_px]
            if len(explained) < MIN_EXPLAINED:
                continue
            ids = first + 1, second + 1
            geometry: Any = pycolmap.TwoViewGeometry()
            if pycolmap.image_pair_to_pair_id(*ids) in verified:
                geometry = db.read_two_view_geometry(*ids)
                explained = np.unique(np.concatenate([explained, np.asarray(geometry.inlier_matches)]), axis=0)
            # a pair that was found to have no geometry has an entry, too
            db.delete_two_view_geometry(*ids)
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = explained.astype(np.uint32)
            db.write_two_view_geometry(*ids, geometry)
