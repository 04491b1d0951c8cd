"""Bundle adjustment with outlier rounds, and the sequence of shutter models."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..errors import InputError, RsUndistortWarning
from ..model import Reconstruction, check_shutter_model
from .bundle_options import BundleOptions, BundleResult
from .known_lengths import measured_lengths
from .layout import Layout
from .prior_sigmas import estimates_sigmas, starting_sigmas
from .problem import BundleProblem
from .rounds import Rounds

__all__ = ["MODEL_SEQUENCE", "adjust_sequence", "bundle_adjust", "objective", "sequence_to"]

#: Shutter models in the order in which they are adjusted, each from the one before.
MODEL_SEQUENCE = ("global", "two-step", "rotation", "constant-motion")

# Relative fall of the cost that ends a solve whose prior standard deviations will still change.
_UNSETTLED_TOLERANCE = 1e-5
# The same of a path, whose frames a start from another adjustment knows well.
_UNSETTLED_PATH = 1e-4


def objective(reconstruction: Reconstruction, shutter_model: str, options: BundleOptions) -> float:
    """The cost that `bundle_adjust` minimises in its first solve, at the values of a reconstruction.

    Half the robust sum of squares in units of the noise (`options.sigma_px`, which must be given), and the priors.
    Motion that the model lacks, or that is held, counts as zero.
    """
    if options.sigma_px is None:
        raise InputError("the objective needs sigma_px: half a sum of squares means nothing without the noise")
    sigmas = starting_sigmas(options, Layout.of(shutter_model, options), reconstruction)
    problem = BundleProblem(reconstruction, shutter_model, options, options.sigma_px, sigmas, heavy_tails=False)
    return problem.cost(problem.initial_state())


def bundle_adjust(
    reconstruction: Reconstruction,
    shutter_model: str = "rotation",
    options: BundleOptions | None = None,
    progress: Callable[[float], None] | None = None,
    *,
    simpler_first: bool = False,
) -> BundleResult:
    """Poses, shutter motions and points that explain the measurements best.

    Parameters
    ----------
    reconstruction : Reconstruction
        Start; its phi is the start of phi.
    shutter_model : {"global", "two-step", "linearized", "rotation", "constant-motion"}
        How the shutter is modelled.
    options : BundleOptions, optional
        Tolerances, loss, priors, constraints.
    progress : callable, optional
        Called with the cost after each accepted step.
    simpler_first : bool
        Adjust with the simpler models first, each from the one before, phi from zero: for starts without motions, such
        as those of global-shutter programs.

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
    if simpler_first:
        tell = None if progress is None else (lambda _, cost: progress(cost))
        return adjust_sequence(reconstruction, sequence_to(shutter_model), options, tell)[shutter_model]
    rounds = Rounds(reconstruction, shutter_model, options, progress)
    for left in reversed(range(options.outlier_rounds)):
        # the last one estimates the noise, which weighs what follows
        rounds.solve(options.round_tolerance, is_judged=left == 0)
        rounds.drop_outliers()
    most = options.prior_sigma_rounds + 1
    is_guess = options.path is None or options.path.start is None
    if is_guess and not options.outlier_rounds and most > 1 and estimates_sigmas(shutter_model, options):
        # the first prior standard deviations are a guess: their solution need not be exact
        rounds.solve(options.round_tolerance)
        rounds.begin_next()
        most -= 1
    unsettled = _UNSETTLED_TOLERANCE if is_guess else _UNSETTLED_PATH
    exact = options.cost_tolerance >= unsettled
    for left in reversed(range(most)):
        exact = exact or left == 0
        # a jackknife takes as long as many steps: once the noise is known only the last solve needs one
        judged = exact or not rounds.noise_is_known
        rounds.solve(options.cost_tolerance if exact else unsettled, is_judged=judged)
        if rounds.are_settled and exact:
            break
        exact = exact or rounds.are_settled
        rounds.begin_next(with_same_weights=rounds.are_settled)
    result = rounds.result()
    if options.deviations == "jackknife":  # another adjustment may find their points
        for reason in measured_lengths(result.reconstruction, options.lengths)[1]:
            warnings.warn(f"a known length is not used: {reason}", RsUndistortWarning, stacklevel=2)
    return result


def sequence_to(shutter_model: str) -> tuple[str, ...]:
    """Shutter models that end at one, each the start of the next."""
    check_shutter_model(shutter_model)
    if shutter_model in MODEL_SEQUENCE:
        return MODEL_SEQUENCE[: MODEL_SEQUENCE.index(shutter_model) + 1]
    return ("global", "two-step", shutter_model)


def adjust_sequence(
    reconstruction: Reconstruction,
    models: Sequence[str] = MODEL_SEQUENCE,
    options: BundleOptions | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, BundleResult]:
    """Adjust with one shutter model after the other, each started from the one before, phi from zero.

    Parameters
    ----------
    models : sequence of str
        Shutter models, the simplest first.
    options : BundleOptions, optional
        Of the last; of the others as far as they concern a start.
    progress : callable, optional
        Called as (model, cost) after each accepted step.

    Returns
    -------
    dict of BundleResult
        By model, in the order solved. All but the last are rough: no outliers are dropped from them.
    """
    options = options or BundleOptions()
    # every model except the last is only a start: what it cannot explain is no outlier, and it need not converge; the
    # lens would absorb a shutter that is not modelled yet, and bend what is known of the scene
    rough = replace(
        options, outlier_rounds=0, prior_sigma_rounds=0, cost_tolerance=options.round_tolerance, refine=(), lengths=(),
        places=None, deviations="model", residual_field=False,
    )  # fmt: skip
    results: dict[str, BundleResult] = {}
    current = replace(reconstruction, phi=np.zeros((reconstruction.num_images, 3)))
    for model in models:
        step = None if progress is None else (lambda cost, model=model: progress(model, cost))
        results[model] = bundle_adjust(current, model, options if model == models[-1] else rough, step)
        current = results[model].reconstruction
    return results
