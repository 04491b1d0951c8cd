"""Conjugate gradients for the reduced system, preconditioned on two levels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .._kernels import blocks
from ..model.array_types import Array, Mask
from .coarse_space import CoarseSpace
from .reduced import Factored, Reduced, factor, products
from .structure import BlockPattern

__all__ = ["Iterated", "solve_iteratively"]

# Ranges of block rows whose products are summed one after the other: more than threads, so that they share them.
_RANGES = 8


@dataclass(frozen=True)
class Iterated:
    """Result of conjugate gradients.

    Attributes
    ----------
    x, y : (m, nb), (k,) array
        Solution of the photos and cameras.
    residual, camera_residual : (m, nb), (k,) array
        What is left of the right-hand sides.
    num_iterations : int
        Products with the matrix that the search took.
    converged : bool
        Whether the residual fell below the tolerance.
    """

    x: Array
    y: Array
    residual: Array
    camera_residual: Array
    num_iterations: int
    converged: bool


class _Bordered:
    """A reduced system as a product with vectors: photos' unknowns, then the cameras'."""

    def __init__(self, pattern: BlockPattern, free: Mask, reduced: Reduced) -> None:
        self._pattern, self._free, self._reduced = pattern, free, reduced
        self._parts = np.empty((_RANGES, *free.shape))

    def split(self, v: Array) -> tuple[Array, Array]:
        """Photos (m, nb) and cameras (k,) of a vector."""
        return v[: self._free.size].reshape(self._free.shape), v[self._free.size :]

    def join(self, x: Array, y: Array) -> Array:
        """The vector of photos and cameras, 0 where held."""
        return np.concatenate([np.where(self._free, x, 0.0).ravel(), y])

    def times(self, v: Array) -> Array:
        """The product."""
        x, y = self.split(v)
        r, p = self._reduced, self._pattern
        Sx = np.empty_like(x)
        blocks.multiply(p.row_start, p.cols, r.S, x, self._parts, Sx)
        if not y.size:
            return self.join(Sx, y)
        return self.join(Sx + np.tensordot(y, r.border, 1), products(r.border, x[None])[:, 0] + r.corner @ y)


def _inverse_blocks(diagonal: Array, free: Mask) -> Array | None:
    """Inverses of the diagonal blocks (m, nb, nb), 0 where held; None if one is not positive."""
    size = np.sqrt(np.maximum(np.einsum("maa->ma", diagonal), 1e-300))
    scale = np.where(free, 1.0 / size, 0.0)
    held = np.where(free, 0.0, 1.0)[:, :, None] * np.eye(free.shape[1])
    scaled = scale[:, :, None] * diagonal * scale[:, None] + held
    try:
        half = np.linalg.inv(np.linalg.cholesky(scaled))
    except np.linalg.LinAlgError:
        return None
    return scale[:, :, None] * np.einsum("mba,mbc->mac", half, half) * scale[:, None]


def _two_levels(
    system: _Bordered, inverse: Array, space: CoarseSpace, coarse: Factored
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """The preconditioner, and its coarse level alone.

    Each photo for itself, then all clusters and the cameras together for what that leaves ("A-DEF2" of Tang et al.,
    "Comparison of two-level preconditioners derived from deflation, domain decomposition and multigrid methods", 2009):
    with a start from the coarse level it is as good as the symmetric form, at half the products.
    """

    def below(r: Array) -> Array:
        x, y = system.split(r)
        u, cameras = coarse.solve(space.restrict(x), y)
        return system.join(space.prolong(u), cameras)

    def both(r: Array) -> Array:
        x, y = system.split(r)
        z = system.join(np.einsum("mab,mb->ma", inverse, x), np.zeros_like(y))
        return z + below(r - system.times(z))

    return both, below


def solve_iteratively(
    reduced: Reduced, space: CoarseSpace, pattern: BlockPattern, tolerance: float, max_iterations: int
) -> Iterated | None:
    """Solve until the residual is `tolerance` of the solution, in the norms of the preconditioner and of the matrix.

    About tolerance^2 of the decrease of the cost is then missing. None if the matrix is found not to be positive.
    """
    inverse = _inverse_blocks(reduced.S[pattern.diagonal], space.free)
    coarse = factor(space.project(reduced), space.envelope)
    if inverse is None or coarse is None:
        return None
    system = _Bordered(pattern, space.free, reduced)
    precondition, correct = _two_levels(system, inverse, space, coarse)
    b = system.join(reduced.b, reduced.c)
    x = correct(b)
    r = b - system.times(x)
    p = np.zeros_like(x)
    rho, converged = 1.0, False
    for iteration in range(max_iterations + 1):
        z = precondition(r)
        before, rho = rho, float((r * z).sum())
        enough = tolerance**2 * float((x * (b - r)).sum())
        converged = 0.0 <= rho <= enough
        if not rho > enough or iteration == max_iterations:
            break
        p = z + (rho / before if iteration else 0.0) * p
        Ap = system.times(p)
        curvature = float((p * Ap).sum())
        if not curvature > 0:
            return None
        x = x + rho / curvature * p
        r = r - rho / curvature * Ap
    return Iterated(*system.split(x), *system.split(r), iteration, converged)
