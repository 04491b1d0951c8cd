"""A symmetric matrix factored inside its envelope."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .._kernels import envelope as kernels
from ..model.array_types import Array, Index, Mask
from .structure import BlockPattern

__all__ = ["CholeskyFactor", "Envelope"]

# Bands (of four unknowns) of the envelope that threads share: wide enough to be worth meeting for.
_PANEL = 48
# Below these multiply-adds (30 ms of one thread) the factor is one panel: on a busy machine meetings cost more.
_WORTH_THREADS = 3e8
# Parts of the inverse's sums that threads share: a number of its own, since it decides the rounding.
_PARTS = 8


@dataclass(frozen=True)
class Envelope:
    """Where the factor of a symmetric matrix has entries: each row from its first column to the diagonal.

    Attributes
    ----------
    place : (m, nb) int array
        Row of the unknowns of each block row; -1 where held.
    first, offset : (bands,) int array
        First column of each band of four rows, and where the band begins in the data.
    num_values : int
        Length of the data.
    multiply_adds : float
        What the factorisation takes.
    """

    pattern: BlockPattern
    place: Index
    first: Index
    offset: Index
    num_values: int
    multiply_adds: float

    @classmethod
    def smallest(cls, pattern: BlockPattern, free: Mask) -> Envelope:
        """Envelope of the free unknowns (m, nb), in the order as given or reverse Cuthill-McKee: what takes less."""
        orders = np.arange(len(free)), pattern.reverse_cuthill_mckee
        return min((cls.of(pattern, free, order) for order in orders), key=lambda envelope: envelope.multiply_adds)

    @classmethod
    def of(cls, pattern: BlockPattern, free: Mask, order: Index) -> Envelope:
        """Envelope of the free unknowns (m, nb) with the block rows in an order."""
        m, nb = free.shape
        size = int(free.sum())
        begin = np.concatenate([[0], np.cumsum(free[order].sum(1))])  # row of each block row's first unknown
        rank = np.empty(m, np.int64)
        rank[order] = np.arange(m)
        place = np.full((m, nb), -1)
        place[order] = np.where(free[order], begin[:-1, None] + np.cumsum(free[order], axis=1) - 1, -1)
        rows, cols = rank[pattern.rows], rank[pattern.cols]
        leftmost = np.arange(m)
        np.minimum.at(leftmost, np.maximum(rows, cols), np.minimum(rows, cols))
        bands = (size + 3) // 4
        first_of_row = np.concatenate([np.repeat(begin[leftmost], np.diff(begin)), np.full(4 * bands - size, size)])
        first = np.minimum(first_of_row.reshape(bands, 4).min(1), 4 * np.arange(bands)) // 4 * 4
        width = 4 * np.arange(1, bands + 1) - first
        offset = np.concatenate([[0], np.cumsum(4 * width)])
        adds = float((2.0 * width.astype(float) ** 2).sum())
        return cls(pattern, place, first, offset[:-1], int(offset[-1]), adds)

    def factor(self, S: Array) -> CholeskyFactor | None:
        """Factor of a matrix of blocks (blocks, nb, nb); None if it is not positive."""
        scale = np.ones(4 * len(self.first))
        diagonal = np.diagonal(S[self.pattern.diagonal], axis1=1, axis2=2)
        free = self.place >= 0
        # unit diagonal: angles, centres and phi differ by orders of magnitude
        scale[self.place[free]] = 1.0 / np.sqrt(np.maximum(diagonal[free], 1e-300))
        data = np.empty(self.num_values)
        kernels.fill_envelope(
            self.place, self.pattern.row_start, self.pattern.cols, S, scale, self.first, self.offset, data
        )  # fmt: skip
        panel = _PANEL if self.multiply_adds > _WORTH_THREADS else max(len(self.first), 1)
        if not kernels.factor_envelope(self.first, self.offset, panel, data):
            return None

        return CholeskyFactor(self, data, scale)

    def gather(self, x: Array) -> Array:
        """Values of the block rows (k, m, nb) as right-hand sides (k, padded rows)."""
        B = np.zeros((len(x), 4 * len(self.first)))
        free = self.place >= 0
        B[:, self.place[free]] = x[:, free]
        return B

    def scatter(self, B: Array) -> Array:
        """Right-hand sides (k, padded rows) as values of the block rows (k, m, nb); 0 where held."""
        return np.where(self.place >= 0, B[:, self.place], 0.0)


@dataclass(frozen=True)
class CholeskyFactor:
    """Factor of a symmetric matrix inside its envelope.

    Attributes
    ----------
    data : (num_values,) array
        These.
    scale : (padded rows,) array
        What rows and columns of the matrix were multiplied by.
    """

    shape: Envelope
    data: Array
    scale: Array

    def solve(self, B: Array) -> None:
        """Right-hand sides (k, padded rows) become solutions."""
        B *= self.scale
        kernels.solve_envelope(self.shape.first, self.shape.offset, self.data, B)
        B *= self.scale

    @cached_property
    def _inverse(self) -> Array:
        """Entries of the inverse inside the envelope, of the scaled matrix."""
        shape = self.shape
        inverse = self.data.copy()
        parts = _PARTS if shape.multiply_adds > _WORTH_THREADS else 1
        kernels.invert_envelope(shape.first, shape.offset, parts, inverse)
        return inverse

    def inverse_blocks(self, first_row: Index, second_row: Index) -> Array:
        """Blocks (q, nb, nb) of the inverse, of pairs of block rows that the pattern connects; 0 where held."""
        shape = self.shape
        first, offset, inverse = shape.first, shape.offset, self._inverse
        of_rows, of_columns = shape.place[first_row][:, :, None], shape.place[second_row][:, None]
        row, column = np.maximum(of_rows, of_columns), np.minimum(of_rows, of_columns)
        band = row // 4
        at = offset[band] + (row - 4 * band) * (4 * band + 4 - first[band]) + column - first[band]
        free = column >= 0
        found = inverse[np.where(free, at, 0)] * self.scale[row] * self.scale[column]
        return np.where(free, found, 0.0)
