"""Motions of photos from a gyroscope's log: CSV, Gyroflow's `.gcsv`, and GoPro's videos.

The sign. While the clock r runs, the orientation of a photo is `R_cw(r) = Exp(r phi) R_cw`. A gyroscope measures omega,
the rate of the camera about its own axes: `R_wc(t + dt) = R_wc(t) Exp(omega dt)`. Transposed, that is
`R_cw(t + dt) = Exp(-omega dt) R_cw(t)`: the world rotates the other way in the camera. The clock runs forwards in time,
whatever the direction of the readout, and over the whole frame within the time of the readout T. So `phi = -T omega`
per frame.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..errors import FormatError, InputError, RsUndistortWarning, file_errors, format_errors
from ..model import Bend, Camera, RowMotion
from ..model.array_types import Array, Index, Mask
from ..model.checks import check_array, check_finite, frozen
from .motions import Known
from .tables import check_cells, check_columns, read_table
from .video import is_video

__all__ = [
    "GyroLog",
    "bends_from_gyro",
    "gyro_offset",
    "motions_from_gyro",
    "parse_axes",
    "read_gyro",
    "read_photo_times",
]

# rad/s. Gyroscopes of cameras and phones measure up to 2,000 degrees per second, the fastest up to 4,000.
_FASTEST = np.deg2rad(4000.0)
# rad/s. Zero-rate offset of a gyroscope that was calibrated once: half a degree per second.
_BIAS = 0.01
# Of the time of the readout: tables and lines counted by eye are right to a millisecond of thirty.
_READOUT_SHARE = 0.03
# Steps between samples: what is longer is a gap.
_GAP_STEPS = 5.0
# Steps that a readout is integrated in: four between two readings of a bend.
_STEPS = 257
# Gyroflow's axes are up, left and back (its IMU orientation page, and its integrator): rows are right, down, ahead.
CAMERA_FROM_GYROFLOW = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])
_GCSV = ("GYROFLOW IMU LOG", "CAMERA IMU LOG")
_COLUMNS = ("time_s", "wx", "wy", "wz")


@dataclass(frozen=True)
class GyroLog:
    """Rates of rotation of a camera.

    Parameters
    ----------
    time_s : (n,) array
        Increasing; two or more.
    omega_c : (n, 3) array
        Angular velocity in rad/s, right-handed, about the camera's axes: x right, y down, z ahead in the stored pixels.
    readout_s : float, optional
        Time of the readout of a frame, where the log says it.
    """

    time_s: Array
    omega_c: Array
    readout_s: float | None = None

    def __post_init__(self) -> None:
        time_s = check_finite(self.time_s, (None,), "time_s")
        if len(time_s) < 2 or not (np.diff(time_s) > 0).all():
            raise InputError("a gyroscope's log needs two samples or more, at increasing times")
        object.__setattr__(self, "time_s", frozen(time_s))
        object.__setattr__(self, "omega_c", frozen(check_finite(self.omega_c, (len(time_s), 3), "omega_c")))

    @property
    def step_s(self) -> float:
        """Median time between two samples."""
        return float(np.median(np.diff(self.time_s)))

    @property
    def noise(self) -> Array:
        """(3,) standard deviation in rad/s of a sample, from second differences: fast shaking counts as noise."""
        second = np.abs(np.diff(self.omega_c, n=2, axis=0))
        # second differences of independent samples have six times their variance; 0.6745: median of |x| of a normal x
        return np.median(second, axis=0) / (0.6745 * np.sqrt(6.0)) if len(second) else np.zeros(3)

    def mean(self, start_s: Array, end_s: Array) -> Array:
        """(..., 3) mean rates between times, linear between samples; NaN outside the log and across a gap in it."""
        rate = (self._angle(end_s) - self._angle(start_s)) / (end_s - start_s)[..., None]
        return np.where(self._covers(start_s, end_s)[..., None], rate, np.nan)

    def rotations(self, at_s: Array) -> Array:
        """(k, 3) rotation vectors of the world in the camera at times (k,), against the first of them.

        `Exp(rotation) R_cw` is the orientation then, R_cw that at the first time. Between neighbouring times the axis
        of the rotation is held; what that leaves falls with the square of the steps.
        """
        from scipy.spatial.transform import Rotation

        rotations = Rotation.from_rotvec(-np.diff(self._angle(at_s), axis=0, prepend=self._angle(at_s[:1])))
        step = 1
        while step < len(at_s):  # products of all before, by doubling
            rotations = Rotation.concatenate([rotations[:step], rotations[step:] * rotations[:-step]])
            step *= 2
        return np.asarray(rotations.as_rotvec(), np.float64)

    @cached_property
    def _angle_before(self) -> Array:
        """(n, 3) integral of the rates from the first sample to each."""
        step = np.diff(self.time_s)[:, None]
        return np.vstack([np.zeros(3), np.cumsum(0.5 * step * (self.omega_c[1:] + self.omega_c[:-1]), axis=0)])

    @cached_property
    def _gaps_before(self) -> Index:
        """(n,) number of gaps before each sample."""
        return np.concatenate([[0], np.cumsum(np.diff(self.time_s) > _GAP_STEPS * self.step_s)])

    def _angle(self, at_s: Array) -> Array:
        """(..., 3) integral of the rates from the first sample."""
        i = np.clip(np.searchsorted(self.time_s, at_s, side="right") - 1, 0, len(self.time_s) - 2)
        passed = (at_s - self.time_s[i])[..., None]
        slope = (self.omega_c[i + 1] - self.omega_c[i]) / (self.time_s[i + 1] - self.time_s[i])[..., None]
        angle: Array = self._angle_before[i] + passed * (self.omega_c[i] + 0.5 * passed * slope)
        return angle

    def _covers(self, start_s: Array, end_s: Array) -> Mask:
        gaps = self._gaps_before
        first = np.searchsorted(self.time_s, start_s, side="right") - 1  # the sample before, and the one after
        last = np.searchsorted(self.time_s, end_s, side="left")
        inside = (first >= 0) & (last < len(self.time_s))
        covers: Mask = inside & (gaps[np.clip(first, 0, None)] == gaps[np.clip(last, None, len(gaps) - 1)])
        return covers


def parse_axes(text: str) -> Array:
    """(3, 3) matrix that takes a sensor's rates to other axes, from three letters such as "XYZ" or "yXZ".

    The k-th letter names the axis of the sensor that lies along the k-th axis wanted; a small one points the other way.
    """
    if sorted(text.upper()) != ["X", "Y", "Z"]:
        raise InputError(
            f"gyroscope axes {text!r}: expected X, Y and Z in some order, small where reversed, such as yXZ"
        )
    matrix = np.zeros((3, 3))
    for row, letter in enumerate(text):
        matrix[row, "XYZ".index(letter.upper())] = 1.0 if letter.isupper() else -1.0
    if np.linalg.det(matrix) < 0:
        warnings.warn(
            f"gyroscope axes {text} are a mirror image, which no mounting of a sensor is; is a letter's case wrong?",
            RsUndistortWarning,
            stacklevel=2,
        )
    return matrix


def read_gyro(path: Path | str, axes: str | None = None) -> GyroLog:
    """The log of a gyroscope.

    Parameters
    ----------
    path : path
        CSV with the columns `time_s, wx, wy, wz` (rad/s, right-handed), Gyroflow's `.gcsv`, or a video of a GoPro
        (`read_gpmf`).
    axes : str, optional
        Axes of the sensor that point to the right, down and ahead in the stored pixels, as `parse_axes` takes them. By
        default XYZ for CSV, and the file's own orientation for `.gcsv` and videos.

    Raises
    ------
    FileError, FormatError
        Not readable; columns or scales missing, numbers that are none, times that go back. A last line that was cut
        off is left out.
    """
    path = Path(path)
    if is_video(path):
        from .gpmf import read_gpmf

        return read_gpmf(path, axes)
    with file_errors(path):
        lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    if lines and lines[0].strip() in _GCSV:
        return _from_gcsv(path, lines, axes)
    columns = [cell.strip() for cell in lines[0].split(",")] if lines else []
    if missing := [column for column in _COLUMNS if column not in columns]:
        raise FormatError(f"{path} has no column {missing[0]!r}; expected {', '.join(_COLUMNS)}, or Gyroflow's .gcsv")
    check_columns(path, columns)
    time_s, rates = _samples(path, lines, 1, [columns.index(column) for column in _COLUMNS])
    return _log(path, time_s, rates @ parse_axes(axes or "XYZ").T)


def _from_gcsv(path: Path, lines: list[str], axes: str | None) -> GyroLog:
    """A log as docs.gyroflow.xyz describes it (Technical details, GCSV format)."""
    start = next((i for i, line in enumerate(lines) if line.split(",")[0].strip() in ("t", "time")), None)
    if start is None:
        raise FormatError(f"{path} has no line t,gx,gy,gz that begins its samples")
    header = dict(cell.strip().split(",", 1) for cell in lines[1:start] if "," in cell)
    try:
        tscale, gscale = float(header["tscale"]), float(header["gscale"])
        readout_s = float(header.get("frame_readout_time", 0)) / 1e3
    except KeyError as error:
        raise FormatError(f"{path} has no {error.args[0]} in its header") from None
    except ValueError as error:
        raise FormatError(f"{path}: {error}") from None
    if axes is None and "orientation" not in header:
        raise FormatError(f"{path} does not say how the sensor lies (orientation); give --gyro-axes")
    to_camera = parse_axes(axes) if axes else CAMERA_FROM_GYROFLOW @ parse_axes(header["orientation"].strip())
    time, counts = _samples(path, lines, start + 1, [0, 1, 2, 3])
    return _log(path, tscale * time, gscale * counts @ to_camera.T, readout_s if readout_s > 0 else None)


def _samples(path: Path, lines: list[str], start: int, columns: list[int]) -> tuple[Array, Array]:
    """Times (n,) and rates (n, 3) as written, behind the line of the columns, without a last line that was cut off."""
    body = lines[start:]
    width = lines[start - 1].count(",") + 1
    for number, line in enumerate(body, start + 1):
        if line.count(",") >= width:
            check_cells(path, number, width, line.split(",")[width:])
    if len(body) < 2:
        raise FormatError(f"{path} holds no two samples")
    for last in (len(body), len(body) - 1):
        try:
            table = np.loadtxt(body[:last], delimiter=",", usecols=columns, ndmin=2, comments=None)
            break
        except (ValueError, IndexError) as error:
            problem = str(error)
    else:
        raise FormatError(f"{path}, after line {start}: {problem}")
    if last < len(body):
        warnings.warn(f"{path}: the last line is cut off and was left out", RsUndistortWarning, stacklevel=3)
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    if len(back):
        raise FormatError(f"{path}, sample {back[0] + 2}: the time goes back")
    return table[:, 0], table[:, 1:]


def _log(path: Path, time_s: Array, omega_c: Array, readout_s: float | None = None) -> GyroLog:
    """A log in which samples that were written with one time are one, their mean."""
    times, index, count = np.unique(time_s, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(index, omega_c[:, k]) for k in range(3)], axis=1) / count[:, None]
    if (fastest := float(np.abs(mean).max(initial=0.0))) > _FASTEST:
        raise FormatError(
            f"{path} has rates up to {fastest:.3g}, which no gyroscope measures in rad/s: are they in degrees "
            "per second? One is 0.01745 rad/s (in .gcsv: its gscale)"
        )
    with format_errors(path):
        return GyroLog(times, mean, readout_s)


def read_photo_times(path: Path | str) -> dict[str, float]:
    """Times in seconds at which photos were taken, by name: CSV with the columns `name, time_s`, as `frames.csv`.

    Photos whose cell is empty are left out.
    """
    path = Path(path)
    columns, rows = read_table(path)
    if not {"name", "time_s"} <= set(columns):
        raise FormatError(f"{path} needs the columns name, time_s")
    times: dict[str, float] = {}
    for number, row in enumerate(rows, start=2):
        try:
            time_s = float(row["time_s"] or "nan")
        except ValueError:
            raise FormatError(f"{path}, line {number}: time_s={row['time_s']!r}, expected a number") from None
        if row["name"] in times:
            raise FormatError(f"{path}, line {number}: {row['name']} twice")
        if np.isfinite(time_s):
            times[row["name"]] = time_s
    return times


def motions_from_gyro(
    log: GyroLog,
    times_s: Mapping[str, float],
    readout_s: float | Mapping[str, float],
    *,
    offset_s: float = 0.0,
    offset_sigma_s: float = 0.001,
    steady: bool = True,
) -> Known:
    """Rotations of photos during their readout, as a gyroscope saw them.

    Parameters
    ----------
    times_s : mapping of photo name to float
        When the middle line of each photo was read, by the camera's clock.
    readout_s : float, or mapping of photo name to float
        Time of the readout of a frame, of all photos or of each.
    offset_s : float
        What the clock of the log shows when the camera's shows zero.
    offset_sigma_s : float
        Standard deviation of `offset_s`.
    steady : bool
        Whether the motions are taken to be steady; not where `bends_from_gyro` says how they are not.

    Returns
    -------
    dict of photo name to (phi, sigma)
        Radians per frame, (3,) each, as `BundleOptions.known_phi` takes them: minus the mean rate over the readout,
        times its time. The standard deviation holds the noise of the samples, a zero-rate offset of 0.01 rad/s, what
        the uncertainty of the clocks and of the readout (3 %) does to the mean, and how far the rate varies within the
        readout where it is taken to be steady. Photos that the log does not cover are left out, with a warning.

    Raises
    ------
    InputError
        The log covers none of the photos, or the time of the readout is not positive.
    """
    names = list(times_s)
    span = np.array([readout_s[name] if isinstance(readout_s, Mapping) else readout_s for name in names], float)
    if not ((span > 0) & np.isfinite(span)).all():
        raise InputError(f"the time of the readout is {readout_s!r} s, expected positive numbers")
    middle = np.array([times_s[name] for name in names], float) + offset_s
    start, end = middle - span / 2, middle + span / 2
    rate = log.mean(start, end)
    shifted = np.stack([log.mean(start + shift, end + shift) for shift in (-offset_sigma_s, offset_sigma_s)])
    edges = start + span * np.arange(9)[:, None] / 8
    slices = log.mean(edges[:-1], edges[1:])
    variance = (
        log.noise**2 * np.minimum(1.0, log.step_s / span)[:, None]
        + _BIAS**2
        + np.mean((shifted - rate) ** 2, axis=0)
        + (_READOUT_SHARE * rate) ** 2
        + (np.var(slices, axis=0) if steady else np.zeros(3))
    )
    covered = np.isfinite(variance).all(axis=1)
    if not covered.any():
        raise InputError(
            f"the gyroscope's log goes from {log.time_s[0]:.3f} to {log.time_s[-1]:.3f} s and covers none of the photos"
            + (f", taken from {middle.min():.3f} to {middle.max():.3f} s" if names else "")
            + "; give the offset of the clocks"
        )
    if lost := [name for name, there in zip(names, covered, strict=True) if not there]:
        warnings.warn(
            f"the gyroscope's log does not cover {len(lost)} of {len(names)} photos, such as {lost[0]}",
            RsUndistortWarning,
            stacklevel=2,
        )
    return {name: (-span[i] * rate[i], span[i] * np.sqrt(variance[i])) for i, name in enumerate(names) if covered[i]}


def bends_from_gyro(
    log: GyroLog,
    times_s: Mapping[str, float],
    readout_s: float | Mapping[str, float],
    cameras: Mapping[str, Camera],
    *,
    offset_s: float = 0.0,
) -> dict[str, tuple[Array, Bend]]:
    """How photos rotated while they were read: the nearest steady motion, and how the rotation departs from it.

    Parameters
    ----------
    log, times_s, readout_s, offset_s
        As `motions_from_gyro` takes them.
    cameras : mapping of photo name to Camera
        Whose clock the bends go by, from where the reading of a frame begins to where it ends.

    Returns
    -------
    dict of photo name to (phi, Bend)
        phi (3,) in radians per frame: the slope of the rotation, where `motions_from_gyro` has its mean rate. The bend
        is as `BundleOptions.known_bends` takes it, orthogonal to 1 and to the clock, a spline of 65 readings: a
        vibration of 1.5 mrad is right to 4e-5 rad at 10 periods a frame. The rates are integrated to rotations, so it
        is right for rotations about changing axes, too. Photos that the log does not cover are left out.
    """
    found = {}
    for name, time_s in times_s.items():
        span = readout_s[name] if isinstance(readout_s, Mapping) else readout_s
        start, end = np.array(time_s + offset_s - span / 2), np.array(time_s + offset_s + span / 2)
        if not log._covers(start, end):
            continue
        clock = np.linspace(*cameras[name].clock_range, _STEPS)
        motion, _, _ = RowMotion.of(clock, log.rotations(np.linspace(start, end, _STEPS)))
        assert motion.bend is not None
        found[name] = motion.phi * (clock[-1] - clock[0]), motion.bend
    return found


def gyro_offset(
    log: GyroLog, times_s: ArrayLike, phi_frame: ArrayLike, readout_s: float, *, largest_s: float = 10.0
) -> tuple[float, float]:
    """The offset of a log's clock, from motions that were solved for without it.

    Parameters
    ----------
    times_s : (m,) array
        When the middle lines of photos were read, by the camera's clock.
    phi_frame : (m, 3) array
        Their rotations in radians per frame: `image.motion.phi * camera.frame_span` of a solution.
    largest_s : float
        Offsets of either sign up to this are tried.

    Returns
    -------
    offset_s : float
        As `motions_from_gyro` takes it: where the rates explain the rotations best.
    correlation : float
        Of both there, from -1 to 1. Below about 0.8, or with few photos, the offset is not to be believed; a camera
        that rotates evenly has none that can be seen.

    Raises
    ------
    InputError
        No offset lets the log cover four fifths of the photos.
    """
    times = check_finite(times_s, (None,), "times_s")
    phi = check_array(phi_frame, (len(times), 3), "phi_frame")

    def correlation(offset_s: float) -> float:
        middle = times + offset_s
        seen = -readout_s * log.mean(middle - readout_s / 2, middle + readout_s / 2)
        there = np.isfinite(seen).all(axis=1)
        norm = float(np.linalg.norm(seen[there]) * np.linalg.norm(phi[there]))
        return float(np.sum(seen[there] * phi[there])) / norm if norm > 0 and there.mean() >= 0.8 else -np.inf

    best, found = 0.0, np.zeros(0)
    for reach, step in ((largest_s, readout_s / 4), (readout_s / 4, readout_s / 64)):
        offsets = best + step * np.arange(-np.ceil(reach / step), np.ceil(reach / step) + 1)
        found = np.array([correlation(offset) for offset in offsets])
        best = float(offsets[np.argmax(found)])
    if not np.isfinite(found.max()):
        raise InputError(f"no offset up to {largest_s:g} s lets the gyroscope's log cover the photos")
    return best, float(found.max())
