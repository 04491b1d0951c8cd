"""The reduced system of the photos, bordered by what they share, and its factorisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .envelope import Envelope

__all__ = ["Factored", "Reduced", "factor", "products"]

Array = NDArray[np.float64]


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

    def solve(self, b: Array, c: Array) -> tuple[Array, Array]:
        """Solution of the photos (m, nb), 0 where held, and of the cameras (k,)."""
        x = self.solve_photos(b[None])
        y = self.cameras @ (c - products(self.border, x)[:, 0])
        return x[0] - np.tensordot(y, self.border_solved, 1), y

    def solve_photos(self, b: Array) -> Array:
        """S^-1 b for stacks (k, m, nb): the cameras being held."""
        rows = self.envelope.gather(b)
        self.solve_rows(rows)
        return self.envelope.scatter(rows)

    def covariance_times(self, vectors: Array) -> Array:
        """Covariance of the photos' unknowns, the cameras being free, times vectors (k, m, nb)."""
        found = self.solve_photos(vectors)
        return found + np.tensordot(products(found, self.border) @ self.cameras, self.border_solved, 1)


def factor(reduced: Reduced, envelope: Envelope) -> Factored | None:
    """The system factored; None if it is not positive."""
    solve = envelope.factor(reduced.S)
    if solve is None:
        return None
    rows = envelope.gather(reduced.border)
    solve(rows)
    X = envelope.scatter(rows)
    cameras = _positive_inverse(reduced.corner - products(reduced.border, X))
    return None if cameras is None else Factored(envelope, solve, reduced.border, X, cameras)
