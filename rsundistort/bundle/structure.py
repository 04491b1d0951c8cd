"""Which photo sees which point, and which photos share points: fixed while a problem is solved."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ..model.array_types import Index

__all__ = ["BlockPattern", "Structure"]


@dataclass(frozen=True)
class BlockPattern:
    """Where a symmetric matrix of blocks has any: its upper triangle in block rows.

    Attributes
    ----------
    row_start, cols : (m + 1,), (blocks,) int array
        Ranges of the block rows, and block columns, ascending in each row from its diagonal block.
    """

    row_start: Index
    cols: Index

    @property
    def size(self) -> int:
        """Number of block rows."""
        return len(self.row_start) - 1

    @property
    def rows(self) -> Index:
        """(blocks,) block rows."""
        return np.repeat(np.arange(self.size), np.diff(self.row_start))

    @property
    def diagonal(self) -> Index:
        """(m,) the diagonal blocks."""
        return self.row_start[:-1]

    def with_blocks(self, first: Index, second: Index) -> BlockPattern:
        """The pattern with the blocks of some pairs, too."""
        keys = np.minimum(first, second) * self.size + np.maximum(first, second)
        rows, cols = np.divmod(np.union1d(self.rows * self.size + self.cols, keys), self.size)
        return BlockPattern(np.searchsorted(rows, np.arange(self.size + 1)), cols)

    def find(self, first: Index, second: Index) -> Index:
        """(q,) places of the blocks of pairs of rows and columns, in either order."""
        keys = np.minimum(first, second) * self.size + np.maximum(first, second)
        return np.searchsorted(self.rows * self.size + self.cols, keys)

    @cached_property
    def reverse_cuthill_mckee(self) -> Index:
        """(m,) an order of the block rows in which each has its blocks near its diagonal."""
        return np.asarray(reverse_cuthill_mckee(self.graph(), symmetric_mode=True).astype(np.int64))

    def graph(self) -> scipy.sparse.csr_array:
        """The whole pattern, below the diagonal too, as (m, m) ones."""
        upper = scipy.sparse.csr_array((np.ones(len(self.cols)), self.cols, self.row_start), shape=(self.size,) * 2)
        return (upper + upper.T).tocsr()


@dataclass(frozen=True)
class Structure:
    """Which photo sees which point.

    Attributes
    ----------
    points : (n,) int array
        The points as they were given, in the order of the first photo that sees each: what a photo sees lies together.
    order : (o,) int array
        The observations as they were given, by point in that order and then by photo. All else is in these orders.
    frame_idx, point_idx : (o,) int array
        Photo and point.
    track_start : (n + 1,) int array
        Ranges of the points in the observations.
    frame_start, frame_order : (m + 1,), (o,) int array
        The observations of each photo.
    pattern : BlockPattern
        Photos that share points: the blocks of the reduced system.
    """

    points: Index
    order: Index
    frame_idx: Index
    point_idx: Index
    track_start: Index
    frame_start: Index
    frame_order: Index
    pattern: BlockPattern

    @classmethod
    def from_observations(
        cls, frame_idx: Index, point_idx: Index, num_frames: int, num_points: int,
        joined: tuple[Index, Index] | None = None,
    ) -> Structure:  # fmt: skip
        """Structure of observations in any order; priors connect the pairs of photos `joined`, too."""
        first = np.full(num_points, num_frames)
        np.minimum.at(first, point_idx, frame_idx)
        points = np.argsort(first, kind="stable")
        point_idx = np.argsort(points)[point_idx]
        order = np.argsort(point_idx * num_frames + frame_idx, kind="stable")
        frame_idx, point_idx = frame_idx[order], point_idx[order]
        track_start = np.searchsorted(point_idx, np.arange(num_points + 1))
        frame_order = np.argsort(frame_idx, kind="stable")
        frame_start = np.concatenate([[0], np.cumsum(np.bincount(frame_idx, minlength=num_frames))])
        sees = scipy.sparse.csr_array(
            (np.ones(len(order)), point_idx[frame_order], frame_start), shape=(num_frames, num_points)
        )
        # a photo without measurements has its diagonal block, too
        shared = scipy.sparse.triu(sees @ sees.T + scipy.sparse.diags_array(np.ones(num_frames)), format="csr")
        shared.sort_indices()
        pattern = BlockPattern(shared.indptr.astype(np.int64), shared.indices.astype(np.int64))
        if joined is not None:
            pattern = pattern.with_blocks(*joined)
        return cls(points, order, frame_idx, point_idx, track_start, frame_start, frame_order, pattern)
