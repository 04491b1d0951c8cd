"""Bundle adjustment with outlier rounds, and the ladder of shutter models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..model import Reconstruction
from .intrinsics import pixels_of
from .jackknife import Inflation, inflated, inflation
from .layout import Layout
from .options import BundleOptions, BundleResult
from .problem import BundleProblem, Spreads, reprojection_residuals
from .solver import minimize
from .triangulate import revive_points

__all__ = ["LADDER", "bundle_adjust", "climb", "objective"]

#: Shutter models in the order in which they are solved, each from the one before.
LADDER = ("global", "two-step", "rotation", "constant-motion")

# Radians per frame: a hundredth of a pixel at any focal length in use. Keeps the prior's weight finite.
_MIN_SPREAD = 1e-6
# Spreads below this (radians, focal lengths) need not settle: a tenth of a pixel.
_SETTLED_AT = 2e-5
# The same of the fields, which are in pixels.
_MIN_SPREAD_PX, _SETTLED_PX = 1e-4, 1e-3
# A lens that its model says so badly needs another model.
_MOST_PX = 1.0

# No lens varies more than this from photo to photo (of f, and of the principal point in focal lengths). A strong
# shutter would be taken for it.
_MOST_VARIED = 0.02
# Of a spread, between two solves.
_LARGEST_CHANGE = 4.0


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


def _spread(
    values: NDArray[np.float64], variance: NDArray[np.float64], span: NDArray[np.float64], spread: float
) -> float:
    """Spread over photos and axes, per frame, of unknowns (m, 3) per unit of the clock with posterior variances (m, 3).

    `spread` is that of the prior under which they were found. Values beyond three robust spreads count as three: a few
    photos that moved far more, or that hang on by few measurements, must not loosen the prior of the rest. Held values
    tell nothing.
    """
    free = variance > 0
    if not free.any():
        return 0.0
    scale = np.broadcast_to(span[:, None] ** 2, values.shape)[free]
    square, unknown = values[free] ** 2 * scale, float((variance[free] * scale).mean())
    robust = float(np.median(square + variance[free] * scale)) / 0.455  # median of the square of a normal variable
    seen = float(np.minimum(square, 9.0 * robust).mean())
    # MacKay's fixed point of sigma^2 = mean(phi^2 + variance): a few rounds where that takes dozens. `told` is the
    # share of the unknowns that the measurements, not the prior, decide
    told = max(1.0 - unknown / spread**2, 1e-3)
    return float(np.clip(np.sqrt(seen / told), spread / _LARGEST_CHANGE, spread * _LARGEST_CHANGE))


def _estimated(
    spreads: Spreads, current: Reconstruction, covariances: NDArray[np.float64], options: BundleOptions,
    layout: Layout, baseline: float,
) -> Spreads:  # fmt: skip
    """The spreads of both priors that a solution shows; those that were given stay."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    if not np.isfinite(variances).all():
        return spreads
    span = current.frame_span()
    motion = variances[:, 6 : layout.motion]
    limited = [options.phi_limits.get(name, np.inf) < spreads.phi for name in current.image_names]
    motion = np.where(np.array(limited)[:, None], 0.0, motion)
    phi, velocity, focal, centre = spreads.phi, spreads.velocity, spreads.focal, spreads.centre
    if options.phi_sigma is None and motion.shape[1] > 0:
        phi = _spread(current.phi, motion[:, :3], span, spreads.phi) + _MIN_SPREAD
    if options.velocity_sigma is None and motion.shape[1] > 3:
        velocity = _spread(current.velocity, motion[:, 3:], span, spreads.velocity) + _MIN_SPREAD * current.baseline
    if options.varying:
        ones, varied = np.ones(len(span)), current.variation
        of_varied = variances[:, layout.motion : layout.variation]
        focal = _spread(varied[:, :1], of_varied[:, :1], ones, spreads.focal) + _MIN_SPREAD
        centre = _spread(varied[:, 1:], of_varied[:, 1:], ones, spreads.centre) + _MIN_SPREAD
    bends, ways = _bend_spreads(spreads, current, variances[:, layout.variation :], layout)
    return _bounded(Spreads(phi, velocity, focal, centre, bends, ways, spreads.field), options, baseline)


def _bend_spreads(
    spreads: Spreads, current: Reconstruction, variances: NDArray[np.float64], layout: Layout
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The spreads of the groups of bends, of rotations and of positions."""
    ones, found = np.ones(current.num_images), layout.coefficients(current)
    turns = 3 * len(layout.group)

    def of(group: int, part: slice, spread: float, least: float) -> float:
        mine = np.flatnonzero(np.repeat(np.array(layout.group[: (part.stop - part.start) // 3]) == group, 3))
        return _spread(found[:, part][:, mine], variances[:, part][:, mine], ones, spread) + least

    own, ways = slice(0, turns), slice(turns, turns + 3 * layout.ways)
    return (
        tuple(of(k, own, spread, _MIN_SPREAD) for k, spread in enumerate(spreads.bends)),
        tuple(of(k, ways, spread, _MIN_SPREAD * current.baseline) for k, spread in enumerate(spreads.ways)),
    )


def _estimates_spreads(shutter_model: str, options: BundleOptions) -> bool:
    """Whether a spread is to be estimated."""
    of_turn = shutter_model != "global" and options.phi_sigma is None
    of_way = shutter_model == "constant-motion" and options.velocity_sigma is None
    return of_turn or of_way or options.varying or options.bends > 0 or options.residual_field


def _settled(before: Spreads, after: Spreads, tolerance: float) -> bool:
    """Whether no spread changed by more than a share; what is as good as nothing may go on falling."""
    of_bends = (_SETTLED_AT,) * len(before.bends), (0.0,) * len(before.ways)
    none = Spreads(_SETTLED_AT, 0.0, _SETTLED_AT, _SETTLED_AT, *of_bends, _SETTLED_PX)
    return all(
        abs(new - old) <= tolerance * new or max(old, new) < least
        for old, new, least in zip(*(np.hstack(astuple(each)) for each in (before, after, none)), strict=True)
    )


def _starting_spreads(options: BundleOptions, layout: Layout, baseline: float) -> Spreads:
    start = Spreads(
        options.phi_sigma or options.phi_sigma_start,
        (options.velocity_sigma or options.velocity_sigma_start) * baseline,
        options.focal_sigma_start,
        options.centre_sigma_start,
        tuple(np.broadcast_to(options.bend_sigma_start, len(set(layout.group))).tolist()),
        (options.way_sigma_start * baseline,) * len(set(layout.group[: layout.ways])),
        options.field_sigma_start,
    )
    return _bounded(start, options, baseline)


def _bounded(spreads: Spreads, options: BundleOptions, baseline: float) -> Spreads:
    """The spreads within their upper limits."""
    phi = np.inf if options.phi_sigma_most is None else options.phi_sigma_most
    velocity = np.inf if options.velocity_sigma_most is None else options.velocity_sigma_most * baseline
    return Spreads(
        min(spreads.phi, phi), min(spreads.velocity, velocity), min(spreads.focal, _MOST_VARIED),
        min(spreads.centre, _MOST_VARIED), tuple(min(each, phi) for each in spreads.bends), spreads.ways,
        min(spreads.field, _MOST_PX),
    )  # fmt: skip


def objective(reconstruction: Reconstruction, shutter_model: str, options: BundleOptions) -> float:
    """What `bundle_adjust` lowers in its first solve, at a reconstruction's values.

    Half the robust sum of squares in units of the noise (`options.sigma_px`, which must be given), and the priors.
    Motion that the model lacks, or that is held, counts as zero.
    """
    if options.sigma_px is None:
        raise InputError("the objective needs sigma_px: half a sum of squares means nothing without the noise")
    spreads = _starting_spreads(options, Layout.of(shutter_model, options), reconstruction.baseline)
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
    spreads = _starting_spreads(options, layout, baseline)
    jackknife, factor = options.deviations == "jackknife", 1.0
    # Measurements that seem more exact than they are would pull the intrinsics over the hump of a prior with heavy
    # tails, and they would not come back: it is normal until the noise is known
    prior_of_cameras = jackknife and options.guessed is not None and len(options.refine) > 0
    heavy_tails = False
    for round_ in range(options.outlier_rounds + options.spread_rounds + 1):
        cleaning = round_ < options.outlier_rounds
        # where the first spreads are but a guess, their solution need not be exact
        rough = cleaning or (round_ == 0 and options.spread_rounds > 0 and _estimates_spreads(shutter_model, options))
        believed = replace(base, observations=base.observations.select(keep))
        problem = BundleProblem(believed, shutter_model, options, sigma * factor, spreads, heavy_tails=heavy_tails)
        result = minimize(
            problem,
            problem.initial_state(),
            max_iterations=options.max_iterations,
            cost_tolerance=options.round_tolerance if rough else options.cost_tolerance,
            step_tolerance=options.step_tolerance,
            initial_damping=options.initial_damping,
            max_damping=options.max_damping,
            progress=progress,
        )
        iterations += result.num_iterations
        current = problem.reconstruction(result.state)
        equations = problem.with_squares().linearize(result.state)
        marginals = equations.marginal_covariances()
        weighed, had_tails = factor, heavy_tails
        per_camera = equations.num_shared // equations.num_cameras
        shared = Inflation(np.ones(len(marginals.photos[0])), np.ones(per_camera))
        if jackknife and not rough:
            shared = inflation(equations, problem.partitions(result.state), marginals, factor)
            factor, heavy_tails = shared.noise, True
        del equations
        before, spreads = spreads, _estimated(spreads, current, marginals.photos, options, layout, baseline)
        if options.residual_field:
            values, variances = problem.fields(result.state, marginals.cameras)
            found = _spread(values, variances, np.ones(len(values)), before.field)
            spreads = replace(spreads, field=min(found + _MIN_SPREAD_PX, _MOST_PX))
        revived = revive_points(current, shutter_model)
        if cleaning:
            sigma = options.sigma_px or _noise_px(current, shutter_model, options.min_sigma_px)
            base = replace(revived, observations=base.observations)
            keep = _believed(base, options, sigma)
            alive = base.track_lengths(keep) >= 2
            keep = keep[alive[base.observations.point_idx]]
            base = base.take_points(alive)
        elif (
            not rough
            and revived is current
            and _settled(before, spreads, options.spread_tolerance)
            and abs(factor - weighed) < 0.1 * factor
            and (had_tails or not prior_of_cameras)
        ):
            break
        else:
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
