"""Normal equations of photos, points and shared intrinsics; the points are eliminated."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np

from .._kernels import schur
from .._kernels._jit import unknowns_of
from ..model.array_types import Array, Index
from .connections import Border, CommonPrior, Coupling
from .elimination import Elimination
from .point_terms import PointTerms
from .reduced import Factored, Reduced, factor

__all__ = ["PRIORS_ERROR", "Function", "Marginals", "NormalEquations", "Step"]

Step = tuple[Array, Array, Array]

# Of the priors' precision, for the derivative by it, which is off by at most the square.
_STEP = 2.0**-8
#: Relative error of the priors' shares, some times the square of that.
PRIORS_ERROR = 8 * _STEP**2


class Marginals(NamedTuple):
    """Covariances of unknowns, all others being free; 0 where held.

    Attributes
    ----------
    photos, cameras : (m, nb, nb), (k, k) array
        Of each photo's unknowns, and of the cameras'.
    photos_of_priors, cameras_of_priors : (m, nb, nb), (k, k) array
        The shares of these that are the priors' doing, H^-1 P H^-1: how far the priors' means are from the truth. The
        rest is noise.
    """

    photos: Array
    cameras: Array
    photos_of_priors: Array
    cameras_of_priors: Array


@dataclass(frozen=True)
class Function:
    """Uncertainty of a linear function of the points.

    Attributes
    ----------
    variance, of_priors : float
        Its variance, and the share of that that is the priors' doing.
    with_photos, with_photos_of_priors : (m, nb) array
        Its covariance with the photos' unknowns, and the priors' share of that.
    with_cameras : (k,) array
        Its covariance with the unknowns of all cameras.
    """

    variance: float
    of_priors: float
    with_photos: Array
    with_photos_of_priors: Array
    with_cameras: Array

    def inflated(self, by: float) -> tuple[float, Array]:
        """Variance, and covariance with the photos, where the noise's share of the deviations is so much larger."""
        variance = self.of_priors + by**2 * (self.variance - self.of_priors)
        return variance, self.with_photos_of_priors + by**2 * (self.with_photos - self.with_photos_of_priors)


class NormalEquations:
    """Block normal equations at one state; `solve` eliminates the points and solves for the photos.

    Parameters
    ----------
    elimination : Elimination
        Which photo sees which point, and how the reduced system is solved.
    cost : float
        Cost at the state.
    res, J_frame : (o, 2), (o, 2, seen) array
        Weighted residuals and Jacobians, of the first unknowns of the photos, to which only priors may add; that of
        the point is minus that of the centre.
    prior_diag, prior_gradient : (m, nb) array
        Diagonal Hessian and gradient of the priors of the photos.
    border : Border
        What the photos share.
    of_points : PointTerms
        What is known of the points. Lengths connect them, which the elimination takes one by one, so their share of the
        Hessian is added to its inverse (Woodbury).
    coupling : Coupling, optional
        Prior that connects pairs of photos; the structure's pattern has their blocks.
    common : CommonPrior, optional
        Which of the photos' priors have means that are the last unknowns of their cameras. Their weights and gradients
        are in `prior_diag` and `prior_gradient`, and in those of the border.

    Attributes
    ----------
    blocks : tuple of array
        res and J_frame.
    num_photos, num_cameras, num_shared : int
        Number of photos, of cameras, and of unknowns of all cameras.
    """

    def __init__(
        self,
        elimination: Elimination,
        cost: float,
        res: Array,
        J_frame: Array,
        prior_diag: Array,
        prior_gradient: Array,
        border: Border,
        of_points: PointTerms,
        coupling: Coupling | None = None,
        common: CommonPrior | None = None,
    ) -> None:
        self.cost = cost
        self._elimination = elimination
        s = self._s = elimination.structure
        nb = prior_diag.shape[1]
        self._J = J_frame
        self.blocks = res, J_frame
        self._num_unseen = nb - J_frame.shape[2]
        self._unknowns = unknowns_of(J_frame.shape[2])
        self._prior_diag, self._prior_gradient = prior_diag, prior_gradient
        self._V, self._g_point = of_points.blocks(s.track_start, res, J_frame)
        self._diagonal, self._g_frame = (self._wide(each) for each in self._gradients(res, J_frame))
        self._diagonal += prior_diag
        self._g_frame += prior_gradient
        self._coupling = coupling
        if coupling is not None:
            m = len(prior_diag)
            self._diagonal += coupling.diagonal(m)
            self._g_frame += coupling.pull(coupling.res, m)
        self._border = border
        diagonal, g_camera = self._gradients(res, border.J)
        self._camera_diagonal = border.sum_photos(diagonal)
        self._g_camera = border.sum_photos(g_camera) + border.prior_gradient.ravel()
        self._common = common
        self._lengths = of_points.lengths[1]
        self.num_photos, self.num_cameras, self.num_shared = len(prior_diag), border.num_cameras, len(self._g_camera)

    def spend(self) -> tuple[Array, Array]:
        """The blocks, for others to be written over them; no more can be asked, and all else as large is given up."""
        del self._J, self._border
        return self.blocks

    def _wide(self, values: Array) -> Array:
        """Photos' values (..., m, measured) with zeros for the unknowns that no measurement sees."""
        if not self._num_unseen:
            return values
        wide = np.zeros((*values.shape[:-1], values.shape[-1] + self._num_unseen))
        wide[..., : values.shape[-1]] = values
        return wide

    def _seen(self, values: Array) -> Array:
        """Photos' values (..., m, nb) of the unknowns that measurements see."""
        return values[..., : values.shape[-1] - self._num_unseen]

    def _gradients(self, res: Array, J: Array) -> tuple[Array, Array]:
        """Diagonal of J'J and J'res, summed over each photo (m, unknowns)."""
        s = self._s
        diagonal, gradient = np.zeros((2, len(s.frame_start) - 1, J.shape[2]))
        if J.shape[2]:
            with numba.parallel_chunksize(1):
                schur.frame_gradients(s.frame_start, s.frame_order, res, J, diagonal, gradient)
        return diagonal, gradient

    def reduce(
        self, damping: float, g_frame: Array | None = None, g_point: Array | None = None, g_camera: Array | None = None
    ) -> tuple[Reduced, Array]:
        """The damped system without the points, and V^-1 (n, 3, 3); for another gradient than its own, if given."""
        s = self._s
        g_frame = self._g_frame if g_frame is None else g_frame
        g_point = self._g_point if g_point is None else g_point
        g_camera = self._g_camera if g_camera is None else g_camera
        m, nb = g_frame.shape
        V_inv = np.empty_like(self._V)
        schur.invert_points(self._V, damping, V_inv)
        seen = nb - self._num_unseen
        S = np.empty((len(s.pattern.cols), seen, seen))
        rhs = np.empty((m, seen))
        diagonal = self._prior_diag + damping * self._diagonal
        with numba.parallel_chunksize(1):
            schur.reduced_system(
                self._unknowns, s.frame_start, s.frame_order, s.frame_idx, s.point_idx, s.track_start,
                s.pattern.row_start, s.pattern.cols, self._J, V_inv, g_point,
                np.ascontiguousarray(self._seen(g_frame)), np.ascontiguousarray(self._seen(diagonal)), S, rhs,
            )  # fmt: skip
        if self._num_unseen:
            measured, S = S, np.zeros((len(S), nb, nb))
            S[:, :seen, :seen] = measured
            own = np.arange(seen, nb)
            S[s.pattern.diagonal[:, None], own, own] = diagonal[:, seen:]
            rhs = np.hstack([rhs, g_frame[:, seen:]])
        if self._coupling is not None:
            self._coupling.add_to(S, s.pattern)
        nc = self._border.J.shape[2]
        k = len(g_camera)
        rows, rhs_camera = np.zeros((m, seen + nc, k)), np.zeros((m, nc))
        if nc:
            with numba.parallel_chunksize(1):
                schur.border_rows(
                    s.frame_start, s.frame_order, s.frame_idx, s.point_idx, s.track_start,
                    self._border.camera_of_frame, self._J, self._border.J, V_inv, g_point, rows, rhs_camera,
                )  # fmt: skip
        if self._common is not None:
            rows += self._common_rows
        # nothing pulls at a camera that took none of the photos, whatever holds it
        unused = np.repeat(np.bincount(self._border.camera_of_frame, minlength=self._border.num_cameras) == 0, nc)
        held = self._border.prior_diag.ravel() + damping * self._camera_diagonal + unused
        corner = self._border.sum_photos(rows[:, seen:]) + np.diag(held)
        border = np.where(self._elimination.free, self._wide(rows[:, :seen].transpose(2, 0, 1)), 0.0)
        c = -g_camera - self._border.sum_photos(rhs_camera)
        return Reduced(S, -rhs, border, (corner + corner.T) / 2, c), V_inv

    @cached_property
    def _common_rows(self) -> Array:
        """(m, nb + nc, k) what means of priors add to the Hessian: of photos by all cameras, of cameras by these."""
        assert self._common is not None
        weight, J = self._common
        h, nc, own = J.shape[2], self._border.J.shape[2], self._border.camera_of_frame
        m, nb = weight.shape
        rows = np.zeros((m, nb + nc, self.num_shared))
        columns = own[:, None] * nc + np.arange(nc - h, nc)
        pull = weight[:, :, None] * J
        photo = np.arange(m)[:, None]
        rows[photo, :nb, columns] = -pull.transpose(0, 2, 1)
        rows[photo, nb + nc - h :, columns] = np.einsum("mah,mag->mgh", J, pull).transpose(0, 2, 1)
        return rows

    @cached_property
    def _reduced(self) -> Reduced:
        """The system without the points, not damped."""
        return self.reduce(0.0)[0]

    @cached_property
    def inverse(self) -> Factored | None:
        """The inverse of the whole system, for photos and cameras; None where it cannot be factored."""
        reduced = self._reduced
        del self._reduced  # as large as the factor
        factored = factor(reduced, self._elimination.shape)
        del reduced
        if factored is None or not len(self._lengths):
            return factored
        frame, _, camera, inner = self._of_lengths(0.0, exact=True)
        return factored.joined(frame, camera, -inner)

    def marginal_covariances(self, of_priors: bool = True) -> Marginals:
        """Covariances of the unknowns of each photo and of all cameras, all others being free.

        0 where held; NaN where the system cannot be factored. The priors' shares H^-1 P H^-1 are by how much the
        covariances fall as the priors' precision P grows: a difference of two that are a little looser and tighter.
        They are 0 unless asked for (`of_priors`), since they take twice the time of the rest.
        """
        if not of_priors:
            found = self._covariances()
            return Marginals(*found, *(np.zeros_like(each) for each in found))
        # its own inverse, which is kept, comes last: one factor in memory at a time
        looser, tighter = (self._with_priors(1.0 + by)._covariances() for by in (-_STEP, _STEP))
        shares = [(a - b) / (2 * _STEP) for a, b in zip(looser, tighter, strict=True)]
        return Marginals(*self._covariances(), *shares)

    def _covariances(self) -> tuple[Array, Array]:
        """Covariances of photos (m, nb, nb) and of all cameras (k, k)."""
        if self.inverse is None:
            free = self._elimination.free[:, : self._J.shape[2]]
            return np.where(free[:, :, None] & free[:, None], np.nan, 0.0), np.full((self.num_shared,) * 2, np.nan)
        photos, cameras = self.inverse.diagonal_blocks()
        return self._seen(photos)[:, : photos.shape[1] - self._num_unseen], cameras

    def photos_by_shared(self, last: int) -> Array:
        """(m, nb, last) covariances of photos' unknowns with the last that each shares with those of its camera."""
        border = self._border
        if self.inverse is None:
            return np.full((*self._seen(self._g_frame).shape, last), np.nan)
        end = (border.camera_of_frame + 1)[:, None] * border.J.shape[2]
        columns = end + np.arange(-last, 0)
        found = self.inverse.photos_by_cameras()[np.arange(self.num_photos)[:, None], :, columns]
        return self._seen(found).swapaxes(1, 2)

    def coupling_variances(self) -> tuple[Array, Array]:
        """Residuals (q, r) of the coupling, and their variances, all unknowns being free."""
        c = self._coupling
        assert c is not None
        if self.inverse is None:
            return c.res, np.full_like(c.res, np.nan)
        ends = (c.first, c.J_first), (c.second, c.J_second)
        variances = np.zeros_like(c.res)
        for photo, J in ends:
            for other, J_other in ends:
                variances += np.einsum("qra,qab,qrb->qr", J, self.inverse.pair_blocks(photo, other), J_other)
        return c.res, variances

    def _with_priors(self, scale: float, by_cameras: float | None = None) -> NormalEquations:
        """The equations with the priors' precision multiplied; for their inverse only, since gradients are not.

        That of the cameras' own unknowns by another factor, if one is given.
        """
        other = copy(self)
        other.__dict__.pop("inverse", None)
        other._prior_diag = scale * self._prior_diag
        by_cameras = scale if by_cameras is None else by_cameras
        other._border = replace(self._border, prior_diag=by_cameras * self._border.prior_diag)
        S, (diagonal, own) = self._reduced.S.copy(), (self._s.pattern.diagonal, np.arange(self._prior_diag.shape[1]))
        S[diagonal[:, None], own, own] += (scale - 1.0) * self._prior_diag
        if self._coupling is not None:
            self._coupling.add_to(S, self._s.pattern, scale - 1.0)
        corner = self._reduced.corner + np.diag((by_cameras - 1.0) * self._border.prior_diag.ravel())
        border = self._reduced.border
        if self._common is not None:
            nb = self._prior_diag.shape[1]
            of_photos, of_cameras = np.split((scale - 1.0) * self._common_rows, [nb], axis=1)
            border = border + np.where(self._elimination.free, of_photos.transpose(2, 0, 1), 0.0)
            corner = corner + self._border.sum_photos(of_cameras)
        other._reduced = replace(self._reduced, S=S, border=border, corner=corner)
        return other

    def covariance(self, vectors: Array, inflation: float = 1.0) -> Array:
        """Covariance of the photos' unknowns, all others being free, times vectors (k, m, nb).

        With `inflation` the noise's share of the deviations is so much larger; that of the priors stays.
        """
        if self.inverse is None:
            return np.full_like(vectors, np.nan)
        found = self.inverse.times(self._wide(vectors), np.zeros((len(vectors), len(self._g_camera))))
        if inflation == 1.0:
            return self._seen(found[0])
        # H^-1 P H^-1, P the priors' precision
        by, by_priors = inflation**2, self.inverse.times(*self._of_priors(*found))[0]
        return by * self._seen(found[0]) + (1 - by) * self._seen(by_priors)

    def times(self, frame: Array, camera: Array) -> tuple[Array, Array]:
        """H^-1 times stacks of photos' values (k, m, seen) and of cameras' (k, unknowns); NaN without an inverse."""
        if self.inverse is None:
            return np.full_like(frame, np.nan), np.full_like(camera, np.nan)
        found = self.inverse.times(self._wide(frame), camera)
        return self._seen(found[0]), found[1]

    def _of_priors(self, frame: Array, camera: Array) -> tuple[Array, Array]:
        """The priors' precision times stacks of photos' values (n, m, nb) and of cameras' (n, k)."""
        by_frame, by_camera = self._prior_diag * frame, self._border.prior_diag.ravel() * camera
        if self._coupling is not None:
            by_frame += self._coupling.times(frame)
        if self._common is not None:
            of_photos, of_cameras = np.split(self._common_rows, [frame.shape[2]], axis=1)
            by_frame += np.einsum("mak,nk->nma", of_photos, camera)
            by_camera += np.einsum("mak,nma->nk", of_photos, frame)
            by_camera += camera @ self._border.sum_photos(of_cameras)
        return by_frame, by_camera

    def function_of_points(self, weights: Array) -> Function | None:
        """Uncertainty of sum(weights * points), weights (n, 3); None where the system cannot be factored."""
        zero = np.zeros_like(self._g_frame), np.zeros_like(self._g_camera)
        solved = self._solve(0.0, zero[0], -weights, zero[1], exact=True)
        if solved is None or self.inverse is None:
            return None
        frame, point, camera = solved[:3]
        of_frame, of_camera = self._of_priors(frame[None], camera[None])
        return Function(
            variance=float((weights * point).sum()),
            of_priors=float((of_frame[0] * frame).sum() + (of_camera[0] * camera).sum()),
            with_photos=self._seen(frame),
            with_photos_of_priors=self._seen(self.inverse.times(of_frame, of_camera)[0][0]),
            with_cameras=camera,
        )

    def _moved(self, frame: Array, point: Array, camera: Array) -> Array:
        """Changes (o, 2) of the residuals with a step of photos (m, nb), points (n, 3) and all cameras (k,)."""
        f, border = self._s.frame_idx, self._border
        own = camera.reshape(border.num_cameras, -1)[border.camera_of_frame[f]]
        moved: Array = np.einsum("oia,oa->oi", self._J, self._seen(frame)[f]) + np.einsum("oia,oa->oi", border.J, own)
        return moved - np.einsum("oia,oa->oi", self._J[:, :, 3:6], point[self._s.point_idx])

    def released(self, scale: float) -> tuple[NormalEquations, Array]:
        """Equations whose photos' priors have a precision so much smaller, and residuals (o, 2) of their solution.

        From an optimum, by one linear step. The equations are for their inverse only, as those of `_with_priors`; they
        themselves, and their residuals, where the system cannot be factored.
        """
        other = self._with_priors(scale, 1.0)
        if other.inverse is None:
            return self, self.blocks[0]
        # the gradient without that share of the priors; at the optimum there is none of means but by these
        g_frame, g_camera = (scale - 1.0) * self._prior_gradient, np.zeros(self.num_shared)
        if self._common is not None:
            g_camera -= self._border.sum_photos(self._of_means(g_frame))
        V_inv = np.empty_like(self._V)
        schur.invert_points(self._V, 0.0, V_inv)
        frame, camera = other.inverse.solve(-g_frame, -g_camera)
        point = self._point_steps(V_inv, np.zeros_like(self._g_point), frame, camera)
        return other, self.blocks[0] + self._moved(frame, point, camera)

    def _of_means(self, by_photos: Array) -> Array:
        """Gradients (m, nc) by the unknowns of each photo's camera, of those (m, nb) of priors that have means."""
        assert self._common is not None
        J = self._common.J
        by_mean = np.zeros((len(by_photos), self._border.J.shape[2]))
        by_mean[:, -J.shape[2] :] = np.einsum("mah,ma->mh", J, by_photos)
        return by_mean

    def residuals_of(self, noise: Array, of_photos: Array, of_cameras: Array, rng: np.random.Generator) -> Array:
        """Residuals (o, 2) that a fit would leave of noise (o, 2), the priors' means being off, too.

        These by so many of their standard deviations, of_photos (m, nb) and of_cameras (k,), and those of a path by
        what is drawn. Known lengths are right.
        """
        assert self.inverse is not None
        g_point, V = np.empty_like(self._g_point), np.empty_like(self._V)
        schur.point_blocks(self._s.track_start, noise, self._J, V, g_point)
        V_inv = np.empty_like(self._V)
        schur.invert_points(self._V, 0.0, V_inv)
        by_frame, by_camera = self._without_points(V_inv, noise, np.zeros(len(noise), np.int64), 1)
        g_frame = self._wide(by_frame[0]) + np.sqrt(self._prior_diag) * self._wide(of_photos)
        if self._coupling is not None:
            g_frame += self._coupling.pull(rng.normal(size=self._coupling.res.shape), len(g_frame))
        g_camera = by_camera[0] + np.sqrt(self._border.prior_diag.ravel()) * of_cameras
        if self._common is not None:
            off = np.sqrt(self._common.weight) * self._wide(of_photos)
            g_camera -= self._border.sum_photos(self._of_means(off))
        frame, camera = self.inverse.solve(-g_frame, -g_camera)
        point = self._point_steps(V_inv, g_point, frame, camera)
        return noise + self._moved(frame, point, camera)

    def group_pulls(self, residuals: Array, group: Index, num_groups: int) -> tuple[Array, Array]:
        """How far groups of residuals (o, 2) pull photos (num_groups, m, nb) and cameras (num_groups, k).

        That is H^-1 of each group's share of the gradient, points eliminated; group (o,) is the group of each.
        """
        V_inv = np.empty_like(self._V)
        schur.invert_points(self._V, 0.0, V_inv)
        return self.times(*self._without_points(V_inv, residuals, group, num_groups))

    def _without_points(self, V_inv: Array, residuals: Array, group: Index, num_groups: int) -> tuple[Array, Array]:
        """Shares of groups of residuals in the gradient, points eliminated: (num_groups, m, seen), (num_groups, k)."""
        s, border = self._s, self._border
        m, nb, nc = len(self._g_frame), self._J.shape[2], border.J.shape[2]
        g_frame, g_camera = np.empty((m, num_groups, nb)), np.empty((m, num_groups, nc))
        schur.group_gradients(
            s.frame_start, s.frame_order, s.point_idx, s.track_start, residuals, self._J, border.J, V_inv,
            group, g_frame, g_camera,
        )  # fmt: skip
        return g_frame.transpose(1, 0, 2), border.sum_photos(g_camera.transpose(0, 2, 1)).T

    def length_pulls(self) -> tuple[Array, Array]:
        """The same of known lengths (q, m, nb) and (q, k), each wrong by its standard deviation."""
        inverse = self.inverse
        assert inverse is not None
        # H^-1 J' = (H - J'J)^-1 J' (1 + J (H - J'J)^-1 J')^-1: the last of the inverse's changes
        last = slice(len(inverse.weights) - len(self._lengths), None)
        inner = -inverse.weights[last, last]
        return self._seen(np.tensordot(inner, inverse.frames[last], 1)), inner @ inverse.cameras[last]

    def solve(self, damping: float) -> tuple[Step, float] | None:
        """Step of the photos (m, nb), points (n, 3) and cameras (c, nc), and the decrease of cost that it predicts."""
        solved = self._solve(damping, self._g_frame, self._g_point, self._g_camera)
        if solved is None:
            return None
        frame, point, camera, residual, camera_residual = solved
        # of the system that was solved: an unfinished solution leaves (H + damping D) step + g = -residual.
        # Sums, not np.vdot: threads of BLAS that wait for work take the processors from ours
        diag_point = np.diagonal(self._V, axis1=1, axis2=2)
        predicted = 0.5 * float(
            (frame * (damping * self._diagonal * frame - self._g_frame + residual)).sum()
            + (point * (damping * diag_point * point - self._g_point)).sum()
            + (camera * (damping * self._camera_diagonal * camera - self._g_camera + camera_residual)).sum()
        )
        return (frame, point, camera.reshape(self._border.num_cameras, self._border.J.shape[2])), predicted

    def _solve(
        self, damping: float, g_frame: Array, g_point: Array, g_camera: Array, exact: bool = False
    ) -> tuple[Array, Array, Array, Array, Array] | None:
        """Solution of the photos, points and cameras for a gradient, with the residuals of photos and cameras."""
        solved = self._solve_without_lengths(damping, g_frame, g_point, g_camera, exact)
        if solved is None or not len(self._lengths):
            return solved
        frame, point, camera, *residuals = solved
        of_lengths = self._of_lengths(damping, exact)
        share = of_lengths[3] @ np.einsum("qna,na->q", self._lengths, point)
        frame, point, camera = (
            x - np.tensordot(share, u, 1) for x, u in zip((frame, point, camera), of_lengths[:3], strict=True)
        )
        return frame, point, camera, residuals[0], residuals[1]

    def _of_lengths(self, damping: float, exact: bool) -> tuple[Array, Array, Array, Array]:
        """H^-1 J' of the lengths' Jacobian J, for photos, points and cameras, and (1 + J H^-1 J')^-1."""
        zero = np.zeros_like(self._g_frame), np.zeros_like(self._g_camera)
        columns = [self._solve_without_lengths(damping, zero[0], -J, zero[1], exact) for J in self._lengths]
        if any(column is None for column in columns):
            nan = np.nan
            q = len(columns)
            return (
                np.full((q, *zero[0].shape), nan), np.full((q, *self._g_point.shape), nan),
                np.full((q, *zero[1].shape), nan), np.full((q, q), nan),
            )  # fmt: skip
        frame, point, camera = (np.array([column[k] for column in columns if column is not None]) for k in range(3))
        inner = np.linalg.inv(np.eye(len(columns)) + np.einsum("qna,pna->qp", self._lengths, point))
        return frame, point, camera, inner

    def _solve_without_lengths(
        self, damping: float, g_frame: Array, g_point: Array, g_camera: Array, exact: bool
    ) -> tuple[Array, Array, Array, Array, Array] | None:
        """`_solve` for the measurements and priors alone."""
        reduced, V_inv = self.reduce(damping, g_frame, g_point, g_camera)
        solved = self._elimination.solve(reduced, exact)
        if solved is None:
            return None
        frame, camera, residual, camera_residual = solved
        point = self._point_steps(V_inv, g_point, frame, camera)
        if not all(np.isfinite(part).all() for part in (frame, point, camera)):
            return None
        return frame, point, camera, residual, camera_residual

    def _point_steps(self, V_inv: Array, g_point: Array, frame: Array, camera: Array) -> Array:
        """Steps (n, 3) of the points that go with those of photos and cameras."""
        point = np.empty_like(g_point)
        schur.back_substitute(
            self._s.track_start, self._s.frame_idx, V_inv,
            self._pulled(g_point, camera), self._J, np.ascontiguousarray(self._seen(frame)), point,
        )  # fmt: skip
        return point

    def _pulled(self, g_point: Array, step_camera: Array) -> Array:
        """Gradient of the points (n, 3) after a step of all cameras (k,)."""
        if not step_camera.size:
            return g_point
        s = self._s
        steps = step_camera.reshape(self._border.num_cameras, -1)
        V, pull = np.empty_like(self._V), np.empty_like(g_point)
        moved = np.einsum("oij,oj->oi", self._border.J, steps[self._border.camera_of_frame[s.frame_idx]])
        schur.point_blocks(s.track_start, moved, self._J, V, pull)
        return g_point + pull
