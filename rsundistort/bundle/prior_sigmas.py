"""Prior standard deviations of the unknowns of each photo, estimated from the photos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array
from .bundle_options import BundleOptions
from .common_motion import MeansPrior, prior_of_means
from .layout import Layout
from .motion_prior import SIGMA_OF_SCALE, tail_weight
from .path_prior import PathPrior

__all__ = [
    "MOST_VARIED",
    "Common",
    "PriorSigmas",
    "estimated",
    "estimates_sigmas",
    "field_prior_sigma",
    "has_means",
    "path_prior_sigmas",
    "settled",
    "starting_sigmas",
]

# Radians per frame: a hundredth of a pixel at any focal length in use. Keeps the prior's weight finite.
_MIN_SIGMA = 1e-6
# Prior standard deviations below this (radians, focal lengths) need not converge: a tenth of a pixel.
_SETTLED_AT = 2e-5
# The same of the fields, which are in pixels.
_MIN_SIGMA_PX, _SETTLED_PX = 1e-4, 1e-3
# Prior standard deviations of means have converged if they change by less than this share: they hardly weigh.
_SETTLED_MEANS = 0.2
# A velocity in common by what photos have of their own, at first: drones and people on their way travel alike, but for
# a part of their speed. (Were the mean drawn to zero as a sample of what varies, that of an orbit would be lost, and
# its rotation with it.)
_MUCH = 3.0
# A motion that is less likely is not taken from the mean over sharing it and none: what a solve leaves of steps would
# count many times.
_LEAST_LIKELY = 0.1
# Of the way between two photos, in a frame: half a second or more from photo to photo, a frame in a hundredth or less.
_STEADY = 0.02
# A lens that its model says so badly needs another model.
_MOST_PX = 1.0

# No lens varies more than this from photo to photo (of f, and of the principal point in focal lengths). A strong
# shutter would be taken for it.
MOST_VARIED = 0.02
# A video may zoom, and what its path leaves of a shutter is not taken for that.
_MOST_ZOOMED = 0.5
# Of a path's rates from frame to frame: radians, and shares of the mean way between consecutive photos.
_ROTATION_START, _TRAVEL_START = 5e-3, 0.2
# Residuals of a path that count as if these had been seen before.
_USUAL_WEIGHT = 2.0
# Ratio of a prior standard deviation to that of the solve before, or the other way round.
_LARGEST_CHANGE = 4.0


@dataclass(frozen=True)
class PriorSigmas:
    """Standard deviations of the priors on what each photo has of its own, and on what photos have in common.

    Attributes
    ----------
    phi : float
        Radians per frame.
    velocity : float
        World units per frame.
    focal : float
        Of the variation of log f.
    centre : float
        Of the variation of the principal point, focal lengths.
    bends, ways : tuple of float
        Of the groups of bends: of the rotation, radians, and of the position, world units.
    field : float
        Of the unknowns of the cameras' residual fields, pixels.
    path : tuple of float
        Of a path, if there is one: rotation and travel, as `PathPrior` takes them.
    means : MeansPrior or None
        Of the means of a camera's motions, if there are any.
    """

    phi: float
    velocity: float
    focal: float = 1.0
    centre: float = 1.0
    bends: tuple[float, ...] = ()
    ways: tuple[float, ...] = ()
    field: float = 1.0
    path: tuple[float, ...] = ()
    means: MeansPrior | None = None


def _prior_sigma(values: Array, variance: Array, sigma: float) -> float:
    """Prior standard deviation of unknowns (m, k) with posterior variances (m, k).

    It is estimated over photos and axes; `sigma` is that under which they were found. Values beyond three robust
    standard deviations count as three: a few photos that moved far more, or that few measurements connect, must not
    widen the prior of the rest. Fixed values are left out.
    """
    free = variance > 0
    if not free.any():
        return 0.0
    square, unknown = values[free] ** 2, float(variance[free].mean())
    robust = float(np.median(square + variance[free])) / 0.455  # median of the square of a normal variable
    seen = float(np.minimum(square, 9.0 * robust).mean())
    return _fixed_point(seen, unknown, sigma)


def _scale(values: Array, variance: Array, sigma: float) -> float:
    """Scale of the prior with heavy tails of motions (m, 3) with posterior variances (m, 3), per frame.

    As `_prior_sigma`, which weighs all photos the same.
    """
    free = variance > 0
    if not free.any():
        return 0.0
    weight = tail_weight(np.where(free, values**2 + variance, 0.0).sum(1) / sigma**2, free.sum(1))[:, None]
    seen, unknown = (float(np.broadcast_to(weight * each, free.shape)[free].mean()) for each in (values**2, variance))
    return _fixed_point(seen, unknown, sigma)


def _fixed_point(seen: float, unknown: float, sigma: float) -> float:
    """MacKay's of sigma^2 = mean square seen + mean variance: a few rounds where that equation takes dozens."""
    # the share of the unknowns that the measurements, not the prior, decide
    known = max(1.0 - unknown / sigma**2, 1e-3)
    return float(np.clip(np.sqrt(seen / known), sigma / _LARGEST_CHANGE, sigma * _LARGEST_CHANGE))


class Common(NamedTuple):
    """Means of the motions of photos (m, 6), their variances, and their covariances with the motions.

    In the frames of the cameras, radians and world units per frame, as are the motions; 0 where a motion has none. And
    of the cameras the unknowns behind them (cameras, 8), their covariances (cameras, 8, 8), and `MotionMeans.root`.
    """

    values: Array
    variances: Array
    with_motions: Array
    unknowns: Array
    covariances: Array
    root: Array


def estimated(
    sigmas: PriorSigmas, current: Reconstruction, covariances: Array, options: BundleOptions,
    layout: Layout, baseline: float, common: Common | None = None,
) -> PriorSigmas:  # fmt: skip
    """Estimates of the prior standard deviations from a solution; given ones stay."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    if not np.isfinite(variances).all():
        return sigmas
    own, own_variances = _own_motions(current, covariances[:, 6 : layout.motion, 6 : layout.motion], common)
    limited = [options.phi_limits.get(name, np.inf) < sigmas.phi for name in current.image_names]
    own_variances = np.where(np.array(limited)[:, None], 0.0, own_variances)
    found = sigmas
    if options.phi_sigma is None and own.shape[1] > 0:
        found = replace(found, phi=_scale(own[:, :3], own_variances[:, :3], sigmas.phi) + _MIN_SIGMA)
    if options.velocity_sigma is None and own.shape[1] > 3:
        velocity = _scale(own[:, 3:], own_variances[:, 3:], sigmas.velocity) + _MIN_SIGMA * current.baseline
        found = replace(found, velocity=velocity)
    if common is not None:
        assert sigmas.means is not None
        freedom = _freedom(own, own_variances, common, sigmas)
        found = replace(found, means=_means_prior(common, sigmas.means, found.velocity, current, freedom))
    if options.varying:
        varied = current.variation
        of_varied = variances[:, layout.motion : layout.variation]
        focal = _prior_sigma(varied[:, :1], of_varied[:, :1], sigmas.focal)
        found = replace(found, focal=focal + _MIN_SIGMA)
        if layout.num_varying > 1:
            centre = _prior_sigma(varied[:, 1:], of_varied[:, 1:], sigmas.centre)
            found = replace(found, centre=centre + _MIN_SIGMA)
    bends, ways = _bend_sigmas(sigmas, current, variances[:, layout.variation :], layout)
    return _bounded(replace(found, bends=bends, ways=ways), options, baseline)


def _freedom(own: Array, variances: Array, common: Common, sigmas: PriorSigmas) -> float:
    """How many of the motions (m, 6) that share a mean the measurements would decide, if they shared none."""
    known = 0.0
    for part, sigma in ((slice(3), sigmas.phi), (slice(3, 6), sigmas.velocity)):
        shares = (common.variances[:, part] > 0) & (variances[:, part] > 0)
        if shares.any():
            x, mean, variance = (each[:, part][shares] for each in (own, common.values, variances))
            of_noise = 1.0 / np.maximum(1.0 / variance - 1.0 / sigma**2, 1e-9 / sigma**2)
            alone = float(((x + mean) ** 2 + variance).mean())
            known += float((alone / (alone + of_noise)).sum())
    return known


def _means_prior(
    common: Common, before: MeansPrior, velocity_sigma: float, current: Reconstruction, freedom: float
) -> MeansPrior:
    """Prior on means that were found under the one before.

    A velocity in common is expected to be a few times what the photos have of their own, or as large as it is found, or
    that of a camera that does not stop.
    """
    velocity, depth = _MUCH * SIGMA_OF_SCALE * velocity_sigma, current.typical_depth
    velocity = max(velocity, _STEADY * current.baseline)
    sharing = np.flatnonzero(common.variances.any(1))
    if not len(sharing):
        return MeansPrior.of_ways(velocity, depth)
    # if they share one: what was found is the mean over both
    likely = max(before.probability, _LEAST_LIKELY) if before.probability else 1.0
    found = ((common.values / likely) ** 2 + common.variances / likely)[sharing, 3:]
    velocity = max(velocity, float(np.sqrt(found.mean())))
    cameras = np.unique(current.camera_idx[sharing])
    return prior_of_means(common.unknowns[cameras], common.covariances[cameras], common.root, velocity, depth, freedom)


def _own_motions(current: Reconstruction, covariances: Array, common: Common | None) -> tuple[Array, Array]:
    """What each photo's motion has of its own (m, k), in the camera's frame and per frame, and its variances.

    Variances are 0 where a motion is held.
    """
    span = current.frame_span()[:, None]
    k = covariances.shape[1]
    held = np.diagonal(covariances, axis1=1, axis2=2) <= 0
    to_camera = np.zeros((len(span), 6, 6))
    to_camera[:, :3, :3], to_camera[:, 3:, 3:] = np.eye(3), current.R_cw
    to_camera = to_camera[:, :k, :k]
    own = span * np.einsum("mab,mb->ma", to_camera, np.hstack([current.phi, current.velocity])[:, :k])
    variances = span**2 * np.einsum("mab,mbc,mac->ma", to_camera, covariances, to_camera)
    if common is not None:
        own = own - common.values
        variances = variances + common.variances - 2.0 * common.with_motions
    # a photo whose velocity is held in part has none of its own to learn from
    held[:, 3:] = held[:, 3:].any(1, keepdims=True)
    return own, np.where(held, 0.0, np.maximum(variances, 1e-300))


def _bend_sigmas(
    sigmas: PriorSigmas, current: Reconstruction, variances: Array, layout: Layout
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Prior standard deviations of the groups of bends, of rotations and of positions."""
    found = layout.coefficients(current)
    rotations = 3 * len(layout.group)

    def of(group: int, part: slice, sigma: float, least: float) -> float:
        mine = np.flatnonzero(np.repeat(np.array(layout.group[: (part.stop - part.start) // 3]) == group, 3))
        return _prior_sigma(found[:, part][:, mine], variances[:, part][:, mine], sigma) + least

    own, ways = slice(0, rotations), slice(rotations, rotations + 3 * layout.ways)
    return (
        tuple(of(k, own, sigma, _MIN_SIGMA) for k, sigma in enumerate(sigmas.bends)),
        tuple(of(k, ways, sigma, _MIN_SIGMA * current.baseline) for k, sigma in enumerate(sigmas.ways)),
    )


def estimates_sigmas(shutter_model: str, options: BundleOptions) -> bool:
    """Whether a prior standard deviation is estimated."""
    of_phi = shutter_model != "global" and options.phi_sigma is None
    of_way = shutter_model == "constant-motion" and options.velocity_sigma is None
    return (
        of_phi or of_way or options.path is not None or options.varying or options.bends > 0 or options.residual_field
    )


def settled(before: PriorSigmas, after: PriorSigmas, tolerance: float) -> bool:
    """Whether no prior standard deviation changed by more than a share; negligible ones may keep falling.

    On a path, phi and velocity have none of their own.
    """
    phi, velocity = (np.inf, np.inf) if before.path else (_SETTLED_AT, 0.0)
    negligible = {
        "phi": phi, "velocity": velocity, "focal": _SETTLED_AT, "centre": _SETTLED_AT, "bends": _SETTLED_AT,
        "ways": 0.0, "field": _SETTLED_PX, "path": 0.0,
    }  # fmt: skip
    if before.means is not None and after.means is not None and after.means.differs(before.means, _SETTLED_MEANS):
        return False
    for name, least in negligible.items():
        old, new = np.array([getattr(before, name), getattr(after, name)])
        if not ((np.abs(new - old) <= tolerance * new) | (np.maximum(old, new) < least)).all():
            return False
    return True


def starting_sigmas(options: BundleOptions, layout: Layout, reconstruction: Reconstruction) -> PriorSigmas:
    """Standard deviations that are given, or at which the estimation begins."""
    baseline = reconstruction.baseline
    start = PriorSigmas(
        options.phi_sigma or options.phi_sigma_start,
        (options.velocity_sigma or options.velocity_sigma_start) * baseline,
        options.focal_sigma_start,
        options.centre_sigma_start,
        tuple(np.broadcast_to(options.bend_sigma_start, len(set(layout.group))).tolist()),
        (options.way_sigma_start * baseline,) * len(set(layout.group[: layout.ways])),
        options.field_sigma_start,
        () if options.path is None else (_ROTATION_START, _TRAVEL_START * baseline),
    )
    if has_means(layout, options):
        start = replace(start, means=MeansPrior.of_ways(_MUCH * start.velocity, reconstruction.typical_depth))
    return _bounded(start, options, baseline)


def has_means(layout: Layout, options: BundleOptions) -> bool:
    """Whether motions have means that are solved for.

    That takes velocities, of a prior that is estimated and that no exposure bounds: a common one is bounded with them.
    """
    estimates = options.velocity_sigma is None and options.velocity_sigma_most is None
    return layout.motion > 9 and estimates and options.path is None


def _bounded(sigmas: PriorSigmas, options: BundleOptions, baseline: float) -> PriorSigmas:
    """The prior standard deviations within their upper limits."""
    phi = np.inf if options.phi_sigma_most is None else options.phi_sigma_most
    velocity = np.inf if options.velocity_sigma_most is None else options.velocity_sigma_most * baseline
    focal = MOST_VARIED if options.path is None else _MOST_ZOOMED
    return replace(
        sigmas, phi=min(sigmas.phi, phi), velocity=min(sigmas.velocity, velocity), focal=min(sigmas.focal, focal),
        centre=min(sigmas.centre, MOST_VARIED), bends=tuple(min(each, phi) for each in sigmas.bends),
        field=min(sigmas.field, _MOST_PX),
    )  # fmt: skip


def field_prior_sigma(values: Array, variances: Array, sigma: float) -> float:
    """Prior standard deviation in pixels of the unknowns (k, n) of residual fields, as `_prior_sigma`."""
    found = _prior_sigma(values, variances, sigma)
    return min(found + _MIN_SIGMA_PX, _MOST_PX)


def path_prior_sigmas(prior: PathPrior, residuals: Array, variances: Array, baseline: float) -> tuple[float, ...]:
    """Prior standard deviations of a path by its residuals (q, 18) and their posterior variances, as `_prior_sigma`.

    With few frames, which hardly determine them, they are drawn to those of a hand.
    """
    squares, unknown = (prior.unit_squares(each) for each in (residuals**2, variances))
    found = []
    usual = _ROTATION_START, _TRAVEL_START * baseline
    for square, variance, sigma, start in zip(squares, unknown, prior.sigmas, usual, strict=True):
        seen = _prior_sigma(np.sqrt(square), variance, sigma) ** 2
        found.append(float(np.sqrt((square.size * seen + _USUAL_WEIGHT * start**2) / (square.size + _USUAL_WEIGHT))))
    return tuple(found)
