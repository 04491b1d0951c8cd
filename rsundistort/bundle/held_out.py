"""Models fitted to nine tenths of the measurements, and judged by how well they predict the rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..model import Observations, Reconstruction, other_axis
from ..model.array_types import Array, Index, Mask
from ..model.reprojection import reprojection_residuals
from .adjust import bundle_adjust, objective
from .bundle_options import BundleOptions
from .prior_sigmas import MOST_VARIED, PriorSigmas
from .remains import CLIP, WAVES, agreement_of_waves, errors_without, half_across_readout, warps, waves

__all__ = [
    "BENDS", "MIN_AGREEMENT", "MIN_FALL", "SMOOTH_BENDS", "ModelFit", "ModelFits", "clipped_errors", "corners",
    "enough_points", "hold_out", "improves", "standard_errors",
]  # fmt: skip

# Measurements of a photo that models are compared by, where it has more: they find a fall by `MIN_FALL` with three
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
MIN_FALL = 0.02
# Two halves of a scene must show the same motions: what they have in common exceeds their difference. (Warped photos:
# 0.98 and more; a camera without rolling shutter: 0.1 to 0.5.)
MIN_AGREEMENT = 0.5
# Share of the limit of a prior standard deviation: an estimate this near would be larger without the limit.
_AT_LIMIT = 0.99
# A model that does not fit converges slowly along a narrow valley; the others converge in fewer steps.
_MOST_STEPS = 15
# A model that leaves so many times the held-out error of another will not be better.
_HOPELESS = 2.0
# Standard deviation that holds motions where they are, radians per frame.
_HELD = 1e-6

_VARYING = ", varying lens"
# Unsteady motions, by the groups of bends that they have. A cubic that is free in each photo hides the height of the
# scene, so a rate that changes steadily is tried without it.
BENDS = {0: "", 1: ", accelerating", 2: ", bent", 5: ", vibrating"}
# Least correlation of the waves that two halves of the scene show, if a vibration is to be among them: 0.8 of one of a
# milliradian, and 0.4 of several, since points of either half take up a part; 0.02 to 0.14 of photos without one.
_SHARED = 0.25
# Groups that a smooth warp could imitate; the others displace lines faster.
SMOOTH_BENDS = 2


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
    spare = np.flatnonzero(lengths > max(min(_LEFT_OVER, lengths.max(initial=0) - 1), 2))
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
    return gain > _MIN_GAIN and (before - after).mean() > max(MIN_FALL * before.mean(), after.mean() - 1.0)


def corners(rec: Reconstruction, measured: Observations) -> Index:
    """(n,) groups of measurements: those in one of 4 x 4 parts of one photo."""
    size = np.array([(camera.width, camera.height) for camera in rec.cameras])[rec.camera_idx][measured.frame_idx]
    x, y = np.clip(_PARTS * (measured.xy_raw + 0.5) / size, 0, _PARTS - 1).astype(np.int64).T
    return np.asarray((measured.frame_idx * _PARTS + y) * _PARTS + x)


@dataclass(frozen=True)
class ModelFit:
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
        return self.left <= MIN_FALL * float(self.errors.mean()) if len(self.errors) else True

    @property
    def is_no_lens(self) -> bool:
        """Whether a lens would have to vary more than lenses do.

        Then it makes up for something else: a camera that travels by 6 px a frame over flat ground can be a principal
        point that wanders by 13.
        """
        return self.varying and max(self.sigmas.focal, self.sigmas.centre) >= _AT_LIMIT * MOST_VARIED


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


class ModelFits:
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
        self.done: dict[str, ModelFit] = {}
        self._ended = set[str]()  # early

    def fit(
        self, model: str, varying: bool, starts: Sequence[Reconstruction], label: str | None = None, bends: int = 0,
        residual_field: bool = False, against: ModelFit | None = None,
    ) -> ModelFit:  # fmt: skip
        """Fit a model from the cheapest of some starts.

        It ends before its priors are estimated if it leaves a multiple of the held-out error of `against`: they change
        that by some hundredths, and what fits badly converges slowly.
        """
        label = label or model + BENDS[bends] + _VARYING * varying
        if label not in self.done or (against is None and label in self._ended):
            self._ended.discard(label)
            options = replace(self._rough, varying=varying, bends=bends, residual_field=residual_field)
            if against is not None and len(self.held_out):
                first = self._adjusted(label, model, starts, replace(options, prior_sigma_rounds=0))
                if float(first.errors.mean()) > _HOPELESS * float(against.errors.mean()):
                    self._ended.add(label)
                    self.done[label] = first
                    return first
                starts = [first.reconstruction]
            self.done[label] = self._adjusted(label, model, starts, options)
        return self.done[label]

    def _adjusted(self, label: str, model: str, starts: Sequence[Reconstruction], options: BundleOptions) -> ModelFit:
        """A model adjusted from the cheapest of some starts, and its held-out errors."""
        step = None if self._progress is None else partial(self._progress, label)
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
        return ModelFit(
            label, model, options.varying, options.bends, options.residual_field, found, errors, rms_px, left, sigmas,
        )  # fmt: skip

    def along_other_axis(self, fit: ModelFit, plain: ModelFit) -> ModelFit:
        """The model of a fit read along the other axis, from fits without a shutter; vibrations on the same terms.

        One that lets the lens vary is no start where it does not: without what varied, its poses fit nothing.
        """

        def read(starts: Sequence[Reconstruction], bends: int) -> ModelFit:
            label = f"{fit.model}{BENDS[bends]}{_VARYING * fit.varying}, read along the other axis"
            return self.fit(fit.model, fit.varying, starts, label, bends, against=fit)

        smooth = min(fit.bends, SMOOTH_BENDS)
        still = self.fit(plain.model, False, [self.given])
        other = read([read_along_other_axis(each.reconstruction) for each in (plain, still)], smooth)
        if fit.bends > smooth and self.shared_waves(other):
            other = read([other.reconstruction], fit.bends)
        return other

    def agreement(self, fit: ModelFit) -> float:
        """Correlation over photos, axes and lines of the rotations that two halves of the scene show, fitted alone.

        The scene is divided across the readout, so that both halves see all of it. A lens error bends them differently;
        the means over the photos are subtracted, since a lens error can cause them.
        """
        rec = fit.reconstruction
        phi, velocity = fit.sigmas.phi, fit.sigmas.velocity or None
        # motions known from elsewhere would make both halves agree
        options = replace(
            self._rough, varying=fit.varying, bends=fit.bends, phi_sigma=phi, velocity_sigma=velocity, known_phi={},
            known_bends={},
        )  # fmt: skip
        first = half_across_readout(rec)
        try:
            halves = [bundle_adjust(rec.take_points(half), fit.model, options) for half in (first, ~first)]
        except InputError:  # one without measurements
            return 0.0
        one, other = (_turns(each.reconstruction) for each in halves)
        one, other = one - one.mean(0), other - other.mean(0)
        scale = float(np.sqrt((one**2).sum() * (other**2).sum()))
        return float((one * other).sum() / scale) if scale > 0 else 0.0

    def by_known_motions(self, plain: ModelFit) -> ModelFit | None:
        """The same lens with motions as they are known from elsewhere, as by a gyroscope.

        None if none are known, or nothing is held out to judge by. No motion is fitted to the photos, and what else
        bends them knows nothing of these.
        """
        known = self._rough.known_phi
        if not known or not len(self.held_out):
            return None
        exactly = np.full(3, _HELD)
        held = {name: (np.zeros(3), exactly) for name in self.given.image_names}
        held |= {name: (np.where(np.isfinite(sigma), phi, 0.0), exactly) for name, (phi, sigma) in known.items()}
        options = replace(self._rough, varying=plain.varying, known_phi=held, still={}, held_phi={})
        return self._adjusted("known motions", "rotation", [plain.reconstruction], options)

    @property
    def known_phi(self) -> Mapping[str, tuple[ArrayLike, ArrayLike]]:
        """Motions that are known from elsewhere, and their standard deviations."""
        return self._rough.known_phi

    def without_known_motions(self, fit: ModelFit) -> ModelFit:
        """The model of a fit with the motions that the photos alone show."""
        options = replace(self._rough, varying=fit.varying, bends=fit.bends, known_phi={}, known_bends={})
        return self._adjusted("the photos alone", fit.model, [fit.reconstruction, self.given], options)

    def waves(self, fit: ModelFit, sites: int = WAVES, least_px: float = 0.0) -> bool:
        """Whether free displacements of each photo's lines would remove significantly more than a smooth warp of it.

        And by more than `least_px`, root mean square.
        """
        fall = self._fall_by_waves(fit, sites)
        return fall > MIN_FALL * float(fit.errors.mean()) and fall > (least_px / self._sigma_px) ** 2 / 2

    def shared_waves(self, fit: ModelFit) -> bool:
        """Whether the part of them that two halves of the scene share would: a vibration rotates whole lines."""
        fall, least = self._fall_by_waves(fit, WAVES), MIN_FALL * float(fit.errors.mean())
        if fall <= least:
            return False
        shared = agreement_of_waves(fit.reconstruction, self._sigma_px)
        return shared > _SHARED and shared * fall > least

    def _fall_by_waves(self, fit: ModelFit, sites: int) -> float:
        """Fall of the held-out error by splines along the readout of each photo, beyond that by a smooth warp of it."""
        if not len(self.held_out):
            return 0.0
        seen = self.given.observations
        smooth, free = (
            errors_without(functions, fit.reconstruction, seen, self.held_out, self._sigma_px).mean()
            for functions in (warps, partial(waves, sites=sites))
        )
        return float(smooth - free)

    def at_limit(self, fit: ModelFit) -> bool:
        """Whether the motions reach the limit that is known from elsewhere."""
        limits = [(fit.sigmas.phi, self._rough.phi_sigma_most)]
        if fit.model == "constant-motion":
            limits.append((fit.sigmas.velocity, self._rough.velocity_sigma_most))
        return any(most is not None and spread >= _AT_LIMIT * most for spread, most in limits)

    def gain(self, before: ModelFit, after: ModelFit) -> float:
        """Fall of the held-out error from one fit to another, in standard errors."""
        return standard_errors(before.errors - after.errors, self._group)

    def is_better(self, before: ModelFit, after: ModelFit) -> bool:
        """Whether that fall is significant in standard errors and as a share."""
        if not len(self.held_out):
            return False
        fall = float((before.errors - after.errors).mean())
        return self.gain(before, after) > _MIN_GAIN and fall > MIN_FALL * float(before.errors.mean())
