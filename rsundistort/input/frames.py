"""The photos of a run: a folder, or frames of a video."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ..batch.progress import StageLog
from ..errors import InputError
from ..io.video import VideoFrames, extract_frames, is_video
from .key_frames import Clip, read_clip

__all__ = ["PhotoSource", "find_photos"]


@dataclass(frozen=True)
class PhotoSource:
    """The place of a run's photos.

    Attributes
    ----------
    camera : str or None
        As `find_cameras` takes it.
    frames : VideoFrames or None
        Of the video, if they are frames of one.
    video : dict or None
        Its content of `solution.json`.
    clip : Clip or None
        The video, if its frames are to share one path.
    """

    folder: Path
    camera: str | None
    frames: VideoFrames | None = None
    video: dict[str, Any] | None = None
    clip: Clip | None = None


def find_photos(
    photos: Path, scratch: Path, camera: str | None, every: int | None, sharpest: int | None, log: StageLog
) -> PhotoSource:
    """A folder as it is; for a video, frames in `scratch/frames`, with the `camera.json` beside the video.

    Frames that neither `every` nor `sharpest` chooses are the key frames of one clip.
    """
    if not is_video(photos):
        if every is not None or sharpest is not None:
            raise InputError(f"{photos} is no video; --every and --sharpest choose frames of one")
        return PhotoSource(photos, camera)
    log.begin("frames")
    folder, tell, clip = scratch / "frames", partial(log.tell, "frames"), None
    if every is None and sharpest is None:
        clip = read_clip(photos, folder, tell)
        frames = clip.frames
    else:
        frames = extract_frames(photos, folder, every=every, sharpest=sharpest, progress=tell)
    log.end("frames", photos=len(frames.names), frames=frames.num_frames, damaged=frames.num_damaged)
    if clip is None and len(frames.names) < 3:
        raise InputError(
            f"{photos} gives {len(frames.names)} photos; the shutter needs at least three, take a smaller N"
        )
    beside = photos.parent / "camera.json"
    return PhotoSource(
        folder,
        str(beside) if camera is None and beside.is_file() else camera,
        frames,
        {
            "name": photos.name,
            "every": every,
            "sharpest": sharpest,
            "frames": frames.num_frames,
            "damaged": frames.num_damaged,
            "orientation": frames.orientation,
            "make": frames.make,
            "model": frames.model,
            **({} if clip is None else clip.facts()),
        },
        clip,
    )
