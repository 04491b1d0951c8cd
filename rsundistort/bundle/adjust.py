"""Bundle adjustment with outlier rounds, and the ladder of shutter models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..model import Reconstruction
from ..model.reprojection import reprojection_residuals
from .intrinsics import pixels_of
from .jackknife import Inflation, inflated, inflation
from .layout import Layout
from .options import BundleOptions, BundleResult
from .problem import BundleProblem
from .solver import minimize
from .spreads import estimated, estimates_spreads, field_spread, settled, starting_spreads
from .triangulate import revive_points

__all__ = ["LADDER", "bundle_adjust", "climb", "objective"]

#: Shutter models in the order in which they are solved, each from the one before.
LADDER = ("global", "two-step", "rotation", "constant-motion")

# Fall of the cost, as a share, below which a solve ends whose spreads are yet to change.
_UNSETTLED_TOLERANCE = 1e-5


def _noise_px(reconstruction: Reconstruction, shutter_model: str, floor: float) -> float:
    """Robust standard deviation of the residuals' parts in pixels, of measurements whose relative sigma is 1."""
    res, valid = reprojection_residuals(reconstruction, shutter_model)
    if not valid.any():
        return max(1.0, floor)
    # median of |x| of a normal variable is 0.6745 sigma; residuals of a fit are shorter than the noise
    spread = float(np.median(np.abs(res / reconstruction.observations.sigma[:, None])[valid])) / 0.6745
    bends = max(reconstruction.bend.shape[1] - 2, 0)
    unknowns = (9 + 3 * bends) * reconstruction.num_images + 3 * reconstruction.num_points
    shrink = np.sqrt(max(1.0 - unknowns / (2.0 * len(res)), 0.1))
    return max(spread / shrink, floor)


def _believed(reconstruction: Reconstruction, options: BundleOptions, sigma: float) -> NDArray[np.bool_]:
    """(o,) measurements that lie as near to their prediction as their noise allows."""
    res, valid = reprojection_residuals(reconstruction)
    limit = np.maximum(options.outlier_sigma * sigma * reconstruction.observations.sigma, options.min_outlier_px)
    return valid & (np.linalg.norm(res, axis=1) <= limit)


def objective(reconstruction: Reconstruction, shutter_model: str, options: BundleOptions) -> float:
    """What `bundle_adjust` lowers in its first solve, at a reconstruction's values.

    Half the robust sum of squares in units of the noise (`options.sigma_px`, which must be given), and the priors.
    Motion that the model lacks, or that is held, counts as zero.
    """
    if options.sigma_px is None:
        raise InputError("the objective needs sigma_px: half a sum of squares means nothing without the noise")
    spreads = starting_spreads(options, Layout.of(shutter_model, options), reconstruction.baseline)
    problem = BundleProblem(reconstruction, shutter_model, options, options.sigma_px, spreads, heavy_tails=False)
    return problem.cost(problem.initial_state())


def _check_solvable(reconstruction: Reconstruction, shutter_model: str) -> None:
    """Refuse what has no answer: too few photos for a shutter, and photos without parallax."""
    m = reconstruction.num_images
    if shutter_model != "global" and m < 3:
        raise InputError(f"{m} photos cannot tell the shutter from the scene; at least three are needed")
    if m > 1 and not np.linalg.norm(np.ptp(reconstruction.center_w, axis=0)) > 1e-9 * reconstruction.size:
        raise InputError("all photos are taken from one place: without parallax there is no scene to solve for")


def bundle_adjust(
    reconstruction: Reconstruction,
    shutter_model: str = "rotation",
    options: BundleOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> BundleResult:
    """Poses, shutter motions and points that explain the measurements best.

    Parameters
    ----------
    reconstruction : Reconstruction
        Start; its phi is the start of phi.
    shutter_model : {"global", "two-step", "linearized", "rotation", "constant-motion"}
        How the shutter is modelled.
    options : BundleOptions, optional
        Tolerances, loss, priors, anchors.
    progress : callable, optional
        Called with the cost after each accepted step.

    Returns
    -------
    BundleResult
        With a stop reason: the estimate of a solve that ran out of iterations is returned, and says so. A photo whose
        measurements cannot support its shutter keeps its motion at the prior: its `sigma_phi` is then the prior's.

    Raises
    ------
    InputError
        Fewer than two photos (three for a shutter), no common points, or all photos taken from one place.
    """
    options = options or BundleOptions()
    # `base` holds all measurements of the points still in use, `keep` says which of them are believed: one that was
    # doubted while an outlier bent its point is heard again in the next round
    base = reconstruction.with_points(np.ones(len(reconstruction.observations), bool))
    if base.num_points:
        _check_solvable(base, shutter_model)
    base = revive_points(base, shutter_model, from_afar=True)
    keep = np.ones(len(base.observations), bool)
    iterations = 0
    sigma = options.sigma_px or _noise_px(base, shutter_model, options.min_sigma_px)
    baseline = reconstruction.baseline
    layout = Layout.of(shutter_model, options)
    spreads = starting_spreads(options, layout, baseline)
    jackknife, factor = options.deviations == "jackknife", 1.0
    # Measurements that seem more exact than they are would pull the intrinsics over the hump of a prior with heavy
    # tails, and they would not come back: it is normal until the noise is known
    prior_of_cameras = jackknife and options.guessed is not None and len(options.refine) > 0
    heavy_tails = False
    most_rounds = options.outlier_rounds + options.spread_rounds + 1
    exact = False
    damping = options.initial_damping
    for round_ in range(most_rounds):
        cleaning = round_ < options.outlier_rounds
        # where the first spreads are but a guess, their solution need not be exact
        rough = cleaning or (round_ == 0 and options.spread_rounds > 0 and estimates_spreads(shutter_model, options))
        # that of spreads which will change is but a start, too
        exact = exact or options.cost_tolerance >= _UNSETTLED_TOLERANCE or round_ == most_rounds - 1
        tolerance = options.cost_tolerance if exact else _UNSETTLED_TOLERANCE
        believed = replace(base, observations=base.observations.select(keep))
        problem = BundleProblem(believed, shutter_model, options, sigma * factor, spreads, heavy_tails=heavy_tails)
        result = minimize(
            problem,
            problem.initial_state(),
            max_iterations=options.max_iterations,
            cost_tolerance=options.round_tolerance if rough else tolerance,
            step_tolerance=options.step_tolerance,
            initial_damping=damping,
            max_damping=options.max_damping,
            progress=progress,
        )
        iterations += result.num_iterations
        # the next round's valley is this one's
        damping = min(result.damping, options.initial_damping)
        current = problem.reconstruction(result.state)
        equations = problem.with_squares().linearize(result.state)
        marginals = equations.marginal_covariances(of_priors=jackknife and not rough)
        weighed, had_tails = factor, heavy_tails
        per_camera = equations.num_shared // equations.num_cameras
        shared = Inflation(np.ones(len(marginals.photos[0])), np.ones(per_camera))
        if jackknife and not rough:
            shared = inflation(equations, problem.partitions(result.state), marginals, factor)
            factor, heavy_tails = shared.noise, True
        del equations
        before, spreads = spreads, estimated(spreads, current, marginals.photos, options, layout, baseline)
        if options.residual_field:
            values, variances = problem.fields(result.state, marginals.cameras)
            spreads = replace(spreads, field=field_spread(values, variances, before.field))
        revived = revive_points(current, shutter_model)
        if cleaning:
            sigma = options.sigma_px or _noise_px(current, shutter_model, options.min_sigma_px)
            base = replace(revived, observations=base.observations)
            keep = _believed(base, options, sigma)
            alive = base.track_lengths(keep) >= 2
            keep = keep[alive[base.observations.point_idx]]
            base = base.take_points(alive)
        else:
            done = (
                not rough
                and revived is current
                and settled(before, spreads, options.spread_tolerance)
                and abs(factor - weighed) < 0.1 * factor
                and (had_tails or not prior_of_cameras)
            )
            if done and exact:
                break
            if done:
                exact, spreads, factor, heavy_tails = True, before, weighed, had_tails
            base = replace(revived, observations=base.observations)
    res, valid = reprojection_residuals(current)
    rms = float(np.sqrt(np.mean(res[valid] ** 2))) if valid.any() else float("nan")
    dropped = len(reconstruction.observations) - len(current.observations)
    covariances, intrinsic_covariance = inflated(marginals, shared.photos / weighed, shared.cameras / weighed)
    return BundleResult(
        current,
        result.stop_reason,
        result.cost_history,
        iterations,
        sigma,
        spreads.phi,
        spreads.velocity / baseline,
        spreads.focal if options.varying else 0.0,
        spreads.centre if options.varying else 0.0,
        spreads.bends,
        tuple(each / baseline for each in spreads.ways),
        covariances[:, : layout.motion, : layout.motion],
        _sigma_intrinsics(current, options.refine, intrinsic_covariance),
        rms,
        dropped,
        shared.photos,
        weighed,
        before.field if options.residual_field else 0.0,
        tuple(np.sqrt(problem.fields(result.state, intrinsic_covariance)[1].sum(1)).tolist()),
    )


def _sigma_intrinsics(
    current: Reconstruction, names: Sequence[str], covariance: NDArray[np.float64]
) -> tuple[dict[str, float], ...]:
    """Standard deviations of each camera's refined intrinsics, in pixels or as coefficients."""
    sigmas = np.sqrt(np.diagonal(covariance)).reshape(len(current.cameras), -1)
    return tuple(
        dict(zip(names, (sigma[: len(names)] * pixels_of(camera, names)).tolist(), strict=True))
        for camera, sigma in zip(current.cameras, sigmas, strict=True)
    )


def climb(
    reconstruction: Reconstruction,
    rungs: Sequence[str] = LADDER,
    options: BundleOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, BundleResult]:
    """Solve the shutter models one after the other, each started from the one before, phi from zero.

    Returns
    -------
    dict of BundleResult
        By model, in the order solved. All but the last are rough: no outliers are dropped from them.
    """
    options = options or BundleOptions()
    # every rung but the last is only a start: what its model cannot explain is no outlier, and it need not converge
    # a shutter that is not modelled yet would be blamed on the lens, and bend known lengths
    rough = replace(
        options, outlier_rounds=0, spread_rounds=0, cost_tolerance=options.round_tolerance, refine=(), lengths=(),
        deviations="model", residual_field=False,
    )  # fmt: skip
    results: dict[str, BundleResult] = {}
    current = replace(reconstruction, phi=np.zeros((reconstruction.num_images, 3)))
    for model in rungs:
        step = None if progress is None else (lambda cost, model=model: progress(model, cost))
        results[model] = bundle_adjust(current, model, options if model == rungs[-1] else rough, step)
        current = results[model].reconstruction
    return results
