"""Lengths that are known: they fix the ratios of a scene that a critical motion leaves open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import InputError
from ..model import KnownLength, Reconstruction
from ..model.array_types import Array, Index
from ..model.known_length import End

__all__ = ["LengthResiduals", "check_lengths", "measured_lengths", "scale_of_lengths"]

# Largest distance of a point's measurement from where the user pointed, pixels.
_REACH_PX = 5.0


def check_lengths(lengths: Sequence[KnownLength]) -> tuple[KnownLength, ...]:
    """The lengths, refused if there is only one: it determines the scale of the world, which changes no photo."""
    if len(lengths) == 1:
        raise InputError("one known length determines only the scale of the world; give two, or a height and a width")
    return tuple(lengths)


def measured_lengths(
    reconstruction: Reconstruction, lengths: Sequence[KnownLength]
) -> tuple[tuple[KnownLength, ...], list[str]]:
    """The lengths between two points that are measured, none if only one is left; and why the others are none.

    Points change while outliers are dropped and tracks are made again.
    """
    kept, lost = [], []
    for each in lengths:
        ends = [_nearest_point(reconstruction, end) for end in (each.start, each.end)]
        far = [end for end, point in zip((each.start, each.end), ends, strict=True) if point is None]
        lost += [f"no point is measured within {_REACH_PX:.0f} px of ({x:g}, {y:g}) in {name}" for name, x, y in far]
        if ends[0] == ends[1] and not far:
            lost.append(f"{each.start} and {each.end} are the same point of the scene")
        elif not far:
            kept.append(each)
    if len(kept) == 1:
        lost.append("it is the only one left, and ratios need two")
    return tuple(kept if len(kept) > 1 else ()), lost


def _nearest_point(reconstruction: Reconstruction, end: End) -> int | None:
    """The point that is measured nearest to a pixel of a photo; None if there is none near it."""
    name, x, y = end
    if name not in reconstruction.image_names:
        raise InputError(f"known length: {name!r} is not a photo of the reconstruction")
    obs = reconstruction.observations
    mine = np.flatnonzero(obs.frame_idx == reconstruction.image_names.index(name))
    distance = np.linalg.norm(obs.xy_raw[mine] - [x, y], axis=1)
    if not len(mine) or distance.min() > _REACH_PX:
        return None
    return int(obs.point_idx[mine[np.argmin(distance)]])


def scale_of_lengths(reconstruction: Reconstruction, lengths: Sequence[KnownLength]) -> tuple[float, float]:
    """Lengths of a reconstruction over the known ones, their weighted geometric mean, and its relative deviation."""
    chord = np.diff(reconstruction.points_w[_ends(reconstruction, lengths)], axis=1)[:, 0]
    found = np.log(np.linalg.norm(chord, axis=1) / [each.length for each in lengths])
    weight = np.array([(each.length / each.sigma) ** 2 for each in lengths])
    return float(np.exp(np.average(found, weights=weight))), float(weight.sum() ** -0.5)


def _ends(reconstruction: Reconstruction, lengths: Sequence[KnownLength]) -> Index:
    """(q, 2) points that `measured_lengths` are between."""
    found = [[_nearest_point(reconstruction, end) for end in (each.start, each.end)] for each in lengths]
    return np.array(found, np.int64).reshape(-1, 2)


class LengthResiduals:
    """Residuals of known lengths, none or two and more: logarithms of their ratios, the common scale taken out.

    They are those that are measured (`measured_lengths`).
    """

    def __init__(self, reconstruction: Reconstruction, lengths: Sequence[KnownLength]) -> None:
        self._ends = _ends(reconstruction, lengths)
        self._target = np.log([each.length for each in lengths])
        weight = np.array([each.length / each.sigma for each in lengths])
        unit = weight[:, None] / max(float(np.linalg.norm(weight)), 1e-300)
        # weighted, and without the part that a change of the world's scale explains
        self._whiten = (np.eye(len(lengths)) - unit @ unit.T) * weight

    def residuals(self, points_w: Array) -> Array:
        """(q,) residuals in units of their standard deviations."""
        chord = points_w[self._ends[:, 1]] - points_w[self._ends[:, 0]]
        length = np.maximum(np.linalg.norm(chord, axis=1), 1e-300)
        return self._whiten @ (np.log(length) - self._target)

    def jacobian(self, points_w: Array) -> Array:
        """(q, n, 3) derivatives of the residuals by the points."""
        chord = points_w[self._ends[:, 1]] - points_w[self._ends[:, 0]]
        along = chord / np.maximum((chord**2).sum(1, keepdims=True), 1e-300)
        J = np.zeros((len(self._target), len(points_w), 3))
        for k, (a, b) in enumerate(self._ends):
            J[:, a] -= self._whiten[:, k, None] * along[k]
            J[:, b] += self._whiten[:, k, None] * along[k]
        return J
