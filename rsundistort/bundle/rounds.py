"""Successive solves of an adjustment: outliers are dropped, prior standard deviations and noise converge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..errors import InputError
from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask
from ..model.reprojection import reprojection_residuals
from .bundle_options import BundleOptions, BundleResult
from .common_motion import CommonMotion
from .doubt import Doubt
from .intrinsics import has_intrinsic, pixels_of
from .jackknife import Inflation, inflated, inflation
from .layout import Layout
from .lens_field import LensFields
from .noise import noise_and_loss
from .normal_equations import NormalEquations
from .path_prior import (
    FramePath,
    PathPrior,
    PathState,
    of_motions,
    orthogonal,
    path_bends,
    path_solution,
    with_path_motions,
)  # fmt: skip
from .prior_sigmas import Common, estimated, field_prior_sigma, path_prior_sigmas, settled, starting_sigmas
from .problem import BundleProblem
from .solver import minimize
from .structure import Structure
from .triangulate import least_distance, retriangulated

__all__ = ["Rounds"]

# The factor of the noise has converged if it changes by less than this share.
_SETTLED_NOISE = 0.1
# The bends of a path have converged if they change by less, radians: a twentieth of a pixel at any focal length in use.
_SETTLED_BEND = 2e-5


def _believed(reconstruction: Reconstruction, options: BundleOptions, sigma: float) -> Mask:
    """(o,) measurements that lie as near to their prediction as their noise allows, and not at the lens."""
    rec, obs = reconstruction, reconstruction.observations
    res, believed = reprojection_residuals(rec)
    limit = np.maximum(options.outlier_sigma * sigma * obs.sigma, options.min_outlier_px)
    believed &= np.linalg.norm(res, axis=1) <= limit
    if options.path is None or not options.path.rotation_only:  # else points are directions
        away = np.linalg.norm(rec.points_w[obs.point_idx] - rec.center_w[obs.frame_idx], axis=1)
        believed &= away >= least_distance(rec)
    return believed


def _check_solvable(reconstruction: Reconstruction, shutter_model: str, path: FramePath | None) -> None:
    """Refuse problems without a solution: too few photos for a shutter, and photos without parallax."""
    m = reconstruction.num_images
    if shutter_model != "global" and m < 3 and path is None:
        raise InputError(f"{m} photos cannot separate the shutter from the scene; at least three are needed")
    if path is not None and path.rotation_only:
        return
    if m > 1 and not np.linalg.norm(np.ptp(reconstruction.center_w, axis=0)) > 1e-9 * reconstruction.size:
        raise InputError("all photos are taken from one place: without parallax there is no scene to solve for")


def _sigma_intrinsics(current: Reconstruction, names: Sequence[str], covariance: Array) -> tuple[dict[str, float], ...]:
    """Standard deviations of each camera's refined intrinsics, in pixels or as coefficients."""
    sigmas = np.sqrt(np.diagonal(covariance)).reshape(len(current.cameras), -1)
    found = []
    for camera, sigma in zip(current.cameras, sigmas, strict=True):
        values = (sigma[: len(names)] * pixels_of(camera, names)).tolist()
        found.append({name: each for name, each in zip(names, values, strict=True) if has_intrinsic(camera, name)})
    return tuple(found)


class Rounds:
    """Solves of one adjustment, each with outliers, prior standard deviations and noise from the one before.

    Parameters
    ----------
    reconstruction, shutter_model, options, progress
        As in `bundle_adjust`.
    """

    def __init__(
        self,
        reconstruction: Reconstruction,
        shutter_model: str,
        options: BundleOptions,
        progress: Callable[[float], None] | None,
    ) -> None:
        self._given, self._model, self._options, self._progress = reconstruction, shutter_model, options, progress
        # `base` holds all measurements of the points still in use, `keep` says which of them are believed: one that was
        # doubted while an outlier bent its point is heard again in the next round
        base = reconstruction.with_points(np.ones(len(reconstruction.observations), bool))
        if base.num_points:
            _check_solvable(base, shutter_model, options.path)
        self._path: PathState | None = None
        self._path_moved = np.inf
        start = None if options.path is None else options.path.start
        if options.path is not None and start is not None:
            prior = PathPrior(options.path, base, (start.sigmas[0], start.sigmas[1]))
            self._path = prior.start(base, start)
            base = with_path_motions(base, options.path, self._path)
            self._options = options = replace(options, known_bends=path_bends(base, options.path, self._path))
        self._rotation_only = options.path is not None and options.path.rotation_only
        self._base = base if self._rotation_only else retriangulated(base, shutter_model, from_afar=True)
        self._keep = np.ones(len(self._base.observations), bool)
        self._sigma_px, self._loss = noise_and_loss(self._base, shutter_model, options)
        if options.outlier_rounds or options.deviations == "model":
            self._loss = options.usual_loss  # residuals of a start do not say what tails the noise has
        self._baseline = reconstruction.baseline
        self._layout = Layout.of(shutter_model, options)
        self._sigmas = starting_sigmas(options, self._layout, self._base)
        self._noise = 1.0
        #: Whether the noise has converged since outliers were dropped.
        self.noise_is_known = False
        if start is not None:
            self._sigmas = replace(self._sigmas, path=start.sigmas)
            self._noise = start.noise or 1.0
        self._weighed_sigmas, self._weighed_noise = self._sigmas, self._noise
        # Measurements that seem more exact than they are would pull the intrinsics over the hump of a prior with heavy
        # tails, and they would not come back: it is normal until the noise is known
        self._heavy_tails = self._had_heavy_tails = start is not None and start.noise is not None
        self._damping = options.initial_damping
        self._iterations = 0
        self._means: Array | None = None
        self._partitions: tuple[Index, ...] = ()
        self._structure: Structure | None = None
        self._lens_fields: LensFields | None = None

    def solve(self, cost_tolerance: float, is_judged: bool = False) -> None:
        """Solve once. One that is judged says how uncertain it is by its residuals, if the options ask for that."""
        options = self._options
        believed = replace(self._base, observations=self._base.observations.select(self._keep))
        problem = self._problem = BundleProblem(
            believed, self._model, options, self._sigma_px, self._sigmas,
            heavy_tails=self._heavy_tails, path=self._path, means=self._means, noise=self._noise, loss=self._loss,
            structure=self._structure, fields=self._lens_fields,
        )  # fmt: skip
        self._structure, self._lens_fields = problem.structure, problem.lens_fields
        self._solved = minimize(
            problem,
            problem.initial_state(),
            max_iterations=options.max_iterations,
            # more noise makes the cost smaller, and half a unit of it is still one standard deviation
            cost_tolerance=cost_tolerance * self._noise**2,
            step_tolerance=options.step_tolerance,
            initial_damping=self._damping,
            max_damping=options.max_damping,
            progress=self._progress,
        )
        state = self._solved.state
        self._iterations += self._solved.num_iterations
        # the next round's valley is this one's
        self._damping = min(self._solved.damping, options.initial_damping)
        self._current = problem.reconstruction(state)
        asks_residuals = is_judged and options.deviations == "jackknife"
        equations = problem.with_squares(influence=True).linearize(state)
        self._marginals = equations.marginal_covariances(of_priors=asks_residuals)
        if state.path is not None:
            self._with_pace = equations.photos_by_shared(1)[:, :, 0]
        self._weighed_noise, self._had_heavy_tails = self._noise, self._heavy_tails
        self._doubt = Doubt.of(
            equations, options, self._current, self._heavy_tails, prior=self._sigmas.means, means=state.means
        )  # fmt: skip
        self._inflation = Inflation()
        if asks_residuals:
            # the measurements of judged solves are the same, and their points hardly move
            self._partitions = self._partitions or problem.partitions(state)
            has_pace = state.path is not None
            found = self._inflation = inflation(equations, self._partitions, self._marginals, self._noise, has_pace)
            # of all that has a prior of mean zero: what photos have beside their poses, else the lens
            self._noise = found.sure_photos if self._marginals.photos.shape[1] > 6 else found.sure_cameras
            self.noise_is_known = self._has_its_noise
            self._heavy_tails = True
        self._weighed_sigmas = self._sigmas
        self._sigmas = estimated(
            self._sigmas, self._current, self._marginals.photos, options, self._layout, self._baseline,
            self._common(equations),
        )  # fmt: skip
        self._means = None if problem.means is None else problem.means.values(state.means)
        if options.residual_field:
            values, variances = problem.fields(state, self._marginals.cameras)
            field = field_prior_sigma(values, variances, self._weighed_sigmas.field)
            self._sigmas = replace(self._sigmas, field=field)
        if state.path is not None:
            self._follow_path(problem, equations)
        self._new_points = self._current if self._rotation_only else retriangulated(self._current, self._model)

    def _common(self, equations: NormalEquations) -> Common | None:
        """Means of the motions that the last solve found."""
        state, current, of = self._solved.state, self._current, self._problem.means
        if of is None:
            return None
        covariances = self._covariances_of_means
        means, of_means = of.of_photos(state.means, covariances)
        # of the motions in their cameras' frames
        together = current.frame_span()[:, None, None] * equations.photos_by_shared(len(of.root))[:, 6:12]
        together[:, 3:] = current.R_cw @ together[:, 3:]
        with_motions = np.einsum("mak,mak->ma", together, of.by_unknowns)
        return Common(means, of_means, with_motions, state.means, covariances, of.root)

    @property
    def _covariances_of_means(self) -> Array:
        """(cameras, 8, 8) of their unknowns by the last solve."""
        c, k = self._solved.state.means.shape
        blocks = self._marginals.cameras.reshape(c, -1, c, len(self._marginals.cameras) // c)
        return blocks[np.arange(c), -k:, np.arange(c), -k:]

    def _follow_path(self, problem: BundleProblem, equations: NormalEquations) -> None:
        """Bend the motions of the next solve as the path of this one, and update its prior standard deviations."""
        state, options = self._solved.state, self._options
        assert options.path is not None
        residuals, variances = equations.coupling_variances()
        if options.prior_sigma_rounds and np.isfinite(variances).all():
            self._sigmas = replace(
                self._sigmas, path=path_prior_sigmas(problem.path, residuals, variances, self._baseline)
            )
        self._path = state.path
        bends = path_bends(self._current, options.path, state.path)
        before, after = (
            Layout.of(self._model, replace(options, known_bends=each)).values(
                np.zeros((self._current.num_images, 0)), self._current.image_names
            )
            for each in (options.known_bends or bends, bends)
        )
        self._path_moved = float(np.abs(after - before)[..., :3].max()) if options.known_bends else np.inf
        self._options = replace(options, known_bends=bends)
        self._layout = Layout.of(self._model, self._options)

    def drop_outliers(self) -> None:
        """Keep in the next solve the measurements near to the last within their noise."""
        options = self._options
        self._sigma_px, self._loss = noise_and_loss(self._current, self._model, options)
        self.begin_next()
        base = self._base
        keep = _believed(base, options, self._sigma_px)
        alive = base.track_lengths(keep) >= 2
        self._keep, self._partitions = keep[alive[base.observations.point_idx]], ()
        self._structure = None
        self.noise_is_known = False
        self._base = base.take_points(alive)

    @property
    def _has_its_noise(self) -> bool:
        """Whether the noise by the last solve is that which it was weighed with."""
        return abs(self._noise - self._weighed_noise) < _SETTLED_NOISE * self._noise

    @property
    def are_settled(self) -> bool:
        """Whether prior standard deviations and noise by the last solve are those that it was weighed with."""
        options = self._options
        awaits_tails = (
            options.deviations == "jackknife" and options.guessed is not None and len(options.refine) > 0
        ) and not self._had_heavy_tails
        return (
            self._new_points is self._current
            and settled(self._weighed_sigmas, self._sigmas, options.prior_sigma_tolerance)
            and self._has_its_noise
            and not awaits_tails
            and (options.path is None or self._path_moved < _SETTLED_BEND)
        )

    def begin_next(self, with_same_weights: bool = False) -> None:
        """Start the next solve from the last, with its prior standard deviations and noise, or as it was weighed."""
        if with_same_weights:
            self._sigmas, self._noise = self._weighed_sigmas, self._weighed_noise
            self._heavy_tails = self._had_heavy_tails
        self._base = replace(self._new_points, observations=self._base.observations)

    def result(self) -> BundleResult:
        """Result of the last solve."""
        current, options, layout, state = self._current, self._options, self._layout, self._solved.state
        res, valid = reprojection_residuals(current)
        weighed, sigmas = self._weighed_noise, self._sigmas
        # the noise that weighs the measurements is larger than independent noise already
        found = self._inflation
        by = found._replace(photos=found.photos / weighed, cameras=found.cameras / weighed)
        covariances, of_intrinsics = inflated(self._marginals, by, len(current.cameras))
        covariances, of_intrinsics = covariances + self._doubt.of_photos, of_intrinsics + self._doubt.of_cameras
        path = None
        if self._path is not None and options.path is not None:
            pace_sigma = np.sqrt(np.diagonal(of_intrinsics).reshape(len(current.cameras), -1)[:, -1])
            path = path_solution(current, options.path, self._path, pace_sigma)
            per_camera = len(of_intrinsics) // len(current.cameras)
            with_pace = by.photos**2 * self._with_pace + self._doubt.with_last(current.camera_idx, per_camera)
            covariances = of_motions(covariances, with_pace, pace_sigma, self._path, current)
            current = orthogonal(with_path_motions(current, options.path, self._path))
        return BundleResult(
            current,
            self._solved.stop_reason,
            self._solved.cost_history,
            self._iterations,
            self._sigma_px,
            sigmas.phi,
            sigmas.velocity / self._baseline,
            sigmas.focal if options.varying else 0.0,
            sigmas.centre if layout.num_varying > 1 else 0.0,
            sigmas.bends,
            tuple(each / self._baseline for each in sigmas.ways),
            covariances[:, : layout.motion, : layout.motion],
            _sigma_intrinsics(current, options.refine, of_intrinsics),
            float(np.sqrt(np.mean(res[valid] ** 2))) if valid.any() else float("nan"),
            len(self._given.observations) - len(current.observations),
            self._inflation.photos,
            weighed,
            self._weighed_sigmas.field if options.residual_field else 0.0,
            tuple(np.sqrt(self._problem.fields(state, of_intrinsics)[1].sum(1)).tolist()),
            path,
            sigmas.path,
            common=self._common_motion(),
            loss=self._loss,
        )

    def _common_motion(self) -> CommonMotion | None:
        of = self._problem.means
        if of is None or self._means is None:
            return None
        prior = self._weighed_sigmas.means
        assert prior is not None
        assert self._sigmas.means is not None
        per_unit = np.repeat([1.0, 1.0 / self._baseline], [3, 5])
        means, variances = of.of_photos(self._solved.state.means, self._covariances_of_means)
        deviations = np.sqrt(np.maximum(variances + prior.odds_against * means**2, 0.0))
        return CommonMotion(
            self._means * per_unit, prior.scaled(1.0 / self._baseline), means * per_unit[:6],
            deviations * per_unit[:6], self._sigmas.means.probability,
        )  # fmt: skip
