"""Readout times of a run, and motions from a gyroscope."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..io import ExifFacts
from ..io.gyro import GyroLog, bends_from_gyro, motions_from_gyro, read_gyro, read_photo_times
from ..io.motions import Known
from ..io.readout_times import readout_time
from ..io.video import FRAME_TABLE, VideoFrames
from ..model import Bend, Camera
from ..model.checks import check_fields

__all__ = ["GyroOptions", "Readouts", "gyro_motions", "known_readouts"]

#: By camera: readout time of a frame in seconds, and its source.
Readouts = dict[int, tuple[float, str]]


@dataclass(frozen=True)
class GyroOptions:
    """A gyroscope's log, and its clock and axes relative to the camera's.

    Parameters
    ----------
    file : path
        As `io.read_gyro` takes it.
    offset_s : float
        Time on the log's clock when the camera's shows zero. For a video with a path it is estimated, within 10 s of
        this.
    axes : str, optional
        As `io.read_gyro` takes them.
    times : path, optional
        CSV with `name, time_s`; by default `frames.csv` among the photos. A video with a path has times of its own.
    """

    file: Path | str
    offset_s: float = 0.0
    axes: str | None = None
    times: Path | str | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        if not np.isfinite(float(self.offset_s)):
            raise InputError(f"offset of the gyroscope's clock: {self.offset_s!r}, expected seconds")

    def log(self) -> GyroLog:
        """The log itself."""
        return read_gyro(self.file, self.axes)

    def facts(self) -> dict[str, Any]:
        """Its content of `solution.json`."""
        return {"name": Path(self.file).name, "offset_s": self.offset_s, "axes": self.axes}


def known_readouts(
    bodies: Sequence[ExifFacts | VideoFrames],
    cameras: Sequence[Camera],
    camera_idx: ArrayLike,
    given_s: float | None,
    log: GyroLog | None,
) -> Readouts:
    """Readout time of a frame in seconds, and its source: the user, the gyroscope's log, or the table.

    By camera; unknown ones are missing. A camera's make and model are those of its first photo, by its EXIF or the
    video; they are unknown if `bodies` is empty.
    """
    if given_s is not None:
        return dict.fromkeys(range(len(cameras)), (given_s, "given"))
    if log is not None and log.readout_s is not None:
        return dict.fromkeys(range(len(cameras)), (log.readout_s, "the gyroscope's log"))
    index = np.asarray(camera_idx).tolist()
    found = {}
    for k, camera in enumerate(cameras):
        if k not in index or not bodies:
            continue
        body = bodies[index.index(k)]
        readout = readout_time(body.make or "", body.model or "", camera.width, camera.height) if body.model else None
        if readout is not None:
            found[k] = readout
    return found


def gyro_motions(
    folder: Path, gyro: GyroOptions, log: GyroLog, readout_s: Mapping[str, float | None], cameras: Mapping[str, Camera]
) -> tuple[Known, dict[str, Bend]]:
    """Motions of the photos that have a time, as `RunOptions.known` and `known_bends` take them.

    `readout_s` and `cameras` are by photo. A table of times that was given is refused where it names none.
    """
    table = Path(gyro.times) if gyro.times is not None else folder / FRAME_TABLE
    if gyro.times is None and not table.is_file():
        raise InputError(f"{gyro.file}: when were the photos taken? Give a table of name, time_s with --photo-times")
    stated = read_photo_times(table)
    times = {name: time for name, time in stated.items() if name in readout_s}
    if not times:
        raise InputError(f"{table} has the time of none of the photos, such as {next(iter(readout_s))}")
    # photos that cannot be read are left out; frames of a video may have been deleted
    others = [name for name in stated if name not in readout_s and not (folder / name).is_file()]
    if others and gyro.times is not None:
        raise InputError(f"{table}: {others[0]!r} is not among the photos")
    if unknown := [name for name in times if readout_s[name] is None]:
        raise InputError(
            f"{gyro.file}: how long does the camera of {unknown[0]} take to read a frame? Give --readout-ms"
        )
    spans = {name: readout_s[name] or 0.0 for name in times}
    known = motions_from_gyro(log, times, spans, offset_s=gyro.offset_s, steady=False)
    found = bends_from_gyro(log, {name: times[name] for name in known}, spans, cameras, offset_s=gyro.offset_s)
    # phi belongs to the bend: the slope of the rotation, not its mean rate
    return {name: (found[name][0], sigma) for name, (_, sigma) in known.items()}, {k: v for k, (_, v) in found.items()}
