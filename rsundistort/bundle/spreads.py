"""Prior standard deviations of the unknowns of each photo, estimated from the photos."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..model import Reconstruction
from .layout import Layout
from .options import BundleOptions
from .path import PathPrior

__all__ = [
    "Spreads",
    "common_velocity",
    "estimated",
    "estimates_spreads",
    "field_spread",
    "path_spreads",
    "settled",
    "starting_spreads",
]

# Radians per frame: a hundredth of a pixel at any focal length in use. Keeps the prior's weight finite.
_MIN_SPREAD = 1e-6
# Prior standard deviations below this (radians, focal lengths) need not converge: a tenth of a pixel.
_SETTLED_AT = 2e-5
# The same of the fields, which are in pixels.
_MIN_SPREAD_PX, _SETTLED_PX = 1e-4, 1e-3
# A mean velocity has converged if it changes by less than this share of the standard deviation about it.
_SETTLED_TRAVEL = 0.05
# A mean velocity counts beyond so many standard errors.
_SIGNIFICANT = 2.0
# A lens that its model says so badly needs another model.
_MOST_PX = 1.0

# No lens varies more than this from photo to photo (of f, and of the principal point in focal lengths). A strong
# shutter would be taken for it.
_MOST_VARIED = 0.02
# Of a path's rates from frame to frame: radians, and shares of the mean way between consecutive photos.
_TURN_START, _TRAVEL_START = 5e-3, 0.2
# Residuals of a path that count as if these had been seen before.
_USUAL_WEIGHT = 2.0
# Ratio of a prior standard deviation to that of the solve before, or the other way round.
_LARGEST_CHANGE = 4.0


@dataclass(frozen=True)
class Spreads:
    """Standard deviations of the priors on what each photo has of its own, and the mean of one of them.

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
    travel : tuple of float
        Mean of the prior on the velocity, in the frame of each camera, world units per frame. All others are zero: a
        drone flies on, but its rotations have no direction.
    """

    phi: float
    velocity: float
    focal: float = 1.0
    centre: float = 1.0
    bends: tuple[float, ...] = ()
    ways: tuple[float, ...] = ()
    field: float = 1.0
    path: tuple[float, ...] = ()
    travel: tuple[float, ...] = (0.0, 0.0, 0.0)


def _spread(
    values: NDArray[np.float64], variance: NDArray[np.float64], span: NDArray[np.float64], spread: float
) -> float:
    """Prior standard deviation, per frame, of unknowns (m, 3) per unit of the clock with posterior variances (m, 3).

    It is estimated over photos and axes; `spread` is that under which they were found. Values beyond three robust
    standard deviations count as three: a few photos that moved far more, or that few measurements connect, must not
    widen the prior of the rest. Fixed values are left out.
    """
    free = variance > 0
    if not free.any():
        return 0.0
    scale = np.broadcast_to(span[:, None] ** 2, values.shape)[free]
    square, unknown = values[free] ** 2 * scale, float((variance[free] * scale).mean())
    robust = float(np.median(square + variance[free] * scale)) / 0.455  # median of the square of a normal variable
    seen = float(np.minimum(square, 9.0 * robust).mean())
    # MacKay's fixed point of sigma^2 = mean(phi^2 + variance): a few rounds where that takes dozens. `known` is the
    # share of the unknowns that the measurements, not the prior, decide
    known = max(1.0 - unknown / spread**2, 1e-3)
    return float(np.clip(np.sqrt(seen / known), spread / _LARGEST_CHANGE, spread * _LARGEST_CHANGE))


def estimated(
    spreads: Spreads, current: Reconstruction, covariances: NDArray[np.float64], options: BundleOptions,
    layout: Layout, baseline: float,
) -> Spreads:  # fmt: skip
    """Estimates of both prior standard deviations from a solution; given ones stay."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    if not np.isfinite(variances).all():
        return spreads
    span = current.frame_span()
    motion = variances[:, 6 : layout.motion]
    limited = [options.phi_limits.get(name, np.inf) < spreads.phi for name in current.image_names]
    motion = np.where(np.array(limited)[:, None], 0.0, motion)
    phi, velocity, focal, centre = spreads.phi, spreads.velocity, spreads.focal, spreads.centre
    travel = np.zeros(3)
    if options.phi_sigma is None and motion.shape[1] > 0:
        phi = _spread(current.phi, motion[:, :3], span, spreads.phi) + _MIN_SPREAD
    if options.velocity_sigma is None and motion.shape[1] > 3:
        own, variance = _in_cameras(current, np.where(motion[:, 3:, None] > 0, covariances[:, 9:12, 9:12], 0.0))
        travel = _travel(own * span[:, None], variance, np.array(spreads.travel), options)
        velocity = _spread(own - travel / span[:, None], variance, span, spreads.velocity)
        velocity += _MIN_SPREAD * current.baseline
    if options.varying:
        ones, varied = np.ones(len(span)), current.variation
        of_varied = variances[:, layout.motion : layout.variation]
        focal = _spread(varied[:, :1], of_varied[:, :1], ones, spreads.focal) + _MIN_SPREAD
        centre = _spread(varied[:, 1:], of_varied[:, 1:], ones, spreads.centre) + _MIN_SPREAD
    bends, ways = _bend_spreads(spreads, current, variances[:, layout.variation :], layout)
    return _bounded(
        Spreads(phi, velocity, focal, centre, bends, ways, spreads.field, spreads.path, (*travel.tolist(),)),
        options,
        baseline,
    )


def _in_cameras(
    current: Reconstruction, covariances: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Velocities (m, 3) in the frames of the cameras, and their variances."""
    R = current.R_cw
    return np.einsum("mij,mj->mi", R, current.velocity), np.einsum("mij,mjk,mik->mi", R, covariances, R)


def common_velocity(reconstruction: Reconstruction, travel: ArrayLike) -> NDArray[np.float64]:
    """Velocities (m, 3), world units per unit of the clock, of photos that all travel by `travel` (`Spreads`)."""
    world = np.einsum("mji,j->mi", reconstruction.R_cw, np.asarray(travel, float))
    return np.asarray(world / reconstruction.frame_span()[:, None])


def _travel(
    velocity: NDArray[np.float64], variance: NDArray[np.float64], before: NDArray[np.float64], options: BundleOptions
) -> NDArray[np.float64]:
    """Mean velocity (3,) of the photos in the frames of their cameras, per frame, as far as it is not by chance.

    A component within two standard errors of zero is none, and others are shrunk by James and Stein's estimator. (A
    mean once free is drawn no longer: one by chance would grow along what the measurements hardly determine.) The
    velocities were found under the mean `before`, which drew them, so that a round leaves a share of the error, 0 to 1:
    the step from it is doubled, which leaves 2 share - 1. Zero where the exposure bounds the motions: a common one is
    bounded with them.
    """
    free = velocity[(variance > 0).all(1)]
    if options.velocity_sigma_most is not None or len(free) < 3:
        return np.zeros(3)
    mean, chance = free.mean(0), free.var(axis=0, ddof=1) / len(free)
    shrunk = mean * (1.0 - chance / np.maximum(mean**2, 1e-300))
    return np.where(mean**2 > _SIGNIFICANT**2 * chance, 2.0 * shrunk - before, 0.0)


def _bend_spreads(
    spreads: Spreads, current: Reconstruction, variances: NDArray[np.float64], layout: Layout
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Prior standard deviations of the groups of bends, of rotations and of positions."""
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


def estimates_spreads(shutter_model: str, options: BundleOptions) -> bool:
    """Whether a prior standard deviation is estimated."""
    of_turn = shutter_model != "global" and options.phi_sigma is None
    of_way = shutter_model == "constant-motion" and options.velocity_sigma is None
    return (
        of_turn or of_way or options.path is not None or options.varying or options.bends > 0 or options.residual_field
    )


def settled(before: Spreads, after: Spreads, tolerance: float) -> bool:
    """Whether no prior standard deviation changed by more than a share; negligible ones may keep falling.

    On a path, phi and velocity have none of their own.
    """
    of_bends = (_SETTLED_AT,) * len(before.bends), (0.0,) * len(before.ways)
    phi, velocity = (np.inf, np.inf) if before.path else (_SETTLED_AT, 0.0)
    none = Spreads(
        phi, velocity, _SETTLED_AT, _SETTLED_AT, *of_bends, _SETTLED_PX, (0.0,) * len(before.path), (np.inf,) * 3
    )
    if (np.abs(np.subtract(after.travel, before.travel)) > _SETTLED_TRAVEL * after.velocity).any():
        return False
    return all(
        abs(new - old) <= tolerance * new or max(old, new) < least
        for old, new, least in zip(*(np.hstack(astuple(each)) for each in (before, after, none)), strict=True)
    )


def starting_spreads(options: BundleOptions, layout: Layout, baseline: float) -> Spreads:
    """Those that are given, or at which the estimation begins."""
    start = Spreads(
        options.phi_sigma or options.phi_sigma_start,
        (options.velocity_sigma or options.velocity_sigma_start) * baseline,
        options.focal_sigma_start,
        options.centre_sigma_start,
        tuple(np.broadcast_to(options.bend_sigma_start, len(set(layout.group))).tolist()),
        (options.way_sigma_start * baseline,) * len(set(layout.group[: layout.ways])),
        options.field_sigma_start,
        () if options.path is None else (_TURN_START, _TRAVEL_START * baseline),
    )
    return _bounded(start, options, baseline)


def _bounded(spreads: Spreads, options: BundleOptions, baseline: float) -> Spreads:
    """The prior standard deviations within their upper limits."""
    phi = np.inf if options.phi_sigma_most is None else options.phi_sigma_most
    velocity = np.inf if options.velocity_sigma_most is None else options.velocity_sigma_most * baseline
    return Spreads(
        min(spreads.phi, phi), min(spreads.velocity, velocity), min(spreads.focal, _MOST_VARIED),
        min(spreads.centre, _MOST_VARIED), tuple(min(each, phi) for each in spreads.bends), spreads.ways,
        min(spreads.field, _MOST_PX), spreads.path, spreads.travel,
    )  # fmt: skip


def field_spread(values: NDArray[np.float64], variances: NDArray[np.float64], spread: float) -> float:
    """Prior standard deviation in pixels of the unknowns (k, n) of residual fields, as `_spread`."""
    found = _spread(values, variances, np.ones(len(values)), spread)
    return min(found + _MIN_SPREAD_PX, _MOST_PX)


def path_spreads(
    prior: PathPrior, residuals: NDArray[np.float64], variances: NDArray[np.float64], baseline: float
) -> tuple[float, ...]:
    """Prior standard deviations of a path by its residuals (q, 18) and their posterior variances, as `_spread`.

    With few frames, which hardly determine them, they are drawn to those of a hand.
    """
    squares, unknown = (prior.unit_squares(each) for each in (residuals**2, variances))
    ones, found = np.ones(len(residuals)), []
    usual = _TURN_START, _TRAVEL_START * baseline
    for square, variance, spread, start in zip(squares, unknown, prior.spreads, usual, strict=True):
        seen = _spread(np.sqrt(square), variance, ones, spread) ** 2
        found.append(float(np.sqrt((square.size * seen + _USUAL_WEIGHT * start**2) / (square.size + _USUAL_WEIGHT))))
    return tuple(found)
