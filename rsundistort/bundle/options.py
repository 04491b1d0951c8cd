"""What a bundle adjustment can be told, and what it answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..model import BEND_GROUPS, Bend, KnownLength, Reconstruction
from ..model.checks import check_fields
from .intrinsics import GuessedCameras, check_refined
from .lengths import check_lengths
from .path import FramePath, PathSolution
from .places import KnownPlaces

__all__ = ["DEVIATIONS", "LOSSES", "BundleOptions", "BundleResult"]

#: What standard deviations are read off: the model of independent noise, or the residuals.
DEVIATIONS = ("jackknife", "model")

#: Robust losses and their codes in the kernels.
LOSSES: dict[str, int] = {"squared": 0, "huber": 1, "cauchy": 2, "soft-l1": 3}


def _known(name: str, phi: ArrayLike, sigma: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A known motion, checked."""
    values, sigmas = (np.array(np.broadcast_to(np.asarray(value, np.float64), 3)) for value in (phi, sigma))
    unknown = np.isposinf(sigmas)
    if not (np.isfinite(values) | unknown).all():
        raise InputError(f"known motion of {name!r}: {values.tolist()}, expected finite numbers")
    if not (sigmas > 0).all():
        raise InputError(f"known motion of {name!r}: sigma {sigmas.tolist()}, expected positive numbers")
    return np.where(unknown, 0.0, values), sigmas


@dataclass(frozen=True)
class BundleOptions:
    """Options of `bundle_adjust`; each says which inequality it controls.

    Parameters
    ----------
    max_iterations : int
        At most this many steps are tried in one solve.
    cost_tolerance : float
        Stop when a step lowers the cost by less than `cost_tolerance * cost`. The cost is about the number of
        observations, and half a unit of it is one standard deviation of one unknown.
    round_tolerance : float
        The same for the solves before the last outlier round, which only have to tell outliers from the rest, and for
        the first one if it starts from a guess of the spreads.
    step_tolerance : float
        Stop when every centre and point moves by less than `step_tolerance` times the scene's size, and every
        angle by less than `step_tolerance` radians.
    initial_damping, max_damping : float
        Levenberg-Marquardt damping, times the diagonal of the normal equations; above the largest, stop.
    loss : {"soft-l1", "huber", "cauchy", "squared"}
        Robust loss of an observation. Where the outliers are gone the noise of features still has heavy tails: squares
        of the same measurements give motions that are wrong by 1.1 to 1.4 times as much.
    loss_scale : float
        Residual length, in standard deviations of the noise, where the loss starts to bend.
    sigma_px : float or None
        Standard deviation of the measurements in pixels, which weighs them against the priors. None: read off
        the residuals, robustly, before each solve (never below `min_sigma_px`).
    min_sigma_px : float
        Lower limit of that reading.
    phi_sigma : float or None
        Standard deviation of the zero-mean prior on each component of phi, in radians per frame. None: estimated with
        the solution (empirical Bayes, `sigma^2 <- mean(phi^2 + posterior variance of phi)` after each solve), so that
        a shutter that can hardly be seen is not fitted to noise.
    phi_sigma_start : float
        Where that estimate starts; about what a swung hand does.
    velocity_sigma, velocity_sigma_start : float or None, float
        The same for each component of the velocity of the constant-motion model, in baselines per frame (a baseline is
        the mean distance of consecutive centres).
    phi_sigma_most, velocity_sigma_most : float or None
        Upper limits of the two spreads, where something else than the measurements says how far cameras can have moved.
    phi_limits : mapping of photo name to float
        The same of single photos: their prior is no wider than this (radians per frame), and that on their velocity no
        wider than what displaces their scene, at its median depth, as such a turn does. They tell nothing of the spread
        of the others.
    varying : bool
        Whether the intrinsics of each photo may differ from its camera's: log f, as a focusing lens changes it, and the
        principal point, as a stabiliser moves it, each with a zero-mean prior whose spread is estimated.
    bends : int
        How many groups of `model.BEND_GROUPS` the motions may depart from steady ones by, 0 to 5, under models that are
        exact: in their rotation, and of constant-motion by the first two groups in their position. Each group has a
        zero-mean prior whose spread is estimated, so that what is not there vanishes.
    bend_sigma_start, way_sigma_start : float
        Where these estimates start: root mean square over the frame, in radians (or of each group), and in baselines.
    focal_sigma_start, centre_sigma_start : float
        Where these estimates start: of log f, and of the principal point in focal lengths.
    residual_field : bool
        Whether what the lens models leave is solved for, too: a smooth field of each camera (`Camera.field`) without
        mean, orthogonal to what the intrinsics express, with a zero-mean prior whose spread is estimated.
    field_sigma_start : float
        Where that estimate starts, pixels: of each of some twenty orthogonal fields, root mean square over the frame.
    spread_rounds : int
        At most this many more solves settle the spreads, until neither changes by more than `spread_tolerance`.
    spread_tolerance : float
        See `spread_rounds`; a share.
    outlier_rounds : int
        Times that observations further than `outlier_sigma` standard deviations are dropped and all is solved again.
    outlier_sigma : float
        See `outlier_rounds`.
    min_outlier_px : float
        No observation nearer than this to its prediction is dropped.
    held_phi : mapping of photo name to component indices
        Hard anchors: components of phi held at zero, e.g. {"0001.jpg": (0,)} is the paper's RS*.
    known_phi : mapping of photo name to (phi, sigma)
        Motions that are known from elsewhere, each with its standard deviation, (3,) radians per frame; components of
        infinite sigma are unknown. A soft anchor is a known phi of zero.
    known_bends : mapping of photo name to Bend
        How motions depart from steady ones, where that is known from elsewhere, such as a gyroscope
        (`io.bends_from_gyro`). The start and the end of each are those of the frame.
    still : mapping of photo name to float
        Photos that did not move but for so many radians per frame (one standard deviation; 0: not at all). Models
        without a velocity hold their phi1 near zero (the paper's remedy; the measurements tell the rest),
        constant-motion the whole motion: the velocity to the way that displaces what the photo shows, at its median
        depth, as the angle does.
    lengths : sequence of KnownLength
        Known lengths in the scene, two or more: their ratios are residuals.
    places : KnownPlaces, optional
        Where photos were taken and control points are, in the frame of the reconstruction. Three or more hold it, in
        the place of the photo that does otherwise; fewer say nothing.
    refine : tuple of str
        Intrinsics of each camera that are solved for with the rest: some of f (or fx, fy), cx, cy, k1, k2, p1, p2, k3;
        of a fisheye k1 to k4.
    guessed : GuessedCameras, optional
        Prior on these intrinsics; without it they follow the photos alone.
    factor_limit : float or None
        Reduced systems whose factorisation takes at most this many multiply-adds are factored, others are solved by
        preconditioned conjugate gradients. None: what is expected to take less time, judged by the multiply-adds of
        the one and the bytes of the other.
    cg_tolerance : float
        Conjugate gradients stop when the residual, in the norm of the preconditioner, falls below `cg_tolerance` times
        the solution, in the norm of the matrix: a step then lacks about the square of it of its decrease of the cost.
    deviations : {"jackknife", "model"}
        How noisy measurements are taken to be together: "model" as independent ones, each as `sigma_px` says;
        "jackknife" as residuals show that pull together, in corners of the scene and of the lens. By that the
        covariances are larger (never smaller than of "model"), and the measurements weigh less against the priors once
        outliers are gone: the false motion that a lens or a scene leaves does not stand against a prior of mean zero.
    path : FramePath, optional
        Frames of a video share one trajectory: neighbours are joined by a prior of white noise on acceleration, phi and
        velocity are the trajectory's rates times the time that the readout takes, which is solved for. Only
        constant-motion; takes the place of the priors on phi and velocity.
    """

    max_iterations: int = 100
    cost_tolerance: float = 1e-7
    round_tolerance: float = 1e-3
    step_tolerance: float = 1e-10
    initial_damping: float = 1e-4
    max_damping: float = 1e12
    loss: str = "soft-l1"
    loss_scale: float = 1.5
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
    spread_rounds: int = 12
    spread_tolerance: float = 0.01
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
    path: FramePath | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "refine", check_refined(self.refine))
        object.__setattr__(self, "lengths", check_lengths(self.lengths))
        known = {name: _known(name, *value) for name, value in self.known_phi.items()}
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
            "cost_tolerance",
            "round_tolerance",
            "step_tolerance",
            "initial_damping",
            "loss_scale",
            "min_sigma_px",
            "phi_sigma_start",
            "velocity_sigma_start",
            "way_sigma_start",
            "focal_sigma_start",
            "centre_sigma_start",
            "field_sigma_start",
            "spread_tolerance",
            "cg_tolerance",
        )
        for name in (*positive, "outlier_sigma", "max_damping"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name}={getattr(self, name)!r}, expected a positive number")
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
            raise InputError("the path of a video says how its frames move; it takes no anchors, but known rates")
        if self.max_iterations < 1 or self.outlier_rounds < 0 or self.spread_rounds < 0:
            raise InputError("max_iterations must be at least 1, outlier_rounds and spread_rounds at least 0")


@dataclass(frozen=True)
class BundleResult:
    """Outcome of a bundle adjustment.

    Attributes
    ----------
    reconstruction : Reconstruction
        The estimate; observations that were dropped as outliers, and points left without two photos, are gone.
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
        velocity, as far as the model has them (nb = 6, 9 or 12). The gauge is that of the solve: the photo with the
        most observations has its pose held, and the centre farthest from it one coordinate; 0 where held.
    sigma_intrinsics : tuple of dict of name to float
        Standard deviation of each camera's refined intrinsics, in pixels, or as the lens coefficients.
    rms_px : float
        Root mean square of the residuals' x and y parts.
    num_outliers : int
        Observations dropped.
    inflation : (unknowns of a photo,) array
        How many times larger than of independent measurements the noise's share of the deviations of each kind of
        unknown is (`BundleOptions.deviations`), 1 or more. The covariances have it in them.
    noise_factor : float
        One such factor for all: times `sigma_px` it is the noise that weighed the measurements against the priors.
    field_sigma_px : float
        Standard deviation of the prior on the unknowns of the cameras' residual fields; 0 where none was solved for.
    sigma_fields_px : tuple of float
        Standard deviation of each camera's field, root mean square over its frame; 0 where none was solved for.
    path : PathSolution or None
        The path, of frames that have one.
    path_sigmas : tuple of float
        The spreads of its prior, of turn and of travel, as `PathPrior` takes them.
    """

    reconstruction: Reconstruction
    stop_reason: str
    cost_history: NDArray[np.float64]
    num_iterations: int
    sigma_px: float
    phi_sigma: float
    velocity_sigma: float
    focal_sigma: float
    centre_sigma: float
    bend_sigmas: tuple[float, ...]
    way_sigmas: tuple[float, ...]
    covariances: NDArray[np.float64]
    sigma_intrinsics: tuple[dict[str, float], ...]
    rms_px: float
    num_outliers: int
    inflation: NDArray[np.float64]
    noise_factor: float
    field_sigma_px: float = 0.0
    sigma_fields_px: tuple[float, ...] = ()
    path: PathSolution | None = None
    path_sigmas: tuple[float, ...] = ()

    def of_photos(self, keep: NDArray[np.bool_]) -> BundleResult:
        """The same of some photos (m,) only, with the points that two of them show."""
        return replace(self, reconstruction=self.reconstruction.take_photos(keep), covariances=self.covariances[keep])

    @property
    def sigma_phi(self) -> NDArray[np.float64]:
        """(m, 3) standard deviations of phi, radians per unit of the clock; 0 where held, and for a global shutter."""
        return self._sigmas(6)

    @property
    def sigma_velocity(self) -> NDArray[np.float64]:
        """(m, 3) standard deviations of the velocity, world units per unit of the clock; 0 where there is none."""
        return self._sigmas(9)

    def _sigmas(self, first: int) -> NDArray[np.float64]:
        variances = np.diagonal(self.covariances, axis1=1, axis2=2)[:, first : first + 3]
        return np.sqrt(variances) if variances.shape[1] else np.zeros((len(self.covariances), 3))

    @property
    def converged(self) -> bool:
        """Whether the last solve ended because nothing was left to gain."""
        return self.stop_reason in ("cost", "step", "damping")
