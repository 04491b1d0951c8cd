"""The gyroscope of a clip: found, aligned with the frames, and the rates of these."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..bundle import BundleResult
from ..errors import RsUndistortError, RsUndistortWarning
from ..input.gyro_alignment import GyroAlignment, NoAlignment, align_gyro
from ..input.key_frames import Clip
from ..input.stabilisation import Regression
from ..io.gpmf import has_telemetry
from ..io.gyro import GyroLog, read_gyro
from ..model.array_types import Array, Index
from ..verdict.judge_path import ReadoutTime

__all__ = ["Felt", "felt_gyroscope", "own_gyroscope", "readout_of", "rotations_between"]


@dataclass(frozen=True)
class Felt:
    """A gyroscope that belongs to this clip.

    Attributes
    ----------
    alignment : GyroAlignment
        Its axes and clock relative to the camera's.
    log : GyroLog
        The log about the camera's axes, on its own clock.
    """

    alignment: GyroAlignment
    log: GyroLog

    def rates(self, result: BundleResult) -> dict[str, tuple[Array, Array]]:
        """Rates of the frames that it covers, as `FramePath.rates` takes them, about the time of their middle rows."""
        assert result.path is not None
        half = max(0.5 * abs(readout_of(result).seconds), 0.5 * self.log.step_s)
        at = result.path.path.time_s + self.alignment.offset_s
        inside = (at - half >= self.log.time_s[0]) & (at + half <= self.log.time_s[-1])
        names = [name for name, there in zip(result.path.names, inside, strict=True) if there]
        if not names:
            return {}
        # the world rotates against the camera, in the radians of the images: their focal length cancels in the readout
        # time only if both use the same
        found, start, end = self.alignment, at[inside] - half, at[inside] + half
        values = -found.ratio * self.log.mean(start, end)
        # a wrong clock gives the rates of another moment
        step = self.log.step_s
        ahead, behind = (found.ratio * self.log.mean(start + by, end + by) for by in (step, -step))
        by_clock = found.offset_sigma_s * np.nan_to_num(ahead - behind) / (2 * step)
        sigma = np.hypot(found.rms, by_clock)
        return {name: (rate, each) for name, rate, each in zip(names, values, sigma, strict=True)}

    def readout(self, shutter: Regression) -> ReadoutTime:
        """The readout time by rotations of the lines over rates of the gyroscope, in the radians of the images."""
        seconds, found = shutter.slope / self.alignment.ratio, self.alignment
        share = np.hypot(shutter.sigma / shutter.slope, found.ratio_sigma / found.ratio) if shutter.slope else np.inf
        return ReadoutTime(seconds, float(abs(seconds) * share) if shutter.slope else float(shutter.sigma))

    def facts(self) -> dict[str, Any]:
        """Its content of `solution.json`."""
        found = self.alignment
        return {
            "axes": found.axes,
            "offset_s": found.offset_s,
            "offset_sigma_s": found.offset_sigma_s,
            "correlation": found.correlation,
            "rotation_ratio": found.ratio,
        }


def own_gyroscope(clip: Clip) -> GyroLog | None:
    """The gyroscope's log in a video's own telemetry; None without one, or, with a warning, if it cannot be read."""
    if not has_telemetry(clip.video):
        return None
    try:
        return read_gyro(clip.video)
    except RsUndistortError as error:
        warnings.warn(f"without the gyroscope of {clip.video.name}: {error}", RsUndistortWarning, stacklevel=4)
        return None


def felt_gyroscope(result: BundleResult, log: GyroLog | None, around_s: float = 0.0) -> Felt | None:
    """The gyroscope of a clip, aligned with its frames; None without one, or if it is of another clip.

    The offset of its clock is looked for around `around_s`.
    """
    if log is None:
        return None
    assert result.path is not None
    path = result.path.path
    found = align_gyro(log, path.time_s, *rotations_between(path.part, path.R_cw), around_s=around_s)
    if isinstance(found, NoAlignment):
        warnings.warn(f"without the gyroscope: {found.reason}", RsUndistortWarning, stacklevel=6)
        return None
    return Felt(found, found.in_camera(log))


def rotations_between(part: Index, R_cw: Array) -> tuple[Index, Array]:
    """Neighbouring frames (n, 2) of a part, and the rotations (n, 3) from one to the other; NaN of unknown ones."""
    first = np.flatnonzero(part[1:] == part[:-1])
    rotations = np.full((len(first), 3), np.nan)
    between = R_cw[first + 1] @ R_cw[first].transpose(0, 2, 1)
    known = np.isfinite(between).all(axis=(1, 2))
    if known.any():
        rotations[known] = Rotation.from_matrix(between[known]).as_rotvec()
    return np.stack([first, first + 1], axis=1), rotations


def readout_of(result: BundleResult) -> ReadoutTime:
    """The readout time that an adjustment of a path found."""
    assert result.path is not None
    return ReadoutTime(float(result.path.readout_s[0]), float(result.path.sigma_readout_s[0]))
