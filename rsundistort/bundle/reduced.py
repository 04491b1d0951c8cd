"""The reduced system of the photos: elimination of the points, then an envelope factorised, or conjugate gradients."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee

from .._kernels import schur

__all__ = ["Elimination", "NormalEquations", "Structure"]

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
Step = tuple[Array, Array]


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
        first = np.full(num_points, num_frames)
        np.minimum.at(first, point_idx, frame_idx)
        point_of = np.argsort(first, kind="stable")
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
    multiply_adds : float
        What the factorisation takes.
    """

    place: Index
    size: int
    first: Index
    offset: Index
    num_values: int
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
        if cluster:
            leftmost = np.maximum(leftmost, np.arange(m) // cluster * cluster)
        bands = (size + 3) // 4
        first_of_row = np.concatenate([np.repeat(begin[leftmost], np.diff(begin)), np.full(4 * bands - size, size)])
        first = np.minimum(first_of_row.reshape(bands, 4).min(1), 4 * np.arange(bands)) // 4 * 4
        width = 4 * np.arange(1, bands + 1) - first
        offset = np.concatenate([[0], np.cumsum(4 * width)])
        return cls(place, size, first, offset[:-1], int(offset[-1]), float((2.0 * width.astype(float) ** 2).sum()))

    def factor(self, structure: Structure, S: Array) -> Callable[[Array], None] | None:
        """Solver in place of right-hand sides (k, padded rows), of the blocks inside the envelope; None if it fails."""
        scale = np.ones(4 * len(self.first))
        diagonal = np.diagonal(S[structure.row_start[:-1]], axis1=1, axis2=2)
        free = self.place >= 0
        # unit diagonal: angles, centres and phi differ by orders of magnitude
        scale[self.place[free]] = 1.0 / np.sqrt(np.maximum(diagonal[free], 1e-300))
        data = np.empty(self.num_values)
        schur.fill_envelope(
            self.place, structure.row_start, structure.cols, S, scale, self.first, self.offset, data
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
        """Values of the photos (m, nb) as one right-hand side (1, padded rows)."""
        B = np.zeros((1, 4 * len(self.first)))
        free = self.place >= 0
        B[0, self.place[free]] = x[free]
        return B

    def scatter(self, B: Array) -> Array:
        """One right-hand side (1, padded rows) as values of the photos; 0 where held."""
        return np.where(self.place >= 0, B[0, self.place], 0.0)


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

    def solve(self, S: Array, b: Array) -> tuple[Array, Array] | None:
        """Solution (m, nb) of S x = b, 0 where held, and the residual b - S x; None if S is not positive."""
        if self.clusters is not None:
            return self._conjugate_gradients(self.clusters, S, b)
        solve = self.envelope.factor(self.structure, S)
        if solve is None:
            return None
        B = self.envelope.gather(b)
        solve(B)
        return self.envelope.scatter(B), np.zeros_like(b)

    def _conjugate_gradients(self, clusters: Envelope, S: Array, b: Array) -> tuple[Array, Array] | None:
        """Preconditioned by the factored diagonal blocks of neighbouring photos."""
        precondition = clusters.factor(self.structure, S)
        if precondition is None:
            return None
        unknowns = (0.0,) * b.shape[1]
        s = self.structure
        x = np.zeros_like(b)
        r = np.where(self.free, b, 0.0)
        p = np.zeros_like(b)
        Sp = np.empty_like(b)
        rho = first = 0.0
        for _ in range(_MAX_CG):
            B = clusters.gather(r)
            precondition(B)
            z = clusters.scatter(B)
            before, rho = rho, float((r * z).sum())
            first = first or rho
            if not rho > self.cg_tolerance**2 * first:
                break
            p = z + (rho / before if before else 0.0) * p
            schur.multiply(unknowns, s.row_start, s.cols, *self.below, S, p, Sp)
            curvature = float((p * Sp)[self.free].sum())
            if not curvature > 0:
                return None
            x += (rho / curvature) * p
            r -= np.where(self.free, (rho / curvature) * Sp, 0.0)
        return x, r

    def marginal_covariances(self, S: Array) -> Array:
        """Diagonal blocks (m, nb, nb) of the inverse, 0 where held; NaN if S is not positive.

        A few columns at a time: never the whole inverse.
        """
        m, nb = self.free.shape
        solve = self.envelope.factor(self.structure, S)
        if solve is None:
            return np.where(self.free[:, :, None] & self.free[:, None, :], np.nan, 0.0)
        result = np.zeros((m, nb, nb))
        place = self.envelope.place
        step = max(_COLUMNS // nb, 1)
        for begin in range(0, m, step):
            photos = np.arange(begin, min(begin + step, m))
            unit = np.zeros((int(self.free[photos].sum()), 4 * len(self.envelope.first)))
            unit[np.arange(len(unit)), place[photos][self.free[photos]]] = 1.0
            solve(unit)
            done = 0
            for i in photos:
                free = np.flatnonzero(self.free[i])
                block = unit[done : done + len(free)][:, place[i, free]]
                result[i][np.ix_(free, free)] = (block + block.T) / 2
                done += len(free)
        return result


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
    """

    def __init__(
        self,
        elimination: Elimination,
        cost: float,
        res: Array,
        J_frame: Array,
        prior_diag: Array,
        prior_gradient: Array,
    ) -> None:
        self.cost = cost
        self._elimination = elimination
        s = self._s = elimination.structure
        m, nb = prior_diag.shape
        n = len(s.point_of)
        self._J = J_frame
        self._unknowns = (0.0,) * nb
        self._prior_diag = prior_diag
        self._diagonal = np.empty((m, nb))
        self._g_frame = np.empty((m, nb))
        self._V = np.empty((n, 3, 3))
        self._g_point = np.empty((n, 3))
        schur.point_blocks(s.track_start, s.point_of, res, J_frame, self._V, self._g_point)
        with numba.parallel_chunksize(1):
            schur.frame_gradients(s.frame_start, s.frame_order, res, J_frame, self._diagonal, self._g_frame)
        self._diagonal += prior_diag
        self._g_frame += prior_gradient

    def reduce(self, damping: float) -> tuple[Array, Array, Array]:
        """Blocks (upper triangle) and right-hand side (m, nb) of the damped reduced system, and V^-1 (n, 3, 3)."""
        s = self._s
        nb = len(self._unknowns)
        V_inv = np.empty_like(self._V)
        schur.invert_points(self._V, damping, V_inv)
        S = np.empty((len(s.cols), nb, nb))
        rhs = np.empty_like(self._g_frame)
        with numba.parallel_chunksize(1):
            schur.reduced_system(
                self._unknowns, s.frame_start, s.frame_order, s.frame_idx, s.track_idx, s.track_start, s.point_of,
                s.row_start, s.cols, self._J, V_inv, self._g_point, self._g_frame,
                self._prior_diag + damping * self._diagonal, S, rhs,
            )  # fmt: skip
        return S, rhs, V_inv

    def point_steps(self) -> Array:
        """Gauss-Newton steps (n, 3) of the points alone, the photos being held."""
        V_inv = np.empty_like(self._V)
        schur.invert_points(self._V, 0.0, V_inv)
        return -np.einsum("nij,nj->ni", V_inv, self._g_point)

    def marginal_covariances(self) -> Array:
        """Covariances (m, nb, nb) of the unknowns of each photo, all others being free; 0 where held.

        NaN where the system cannot be factored.
        """
        return self._elimination.marginal_covariances(self.reduce(0.0)[0])

    def solve(self, damping: float) -> tuple[Step, float] | None:
        """Step of the photos (m, nb) and points (n, 3), and the decrease of cost that it predicts."""
        S, rhs, V_inv = self.reduce(damping)
        solved = self._elimination.solve(S, -rhs)
        if solved is None:
            return None
        step_frame, residual = solved
        step_point = np.empty_like(self._g_point)
        schur.back_substitute(
            self._unknowns, self._s.track_start, self._s.point_of, self._s.frame_idx, V_inv, self._g_point, self._J,
            step_frame, step_point,
        )  # fmt: skip
        if not (np.isfinite(step_frame).all() and np.isfinite(step_point).all()):
            return None
        # of the system that was solved: an unfinished solution leaves (H + damping D) step + g = -residual.
        # Sums, not np.vdot: threads of BLAS that wait for work take the processors from ours
        diag_point = np.diagonal(self._V, axis1=1, axis2=2)
        predicted = 0.5 * float(
            (step_frame * (damping * self._diagonal * step_frame - self._g_frame + residual)).sum()
            + (step_point * (damping * diag_point * step_point - self._g_point)).sum()
        )
        return (step_frame, step_point), predicted
