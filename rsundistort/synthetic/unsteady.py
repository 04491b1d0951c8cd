"""Unsteady motions during the readout: accelerations, vibrations, a gyroscope's track, poses by row."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ..errors import FormatError, InputError, RsUndistortWarning
from ..io.gyro import GyroLog
from ..io.tables import read_table
from ..model import Camera, RowMotion
from ..model.array_types import Array
from ..model.checks import check_array, check_finite, frozen

__all__ = [
    "Poses",
    "RowTable",
    "Vibration",
    "accelerations",
    "read_row_tables",
    "row_table",
    "tracks",
    "unsteady",
    "unsteady_motions",
    "vibrations",
]

#: Rotation vectors and positions (k, 3) at values (k,) of the clock.
Poses = Callable[[Array], tuple[Array, Array]]

AXES = ("random", "x", "y", "z")
# Values of a bend: as many as most motions need, and the largest number.
_SITES, _MOST_SITES = 65, 1025
# Values at which a motion is sampled and checked: at 1.5 mrad and 100 periods a frame right to 1e-9 rad.
_SAMPLES = 4097
_TOLERATED_PX = 0.02
# Steps between the rows of a table that count as a gap, in units of the median.
_GAP_STEPS = 5.0


@dataclass(frozen=True)
class Vibration:
    """A harmonic vibration of random phase.

    Parameters
    ----------
    amplitude_rad : float
        Of the rotation.
    periods : (float, float)
        Per frame; drawn uniformly between these for each photo.
    axis : str
        Axis of rotation in the camera frame: "x", "y", "z", or "random" for each photo.
    travel : float
        Amplitude of the position, world units, with the same frequency and a direction and phase of its own.
    """

    amplitude_rad: float = 0.0
    periods: tuple[float, float] = (2.0, 5.0)
    axis: str = "random"
    travel: float = 0.0

    def __post_init__(self) -> None:
        for name in ("amplitude_rad", "travel"):
            value = check_finite(getattr(self, name), (), f"vibration: {name}")
            if value < 0:
                raise InputError(f"vibration: {name}={value:g}, expected 0 or more")
        low, high = check_finite(self.periods, (2,), "vibration: periods").tolist()
        if not 0 < low <= high <= 100:
            raise InputError(f"vibration: periods={low:g} to {high:g} a frame, expected a range between 0 and 100")
        if self.axis not in AXES:
            raise InputError(f"vibration: axis {self.axis!r}, expected one of {', '.join(AXES)}")


@dataclass(frozen=True)
class RowTable:
    """Poses of a camera by the row that it read.

    Parameters
    ----------
    at : (k,) array
        Ascending rows (columns, if these are read one after the other), pixels; or values of the clock.
    rotation : (k, 3) array
        Rotation vectors in radians: the pose there is `Exp(rotation) R_cw`, with R_cw that of the photo.
    position : (k, 3) array, optional
        Added to the centre of the camera, world units.
    by_clock : bool
        Whether `at` is the clock.

    Between its rows a table is a cubic spline. It must cover all rows of the photo, without a gap.
    """

    at: Array
    rotation: Array
    position: Array | None = None
    by_clock: bool = False

    def __post_init__(self) -> None:
        what = "clock" if self.by_clock else "row"
        at = check_array(self.at, (None,), what)
        rotation = check_array(self.rotation, (len(at), 3), "rotation")
        given = np.zeros_like(rotation) if self.position is None else self.position
        position = check_array(given, (len(at), 3), "position")
        for field, value in (("at", at), ("rotation", rotation), ("position", position)):
            known = np.isfinite(value.reshape(len(at), -1)).all(axis=1)
            if not known.all():
                k = int(np.argmin(known))
                raise InputError(f"NaN or infinity in pose {k + 1} of {len(at)}, {what} {at[k]:g}")
            object.__setattr__(self, field, frozen(value))
        if len(at) < 4:
            raise InputError(f"{len(at)} poses, expected 4 or more")
        step = np.diff(at)
        if (step <= 0).any():
            k = int(np.argmax(step <= 0))
            raise InputError(f"{what} {at[k + 1]:g} comes after {at[k]:g}; expected ascending ones, each once")
        if (step > _GAP_STEPS * np.median(step)).any():
            k = int(np.argmax(step))
            raise InputError(f"a gap between {what} {at[k]:g} and {at[k + 1]:g}; others are {np.median(step):g} apart")

    def path(self, camera: Camera) -> Poses:
        """The pose as a function of the clock of a camera, which must not show more than the table has."""
        assert self.position is not None
        axis, sign = camera.clock_axis, camera.clock_sign
        last, f, c = (camera.width, camera.height)[axis] - 1, camera.K[axis, axis], camera.K[axis, 2]
        need = sorted(sign * (np.array([0, last]) - c) / f) if self.by_clock else [0.0, float(last)]
        slack = 1e-6 * (need[1] - need[0])
        if self.at[0] > need[0] + slack or self.at[-1] < need[1] - slack:
            what = "the clock" if self.by_clock else ("columns", "rows")[axis]
            raise InputError(
                f"poses from {self.at[0]:g} to {self.at[-1]:g}, but {what} of the photo from {need[0]:g} to {need[1]:g}"
            )
        # relative to the middle, where no rotation vector wraps
        readings = Rotation.from_rotvec(np.array(self.rotation))  # it takes nothing read-only
        middle = readings[len(readings) // 2]
        spline = CubicSpline(self.at, np.hstack([(readings * middle.inv()).as_rotvec(), self.position]))

        def path(clock: Array) -> tuple[Array, Array]:
            values = spline(clock if self.by_clock else sign * clock * f + c)
            return (Rotation.from_rotvec(values[:, :3]) * middle).as_rotvec(), values[:, 3:]

        return path


def unsteady(
    name: str, camera: Camera, steady: RowMotion | RowTable | Poses, share: ArrayLike = 0.0, shake: Poses | None = None
) -> tuple[RowMotion, Array, Array]:
    """The motion of a photo, with its unsteady part.

    Parameters
    ----------
    steady : RowMotion, RowTable or function
        The motion without the following; functions give rotation vectors and positions (k, 3) at values (k,) of the
        clock.
    share : (3,) array
        Relative growth of each component of phi from the middle of the frame to its end: the rate is `phi (1 + share
        s)`, s from -1 to 1.
    shake : function, optional
        A vibration that is added.

    Returns
    -------
    motion, correction, way
        As `RowMotion.of`. A spline that deviates from the motion by more than 0.02 px causes a warning.
    """
    start, end = camera.clock_range
    clock = np.linspace(start, end, _SAMPLES)
    try:
        path = steady.path(camera) if isinstance(steady, RowTable) else steady
    except InputError as error:
        raise InputError(f"table of {name}: {error}") from error
    rotation, position = path.at(clock) if isinstance(path, RowMotion) else path(clock)
    if isinstance(path, RowMotion):
        middle, half = (start + end) / 2, (end - start) / 2
        rotation = rotation + np.outer((clock - middle) ** 2 / (2 * half), path.phi * np.asarray(share, np.float64))
    sites, readings = _SITES, Rotation.from_rotvec(rotation)
    if shake is not None:
        rotated, moved = shake(clock)
        readings, position = Rotation.from_rotvec(rotated) * readings, position + moved
    while True:
        motion, correction, way = RowMotion.of(clock, readings.as_rotvec(), position, sites)
        found, gone = motion.at(clock)
        missed = (Rotation.from_rotvec(found) * Rotation.from_matrix(correction) * readings.inv()).magnitude().max()
        missed_px = float(
            np.diag(camera.K)[:2].max() * max(missed, np.linalg.norm(gone + way - position, axis=1).max())
        )
        if missed_px <= _TOLERATED_PX or sites == _MOST_SITES:
            break
        sites = 2 * sites - 1
    if missed_px > _TOLERATED_PX:
        warnings.warn(
            f"{name}: the truth follows the motion to {missed_px:.2g} px (at a depth of 1), by {sites} readings",
            RsUndistortWarning,
            stacklevel=2,
        )
    return motion, correction, way


def unsteady_motions(
    start: Mapping[str, RowMotion | RowTable | Poses],
    cameras: Sequence[Camera],
    acceleration: float,
    vibration: Vibration | None,
    seed: int,
    still: Collection[str] = (),
) -> dict[str, tuple[RowMotion, Array, Array]]:
    """Motions of photos as of `unsteady`, with random accelerations and vibrations; steady ones stay.

    `start` is by photo, in the order of `cameras`; `acceleration` as `accelerations` takes it. A still photo does not
    move.
    """
    shares = accelerations(len(start), acceleration, seed)
    shakes: Sequence[Poses | None] = [None] * len(start)
    if vibration is not None:
        shakes = vibrations(list(cameras), vibration, seed)
    found = {}
    for (name, given), camera, share, shake in zip(start.items(), cameras, shares, shakes, strict=True):
        each = RowMotion() if name in still else given
        if isinstance(each, RowMotion) and (name in still or (shake is None and not acceleration)):
            found[name] = each, np.eye(3), np.zeros(3)
        else:
            found[name] = unsteady(name, camera, each, share, shake)
    return found


def accelerations(num: int, sigma: float, seed: int) -> Array:
    """(num, 3) relative growth of the components of phi over half a frame, normal with this standard deviation."""
    if not (sigma >= 0 and np.isfinite(sigma)):
        raise InputError(f"acceleration={sigma}, expected a share of 0 or more")
    return sigma * np.random.default_rng([seed, 7]).normal(size=(num, 3))


def vibrations(cameras: list[Camera], vibration: Vibration, seed: int) -> list[Poses]:
    """The vibration of each photo; the same seed draws the same."""
    rng = np.random.default_rng([seed, 8])
    return [_shake(camera, vibration, rng) for camera in cameras]


def _shake(camera: Camera, vibration: Vibration, rng: np.random.Generator) -> Poses:
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    if vibration.axis != "random":
        axes[0] = np.eye(3)["xyz".index(vibration.axis)]
    swing, move = vibration.amplitude_rad * axes[0], vibration.travel * axes[1]
    rate = 2 * np.pi * rng.uniform(*vibration.periods) / camera.frame_span
    phase, late = rng.uniform(0, 2 * np.pi, 2)
    return lambda clock: (np.outer(np.sin(rate * clock + phase), swing), np.outer(np.sin(rate * clock + late), move))


def tracks(log: GyroLog, cameras: list[Camera], readout_s: float | None, seed: int) -> list[Poses]:
    """Sections of a gyroscope's log, as long as the readout: one for each photo, without a gap.

    The readout time is that of the log if not given.
    """
    readout_s = log.readout_s if readout_s is None else readout_s
    if readout_s is None or not (readout_s > 0 and np.isfinite(readout_s)):
        raise InputError("the gyroscope's log does not say how long a frame is read; give --readout-ms")
    starts = log.time_s[np.isfinite(log.mean(log.time_s, log.time_s + readout_s)).all(axis=1)]
    if not len(starts):
        raise InputError(f"the gyroscope's log has no stretch of {readout_s:g} s without a gap")
    chosen = np.random.default_rng([seed, 9]).choice(starts, len(cameras))

    def track(camera: Camera, start_s: float) -> Poses:
        first, span = camera.clock_range[0], camera.frame_span

        def path(clock: Array) -> tuple[Array, Array]:
            rotation = log.rotations(start_s + readout_s * np.clip((clock - first) / span, 0, 1))
            return rotation, np.zeros_like(rotation)

        return path

    return [track(camera, start_s) for camera, start_s in zip(cameras, chosen.tolist(), strict=True)]


def read_row_tables(path: Path | str) -> dict[str, RowTable]:
    """Poses by row of photos.

    Parameters
    ----------
    path : path
        CSV with the columns `name`, `row` (or `clock`), `rx, ry, rz` and, if the camera travels, `x, y, z`. Units and
        axes are those of `RowTable`.

    Raises
    ------
    FileError, FormatError
        Not readable; names the photo and the row where something is missing, no number, out of order or a gap.
    """
    path = Path(path)
    columns, rows = read_table(path)
    at = "clock" if "clock" in columns else "row"
    position = ("x", "y", "z") if {"x", "y", "z"} & set(columns) else ()
    missing = [column for column in ("name", at, "rx", "ry", "rz", *position) if column not in columns]
    if missing:
        raise FormatError(f"{path} has no column {missing[0]!r}; expected name, row or clock, rx, ry, rz and x, y, z")
    entries: dict[str, dict[str, list[Any]]] = defaultdict(lambda: defaultdict(list))
    for number, row in enumerate(rows, start=2):
        try:
            numbers = {column: float(row[column]) for column in (at, "rx", "ry", "rz", *position)}
        except ValueError:
            raise FormatError(f"{path}, line {number} ({row['name'] or 'no name'}): expected numbers") from None
        if not np.isfinite(list(numbers.values())).all():
            raise FormatError(f"{path}, line {number} ({row['name'] or 'no name'}): NaN or infinity")
        entry = entries[row["name"]]
        entry[at].append(numbers[at])
        entry["rotation"].append([numbers[column] for column in ("rx", "ry", "rz")])
        if position:
            entry["position"].append([numbers[column] for column in position])
    return {name: row_table(entry, f"{path}: table of {name}") for name, entry in entries.items()}


def row_table(entry: Any, where: str) -> RowTable:
    """The table of an object with `row` or `clock`, `rotation` and, if the camera travels, `position`."""
    if not isinstance(entry, Mapping) or ("row" in entry) == ("clock" in entry) or "rotation" not in entry:
        raise FormatError(f"{where}: expected an object with row or clock, and rotation")
    if unknown := sorted(set(entry) - {"row", "clock", "rotation", "position"}):
        raise FormatError(f"{where}: unknown key {unknown[0]!r}")
    by_clock = "clock" in entry
    try:
        return RowTable(entry["clock" if by_clock else "row"], entry["rotation"], entry.get("position"), by_clock)
    except InputError as error:
        raise FormatError(f"{where}: {error}") from error
