"""Matching and mapping of the photos: the start of all that is solved."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..batch.progress import StageLog
from ..colmap.conventions import quiet_pycolmap
from ..errors import ReconstructionError
from ..input.load import LoadedPhotos
from ..input.pairing import pairs_of_clip, pairs_to_match
from ..io.kept import Kept
from ..model import Reconstruction
from ..sfm import MatchedPhotos, map_photos, match_photos, verify_with_shutter
from ..sfm.mapping import PLACING_KEYPOINTS
from ..sfm.matching import LOOSE_PX

__all__ = ["place_photos"]

# Verified matches of a pair that overlaps, beyond doubt.
_MANY = 100
# Largest distance from epipolar lines of matches between key frames of a video, in the pixels that features are
# detected in. Content moves by little from one to the next, and so does the shutter's distortion: with four times as
# much, these lines have any direction where there is hardly any parallax, and poses go wrong.
_CLOSE_PX = 4.0
# Largest keypoints of a key frame that place it: neighbours show nearly all of them again.
_OF_CLIP = (512, 2048, None)


def _num_verified(matched: MatchedPhotos) -> int:
    """Pairs of photos that overlap beyond doubt."""
    with quiet_pycolmap().Database.open(matched.database) as db:
        _, counts = db.read_two_view_geometry_num_inliers()
    return sum(count >= _MANY for count in counts)


def place_photos(
    photos: LoadedPhotos,
    scratch: Path,
    log: StageLog,
    seed: int,
    matching: str,
    kept: Kept,
    *,
    with_shutter: bool = False,
    of_clip: bool = False,
) -> tuple[Reconstruction, MatchedPhotos]:
    """Match photos and map them, as of a global shutter; results of an earlier run are not computed again.

    Parameters
    ----------
    photos : LoadedPhotos
        Features and cameras.
    scratch : Path
        Folder for the database.
    log : StageLog
        Gets the progress.
    seed, matching
        As in `solve_photos`.
    kept : Kept
        Takes the results, for resuming.
    with_shutter : bool
        Whether pairs that a shutter hides are verified by relative poses with a shutter.
    of_clip : bool
        Whether they are key frames of a video in its order, which differ by little.
    """
    cameras, database = photos.cameras, scratch / "database.db"
    log.begin("matching")
    given = database, photos.names, photos.features, cameras.cameras, cameras.camera_idx
    counts: dict[str, float] | None = kept.get("pairs")
    if counts is not None and kept.get_file("database", database):
        matched = MatchedPhotos(*given, calibrated=cameras.calibrated, seed=seed)
    else:
        choose = pairs_of_clip if of_clip else pairs_to_match
        pairs, num_pairs = choose(photos, matching, seed), math.comb(len(photos.names), 2)
        within_px = LOOSE_PX
        if of_clip:
            within_px = _CLOSE_PX * float(np.median([each.step_px for each in photos.features]))
        matched = match_photos(*given, calibrated=cameras.calibrated, seed=seed, pairs=pairs, within_px=within_px)
        counts = {"pairs": num_pairs if pairs is None else len(pairs), "of_pairs": num_pairs}
        if with_shutter:
            counts["spread_rad"] = verify_with_shutter(matched)
        kept.put_file("database", database)
        kept.put("pairs", counts)
    log.end("matching", **counts)
    log.begin("mapping", len(photos.names))
    mapped: Reconstruction | None = kept.get("mapped")
    if mapped is None:
        try:
            keypoints = _OF_CLIP if of_clip else PLACING_KEYPOINTS
            mapped = map_photos(matched, lambda done: log.tell("mapping", done, len(photos.names)), keypoints)
        except ReconstructionError as error:
            if _num_verified(matched) < len(photos.names) - 1:
                raise
            raise ReconstructionError(
                "the photos overlap, but show no parallax: the camera stood still or only rotated; "
                "use photos from places apart"
            ) from error
        kept.put("mapped", mapped)
    log.end("mapping", photos=mapped.num_images, points=mapped.num_points, observations=len(mapped.observations))
    return mapped, matched
