"""What a run knows of the time of the readout, and of motions from a gyroscope."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..io.gyro import GyroLog, motions_from_gyro, read_gyro, read_photo_times
from ..io.motions import Known
from ..io.readout_times import camera_body, readout_time
from ..io.video import FRAME_TABLE, VideoFrames
from ..model import Camera, Reconstruction

__all__ = ["GyroOptions", "gyro_contradiction", "gyro_motions", "known_readout"]

# Known motions that a solution misses by this many of their standard deviations are not those of its photos.
_FAR = 3.0


@dataclass(frozen=True)
class GyroOptions:
    """A gyroscope's log, and how its clock and its axes lie to the camera's.

    Parameters
    ----------
    file : path
        As `io.read_gyro` takes it.
    offset_s : float
        What the clock of the log shows when the camera's shows zero.
    axes : str, optional
        As `io.read_gyro` takes them.
    times : path, optional
        CSV with `name, time_s`; by default `frames.csv` among the photos.
    """

    file: Path | str
    offset_s: float = 0.0
    axes: str | None = None
    times: Path | str | None = None

    def __post_init__(self) -> None:
        if not np.isfinite(self.offset_s):
            raise InputError(f"offset of the gyroscope's clock: {self.offset_s!r}, expected seconds")

    def log(self) -> GyroLog:
        """The log itself."""
        return read_gyro(self.file, self.axes)

    def facts(self) -> dict[str, Any]:
        """What `solution.json` says of it."""
        return {"name": Path(self.file).name, "offset_s": self.offset_s, "axes": self.axes}


def known_readout(
    photo: Path, camera: Camera, frames: VideoFrames | None, given_s: float | None, log: GyroLog | None
) -> tuple[float, str] | None:
    """Seconds that the readout of a frame takes, and who says so: the user, the gyroscope's log, or the table."""
    if given_s is not None:
        return given_s, "given"
    if log is not None and log.readout_s is not None:
        return log.readout_s, "the gyroscope's log"
    body = (frames.make, frames.model) if frames is not None else camera_body(photo)
    return None if body is None else readout_time(*body, camera.width, camera.height)


def gyro_motions(
    folder: Path, names: Sequence[str], gyro: GyroOptions, log: GyroLog, readout: tuple[float, str] | None
) -> Known:
    """Motions of the photos that have a time, as `RunOptions.known` takes them."""
    if readout is None:
        raise InputError(
            f"{gyro.file}: how long does the camera take to read a frame? It is not in the table; give --readout-ms"
        )
    table = Path(gyro.times) if gyro.times is not None else folder / FRAME_TABLE
    if gyro.times is None and not table.is_file():
        raise InputError(f"{gyro.file}: when were the photos taken? Give a table of name, time_s with --photo-times")
    times = {name: time for name, time in read_photo_times(table).items() if name in names}
    if not times:
        raise InputError(f"{table} has the time of none of the photos, such as {names[0]}")
    return motions_from_gyro(log, times, readout[0], offset_s=gyro.offset_s)


def gyro_contradiction(rec: Reconstruction, known: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> str | None:
    """A warning, if a solution is far from the motions that it was told to be known."""
    span = rec.frame_span()
    misses = [
        (rec.phi[i] * span[i] - np.asarray(known[name][0])) / np.asarray(known[name][1])
        for i, name in enumerate(rec.image_names)
        if name in known
    ]
    far = float(np.sqrt(np.mean(np.square(misses)))) if misses and rec.shutter_model != "global" else 0.0
    if far <= _FAR:
        return None
    return (
        f"the photos contradict the gyroscope, by {far:.0f} times its uncertainty; check the offset of its clock "
        "(--gyro-offset), its axes (--gyro-axes) and the time of the readout (--readout-ms)"
    )
