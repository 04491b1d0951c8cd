"""What an adjustment leaves open: covariances of linear functions of photos and points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .options import BundleOptions, BundleResult
from .problem import BundleProblem, Spreads

__all__ = ["Posterior", "gauge_directions"]

Array = NDArray[np.float64]


class Posterior:
    """Covariances at a result, all unknowns being free but the anchors and the gauge.

    Parameters
    ----------
    result : BundleResult
        Where.
    options : BundleOptions, optional
        Those of the adjustment: anchors, known motions and refined intrinsics count.
    """

    def __init__(self, result: BundleResult, options: BundleOptions | None = None) -> None:
        rec = result.reconstruction
        spreads = Spreads(
            result.phi_sigma, max(result.velocity_sigma * rec.baseline, 1e-300),
            max(result.focal_sigma, 1e-300), max(result.centre_sigma, 1e-300),
        )  # fmt: skip
        plain = replace(options or BundleOptions(), loss="squared")
        self._problem = BundleProblem(rec, rec.shutter_model, plain, result.sigma_px, spreads)
        self._state = self._problem.initial_state()
        self._equations = self._problem.linearize(self._state)
        self._covariance = self._equations.covariance()
        self._own = 3 * plain.varying

    def of_photos(self, vectors: Array) -> Array:
        """Covariance of the photos' unknowns times vectors (k, m, nb), as in `BundleResult.covariances`."""
        return self._covariance(self._whole(vectors))[:, :, : vectors.shape[2]]

    def of_points(self, weights: Array) -> tuple[float, Array]:
        """Variance of a linear function of the points, `sum(weights * points_w)` with weights (n, 3).

        And its covariance (m, nb) with the photos' unknowns. NaN where the system cannot be factored.
        """
        variance, with_photos = self._problem.variance_of_points(self._state, weights)
        return variance, with_photos[:, : with_photos.shape[1] - self._own]

    def motions(self) -> tuple[Array, Array]:
        """Motions (m, k) of the photos and their covariances (m, k, k), as far as the model has them.

        One Gauss-Newton step from the result, which matters where the options free what was held in it.
        """
        covariances = self._equations.marginal_covariances()[0]
        solved = self._equations.solve(0.0)
        step = np.full(covariances.shape[:2], np.nan) if solved is None else solved[0][0]
        last = covariances.shape[1] - self._own
        motion = np.hstack([self._state.phi, self._state.velocity])[:, : last - 6] + step[:, 6:last]
        return motion, covariances[:, 6:last, 6:last]

    def squared_shifts(self) -> Array:
        """(m, k, k) mean over a photo's measurements of the squared displacement that a change of its motion causes.

        As a quadratic form, pixels squared. Where pose and points make up for the change in the photo as it was taken,
        it is the rectified photo that is displaced.
        """
        frame, _, noise_px = self._problem.measurements
        J = self._equations.blocks[1]
        J = J[:, :, 6 : J.shape[2] - self._own] * noise_px[:, None, None]
        total = np.zeros((len(self._state.phi), J.shape[2], J.shape[2]))
        np.add.at(total, frame, np.einsum("oki,okj->oij", J, J))
        return total / np.maximum(np.bincount(frame, minlength=len(total)), 1)[:, None, None]

    def noise_factor(self, vectors: Array) -> float:
        """How many times larger than `sigma_px` the noise is that errors of functions (k, m, nb) of the photos show.

        Measurements of neighbouring points go together: they see the same stone through the same corner of a lens.
        Their joint influence on the functions, group of tracks by group, has a larger spread than that of as many
        independent ones (the infinitesimal jackknife, or sandwich, of clustered data). Too small rather than too large,
        since groups cut through what goes together; never below 1, and 1 where there are too few points to say.
        """
        group = _neighbours(self._state.points_w)[self._problem.measurements[1]]
        groups = int(group.max(initial=0)) + 1
        if groups < _LEAST_GROUPS:
            return 1.0
        ratios = []
        for vector in self._whole(vectors):
            influence = self._equations.influence(vector)
            joint = np.bincount(group, (influence * self._equations.blocks[0]).sum(1), groups)
            alone = max(float((influence**2).sum()), 1e-300)
            ratios.append(float((joint**2).sum()) * groups / (groups - 1) / alone)
        factor = float(np.sqrt(np.mean(ratios)))
        return max(factor, 1.0) if np.isfinite(factor) else 1.0

    def _whole(self, vectors: Array) -> Array:
        """With zeros for what the photos have of their own beside pose and motion."""
        return np.pad(vectors, [(0, 0), (0, 0), (0, self._own)])


# Groups of neighbouring tracks: as many as tell the spread of their influence, of points enough to be neighbours.
_MOST_GROUPS, _LEAST_GROUPS, _OF_GROUP = 32, 16, 16


def _neighbours(points_w: Array) -> NDArray[np.int64]:
    """(n,) groups of neighbouring points, a power of two of about the same size: halves of halves, cut across."""
    group = np.zeros(len(points_w), np.int64)
    for _ in range(int(np.log2(np.clip(len(points_w) / _OF_GROUP, 1, _MOST_GROUPS)))):
        halves = group.copy()
        for each in range(int(group.max(initial=0)) + 1):
            mine = np.flatnonzero(group == each)
            # far points must not decide which way to cut
            low, high = np.quantile(points_w[mine], [0.1, 0.9], axis=0)
            along = points_w[mine, int(np.argmax(high - low))]
            halves[mine] = 2 * each
            halves[mine[np.argsort(along, kind="stable")[len(mine) // 2 :]]] += 1
        group = halves
    return group


def gauge_directions(result: BundleResult) -> Array:
    """(7, m, nb) changes of the photos' unknowns that move, turn or scale the world, and change no photo."""
    rec = result.reconstruction
    m, nb = result.covariances.shape[:2]
    directions = np.zeros((7, m, nb))
    centers = rec.center_w - rec.center_w.mean(0)
    for k in range(3):
        unit = np.eye(3)[k]
        directions[k, :, :3] = -rec.R_cw[:, :, k]
        directions[k, :, 3:6] = np.cross(unit, centers)
        directions[3 + k, :, 3:6] = unit
        if nb > 9:
            directions[k, :, 9:] = np.cross(unit, rec.velocity)
    directions[6, :, 3:6] = centers
    if nb > 9:
        directions[6, :, 9:] = rec.velocity
    return directions
