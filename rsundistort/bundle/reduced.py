"""The reduced system of the photos, bordered by what they share, and its factorisation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..model.array_types import Array, Index
from .envelope import CholeskyFactor, Envelope
from .sparse_blocks import BlockFactor, SparseBlocks

__all__ = ["Factored", "Reduced", "factor", "products"]


# Right-hand sides that are solved together: enough for all threads, and little memory.
_STACK = 32


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


def products(A: Array, B: Array) -> Array:
    """(i, j) inner products of stacks of photos' values; not of BLAS, whose waiting threads take our processors."""
    return np.einsum("ima,jma->ij", A, B)


def _positive_inverse(A: Array) -> Array | None:
    """Inverse of a small symmetric matrix with unknowns of different scale; None if it is not positive."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(A), 1e-300))
    try:
        L = np.linalg.cholesky(scale[:, None] * A * scale)
    except np.linalg.LinAlgError:
        return None
    half = np.linalg.inv(L) * scale
    return half.T @ half


@dataclass(frozen=True)
class Factored:
    """A reduced system that is factored: its inverse, for as many right-hand sides as one likes.

    That is the inverse of the photos' own part, the cameras being held, and what r changes that photos and cameras make
    together add to it: frames and cameras Z, and their covariance M, as Z' M Z.

    Attributes
    ----------
    photos : CholeskyFactor or BlockFactor
        Of the photos' part.
    frames, cameras : (r, m, nb), (r, k) array
        The changes. Of each of the cameras' unknowns: -S^-1 B' of the photos, and 1 of itself.
    weights : (r, r) array
        Their covariance.
    """

    photos: CholeskyFactor | BlockFactor
    frames: Array
    cameras: Array
    weights: Array

    def solve(self, b: Array, c: Array) -> tuple[Array, Array]:
        """Solution of the photos (m, nb), 0 where held, and of the cameras (k,)."""
        x, y = self.times(b[None], c[None])
        return x[0], y[0]

    def times(self, b: Array, c: Array) -> tuple[Array, Array]:
        """The inverse times stacks of photos' values (n, m, nb) and of cameras' (n, k)."""
        if len(b) > _STACK:
            x, y = np.empty_like(b, order="C"), np.empty_like(c, order="C")
            for start in range(0, len(b), _STACK):
                some = slice(start, start + _STACK)
                x[some], y[some] = self.times(b[some], c[some])
            return x, y
        shares = (products(b, self.frames) + c @ self.cameras.T) @ self.weights
        shape = self.photos.shape
        rows = shape.gather(b)
        self.photos.solve(rows)
        return shape.scatter(rows) + np.tensordot(shares, self.frames, 1), shares @ self.cameras

    def diagonal_blocks(self) -> tuple[Array, Array]:
        """Blocks of the inverse of each photo (m, nb, nb), 0 where held, and that of all cameras (k, k)."""
        shared = np.einsum("rma,rs->sma", self.frames, self.weights)
        cameras = self.cameras.T @ self.weights @ self.cameras
        every = np.arange(self.frames.shape[1])
        own = self.photos.inverse_blocks(every, every)
        return own + np.einsum("sma,smb->mab", shared, self.frames), (cameras + cameras.T) / 2

    def pair_blocks(self, first: Index, second: Index) -> Array:
        """Blocks of the inverse of pairs of photos that the pattern connects, (q, nb, nb), 0 where held."""
        shared = np.einsum("rqa,rs->sqa", self.frames[:, first], self.weights)
        return self.photos.inverse_blocks(first, second) + np.einsum("sqa,sqb->qab", shared, self.frames[:, second])

    def photos_by_cameras(self) -> Array:
        """Blocks of the inverse between photos and cameras, (m, nb, k)."""
        return np.einsum("rma,rs,sk->mak", self.frames, self.weights, self.cameras)

    def joined(self, frames: Array, cameras: Array, weights: Array) -> Factored:
        """The inverse with more changes added."""
        r = len(self.weights)
        all_weights = np.zeros((r + len(weights),) * 2)
        all_weights[:r, :r], all_weights[r:, r:] = self.weights, weights
        return replace(
            self,
            frames=np.concatenate([self.frames, frames]),
            cameras=np.concatenate([self.cameras, cameras]),
            weights=all_weights,
        )


def factor(reduced: Reduced, shape: Envelope | SparseBlocks) -> Factored | None:
    """The system factored; None if it is not positive."""
    photos = shape.factor(reduced.S)
    if photos is None:
        return None
    rows = shape.gather(reduced.border)
    photos.solve(rows)
    X = shape.scatter(rows)
    cameras = _positive_inverse(reduced.corner - products(reduced.border, X))
    return None if cameras is None else Factored(photos, -X, np.eye(len(X)), cameras)
