"""Frames of a video as photos, with the times at which they were taken."""

from __future__ import annotations

import csv
import struct
import threading
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, RsUndistortWarning
from ..model.array_types import Array
from .ffmpeg_reasons import ffmpeg_errors, open_video
from .outputs import output_folder
from .photos.exif import ORIENTATION, pack_ifd
from .photos.images import MAX_MEGAPIXELS, write_image
from .photos.metadata import Metadata

__all__ = [
    "FRAME_TABLE",
    "VIDEO_SUFFIXES",
    "FrameWriter",
    "VideoFrames",
    "VideoReader",
    "bits_of",
    "converted",
    "extract_frames",
    "frame_name",
    "is_video",
    "sharpness_of",
]

VIDEO_SUFFIXES = (
    ".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".3gp", ".wmv", ".h264",
)  # fmt: skip

#: Table that lies beside the frames.
FRAME_TABLE = "frames.csv"

# longer side in pixels of the picture whose sharpness is measured: motion blur shows, noise of single pixels does not
_MEASURED_PX = 960
# EXIF orientation that shows a frame as its display matrix asks, by the angle counterclockwise
_ORIENTATIONS = {0: 1, -90: 6, 90: 8, 180: 3, -180: 3}
_ATTACHED_PICTURE = 1024  # FFmpeg's AV_DISPOSITION_ATTACHED_PIC
_MEND = "; if it was cut short while being recorded, repair it or copy it again"
_MAKE = ("make", "com.apple.quicktime.make", "com.android.manufacturer")
_MODEL = ("model", "com.apple.quicktime.model", "com.android.model")


@dataclass(frozen=True)
class VideoFrames:
    """Frames that were taken from a video.

    Attributes
    ----------
    names : tuple of str
        PNG files, in the order of the video.
    time_s : (m,) array
        When each was taken, seconds since the first frame of the video; NaN where the video holds no times.
    num_frames : int
        Whole frames of the video.
    num_damaged : int
        Frames that were passed over because they, or what they build on, could not be decoded; a decoder may have kept
        others to itself.
    orientation : int
        EXIF orientation, which players apply and the frames do not: they are as the sensor stored them.
    make, model : str
        Camera, where the video names it; else empty.
    """

    names: tuple[str, ...]
    time_s: Array
    num_frames: int
    num_damaged: int
    orientation: int
    make: str
    model: str


def is_video(path: Path) -> bool:
    """Whether a path is a file with the ending of a video."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES and Path(path).is_file()


def extract_frames(
    video: Path | str,
    folder: Path | str,
    *,
    every: int | None = None,
    sharpest: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> VideoFrames:
    """Write frames of a video as PNG files, in the stored pixels, and `frames.csv` with their times.

    Parameters
    ----------
    video : path
        Any file that FFmpeg decodes. One frame is held in memory at a time.
    folder : path
        Made if missing, must be empty; it gets all frames or stays as it was. `frames.csv` has the columns `name`,
        `frame` (number among those that could be decoded, from 0), `time_s` (seconds since the first frame; empty where
        the video holds no times) and `sharpness` (variance of the Laplacian, grey levels squared, of the frame reduced
        to at most 960 pixels).
    every : int
        Take each frame whose number is a multiple of this; if it is damaged, the next whole one.
    sharpest : int
        Take the sharpest of each so many frames. Give this or `every`.
    progress : callable, optional
        Called with the number of frames read, and of all, 0 where that is not known.

    Returns
    -------
    VideoFrames
        Names and times. A display matrix (a phone held upright) is not applied; it is written as the EXIF orientation,
        with make and model, where OpenCV can write EXIF.

    Raises
    ------
    InputError
        Neither or both of `every` and `sharpest`, or PyAV is missing.
    FileError
        No video, or not a whole frame in it. A video that is cut short, or damaged in places, gives the frames that it
        has, with a warning.
    """
    video = Path(video)
    if (every is None) == (sharpest is None):
        raise InputError(
            f"{video.name} is a video: say which frames are the photos, --every N or --sharpest N (of each N frames)"
        )
    group = every or sharpest or 0
    if group < 1:
        raise InputError(f"every {group} frames: expected 1 or more")
    with output_folder(Path(folder)) as scratch, VideoReader(video) as reader:
        return _extract(reader, scratch, group, measure=sharpest is not None, progress=progress)


def _extract(
    reader: VideoReader, folder: Path, group: int, *, measure: bool, progress: Callable[[int, int], None] | None
) -> VideoFrames:
    writer = FrameWriter(reader, folder)
    best: tuple[int, float, Any] | None = None
    sharpest = 0.0
    for number, time_s, picture in reader:
        if progress is not None:
            progress(number + 1, reader.num_frames)
        if best is not None and number // group > best[0] // group:
            writer.add(*best, sharpest)
            best = None
        if measure or best is None:
            sharpness = sharpness_of(picture)
            if best is None or sharpness > sharpest:
                best, sharpest = (number, time_s, picture), sharpness
    if best is not None:
        writer.add(*best, sharpest)
    reader.warn()
    return writer.finish()


class VideoReader:
    """Whole frames of a video in the order of presentation, each as (number, time_s, picture of PyAV).

    Used in a `with` statement. Times are those since the first frame; NaN where the video holds none. A frame that
    cannot be decoded is concealed by the decoder, and those that build on it inherit the fault: all up to the next
    whole key frame are passed over. Behind a change of size the video ends.

    Raises
    ------
    InputError
        PyAV is missing.
    FileError
        No video, or it cannot be read.
    """

    def __init__(self, video: Path | str) -> None:
        self.video = Path(video)
        self.num_whole = 0
        self.num_damaged = 0
        self._interlaced = False
        self._timeless = 0
        self._broken = ""
        self._end_s = 0.0
        self._size: tuple[int, int] | None = None
        self._changes_at_s: float | None = None

    def __enter__(self) -> VideoReader:
        self._container = open_video(self.video, _MEND)
        # a cover picture is a video stream, too
        streams = self._container.streams.video
        stream = next((s for s in streams if not int(s.disposition) & _ATTACHED_PICTURE), None)
        if stream is None:
            self._container.close()
            raise FileError(f"{self.video} holds no pictures")
        size = (stream.width, stream.height) if stream.codec_context is not None else (0, 0)
        if not 0 < size[0] * size[1] <= MAX_MEGAPIXELS * 1e6:
            self._container.close()
            kind = f"pictures of {size[0]}x{size[1]} pixels" if stream.codec_context is not None else "an unknown codec"
            raise FileError(f"{self.video} cannot be read as a video: it has {kind}; repair it or copy it again")
        self.stream = stream  # PyAV's, of the pictures
        self.tags = dict(self._container.metadata)
        tags = {key.lower(): value for key, value in (*self._container.metadata.items(), *stream.metadata.items())}
        self.make, self.model = (
            next((tags[key].strip() for key in keys if tags.get(key)), "") for keys in (_MAKE, _MODEL)
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._container.close()

    def __iter__(self) -> Iterator[tuple[int, float, Any]]:
        with ffmpeg_errors(f"{self.video} cannot be read as a video", _MEND):
            yield from self._whole()

    @property
    def num_frames(self) -> int:
        """Frames by the container; 0 where it does not say."""
        return int(self.stream.frames)

    def _whole(self) -> Iterator[tuple[int, float, Any]]:
        first: float | None = None
        previous = np.nan
        step = float(1 / self.stream.average_rate) if self.stream.average_rate else np.nan
        damaged = False
        for number, picture in enumerate(self._pictures()):
            damaged = picture is None or picture.is_corrupt or (damaged and not picture.key_frame)
            if picture is not None and picture.time is not None:
                first = picture.time if first is None else first
                time_s = picture.time - first
            else:
                time_s = previous + step  # NaN until a frame has a time
            previous = time_s
            self._end_s = max(self._end_s, time_s + step) if np.isfinite(time_s + step) else self._end_s
            if damaged:
                self.num_damaged += 1
                continue
            size = picture.width, picture.height
            if size != (self._size or size):
                self._changes_at_s = time_s
                return
            self._size = size
            self.num_whole += 1
            self._interlaced |= picture.interlaced_frame
            self._timeless += picture.time is None
            yield number, time_s, picture

    def _pictures(self) -> Iterator[Any]:
        """Decoded frames; None for one that could not be."""
        import av

        self.stream.thread_type = "SLICE"  # threads that take a frame each lose the faults of the last ones
        packets = self.stream.container.demux(self.stream)
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                return
            except av.error.FFmpegError as error:
                self._broken = error.strerror
                packet = None  # what the decoder still holds
            try:
                yield from self.stream.codec_context.decode(packet)
            except av.error.FFmpegError:
                yield None
            if packet is None:
                return

    def warn(self) -> None:
        """Say what was wrong with the video."""
        said = []
        if self.num_damaged:
            said.append(f"{self.num_damaged} frames or more are damaged and were left out")
        length = self.stream.duration and float(self.stream.duration * self.stream.time_base)
        if length is None and self.stream.container.duration is not None:
            length = self.stream.container.duration / 1e6
        if self._changes_at_s is not None:
            said.append(f"its frames change size at {self._changes_at_s:.1f} s; what follows was left out")
        # containers round, and count the sound that goes on after the last frame
        elif self._broken or (length and self._end_s and self._end_s < length - max(0.5, 0.02 * length)):
            said.append(f"it ends at {self._end_s:.1f} s{f' of {length:.1f} s' if length else ''}")
        if self._interlaced:
            said.append("it is interlaced: each frame holds two moments, which no shutter model describes")
        if self._timeless:
            said.append(f"{self._timeless} frames have no time of their own")
        if said:
            warnings.warn(f"{self.video.name}: {'; '.join(said)}", RsUndistortWarning, stacklevel=3)


class FrameWriter:
    """Writes frames of a video as PNG files, and the table of their times."""

    def __init__(self, reader: VideoReader, folder: Path) -> None:
        self._reader, self._folder = reader, folder
        self._rows: list[tuple[str, int, float, float]] = []
        self._orientation = 1

    def add(self, number: int, time_s: float, picture: Any, sharpness: float) -> None:
        """Write one frame."""
        self._orientation = _ORIENTATIONS.get(picture.rotation, 1)
        name = frame_name(self._reader.video, number)
        write_image(
            self._folder / name, _pixels(picture), _metadata(self._orientation, self._reader.make, self._reader.model)
        )
        self._rows.append((name, number, time_s, sharpness))

    def finish(self) -> VideoFrames:
        """Write the table, in the order of the video."""
        if not self._rows:
            raise FileError(f"{self._reader.video} holds no whole frame; copy it again from the camera")
        self._rows.sort(key=lambda row: row[1])
        with (self._folder / FRAME_TABLE).open("w", encoding="utf-8", newline="") as file:
            table = csv.writer(file)
            table.writerow(["name", "frame", "time_s", "sharpness"])
            for name, number, time_s, sharpness in self._rows:
                time = f"{time_s:.6f}" if np.isfinite(time_s) else ""
                table.writerow([name, number, time, f"{sharpness:.2f}"])
        names, _, times, _ = zip(*self._rows, strict=True)
        reader = self._reader
        return VideoFrames(
            names, np.array(times), reader.num_whole, reader.num_damaged, self._orientation, reader.make, reader.model
        )


def frame_name(video: Path, number: int) -> str:
    """Name of a frame as a photo."""
    return f"{video.stem}_{number:06d}.png"


@lru_cache(maxsize=16)
def _converter(_form: str, _size: tuple[int, int], _of: tuple[Any, ...], _thread: int) -> Any:
    """What converts frames of a kind to another, for one thread: making it takes longer than a conversion does."""
    from av.video.reformatter import VideoReformatter

    return VideoReformatter()


def converted(picture: Any, form: str, size: tuple[int, int] | None = None) -> NDArray[Any]:
    """Pixels of a frame in a format that PyAV names, and scaled to a width and height if wanted."""
    width, height = size or (picture.width, picture.height)
    kind = picture.format.name, picture.width, picture.height, picture.colorspace, picture.color_range
    converter = _converter(form, (width, height), kind, threading.get_ident())
    pixels: NDArray[Any] = converter.reformat(picture, width, height, form).to_ndarray()
    return pixels


def _pixels(picture: Any) -> NDArray[Any]:
    """(h, w, 3) BGR, 8 bit, or 16 bit where the video has more than eight."""
    if bits_of(picture.format) > 8:
        return np.ascontiguousarray(converted(picture, "rgb48le")[..., ::-1])
    return converted(picture, "bgr24")


def bits_of(form: Any) -> int:
    """Bits of a number in a format of PyAV."""
    return int(max(component.bits for component in form.components))


def sharpness_of(picture: Any) -> float:
    """Variance of the Laplacian of the reduced grey frame."""
    scale = min(1.0, _MEASURED_PX / max(picture.width, picture.height))
    grey = converted(picture, "gray", (max(2, round(scale * picture.width)), max(2, round(scale * picture.height))))
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def _metadata(orientation: int, make: str, model: str) -> Metadata:
    """EXIF with the orientation, and make and model if known."""
    texts = [(tag, text.encode("ascii", "replace") + b"\0") for tag, text in ((0x010F, make), (0x0110, model)) if text]
    entries: list[tuple[int, int, int, bytes | int]] = [(tag, 2, len(text), text) for tag, text in texts]
    entries.append((ORIENTATION, 3, 1, struct.pack("<H", orientation)))
    return Metadata(exif=b"II*\0" + struct.pack("<I", 8) + pack_ifd("<", entries, 8))
