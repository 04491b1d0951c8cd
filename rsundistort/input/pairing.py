"""The photos of a run that are matched with each other."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..io import ExifFacts
from ..io.photos.images import natural_order
from ..model.array_types import Array, Index
from ..sfm import choose_pairs, global_descriptors
from .load import LoadedPhotos

__all__ = ["MATCHINGS", "capture_sequences", "pairs_of_clip", "pairs_to_match", "places_of"]

#: "auto" is "exhaustive" for small sets, and "neighbours" where that saves half of the pairs or more.
MATCHINGS = ("auto", "exhaustive", "neighbours")

# neighbours are about 25 for each photo
_EXHAUSTIVE_TO = 60
# Key frames of a video are matched with the most similar others that are not neighbours, by as many of their features.
_RETURNS, _SEEN_AGAIN_BY = 3, 256
_EARTH_RADIUS_M = 6371e3


def pairs_to_match(photos: LoadedPhotos, matching: str, seed: int) -> Index | None:
    """Pairs of neighbours in the order of capture, by GPS or by appearance; None for all pairs."""
    num_photos = len(photos.names)
    if matching == "exhaustive" or (matching == "auto" and num_photos <= _EXHAUSTIVE_TO):
        return None
    return choose_pairs(
        num_photos,
        capture_sequences(photos.names, photos.cameras.camera_idx, photos.facts),
        places_of(photos.facts),
        global_descriptors([each.descriptors for each in photos.features], seed),
    )


def pairs_of_clip(keys: LoadedPhotos, matching: str, seed: int) -> Index | None:
    """Pairs of key frames of a video, in its order; None for all.

    Each is matched with those 1, 2, 4, 8, ... further on, as long as the video: tracks connect what lies between, and
    far ones have the parallax that neighbours lack. The most similar others find what the camera returns to.
    """
    if matching == "exhaustive":
        return None
    num = len(keys.names)
    steps = 2 ** np.arange(math.ceil(math.log2(max(num, 2))))
    ahead = [np.column_stack([np.arange(num - step), np.arange(step, num)]) for step in steps.tolist()]
    largest = [each.descriptors[:_SEEN_AGAIN_BY] for each in keys.features]
    return choose_pairs(num, descriptors=global_descriptors(largest, seed), given=ahead, similar=_RETURNS)


def capture_sequences(names: Sequence[str], camera_idx: Index, facts: Sequence[ExifFacts]) -> list[Index]:
    """The photos of each camera in the order of capture: by its clock, else by the numbers in their names.

    Clocks of several cameras differ, so each has a sequence of its own. If photos of a camera lack a time, only the
    names count; they also order photos of the same second.
    """
    sequences = []
    for camera in range(int(camera_idx.max()) + 1):
        mine = np.flatnonzero(camera_idx == camera).tolist()
        timed = all(facts[k].taken_s is not None for k in mine)
        order = sorted(mine, key=lambda k: ((facts[k].taken_s or 0.0) if timed else 0.0, natural_order(names[k])))
        sequences.append(np.array(order, np.int64))
    return sequences


def places_of(facts: Sequence[ExifFacts]) -> Array:
    """(m, 3) places by GPS at sea level, metres from the centre of the Earth; NaN where a photo has none."""
    latitude, longitude = np.deg2rad([fact.place_deg or (np.nan, np.nan) for fact in facts]).T
    return _EARTH_RADIUS_M * np.column_stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    )
