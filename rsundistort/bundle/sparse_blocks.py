"""A symmetric matrix of blocks factored where its factor has any: paths, whose frames see few others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .._kernels import sparse_blocks as kernels
from .._kernels._jit import unknowns_of
from .structure import BlockPattern

__all__ = ["BlockFactor", "SparseBlocks"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class SparseBlocks:
    """Where the factor of a symmetric matrix has blocks, its rows in an order that fills few.

    Attributes
    ----------
    pattern : BlockPattern
        Where the matrix has blocks.
    free : (m, nb) bool array
        Unknowns that are not held.
    order, rank : (m,) int array
        Block rows in the order of the factor, and the place of each.
    filled : BlockPattern
        Where the factor has blocks, in that order.
    """

    pattern: BlockPattern
    free: NDArray[np.bool_]
    order: Index
    rank: Index
    filled: BlockPattern

    @classmethod
    def of(cls, pattern: BlockPattern, free: NDArray[np.bool_]) -> SparseBlocks:
        """The order of minimum degree (Tinney and Walker, "Direct solutions of sparse network equations", 1967)."""
        m = pattern.size
        order, rank, joined = np.empty(m, np.int64), np.empty(m, np.int64), np.zeros((m, m), bool)
        kernels.eliminate(pattern.row_start, pattern.cols, order, joined)
        rank[order] = np.arange(m)
        joined = joined[order][:, order]
        joined[np.arange(m), np.arange(m)] = True
        rows, cols = np.nonzero(joined)
        return cls(pattern, free, order, rank, BlockPattern(np.searchsorted(rows, np.arange(m + 1)), cols))

    @property
    def num_values(self) -> int:
        """Length of the factor's data."""
        return len(self.filled.cols) * self.free.shape[1] ** 2

    @property
    def multiply_adds(self) -> float:
        """Multiply-adds of the factorisation."""
        wide = np.diff(self.filled.row_start).astype(float)
        return float((wide * (wide + 1)).sum() / 2 * self.free.shape[1] ** 3)

    def factor(self, S: Array) -> BlockFactor | None:
        """Factor of a matrix of blocks (blocks, nb, nb); None if it is not positive."""
        diagonal = np.diagonal(S[self.pattern.diagonal], axis1=1, axis2=2)
        # unit diagonal: angles, centres and phi differ by orders of magnitude
        scale = np.where(self.free, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 1.0)
        nb = self.free.shape[1]
        U = np.empty((len(self.filled.cols), nb, nb))
        kernels.fill_blocks(
            self.filled.row_start, self.filled.cols, self.rank[self.pattern.rows], self.rank[self.pattern.cols], S,
            scale[self.order], self.free[self.order], U,
        )  # fmt: skip
        if not kernels.factor_blocks(unknowns_of(nb), self.filled.row_start, self.filled.cols, U):
            return None
        return BlockFactor(self, U, scale)

    def gather(self, x: Array) -> Array:
        """Values of the block rows (k, m, nb) as right-hand sides."""
        return np.where(self.free, x, 0.0)[:, self.order]

    def scatter(self, B: Array) -> Array:
        """Right-hand sides as values of the block rows (k, m, nb); 0 where held."""
        return np.where(self.free, B[:, self.rank], 0.0)


@dataclass(frozen=True)
class BlockFactor:
    """Factor of a symmetric matrix of blocks.

    Attributes
    ----------
    shape : SparseBlocks
        Where it has blocks.
    data : (blocks, nb, nb) array
        These.
    scale : (m, nb) array
        What rows and columns of the matrix were multiplied by.
    """

    shape: SparseBlocks
    data: Array
    scale: Array

    def solve(self, B: Array) -> None:
        """Right-hand sides as `SparseBlocks.gather` gives them become solutions."""
        scale = self.scale[self.shape.order]
        B *= scale
        kernels.solve_blocks(self.shape.filled.row_start, self.shape.filled.cols, self.data, B)
        B *= scale

    def inverse_blocks(self) -> Array:
        """Diagonal blocks (m, nb, nb) of the inverse; 0 where held."""
        every = np.arange(len(self.scale))
        return self.inverse_blocks_of(every, every)

    @cached_property
    def _inverse(self) -> Array:
        """Blocks of the inverse where the factor has any, of the scaled matrix."""
        inverse = self.data.copy()
        filled = self.shape.filled
        kernels.invert_blocks(unknowns_of(inverse.shape[1]), filled.row_start, filled.cols, inverse)
        return inverse

    def inverse_blocks_of(self, first_row: Index, second_row: Index) -> Array:
        """Blocks (q, nb, nb) of the inverse, of pairs of block rows that the pattern joins; 0 where held."""
        shape = self.shape
        f, g = shape.rank[first_row], shape.rank[second_row]
        found = self._inverse[shape.filled.find(f, g)]
        found = np.where((f <= g)[:, None, None], found, found.transpose(0, 2, 1))
        scale = np.where(shape.free, self.scale, 0.0)
        return found * scale[first_row][:, :, None] * scale[second_row][:, None]
