"""How the reduced system of the photos is solved: factored, or by conjugate gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model.array_types import Array, Mask
from .coarse_space import CoarseSpace
from .conjugate_gradients import solve_iteratively
from .envelope import Envelope
from .reduced import Reduced, factor
from .sparse_blocks import Chain, SparseBlocks
from .structure import Structure

__all__ = ["Elimination"]

# Iterations that conjugate gradients are expected to take (measured: 5 to 30 a step on blocks of 50 to 2500 photos).
_EXPECTED_CG = 20
_MAX_CG = 500
# A multiply-add that waits for memory, as those of products and substitutions do, takes the time of so many of the
# factorisation's (measured: 2e9 and 1.5e10 a second of one processor).
_WAIT = 6.0
# Photos of a cluster, at least; twice as many, and again, while the coarse system would take longer than the products.
_CLUSTER = 32


@dataclass(frozen=True)
class Elimination:
    """How the reduced system of a structure is solved: fixed while a problem is solved.

    Attributes
    ----------
    free : (m, nb) bool array
        Unknowns that are not held.
    shape : Envelope or SparseBlocks
        Of the factor of the whole system.
    space : CoarseSpace or None
        Of the preconditioner, if the system is solved by conjugate gradients.
    cg_tolerance : float
        Where these stop.
    max_cg : int
        Iterations that they may take.
    """

    structure: Structure
    free: Mask
    shape: Envelope | SparseBlocks
    space: CoarseSpace | None
    cg_tolerance: float
    max_cg: int

    @classmethod
    def of(
        cls,
        structure: Structure,
        free: Mask,
        poses: tuple[Array, Array],
        factor_limit: float | None,
        cg_tolerance: float,
        chain: Chain | None = None,
    ) -> Elimination:
        """Choose between factorisation and conjugate gradients, for photos at R_cw (m, 3, 3) and center_w (m, 3).

        Conjugate gradients are taken if they are expected to take half the time of the factorisation, or, with a limit,
        if that takes more multiply-adds. In the first case they may take as long as the factorisation, which then
        solves what they have not. Frames that a path chains share points with few others, key frames with any: their
        factor is sparse inside its envelope.
        """
        shape = (
            Envelope.smallest(structure.pattern, free)
            if chain is None
            else SparseBlocks.of(structure.pattern, free, chain)
        )
        adds = shape.multiply_adds
        products = 2 * _WAIT * 2 * len(structure.pattern.cols) * free.shape[1] ** 2  # of one iteration
        if adds <= (2 * _EXPECTED_CG * products if factor_limit is None else factor_limit):
            return cls(structure, free, shape, None, cg_tolerance, 0)
        photos = _CLUSTER
        space = CoarseSpace.of(structure.pattern, free, *poses, photos)
        while space.envelope.multiply_adds > _EXPECTED_CG * products and photos < len(free):
            photos *= 2
            space = CoarseSpace.of(structure.pattern, free, *poses, photos)
        if factor_limit is not None:
            return cls(structure, free, shape, space, cg_tolerance, _MAX_CG)
        iteration = products + _WAIT * 2 * space.envelope.num_values
        worth = 2 * (space.envelope.multiply_adds + _EXPECTED_CG * iteration) < adds
        return cls(structure, free, shape, space if worth else None, cg_tolerance, min(_MAX_CG, int(adds / iteration)))

    def solve(self, reduced: Reduced, exact: bool = False) -> tuple[Array, Array, Array, Array] | None:
        """Solution of the photos (m, nb), 0 where held, and of the cameras (k,), with the residuals of both.

        None if the matrix is not positive. `exact` asks for the factorisation.
        """
        if self.space is not None and not exact:
            found = solve_iteratively(reduced, self.space, self.structure.pattern, self.cg_tolerance, self.max_cg)
            if self.max_cg == _MAX_CG or (found is not None and found.converged):
                return None if found is None else (found.x, found.y, found.residual, found.camera_residual)
        factored = factor(reduced, self.shape)
        if factored is None:
            return None
        x, y = factored.solve(reduced.b, reduced.c)
        return x, y, np.zeros_like(x), np.zeros_like(y)
