"""Options and result of a bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..model import BEND_GROUPS, Bend, KnownLength, Reconstruction
from ..model.array_types import Array, Mask
from ..model.checks import check_fields
from ..model.former_fields import former_fields
from .common_motion import CommonMotion
from .intrinsics import GuessedCameras, check_refined
from .known_lengths import check_lengths
from .known_positions import KnownPlaces
from .loss import LOSSES, USUAL_SCALE, Loss
from .path_prior import FramePath, PathSolution, PathStart

__all__ = ["DEVIATIONS", "BundleOptions", "BundleResult"]

#: Source of the standard deviations: the residuals, or the model of independent noise.
DEVIATIONS = ("jackknife", "model")


def _known(name: str, known: tuple[ArrayLike, ArrayLike]) -> tuple[Array, Array]:
    """A known motion, checked."""
    try:
        phi, sigma = known
        values, sigmas = (np.array(np.broadcast_to(np.asarray(value, np.float64), 3)) for value in (phi, sigma))
    except (TypeError, ValueError) as error:
        raise InputError(f"known motion of {name!r}: expected phi and sigma of three numbers each") from error
    unknown = np.isposinf(sigmas)
    if not (np.isfinite(values) | unknown).all():
        raise InputError(f"known motion of {name!r}: {values.tolist()}, expected finite numbers")
    if not (sigmas > 0).all():
        raise InputError(f"known motion of {name!r}: sigma {sigmas.tolist()}, expected positive numbers")
    return np.where(unknown, 0.0, values), sigmas


@former_fields(spread_rounds="prior_sigma_rounds", spread_tolerance="prior_sigma_tolerance")
@dataclass(frozen=True)
class BundleOptions:
    """Options of `bundle_adjust`; each says which inequality it controls.

    Parameters
    ----------
    max_iterations : int
        Largest number of steps in one solve.
    cost_tolerance : float
        Stop when a step lowers the cost by less than `cost_tolerance * cost`. The cost is about the number of
        observations, and half a unit of it is one standard deviation of one unknown.
    round_tolerance : float
        The same for the solves before the last outlier round, which only separate outliers from the rest, and for the
        first one if it starts from a guess of the prior standard deviations.
    step_tolerance : float
        Stop when every centre and point moves by less than `step_tolerance` times the scene's size, and every
        angle by less than `step_tolerance` radians.
    initial_damping, max_damping : float
        Levenberg-Marquardt damping, times the diagonal of the normal equations; above the largest, stop.
    loss : {"soft-l1", "huber", "cauchy", "squared"}
        Robust loss of an observation. Even without outliers the noise of features has heavy tails: with squares the
        same measurements give motions that are wrong by 1.1 to 1.4 times as much.
    loss_scale : float or None
        Residual length, in standard deviations of the noise, beyond which the loss grows more slowly. None: of soft-l1
        the most likely one by the residuals once outliers are dropped (`bundle.noise`), else 1.5.
    sigma_px : float or None
        Standard deviation of the measurements in pixels, which weighs them against the priors. None: estimated from the
        residuals, robustly, before each solve (never below `min_sigma_px`).
    min_sigma_px : float
        Lower limit of that estimate.
    phi_sigma : float or None
        Standard deviation of the normal, zero-mean prior on each component of phi, in radians per frame. None: the
        prior is Student's t with four degrees of freedom (`motion_prior`), and its scale is estimated with the solution
        (empirical Bayes, the weighted mean of `phi^2 + posterior variance of phi` after each solve), so that a shutter
        that is hardly observable is not fitted to noise, and that a photo which moved far more does not bend the rest.
    phi_sigma_start : float
        Start of that estimate; about the rotation of a swung hand.
    velocity_sigma, velocity_sigma_start : float or None, float
        The same for each component of the velocity of the constant-motion model, in baselines per frame (a baseline is
        the mean distance of consecutive centres).
    phi_sigma_most, velocity_sigma_most : float or None
        Upper limits of the two prior standard deviations, known from another source than the measurements.
    phi_limits : mapping of photo name to float
        The same for single photos: their prior is no wider than this (radians per frame), and that on their velocity no
        wider than what displaces their scene, at its median depth, as much. They do not affect the prior of the others.
    varying : bool
        Whether the intrinsics of each photo may differ from its camera's: log f, as a focusing lens changes it, and the
        principal point, as a stabiliser moves it, each with a zero-mean prior whose standard deviation is estimated. Of
        frames on a path log f alone: a shift that lasts from frame to frame is a rotation of the path.
    bends : int
        Number of groups of `model.BEND_GROUPS` in unsteady motions, 0 to 5, for exact models: in their rotation, and
        for constant-motion with the first two groups in their position. Each group has a zero-mean prior whose standard
        deviation is estimated, so that groups that are not needed vanish.
    bend_sigma_start, way_sigma_start : float
        Start of these estimates: root mean square over the frame, in radians (or for each group), and in baselines.
    focal_sigma_start, centre_sigma_start : float
        Start of these estimates: of log f, and of the principal point in focal lengths.
    residual_field : bool
        Whether a residual field of each camera is estimated (`Camera.field`): smooth, without mean, orthogonal to the
        effect of the intrinsics, with a zero-mean prior whose standard deviation is estimated.
    field_sigma_start : float
        Start of that estimate, pixels: of each of some twenty orthogonal fields, root mean square over the frame.
    prior_sigma_rounds : int
        Largest number of further solves until no prior standard deviation changes by more than `prior_sigma_tolerance`.
    prior_sigma_tolerance : float
        Largest relative change, see `prior_sigma_rounds`.
    outlier_rounds : int
        Number of times that observations farther than `outlier_sigma` standard deviations are dropped and all is solved
        again.
    outlier_sigma : float
        See `outlier_rounds`.
    min_outlier_px : float
        No observation nearer than this to its prediction is dropped.
    held_phi : mapping of photo name to component indices
        Hard constraints: components of phi held at zero, e.g. {"0001.jpg": (0,)} is the paper's RS*.
    known_phi : mapping of photo name to (phi, sigma)
        Motions that are known from elsewhere, each with its standard deviation, (3,) radians per frame; components of
        infinite sigma are unknown. A known phi of zero is a soft constraint.
    known_bends : mapping of photo name to Bend
        Deviations of motions from steady ones that are known from elsewhere, such as a gyroscope
        (`io.bends_from_gyro`). The start and the end of each are those of the frame.
    still : mapping of photo name to float
        Photos that did not move by more than this angle per frame in radians (one standard deviation; 0: not at all).
        Models without a velocity hold their phi1 near zero (the paper's remedy; the measurements determine the rest),
        constant-motion the whole motion: the velocity up to a translation that displaces the photo's content, at its
        median depth, as the angle does.
    lengths : sequence of KnownLength
        Known lengths in the scene, two or more: their ratios are residuals. Those without two points, or whose points
        are lost as outliers, are left out; adjustments of `deviations` by a jackknife name them, others are rough.
    places : KnownPlaces, optional
        Positions of photos and control points, in the frame of the reconstruction. Three or more determine the gauge,
        in place of the fixed photo; fewer are ignored.
    refine : tuple of str
        Intrinsics of each camera that are estimated: some of f (or fx, fy), cx, cy, k1, k2, p1, p2, k3; for a fisheye
        k1 to k4.
    guessed : GuessedCameras, optional
        Prior on these intrinsics; without it they depend on the photos alone.
    factor_limit : float or None
        Reduced systems whose factorisation takes at most this many multiply-adds are factored, others are solved by
        preconditioned conjugate gradients. None: the method that is expected to take less time, by the multiply-adds of
        the one and the bytes of the other.
    cg_tolerance : float
        Conjugate gradients stop when the residual, in the norm of the preconditioner, falls below `cg_tolerance` times
        the solution, in the norm of the matrix: a step then lacks about the square of it of its decrease of the cost.
    deviations : {"jackknife", "model"}
        Noise model of the standard deviations: "model" takes measurements as independent, with `sigma_px`; "jackknife"
        estimates the correlation of residuals in regions of the scene and of the lens. With the latter the covariances
        are larger (never smaller than with "model"), and the measurements weigh less against the priors once outliers
        are dropped: a false motion caused by a lens or a scene yields to a prior of mean zero.
    rival : mapping of photo to 12 floats
        How far another model that may be right moves rotation, centre, phi and velocity of a photo, times the root of
        its probability: its square is added to the covariances (`bundle.doubt`). The estimate does not depend on it.
    path : FramePath, optional
        Frames of a video share one trajectory: a prior of white noise on the change of acceleration connects
        neighbours, phi and velocity are the trajectory's rates times the readout time, which is estimated. For
        constant-motion only; replaces the priors on phi and velocity.
    """

    max_iterations: int = 100
    cost_tolerance: float = 1e-7
    round_tolerance: float = 1e-3
    step_tolerance: float = 1e-10
    initial_damping: float = 1e-4
    max_damping: float = 1e12
    loss: str = "soft-l1"
    loss_scale: float | None = None
    sigma_px: float | None = None
    min_sigma_px: float = 0.02
    phi_sigma: float | None = None
    phi_sigma_start: float = 0.03
    velocity_sigma: float | None = None
    velocity_sigma_start: float = 0.03
    phi_sigma_most: float | None = None
    velocity_sigma_most: float | None = None
    phi_limits: Mapping[str, float] = field(default_factory=dict)
    varying: bool = False
    bends: int = 0
    bend_sigma_start: float | tuple[float, ...] = 1e-3
    way_sigma_start: float = 1e-3
    focal_sigma_start: float = 2e-3
    centre_sigma_start: float = 3e-3
    residual_field: bool = False
    field_sigma_start: float = 0.03
    prior_sigma_rounds: int = 12
    prior_sigma_tolerance: float = 0.01
    outlier_rounds: int = 3
    outlier_sigma: float = 4.5
    min_outlier_px: float = 0.25
    held_phi: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    known_phi: Mapping[str, tuple[ArrayLike, ArrayLike]] = field(default_factory=dict)
    known_bends: Mapping[str, Bend] = field(default_factory=dict)
    still: Mapping[str, float] = field(default_factory=dict)
    lengths: Sequence[KnownLength] = ()
    places: KnownPlaces | None = None
    refine: tuple[str, ...] = ()
    guessed: GuessedCameras | None = None
    factor_limit: float | None = None
    cg_tolerance: float = 0.01
    deviations: str = "jackknife"
    rival: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    path: FramePath | None = None

    @property
    def usual_loss(self) -> Loss:
        """The robust loss of measurements whose tails are not known."""
        return Loss(self.loss, self.loss_scale or USUAL_SCALE)

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "refine", check_refined(self.refine))
        object.__setattr__(self, "lengths", check_lengths(self.lengths))
        known = {name: _known(name, value) for name, value in self.known_phi.items()}
        object.__setattr__(self, "known_phi", known)
        for name, components in self.held_phi.items():
            if any(component not in (0, 1, 2) for component in components):
                raise InputError(f"anchor {name!r}: components {components}, expected some of 0, 1, 2")
            if name in known and np.isfinite(known[name][1][list(components)]).any():
                raise InputError(f"anchor {name!r} is held at zero and known from elsewhere; give one of them")
        for name, still in self.still.items():
            if not 0 <= still < np.inf:
                raise InputError(f"still photo {name!r}: sigma {still!r}, expected 0 or a positive number")
            if name in known or name in self.held_phi:
                raise InputError(f"photo {name!r} is said to be still and its motion to be known; give one of them")
        for name, limit in self.phi_limits.items():
            if not 0 < limit < np.inf:
                raise InputError(f"limit of the motion of {name!r}: {limit!r}, expected a positive number")
        if self.loss not in LOSSES:
            raise InputError(f"loss={self.loss!r}, expected one of {', '.join(LOSSES)}")
        if self.deviations not in DEVIATIONS:
            raise InputError(f"deviations={self.deviations!r}, expected one of {', '.join(DEVIATIONS)}")
        positive = (
            "cost_tolerance", "round_tolerance", "step_tolerance", "initial_damping", "max_damping",
            "min_sigma_px", "phi_sigma_start", "velocity_sigma_start", "way_sigma_start", "focal_sigma_start",
            "centre_sigma_start", "field_sigma_start", "prior_sigma_tolerance", "outlier_sigma", "cg_tolerance",
        )  # fmt: skip
        for name in positive:
            if not getattr(self, name) > 0:
                raise InputError(f"{name}={getattr(self, name)!r}, expected a positive number")
        if self.loss_scale is not None and not self.loss_scale > 0:
            raise InputError(f"loss_scale={self.loss_scale!r}, expected a positive number")
        if self.sigma_px is not None and not self.sigma_px > 0:
            raise InputError(f"sigma_px={self.sigma_px!r}, expected a positive number or None")
        for name in ("phi_sigma", "velocity_sigma", "phi_sigma_most", "velocity_sigma_most"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"{name}={value!r}, expected a positive number or None")
        starts = np.ravel(self.bend_sigma_start)
        if len(starts) not in (1, self.bends) or not (starts > 0).all():
            raise InputError(f"bend_sigma_start={self.bend_sigma_start!r}, expected a positive number, or one a group")
        if self.bends not in range(len(BEND_GROUPS) + 1):
            raise InputError(f"bends={self.bends!r}, expected 0 to {len(BEND_GROUPS)} groups")
        if self.path is not None and self.places:
            raise InputError("the path of a video is solved for in a frame of its own; it takes no known places")
        if self.path is not None and (self.known_phi or self.still or self.held_phi):
            raise InputError("the path of a video says how its frames move; it takes known rates, but no known motions")
        if self.max_iterations < 1 or self.outlier_rounds < 0 or self.prior_sigma_rounds < 0:
            raise InputError("max_iterations must be at least 1, outlier_rounds and prior_sigma_rounds at least 0")


@dataclass(frozen=True)
class BundleResult:
    """Outcome of a bundle adjustment.

    Attributes
    ----------
    reconstruction : Reconstruction
        The estimate, without the observations that were dropped as outliers, and points left without two photos.
    stop_reason : str
        "cost", "step" (converged), "iterations" (ran out) or "damping" (no step lowers the cost any more).
    cost_history : (k,) array
        Cost after each accepted step of the last solve, the start first.
    num_iterations : int
        Steps tried, over all solves.
    sigma_px : float
        Standard deviation of the noise of a measurement in the last solve.
    phi_sigma : float
        Standard deviation of the prior on phi, radians per frame: as given, or as estimated.
    velocity_sigma : float
        Standard deviation of the prior on the velocity, baselines per frame; for constant-motion only.
    focal_sigma, centre_sigma : float
        Standard deviations of the variation of log f, and of the principal point in focal lengths; 0 where none varies.
    bend_sigmas : tuple of float
        Standard deviations of the groups of the rotations' bends, radians (root mean square over the frame).
    way_sigmas : tuple of float
        Those of the positions' bends, baselines.
    covariances : (m, nb, nb) array
        Covariance of each photo's unknowns, the rest being free: rotation (left, radians, camera frame), centre, phi,
        velocity, as far as the model has them (nb = 6, 9 or 12). The gauge is that of the solve: the pose of the photo
        with the most observations and one coordinate of the centre farthest from it are fixed; 0 where fixed.
    sigma_intrinsics : tuple of dict of name to float
        Standard deviation of each camera's refined intrinsics, in pixels, or as the lens coefficients.
    rms_px : float
        Root mean square of the x and y components of the residuals.
    num_outliers : int
        Observations dropped.
    inflation : float
        Factor (1 or more) by which the standard deviations of the photos' unknowns due to noise are larger than with
        independent noise (`BundleOptions.deviations`). The covariances include it.
    noise_factor : float
        The same of the solve before: times `sigma_px` it is the noise that weighed measurements against priors.
    field_sigma_px : float
        Standard deviation of the prior on the unknowns of the cameras' residual fields; 0 if none was estimated.
    sigma_fields_px : tuple of float
        Standard deviation of each camera's field, root mean square over its frame; 0 if none was estimated.
    path : PathSolution or None
        The path of the frames of a video, if they have one.
    path_sigmas : tuple of float
        Standard deviations of its prior, of rotation and of translation, as `PathPrior` takes them.
    common : CommonMotion or None
        Means of the priors on phi and velocity, if they were solved for.
    loss : Loss
        The robust loss of the last solve.
    """

    reconstruction: Reconstruction
    stop_reason: str
    cost_history: Array
    num_iterations: int
    sigma_px: float
    phi_sigma: float
    velocity_sigma: float
    focal_sigma: float
    centre_sigma: float
    bend_sigmas: tuple[float, ...]
    way_sigmas: tuple[float, ...]
    covariances: Array
    sigma_intrinsics: tuple[dict[str, float], ...]
    rms_px: float
    num_outliers: int
    inflation: float
    noise_factor: float
    field_sigma_px: float = 0.0
    sigma_fields_px: tuple[float, ...] = ()
    path: PathSolution | None = None
    path_sigmas: tuple[float, ...] = ()
    common: CommonMotion | None = None
    loss: Loss = field(default_factory=Loss.none)

    @property
    def phi_rms(self) -> float:
        """Root mean square of a component of phi by its prior, mean included, radians per frame."""
        return float(np.hypot(self.phi_sigma, 0.0 if self.common is None else self.common.rms[0]))

    @property
    def velocity_rms(self) -> float:
        """Root mean square of a component of the velocity by its prior, baselines per frame."""
        return float(np.hypot(self.velocity_sigma, 0.0 if self.common is None else self.common.rms[1]))

    def of_photos(self, keep: Mask) -> BundleResult:
        """The result of some photos (m,) only, with the points that two of them show."""
        return replace(self, reconstruction=self.reconstruction.take_photos(keep), covariances=self.covariances[keep])

    def path_start(self) -> PathStart:
        """What was found of a path, where the next adjustment of these frames begins."""
        assert self.path is not None
        noise = self.noise_factor if self.noise_factor != 1.0 else None
        return PathStart(tuple(self.reconstruction.image_names), self.path.state, self.path_sigmas, noise)

    @property
    def sigma_phi(self) -> Array:
        """(m, 3) standard deviations of phi, radians per unit of the clock; 0 where held, and for a global shutter."""
        return self._sigmas(6)

    @property
    def sigma_velocity(self) -> Array:
        """(m, 3) standard deviations of the velocity, world units per unit of the clock; 0 where there is none."""
        return self._sigmas(9)

    def _sigmas(self, first: int) -> Array:
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)[:, first : first + 3]
        return np.sqrt(variances) if variances.shape[1] else np.zeros((len(self.covariances), 3))

    @property
    def converged(self) -> bool:
        """Whether the last solve converged."""
        return self.stop_reason in ("cost", "step", "damping")
