"""How a motion departs from a steady one while the frame is read: the one place that knows its functions.

A bend is a cubic spline through values at sites spread evenly over the frame, without a knot at the second and the last
but one (de Boor's "not a knot": what `scipy.interpolate.CubicSpline` does), so that any program can evaluate it. Sites
at n - 1 intervals hold all that fewer of them, halved as often, can say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from ..errors import InputError
from .array_types import Array
from .checks import check_finite, check_whole, frozen
from .values import ComparedByFields

__all__ = ["BEND_GROUPS", "Bend", "bend_functions", "bend_pieces", "bend_table", "parts_of", "splines_at"]


#: Groups of functions, by what they add to those before: a rate that changes steadily, its change changing, and then
#: splines of ever more intervals. Each with its number of intervals and how many functions there are up to it. The last
#: follow five periods in a frame to 1.5 % of their amplitude, sixteen intervals to 9 %; and what they do not follow
#: bends the lens and the height of the scene.
BEND_GROUPS: dict[str, tuple[int, int]] = {
    "quadratic": (3, 1),
    "cubic": (3, 2),
    "6 intervals": (6, 5),
    "12 intervals": (12, 11),
    "24 intervals": (24, 23),
}
_MOST_SITES = 1025


@lru_cache(maxsize=32)
def bend_pieces(num_sites: int) -> Array:
    """(4 (n - 1), n) coefficients of powers of the place, 0 to 1, in each interval of a spline, four by four.

    Times the values at n sites.
    """
    spline = CubicSpline(np.arange(num_sites), np.eye(num_sites))
    return frozen(spline.c[::-1].transpose(1, 0, 2).reshape(-1, num_sites))


@lru_cache(maxsize=32)
def _gram(num_sites: int) -> Array:
    """(n, n) mean over the frame of products of the splines through one value each."""
    place, weight = np.polynomial.legendre.leggauss(4)
    powers = ((place + 1) / 2)[:, None] ** np.arange(4)
    values = np.einsum("qk,ikn->iqn", powers, bend_pieces(num_sites).reshape(-1, 4, num_sites))
    values = (np.sqrt(weight / 2)[:, None] * values).reshape(-1, num_sites)
    return frozen(values.T @ values / (num_sites - 1))


@lru_cache(maxsize=8)
def bend_functions(groups: int) -> tuple[Array, tuple[int, ...]]:
    """Functions of the first groups of `BEND_GROUPS` at the sites of the last of these.

    Returns
    -------
    values : (n, k) array
        At n sites; orthogonal to 1, to the clock and to each other, and of mean square 1 over the frame. So pose and
        phi keep their meaning, those of the steady motion that is nearest; and a coefficient is a root mean square.
    group : (k,) tuple
        Index of the group of each.
    """
    chosen = list(BEND_GROUPS.values())[:groups]
    num = chosen[-1][0] + 1
    gram, place = _gram(num), np.linspace(-1, 1, num)
    found: list[Array] = []

    def orthogonal(values: Array) -> Array:
        """What the values (n,) have beyond the functions found, of mean square 1."""
        for _ in range(2):  # twice is enough (Kahan)
            values = values - sum(((values @ gram @ each) * each for each in found), np.zeros(num))
        return np.asarray(values / np.sqrt(values @ gram @ values))

    for power in range(2):
        found.append(orthogonal(place**power))
    group = []
    for index, (intervals, count) in enumerate(chosen):
        new = count - (len(found) - 2)
        if index < 2:
            found.append(orthogonal(place ** (index + 2)))
        else:
            # splines through one value each, and of those as many as add anything: they fill the space in any order
            step = (num - 1) // intervals
            coarse = np.linspace(0, num - 1, intervals + 1)
            spline = _values_at(np.eye(intervals + 1), np.arange(num) / step)
            order = np.argsort(np.minimum(coarse, num - 1 - coarse), kind="stable")[::-1]
            for k in [each for each in order if 0 < each < intervals][:new]:
                found.append(orthogonal(spline[:, k]))
        group += [index] * new
    return frozen(np.stack(found[2:], axis=1)), tuple(group)


def _values_at(values: Array, place: Array) -> Array:
    """Splines through values (n, ...) at places (p,) from 0 to n - 1, (p, ...); along the tangent beyond these."""
    last = len(values) - 1
    at = np.nan_to_num(np.clip(np.floor(place), 0, last - 1)).astype(int)
    u = np.clip(place - at, 0.0, 1.0)
    beyond = place - at - u
    pieces = (bend_pieces(last + 1) @ values.reshape(last + 1, -1)).reshape(last, 4, -1)[at]
    powers = np.stack([np.ones_like(u), u + beyond, u * (u + 2 * beyond), u * u * (u + 3 * beyond)], axis=1)
    return np.einsum("pk,pkc->pc", powers, pieces).reshape(len(place), *values.shape[1:])


def splines_at(num_sites: int, place: Array) -> Array:
    """(p, n) splines through one value each of n even sites, at places (p,) in the frame, 0 to 1."""
    return _values_at(np.eye(num_sites), np.asarray(place, np.float64) * (num_sites - 1))


def parts_of(clock: Array, readings: Array, sites: int) -> tuple[Array, Array, Array]:
    """Parts of readings (k, c) at ascending times of the clock (k,): bends (sites, c), constants and rates (c,)."""
    values = CubicSpline(clock, readings)(np.linspace(clock[0], clock[-1], sites))
    place, gram = np.linspace(-1, 1, sites), _gram(sites)
    ones = np.ones(sites)
    mean = (ones @ gram @ values) / (ones @ gram @ ones)
    slope = (place @ gram @ values) / (place @ gram @ place)
    rate = slope * 2 / (clock[-1] - clock[0])
    return values - mean - place[:, None] * slope, mean - rate * (clock[0] + clock[-1]) / 2, rate


@dataclass(frozen=True, eq=False)
class Bend(ComparedByFields):
    """How rotation and position depart from those of a steady motion, while the clock runs over a frame.

    Parameters
    ----------
    start, end : float
        The clock where the frame begins and ends.
    rotation : (n, 3) array
        Radians, added to r phi, at n >= 4 evenly spaced readings of the clock from start to end, these included.
    position : (n, 3) array, optional
        World units, added to r velocity; zero when left out.

    Between these readings both are cubic splines, `scipy.interpolate.CubicSpline(bend.clock, bend.rotation)`; before
    the start and behind the end they go on along their tangents. What is constant in them, or grows as the clock does,
    is for the pose and for phi to say: `Bend.of` separates these.
    """

    start: float
    end: float
    rotation: Array
    position: Array | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite([self.start, self.end]).all() and self.start < self.end):
            raise InputError(f"a bend from {self.start!r} to {self.end!r}, expected a start before the end")
        rotation = check_finite(self.rotation, (None, 3), "rotation of the bend")
        if not 4 <= len(rotation) <= _MOST_SITES:
            raise InputError(f"a bend of {len(rotation)} readings, expected 4 to {_MOST_SITES}")
        position = np.zeros_like(rotation) if self.position is None else self.position
        object.__setattr__(self, "rotation", frozen(rotation))
        object.__setattr__(self, "position", frozen(check_finite(position, rotation.shape, "position of the bend")))

    @classmethod
    def of(
        cls, clock: ArrayLike, rotation: ArrayLike, position: ArrayLike | None = None, sites: int = 65
    ) -> tuple[Bend, Array, Array]:
        """The bend nearest to readings, and what of these a steady motion says.

        Parameters
        ----------
        clock : (k,) array
            Ascending, from the start of the frame to its end.
        rotation, position : (k, 3) array
            Rotation vectors and positions there.
        sites : int
            Readings of the bend.

        Returns
        -------
        bend : Bend
            Orthogonal to 1 and to the clock.
        constant, rate : (2, 3) array
            Of the rotation and of the position: what they are at a clock of 0, and by how much they grow with it.
        """
        sites = check_whole(sites, "sites", 4, 10**6)
        r = check_finite(clock, (None,), "clock")
        if len(r) < 4 or not (np.diff(r) > 0).all():
            raise InputError("the readings of the clock must ascend, and be four or more")
        vectors = check_finite(rotation, (len(r), 3), "rotation")
        way = np.zeros_like(vectors) if position is None else check_finite(position, (len(r), 3), "position")
        rest, constant, rate = parts_of(r, np.hstack([vectors, way]), sites)
        return cls(float(r[0]), float(r[-1]), rest[:, :3], rest[:, 3:]), constant.reshape(2, 3), rate.reshape(2, 3)

    @property
    def clock(self) -> Array:
        """(n,) readings of the clock."""
        return np.linspace(self.start, self.end, len(self.rotation))

    @cached_property
    def values(self) -> Array:
        """(n, 6) rotation and position."""
        assert self.position is not None
        return frozen(np.hstack([self.rotation, self.position]))

    @property
    def moves(self) -> bool:
        """Whether the position departs, too."""
        return bool(self.values[:, 3:].any())

    def at(self, clock: ArrayLike) -> tuple[Array, Array]:
        """Rotation vectors and positions (..., 3) to be added when the clock shows r (...)."""
        r = np.asarray(clock, np.float64)
        place = (r.ravel() - self.start) / (self.end - self.start) * (len(self.values) - 1)
        found = _values_at(self.values, place).reshape(*r.shape, 6)
        return found[..., :3], found[..., 3:]

    def rotated(self, matrix: ArrayLike, of_position: ArrayLike | None = None) -> Bend:
        """The bend with its rotation vectors, or its positions too, in other axes."""
        assert self.position is not None
        rotation = self.rotation @ np.asarray(matrix, np.float64).T
        position = self.position if of_position is None else self.position @ np.asarray(of_position, np.float64).T
        return replace(self, rotation=rotation, position=position)


def bend_table(phi: ArrayLike, start: ArrayLike, end: ArrayLike, values: ArrayLike) -> Array:
    """(..., 1 + 4 (n - 1), 6) motions as the kernels take them: `_kernels.projection._path`.

    Of phi (..., 3), the clock at the start and at the end of the frame (...), and a bend's values (..., n, 6).
    """
    values, phi = np.asarray(values, np.float64), np.asarray(phi, np.float64)
    num = values.shape[-2]
    table = np.zeros((*values.shape[:-2], 1 + 4 * (num - 1), 6))
    table[..., 0, :3] = phi
    table[..., 0, 3] = start
    table[..., 0, 4] = (np.asarray(end) - start) / (num - 1)
    table[..., 1:, :] = bend_pieces(num) @ values
    return table
