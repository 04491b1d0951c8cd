"""Where the unknowns of a photo stand, and the functions that its motion bends by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ..model import BEND_GROUPS, SHUTTER_MODELS, Bend, Reconstruction
from ..model.array_types import Array
from ..model.bend import bend_functions, bend_pieces, splines_at
from .bundle_options import BundleOptions

__all__ = ["Layout", "motion_end"]

# Sites of known bends: twice as dense as those of the finest group.
_KNOWN_SITES = 2 * list(BEND_GROUPS.values())[-1][0] + 1
# Groups of bends that positions have, too: faster vibration rotates the camera, but hardly displaces it.
_WAYS = 2


def motion_end(shutter_model: str) -> int:
    """Unknowns of a photo's pose and steady motion: 6, 9 or 12."""
    return {"global": 6, "constant-motion": 12}.get(shutter_model, 9)


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
    known : mapping of photo name to (n, 6) array
        Bends that are known from elsewhere, at the same sites; what is estimated comes on top of them.
    """

    motion: int
    variation: int
    functions: Array
    group: tuple[int, ...]
    ways: int
    known: Mapping[str, Array]

    @classmethod
    def of(cls, shutter_model: str, options: BundleOptions) -> Layout:
        """The layout of a shutter model."""
        motion = motion_end(shutter_model)
        exact = SHUTTER_MODELS[shutter_model] >= SHUTTER_MODELS["rotation"]
        functions, group = bend_functions(options.bends) if exact and options.bends else (np.zeros((0, 0)), ())
        known = {name: _at_sites(bend, _KNOWN_SITES) for name, bend in options.known_bends.items() if exact}
        if known:
            place = np.linspace(0, 1, _KNOWN_SITES)
            functions = splines_at(len(functions), place) @ functions if group else np.zeros((_KNOWN_SITES, 0))
        ways = sum(each < _WAYS for each in group) if motion > 9 else 0
        # a shift of the principal point that lasts from frame to frame is a rotation of their path
        num_varying = (1 if options.path is not None else 3) if options.varying else 0
        return cls(motion, motion + num_varying, functions, group, ways, known)

    @property
    def bent(self) -> bool:
        """Whether motions are not steady."""
        return len(self.functions) > 0

    @property
    def num_varying(self) -> int:
        """How many intrinsics vary: log f alone on a path, else cx / fx and cy / fy, too; 0 if none does."""
        return self.variation - self.motion

    def varied(self, step: Array) -> Array:
        """(m, 3) what steps (m, nb) of the photos change of log f, cx / fx and cy / fy."""
        return np.pad(step[:, self.motion : self.variation], ((0, 0), (0, 3 - self.num_varying)))

    @property
    def num_bends(self) -> int:
        """Number of functions, of rotations and positions together."""
        return len(self.group) + self.ways

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.variation + 3 * self.num_bends

    @cached_property
    def pieces(self) -> Array:
        """(4 (n - 1), k) the functions as the kernels take them."""
        return bend_pieces(len(self.functions)) @ self.functions if self.group else np.zeros((0, 0))

    def per_bend(self, of_groups: Sequence[float], of_ways: Sequence[float]) -> Array:
        """(3 k,) numbers of the unknowns of bends, by groups."""
        values = [of_groups[each] for each in self.group] + [of_ways[each] for each in self.group[: self.ways]]
        return np.repeat(np.array(values, np.float64), 3)

    def still_bends(self, still: float, depth: float) -> Array:
        """(3 k,) weights of bends of a photo that was still to an angle per frame, or the translation that acts alike.

        A steady motion by this angle has a root mean square of angle / sqrt(12) over the lines.
        """
        sigma = self.per_bend([still] * len(self.group), [still * depth] * len(self.group))
        return np.asarray(12.0 / sigma**2)

    def values(self, bend: Array, names: Sequence[str]) -> Array:
        """(m, n, 6) values at the sites of coefficients (m, 3 k) of photos."""
        rotations = len(self.group)
        value = self._known_values(names)
        coefficients = bend.reshape(len(bend), -1, 3)
        value[..., :3] += self.functions @ coefficients[:, :rotations]
        value[..., 3:] += self.functions[:, : self.ways] @ coefficients[:, rotations:]
        return value

    def _known_values(self, names: Sequence[str]) -> Array:
        none = np.zeros((len(self.functions), 6))
        return np.array([self.known.get(name, none) for name in names]).reshape(len(names), *none.shape)

    def coefficients(self, reconstruction: Reconstruction) -> Array:
        """(m, 3 k) coefficients of the bends of a reconstruction, as far as they are along the functions."""
        m, rotations = reconstruction.num_images, len(self.group)
        found = np.zeros((m, self.num_bends, 3))
        if reconstruction.bends and rotations:
            bends = [reconstruction.motion(i).bend for i in range(m)]
            values = np.stack([_at_sites(bend, len(self.functions)) for bend in bends if bend is not None])
            values -= self._known_values(reconstruction.image_names)
            inverse = np.linalg.pinv(self.functions)
            found[:, :rotations] = inverse @ values[..., :3]
            found[:, rotations:] = (inverse @ values[..., 3:])[:, : self.ways]
        return found.reshape(m, -1)


def _at_sites(bend: Bend, num_sites: int) -> Array:
    """(n, 6) values of a bend at as many sites as others have."""
    return np.asarray(_between(len(bend.values), num_sites) @ bend.values)


@lru_cache(maxsize=8)
def _between(num_own: int, num_sites: int) -> Array:
    """(n, k) splines through one value each of k sites, at n sites."""
    return splines_at(num_own, np.linspace(0, 1, num_sites))
