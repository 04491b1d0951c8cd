"""Other models that may be right, too: how far they would move what is corrected, and the motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array
from ..model.reprojection import shutter_displacements, typical_px
from .doubt import steps_to

__all__ = ["LEAST_RIVAL", "UNSEEN_PX", "Rival", "largest_steps", "moved_otherwise"]

#: Photos are displaced this much otherwise by a velocity that explains them as well, as a share of what is corrected.
LEAST_RIVAL = 1 / 3
#: Motions that displace pixels by less than this count as none.
UNSEEN_PX = 0.5


def moved_otherwise(rec: Reconstruction, other: Reconstruction) -> float:
    """By how much another model of the same measurements displaces photos otherwise, over what this one displaces.

    Both are means over the photos of their medians. 0 where the first is less than half a pixel.
    """
    (own, seen), (others, valid) = shutter_displacements(rec), shutter_displacements(other)
    apart, size = (typical_px(rec, each, seen & valid) for each in (others - own, own))
    return float(apart / max(size, 1e-9)) if apart >= UNSEEN_PX else 0.0


@dataclass(frozen=True)
class Rival:
    """A model beside the one that was kept.

    Attributes
    ----------
    model : str
        The shutter model.
    probability : float
        With which it is right, and not the one that was kept.
    steps : (m, 12) array
        How far it moves rotation, centre, phi and velocity of each photo.
    """

    model: str
    probability: float
    steps: Array

    @classmethod
    def of(cls, other: Reconstruction, rec: Reconstruction, probability: float) -> Rival:
        """Another model's solution of the same photos as one that was kept."""
        return cls(other.shutter_model, probability, steps_to(other, rec))

    @property
    def weighed(self) -> Array:
        """(m, 12) steps times the root of the probability: what covariances have the square of (`bundle.doubt`)."""
        return np.asarray(np.sqrt(self.probability) * self.steps)


def largest_steps(rivals: Mapping[str, Rival], names: tuple[str, ...]) -> dict[str, tuple[float, ...]]:
    """By photo the weighed steps of the rival that moves the rotations during the readout most."""
    if not rivals:
        return {}
    most = max((each.weighed for each in rivals.values()), key=lambda steps: float((steps[:, 6:9] ** 2).sum()))
    return {name: tuple(each) for name, each in zip(names, most.tolist(), strict=True)}
