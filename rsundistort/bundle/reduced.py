"""The reduced system of the photos: elimination of the points and its factorisation, dense or sparse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from .._kernels import schur

__all__ = ["NormalEquations", "Structure"]

# Photos whose columns of the inverse are held at once: 16 of 12 unknowns in a system of 10,000 photos are 180 MB.
_COVARIANCE_PHOTOS = 16

_UNFACTORABLE = (np.linalg.LinAlgError, ValueError, RuntimeError)

Step = tuple[NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class Structure:
    """Which photo sees which point: fixed while a problem is solved.

    Attributes
    ----------
    frame_idx, point_idx : (o,) int array
        Observations, sorted by point.
    point_start : (n + 1,) int array
        Ranges of the points in them.
    frame_start, frame_order : (m + 1,), (o,) int array
        The observations of each photo.
    row_start, cols : (m + 1,), (blocks,) int array
        Upper triangle of the reduced system in block rows.
    """

    frame_idx: NDArray[np.int64]
    point_idx: NDArray[np.int64]
    point_start: NDArray[np.int64]
    frame_start: NDArray[np.int64]
    frame_order: NDArray[np.int64]
    row_start: NDArray[np.int64]
    cols: NDArray[np.int64]

    @classmethod
    def from_sorted(
        cls, frame_idx: NDArray[np.int64], point_idx: NDArray[np.int64], num_frames: int, num_points: int
    ) -> Structure:
        """Structure of observations that are sorted by point."""
        point_start = np.searchsorted(point_idx, np.arange(num_points + 1))
        frame_order = np.argsort(frame_idx, kind="stable")
        frame_start = np.searchsorted(frame_idx[frame_order], np.arange(num_frames + 1))
        counts = np.empty(num_frames, np.int64)
        lists = (frame_start, frame_order, frame_idx, point_idx, point_start)
        schur.covisible_counts(*lists, counts)
        row_start = np.concatenate([[0], np.cumsum(counts)])
        cols = np.empty(row_start[-1], np.int64)
        schur.covisible_columns(*lists, row_start, cols)
        return cls(frame_idx, point_idx, point_start, frame_start, frame_order, row_start, cols)


class NormalEquations:
    """Block normal equations at one state; `solve` eliminates the points and factors what is left.

    Parameters
    ----------
    structure : Structure
        Which photo sees which point.
    cost : float
        Cost at the state.
    res, J_frame, J_point : (o, 2), (o, 2, nb), (o, 2, 3) array
        Weighted residuals and Jacobians.
    prior_diag, prior_gradient : (m, nb) array
        Diagonal Hessian and gradient of the priors of the photos.
    free : (m, nb) bool array
        Unknowns that are not held (gauge, anchors).
    dense_limit : int
        Largest number of unknowns that is factored densely.
    """

    def __init__(
        self,
        structure: Structure,
        cost: float,
        res: NDArray[np.float64],
        J_frame: NDArray[np.float64],
        J_point: NDArray[np.float64],
        prior_diag: NDArray[np.float64],
        prior_gradient: NDArray[np.float64],
        free: NDArray[np.bool_],
        dense_limit: int,
    ) -> None:
        m, nb = free.shape
        n = len(structure.point_start) - 1
        self.cost = cost
        self._s = structure
        self._free = free
        self._dense = int(free.sum()) <= dense_limit
        self._U = np.empty((m, nb, nb))
        self._g_frame = np.empty((m, nb))
        self._V = np.empty((n, 3, 3))
        self._g_point = np.empty((n, 3))
        self._W = np.empty((len(res), nb, 3))
        schur.point_blocks(structure.point_start, res, J_frame, J_point, self._V, self._g_point, self._W)
        schur.frame_blocks(structure.frame_start, structure.frame_order, res, J_frame, self._U, self._g_frame)
        diagonal = np.arange(nb)
        self._U[:, diagonal, diagonal] += prior_diag
        self._g_frame += prior_gradient

    def reduce(self, damping: float) -> tuple[Any, NDArray[np.float64], tuple[NDArray[np.float64], ...]]:
        """Blocks (upper triangle), right-hand side (m, nb) and (V_inv, W V_inv) of the damped reduced system."""
        s = self._s
        V_inv = np.empty_like(self._V)
        WV = np.empty_like(self._W)
        schur.eliminate_points(s.point_start, self._V, self._g_point, self._W, damping, V_inv, WV)
        nb = self._U.shape[1]
        S = np.empty((len(s.cols), nb, nb))
        rhs = np.empty_like(self._g_frame)
        schur.reduced_system(
            s.frame_start, s.frame_order, s.frame_idx, s.point_idx, s.point_start, s.row_start, s.cols,
            self._U, self._g_frame, self._g_point, self._W, WV, damping, S, rhs,
        )  # fmt: skip
        return S, rhs, (V_inv, WV)

    def _block_matrix(self, S: NDArray[np.float64]) -> Any:
        """Upper block triangle as a sparse matrix of all unknowns; the diagonal blocks are whole."""
        m, nb = self._free.shape
        return scipy.sparse.bsr_array((S, self._s.cols, self._s.row_start), shape=(m * nb, m * nb)).tocsr()

    def _factor(self, S: NDArray[np.float64]) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
        """Solver of the reduced system of the free unknowns: takes right-hand sides (free[, k])."""
        free = self._free.ravel()
        upper = scipy.sparse.triu(self._block_matrix(S)[free][:, free], format="csc")
        # unit diagonal: angles, centres and phi differ by orders of magnitude
        scale = 1.0 / np.sqrt(np.maximum(upper.diagonal(), 1e-300))
        D = scipy.sparse.diags_array(scale)
        upper = (D @ upper @ D).tocsc()
        solve: Callable[[NDArray[np.float64]], NDArray[np.float64]]
        if self._dense:
            factor = scipy.linalg.cho_factor(upper.toarray(), lower=False, check_finite=True)

            def solve(b: NDArray[np.float64]) -> NDArray[np.float64]:
                return scipy.linalg.cho_solve(factor, b)
        else:
            full = (upper + scipy.sparse.triu(upper, k=1).T).tocsc()
            solve = scipy.sparse.linalg.splu(
                full, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            ).solve
        return lambda b: (scale * solve((scale * b.T).T).T).T

    def marginal_covariances(self) -> NDArray[np.float64]:
        """Covariances (m, nb, nb) of the unknowns of each photo, all others being free; 0 where held.

        The diagonal blocks of the inverse reduced system, a few columns at a time: never the whole inverse. NaN where
        the system cannot be factored.
        """
        m, nb = self._free.shape
        place = np.full(m * nb, -1)
        place[self._free.ravel()] = np.arange(int(self._free.sum()))
        place = place.reshape(m, nb)
        result = np.zeros((m, nb, nb))
        try:
            solve = self._factor(self.reduce(0.0)[0])
            for first in range(0, m, _COVARIANCE_PHOTOS):
                photos = range(first, min(first + _COVARIANCE_PHOTOS, m))
                columns = place[photos][self._free[photos]]
                unit = np.zeros((int(self._free.sum()), len(columns)))
                unit[columns, np.arange(len(columns))] = 1.0
                inverse = solve(unit)
                done = 0
                for i in photos:
                    free = np.flatnonzero(self._free[i])
                    block = inverse[place[i, free], done : done + len(free)]
                    result[i][np.ix_(free, free)] = (block + block.T) / 2
                    done += len(free)
        except _UNFACTORABLE:
            result[:] = np.where(self._free[:, :, None] & self._free[:, None, :], np.nan, 0.0)
        return result

    def solve(self, damping: float) -> tuple[Step, float] | None:
        """Step of the photos (m, nb) and points (n, 3), and the decrease of cost that it predicts."""
        S, rhs, (V_inv, _) = self.reduce(damping)
        step_frame = np.zeros(self._free.shape)
        try:
            step_frame[self._free] = self._factor(S)(-rhs[self._free])
        except _UNFACTORABLE:
            return None
        step_point = np.empty_like(self._g_point)
        schur.back_substitute(
            self._s.point_start, self._s.frame_idx, V_inv, self._g_point, self._W, step_frame, step_point
        )
        if not (np.isfinite(step_frame).all() and np.isfinite(step_point).all()):
            return None
        diag_frame = np.diagonal(self._U, axis1=1, axis2=2)
        diag_point = np.diagonal(self._V, axis1=1, axis2=2)
        predicted = 0.5 * float(
            np.vdot(step_frame, damping * diag_frame * step_frame - self._g_frame)
            + np.vdot(step_point, damping * diag_point * step_point - self._g_point)
        )
        return (step_frame, step_point), predicted
