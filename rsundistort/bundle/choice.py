"""The shutter model that the measurements support: the one that best predicts measurements held out from its fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.special import ndtr

from ..errors import InputError
from ..model import SHUTTER_MODELS, Observations, Reconstruction, other_axis
from ..model.array_types import Array, Index, Mask
from ..model.reprojection import reprojection_residuals, shutter_displacements, typical_px
from .adjust import MODEL_SEQUENCE, bundle_adjust, objective
from .bundle_options import BundleOptions
from .doubt import steps_to
from .model_choice import ModelChoice
from .prior_sigmas import MOST_VARIED, PriorSigmas
from .remains import CLIP, WAVES, agreement_of_waves, errors_without, half_across_readout, warps, waves

__all__ = [
    "choose_model", "clipped_errors", "corners", "enough_points", "hold_out", "improves",
    "standard_errors",
]  # fmt: skip

# Measurements of a photo that models are compared by, where it has more: they find a fall by `_MIN_FALL` with three
# standard errors, and more would not change what is kept.
_ENOUGH = 1500

# A track may lose one measurement if this many are left: two determine the point, the third checks them.
_LEFT_OVER = 3
# Parts of a photo, across and down; the measurements of each count once.
_PARTS = 4
# A model is better if the held-out error falls by this many standard errors: one in six models without effect would
# pass with one, one in forty passes with two.
_MIN_GAIN = 2.0
# And by this share of the error.
_MIN_FALL = 0.02
# Share that counts as most of an error.
_MOST_OF_IT = 0.5
# Splines along the readout through this many values follow motions that none of the models can.
_RESTLESS = 49
# Two halves of a scene must show the same motions: what they have in common exceeds their difference. (Warped photos:
# 0.98 and more; a camera without rolling shutter: 0.1 to 0.5.)
_MIN_AGREEMENT = 0.5
# Motions that displace pixels by less than this, root mean square over the photos, count as none.
_UNSEEN_PX = 0.5
# Share of the limit of a prior standard deviation: an estimate this near would be larger without the limit.
_AT_LIMIT = 0.99
# A model that does not fit converges slowly along a narrow valley; the others converge in fewer steps.
_MOST_STEPS = 15

_VARYING, _FIELD = ", varying lens", ", residual field"
# Unsteady motions, by the groups of bends that they have. A cubic that is free in each photo hides the height of the
# scene, so a rate that changes steadily is tried without it.
_BENDS = {0: "", 1: ", accelerating", 2: ", bent", 5: ", vibrating"}
# Groups that a smooth warp could imitate; the others displace lines faster.
_SMOOTH_BENDS = 2


def enough_points(reconstruction: Reconstruction, per_photo: int = _ENOUGH, seed: int = 0) -> Mask:
    """(n,) points of a sample with so many measurements of each photo or more; all of a photo that has fewer."""
    obs = reconstruction.observations
    order = np.random.default_rng([seed, 11]).permutation(reconstruction.num_points)[obs.point_idx]
    by_photo = np.lexsort((order, obs.frame_idx))
    frames = obs.frame_idx[by_photo]
    rank = np.arange(len(obs)) - np.searchsorted(frames, frames)
    taken = np.zeros(reconstruction.num_points, bool)
    taken[obs.point_idx[by_photo[rank < per_photo]]] = True
    return taken


def hold_out(reconstruction: Reconstruction, share: float = 0.1, seed: int = 0) -> tuple[Mask, Mask]:
    """Masks (o,) of the measurements to fit and of those to hold out.

    At most one measurement of a track is held out, and only of tracks of at least four photos; of three where none is
    longer.
    """
    obs = reconstruction.observations
    rng = np.random.default_rng([seed, 7])
    lengths = np.bincount(obs.point_idx, minlength=reconstruction.num_points)
    spare = np.flatnonzero(lengths > min(_LEFT_OVER, lengths.max(initial=0) - 1))
    wanted = min(round(share * len(obs)), len(spare))
    chosen = rng.permutation(spare)[:wanted]
    # a random measurement of each chosen point: the first of its own in a random order
    order = rng.permutation(len(obs))
    first = np.full(reconstruction.num_points, -1)
    first[obs.point_idx[order[::-1]]] = order[::-1]
    held = np.zeros(len(obs), bool)
    held[first[chosen]] = True
    return ~held, held


def clipped_errors(rec: Reconstruction, measured: Observations, sigma_px: float) -> tuple[Array, float]:
    """Half the clipped squared residual of each measurement in units of the noise, and their rms in pixels."""
    res, valid = reprojection_residuals(replace(rec, observations=measured))
    noise = sigma_px * measured.sigma
    square = np.where(valid, (res**2).sum(1) / noise**2, np.inf)
    clipped = np.minimum(square, 2 * CLIP**2)
    return clipped / 2, float(np.sqrt(np.mean(clipped * noise**2) / 2))


def standard_errors(fall: Array, group: Index | None = None) -> float:
    """Mean fall of errors in units of its standard error; 0 if nothing fell.

    Errors of the measurements of a group (n,) are correlated, and count once: what the lens does in a corner of a
    photo, it does to all measurements there (the cluster-robust variance of a mean).
    """
    rest = fall - fall.mean() if len(fall) else fall
    sums = rest if group is None else np.bincount(np.unique(group, return_inverse=True)[1], rest)
    if len(sums) < 2:
        return 0.0
    spread = float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1))) / len(fall)
    return float(fall.mean() / spread) if spread > 0 else 0.0


def improves(before: Array, after: Array, gain: float) -> bool:
    """Whether a model that the user named explains its measurements well enough for its motions to be trusted.

    Its errors (n,) must fall by two standard errors (`gain`), and by more than their excess over those of noise alone:
    no other model was tried, so the remaining error counts against it.
    """
    return gain > _MIN_GAIN and (before - after).mean() > max(_MIN_FALL * before.mean(), after.mean() - 1.0)


def corners(rec: Reconstruction, measured: Observations) -> Index:
    """(n,) groups of measurements: those in one of 4 x 4 parts of one photo."""
    size = np.array([(camera.width, camera.height) for camera in rec.cameras])[rec.camera_idx][measured.frame_idx]
    x, y = np.clip(_PARTS * (measured.xy_raw + 0.5) / size, 0, _PARTS - 1).astype(np.int64).T
    return np.asarray((measured.frame_idx * _PARTS + y) * _PARTS + x)


@dataclass(frozen=True)
class _Fit:
    """One model fitted, and its held-out errors."""

    label: str
    model: str
    varying: bool
    bends: int
    residual_field: bool
    reconstruction: Reconstruction
    errors: Array
    rms_px: float
    left: float
    sigmas: PriorSigmas

    @property
    def is_explained(self) -> bool:
        """Whether next to nothing is left that another model could explain."""
        return self.left <= _MIN_FALL * float(self.errors.mean()) if len(self.errors) else True

    @property
    def is_no_lens(self) -> bool:
        """Whether a lens would have to vary more than lenses do.

        Then it makes up for something else: a camera that travels by 6 px a frame over flat ground can be a principal
        point that wanders by 13.
        """
        return self.varying and max(self.sigmas.focal, self.sigmas.centre) >= _AT_LIMIT * MOST_VARIED


def moved_px(reconstruction: Reconstruction) -> Array:
    """(m,) approximate displacement of pixels by each photo's motion within half a frame from the principal row."""
    rec = reconstruction
    depth = np.linalg.norm(np.median(rec.points_w, axis=0) - rec.center_w, axis=1)
    angle = np.linalg.norm(rec.phi, axis=1) + np.linalg.norm(rec.velocity, axis=1) / depth
    focal = np.array([rec.camera(i).K[0, 0] for i in range(rec.num_images)])
    bent = np.abs(rec.bend).max(1, initial=0.0)
    bent = np.linalg.norm(bent[:, :3], axis=1) + np.linalg.norm(bent[:, 3:], axis=1) / depth
    return np.asarray(focal * (angle * rec.frame_span() / 2 + bent))


def read_along_other_axis(reconstruction: Reconstruction) -> Reconstruction:
    """The same photos as if all cameras were read along the other axis; without motion."""
    cameras = [replace(each, readout=other_axis(each.readout)) for each in reconstruction.cameras]
    still = np.zeros_like(reconstruction.phi)
    return replace(reconstruction, cameras=cameras, phi=still, velocity=still, bend=np.zeros(0))


def _turns(rec: Reconstruction) -> Array:
    """(m, k, 3) rotation vectors of each photo's camera at some lines, radians."""
    motions = [rec.motion(i) for i in range(rec.num_images)]
    ranges = [rec.camera(i).clock_range for i in range(rec.num_images)]
    return np.stack([each.at(np.linspace(*of, WAVES))[0] for each, of in zip(motions, ranges, strict=True)])


class _Fits:
    """Models fitted to nine tenths of the measurements and judged by the rest."""

    def __init__(
        self,
        reconstruction: Reconstruction,
        options: BundleOptions,
        sigma_px: float,
        seed: int,
        progress: Callable[[str, float], None] | None,
    ) -> None:
        reconstruction = reconstruction.take_points(enough_points(reconstruction, seed=seed))
        fitted, held = hold_out(reconstruction, seed=seed)
        # gross outliers were dropped before: squares, and only as exact as the comparison of models requires
        self._rough = replace(
            options, outlier_rounds=0, prior_sigma_rounds=4, prior_sigma_tolerance=0.05, loss="squared",
            sigma_px=sigma_px, cost_tolerance=1e-5, max_iterations=_MOST_STEPS, lengths=(), deviations="model",
        )  # fmt: skip
        self.given = replace(reconstruction, observations=reconstruction.observations.select(fitted))
        self.held_out = reconstruction.observations.select(held)
        self._group = corners(reconstruction, self.held_out)
        self._sigma_px = sigma_px
        self._progress = progress
        self.done: dict[str, _Fit] = {}

    def fit(
        self, model: str, varying: bool, starts: Sequence[Reconstruction], label: str | None = None, bends: int = 0,
        residual_field: bool = False,
    ) -> _Fit:  # fmt: skip
        """Fit a model from the cheapest of some starts."""
        label = label or model + _BENDS[bends] + _VARYING * varying
        if label in self.done:
            return self.done[label]
        step = None if self._progress is None else partial(self._progress, label)
        options = replace(self._rough, varying=varying, bends=bends, residual_field=residual_field)
        # the given motions belong to the given poses and lens: with those of another model they do not fit. The cheaper
        # start guarantees that a model never ends above the simpler one, which it contains
        cost = [objective(start, model, options) for start in starts]
        result = bundle_adjust(starts[int(np.argmin(cost))], model, options, step)
        found, sigmas = result.reconstruction, PriorSigmas(
            result.phi_rms, result.velocity_rms, result.focal_sigma, result.centre_sigma,
        )  # fmt: skip
        errors, rms_px = clipped_errors(found, self.held_out, self._sigma_px)
        smooth = errors_without(warps, found, self.given.observations, self.held_out, self._sigma_px)
        left = max(float(errors.mean() - smooth.mean()), 0.0) if len(errors) else 0.0
        self.done[label] = _Fit(label, model, varying, bends, residual_field, found, errors, rms_px, left, sigmas)
        return self.done[label]

    def along_other_axis(self, fit: _Fit, plain: _Fit) -> _Fit:
        """The model of a fit read along the other axis, from fits without a shutter; vibrations on the same terms.

        One that lets the lens vary is no start where it does not: without what varied, its poses fit nothing.
        """

        def read(starts: Sequence[Reconstruction], bends: int) -> _Fit:
            label = f"{fit.model}{_BENDS[bends]}{_VARYING * fit.varying}, read along the other axis"
            return self.fit(fit.model, fit.varying, starts, label, bends)

        smooth = min(fit.bends, _SMOOTH_BENDS)
        still = self.fit(plain.model, False, [self.given])
        other = read([read_along_other_axis(each.reconstruction) for each in (plain, still)], smooth)
        if fit.bends > smooth and self.waves_agree(other):
            other = read([other.reconstruction], fit.bends)
        return other

    def agreement(self, fit: _Fit) -> float:
        """Correlation over photos, axes and lines of the rotations that two halves of the scene show, fitted alone.

        The scene is divided across the readout, so that both halves see all of it. A lens error bends them differently;
        the means over the photos are subtracted, since a lens error can cause them.
        """
        rec = fit.reconstruction
        phi, velocity = fit.sigmas.phi, fit.sigmas.velocity or None
        options = replace(self._rough, varying=fit.varying, bends=fit.bends, phi_sigma=phi, velocity_sigma=velocity)
        first = half_across_readout(rec)
        try:
            halves = [bundle_adjust(rec.take_points(half), fit.model, options) for half in (first, ~first)]
        except InputError:  # one without measurements
            return 0.0
        one, other = (_turns(each.reconstruction) for each in halves)
        one, other = one - one.mean(0), other - other.mean(0)
        scale = float(np.sqrt((one**2).sum() * (other**2).sum()))
        return float((one * other).sum() / scale) if scale > 0 else 0.0

    def waves(self, fit: _Fit, sites: int = WAVES, least_px: float = 0.0) -> bool:
        """Whether free displacements of each photo's lines would remove significantly more than a smooth warp of it.

        And by more than `least_px`, root mean square.
        """
        if not len(self.held_out):
            return False
        seen = self.given.observations
        smooth, free = (
            errors_without(functions, fit.reconstruction, seen, self.held_out, self._sigma_px).mean()
            for functions in (warps, partial(waves, sites=sites))
        )
        fall = float(smooth - free)
        return fall > _MIN_FALL * float(fit.errors.mean()) and fall > (least_px / self._sigma_px) ** 2 / 2

    def waves_agree(self, fit: _Fit) -> bool:
        """Whether two halves of the scene show the same motions of the lines."""
        return agreement_of_waves(fit.reconstruction, self._sigma_px) >= _MIN_AGREEMENT

    def at_limit(self, fit: _Fit) -> bool:
        """Whether the motions reach the limit that is known from elsewhere."""
        limits = [(fit.sigmas.phi, self._rough.phi_sigma_most)]
        if fit.model == "constant-motion":
            limits.append((fit.sigmas.velocity, self._rough.velocity_sigma_most))
        return any(most is not None and spread >= _AT_LIMIT * most for spread, most in limits)

    def gain(self, before: _Fit, after: _Fit) -> float:
        """Fall of the held-out error from one fit to another, in standard errors."""
        return standard_errors(before.errors - after.errors, self._group)

    def is_better(self, before: _Fit, after: _Fit) -> bool:
        """Whether that fall is significant in standard errors and as a share."""
        if not len(self.held_out):
            return False
        fall = float((before.errors - after.errors).mean())
        return self.gain(before, after) > _MIN_GAIN and fall > _MIN_FALL * float(before.errors.mean())


class _Selection:
    """The best fit so far, beginning without a shutter; the models that were kept, and reasons against others."""

    def __init__(self, fits: _Fits, best: _Fit, kept: list[str], gain: dict[str, float], refines: bool) -> None:
        self._fits, self._refines = fits, refines
        self.plain = self.best = best
        self.kept, self.gain = kept, gain
        self.against: list[str] = []

    def consider(self, fit: _Fit) -> None:
        """Keep a fit that is better, if it removes more than a smooth warp of each photo would still remove."""
        fits, best = self._fits, self.best
        if fit is best:
            return
        self.gain[fit.label] = fits.gain(best, fit)
        # where both are equally good, the exact rotation is taken, not its approximation
        steady = fit.model == "rotation" and not fit.bends
        exact = best.model == "two-step" and steady and not fits.is_better(fit, best)
        if not exact and not fits.is_better(best, fit):
            return
        if best.model == "rotation" and fit.model == "constant-motion":
            fit = self._or_varying_lens(best, fit)
        if exact or float((best.errors - fit.errors).mean()) > fit.left:
            self.best = fit
            self.kept.append(fit.label)
        else:
            self.against.append(f"{fit.label} removes less of what bends the photos than it leaves")

    def _or_varying_lens(self, steady: _Fit, fit: _Fit) -> _Fit:
        """A velocity beside steady rotations, or a lens that varies in its place, if that predicts better.

        A lens that focuses and a camera that travels both scale and shift what the photo shows.
        """
        fits = self._fits
        if steady.varying or not self._refines:
            return fit
        vary = fits.fit(steady.model, True, [steady.reconstruction], bends=steady.bends)
        self.gain[vary.label] = fits.gain(steady, vary)
        is_ahead = float(vary.errors.mean()) < float(fit.errors.mean())
        return vary if is_ahead and fits.is_better(steady, vary) else fit

    def weigh_velocity(self, fit: _Fit, steady: _Fit) -> None:
        """Keep a velocity in place of unsteady rotations, if it predicts better what `steady` ones leave.

        Both give each photo three numbers more; over a flat scene the one looks like the other, and travel is usual.
        """
        fits, best = self._fits, self.best
        if best.model != "rotation" or not best.bends:
            return
        self.gain[fit.label] = fits.gain(best, fit)
        ahead = float(fit.errors.mean()) < float(best.errors.mean())
        ahead = ahead and float((steady.errors - fit.errors).mean()) > fit.left
        if ahead and fits.is_better(steady, fit):
            self.best = self._or_varying_lens(steady, fit)
            self.kept.append(self.best.label)

    def bend(self, fit: _Fit) -> None:
        """Try unsteady motions after a fit, where something smooth is left, or lines would still move."""
        for bends in _BENDS:
            if bends <= fit.bends:
                continue
            # a vibration rotates the whole line: both halves of the scene show it
            if (fit.is_explained or fit.bends >= _SMOOTH_BENDS) and not (
                self._fits.waves(fit) and self._fits.waves_agree(fit)
            ):
                return
            fit = self._fits.fit(fit.model, fit.varying, [fit.reconstruction], bends=bends)
            self.consider(fit)


def choose_model(
    reconstruction: Reconstruction,
    models: Sequence[str] = MODEL_SEQUENCE,
    options: BundleOptions | None = None,
    *,
    sigma_px: float,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> ModelChoice:
    """Fit models to nine tenths of the measurements (of `enough_points`), and keep those that predict the rest better.

    First a lens that varies from photo to photo is tried, then the shutter models in order, so that these explain what
    no lens does; then unsteady motions, where the lines of the photos would still move. A model is better if the mean
    held-out error falls by more than two standard errors, measurements in the same part of the same photo counted
    once, and by more than two hundredths. A shutter model must also remove more than a smooth warp of each photo would
    still remove, and be better than itself read along the other axis (other causes that bend photos fit either axis),
    and two halves of the scene must show the same motions. Beside rotations, the one of a velocity and a lens that
    varies is kept that predicts better. Last comes a residual field of each camera, where something smooth is left.

    Parameters
    ----------
    reconstruction : Reconstruction
        Measurements without gross outliers, and a start.
    models : sequence of str
        Models in the order of the sequence, the first without a shutter.
    options : BundleOptions, optional
        Of the fits, which are approximate and use squares. Without refined intrinsics none vary either.
    sigma_px : float
        Noise of the measurements, as estimated by the last adjustment.
    seed : int
        Of the choice of measurements.
    progress : callable, optional
        Called as (model, cost).
    """
    options = options or BundleOptions()
    fits = _Fits(reconstruction, options, sigma_px, seed, progress)
    selection = _selected(fits, models, bool(options.refine))
    plain, best, kept, gain = selection.plain, selection.best, selection.kept, selection.gain
    against, agreement = selection.against if best is plain else [], None
    if best is not plain:
        if np.sqrt(np.mean(moved_px(best.reconstruction) ** 2)) < _UNSEEN_PX:
            best = plain
        else:
            against, agreement = _doubts(fits, best, plain, gain)
            if against:
                best = plain
            elif plain.varying:
                best = _with_shared_lens(fits, best, gain)
                kept += [best.label] * (best.label not in kept)
    shutter = "found" if best is not plain else "not-determined" if against else "not-found"
    if best is plain:
        best = fits.fit(models[0], False, [fits.given]) if against and plain.is_no_lens else plain
        kept = kept[: kept.index(best.label) + 1]
    # a warp of each photo alone is fitted to few measurements, and removes less than one that all share
    if options.refine and len(fits.held_out) and best.left > _MOST_OF_IT * _MIN_FALL * float(best.errors.mean()):
        label = f"{best.label}{_FIELD}"
        field = fits.fit(best.model, best.varying, [best.reconstruction], label, best.bends, residual_field=True)
        gain[label] = fits.gain(best, field)
        if fits.is_better(best, field):
            best = field
            kept.append(label)
    return ModelChoice(
        best.model,
        best.label,
        best.varying,
        shutter,
        {label: float(fit.errors.mean()) if len(fit.errors) else float("nan") for label, fit in fits.done.items()},
        {label: fit.rms_px for label, fit in fits.done.items()},
        gain,
        {label: fit.left for label, fit in fits.done.items()},
        tuple(kept),
        agreement,
        tuple(against),
        len(fits.held_out),
        best.residual_field,
        best.bends,
        shutter != "not-determined" and fits.waves(best, _RESTLESS, _UNSEEN_PX / 2),
        _rival(fits, best),
        _steps_of_others(fits, best),
    )


def _steps_of_others(fits: _Fits, best: _Fit) -> dict[str, tuple[float, ...]]:
    """`ModelChoice.steps`. A model is right with the probability that its held-out error is the smaller one."""
    if best.model == "global":
        return {}
    rec, most = best.reconstruction, np.zeros((best.reconstruction.num_images, 12))
    for fit in fits.done.values():
        same = [each.readout for each in fit.reconstruction.cameras] == [each.readout for each in rec.cameras]
        if fit is best or not same or SHUTTER_MODELS[fit.model] < SHUTTER_MODELS["rotation"] or not len(fit.errors):
            continue
        ahead = float(ndtr(-fits.gain(fit, best)))
        steps = np.sqrt(ahead / (ahead + 0.5)) * steps_to(fit.reconstruction, rec)
        most = steps if (steps[:, 6:9] ** 2).sum() > (most[:, 6:9] ** 2).sum() else most
    return {name: tuple(each) for name, each in zip(rec.image_names, most.tolist(), strict=True)}


def _rival(fits: _Fits, best: _Fit) -> float:
    """`ModelChoice.rival`, the most of the velocities that were tried."""
    if best.model != "rotation":
        return 0.0
    shares, (own, seen) = [0.0], shutter_displacements(best.reconstruction)
    for fit in fits.done.values():
        if fit.model == "constant-motion" and not fits.is_better(fit, best):
            other, valid = shutter_displacements(fit.reconstruction)
            apart, size = (typical_px(best.reconstruction, each, seen & valid) for each in (other - own, own))
            shares.append(float(apart / max(size, 1e-9)) if apart >= _UNSEEN_PX else 0.0)
    return max(shares)


def _selected(fits: _Fits, models: Sequence[str], refines: bool) -> _Selection:
    """The models in order: a lens that varies, then those of the shutter, then unsteady motions."""
    given = fits.given
    first = plain = fits.fit(models[0], False, [given])
    kept, gain = [first.label], dict[str, float]()
    if refines and not first.is_explained:
        vary = fits.fit(models[0], True, [first.reconstruction])
        gain[vary.label] = fits.gain(first, vary)
        if fits.is_better(first, vary):
            plain = vary
            kept.append(vary.label)
    last, varying = plain, plain.varying
    if varying and "rotation" in models:
        # where a shutter alone leaves less than half of what a varying lens does, the lens is not what bends the photos
        alone = fits.fit("rotation", False, [first.reconstruction, given])
        varying = not float(alone.errors.mean()) < _MOST_OF_IT * float(plain.errors.mean())
        last = last if varying else first
    selection, steady = _Selection(fits, plain, kept, gain, refines), last
    if not len(fits.held_out):
        selection.against.append("no point is seen by three photos, so no measurement could be held out to judge by")
    for model in models[1:]:
        if model == "constant-motion":
            selection.weigh_velocity(fits.fit(model, varying, [last.reconstruction, given]), steady)
        if selection.best.bends and selection.best.is_explained:
            break
        last = fits.fit(model, varying, [last.reconstruction, given], bends=selection.best.bends)
        selection.consider(last)
        steady = last
        if SHUTTER_MODELS[model] >= SHUTTER_MODELS["rotation"]:
            selection.bend(last)
            last = selection.best if selection.best.model == model else last
    plainer = _without_bends(fits, selection.best)
    if plainer is not selection.best:
        selection.best = plainer
        kept.append(plainer.label)
    return selection


def _without_bends(fits: _Fits, best: _Fit) -> _Fit:
    """The same with steady motions, if a later model or a lens that varies explains what bends explained before."""
    if not best.bends:
        return best
    steady = fits.fit(best.model, best.varying, [best.reconstruction, fits.given])
    return best if fits.is_better(steady, best) else steady


def _doubts(fits: _Fits, best: _Fit, plain: _Fit, gain: dict[str, float]) -> tuple[list[str], float | None]:
    """Reasons against a shutter, for people, and the correlation of the motions of two halves of the scene.

    One reason is enough, and the last ones take the longest to compute.
    """
    if fits.at_limit(best):
        return ["the exposure times allow less motion than they would need"], None
    other = fits.along_other_axis(best, plain)
    gain[other.label] = fits.gain(best, other)
    if not fits.is_better(other, best):
        return ["a shutter that reads along the other axis explains the photos as well"], None
    agreement = fits.agreement(best)
    if agreement < _MIN_AGREEMENT:
        return [f"two halves of the scene show different motions (correlation {agreement:.2f})"], agreement
    return [], agreement


def _with_shared_lens(fits: _Fits, best: _Fit, gain: dict[str, float]) -> _Fit:
    """A shutter model with one lens for all photos, or with one that varies, if that is better."""
    shared, vary = (
        fits.fit(best.model, each, [best.reconstruction, fits.given], bends=best.bends) for each in (False, True)
    )
    gain[vary.label] = fits.gain(shared, vary)
    return _without_bends(fits, vary) if fits.is_better(shared, vary) else shared
