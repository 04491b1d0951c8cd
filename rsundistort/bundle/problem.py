"""Reprojection errors and priors of a reconstruction as a problem for the solver."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np
from scipy.spatial.transform import Rotation

from .._kernels import residuals
from ..errors import InputError
from ..model import Camera, Reconstruction, check_shutter_model
from ..model.array_types import Array, Index, Mask
from ..model.reprojection import camera_arrays, motion_tables, observed_lens_pixels, plain_arrays
from .bundle_options import BundleOptions
from .common_motion import LEAST_PHOTOS, MotionMeans
from .connections import Border, CommonPrior, Coupling
from .elimination import Elimination
from .intrinsics import INTRINSICS, check_lenses, deviation, moved_camera, prior_weight
from .jackknife import by_corner, by_place
from .known_lengths import LengthResiduals, measured_lengths
from .known_positions import KnownPlaces, PlaceResiduals
from .layout import Layout
from .lens_field import LensFields
from .loss import LOSSES, Loss
from .motion_prior import MotionPrior
from .normal_equations import NormalEquations, Step
from .path_prior import PathPrior, PathState
from .point_terms import PointTerms, largest_step, moved_points, nearest_photos
from .prior_sigmas import PriorSigmas
from .sparse_blocks import Chain
from .structure import Structure
from .triangulate import least_distance

__all__ = ["BundleProblem", "State"]


@dataclass(frozen=True)
class State:
    """Unknowns that a step changes: cameras, poses, shutter motion, variation and points, as in `Reconstruction`.

    Of the bends (m, 3 k) coefficients along `Layout.functions`, of the rotation, then of the position, three by three.
    Of frames on a path, phi and velocity are those of its rates. Means (cameras, 8) are the unknowns behind those
    of the motions (`MotionMeans`), in units of their priors; (cameras, 0) if they are not solved for.
    """

    cameras: tuple[Camera, ...]
    R_cw: Array
    center_w: Array
    phi: Array
    velocity: Array
    variation: Array
    bend: Array
    points_w: Array
    means: Array
    path: PathState | None = None


# Observations that a thread takes at a time, and whose costs are summed together.
_CHUNK = 1024


class BundleProblem:
    """Robust reprojection errors and the priors on phi and velocity, with the gauge and the constrained photos held.

    Unknowns of a photo: rotation increment (left, radians), centre (world units), phi (radians per unit of the clock)
    unless the shutter is global, velocity (world units per unit of the clock) if the motion is whole, and the variation
    of its intrinsics (log f, cx / fx, cy / fy) if the options say that they vary, and the coefficients of its bends, if
    it has any (`Layout`). Unknowns of a camera: the intrinsics that the options name, as in `moved_camera`, those of
    `LensFields` if they ask for fields, and those of the means of its photos' motions (`means`) if `PriorSigmas` has
    any. Seven unknowns are held for the gauge: the pose of the photo with the most observations, and one coordinate of
    the centre farthest from it; none where known places hold the frame. The prior on intrinsics has heavy tails
    (`prior_weight`), or it is normal. `noise` is how many times larger than `sigma_px` the noise is that weighs the
    measurements against the priors, since errors go together; `loss` is in units of `sigma_px` all the same.
    `structure` and `fields` are those of a problem with the same observations or cameras, if there was one.
    """

    def __init__(
        self, reconstruction: Reconstruction, shutter_model: str, options: BundleOptions, sigma_px: float,
        sigmas: PriorSigmas, heavy_tails: bool = True, path: PathState | None = None, means: Array | None = None,
        noise: float = 1.0, loss: Loss | None = None, structure: Structure | None = None,
        fields: LensFields | None = None,
    ) -> None:  # fmt: skip
        self._model = check_shutter_model(shutter_model)
        obs = reconstruction.observations
        if not len(obs) or reconstruction.num_images < 2:
            raise InputError("bundle adjustment needs two photos and measurements of common points")
        self._shutter_model = shutter_model
        self._options = options
        self._heavy_tails = heavy_tails
        self.layout = Layout.of(shutter_model, options)
        self._block = self.layout.motion
        self._bend_clock = reconstruction.bend_clock
        if self.layout.bent and not reconstruction.bends:
            self._bend_clock = np.array(
                [reconstruction.camera(i).clock_range for i in range(reconstruction.num_images)]
            )
        self._path, self._path_start, self._bounded = None, path, True
        self._rotation_only = options.path is not None and options.path.rotation_only
        if options.path is not None:
            if shutter_model != "constant-motion":
                raise InputError(f"frames on a path move by constant-motion, not by {shutter_model}")
            self._path = PathPrior(options.path, reconstruction, (sigmas.path[0], sigmas.path[1]))
        self.structure = structure = structure or Structure.from_observations(
            obs.frame_idx, obs.point_idx, reconstruction.num_images, reconstruction.num_points,
            None if self._path is None else (self._path.first, self._path.second),
        )  # fmt: skip
        self._given = reconstruction
        obs = replace(obs, point_idx=np.argsort(structure.points)[obs.point_idx])
        self._start = replace(reconstruction, points_w=reconstruction.points_w[structure.points], observations=obs)
        self._nearest = nearest_photos(self._start.points_w, self._start.center_w, structure)
        self._xy = obs.xy_raw[structure.order]
        self._sigma_px = noise * sigma_px * obs.sigma[structure.order]
        self._loss, self._influence = (loss or options.usual_loss).of_noise(noise), Loss.none()
        focal_px = np.array([camera.K[0, 0] for camera in reconstruction.cameras])[reconstruction.camera_idx]
        nearest = least_distance(reconstruction) or np.nan  # then no change is too large
        self._most_change = 2.0 * (focal_px[structure.frame_idx] / self._sigma_px / nearest) ** 2
        # the rows that the last cost predicted, where the next Jacobians look for them
        self._clock = np.full(len(obs), np.nan)
        self._clock_of: State | None = None
        # what the kernels were last given: several ask for the same
        self._args_of: State | None = None
        self._args: tuple[Any, ...] = ()
        self._lens_of: State | None = None
        self._lens = np.empty((0, 2, 0)), np.empty((0, 2, 3))
        check_lenses(options.refine, reconstruction.cameras)
        self._refine = options.refine
        self.lens_fields, self._field_weight = fields, 0.0
        if options.residual_field:
            self.lens_fields = fields or LensFields(reconstruction.cameras, options.refine, shutter_model)
            camera = reconstruction.camera_idx[self.structure.frame_idx]
            self._field_jacobian = self.lens_fields.jacobian(reconstruction.cameras, camera, self._xy)
            self._field_weight = sigmas.field**-2.0
        self._refine_codes = np.array([INTRINSICS[name] for name in options.refine], np.int64)
        span = reconstruction.frame_span()[:, None]
        self._motion_prior = MotionPrior.of(reconstruction, options, sigmas.phi, sigmas.velocity, self._block - 6)
        self._own_weight = self._weight_of_own(sigmas)
        self._lengths = LengthResiduals(self._start, measured_lengths(self._start, options.lengths)[0])
        self._places = PlaceResiduals(self._start, options.places or KnownPlaces({}))
        self._known, self._known_weight = self._known_motions(span)
        self._free = self._free_unknowns()
        self.means, self._means_start = self._motion_means(sigmas), means
        chain = None if self._path is None else Chain(self._path.first, self._path.second, 6)
        self._elimination = Elimination.of(
            structure, self._free, (reconstruction.R_cw, reconstruction.center_w), options.factor_limit,
            options.cg_tolerance, chain,
        )  # fmt: skip
        self._size = reconstruction.size

    def _weight_of_own(self, sigmas: PriorSigmas) -> Array:
        """(m, k) weights of the priors on variation and bends."""
        varied = np.array([sigmas.focal, sigmas.centre, sigmas.centre])[: self.layout.num_varying] ** -2.0
        of_bends = self.layout.per_bend(sigmas.bends, sigmas.ways) ** -2.0
        weight = np.tile(np.concatenate([varied, of_bends]), (self._start.num_images, 1))
        for i, still in ((self._photo(name), still) for name, still in self._options.still.items() if still > 0):
            weight[i, len(varied) :] += self.layout.still_bends(still, self._start.median_depth(i))
        return weight

    def _motion_means(self, sigmas: PriorSigmas) -> MotionMeans | None:
        """How motions depend on their means, if these are solved for and any photo shares them."""
        if sigmas.means is None:
            return None
        # what a photo's own limit bounds is no sample of the others, and few photos are none of their camera
        limits, start = self._options.phi_limits, self._start
        limited = [limits.get(name, np.inf) < sigmas.phi for name in start.image_names]
        few = np.bincount(start.camera_idx)[start.camera_idx] < LEAST_PHOTOS
        shares = self._free[:, 6:12] & ~(few | limited)[:, None]
        return MotionMeans.of(start, sigmas.means, shares) if shares.any() else None

    def _known_motions(self, span: Array) -> tuple[Array, Array]:
        """Motions (m, nb - 6) known from elsewhere, per unit of the clock, and their weights."""
        if self._options.path is not None:
            return self._options.path.known_rates(self._start.image_names)
        known, weight = np.zeros((2, self._start.num_images, self._block - 6))
        for name, (phi, sigma) in self._options.known_phi.items():
            i = self._photo(name)
            if self._block > 6:
                known[i, :3], weight[i, :3] = phi / span[i], (span[i] / sigma) ** 2
        if self._block > 9:
            places = self._places
            known[places.moving, 3:], weight[places.moving, 3:] = places.velocity, places.velocity_sigma**-2.0
        for name, still in self._options.still.items():
            i = self._photo(name)
            if still > 0:
                way = np.repeat([1.0, self._start.median_depth(i)], 3)[: weight.shape[1]]
                parts = self._still_parts(i)
                known[i, parts] = 0.0  # whoever says so knows better than a velocity by GPS
                weight[i, parts] = ((span[i] / (still * way)) ** 2)[parts]
        return known, weight

    def _still_parts(self, image: int) -> list[int]:
        """Components of a photo's motion that are zero if it was still."""
        if self._block > 9:
            return [0, 1, 2, 3, 4, 5]
        # the rotation that stretches the photo along its readout
        phi1 = 1 - self._start.camera(image).clock_axis
        return [phi1][: self._block - 6]

    def _photo(self, name: str) -> int:
        """Index of a constraint's photo."""
        if name not in self._start.image_names:
            raise InputError(f"anchor {name!r} is not a photo of the reconstruction")
        return self._start.image_names.index(name)

    def _free_unknowns(self) -> Mask:
        """(m, nb) unknowns that are solved for."""
        rec = self._start
        free = np.ones((rec.num_images, self.layout.size), bool)
        reference = int(np.argmax(np.bincount(self.structure.frame_idx, minlength=rec.num_images)))
        offset = np.abs(rec.center_w - rec.center_w[reference])
        far, axis = np.unravel_index(np.argmax(offset), offset.shape)
        if not self._places.holds_frame:
            free[reference, :6] = False
            free[far, 3 + axis] = False
        for name, components in self._options.held_phi.items():
            i = self._photo(name)
            if self._block > 6:
                free[i, [6 + c for c in components]] = False
        for name, still in self._options.still.items():
            if still == 0:
                i = self._photo(name)
                free[i, [6 + part for part in self._still_parts(i)]] = False
                free[i, self.layout.variation :] = False
        if self._path is None:
            return free
        free = np.pad(free, ((0, 0), (0, 6)), constant_values=True)
        if self._rotation_only:
            free[:, [3, 4, 5, 9, 10, 11, *range(self.layout.size + 3, self.layout.size + 6)]] = False
        return free

    def initial_state(self) -> State:
        """The reconstruction's values; zero for held components of the motion and those that the model lacks."""
        motion = np.zeros((self._start.num_images, 6))
        found = np.hstack([self._start.phi, self._start.velocity])[:, : self._block - 6]
        motion[:, : self._block - 6] = np.where(self._free[:, 6 : self._block], found, 0.0)
        start, means = self._start, self._means_start
        variation = start.variation.copy() if self._options.varying else np.zeros_like(start.variation)
        bend = np.where(self._free[:, self.layout.variation : self.layout.size], self.layout.coefficients(start), 0.0)
        cameras = tuple(start.cameras) if self.lens_fields is None else self.lens_fields.started(start.cameras)
        path = self._path_start
        if self._path is not None:
            path = path or self._path.start(start)
            motion = path.motions(start.camera_idx, variation)
        if self.means is None:
            means = np.zeros((len(cameras), 0))
        elif means is None:
            means = self.means.most_likely(self._motion_prior.precision, motion, len(cameras))
        else:
            means = self.means.unknowns(means)
        return State(
            cameras, start.R_cw, start.center_w, motion[:, :3], motion[:, 3:], variation, bend, start.points_w, means,
            path,
        )  # fmt: skip

    def with_squares(self, influence: bool = False) -> BundleProblem:
        """The problem without a robust loss and without the bound of the readout time, for covariances.

        With `influence` its residuals are those by which squares would be pulled as the loss is (Huber's
        pseudo-residuals): the optimum is the same, and so is the influence of each measurement on it.
        """
        plain = copy(self)
        plain._loss, plain._influence = Loss.none(), self._loss if influence else Loss.none()
        plain._bounded, plain._args_of, plain._lens_of = False, None, None
        return plain

    def in_order(self, of_points: Array) -> Array:
        """Values of the reconstruction's points in the order of the state's."""
        return of_points[self.structure.points]

    def partitions(self, state: State) -> tuple[Index, ...]:
        """Measurements that may go wrong together: of one corner of the scene, and of one corner of a lens."""
        s, start = self.structure, self._start
        camera = start.camera_idx[s.frame_idx]
        size = np.array([(each.width, each.height) for each in start.cameras])[camera]
        return by_place(state.points_w, s.point_idx, start.num_images), by_corner(self._xy, size, camera)

    def reconstruction(self, state: State) -> Reconstruction:
        """The reconstruction at a state."""
        U, _, Vt = np.linalg.svd(state.R_cw)  # rounding of many increments
        points_w = np.empty_like(state.points_w)
        points_w[self.structure.points] = state.points_w
        return replace(
            self._given,
            cameras=state.cameras,
            R_cw=U @ Vt,
            center_w=state.center_w,
            phi=state.phi,
            velocity=state.velocity,
            variation=state.variation,
            bend=self.layout.values(state.bend, self._start.image_names),
            bend_clock=self._bend_clock,
            points_w=points_w,
            shutter_model=self._shutter_model,
        )

    def _kernel_args(self, state: State) -> tuple[Any, ...]:
        """Arguments of the kernels: model, cameras, photos, points, measurements and loss."""
        if state is not self._args_of:
            s, phi = self.structure, state.phi
            if self.layout.bent:
                values = self.layout.values(state.bend, self._start.image_names)
                phi = motion_tables(phi, values, self._bend_clock, state.R_cw)
            xy = observed_lens_pixels(state.cameras, self._start.camera_idx[s.frame_idx], self._xy)
            self._args_of, self._args = state, plain_arrays(
                *camera_arrays(self._start.camera_idx, state.cameras, state.variation),
                state.R_cw, state.center_w, phi, state.velocity, state.points_w,
                s.frame_idx, s.point_idx, xy, self._sigma_px / self._loss.root,
            )  # fmt: skip
        return self._model, *self._args, LOSSES[self._loss.kind], self._loss.root * self._loss.scale

    def _motion(self, state: State) -> Array:
        """(m, nb - 6) unknowns of the shutter."""
        if state.path is not None:
            return state.path.rates
        return np.hstack([state.phi, state.velocity])[:, : self._block - 6]

    def _own_motion(self, state: State) -> Array:
        """(m, nb - 6) what each photo's motion has of its own, beside the mean."""
        motion = self._motion(state)
        return motion if self.means is None else motion - self.means.at(state.means)

    def _motion_weight(self, state: State) -> Array:
        """(m, nb - 6) weights of the prior on what each photo's motion has of its own."""
        return self._motion_prior.weight(self._own_motion(state))

    def relative_information(self, state: State) -> Array:
        """`MotionPrior.relative_information` of rotations and velocities, (m, 0 to 2)."""
        return self._motion_prior.relative_information(self._own_motion(state))

    def _own(self, state: State) -> Array:
        """(m, k) unknowns behind those: variation and bends."""
        return np.hstack([state.variation[:, : self.layout.num_varying], state.bend])

    def _prior_cost(self, state: State) -> float:
        known = self._known_weight * (self._motion(state) - self._known) ** 2
        lengths = 2.0 * self._places.cost(state.center_w, state.points_w)
        lengths += float(np.sum(self._lengths.residuals(state.points_w) ** 2))
        varied = float(np.sum(self._own_weight * self._own(state) ** 2))
        own = 2.0 * self._motion_prior.cost(self._own_motion(state)) + float(known.sum()) + varied
        if self._path is not None and state.path is not None:
            own += 2.0 * self._path.cost(state.R_cw, state.center_w, state.path)
        return 0.5 * (own + lengths) + self._camera_priors(state)[2]

    def _camera_priors(self, state: State) -> tuple[Array, Array, float]:
        """Diagonal Hessian and gradient (cameras, nc) of the priors on the cameras, and their cost."""
        apart, slope = np.zeros((2, len(state.cameras), len(self._refine)))
        guessed = self._options.guessed
        if guessed is not None and self._refine:
            for k, (camera, guess, of) in enumerate(zip(state.cameras, guessed.cameras, guessed.sigmas, strict=True)):
                sigma = np.array([of.get(name, np.inf) for name in self._refine])
                apart[k], slope[k] = np.array(deviation(camera, guess, self._refine)) / sigma
        cost, weight = prior_weight(apart**2) if self._heavy_tails else (0.5 * apart**2, np.ones_like(apart))
        diagonal, gradient, total = slope**2 * weight, slope * apart * weight, float(cost.sum())
        if self.lens_fields is not None:
            values = self.lens_fields.values(state.cameras)
            diagonal = np.hstack([diagonal, np.full(values.shape, self._field_weight)])
            gradient = np.hstack([gradient, self._field_weight * values])
            total += 0.5 * self._field_weight * float((values**2).sum())
        if self.means is not None:
            pull = self.means.pull(self._motion_weight(state), self._motion(state), state.means)
            diagonal = np.hstack([diagonal, np.ones_like(state.means)])
            gradient = np.hstack([gradient, state.means + pull])
            total += 0.5 * float((state.means**2).sum())
        if self._path is not None and state.path is not None:
            weight, slope_of_pace = self._path.prior_on_pace(state.path, self._bounded)
            diagonal = np.hstack([diagonal, weight[:, None]])
            gradient = np.hstack([gradient, slope_of_pace[:, None]])
        return diagonal, gradient, total

    def _jacobians(self, state: State, spent: NormalEquations | None = None) -> tuple[Array, Array, float, Index]:
        """Weighted residuals (o, 2), Jacobians of the photos (o, 2, nb), the cost without priors, and who is left out.

        These measurements are singular, of points at the lens or moving along with the line that is read. Their weight
        would leave rounding of what the others say; with zeros for both they stay where they are, and say nothing.
        """
        o = len(self._xy)
        res, J_frame = spent.spend() if spent else (np.empty((o, 2)), np.empty((o, 2, self.layout.size)))
        cost = np.empty(-(-o // _CHUNK))
        with numba.parallel_chunksize(1):
            residuals.residual_blocks(
                *self._kernel_args(state), self._rows(state), self._block, self.layout.pieces, self.layout.ways, res,
                J_frame, cost,
            )  # fmt: skip
        if self._influence.kind != "squared":
            res *= self._influence.weight * self._influence.pull((res**2).sum(1))[:, None]
        if self._options.varying:
            J_frame[:, :, self._block : self.layout.variation] = self._by_lens(state)[1][..., : self.layout.num_varying]
        of_place = J_frame[:, :, 3:6]
        singular = np.flatnonzero(np.einsum("oia,oia->o", of_place, of_place) > self._loss.weight * self._most_change)
        res[singular], J_frame[singular] = 0.0, 0.0
        return res, J_frame, float(cost.sum()), singular

    def blocks(self, state: State) -> tuple[Array, Array]:
        """Weighted residuals (o, 2), and Jacobians of the photos (o, 2, nb)."""
        return self._jacobians(state)[:2]

    def _rows(self, state: State) -> Array:
        """(o,) where to look for the rows: as the last cost found them, if it was that of this state; else NaN."""
        if state is not self._clock_of:
            self._clock.fill(np.nan)
            self._clock_of = None
        return self._clock

    def linearize(self, state: State, spent: NormalEquations | None = None) -> NormalEquations:
        """Normal equations and cost at a state, written over those of `spent`: fresh memory takes time to get."""
        res, J_frame, cost, singular = self._jacobians(state, spent)
        prior_diag = np.zeros((len(state.phi), self.layout.size))
        prior_gradient = np.zeros_like(prior_diag)
        motion = self._motion(state)
        moving, own = np.s_[:, 6 : self._block], np.s_[:, self._block :]
        information = self._motion_prior.information(self._own_motion(state))
        prior_diag[moving] = information + self._known_weight
        prior_gradient[moving] = self._motion_weight(state) * self._own_motion(state)
        prior_gradient[moving] += self._known_weight * (motion - self._known)
        prior_diag[:, 3:6], prior_gradient[:, 3:6] = self._places.on_photos(state.center_w)
        prior_diag[own] = self._own_weight
        prior_gradient[own] = self._own_weight * self._own(state)
        total = cost + self._prior_cost(state)
        border = Border(self._camera_jacobians(state), self._start.camera_idx, *self._camera_priors(state)[:2])
        border.J[singular] = 0.0
        coupling = common = None
        if self.means is not None:
            border = replace(border, J=np.pad(border.J, ((0, 0), (0, 0), (0, state.means.shape[1]))))
            around = (0, 0), (6, self.layout.size - 12)
            common = CommonPrior(np.pad(information, around), np.pad(self.means.directions, (*around, (0, 0))))
        if self._path is not None and state.path is not None:
            f = self.structure.frame_idx
            pace, units = state.path.pace[self._start.camera_idx[f], None, None], np.exp(state.variation[f, :1])
            border.J[:, :, -1] = np.einsum("oia,oa->oi", J_frame[:, :, 6:12], units * state.path.rates[f])
            # a longer focal length is a slower clock
            J_frame[:, :, 12 : self.layout.variation] += border.J[:, :, -1:] * pace
            J_frame[:, :, 6:12] *= pace * units[..., None]
            joins, *by_ends = self._path.jacobians(state.R_cw, state.center_w, state.path)
            # the changes of the rates stand behind all that the measurements know
            of_own = np.zeros((*joins.shape, self.layout.size - 12))
            by_first, by_second = (np.concatenate([J[..., :12], of_own, J[..., 12:]], axis=2) for J in by_ends)
            coupling = Coupling(self._path.first, self._path.second, joins, by_first, by_second)
            of_changes = self._path.prior_on_changes(state.path)
            prior_diag, prior_gradient = (
                np.hstack(each) for each in zip((prior_diag, prior_gradient), of_changes, strict=True)
            )
        of_points = self._point_terms(state)
        return NormalEquations(
            self._elimination, total, res, J_frame, prior_diag, prior_gradient, border, of_points, coupling, common
        )

    def _point_terms(self, state: State) -> PointTerms:
        x = state.points_w
        rays = x - state.center_w[0] if self._rotation_only else None
        return PointTerms((self._lengths.residuals(x), self._lengths.jacobian(x)), rays, self._places.on_points(x))

    @property
    def shares(self) -> Mask:
        """(m, 6) which components of the photos' motions have a mean."""
        assert self.means is not None
        return np.asarray(self.means.directions.any(axis=2))

    @property
    def path(self) -> PathPrior:
        """The prior of the frames' path."""
        assert self._path is not None
        return self._path

    def fields(self, state: State, covariance: Array) -> tuple[Array, Array]:
        """Unknowns of the cameras' fields (cameras, nz), and their variances by all cameras' covariance (k, k)."""
        num = len(state.cameras)
        if self.lens_fields is None:
            return np.zeros((num, 0)), np.zeros((num, 0))
        values, own = self.lens_fields.values(state.cameras), len(self._refine)
        return values, np.diagonal(covariance).reshape(num, -1)[:, own : own + values.shape[1]]

    @property
    def measurements(self) -> tuple[Index, Index, Array]:
        """Photos (o,), points (o,) as in a state, and noise (o,) in pixels of the equations' measurements."""
        return self.structure.frame_idx, self.structure.point_idx, self._sigma_px

    @property
    def by_photo(self) -> list[Index]:
        """The equations' measurements of each photo."""
        return np.split(self.structure.frame_order, self.structure.frame_start[1:-1])

    def _camera_jacobians(self, state: State) -> Array:
        """Weighted Jacobians (o, 2, nc) of what is solved for of the cameras, with room for the pace of a path."""
        J, of_photo = self._by_lens(state)
        if self.lens_fields is None:
            return J
        # what a shift of the principal point does is what weighs a measurement
        camera = self._start.camera_idx[self.structure.frame_idx]
        weight = of_photo[:, :, 1:] / np.array([np.diag(each.K)[:2] for each in state.cameras])[camera, None]
        own = len(self._refine)
        return np.concatenate([J[:, :, :own], weight @ self._field_jacobian, J[:, :, own:]], axis=2)

    def _by_lens(self, state: State) -> tuple[Array, Array]:
        """Those by the intrinsics, without fields, and those by a photo's variation (o, 2, 3).

        The last are left empty (o, 2, 0) where nobody needs them.
        """
        if state is self._lens_of:
            return self._lens
        o, wanted = len(self._xy), self._options.varying or self.lens_fields is not None
        J = np.empty((o, 2, len(self._refine) + (self._path is not None)))
        of_photo = np.empty((o, 2, 3 * wanted))
        if self._refine or wanted:
            residuals.intrinsic_blocks(
                *self._kernel_args(state), self._rows(state), self._refine_codes, state.variation, J, of_photo
            )
        if self._options.varying:  # else nobody asks twice
            self._lens_of, self._lens = state, (J, of_photo)
        return J, of_photo

    def cost(self, state: State) -> float:
        """Half the robust sum of squares in units of the noise, with the priors."""
        cost = np.empty(-(-len(self._xy) // _CHUNK))
        with numba.parallel_chunksize(1):
            residuals.residual_costs(*self._kernel_args(state), self._clock, cost)
        self._clock_of = state
        return float(cost.sum()) + self._prior_cost(state)

    def settle(self, state: State, before: State | None = None) -> State:
        """The state with each point one Gauss-Newton step nearer to its measurements, where that lowers its cost.

        Points that came to lie behind a camera do not see the way back: they may return to where they were before.
        """
        cost = self._costs_of_points(state)
        if before is not None:
            state, cost = self._with_better_points(state, cost, before.points_w)
        steps = self._point_terms(state).steps(self.structure.track_start, *self.blocks(state))
        return self._with_better_points(
            state, cost, moved_points(state.points_w, steps, state.center_w[self._nearest])
        )[0]

    def _with_better_points(self, state: State, cost: Array, points_w: Array) -> tuple[State, Array]:
        """The state with those of other points (n, 3) whose measurements cost less, and costs (n,) of its points."""
        other = self._costs_of_points(replace(state, points_w=points_w))
        points_w = np.where((other < cost)[:, None], points_w, state.points_w)
        return replace(state, points_w=points_w), np.minimum(cost, other)

    def _costs_of_points(self, state: State) -> Array:
        """(n,) cost of the measurements of each point."""
        return np.asarray(np.bincount(self.structure.point_idx, self.costs(state), len(state.points_w)))

    def costs(self, state: State) -> Array:
        """(o,) cost of each of the equations' measurements."""
        cost = np.empty(len(self._xy))
        residuals.residual_costs(*self._kernel_args(state), self._clock, cost)
        self._clock_of = state
        return cost

    def retract(self, state: State, step: Step) -> State:
        """The state after a step."""
        frame, point, intrinsics = step
        cameras, own = state.cameras, len(self._refine)
        if self._refine:
            cameras = tuple(moved_camera(c, self._refine, s[:own]) for c, s in zip(cameras, intrinsics, strict=True))
        if self.lens_fields is not None:
            moved = self.lens_fields.moved
            last = intrinsics.shape[1] - (self._path is not None) - state.means.shape[1]
            cameras = tuple(moved(k, c, s[own:last]) for k, (c, s) in enumerate(zip(cameras, intrinsics, strict=True)))
        phi = state.phi + frame[:, 6:9] if self._block > 6 else state.phi
        velocity = state.velocity + frame[:, 9:12] if self._block > 9 else state.velocity
        variation = state.variation + self.layout.varied(frame)
        if (path := state.path) is not None:
            changes = path.changes + frame[:, self.layout.size :]
            path = PathState(path.rates + frame[:, 6:12], changes, path.pace + intrinsics[:, -1])
            phi, velocity = np.split(path.motions(self._start.camera_idx, variation), 2, axis=1)
        return State(
            cameras,
            Rotation.from_rotvec(frame[:, :3]).as_matrix() @ state.R_cw,
            state.center_w + frame[:, 3:6],
            phi,
            velocity,
            variation,
            state.bend + frame[:, self.layout.variation : self.layout.size],
            moved_points(state.points_w, point, state.center_w[self._nearest]),
            state.means + intrinsics[:, intrinsics.shape[1] - state.means.shape[1] :],
            path,
        )

    def step_size(self, state: State, step: Step) -> float:
        """Largest change: angles in radians, lengths in sizes of the scene, intrinsics in their own units."""
        frame, point, intrinsics = step
        frame = frame[:, : self.layout.size]
        ways = self.layout.size - 3 * self.layout.ways
        angles = np.abs(frame[:, [0, 1, 2, *range(6, min(self._block, 9)), *range(self._block, ways)]]).max()
        moved = np.abs(frame[:, [3, 4, 5, *range(9, self._block), *range(ways, frame.shape[1])]]).max() / self._size
        lengths = max(moved, largest_step(state.points_w, point, state.center_w.mean(0), self._size))
        own, last = len(self._refine), intrinsics.shape[1] - state.means.shape[1]
        of_fields = np.abs(intrinsics[:, own:last]).max(initial=0.0) / float(self._start.cameras[0].K[0, 0])
        return float(max(angles, lengths, np.abs(intrinsics[:, :own]).max(initial=0.0), of_fields))
