"""The rotation of each photo during its readout, from what all pairs of photos show of it together."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..colmap.conventions import quiet_pycolmap
from ..model import Reconstruction
from ..model.array_types import Array, Index
from .database import MatchedPhotos, without_motions, write_photos
from .epipolar import MIN_EXPLAINED, read_matches
from .mapping import map_photos
from .matching import verify_loosely
from .relative_pose import Pair, find_relative_pose, phi_information
from .verification import pair_of

__all__ = ["averaged_motions", "map_without_motions"]

# Rounds of the weights of pairs, and how many times the usual deviation of a pair halves its weight twice.
_ROUNDS, _TAIL = 30, 4.0
# Standard deviation of a component of the motions of a solution, radians a frame.
_KNOWN_RAD = 0.003


def averaged_motions(
    num_photos: int,
    pairs: Mapping[tuple[int, int], Pair],
    phi_sigma: float,
    known_phi: Mapping[int, Array] | None = None,
) -> Array:
    """Rotations phi (m, 3) of photos, radians per unit of the clock, that agree best with the relative poses of pairs.

    A pair alone hardly tells the motion of one photo from that of the other. Each pair is a normal distribution of
    both motions, whatever its pose; their product, under the prior, is what all say. False pairs are outvoted: a pair
    weighs less the farther it lies from the rest, in units of what pairs usually deviate by.

    Parameters
    ----------
    num_photos : int
        Number of photos m.
    pairs : mapping of (first, second) to Pair
        Matches of pairs of photos.
    phi_sigma : float
        Prior standard deviation of the components of phi, radians a frame.
    known_phi : mapping of int to (3,) array, optional
        Motions of some photos by a solution: a pair with one of these shows that of the other photo far better.
    """
    known_phi = known_phi or {}
    poses = {key: find_relative_pose(pair, phi_sigma) for key, pair in pairs.items()}
    found = {key: pose for key, pose in poses.items() if pose is not None}
    known = {key: (*phi_information(pose, pairs[key]), pose.phi.ravel()) for key, pose in found.items()}
    prior, expected = np.zeros((num_photos, 3)), np.zeros((num_photos, 3))
    for first, second in found:
        prior[[first, second]] = (pairs[first, second].frame_spans / phi_sigma).reshape(2, 3) ** 2
    for k, each in known_phi.items():
        prior[k], expected[k] = prior[k] * (phi_sigma / _KNOWN_RAD) ** 2, each
    phi, weights, usual = expected.ravel(), dict.fromkeys(found, 1.0), 1.0
    for _ in range(_ROUNDS if found else 0):
        # a photo without a pair has no motion
        A, b = np.diag(np.where(prior > 0, prior, 1.0).ravel()), (prior * expected).ravel()
        for key, (information, gradient, mean) in known.items():
            at = _components(*key)
            A[np.ix_(at, at)] += weights[key] / usual * information
            b[at] += weights[key] / usual * (information @ mean - gradient)
        phi = np.linalg.solve(A, b)
        apart = {key: _apart(phi[_components(*key)] - mean, each) for key, (each, _, mean) in known.items()}
        usual = max(float(np.median([*apart.values()])), 1e-9)
        weights = {key: (1.0 + each / (_TAIL * usual)) ** -2 for key, each in apart.items()}
    return phi.reshape(num_photos, 3)


def _components(first: int, second: int) -> Index:
    """Places of two photos' motions among those of all."""
    return np.concatenate([np.arange(3 * first, 3 * first + 3), np.arange(3 * second, 3 * second + 3)])


def _apart(step: Array, information: Array) -> float:
    """Mean square of six deviations in units of their standard deviations."""
    return float(step @ information @ step) / len(step)


def map_without_motions(
    matched: MatchedPhotos, phi_sigma: float, known_phi: Mapping[str, Array] | None = None
) -> Reconstruction:
    """What `map_photos` makes of the photos if their motions, averaged over pairs, are taken out of their keypoints.

    Pairs are verified anew: matches that a shutter hid are right then, and poses by which it explained false ones are
    not. The motions are rough, so the result is only another place to start from.

    Parameters
    ----------
    matched : MatchedPhotos
        Photos and their matches; cameras that are guesses are refined by mapping. Its database stays as it is.
    phi_sigma : float
        As in `averaged_motions`.
    known_phi : mapping of str to (3,) array, optional
        As there, by name.

    Returns
    -------
    Reconstruction
        With the raw pixels as measurements, and the motions that were taken out of them.

    Raises
    ------
    ReconstructionError
        When no two photos could be registered.
    """
    matches = {key: found for key, found in read_matches(matched).items() if len(found) >= MIN_EXPLAINED}
    pairs = {key: pair_of(matched, key, found) for key, found in matches.items()}
    known = {matched.names.index(name): each for name, each in (known_phi or {}).items()}
    phi = averaged_motions(len(matched.names), pairs, phi_sigma, known)
    folder = Path(tempfile.mkdtemp(prefix="without-motions-", dir=matched.database.parent))
    moved = replace(without_motions(matched, phi), database=folder / "database.db")
    with quiet_pycolmap().Database.open(moved.database) as db:
        write_photos(db, moved)
        for (first, second), found in matches.items():
            db.write_matches(first + 1, second + 1, found.astype(np.uint32))
    verify_loosely(moved)
    mapped = map_photos(moved, shown=matched)
    return replace(mapped, phi=phi[[matched.names.index(name) for name in mapped.image_names]])
