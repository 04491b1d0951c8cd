"""What an adjustment leaves open: covariances of linear functions of photos and points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..model.array_types import Array, Mask
from .bundle_options import BundleOptions, BundleResult
from .doubt import Doubt
from .prior_sigmas import PriorSigmas
from .problem import BundleProblem

__all__ = ["Posterior", "gauge_directions"]


class Posterior:
    """Covariances at a result, all unknowns being free but the constraints and the gauge.

    The options are those of the adjustment: constraints, known motions and refined intrinsics count.
    """

    def __init__(self, result: BundleResult, options: BundleOptions | None = None) -> None:
        rec = result.reconstruction
        per_unit = np.repeat([1.0, rec.baseline], [3, 5])
        sigmas = self._sigmas = PriorSigmas(
            result.phi_sigma, max(result.velocity_sigma * rec.baseline, 1e-300),
            max(result.focal_sigma, 1e-300), max(result.centre_sigma, 1e-300), result.bend_sigmas,
            tuple(each * rec.baseline for each in result.way_sigmas), result.field_sigma_px, result.path_sigmas,
            None if result.common is None else result.common.prior.scaled(rec.baseline),
        )  # fmt: skip
        plain = replace(options or BundleOptions(), loss="squared")
        self._path = None if result.path is None else result.path.state
        self._problem = BundleProblem(
            rec, rec.shutter_model, plain, result.sigma_px * result.noise_factor, sigmas, path=self._path,
            means=None if result.common is None else per_unit * result.common.values,
        )  # fmt: skip
        self._state = self._problem.initial_state()
        self._equations = self._problem.linearize(self._state)
        self._inflation = (result.inflation if plain.deviations == "jackknife" else 1.0) / result.noise_factor
        self._doubt = Doubt.of(self._equations, plain, rec, prior=sigmas.means, means=self._state.means)
        self._camera_idx = rec.camera_idx
        self._own = self._problem.layout.size - self._problem.layout.motion
        self._shape = rec.num_images, self._equations.blocks[1].shape[2] - self._own

    def of_photos(self, vectors: Array) -> Array:
        """Covariance of the photos' unknowns times vectors (k, m, nb), as in `BundleResult.covariances`."""
        # with zeros for what the photos have of their own beside pose and motion
        whole = np.pad(vectors, [(0, 0), (0, 0), (0, self._own)])
        if self._path is None:
            moved = self._equations.covariance(whole, self._inflation) + self._doubt.times(whole)[0]
            return moved[:, :, : vectors.shape[2]]
        # phi and velocity are pace times rates
        variation = self._state.variation
        pace = self._path.paces(self._camera_idx, variation)[:, None]
        rates = np.exp(variation[:, :1]) * self._path.rates
        of_pace = np.zeros((len(vectors), self._equations.num_shared))
        columns = (self._camera_idx + 1) * (self._equations.num_shared // self._equations.num_cameras) - 1
        np.add.at(of_pace.T, columns, np.einsum("kma,ma->mk", vectors[:, :, 6:12], rates))
        whole[:, :, 6:12] *= pace
        parts = self._equations.times(whole, of_pace), self._doubt.times(whole, of_pace)
        moved, shared = (of_equations + of_doubt for of_equations, of_doubt in zip(*parts, strict=True))
        moved[:, :, 6:12] = pace * moved[:, :, 6:12] + shared[:, columns, None] * rates
        return moved[:, :, : vectors.shape[2]]

    def of_points(self, weights: Array) -> tuple[float, Array]:
        """Variance of a linear function of the points, `sum(weights * points_w)` with weights (n, 3).

        And its covariance (m, nb) with the photos' unknowns. NaN where the system cannot be factored.
        """
        found = self._equations.function_of_points(self._problem.in_order(weights))
        if found is None:
            return np.nan, np.full(self._shape, np.nan)
        variance, with_photos = found.inflated(self._inflation)
        of_doubt, with_doubt = self._doubt.of_function(found)
        return variance + of_doubt, (with_photos + with_doubt)[:, : self._shape[1]]

    def motions(self) -> tuple[Array, Array]:
        """Motions (m, k) of the photos and their covariances (m, k, k), as far as the model has them.

        Phi, velocity, and the coefficients of the bends, each a root mean square over the frame. One Gauss-Newton step
        from the result, which matters where the options free what was held in it.
        """
        layout, state = self._problem.layout, self._state
        covariances = self._equations.marginal_covariances(of_priors=False).photos
        solved = self._equations.solve(0.0)
        step = np.full(covariances.shape[:2], np.nan) if solved is None else solved[0][0]
        own = np.r_[6 : layout.motion, layout.variation : layout.size]
        motion = np.hstack([np.hstack([state.phi, state.velocity])[:, : layout.motion - 6], state.bend])
        return motion + step[:, own], covariances[:, own[:, None], own]

    @property
    def relative_information(self) -> Array:
        """By how much more than a normal prior that of each photo's rotation and velocity tells of them (m, 0 to 2)."""
        return self._problem.relative_information(self._state)

    @property
    def shares(self) -> Mask:
        """(m, 6) which components of the photos' motions have a mean of their camera."""
        return self._problem.shares

    @property
    def bend_sigmas(self) -> Array:
        """(k,) prior standard deviations of the coefficients of the bends: radians, then world units."""
        return self._problem.layout.per_bend(self._sigmas.bends, self._sigmas.ways)

    def squared_shifts(self) -> Array:
        """(m, k, k) mean over a photo's measurements of the squared displacement that a change of its motion causes.

        As a quadratic form, pixels squared. Where pose and points make up for the change in the photo as it was taken,
        it is the rectified photo that is displaced.
        """
        noise_px, J = self._problem.measurements[2], self._equations.blocks[1]
        by_frame = self._problem.by_photo
        squares = []
        for photo, mine in enumerate(by_frame):
            A = J[mine, :, 6 : J.shape[2] - self._own] * noise_px[mine, None, None]
            if self._path is not None:  # the Jacobians are by rates
                A /= self._path.paces(self._camera_idx, self._state.variation)[photo]
            squares.append(np.einsum("oki,okj->ij", A, A) / max(len(mine), 1))
        return np.array(squares)


def gauge_directions(result: BundleResult) -> Array:
    """(7, m, nb) changes of the photos' unknowns that move, rotate or scale the world, and change no photo."""
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
