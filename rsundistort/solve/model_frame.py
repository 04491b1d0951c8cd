"""The frame of a given model: a solution is moved back into it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..bundle import BundleResult
from ..model import Reconstruction
from ..model.array_types import Array
from ..model.similarity import Similarity, fit_similarity, similarity_of
from .outcome import Solved

__all__ = ["in_frame_of", "similarity_to"]

# A similarity needs so many photos, and so many estimates until it knows how far they are off.
_LEAST = 3
_ROUNDS = 3
# Deviations below these, in spreads of the cameras and in radians, are rounding.
_LEAST_OFF, _LEAST_RAD = 1e-9, 1e-9


def in_frame_of(solved: Solved, given: Reconstruction) -> Solved:
    """A solution in the frame of the model that it began with.

    An adjustment holds one pose and one distance, which the shutter had displaced as it had all others. What the model
    says of the frame, its metres too, all of its photos say: their centres are aligned, and their rotations determine
    what centres along a line do not.
    """
    found = similarity_to(solved.shared, given)
    if found is None:
        return solved
    after, before = (_moved(each, found) for each in (solved.result, solved.global_result))
    return replace(solved, result=after, global_result=before)


def similarity_to(rec: Reconstruction, given: Reconstruction) -> Similarity | None:
    """What moves a reconstruction into the frame of a given one; None where too few photos are in both."""
    place = {name: i for i, name in enumerate(given.image_names)}
    pairs = np.array([(i, place[name]) for i, name in enumerate(rec.image_names) if name in place]).reshape(-1, 2)
    here, there = pairs.T
    points, targets = rec.center_w[here], given.center_w[there]
    spread = min(float(np.linalg.norm(each - each.mean(0), axis=1).max(initial=0.0)) for each in (points, targets))
    if len(pairs) < _LEAST or spread == 0:
        return None
    turns = Rotation.from_matrix(given.R_cw[there].transpose(0, 2, 1) @ rec.R_cw[here])
    mean = turns.mean()
    sigma_rad = max(float(np.median((turns * mean.inv()).magnitude())), _LEAST_RAD)
    found = similarity_of(points, targets)
    for _ in range(_ROUNDS):  # photos that are far off shall not say how far all are
        off = float(np.median(np.linalg.norm(found.of(points) - targets, axis=1)))
        sigma = np.full(points.shape, max(off, _LEAST_OFF * spread))
        fit = fit_similarity(points, targets, sigma)
        if not (fit.sigma_rad < sigma_rad).all():
            fit = fit_similarity(points, targets, sigma, (mean.as_matrix(), sigma_rad))
        found = fit.similarity
    return found


def _moved(result: BundleResult, similarity: Similarity) -> BundleResult:
    """An adjustment of a scene, the scene moved."""
    return replace(
        result,
        reconstruction=similarity.of_reconstruction(result.reconstruction),
        covariances=_moved_covariances(result.covariances, similarity),
    )


def _moved_covariances(covariances: Array, similarity: Similarity) -> Array:
    """Covariances (m, nb, nb) of rotation, centre, phi and velocity: centre and velocity are the world's."""
    size = covariances.shape[1]
    step = np.eye(size)
    for start in range(3, size, 6):
        step[start : start + 3, start : start + 3] = similarity.scale * similarity.R
    return np.asarray(step @ covariances @ step.T)
