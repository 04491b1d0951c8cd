"""The shutter model that the measurements support: the one that best predicts measurements held out from its fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import ndtr

from ..model import SHUTTER_MODELS, Reconstruction
from ..model.array_types import Array
from ..model.reprojection import shutter_displacements, typical_px
from .adjust import MODEL_SEQUENCE
from .bundle_options import BundleOptions
from .doubt import steps_to
from .held_out import BENDS, MIN_AGREEMENT, MIN_FALL, SMOOTH_BENDS, ModelFit, ModelFits
from .known_motions import compare_known_motions
from .model_choice import LEAST_RIVAL, LEAST_SEEN_PX, ModelChoice

__all__ = ["choose_model"]

# Share that counts as most of an error.
_MOST_OF_IT = 0.5
# Splines along the readout through this many values follow motions that none of the models can.
_RESTLESS = 49
# A velocity that displaces pixels otherwise by less than this on average is not asked about: none could be seen.
_LEAST_APART = 0.1
_FIELD = ", residual field"


def moved_px(reconstruction: Reconstruction) -> Array:
    """(m,) approximate displacement of pixels by each photo's motion within half a frame from the principal row."""
    rec = reconstruction
    depth = np.linalg.norm(np.median(rec.points_w, axis=0) - rec.center_w, axis=1)
    angle = np.linalg.norm(rec.phi, axis=1) + np.linalg.norm(rec.velocity, axis=1) / depth
    focal = np.array([rec.camera(i).K[0, 0] for i in range(rec.num_images)])
    bent = np.abs(rec.bend).max(1, initial=0.0)
    bent = np.linalg.norm(bent[:, :3], axis=1) + np.linalg.norm(bent[:, 3:], axis=1) / depth
    return np.asarray(focal * (angle * rec.frame_span() / 2 + bent))


class _Selection:
    """The best fit so far, beginning without a shutter; the models that were kept, and reasons against others."""

    def __init__(
        self, fits: ModelFits, best: ModelFit, kept: list[str], gain: dict[str, float], refines: bool, varying: bool
    ) -> None:
        self._fits, self._refines = fits, refines
        self.varying = varying  # whether the lens varies in all shutter models
        self.plain = self.best = best
        self.kept, self.gain = kept, gain
        self.against: list[str] = []

    def consider(self, fit: ModelFit) -> None:
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

    def _or_varying_lens(self, steady: ModelFit, fit: ModelFit) -> ModelFit:
        """A velocity beside steady rotations, or a lens that varies in its place; both if neither predicts better.

        A lens that focuses and a camera that travels both scale and shift what the photo shows. Where the measurements
        do not tell them apart, both are in the estimate: the spread of what they do not need shrinks to nothing.
        """
        fits = self._fits
        if steady.varying or not self._refines:
            return fit
        vary = fits.fit(steady.model, True, [steady.reconstruction], bends=steady.bends, against=fit)
        self.gain[vary.label] = fits.gain(steady, vary)
        if not fits.is_better(steady, vary) or fits.is_better(vary, fit):
            return fit
        if fits.is_better(fit, vary):
            return vary
        both = fits.fit(fit.model, True, [fit.reconstruction, vary.reconstruction], bends=fit.bends)
        self.gain[both.label] = fits.gain(steady, both)
        return both

    @property
    def is_lens_open(self) -> bool:
        """Whether it is still to be tried if the lens of the best varies."""
        # else that was decided beside a velocity. What a lens that varies would explain may be in poses and points
        return self._refines and self.best.varying == self.varying

    def weigh_velocity(self, fit: ModelFit, steady: ModelFit) -> None:
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

    def bend(self, fit: ModelFit) -> None:
        """Try unsteady motions after a fit, where something smooth is left, or lines would still move."""
        for bends in BENDS:
            if bends <= fit.bends:
                continue
            if (fit.is_explained or fit.bends >= SMOOTH_BENDS) and not self._fits.shared_waves(fit):
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
    and two halves of the scene must show the same motions; unless motions that are known from elsewhere, none of them
    fitted, predict better than none. Beside rotations, the one of a velocity and a lens that varies is kept that
    predicts better, or both if neither does; and a lens that varies is tried beside the shutter that is kept. Last
    comes a residual field of each camera, where something smooth is left.

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
    progress : callable, optional
        Called as (model, cost).
    """
    options = options or BundleOptions()
    fits = ModelFits(reconstruction, options, sigma_px, seed, progress)
    selection = _selected(fits, models, bool(options.refine))
    plain, best, kept, gain = selection.plain, selection.best, selection.kept, selection.gain
    against, agreement = selection.against if best is plain else [], None
    known = compare_known_motions(fits, plain, best)
    if best is not plain:
        if np.sqrt(np.mean(moved_px(best.reconstruction) ** 2)) < LEAST_SEEN_PX:
            best = plain
        else:
            # what else bends photos knows nothing of motions that were measured elsewhere
            if known is None or not known.is_better:
                against, agreement = _doubts(fits, best, plain, gain)
            if against:
                best = plain
            elif selection.is_lens_open:
                best = _with_shared_lens(fits, best, gain)
                kept += [best.label] * (best.label not in kept)
    shutter = "found" if best is not plain else "not-determined" if against else "not-found"
    if best is plain:
        best = fits.fit(models[0], False, [fits.given]) if against and plain.is_no_lens else plain
        kept = kept[: kept.index(best.label) + 1]
    if options.refine:
        best = _with_field(fits, best, kept, gain)
    # a lens that varies too much is not kept where no shutter was found, but says why
    zooming = best if shutter == "found" else plain
    rival, rival_px = _rival(fits, best, gain)
    return ModelChoice(
        best.model, best.label, best.varying, shutter,
        {label: float(fit.errors.mean()) if len(fit.errors) else float("nan") for label, fit in fits.done.items()},
        {label: fit.rms_px for label, fit in fits.done.items()}, gain,
        {label: fit.left for label, fit in fits.done.items()}, tuple(kept), agreement, tuple(against),
        len(fits.held_out), best.residual_field, best.bends,
        shutter != "not-determined" and fits.waves(best, _RESTLESS, LEAST_SEEN_PX / 2), rival,
        _steps_of_others(fits, best), known, rival_px=rival_px,
        focal_px=_focal_lengths(zooming.reconstruction) if zooming.varying else {},
    )  # fmt: skip


def _focal_lengths(rec: Reconstruction) -> dict[str, float]:
    """Focal lengths of the photos, pixels."""
    return {name: float(rec.camera(i).K[0, 0]) for i, name in enumerate(rec.image_names)}


def _with_field(fits: ModelFits, best: ModelFit, kept: list[str], gain: dict[str, float]) -> ModelFit:
    """The same with a residual field of each camera, if something smooth is left and it is better."""
    # a warp of each photo alone is fitted to few measurements, and removes less than one that all share
    if not len(fits.held_out) or best.left <= _MOST_OF_IT * MIN_FALL * float(best.errors.mean()):
        return best
    label = f"{best.label}{_FIELD}"
    field = fits.fit(best.model, best.varying, [best.reconstruction], label, best.bends, residual_field=True)
    gain[label] = fits.gain(best, field)
    if not fits.is_better(best, field):
        return best
    kept.append(label)
    return field


def _steps_of_others(fits: ModelFits, best: ModelFit) -> dict[str, tuple[float, ...]]:
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


def _rival(fits: ModelFits, best: ModelFit, gain: dict[str, float]) -> tuple[float, float]:
    """`ModelChoice.rival` and `rival_px`, the most of the velocities that were tried; with the lens of the best."""
    if best.model != "rotation":
        return 0.0, 0.0
    found = _rival_of_tried(fits, best)
    if found[0] >= LEAST_RIVAL and not best.residual_field:
        velocity = fits.fit("constant-motion", best.varying, [best.reconstruction])
        gain.setdefault(velocity.label, fits.gain(best, velocity))
        found = _rival_of_tried(fits, best)
    return found


def _rival_of_tried(fits: ModelFits, best: ModelFit) -> tuple[float, float]:
    """`_rival` of the models that were fitted."""
    shares, (own, seen) = [(0.0, 0.0)], shutter_displacements(best.reconstruction)
    for fit in fits.done.values():
        if fit.model == "constant-motion" and not fits.is_better(fit, best):
            other, valid = shutter_displacements(fit.reconstruction)
            apart, size = (typical_px(best.reconstruction, each, seen & valid) for each in (other - own, own))
            shares.append((float(apart / max(size, 1e-9)), float(apart)) if apart >= _LEAST_APART else (0.0, 0.0))
    return max(shares)


def _selected(fits: ModelFits, models: Sequence[str], refines: bool) -> _Selection:
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
    selection, steady = _Selection(fits, plain, kept, gain, refines, varying), last
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
            selection.bend(selection.best if selection.best.model == model else last)
            last = selection.best if selection.best.model == model else last
    plainer = _without_bends(fits, selection.best)
    if plainer is not selection.best:
        selection.best = plainer
        kept.append(plainer.label)
    return selection


def _without_bends(fits: ModelFits, best: ModelFit) -> ModelFit:
    """The same with steady motions, if a later model or a lens that varies explains what bends explained before."""
    if not best.bends:
        return best
    steady = fits.fit(best.model, best.varying, [best.reconstruction, fits.given])
    return best if fits.is_better(steady, best) else steady


def _doubts(fits: ModelFits, best: ModelFit, plain: ModelFit, gain: dict[str, float]) -> tuple[list[str], float | None]:
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
    if agreement < MIN_AGREEMENT:
        return [
            f"two halves of the scene do not ask for the same motions in the same photos (correlation {agreement:.2f})"
        ], agreement
    return [], agreement


def _with_shared_lens(fits: ModelFits, best: ModelFit, gain: dict[str, float]) -> ModelFit:
    """A shutter model with one lens for all photos, or with one that varies, if that is better."""
    shared, vary = (
        fits.fit(best.model, each, [best.reconstruction, fits.given], bends=best.bends) for each in (False, True)
    )
    gain[vary.label] = fits.gain(shared, vary)
    return _without_bends(fits, vary) if fits.is_better(shared, vary) else shared
