"""Which photos of a reconstruction hang together, so that each has a place among the others."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask

__all__ = [
    "LEAST_MEASUREMENTS",
    "LEAST_TIES",
    "common_points",
    "connected_parts",
    "connected_photos",
    "firmly_connected",
    "other_scenes",
]

#: A photo with fewer measurements is not registered: a wrong place is worse than none.
LEAST_MEASUREMENTS = 20
#: A point of a known place gives two equations, and a photo with its rotation during the readout has nine unknowns:
#: with fewer points it is anywhere.
LEAST_TIES = 5
# Verified matches that two photos of one scene have; photos of two have fewer by chance.
_LEAST_MATCHES = 30
# A point is known, depth and all, as soon as so many photos show it.
_LEAST_PHOTOS = 2


def firmly_connected(reconstruction: Reconstruction) -> Reconstruction:
    """The largest part of a reconstruction whose poses are determined by equations, and what its photos show."""
    rec = reconstruction.without_photos(LEAST_MEASUREMENTS)
    connected = connected_photos(rec, LEAST_TIES)
    while not connected.all():
        rec = rec.take_photos(connected).without_photos(LEAST_MEASUREMENTS)
        connected = connected_photos(rec, LEAST_TIES)
    return rec


def other_scenes(num_verified: Mapping[tuple[int, int], int], is_registered: Mask) -> list[Index]:
    """Sets of three photos or more that match each other, of which none is registered or matches one that is."""
    m = len(is_registered)
    pairs = np.array([pair for pair, count in num_verified.items() if count >= _LEAST_MATCHES], int).reshape(-1, 2)
    label = connected_components(csr_matrix((np.ones(len(pairs)), pairs.T), (m, m)), directed=False)[1]
    sets = (np.flatnonzero(label == each) for each in np.unique(label[~is_registered]))
    return [photos for photos in sets if len(photos) > _LEAST_PHOTOS and not is_registered[photos].any()]


def common_points(reconstruction: Reconstruction) -> Array:
    """(m, m) number of points that two photos show."""
    shows = _shown(reconstruction, np.ones(len(reconstruction.observations), bool))
    return np.asarray((shows @ shows.T).toarray())


def connected_parts(reconstruction: Reconstruction) -> Index:
    """(m,) label of the part that each photo is in, by what photos show together."""
    return np.asarray(connected_components(common_points(reconstruction) >= LEAST_MEASUREMENTS)[1], np.int64)


def _shown(rec: Reconstruction, keep_obs: Mask) -> csr_matrix:
    """(m, n) 1 where a photo shows a point, by some observations; what it shows twice counts once."""
    where = rec.observations.frame_idx[keep_obs], rec.observations.point_idx[keep_obs]
    shows = csr_matrix((np.ones(keep_obs.sum()), where), (rec.num_images, rec.num_points))
    shows.data[:] = 1.0
    return shows


def connected_photos(reconstruction: Reconstruction, least: int = LEAST_MEASUREMENTS, *, in_common: int = 1) -> Mask:
    """(m,) the largest set of photos of which each shows `least` points whose place the others determine.

    A set grows from a pair: a photo is added if it shows so many points that two of the set show. Sets that have
    photos in common are one: one photo determines how they were rotated, two determine their scale, too. What two sets
    show of each other by less can be rotated and moved against each other: residuals are small wherever they are.
    """
    obs, m = reconstruction.observations, reconstruction.num_images
    # what two photos alone show ties no third to them
    ties = (reconstruction.track_lengths(np.ones(len(obs), bool)) > _LEAST_PHOTOS)[obs.point_idx]
    shows = _shown(reconstruction, ties)

    def grown(connected: Mask) -> Mask:
        new, count = connected, np.zeros(reconstruction.num_points)
        while new.any():
            count += shows[new].sum(0).A1
            new = ~connected & (shows @ (count >= _LEAST_PHOTOS) >= least)
            connected = connected | new
        return connected

    left, sets = np.ones(m, bool), list[Mask]()
    while left.any():
        first = int(np.argmax(np.where(left, shows.sum(1).A1, -1.0)))
        common = (shows @ shows[first].T).toarray().ravel()
        common[first] = -1.0
        connected = np.arange(m) == first
        if common.max() >= least:
            connected = grown(connected | (np.arange(m) == np.argmax(common)))
        while any(touching := [(each & connected).sum() >= in_common for each in sets]):
            both = np.any([connected, *(each for each, near in zip(sets, touching, strict=True) if near)], axis=0)
            sets = [each for each, near in zip(sets, touching, strict=True) if not near]
            connected = grown(both)
        sets.append(connected)
        left = left & ~connected
    return max(sets, key=lambda each: int(each.sum()), default=left)
