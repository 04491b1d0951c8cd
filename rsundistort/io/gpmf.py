"""Gyroscopes of GoPro's cameras: GPMF telemetry, as its MP4 files carry it in a track of its own.

A payload is a sequence of items: a key of four letters, one byte of type, one of the size of a sample, two with the
number of samples, big-endian, then the samples, padded to four bytes. Type 0 holds items itself: DEVC a device, STRM in
it a stream, whose last item is its data and whose others describe it (github.com/gopro/gpmf-parser).

The samples carry no times. Payloads do, about one a second, but a payload gets what the camera happened to have by
then, so that its time is right to some ten milliseconds only. The samples are uniform in time: sample n was taken at
a + b n, the line that fits the times of all payloads best, with n from TSMP, which counts also what was lost. Fusion
and newer cameras write microseconds besides (STMP), of which the video's are those of its exposures (SHUT).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FormatError, RsUndistortError, RsUndistortWarning, format_errors
from ..model.array_types import Array
from .ffmpeg_reasons import open_video
from .gyro import CAMERA_FROM_GYROFLOW, GyroLog, parse_axes

__all__ = ["GyroPayload", "has_telemetry", "parse_payload", "read_gpmf"]

_DTYPES = {
    "b": "i1", "B": "u1", "s": ">i2", "S": ">u2", "l": ">i4", "L": ">u4", "j": ">i8", "J": ">u8",
    "f": ">f4", "d": ">f8",
}  # fmt: skip
# rad/s of a unit, as SIUN or UNIT write it
_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180, "\xb0/s": np.pi / 180}
# Axes that HERO5 wrote without saying so (Z up, X left, Y back), and to which ORIO takes the samples of those after it.
_OUT = "ZXY"
# Cameras that write no ORIN, and whose axes are not those of HERO5 (readme of gpmf-parser).
_SILENT = {"Hero6 Black": "YxZ", "Fusion": "yXZ"}
_DISCARD_ALL = 48  # FFmpeg's AVDISCARD_ALL
# s. Payloads whose times are farther than this from those of uniform samples: it is no jitter.
_JITTER_S = 0.1
# ms. A time of readout (SROT) outside is none.
_READOUTS_MS = (1.0, 100.0)


@dataclass(frozen=True)
class _Item:
    """Key, type, size and number of the samples of an item, as it claims, and those of its bytes that are there."""

    key: str
    kind: str
    sample_bytes: int
    num_samples: int
    data: memoryview

    def text(self) -> str:
        return bytes(self.data).split(b"\0")[0].decode("latin-1").strip()

    def numbers(self) -> Array:
        """Whole numbers that are there; none of a type that holds no numbers."""
        dtype = np.dtype(_DTYPES.get(self.kind, "V1"))
        if dtype.kind == "V":
            return np.zeros(0)
        return np.frombuffer(self.data, dtype, len(self.data) // dtype.itemsize).astype(np.float64)

    def rows(self) -> Array:
        """(n, 3) whole samples; none where a sample is not three numbers."""
        numbers = self.numbers()
        if not len(numbers) or self.sample_bytes != 3 * np.dtype(_DTYPES[self.kind]).itemsize:
            return np.zeros((0, 3))
        return numbers[: len(numbers) // 3 * 3].reshape(-1, 3)


@dataclass(frozen=True)
class GyroPayload:
    """Readings of the camera's gyroscope in one payload.

    Attributes
    ----------
    rates : (n, 3) array
        rad/s, in the order in which they are stored.
    orientation : (3, 3) array
        Takes `rates` to the camera's axes: right, down, ahead.
    num_before : int or None
        Samples that the camera took before these (TSMP).
    stamp_s, frame_stamp_s : float or None
        When the first sample, and the first frame of the payload, were taken by the camera's clock (STMP).
    delay_s : float
        By which the data is late (TIMO).
    readout_s : float or None
        Of a frame (SROT).
    problems : tuple of str
        What could not be read.
    """

    rates: Array = field(default_factory=lambda: np.zeros((0, 3)))
    orientation: Array = field(default_factory=lambda: np.eye(3))
    device: str = ""
    num_before: int | None = None
    stamp_s: float | None = None
    frame_stamp_s: float | None = None
    delay_s: float = 0.0
    readout_s: float | None = None
    problems: tuple[str, ...] = ()


def has_telemetry(path: Path | str) -> bool:
    """Whether a video has a track of GPMF telemetry; False also where PyAV is missing or the file cannot be read."""
    try:
        with open_video(Path(path)) as container:
            return _track(container) is not None
    except RsUndistortError:
        return False


def read_gpmf(path: Path | str, axes: str | None = None) -> GyroLog:
    """The log of the gyroscope of a GoPro, out of its video.

    Parameters
    ----------
    path : path
        MP4 with a track of GPMF telemetry (HERO5 and later).
    axes : str, optional
        Which of the numbers of a sample, in the order in which they are stored, are the rates about the right, down and
        ahead, as `parse_axes` takes them. By default what the telemetry says, or is known of the camera.

    Returns
    -------
    GyroLog
        Times in seconds since the first frame of the video, as in `frames.csv`. Samples that were lost leave a gap.
        The time of the readout, where the telemetry has it.

    Raises
    ------
    FileError
        Not readable.
    FormatError
        No telemetry, no gyroscope in it, nothing of it readable, or times that do not increase. What is damaged in
        places gives what could be read, with a warning.
    InputError
        PyAV is missing.
    """
    path = Path(path)
    with open_video(path) as container:
        stream = _track(container)
        if stream is None:
            raise FormatError(f"{path} has no track of GoPro's telemetry; give the gyroscope's log as CSV or .gcsv")
        found, ends_s = _payloads(container, stream)
    said = list(dict.fromkeys(problem for _, _, payload in found for problem in payload.problems))
    device = next((payload.device for _, _, payload in found if len(payload.rates)), None)
    readout_s = next((payload.readout_s for _, _, payload in found if payload.readout_s is not None), None)
    with_rates = [each for each in found if len(each[2].rates) and each[2].device == device]
    if not with_rates:
        why = said[0] if said else "no GYRO in it"
        raise FormatError(f"{path}: its telemetry has no gyroscope that can be read ({why})")
    start_s, length_s = (np.array(values) for values in zip(*((t, d) for t, d, _ in with_rates), strict=True))
    payloads = [payload for _, _, payload in with_rates]
    with format_errors(path):
        time_s, jitters = _sample_times(payloads, start_s, length_s)
    if jitters:
        said.append("samples that are not uniform in time")
    if ends_s is not None:
        said.append(f"it ends at {ends_s[0]:.1f} s of {ends_s[1]:.1f} s")
    orientation = parse_axes(axes) if axes else payloads[0].orientation
    rates = np.concatenate([payload.rates for payload in payloads]) @ orientation.T
    if said:
        warnings.warn(f"{path.name}, telemetry: {'; '.join(said[:3])}", RsUndistortWarning, stacklevel=2)
    with format_errors(path):
        return GyroLog(time_s, rates, readout_s if readout_s is not None else _global_readout(path))


# ---------------------------------------------------------------- the container


def _track(container: Any) -> Any:
    """The stream that holds the telemetry; FFmpeg calls MP4's gpmd bin_data."""
    for stream in container.streams.data:
        if stream.name == "bin_data" or "GoPro MET" in stream.metadata.get("handler_name", ""):
            return stream
    return None


def _payloads(container: Any, stream: Any) -> tuple[list[tuple[float, float, GyroPayload]], tuple[float, float] | None]:
    """Each payload with its time and length in seconds; where the track ends, and should, if it was cut short."""
    import av

    video = next(iter(container.streams.video), None)
    first_s = float(video.start_time * video.time_base) if video is not None and video.start_time else 0.0
    for other in container.streams:
        if other.index != stream.index:
            with suppress(AttributeError):  # of a PyAV before 18, which reads the pictures, too
                other.discard = _DISCARD_ALL
    found: list[tuple[float, float, GyroPayload]] = []
    end_s, broken = 0.0, False
    try:
        for packet in container.demux(stream):
            if packet.stream_index != stream.index or not packet.size or packet.pts is None:
                continue
            time_s, length_s = (float((value or 0) * packet.time_base) for value in (packet.pts, packet.duration))
            end_s = max(end_s, time_s + length_s)
            found.append((time_s - first_s, length_s, parse_payload(bytes(packet))))
    except (OSError, av.error.FFmpegError):
        broken = True
    whole_s = float(stream.duration * stream.time_base) if stream.duration else end_s
    return found, (end_s, whole_s) if broken or end_s < whole_s - 0.5 else None


def _global_readout(path: Path) -> float | None:
    """Readout time that the file states once for all frames (moov, udta, GPMF), in seconds."""
    with path.open("rb") as file:
        start, end = 0, path.stat().st_size
        for name in (b"moov", b"udta", b"GPMF"):
            while start + 8 <= end:
                file.seek(start)
                head = file.read(16)
                size = int.from_bytes(head[:4], "big")
                body = 16 if size == 1 else 8
                size = int.from_bytes(head[8:16], "big") if size == 1 else size or end - start
                if head[4:8] == name or size < body:
                    break
                start += size
            if start + 8 > end or head[4:8] != name or size < body:
                return None
            start, end = start + body, min(end, start + size)
        file.seek(start)
        return parse_payload(file.read(end - start)).readout_s


# ---------------------------------------------------------------- times


def _sample_times(payloads: list[GyroPayload], start_s: Array, length_s: Array) -> tuple[Array, bool]:
    """Times of all samples, and whether payloads are too far from uniform times to be believed uniform."""
    count = np.array([len(payload.rates) for payload in payloads])
    counted = np.cumsum(count) - count
    stated = np.array([counted[i] if p.num_before is None else p.num_before for i, p in enumerate(payloads)])
    # numbers that run back, or make more than nine of ten samples lost, are not believed
    believed = (np.diff(stated) >= count[:-1]).all() and stated[-1] + count[-1] - stated[0] <= 10 * count.sum()
    first = stated - stated[0] if believed else counted
    at_s = _first_times(payloads, start_s)
    if len(payloads) == 1:
        first, at_s = np.array([0, count[0]]), np.array([at_s[0], at_s[0] + length_s[0]])
    rate, start = np.polyfit(first, at_s, 1)
    if not rate > 0:
        raise FormatError("the times of the telemetry do not increase")
    index = np.concatenate([n + np.arange(k) for n, k in zip(first, count, strict=False)])
    if np.abs(start + rate * first - at_s).max() <= _JITTER_S:
        return start + rate * index - payloads[0].delay_s, False
    if not (np.diff(at_s) > 0).all():
        raise FormatError("the times of the telemetry run back")
    knots = np.append(first, first[-1] + count[-1]), np.append(at_s, at_s[-1] + rate * count[-1])
    return np.interp(index, *knots) - payloads[0].delay_s, True


def _first_times(payloads: list[GyroPayload], start_s: Array) -> Array:
    """Times of the first samples by the camera's own stamps; the file's where these are missing or contradict it."""
    if len(payloads) < 2 or any(payload.stamp_s is None for payload in payloads):
        return start_s
    stamps = np.array([payload.stamp_s for payload in payloads], float)
    frame = payloads[0].frame_stamp_s
    at_s = stamps - frame + start_s[0] if frame is not None else stamps + np.median(start_s - stamps)
    return at_s if np.abs(at_s - start_s).max() < 1.0 else start_s


# ---------------------------------------------------------------- a payload


def parse_payload(data: bytes) -> GyroPayload:
    """Readings of the gyroscope of the first device in a payload that has one.

    Unknown keys are passed over. What is damaged is named in `problems`; nothing is raised.
    """
    problems: list[str] = []
    found: GyroPayload | None = None
    frame_stamp_s = readout_s = None
    for device in _items(memoryview(data), problems):
        if device.key != "DEVC" or device.kind != "\0":
            continue
        name = ""
        for item in _items(device.data, problems):
            if item.key == "DVNM":
                name = item.text()
            elif item.key == "SROT":
                readout_s = _readout(item)
            elif item.key == "STRM" and item.kind == "\0":
                stream = {each.key: each for each in _items(item.data, problems)}
                if "GYRO" in stream and found is None:
                    found = _gyroscope(stream, name, problems)
                if "SHUT" in stream and frame_stamp_s is None:
                    frame_stamp_s = _first(stream.get("STMP"), 1e-6)
                if "SROT" in stream and readout_s is None:
                    readout_s = _readout(stream["SROT"])
    said = tuple(dict.fromkeys(problems))
    return replace(found or GyroPayload(), frame_stamp_s=frame_stamp_s, readout_s=readout_s, problems=said)


def _items(data: memoryview, problems: list[str]) -> Iterator[_Item]:
    """Items that lie next to each other. Each takes eight bytes or more, so this ends."""
    at = 0
    while at + 8 <= len(data):
        key = bytes(data[at : at + 4])
        if key == b"\0\0\0\0":  # padding
            return
        if not key.isascii() or not key.decode("ascii").isprintable():
            problems.append(f"bytes that are no key ({key!r})")
            return
        size, count = data[at + 5], int.from_bytes(data[at + 6 : at + 8], "big")
        end = at + 8 + size * count
        whole = end <= len(data)
        if not whole:
            problems.append(f"{key.decode('ascii')} is cut short")
        yield _Item(key.decode("ascii"), chr(data[at + 4]), size, count, data[at + 8 : end])
        at = end + -end % 4 if whole else len(data)


def _gyroscope(stream: dict[str, _Item], device: str, problems: list[str]) -> GyroPayload | None:
    """The samples of a stream; None if there are none that can be read, with the reason among the problems."""
    item = stream["GYRO"]
    counts = item.rows()
    if not len(counts):
        if len(item.data):
            problems.append(f"GYRO of type {item.kind!r} with {item.sample_bytes} bytes a sample")
        return None
    scale = stream["SCAL"].numbers() if "SCAL" in stream else np.ones(1)
    if len(scale) not in (1, 3) or not (np.isfinite(scale) & (scale != 0)).all():
        problems.append(f"SCAL is {', '.join(f'{value:g}' for value in scale[:3]) or 'empty'}")
        return None
    unit = next((stream[key].text() for key in ("SIUN", "UNIT") if key in stream), "rad/s")
    if unit not in _UNITS:
        problems.append(f"unit {unit!r} is taken for rad/s")
    rates = counts / scale * _UNITS.get(unit, 1.0)
    if not np.isfinite(rates).all():
        problems.append("rates that are no numbers")
        return None
    total = _first(stream.get("TSMP"))
    return GyroPayload(
        rates,
        _orientation(stream, device, problems),
        device,
        None if total is None else int(total) - item.num_samples,
        _first(stream.get("STMP"), 1e-6),
        delay_s=_first(stream.get("TIMO")) or 0.0,
    )


def _orientation(stream: dict[str, _Item], device: str, problems: list[str]) -> Array:
    """(3, 3) from the order of storage to the camera's axes: by the letters of ORIN, or by what is known."""
    letters = stream["ORIN"].text() if "ORIN" in stream else _SILENT.get(device, _OUT)
    if sorted(letters.upper()) != ["X", "Y", "Z"]:
        problems.append(f"axes {letters!r} are taken for {_OUT}")
        letters = _OUT
    stored = np.zeros((3, 3))  # takes samples to X, Y, Z
    for column, letter in enumerate(letters):
        stored["XYZ".index(letter.upper()), column] = 1.0 if letter.isupper() else -1.0
    # Z is up, X left and Y back: the order of Gyroflow's axes is ZXY
    return CAMERA_FROM_GYROFLOW @ stored[[2, 0, 1]]


def _first(item: _Item | None, scale: float = 1.0) -> float | None:
    numbers = item.numbers() if item is not None else np.zeros(0)
    return float(numbers[0]) * scale if len(numbers) and np.isfinite(numbers[0]) else None


def _readout(item: _Item) -> float | None:
    """Seconds; SROT has milliseconds."""
    value = _first(item)
    return value / 1e3 if value is not None and _READOUTS_MS[0] <= value <= _READOUTS_MS[1] else None
