"""A symmetric matrix of blocks factored where its factor has any: paths, whose frames see few others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np

from .._kernels import sparse_blocks as kernels
from ..model.array_types import Array, Index, Mask
from .structure import BlockPattern

__all__ = ["BlockFactor", "Chain", "SparseBlocks"]

# Parts of the inverse's sums that threads share: a number of its own, since it decides the rounding.
_PARTS = 8
# Multiply-adds of a block row, in the mean, that are worth waking threads for. Two of them take 0.75 of the time with
# half of it where nothing else runs, and several times as long where something does: each row waits for both.
_WORTH_THREADS = 5e5


class Chain(NamedTuple):
    """Unknowns that only a chain of photos connects.

    Attributes
    ----------
    first, second : (q,) int array
        Photos that the chain connects.
    num : int
        The last unknowns of each photo, so many, have blocks with those of these pairs only.
    """

    first: Index
    second: Index
    num: int


@dataclass(frozen=True)
class SparseBlocks:
    """Where the factor of a symmetric matrix has blocks, its rows in an order that fills few.

    The unknowns of a photo are one block row, or two: those that only a chain connects can be eliminated long before
    the others, so that what many photos see of each other is filled with blocks without them.

    Attributes
    ----------
    free : (m, nb) bool array
        Unknowns that are not held.
    rank : (m, parts) int array
        The block row of the factor of each part of a photo's unknowns.
    begin : (parts + 1,) int array
        Where each part begins.
    filled : BlockPattern
        Where the factor has blocks, in the order of the elimination.
    size, position : (rows,) int array
        Unknowns of each block row, and the first of them.
    column, start : (blocks,), (rows + 1,) int array
        Where each block begins in its rows, and where these begin in the data.
    """

    pattern: BlockPattern
    free: Mask
    rank: Index
    begin: Index
    filled: BlockPattern
    size: Index
    position: Index
    column: Index
    start: Index

    @classmethod
    def of(cls, pattern: BlockPattern, free: Mask, chain: Chain | None = None) -> SparseBlocks:
        """The order of minimum degree (Tinney and Walker, "Direct solutions of sparse network equations", 1967)."""
        m, nb = free.shape
        begin = np.array([0, nb] if chain is None else [0, nb - chain.num, nb])
        parts = len(begin) - 1
        nodes = pattern if chain is None else _in_two(pattern, chain)
        rows = m * parts
        weight = np.tile(np.diff(begin), m)
        order, joined = np.empty(rows, np.int64), np.zeros((rows, rows), bool)
        kernels.eliminate(nodes.row_start, nodes.cols, weight, order, joined)
        rank = np.empty(rows, np.int64)
        rank[order] = np.arange(rows)
        joined = joined[order][:, order]
        joined[np.arange(rows), np.arange(rows)] = True
        of_row, cols = np.nonzero(joined)
        filled = BlockPattern(np.searchsorted(of_row, np.arange(rows + 1)), cols)
        size = weight[order]
        ends = np.cumsum(size[cols])
        column = ends - size[cols] - np.concatenate([[0], ends])[filled.row_start[:-1]][of_row]
        wide = np.bincount(of_row, size[cols], rows).astype(np.int64)
        position = np.cumsum(size) - size
        start = np.concatenate([[0], np.cumsum(size * wide)])
        return cls(pattern, free, rank.reshape(m, parts), begin, filled, size, position, column, start)

    @property
    def num_values(self) -> int:
        """Length of the factor's data."""
        return int(self.start[-1])

    @property
    def multiply_adds(self) -> float:
        """Multiply-adds of the factorisation."""
        wide = np.diff(self.start) / self.size
        return float((self.size * wide * (wide + 1)).sum() / 2)

    @cached_property
    def _unknowns(self) -> Index:
        """(m, nb) where each of the photos' unknowns stands in the order of the elimination."""
        part = np.repeat(np.arange(len(self.begin) - 1), np.diff(self.begin))
        own = np.arange(self.begin[-1]) - self.begin[part]
        return self.position[self.rank[:, part]] + own

    @property
    def _layout(self) -> tuple[Index, Index, Index, Index, Index]:
        """What kernels take of it."""
        return self.filled.row_start, self.filled.cols, self.column, self.start, self.size

    @contextmanager
    def threads(self) -> Iterator[None]:
        """As many threads as the block rows are worth; their number changes no result."""
        before = numba.get_num_threads()
        if self.multiply_adds < _WORTH_THREADS * len(self.size):
            numba.set_num_threads(1)
        try:
            yield
        finally:
            numba.set_num_threads(before)

    def factor(self, S: Array) -> BlockFactor | None:
        """Factor of a matrix of blocks (blocks, nb, nb); None if it is not positive."""
        diagonal = np.diagonal(S[self.pattern.diagonal], axis1=1, axis2=2)
        # unit diagonal: angles, centres and phi differ by orders of magnitude
        scale = np.where(self.free, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 1.0)
        data = np.empty(self.num_values)
        kernels.fill_blocks(
            *self._layout, self.pattern.rows, self.pattern.cols, S, scale, self.free, self.rank, self.begin, data
        )  # fmt: skip
        with self.threads():
            positive = kernels.factor_blocks(*self._layout, data)
        return BlockFactor(self, data, scale) if positive else None

    def gather(self, x: Array) -> Array:
        """Values of the block rows (k, m, nb) as right-hand sides (k, unknowns)."""
        B = np.empty((len(x), self.free.size))
        B[:, self._unknowns.ravel()] = np.where(self.free, x, 0.0).reshape(len(x), -1)
        return B

    def scatter(self, B: Array) -> Array:
        """Right-hand sides as values of the block rows (k, m, nb); 0 where held."""
        return np.where(self.free, B[:, self._unknowns], 0.0)


def _in_two(pattern: BlockPattern, chain: Chain) -> BlockPattern:
    """The pattern of photos whose unknowns are two block rows each, 2 i and 2 i + 1; the chain connects all of them."""
    every, rows = np.arange(pattern.size), 2 * pattern.size
    first, second = np.concatenate([every, chain.first]), np.concatenate([every, chain.second])
    pairs = [(2 * pattern.rows, 2 * pattern.cols)]
    pairs += [(2 * first + a, 2 * second + b) for a in (0, 1) for b in (0, 1)]
    one, other = (np.concatenate(each) for each in zip(*pairs, strict=True))
    of_row, cols = np.divmod(np.unique(np.minimum(one, other) * rows + np.maximum(one, other)), rows)
    return BlockPattern(np.searchsorted(of_row, np.arange(rows + 1)), cols)


@dataclass(frozen=True)
class BlockFactor:
    """Factor of a symmetric matrix of blocks.

    Attributes
    ----------
    data : (num_values,) array
        These.
    scale : (m, nb) array
        What rows and columns of the matrix were multiplied by.
    """

    shape: SparseBlocks
    data: Array
    scale: Array

    def solve(self, B: Array) -> None:
        """Right-hand sides as `SparseBlocks.gather` gives them become solutions."""
        scale = np.empty(self.scale.size)
        scale[self.shape._unknowns] = self.scale
        B *= scale
        kernels.solve_blocks(*self.shape._layout, self.shape.position, self.data, B)
        B *= scale

    @cached_property
    def _inverse(self) -> Array:
        """The inverse where the factor has blocks, of the scaled matrix."""
        inverse = self.data.copy()
        with self.shape.threads():
            kernels.invert_blocks(*self.shape._layout, _PARTS, inverse)
        return inverse

    def inverse_blocks(self, first_row: Index, second_row: Index) -> Array:
        """Blocks (q, nb, nb) of the inverse, of pairs of photos that the pattern joins; 0 where held.

        Of unknowns in a chain, pairs that it joins.
        """
        shape = self.shape
        part = np.repeat(np.arange(len(shape.begin) - 1), np.diff(shape.begin))
        own = np.arange(shape.begin[-1]) - shape.begin[part]
        f, g = shape.rank[first_row][:, part][:, :, None], shape.rank[second_row][:, part][:, None]
        low, high = np.minimum(f, g), np.maximum(f, g)
        block = shape.filled.find(low, high)
        wide = (np.diff(shape.start) // shape.size)[low]
        across, along = np.where(f <= g, own[:, None], own), np.where(f <= g, own, own[:, None])
        found = self._inverse[shape.start[low] + across * wide + shape.column[block] + along]
        scale = np.where(shape.free, self.scale, 0.0)
        return found * scale[first_row][:, :, None] * scale[second_row][:, None]
