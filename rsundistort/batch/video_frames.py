"""All frames of a video, rectified one after the other into a video."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import FileError, RsUndistortWarning
from ..io.aside import written_aside
from ..io.video import VideoReader, frame_name
from ..io.video_like import Pixels, VideoWriter, black_out, pixels_of
from ..model.track import even_camera
from ..rectify import rectify
from .geometry import PhotoGeometry
from .progress import StageLog
from .workers import Workers

__all__ = ["rectify_clip"]

# What a frame takes for each pixel from decoding to encoding, 16 bits a colour: three planes, before and after, twice.
_BYTES_PER_PIXEL = 40


class _Frame(NamedTuple):
    """A decoded frame, and what its grid takes."""

    picture: Any
    geometry: PhotoGeometry


def rectify_clip(
    video: Path,
    out: Path,
    geometry_of: Callable[[str], PhotoGeometry | None],
    otherwise: PhotoGeometry,
    interpolation: str,
    workers: Workers,
    log: StageLog,
) -> None:
    """Rectify every frame of a video, each by its own motion; the result is whole or not there.

    Size, rate, time stamps, colours and sound are those of the video; a view of odd sides loses a pixel. A few frames
    are in memory at a time.

    Parameters
    ----------
    video : Path
        The raw frames.
    out : Path
        MP4 file to write.
    geometry_of : callable
        Geometry of a frame by its name; None of one whose motion is not known.
    otherwise : PhotoGeometry
        Of such frames.
    interpolation : str
        As in `rectify`.
    workers : Workers
        Its threads are used, and no cluster: the frames come one after the other.

    Raises
    ------
    FileError
        The video cannot be read, or the result not be written.
    """
    target = even_camera(otherwise.new_camera)
    num_lens_only = num_frames = 0

    def work(frame: _Frame) -> tuple[_Frame, Pixels]:
        raw = pixels_of(frame.picture)
        depth = frame.geometry.find_depth().depth
        values, valid = rectify(raw.values, *frame.geometry.grid, interpolation, depth=depth)
        values, valid = values[: target.height, : target.width], valid[: target.height, : target.width]
        return frame, black_out(raw, values, valid)

    def frames(reader: VideoReader) -> Iterator[_Frame]:
        nonlocal num_lens_only
        for number, _, picture in reader:
            if picture.pts is None:
                continue
            found = geometry_of(frame_name(video, number))
            num_lens_only += found is None
            yield _Frame(picture, found or otherwise)

    camera = otherwise.camera
    alone = replace(workers, scheduler=None)
    alone = alone.fitting("the video", _BYTES_PER_PIXEL * camera.width * camera.height)
    log.begin("video")
    try:
        with written_aside(out) as aside, VideoReader(video) as reader:
            log.tell("video", 0, reader.num_frames)
            with (
                VideoWriter(aside, reader, target.width, target.height, workers.jobs) as writer,
                closing(alone.map(work, frames(reader), _lost)) as results,
            ):
                for frame, pixels in results:
                    writer.add(frame.picture.pts, frame.picture, pixels)
                    num_frames += 1
                    log.tell("video", num_frames, max(num_frames, reader.num_frames))
    except FileError as error:
        raise FileError(f"{out}: {error}") from error
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(f"{out.name} was not written; start anew for it") from stop
    num_frames -= writer.num_late
    _warn(out.name, num_frames, writer.num_late, num_lens_only)
    log.end("video", frames=num_frames, lens_only=num_lens_only, encoder=writer.encoder)


def _warn(name: str, num_frames: int, num_late: int, num_lens_only: int) -> None:
    """Say which frames are missing, or keep their motion."""
    if num_late:
        warnings.warn(f"{name}: {num_late} frames whose time runs back were left out", RsUndistortWarning, stacklevel=4)
    if num_lens_only:
        warnings.warn(
            f"{name}: {num_lens_only} of {num_frames} frames have no pose and are corrected for the lens only",
            RsUndistortWarning, stacklevel=4,
        )  # fmt: skip


def _lost(_frame: _Frame, why: str) -> Any:
    raise FileError(why)
