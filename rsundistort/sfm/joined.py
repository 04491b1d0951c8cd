"""Which photos of a reconstruction hang together, so that each has a place among the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..model import Reconstruction

__all__ = ["LEAST_MEASUREMENTS", "firmly_joined", "hanging_together"]

#: A photo with fewer measurements is not joined: a wrong place is worse than none.
LEAST_MEASUREMENTS = 20

# A point is known, depth and all, as soon as so many photos show it.
_LEAST_PHOTOS = 2


def firmly_joined(reconstruction: Reconstruction) -> Reconstruction:
    """The largest part of a reconstruction whose photos hang together, and what they show."""
    rec = reconstruction.without_photos(LEAST_MEASUREMENTS)
    joined = hanging_together(rec)
    while not joined.all():
        rec = rec.take_photos(joined).without_photos(LEAST_MEASUREMENTS)
        joined = hanging_together(rec)
    return rec


def hanging_together(reconstruction: Reconstruction) -> NDArray[np.bool_]:
    """(m,) the largest set of photos of which each shows points whose place the others tell.

    A set grows from a pair: a photo joins if it shows so many points (`LEAST_MEASUREMENTS`) that two of the set show.
    What two sets show of each other by less can be turned, moved and scaled against each other: residuals are small
    wherever they are.
    """
    from scipy.sparse import csr_matrix  # late: few runs need it

    obs, m = reconstruction.observations, reconstruction.num_images
    # what two photos alone show ties no third to them
    ties = (reconstruction.track_lengths(np.ones(len(obs), bool)) > _LEAST_PHOTOS)[obs.point_idx]
    where = obs.frame_idx[ties], obs.point_idx[ties]
    shows = csr_matrix((np.ones(ties.sum()), where), (m, reconstruction.num_points))
    shows.data[:] = 1.0  # what a photo shows twice counts once
    left, largest = np.ones(m, bool), np.zeros(m, bool)
    while left.any():
        first = int(np.argmax(np.where(left, shows.sum(1).A1, -1.0)))
        common = (shows @ shows[first].T).toarray().ravel()
        common[first] = -1.0
        joined = new = np.isin(np.arange(m), [first, np.argmax(common)])
        count = np.zeros(reconstruction.num_points)
        while new.any():
            count += shows[new].sum(0).A1
            new = ~joined & (shows @ (count >= _LEAST_PHOTOS) >= LEAST_MEASUREMENTS)
            joined = joined | new
        left = left & ~joined
        if joined.sum() > largest.sum():
            largest = joined
    return largest
