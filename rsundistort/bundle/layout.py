"""Where the unknowns of a photo stand, and the functions that its motion bends by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..model import SHUTTER_MODELS, Reconstruction
from ..model.bend import bend_functions, bend_pieces
from .options import BundleOptions

__all__ = ["Layout"]

# Groups of bends that positions have, too: what vibrates faster than that turns, but hardly travels.
_WAYS = 2


@dataclass(frozen=True)
class Layout:
    """Where the unknowns of a photo stand in its block: pose, phi, velocity; the variation of its intrinsics; bends.

    Attributes
    ----------
    motion : int
        Where pose and steady motion end: 6, 9 or 12.
    variation : int
        Where the variation ends, after it or right there.
    functions : (n, k) array
        What bends the rotations, at n sites; k may be 0.
    group : (k,) tuple of int
        Group of each.
    ways : int
        How many of them bend the positions.
    """

    motion: int
    variation: int
    functions: NDArray[np.float64]
    group: tuple[int, ...]
    ways: int

    @classmethod
    def of(cls, shutter_model: str, options: BundleOptions) -> Layout:
        """That of a model."""
        motion = {"global": 6, "constant-motion": 12}.get(shutter_model, 9)
        groups = options.bends if SHUTTER_MODELS[shutter_model] >= SHUTTER_MODELS["rotation"] else 0
        functions, group = bend_functions(groups) if groups else (np.zeros((0, 0)), ())
        ways = sum(each < _WAYS for each in group) if motion > 9 else 0
        return cls(motion, motion + 3 * options.varying, functions, group, ways)

    @property
    def num_bends(self) -> int:
        """Number of functions, of rotations and positions together."""
        return len(self.group) + self.ways

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.variation + 3 * self.num_bends

    @cached_property
    def pieces(self) -> NDArray[np.float64]:
        """(4 (n - 1), k) the functions as the kernels take them."""
        return bend_pieces(len(self.functions)) @ self.functions if self.group else np.zeros((0, 0))

    def per_bend(self, of_groups: Sequence[float], of_ways: Sequence[float]) -> NDArray[np.float64]:
        """(3 k,) numbers of the unknowns of bends, by groups."""
        values = [of_groups[each] for each in self.group] + [of_ways[each] for each in self.group[: self.ways]]
        return np.repeat(np.array(values, np.float64), 3)

    def values(self, bend: NDArray[np.float64]) -> NDArray[np.float64]:
        """(m, n, 6) values at the sites of coefficients (m, 3 k)."""
        turns = len(self.group)
        value = np.zeros((len(bend), len(self.functions), 6))
        coefficients = bend.reshape(len(bend), -1, 3)
        value[..., :3] = self.functions @ coefficients[:, :turns]
        value[..., 3:] = self.functions[:, : self.ways] @ coefficients[:, turns:]
        return value

    def coefficients(self, reconstruction: Reconstruction) -> NDArray[np.float64]:
        """(m, 3 k) coefficients of the bends of a reconstruction, as far as they are along the functions."""
        m, turns = reconstruction.num_images, len(self.group)
        found = np.zeros((m, self.num_bends, 3))
        if reconstruction.bends and turns:
            bends = [reconstruction.motion(i).bend for i in range(m)]
            at = [np.linspace(each.start, each.end, len(self.functions)) for each in bends if each is not None]
            readings = [np.hstack(bend.at(clock)) for bend, clock in zip(bends, at, strict=True) if bend is not None]
            values = np.stack(readings)
            inverse = np.linalg.pinv(self.functions)
            found[:, :turns] = inverse @ values[..., :3]
            found[:, turns:] = (inverse @ values[..., 3:])[:, : self.ways]
        return found.reshape(m, -1)
