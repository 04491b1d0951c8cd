"""Matching and mapping of the photos: the start of all that is solved."""

from __future__ import annotations

import math
from pathlib import Path

from ..batch.progress import StageLog
from ..colmap.conventions import quiet_pycolmap
from ..errors import ReconstructionError
from ..input.load import LoadedPhotos
from ..input.pairing import pairs_to_match
from ..io.kept import Kept
from ..model import Reconstruction
from ..sfm import MatchedPhotos, map_photos, match_photos, verify_with_shutter

__all__ = ["place_photos"]

# Verified matches of a pair that overlaps, beyond doubt.
_MANY = 100


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
    """
    cameras, database = photos.cameras, scratch / "database.db"
    log.begin("matching")
    given = database, photos.names, photos.features, cameras.cameras, cameras.camera_idx
    counts: dict[str, float] | None = kept.get("pairs")
    if counts is not None and kept.get_file("database", database):
        matched = MatchedPhotos(*given, calibrated=cameras.calibrated, seed=seed)
    else:
        pairs, num_pairs = pairs_to_match(photos, matching, seed), math.comb(len(photos.names), 2)
        matched = match_photos(*given, calibrated=cameras.calibrated, seed=seed, pairs=pairs)
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
            mapped = map_photos(matched, lambda done: log.tell("mapping", done, len(photos.names)))
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
