"""Matching and mapping of the photos: the start of all that is solved."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ..batch.progress import StageLog
from ..bundle import GuessedCameras
from ..errors import ReconstructionError
from ..input.load import LoadedPhotos, OtherFeatures
from ..input.pairing import pairs_of_clip, pairs_to_match
from ..io.kept import Kept
from ..model import Reconstruction
from ..model.array_types import Array, Index
from ..sfm import MatchedPhotos, map_photos, match_photos, read_num_verified, verify_with_shutter
from ..sfm.database import without_motions
from ..sfm.epipolar import matches_that_fit
from ..sfm.matching import LOOSE_PX, close_px, match_more
from .solutions import consistent
from .tracks import NO_PARALLAX

__all__ = ["map_key_frames", "match_without_motions", "place_photos"]

# Verified matches of a pair that overlaps, beyond doubt.
_MANY = 100
# Verified matches of a pair with which coarse features do. With more photos than `_ASKED`, so many pairs in their order
# are asked before all are matched, of which most must have that; each photo then has half of it at least.
_RICH, _ASKED, _MOST_OF_THEM, _AT_LEAST = 800, 16, 0.75, 0.5
# Key frames are mapped again so often at most.
_MAPPING_ROUNDS = 3
# Largest keypoints of a key frame that place it: neighbours show nearly all of them again.
_OF_CLIP = (512, 2048, None)


def place_photos(
    photos: LoadedPhotos,
    scratch: Path,
    log: StageLog,
    seed: int,
    matching: str,
    kept: Kept,
    *,
    with_shutter: bool = False,
    is_strong: bool = False,
    of_clip: bool = False,
    other: OtherFeatures | None = None,
) -> tuple[Reconstruction, MatchedPhotos]:
    """Match photos and map them, as of a global shutter; results of an earlier run are not computed again.

    Parameters
    ----------
    scratch : Path
        Folder for the database.
    seed, matching
        As in `solve_photos`.
    with_shutter : bool
        Whether pairs that a shutter hides are verified by relative poses with a shutter.
    is_strong : bool
        Whether that is known to be a strong one.
    of_clip : bool
        Whether they are key frames of a video in its order, which differ by little.
    other : OtherFeatures, optional
        Finer features, for photos whose coarse ones match too few of others.
    """
    match = partial(
        _match, scratch=scratch, log=log, seed=seed, matching=matching, kept=kept, with_shutter=with_shutter,
        is_strong=is_strong, of_clip=of_clip,
    )  # fmt: skip
    # without finer ones, coarse features have to do
    matched = match(photos if other is not None else replace(photos, coarse=frozenset()))
    if matched is None and other is not None:
        matched = match(other.finer())
    assert matched is not None
    log.begin("mapping", len(photos.names))
    guessed = None if photos.cameras.calibrated else photos.cameras.known_to(loose=True)
    key = f"mapped{_detail(photos)}" if photos.affine else "mapped"
    mapped: Reconstruction | None = kept.get(key)
    if mapped is None:
        try:
            map_them = partial(map_key_frames, guessed=guessed) if of_clip else map_photos
            mapped = map_them(matched, lambda done: log.tell("mapping", done, len(photos.names)))
        except ReconstructionError as error:
            overlapping = sum(count >= _MANY for count in read_num_verified(matched).values())
            if overlapping < len(photos.names) - 1:
                raise
            raise ReconstructionError(NO_PARALLAX) from error
        kept.put(key, mapped)
    log.end("mapping", photos=mapped.num_images, points=mapped.num_points, observations=len(mapped.observations))
    return mapped, matched


def map_key_frames(
    matched: MatchedPhotos, progress: Callable[[int], None] | None = None, guessed: GuessedCameras | None = None
) -> Reconstruction:
    """Key frames of a video, mapped again by the matches that fit their poses until that moves none of them.

    Neighbours of a video have hardly any parallax, and what they show may be one plane: false matches, and inexact
    ones, which have room for a shutter, may turn the rest of a video at any key frame, and give it another scale. Each
    half fits itself, so that nothing shows it; but few of these matches fit the poses.

    Mapping takes what the shutter bends for the lens's, knows nothing of what lenses are like, and lets them run away
    where lines rotate fast, or hardly any parallax holds them (k1 = 9 where they rotate by two degrees, 58 before a
    global shutter). A path finds the way back from a focal length that is off, but not from a scene that is bent like
    that. So a lens that would be a surprise is held as it was guessed.

    Other parameters and errors are those of `sfm.map_photos`.

    Parameters
    ----------
    guessed : GuessedCameras, optional
        What is known of the lens, if it is a guess.
    """
    mapped = map_photos(matched, progress, _OF_CLIP)
    if guessed is not None and guessed.surprises(mapped.cameras):
        matched = replace(matched, calibrated=True)
        mapped = map_photos(matched, progress, _OF_CLIP)
    num_fitting = _num_fitting(matched, mapped)
    for _ in range(_MAPPING_ROUNDS):
        rough, before = mapped, num_fitting
        try:
            again = map_photos(replace(matched, cameras=rough.cameras), keypoints=_OF_CLIP, rough=rough)
        except ReconstructionError:
            break
        num_fitting = _num_fitting(matched, again)
        if again.num_images < rough.num_images or num_fitting < before:
            break
        mapped = again
        if consistent(rough, again):
            break
    return mapped


def _num_fitting(matched: MatchedPhotos, reconstruction: Reconstruction) -> int:
    """How many matches fit poses."""
    return sum(map(len, matches_that_fit(matched, reconstruction).values()))


def _match(
    photos: LoadedPhotos,
    scratch: Path,
    log: StageLog,
    seed: int,
    matching: str,
    kept: Kept,
    *,
    with_shutter: bool,
    is_strong: bool,
    of_clip: bool,
) -> MatchedPhotos | None:
    """Photos matched with each other, as in `place_photos`; None if their features are too coarse for that."""
    detail = _detail(photos)
    cameras, database = photos.cameras, scratch / f"database{detail.replace(' ', '-')}.db"
    log.begin("matching")
    given = database, photos.names, photos.features, cameras.cameras, cameras.camera_idx
    counts: dict[str, float] | None = kept.get(f"pairs{detail}")
    if counts is not None and kept.get_file(f"database{detail}", database):
        matched = MatchedPhotos(*given, calibrated=cameras.calibrated, seed=seed)
    else:
        choose = pairs_of_clip if of_clip else pairs_to_match
        within_px = LOOSE_PX
        if of_clip:
            # content moves by little from one to the next, and so does the distortion of the shutter
            within_px = close_px(photos.features)
        start = partial(match_photos, *given, calibrated=cameras.calibrated, seed=seed, within_px=within_px)
        asks = bool(photos.coarse) and len(photos.names) > _ASKED
        if asks:
            matched = start(pairs=_neighbours(len(photos.names)))
            rich = sum(count >= _RICH for count in read_num_verified(matched).values())
            if rich < _MOST_OF_THEM * _ASKED:
                log.end("matching", of="coarse features", rich=False)
                return None
        pairs, num_pairs = choose(photos, matching, seed), math.comb(len(photos.names), 2)
        if asks:
            match_more(matched, within_px=within_px, pairs=pairs)
        else:
            matched = start(pairs=pairs)
        counts = {"pairs": num_pairs if pairs is None else len(pairs), "of_pairs": num_pairs}
        if with_shutter:
            counts["spread_rad"] = verify_with_shutter(matched, is_strong=is_strong)
        kept.put_file(f"database{detail}", database)
        kept.put(f"pairs{detail}", counts)
    log.end("matching", **counts)
    return matched if not photos.coarse or _all_are_rich(matched) else None


def match_without_motions(
    photos: LoadedPhotos,
    rec: Reconstruction,
    folder: Path,
    log: StageLog,
    seed: int,
    matching: str,
    rough_phi: Mapping[str, Array],
) -> MatchedPhotos:
    """Photos matched again, with pairs verified by keypoints without the motions of a reconstruction of them.

    Parameters
    ----------
    folder : Path
        For the database.
    rough_phi : mapping of name to (3,) array
        Rotations of photos that it lacks.
    """
    log.begin("matching without motions")
    idx = photos.cameras.camera_idx
    own = [rec.cameras[k] for k in idx]
    phi = np.array([rough_phi.get(name, np.zeros(3)) for name in photos.names])
    for i, name in enumerate(rec.image_names):
        k = photos.names.index(name)
        own[k], phi[k] = rec.camera(i), rec.phi[i]
    matched = MatchedPhotos(folder / "database.db", photos.names, photos.features, rec.cameras, idx, True, seed)
    moved = without_motions(matched, phi, own)
    pairs = pairs_to_match(photos, matching, seed)
    match_photos(moved.database, moved.names, moved.features, moved.cameras, idx, seed=seed, pairs=pairs)
    log.end("matching without motions", pairs=len(read_num_verified(matched)))
    return matched


def _detail(photos: LoadedPhotos) -> str:
    """Which features they have, for the names of what is kept."""
    return " of affine features" if photos.affine else " of coarse features" if photos.coarse else ""


def _neighbours(count: int) -> Index:
    """(p, 2) some of the pairs of photos that follow each other."""
    first = np.linspace(0, count - 2, _ASKED).astype(np.int64)
    return np.stack([first, first + 1], axis=1)


def _all_are_rich(matched: MatchedPhotos) -> bool:
    """Whether each photo shares matches enough with one of the others."""
    most = dict.fromkeys(range(len(matched.names)), 0)
    for pair, count in read_num_verified(matched).items():
        for photo in pair:
            most[photo] = max(most[photo], count)
    return min(most.values()) >= _AT_LEAST * _RICH
