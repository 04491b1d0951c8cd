"""Matching of photos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..colmap.conventions import quiet_pycolmap
from ..model import Camera
from .database import LOOSE, MatchedPhotos, verification_options, write_photos
from .features import Features

__all__ = ["LOOSE_PX", "match_more", "match_photos"]

#: Largest distance of matches from epipolar lines that leaves room for the shutter: `LOOSE` times that of COLMAP.
LOOSE_PX = 4.0 * LOOSE


def match_photos(
    database: Path,
    names: Sequence[str],
    features: Sequence[Features],
    cameras: Sequence[Camera],
    camera_idx: NDArray[np.int64],
    *,
    calibrated: bool = True,
    focal_known: bool = True,
    within_px: float = LOOSE_PX,
    seed: int = 0,
    pairs: NDArray[np.int64] | None = None,
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
        Largest distance of verified matches from their epipolar lines.
    seed : int
        Seed of the verification.
    pairs : (p, 2) int array, optional
        Pairs to match, as `choose_pairs` gives them; by default all.
    """
    pycolmap = quiet_pycolmap()
    matched = MatchedPhotos(database, tuple(names), tuple(features), tuple(cameras), camera_idx, calibrated, seed)
    with pycolmap.Database.open(database) as db:
        write_photos(db, matched)
        if not focal_known:
            for camera in db.read_all_cameras():
                camera.has_prior_focal_length = False
                db.update_camera(camera)
        sift = pycolmap.FeatureExtractorType.SIFT
        for index, found in enumerate(features):
            db.write_descriptors(index + 1, pycolmap.FeatureDescriptors(type=sift, data=found.descriptors))
    match_more(matched, within_px=within_px, pairs=pairs)
    return matched


def match_more(matched: MatchedPhotos, *, within_px: float = LOOSE_PX, pairs: NDArray[np.int64] | None = None) -> None:
    """Match and verify further pairs of photos; those that were matched before stay as they are.

    Parameters
    ----------
    matched : MatchedPhotos
        Photos of `match_photos`; gets the matches.
    within_px, pairs
        As there.
    """
    pycolmap, database = quiet_pycolmap(), matched.database
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    verification = verification_options(within_px, matched.seed)
    if pairs is None:
        pycolmap.match_exhaustive(database, matching, verification_options=verification, device=pycolmap.Device.cpu)
    else:
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = database.with_name("pairs.txt")
        np.savetxt(pairing.match_list_path, np.asarray(pairs) + 1, fmt="%d")
        pycolmap.match_image_pairs(
            database, matching, pairing, verification_options=verification, device=pycolmap.Device.cpu
        )
