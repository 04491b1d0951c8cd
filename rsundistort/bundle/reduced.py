"""The reduced system of the photos, bordered by what they share.

Elimination of the points, then an envelope factorised, or conjugate gradients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee

from .._kernels import schur

__all__ = ["Border", "Elimination", "NormalEquations", "Structure", "by_first_photo"]

# Right-hand sides of the inverse that are held at once: 192 in a system of 10,000 photos are 180 MB.
_COLUMNS = 192
# Bands (of four unknowns) of the envelope that threads share: wide enough to be worth meeting for.
_PANEL = 48
# Below these multiply-adds (30 ms of one thread) the factor is one panel: on a busy machine meetings cost more.
_WORTH_THREADS = 3e8
# Photos that the preconditioner of the conjugate gradients solves for together.
_CLUSTER = 32
_MAX_CG = 500

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Step = tuple[Array, Array, Array]


def by_first_photo(frame_idx: Index, point_idx: Index, num_frames: int, num_points: int) -> Index:
    """Points in the order of the first photo that sees each."""
    first = np.full(num_points, num_frames)
    np.minimum.at(first, point_idx, frame_idx)
    return np.argsort(first, kind="stable")


@dataclass(frozen=True)
class Structure:
    """Which photo sees which point: fixed while a problem is solved.

    Attributes
    ----------
    order : (o,) int array
        The observations as they were given, by track and then by photo; tracks by their first photo, so that what a
        photo sees lies together. All else is in this order.
    frame_idx, point_idx, track_idx : (o,) int array
        Photo, point and track.
    track_start, point_of : (n + 1,), (n,) int array
        Ranges of the tracks in the observations, and their points.
    frame_start, frame_order : (m + 1,), (o,) int array
        The observations of each photo.
    row_start, cols : (m + 1,), (blocks,) int array
        Upper triangle of the reduced system in block rows.
    """

    order: Index
    frame_idx: Index
    point_idx: Index
    track_idx: Index
    track_start: Index
    point_of: Index
    frame_start: Index
    frame_order: Index
    row_start: Index
    cols: Index

    @classmethod
    def from_observations(cls, frame_idx: Index, point_idx: Index, num_frames: int, num_points: int) -> Structure:
        """Structure of observations in any order."""
        point_of = by_first_photo(frame_idx, point_idx, num_frames, num_points)
        track = np.empty(num_points, np.int64)
        track[point_of] = np.arange(num_points)
        order = np.argsort(track[point_idx] * num_frames + frame_idx, kind="stable")
        frame_idx, point_idx = frame_idx[order], point_idx[order]
        track_idx = track[point_idx]
        track_start = np.searchsorted(track_idx, np.arange(num_points + 1))
        frame_order = np.argsort(frame_idx, kind="stable")
        frame_start = np.concatenate([[0], np.cumsum(np.bincount(frame_idx, minlength=num_frames))])
        counts = np.empty(num_frames, np.int64)
        lists = (frame_start, frame_order, frame_idx, track_idx, track_start)
        schur.covisible_counts(*lists, counts)
        row_start = np.concatenate([[0], np.cumsum(counts)])
        cols = np.empty(row_start[-1], np.int64)
        schur.covisible_columns(*lists, row_start, cols)
        return cls(
            order, frame_idx, point_idx, track_idx, track_start, point_of, frame_start, frame_order, row_start, cols
        )  # fmt: skip


@dataclass(frozen=True)
class Envelope:
    """Where the factor of a symmetric matrix has entries: each row from its first column to the diagonal.

    Attributes
    ----------
    place : (m, nb) int array
        Row of each photo's unknowns; -1 where held.
    size : int
        Number of unknowns.
    first, offset : (bands,) int array
        First column of each band of four rows, and where the band begins in the data.
    num_values : int
        Length of the data.
    kept : (blocks,) bool array
        Blocks of the matrix that lie inside.
    multiply_adds : float
        What the factorisation takes.
    """

    place: Index
    size: int
    first: Index
    offset: Index
    num_values: int
    kept: NDArray[np.bool_]
    multiply_adds: float

    @classmethod
    def of(cls, structure: Structure, free: NDArray[np.bool_], photos: Index, cluster: int = 0) -> Envelope:
        """Envelope of the free unknowns with the photos in an order; cut into diagonal blocks of `cluster` photos."""
        m, nb = free.shape
        size = int(free.sum())
        begin = np.concatenate([[0], np.cumsum(free[photos].sum(1))])  # row of each photo's first unknown
        rank = np.empty(m, np.int64)
        rank[photos] = np.arange(m)
        place = np.full((m, nb), -1)
        place[photos] = np.where(free[photos], begin[:-1, None] + np.cumsum(free[photos], axis=1) - 1, -1)
        rows = np.repeat(rank, np.diff(structure.row_start))
        cols = rank[structure.cols]
        leftmost = np.arange(m)
        np.minimum.at(leftmost, np.maximum(rows, cols), np.minimum(rows, cols))
        kept = np.ones(len(rows), bool)
        if cluster:
            leftmost = np.maximum(leftmost, np.arange(m) // cluster * cluster)
            # a band of four rows can reach over the border of two clusters: half a coupling is not positive
            kept = rows // cluster == cols // cluster
        bands = (size + 3) // 4
        first_of_row = np.concatenate([np.repeat(begin[leftmost], np.diff(begin)), np.full(4 * bands - size, size)])
        first = np.minimum(first_of_row.reshape(bands, 4).min(1), 4 * np.arange(bands)) // 4 * 4
        width = 4 * np.arange(1, bands + 1) - first
        offset = np.concatenate([[0], np.cumsum(4 * width)])
        return cls(
            place, size, first, offset[:-1], int(offset[-1]), kept, float((2.0 * width.astype(float) ** 2).sum())
        )

    def factor(self, structure: Structure, S: Array) -> Callable[[Array], None] | None:
        """Solver in place of right-hand sides (k, padded rows), of the blocks inside the envelope; None if it fails."""
        scale = np.ones(4 * len(self.first))
        diagonal = np.diagonal(S[structure.row_start[:-1]], axis1=1, axis2=2)
        free = self.place >= 0
        # unit diagonal: angles, centres and phi differ by orders of magnitude
        scale[self.place[free]] = 1.0 / np.sqrt(np.maximum(diagonal[free], 1e-300))
        data = np.empty(self.num_values)
        schur.fill_envelope(
            self.place, structure.row_start, structure.cols, self.kept, S, scale, self.first, self.offset, data
        )  # fmt: skip
        panel = _PANEL if self.multiply_adds > _WORTH_THREADS else max(len(self.first), 1)
        if not schur.factor_envelope(self.first, self.offset, panel, data):
            return None

        def solve(B: Array) -> None:
            B *= scale
            schur.solve_envelope(self.first, self.offset, data, B)
            B *= scale

        return solve

    def gather(self, x: Array) -> Array:
        """Values of the photos (k, m, nb) as right-hand sides (k, padded rows)."""
        B = np.zeros((len(x), 4 * len(self.first)))
        free = self.place >= 0
        B[:, self.place[free]] = x[:, free]
        return B

    def scatter(self, B: Array) -> Array:
        """Right-hand sides (k, padded rows) as values of the photos (k, m, nb); 0 where held."""
        return np.where(self.place >= 0, B[:, self.place], 0.0)


@dataclass(frozen=True)
class Reduced:
    """The reduced system of the photos, bordered by the k unknowns that they share: [[S, B'], [B, C]] [x; y] = [b; c].

    Attributes
    ----------
    S : (blocks, nb, nb) array
        Upper triangle of blocks of the photos.
    b : (m, nb) array
        Right-hand side of the photos.
    border, corner, c : (k, m, nb), (k, k), (k,) array
        B, C and the right-hand side of the cameras.
    """

    S: Array
    b: Array
    border: Array
    corner: Array
    c: Array


@dataclass(frozen=True)
class Border:
    """Intrinsics that photos share: nc unknowns of each camera.

    Attributes
    ----------
    J : (o, 2, nc) array
        Weighted Jacobians of the observations, nc may be 0.
    camera_of_frame : (m,) int array
        Camera of each photo.
    prior_diag, prior_gradient : (cameras, nc) array
        Diagonal Hessian and gradient of the priors of the cameras.
    """

    J: Array
    camera_of_frame: Index
    prior_diag: Array
    prior_gradient: Array

    @property
    def num_cameras(self) -> int:
        """Number of cameras."""
        return len(self.prior_diag)

    def sum_photos(self, x: Array) -> Array:
        """Values of the photos (m, nc, ...) summed over those of each camera, (cameras * nc, ...)."""
        total = np.zeros((self.num_cameras, *x.shape[1:]))
        np.add.at(total, self.camera_of_frame, x)
        return total.reshape(self.num_cameras * x.shape[1], *x.shape[2:])


def _products(A: Array, B: Array) -> Array:
    """(i, j) inner products of stacks of photos' values; not of BLAS, whose waiting threads take our processors."""
    result: Array = np.einsum("ima,jma->ij", A, B)
    return result


def _positive_inverse(A: Array) -> Array | None:
    """Inverse of a small symmetric matrix with unknowns of different scale; None if it is not positive."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(A), 1e-300))
    try:
        L = np.linalg.cholesky(scale[:, None] * A * scale)
    except np.linalg.LinAlgError:
        return None
    half = np.linalg.inv(L) * scale
    inverse: Array = half.T @ half
    return inverse


@dataclass(frozen=True)
class Factored:
    """A reduced system that is factored: for as many right-hand sides as one likes.

    Attributes
    ----------
    envelope : Envelope
        Where its factor has entries.
    solve_rows : callable
        Solves for right-hand sides (k, padded rows) in place, the cameras being held.
    border : (k, m, nb) array
        Of the reduced system.
    border_solved : (k, m, nb) array
        S^-1 B': what a change of the cameras does to the photos, up to its sign.
    cameras : (k, k) array
        Covariance of the cameras' unknowns.
    """

    envelope: Envelope
    solve_rows: Callable[[Array], None]
    border: Array
    border_solved: Array
    cameras: Array

    def solve_photos(self, b: Array) -> Array:
        """S^-1 b for stacks (k, m, nb): the cameras being held."""
        rows = self.envelope.gather(b)
        self.solve_rows(rows)
        return self.envelope.scatter(rows)

    def covariance_times(self, vectors: Array) -> Array:
        """Covariance of the photos' unknowns, the cameras being free, times vectors (k, m, nb)."""
        found = self.solve_photos(vectors)
        return found + np.tensordot(_products(found, self.border) @ self.cameras, self.border_solved, 1)


@dataclass(frozen=True)
class Elimination:
    """How the reduced system of a structure is solved: fixed while a problem is solved.

    Attributes
    ----------
    structure : Structure
        Which photo sees which point.
    free : (m, nb) bool array
        Unknowns that are not held.
    envelope : Envelope
        Of the whole system, in the order (as given, or reverse Cuthill-McKee) that leaves it least to do.
    clusters : Envelope or None
        Of the preconditioner, if the system is solved by conjugate gradients.
    below : tuple of int arrays
        Start (m + 1,), block and row of the blocks below the diagonal in each block row.
    cg_tolerance : float
        Relative size of the residual at which the conjugate gradients stop.
    """

    structure: Structure
    free: NDArray[np.bool_]
    envelope: Envelope
    clusters: Envelope | None
    below: tuple[Index, Index, Index]
    cg_tolerance: float

    @classmethod
    def of(cls, structure: Structure, free: NDArray[np.bool_], factor_limit: float, cg_tolerance: float) -> Elimination:
        """Choose the order, and between factorisation and conjugate gradients."""
        m = len(free)
        rows = np.repeat(np.arange(m), np.diff(structure.row_start))
        graph = scipy.sparse.coo_array((np.ones(len(rows)), (rows, structure.cols)), shape=(m, m)).tocsr()
        orders = np.arange(m), reverse_cuthill_mckee((graph + graph.T).tocsr(), symmetric_mode=True).astype(np.int64)
        envelopes = [Envelope.of(structure, free, photos) for photos in orders]
        best = min((0, 1), key=lambda i: envelopes[i].multiply_adds)
        clusters = None
        if envelopes[best].multiply_adds > factor_limit:
            clusters = Envelope.of(structure, free, orders[best], _CLUSTER)
        off = np.flatnonzero(rows != structure.cols)
        by_column = off[np.argsort(structure.cols[off], kind="stable")]
        start = np.concatenate([[0], np.cumsum(np.bincount(structure.cols[off], minlength=m))])
        below = (start, by_column, rows[by_column])
        return cls(structure, free, envelopes[best], clusters, below, cg_tolerance)

    def solve(self, reduced: Reduced) -> tuple[Array, Array, Array, Array] | None:
        """Solution of the photos (m, nb), 0 where held, and of the cameras (k,), with the residuals of both.

        None if the matrix is not positive.
        """
        if self.clusters is not None:
            return self._conjugate_gradients(self.clusters, reduced)
        factored = self.factored(reduced)
        if factored is None:
            return None
        x = factored.solve_photos(reduced.b[None])
        y = factored.cameras @ (reduced.c - _products(reduced.border, x)[:, 0])
        x = x[0] - np.tensordot(y, factored.border_solved, 1)
        return x, y, np.zeros_like(x), np.zeros_like(y)

    def factored(self, reduced: Reduced) -> Factored | None:
        """The system factored; None if it is not positive."""
        solve = self.envelope.factor(self.structure, reduced.S)
        if solve is None:
            return None
        rows = self.envelope.gather(reduced.border)
        solve(rows)
        X = self.envelope.scatter(rows)
        cameras = _positive_inverse(reduced.corner - _products(reduced.border, X))
        return None if cameras is None else Factored(self.envelope, solve, reduced.border, X, cameras)

    def _conjugate_gradients(
        self, clusters: Envelope, reduced: Reduced
    ) -> tuple[Array, Array, Array, Array] | None:  # fmt: skip
        """Preconditioned by the factored diagonal blocks of neighbouring photos, and the corner of the cameras."""
        S, b, border = reduced.S, reduced.b, reduced.border
        precondition = clusters.factor(self.structure, S)
        corner_inverse = _positive_inverse(reduced.corner)
        if precondition is None or corner_inverse is None:
            return None
        unknowns = (0.0,) * b.shape[1]
        s = self.structure
        x, y = np.zeros_like(b), np.zeros_like(reduced.c)
        r, ry = np.where(self.free, b, 0.0), reduced.c.copy()
        p, py = np.zeros_like(x), np.zeros_like(y)
        Sp = np.empty_like(b)
        rho = first = 0.0
        for _ in range(_MAX_CG):
            B = clusters.gather(r[None])
            precondition(B)
            z, zy = clusters.scatter(B)[0], corner_inverse @ ry
            before, rho = rho, float((r * z).sum() + (ry * zy).sum())
            first = first or rho
            if not rho > self.cg_tolerance**2 * first:
                break
            beta = rho / before if before else 0.0
            p, py = z + beta * p, zy + beta * py
            schur.multiply(unknowns, s.row_start, s.cols, *self.below, S, p, Sp)
            Spy = reduced.corner @ py
            if len(py):
                Spy += _products(border, p[None])[:, 0]
                Sp += np.tensordot(py, border, 1)
            curvature = float((p * Sp)[self.free].sum() + (py * Spy).sum())
            if not curvature > 0:
                return None
            alpha = rho / curvature
            x, y = x + alpha * p, y + alpha * py
            r, ry = r - np.where(self.free, alpha * Sp, 0.0), ry - alpha * Spy
        return x, y, r, ry

    def marginal_covariances(self, reduced: Reduced) -> tuple[Array, Array]:
        """Covariances of each photo's unknowns (m, nb, nb), 0 where held, and of the cameras' (k, k).

        The diagonal blocks of the inverse, a few columns at a time: never the whole inverse. NaN if the matrix is not
        positive.
        """
        m, nb = self.free.shape
        factored = self.factored(reduced)
        if factored is None:
            unknown = np.where(self.free[:, :, None] & self.free[:, None, :], np.nan, 0.0)
            return unknown, np.full_like(reduced.corner, np.nan)
        # what the cameras leave open moves the photos with them
        X, cameras = factored.border_solved, factored.cameras
        result: Array = np.einsum("ima,ij,jmb->mab", X, cameras, X)
        place = self.envelope.place
        step = max(_COLUMNS // nb, 1)
        for begin in range(0, m, step):
            photos = np.arange(begin, min(begin + step, m))
            unit = np.zeros((int(self.free[photos].sum()), 4 * len(self.envelope.first)))
            unit[np.arange(len(unit)), place[photos][self.free[photos]]] = 1.0
            factored.solve_rows(unit)
            done = 0
            for i in photos:
                free = np.flatnonzero(self.free[i])
                block = unit[done : done + len(free)][:, place[i, free]]
                result[i][np.ix_(free, free)] += (block + block.T) / 2
                done += len(free)
        return result, cameras


class NormalEquations:
    """Block normal equations at one state; `solve` eliminates the points and solves for the photos.

    Parameters
    ----------
    elimination : Elimination
        Which photo sees which point, and how the reduced system is solved.
    cost : float
        Cost at the state.
    res, J_frame : (o, 2), (o, 2, nb) array
        Weighted residuals and Jacobians; that of the point is minus that of the centre.
    prior_diag, prior_gradient : (m, nb) array
        Diagonal Hessian and gradient of the priors of the photos.
    border : Border
        What the photos share.
    lengths : tuple of (q,) and (q, n, 3) arrays
        Residuals on few points and their Jacobian: they join points, which the elimination takes one by one, so their
        share of the Hessian is added to its inverse (Woodbury).

    Attributes
    ----------
    blocks : tuple of array
        res and J_frame.
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
        lengths: tuple[Array, Array],
    ) -> None:
        self.cost = cost
        self._elimination = elimination
        s = self._s = elimination.structure
        nb = prior_diag.shape[1]
        n = len(s.point_of)
        self._J = J_frame
        self.blocks = res, J_frame
        self._unknowns = (0.0,) * nb
        self._prior_diag = prior_diag
        self._V = np.empty((n, 3, 3))
        self._g_point = np.empty((n, 3))
        schur.point_blocks(s.track_start, s.point_of, res, J_frame, self._V, self._g_point)
        self._diagonal, self._g_frame = self._gradients(res, J_frame)
        self._diagonal += prior_diag
        self._g_frame += prior_gradient
        self._border = border
        diagonal, g_camera = self._gradients(res, border.J)
        self._camera_diagonal = border.sum_photos(diagonal)
        self._g_camera = border.sum_photos(g_camera) + border.prior_gradient.ravel()
        self._lengths = lengths[1]
        self._g_point += np.einsum("q,qna->na", *lengths)

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
        S = np.empty((len(s.cols), nb, nb))
        rhs = np.empty_like(g_frame)
        with numba.parallel_chunksize(1):
            schur.reduced_system(
                self._unknowns, s.frame_start, s.frame_order, s.frame_idx, s.track_idx, s.track_start, s.point_of,
                s.row_start, s.cols, self._J, V_inv, g_point, g_frame,
                self._prior_diag + damping * self._diagonal, S, rhs,
            )  # fmt: skip
        nc = self._border.J.shape[2]
        k = len(g_camera)
        rows, rhs_camera = np.zeros((m, nb + nc, k)), np.zeros((m, nc))
        if nc:
            with numba.parallel_chunksize(1):
                schur.border_rows(
                    s.frame_start, s.frame_order, s.frame_idx, s.track_idx, s.track_start, s.point_of,
                    self._border.camera_of_frame, self._J, self._border.J, V_inv, g_point, rows, rhs_camera,
                )  # fmt: skip
        # nothing pulls at a camera that took none of the photos, whatever holds it
        unused = np.repeat(np.bincount(self._border.camera_of_frame, minlength=self._border.num_cameras) == 0, nc)
        held = self._border.prior_diag.ravel() + damping * self._camera_diagonal + unused
        corner = self._border.sum_photos(rows[:, nb:]) + np.diag(held)
        border = np.where(self._elimination.free, rows[:, :nb].transpose(2, 0, 1), 0.0)
        c = -g_camera - self._border.sum_photos(rhs_camera)
        return Reduced(S, -rhs, border, (corner + corner.T) / 2, c), V_inv

    def marginal_covariances(self) -> tuple[Array, Array]:
        """Covariances of the unknowns of each photo (m, nb, nb) and of all cameras (k, k), all others being free.

        0 where held; NaN where the system cannot be factored.
        """
        photos, cameras = self._elimination.marginal_covariances(self.reduce(0.0)[0])
        if len(self._lengths):
            frame, _, camera, inner = self._of_lengths(0.0)
            photos = photos - np.einsum("qma,qp,pmb->mab", frame, inner, frame)
            cameras = cameras - np.einsum("qk,qp,pl->kl", camera, inner, camera)
        return photos, cameras

    def covariance(self) -> Callable[[Array], Array]:
        """Covariance of the photos' unknowns, all others being free, as a function of vectors (k, m, nb)."""
        factored = self._elimination.factored(self.reduce(0.0)[0])
        if factored is None:
            return lambda vectors: np.full_like(vectors, np.nan)
        if not len(self._lengths):
            return factored.covariance_times
        frame, _, _, inner = self._of_lengths(0.0)
        return lambda vectors: (
            factored.covariance_times(vectors) - np.tensordot(_products(vectors, frame) @ inner, frame, 1)
        )

    def variance_of_points(self, weights: Array) -> tuple[float, Array]:
        """Variance of sum(weights * points), weights (n, 3), and its covariance (m, nb) with the photos' unknowns."""
        solved = self._solve(0.0, np.zeros_like(self._g_frame), -weights, np.zeros_like(self._g_camera))
        if solved is None:
            return np.nan, np.full_like(self._g_frame, np.nan)
        frame, point = solved[:2]
        return float((weights * point).sum()), frame

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
        self, damping: float, g_frame: Array, g_point: Array, g_camera: Array
    ) -> tuple[Array, Array, Array, Array, Array] | None:
        """Solution of the photos, points and cameras for a gradient, with the residuals of photos and cameras."""
        solved = self._solve_without_lengths(damping, g_frame, g_point, g_camera)
        if solved is None or not len(self._lengths):
            return solved
        frame, point, camera, *residuals = solved
        of_lengths = self._of_lengths(damping)
        share = of_lengths[3] @ np.einsum("qna,na->q", self._lengths, point)
        frame, point, camera = (
            x - np.tensordot(share, u, 1) for x, u in zip((frame, point, camera), of_lengths[:3], strict=True)
        )
        return frame, point, camera, residuals[0], residuals[1]

    def _of_lengths(self, damping: float) -> tuple[Array, Array, Array, Array]:
        """H^-1 J' of the lengths' Jacobian J, for photos, points and cameras, and (1 + J H^-1 J')^-1."""
        zero = np.zeros_like(self._g_frame), np.zeros_like(self._g_camera)
        columns = [self._solve_without_lengths(damping, zero[0], -J, zero[1]) for J in self._lengths]
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
        self, damping: float, g_frame: Array, g_point: Array, g_camera: Array
    ) -> tuple[Array, Array, Array, Array, Array] | None:
        """As `_solve`, of the measurements and priors alone."""
        reduced, V_inv = self.reduce(damping, g_frame, g_point, g_camera)
        solved = self._elimination.solve(reduced)
        if solved is None:
            return None
        frame, camera, residual, camera_residual = solved
        point = np.empty_like(g_point)
        schur.back_substitute(
            self._unknowns, self._s.track_start, self._s.point_of, self._s.frame_idx, V_inv,
            self._pulled(g_point, camera), self._J, frame, point,
        )  # fmt: skip
        if not all(np.isfinite(part).all() for part in (frame, point, camera)):
            return None
        return frame, point, camera, residual, camera_residual

    def _pulled(self, g_point: Array, step_camera: Array) -> Array:
        """Gradient of the points (n, 3) after a step of all cameras (k,)."""
        if not step_camera.size:
            return g_point
        s = self._s
        steps = step_camera.reshape(self._border.num_cameras, -1)
        V, pull = np.empty_like(self._V), np.empty_like(g_point)
        moved = np.einsum("oij,oj->oi", self._border.J, steps[self._border.camera_of_frame[s.frame_idx]])
        schur.point_blocks(s.track_start, s.point_of, moved, self._J, V, pull)
        return g_point + pull

    def point_steps(self) -> Array:
        """Gauss-Newton steps (n, 3) of the points alone, the photos being held."""
        V_inv = np.empty_like(self._V)
        schur.invert_points(self._V, 0.0, V_inv)
        return -np.einsum("nij,nj->ni", V_inv, self._g_point)
