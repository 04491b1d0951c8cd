"""Remedies of a critical motion: a photo that did not move, found by evidence, or named by the user and checked."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..bundle import BundleOptions, BundleResult, Posterior, bundle_adjust, measured_lengths
from ..bundle.common_motion import MotionMeans
from ..errors import InputError
from ..model.array_types import Array
from .common import row_phi
from .cost import ShapeCost, shape_cost

__all__ = ["REMEDIES", "Remedy", "contradictions", "heal", "still_probability", "with_remedy"]

#: Remedies. `prior` is the zero-mean prior on phi, whose standard deviation is estimated.
REMEDIES = ("auto", "prior", "none")

# Remaining motion of a photo with a firmly held camera, radians per frame: a pixel or so.
_STILL = 1e-3
# Prior probability that a photo is still.
_SHARE = 0.1
# Standard deviation of phi, radians per frame, that stands for no prior.
_NONE = 10.0
# A still photo is contradicted if its stillness is less likely than this.
_UNLIKELY = 0.01
# So is one whose rotation about the held axis the others show by so many standard deviations.
_SHOWN = 5.0
# Root mean square over the frame of what grows by one from the first row to the last.
_RMS = 1.0 / np.sqrt(12.0)


@dataclass(frozen=True)
class Remedy:
    """The remedy of a critical motion, and its effect.

    Attributes
    ----------
    name : str
        "none needed" (or none possible: the covariance cannot be computed), "anchor" (a photo taken as still), "prior"
        (no photo stands out, or none was wanted), "given" (constraints, motions or lengths of the user), "path" (frames
        of a video, whose path determines how they move), or "none" (switched off).
    anchors : dict of photo name to float
        Photos taken as still, as in `BundleOptions.still`, with the standard deviation, radians per frame.
    before, after : ShapeCost
        Cost of the solutions without and with it.
    warnings : tuple of str
        Constraints that the evidence contradicts, and uncertainties of a pixel and more.
    contradictions : tuple of str
        The former alone.
    """

    name: str
    anchors: Mapping[str, float]
    before: ShapeCost
    after: ShapeCost
    warnings: tuple[str, ...] = ()
    contradictions: tuple[str, ...] = ()

    def added_to(self, options: BundleOptions) -> BundleOptions:
        """The options of an adjustment, with the photo that the remedy took as still."""
        return replace(options, still=self.anchors) if self.name == "anchor" else options

    @property
    def sentence(self) -> str:
        """For people: the remedy and its reason, and the remaining uncertainty."""
        left = self.after.sentence
        if self.name == "none needed":
            return left
        was = f"+-{100 * self.before.sigma_log_k:.1f} %"
        holds = "holds the height of the scene"
        if self.before.common.is_weak:
            was = f"+-{self.before.common.shift_px:.2g} px in the rectified photos"
            holds = "holds what the motions of all photos have in common"
        names = ", ".join([*self.anchors][:3])
        if len(self.anchors) > 3:
            names = f"{names} and {len(self.anchors) - 3} more"
        return {
            "anchor": f"{names} most likely did not move and {holds} ({was} without it); {left}",
            "prior": f"no photo is taken to be still; only the prior holds what their motions have in common; {left}",
            "given": f"with what is known of {names or 'lengths in the scene'}, {left}",
            "path": f"the path of the video determines how its frames moved; {left}",
            "none": left,
        }[self.name]


def with_remedy(options: BundleOptions, remedy: str) -> BundleOptions:
    """Options of an adjustment: without a prior on phi for "none"."""
    if remedy not in REMEDIES:
        raise InputError(f"remedy {remedy!r}, expected one of {', '.join(REMEDIES)}")
    return replace(options, phi_sigma=_NONE) if remedy == "none" else options


def _freed(result: BundleResult, options: BundleOptions | None) -> Posterior:
    """The solution's covariances if no photo is taken as still."""
    given = options or BundleOptions()
    return Posterior(result, replace(given, still={}, held_phi={}, bends=len(result.bend_sigmas)))


def still_probability(result: BundleResult, options: BundleOptions | None = None) -> Array:
    """(m,) probability that each photo did not move, from what all others leave undetermined of its motion.

    Either the photo was still (zero motion, up to 1 mrad per frame and the translation that displaces as much), as one
    in ten is, or it moved like the rest (zero mean; the robust standard deviation of phi2 and phi3, and the prior ones
    of the velocity and of the bends). Each is a prior on its motion in place of the one it was adjusted with; the
    likelier one is that under which the measurements are likelier. No other photo is taken as still, whatever the
    options say. The model of the solution has a shutter.
    """
    rec = result.reconstruction
    m = rec.num_images
    freed = _freed(result, options)
    motion, covariance = freed.motions()
    if not np.isfinite(covariance).all():
        return np.zeros(m)
    span, depth = rec.frame_span(), np.array([rec.median_depth(i) for i in range(m)])
    pair = np.abs(motion[np.arange(m)[:, None], row_phi(rec)[:, 1:]] * span[:, None])
    # not the prior's: that was estimated with phi1, which a critical motion leaves at zero
    phi = max(float(np.median(pair)) / 0.6745, 2 * _STILL)
    velocity = np.maximum(result.velocity_rms * rec.baseline, 2 * _STILL * depth)

    bends = freed.bend_sigmas
    steady = motion.shape[1] - len(bends)

    def precision(of_phi: ArrayLike, of_velocity: ArrayLike, of_bends: Array) -> Array:
        """(m, k, k) of a prior, per unit of the clock."""
        sigma = np.repeat(np.stack(np.broadcast_arrays(of_phi, of_velocity, span)[:2], axis=1), 3, axis=1)
        sigma = np.hstack([sigma[:, :steady] / span[:, None], np.broadcast_to(of_bends, (m, len(bends)))])
        return sigma[:, :, None] ** -2.0 * np.eye(motion.shape[1])

    # of the motion, all that the prior of its own photo did not say: exp(pull x - x' (inside) x / 2)
    inside = np.linalg.inv(covariance)
    mean, phi_sigma, velocity_sigma = _expected(result, freed)
    mean = np.hstack([mean[:, :steady], np.zeros((m, len(bends)))])
    of_tails = freed.relative_information
    of_tails = np.pad(of_tails, ((0, 0), (0, 2 - of_tails.shape[1])), constant_values=1.0) ** -0.5
    own = precision(phi_sigma * of_tails[:, 0], np.maximum(velocity_sigma * of_tails[:, 1], 1e-300), bends)
    pull = np.einsum("mij,mj->mi", inside, motion) - np.einsum("mij,mj->mi", own, mean)
    value, vector = np.linalg.eigh(inside - own)  # nothing where nothing else is known
    inside = np.einsum("mij,mj,mkj->mik", vector, np.maximum(value, 0.0), vector)

    def evidence(prior: Array) -> Array:
        """(m,) log likelihoods of a prior, up to a constant."""
        total = inside + prior
        gain = np.einsum("mi,mi->m", pull, np.linalg.solve(total, pull[..., None])[..., 0])
        return 0.5 * (np.linalg.slogdet(prior)[1] - np.linalg.slogdet(total)[1] + gain)

    # a camera that is held more firmly trembles less, too
    odds = np.log(_SHARE / (1 - _SHARE)) + evidence(precision(_STILL, _STILL * depth, bends * (_STILL / phi)))
    odds -= evidence(precision(phi, velocity, bends))
    return 1.0 / (1.0 + np.exp(-np.clip(odds, -500, 500)))


def _expected(result: BundleResult, freed: Posterior) -> tuple[Array, Array, Array]:
    """Motions (m, 6) of photos by their prior, and its standard deviations (m,) of phi and velocity, per frame."""
    rec, common = result.reconstruction, result.common
    own = np.array([result.phi_sigma, result.velocity_sigma * rec.baseline])
    if common is None:
        return np.zeros((rec.num_images, 6)), *np.repeat(own[:, None], rec.num_images, axis=1)
    per_unit = np.repeat([1.0, rec.baseline], [3, 5])
    # of a camera with few photos, and of a photo with a limit of its own, the motion is its own
    of = MotionMeans.of(rec, common.prior.scaled(rec.baseline), freed.shares)
    means = of.at(of.unknowns(per_unit * common.values))
    of_means = (per_unit[:6] * common.deviations) ** 2 * freed.shares
    of_means = of_means.reshape(-1, 2, 3).mean(axis=2)
    return means, *np.sqrt(own**2 + of_means).T


def contradictions(result: BundleResult, options: BundleOptions, names: Collection[str]) -> tuple[str, ...]:
    """Warnings on photos that were specified as still, if the measurements show that they moved."""
    if not names:
        return ()
    rec = result.reconstruction
    probability = still_probability(result, options)
    motion, covariance = _freed(result, options).motions()
    span = rec.frame_span()
    components = row_phi(rec)
    found = []
    for name in names:
        i = rec.image_names.index(name)
        phi1 = components[i, 0]
        # what is held tells as well, where the other photos determine it
        shows = bool(abs(motion[i, phi1]) > _SHOWN * np.sqrt(covariance[i, phi1, phi1]))
        if shows or probability[i] < _UNLIKELY:
            rotation = np.degrees(np.linalg.norm(motion[i, components[i, 0 if shows else 1 :]]) * span[i])
            found.append(
                f"{name} was specified as still, but it rotated by {rotation:.2f} degrees "
                f"{'' if shows else 'about its other axes '}during the readout; the scene's height is only as right as "
                "that"
            )
    return tuple(found)


def heal(result: BundleResult, options: BundleOptions, remedy: str = "auto") -> tuple[BundleResult, Remedy]:
    """Measure the uncertainty of a solution's shape, and apply a remedy if it is large.

    Parameters
    ----------
    result : BundleResult
        Of a model with a shutter, adjusted with `options`.
    options : BundleOptions
        Its constraints and known motions are the user's: nothing is added to them.
    remedy : {"auto", "prior", "none"}
        "auto": nothing if the poses are not critical, or the height of the scene is known to 0.05 % nevertheless, and
        rotation is distinguished from translation to half a pixel; else the photo that most likely did not move gets a
        soft constraint, with the standard deviation that the evidence supports, beside the prior. "prior" leaves it at
        the prior, "none" at what the solution was.

    Returns
    -------
    BundleResult, Remedy
        The solution, adjusted again if a constraint was added.
    """
    if remedy not in REMEDIES:
        raise InputError(f"remedy {remedy!r}, expected one of {', '.join(REMEDIES)}")
    before = shape_cost(result, options)
    if options.path is not None:
        return result, Remedy("path", {}, before, before)
    still = {name: 0.0 for name, held in options.held_phi.items() if held} | dict(options.still)
    given = still | {name: float(np.min(sigma)) for name, (_, sigma) in options.known_phi.items()}
    if given or measured_lengths(result.reconstruction, options.lengths)[0]:
        said = contradictions(result, options, still)
        return result, Remedy("given", given, before, before, said + _warnings(before), said)
    if remedy == "none":
        return result, Remedy("none", {}, before, before, _warnings(before))
    if not (before.is_flagged or before.common.is_weak) or not np.isfinite(before.sigma_log_k):
        return result, Remedy("none needed", {}, before, before)
    probability = still_probability(result, options)
    best = int(np.argmax(probability))
    if remedy == "prior" or probability[best] < 0.5:
        return result, Remedy("prior", {}, before, before, _warnings(before))
    sigma = _anchor_sigma(result, best, float(probability[best]))
    name = result.reconstruction.image_names[best]
    anchored = replace(options, still={name: sigma})
    healed = _again(result, anchored)
    after = shape_cost(healed, anchored)
    return healed, Remedy("anchor", {name: sigma}, before, after, _warnings(after))


def _anchor_sigma(result: BundleResult, image: int, probability: float) -> float:
    """Standard deviation, radians per frame, of a constraint with the weight of a photo's probable stillness.

    The estimate should be the mean of both cases, p times that of a still photo and 1 - p times the given one. A
    constraint of variance s on a value known to a variance C draws it by C / (C + s), and by p C / (C + still) if s is
    still / p + C (1 - p) / p. Where only phi1 is open, the photo is as still about that axis as about the other two.
    """
    rec = result.reconstruction
    variance = np.diagonal(result.covariances[image])[6:] * rec.frame_span()[image] ** 2
    still, p = _STILL**2, probability
    if len(variance) > 3:
        variance = np.concatenate([variance[:3], variance[3:] / rec.median_depth(image) ** 2])
    else:
        phi1, *others = row_phi(rec)[image]
        square = (rec.phi[image] * rec.frame_span()[image]) ** 2 + variance
        still, variance = max(still, float(square[others].mean())), variance[[phi1]]
    return float(np.sqrt((still + (1 - p) * float(variance.mean())) / p))


def _again(result: BundleResult, options: BundleOptions) -> BundleResult:
    """The adjustment once more from its result, with the same measurements."""
    rec = result.reconstruction
    again = replace(
        options, outlier_rounds=0, sigma_px=result.sigma_px, bend_sigma_start=result.bend_sigmas or 1e-3,
        phi_sigma_start=result.phi_rms, velocity_sigma_start=result.velocity_rms or options.velocity_sigma_start,
    )  # fmt: skip
    return replace(bundle_adjust(rec, rec.shutter_model, again), num_outliers=result.num_outliers)


def _warnings(cost: ShapeCost) -> tuple[str, ...]:
    """Warning of a common motion that displaces the rectified photos by a pixel over the frame."""
    if not (cost.common.is_weak and cost.common.shift_px > _RMS):
        return ()
    return (f"{cost.common.sentence}; a photo that is known not to have moved (--still) would resolve it",)
