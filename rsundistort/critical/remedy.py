"""What heals a critical motion: a photo that did not move, found by evidence, or named by the user and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..bundle import BundleOptions, BundleResult, bundle_adjust
from ..errors import InputError
from .cost import ShapeCost, row_phi, shape_cost

__all__ = ["REMEDIES", "Remedy", "contradictions", "heal", "still_probability", "with_remedy"]

#: What can be done about a critical motion. `prior` is the zero-mean prior on phi, whose spread is estimated.
REMEDIES = ("auto", "prior", "none")

# What is left of the motion of a photo that was taken firmly, radians per frame: a pixel or so.
_STILL = 1e-3
# Share of photos that are still, before anything is known of them.
_SHARE = 0.1
# Standard deviation of phi, radians per frame, that stands for no prior.
_NONE = 10.0
# A photo whose phi2 and phi3 make stillness less likely than this contradicts who says that it was still.
_UNLIKELY = 0.01


@dataclass(frozen=True)
class Remedy:
    """What was done about a critical motion, and what it left.

    Attributes
    ----------
    name : str
        "none needed" (or none possible: the covariance cannot be computed), "anchor" (a photo taken to be still),
        "prior" (no photo stands out, or none was asked for), "given" (anchors, motions or lengths that the user knows),
        or "none" (switched off).
    anchors : dict of photo name to float
        Photos whose phi1 is taken to be zero, with the standard deviation, radians per frame; 0 is hard.
    before, after : ShapeCost
        Of the solutions without and with it.
    warnings : tuple of str
        Anchors that the evidence contradicts.
    """

    name: str
    anchors: Mapping[str, float]
    before: ShapeCost
    after: ShapeCost
    warnings: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """For people: what was done and why, and the uncertainty left."""
        left = self.after.sentence
        if self.name == "none needed":
            return left
        was = f"+-{100 * self.before.sigma_log_k:.1f} %"
        names = ", ".join([*self.anchors][:3])
        if len(self.anchors) > 3:
            names = f"{names} and {len(self.anchors) - 3} more"
        return {
            "anchor": f"{names} most likely did not move and holds the height of the scene ({was} without it); {left}",
            "prior": f"no photo is taken to be still, the motions to be zero in the mean; {left}",
            "given": f"with what is known of {names or 'lengths in the scene'}, {left}",
            "none": left,
        }[self.name]


def with_remedy(options: BundleOptions, remedy: str) -> BundleOptions:
    """Options of an adjustment: without a prior on phi for "none"."""
    if remedy not in REMEDIES:
        raise InputError(f"remedy {remedy!r}, expected one of {', '.join(REMEDIES)}")
    return replace(options, phi_sigma=_NONE) if remedy == "none" else options


def _log_normal(x: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m,) log densities, up to a constant, of x (m, 2) with zero mean and covariances (m, 2, 2)."""
    _, logdet = np.linalg.slogdet(covariance)
    mahalanobis = np.einsum("mi,mi->m", x, np.linalg.solve(covariance, x[..., None])[..., 0])
    value: NDArray[np.float64] = -0.5 * (mahalanobis + logdet)
    return value


def still_probability(result: BundleResult) -> NDArray[np.float64]:
    """(m,) probability that each photo did not move, from its phi2 and phi3.

    Those two are determined where phi1 is not. Either the photo was still (they are zero but for 1 mrad per frame), as
    one in ten is, or it moved like the rest (zero mean, their robust spread).
    """
    rec = result.reconstruction
    span = rec.frame_span()
    components = row_phi(rec)
    rows = np.arange(rec.num_images)[:, None]
    pair = components[:, 1:]
    found = rec.phi[rows, pair] * span[:, None]
    covariance = result.covariances[rows[:, :, None], 6 + pair[:, :, None], 6 + pair[:, None, :]]
    covariance = covariance * span[:, None, None] ** 2
    # not the prior's: that was estimated with phi1, which a critical motion leaves at zero
    spread = max(float(np.median(np.abs(found))) / 0.6745, 2 * _STILL)
    still = _log_normal(found, covariance + _STILL**2 * np.eye(2))
    moved = _log_normal(found, covariance + spread**2 * np.eye(2))
    odds = _SHARE / (1 - _SHARE) * np.exp(np.clip(still - moved, -500, 500))
    probability: NDArray[np.float64] = odds / (1 + odds)
    return probability


def contradictions(result: BundleResult, names: Mapping[str, float]) -> tuple[str, ...]:
    """Warnings on photos said to be still whose phi2 and phi3 say that they moved."""
    rec = result.reconstruction
    probability = still_probability(result)
    span = rec.frame_span()
    components = row_phi(rec)
    found = []
    for name in names:
        i = rec.image_names.index(name)
        if probability[i] < _UNLIKELY:
            turn = np.degrees(np.linalg.norm(rec.phi[i, components[i, 1:]]) * span[i])
            found.append(
                f"{name} is said to have been still, but it turned by {turn:.2f} degrees about its other axes "
                "during the readout; the scene's height is only as right as that"
            )
    return tuple(found)


def heal(result: BundleResult, options: BundleOptions, remedy: str = "auto") -> tuple[BundleResult, Remedy]:
    """Find out what a solution's shape is worth, and mend it where it is in doubt.

    Parameters
    ----------
    result : BundleResult
        Of a model with a shutter, adjusted with `options`.
    options : BundleOptions
        Its anchors and known motions are the user's: nothing is added to them.
    remedy : {"auto", "prior", "none"}
        "auto": nothing where the poses are not critical, or the height of the scene is known to 0.05 % all the same;
        else the photo that most likely did not move becomes a soft anchor, with the standard deviation that the
        evidence supports, beside the prior. "prior" leaves it at the prior, "none" at what the solution was.

    Returns
    -------
    BundleResult, Remedy
        The solution, adjusted again if an anchor was added.
    """
    if remedy not in REMEDIES:
        raise InputError(f"remedy {remedy!r}, expected one of {', '.join(REMEDIES)}")
    before = shape_cost(result, options)
    given = {name: 0.0 for name, held in options.held_phi.items() if held}
    given |= {name: float(np.min(sigma)) for name, (_, sigma) in options.known_phi.items()}
    if given or options.lengths:
        still = {
            name: sigma
            for name, sigma in given.items()
            if name not in options.known_phi or not np.any(options.known_phi[name][0])
        }
        return result, Remedy("given", given, before, before, contradictions(result, still))
    if remedy == "none":
        return result, Remedy("none", {}, before, before)
    if not before.is_flagged or not np.isfinite(before.sigma_log_k):
        return result, Remedy("none needed", {}, before, before)
    probability = still_probability(result)
    best = int(np.argmax(probability))
    if remedy == "prior" or probability[best] < 0.5:
        return result, Remedy("prior", {}, before, before)
    rec = result.reconstruction
    p = float(probability[best])
    # moments of the mixture: still, or moved like the rest
    sigma = float(np.sqrt(p * _STILL**2 + (1 - p) * result.phi_sigma**2))
    components = row_phi(rec)
    sigmas = np.full(3, np.inf)
    sigmas[components[best, 0]] = sigma
    name = rec.image_names[best]
    anchored = replace(options, known_phi={name: (np.zeros(3), sigmas)})
    again = replace(
        anchored, outlier_rounds=0, loss="squared", sigma_px=result.sigma_px, phi_sigma_start=result.phi_sigma
    )  # fmt: skip
    healed = bundle_adjust(rec, rec.shutter_model, again)
    healed = replace(healed, num_outliers=result.num_outliers)
    return healed, Remedy("anchor", {name: sigma}, before, shape_cost(healed, anchored))
