"""A video as one clip: its key frames as photos, and the times of all frames."""

from __future__ import annotations

import shutil
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, RsUndistortWarning
from ..io.video import FrameWriter, VideoFrames, VideoReader, converted, frame_name, sharpness_of
from ..model.array_types import Array, Index, Mask
from ..model.track import ShownFrames, usual_step
from ..sfm.flow import FlowFrame, KeyFlow, KeyFrameChooser, flow_size

__all__ = ["Clip", "flow_frames_of", "read_clip"]

# Smallest number of key frames of a clip, if it has as many frames: content that moved little is still seen from its
# ends.
_LEAST_KEYS = 8
# Standard deviation in grey levels of a frame that shows nothing.
_DARK = 2.0
_INTERLACED = (
    "{0} is interlaced: each frame holds two moments, which are on no path; write it anew first: "
    'ffmpeg -i "{0}" -vf bwdif=mode=send_frame -crf 12 -c:a copy deinterlaced.mp4'
)
# Pictures that may become the next key frame are held up to this much memory: a camera that stands still holds none of
# them back for ever. The oldest go first, and are decoded again if they are chosen.
_HELD_BYTES = 2e8
# A frame is the one before once more if its grey levels differ by less than this share of what they differed by in each
# of so many steps before: other frames of rendered and real videos do by a quarter at least, repeated ones by a
# thousandth. A flash is two large steps. Where there was none, it is taken to be of one grey level.
_SAME, _STEPS, _FIRST_STEP = 0.1, 3, 1.0
# A conversion repeats frames at least so often, and divides rates whose ratio has no larger denominator: 30 and 23.976
# have 5, 60 and 25 have 12.
_LEAST_REPEATS, _LARGEST_RATE = 4, 32
# It rounds times to frames, and where it begins, one comes earlier or later.
_ROUNDED = 1.25
# A recording paused if a step between frames is longer than this many usual ones.
_PAUSE = 20.0
_ONLY_CUTS = (
    "no frame of {} goes on from the one before, so that none share a path; take them as photos with --every N or "
    "--sharpest N"
)


@dataclass(frozen=True)
class Clip:
    """The frames of a video, in their order.

    Attributes
    ----------
    folder : Path
        Where its key frames lie, as PNG files.
    numbers : tuple of int, length n
        Indices of the frames among those that could be decoded; frames that show nothing, or the same as the one
        before, are left out.
    names : tuple of str, length n
        Of all frames, also of those that were not written.
    time_s : (n,) array
        Time of each, by the container's time stamps; seconds since the first. Evenly spaced where frames come twice
        regularly.
    frame_s : float
        The usual time from one frame to the next.
    part : (n,) int array
        Parts of continuous frames: a cut, or a pause of the recording, begins a new part.
    keys : (k,) int array
        The key frames.
    frames : VideoFrames
        Further facts about them, and about the camera.
    flows : tuple of KeyFlow
        Corners of key frames in the next one, in pixels of the flow.
    repeated : tuple of int
        Indices of frames that show the same as the one before.
    shown : ShownFrames or None
        What the file shows when, repeated frames too.
    """

    video: Path
    folder: Path
    numbers: tuple[int, ...]
    names: tuple[str, ...]
    time_s: Array
    frame_s: float
    part: Index
    keys: Index
    frames: VideoFrames
    flows: tuple[KeyFlow, ...] = ()
    repeated: tuple[int, ...] = ()
    shown: ShownFrames | None = None

    @property
    def key_names(self) -> tuple[str, ...]:
        """Names of the key frames."""
        return tuple(self.names[k] for k in self.keys.tolist())

    def are_keys(self, names: Sequence[str]) -> Mask:
        """(m,) which of these frames are key frames."""
        keys = {*self.key_names}
        return np.array([name in keys for name in names], bool)

    def with_gaps(self, missing: Index, frame_s: float) -> Clip:
        """The same frames where so many (n - 1,) are missing between them, and those of a part `frame_s` apart."""
        step_s = np.diff(self.time_s)
        step_s = np.where(np.diff(self.part) == 0, frame_s * (step_s / self.frame_s + missing), step_s)
        time_s = np.concatenate([[0.0], np.cumsum(step_s)]) + self.time_s[0]
        return replace(self, time_s=time_s, frame_s=frame_s)

    @property
    def is_even(self) -> bool:
        """Whether no frame of a part is missing, by their times."""
        step_s = np.diff(self.time_s)[np.diff(self.part) == 0]
        return bool((step_s < 1.5 * self.frame_s).all())

    def places(self, names: Sequence[str]) -> Index:
        """(m,) which of its frames have these names."""
        number = {name: k for k, name in enumerate(self.names)}
        return np.array([number[name] for name in names], np.int64)

    def facts(self) -> dict[str, Any]:
        """Its content of `solution.json`."""
        return {
            "key_frames": len(self.keys),
            "frame_s": self.frame_s,
            "cuts_s": self.time_s[np.flatnonzero(np.diff(self.part)) + 1].tolist(),
            "repeated": [*self.repeated],
        }


def _grey(picture: Any) -> NDArray[np.uint8]:
    """A frame: grey, and reduced for the flow if it is large."""
    return np.ascontiguousarray(converted(picture, "gray", flow_size(picture.width, picture.height)))


def flow_frames_of(clip: Clip, wanted: Sequence[int]) -> Iterator[tuple[int, FlowFrame]]:
    """Frames of a clip, by index (ascending), for the flow; one in memory at a time."""
    number_of = {clip.numbers[k]: k for k in wanted}
    with VideoReader(clip.video) as reader:
        for number, _, picture in reader:
            if number in number_of:
                yield number_of[number], FlowFrame.of(_grey(picture))
                if number_of[number] == wanted[-1]:
                    return


def read_clip(video: Path, folder: Path, progress: Callable[[int, int], None] | None = None) -> Clip:
    """Choose the key frames of a video by motion of the content and sharpness, and write them.

    Parameters
    ----------
    video : path
        Any file that FFmpeg decodes.
    folder : path
        Where the key frames go, as PNG files, with `frames.csv`; must not exist.
    progress : callable, optional
        Called with the number of frames read, and of all, 0 where that is not known.

    Raises
    ------
    InputError
        Fewer than two frames that show anything, no times, or frames that are interlaced.
    FileError
        No video, or damaged at its beginning.
    """
    folder.mkdir(parents=True)
    try:
        return _read(video, folder, progress)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _read(video: Path, folder: Path, progress: Callable[[int, int], None] | None) -> Clip:
    chooser, numbers, times, sharpness, num_late = KeyFrameChooser(), list[int](), list[float](), list[float](), 0
    held: dict[int, tuple[int, float, Any]] = {}  # frames that may become the next key
    written, repeated, shown, step = set[int](), list[int](), dict[float, int](), _Step()
    with VideoReader(video) as reader:
        writer = FrameWriter(reader, folder)
        for number, time_s, picture in reader:
            if progress is not None:
                progress(number + 1, reader.num_frames)
            if not np.isfinite(time_s):
                raise InputError(f"{video.name} holds no times of its frames; write it anew, or say --every N")
            if times and time_s <= times[-1]:
                num_late += 1
                continue
            if picture.interlaced_frame:
                raise InputError(_INTERLACED.format(video.name))
            grey = _grey(picture)
            if grey.std() < _DARK:
                continue
            if step.is_none(grey):
                repeated.append(number)
                shown[time_s] = numbers[-1]
                continue
            held[len(numbers)] = number, time_s, picture
            if len(held) * sum(plane.buffer_size for plane in picture.planes) > _HELD_BYTES:
                del held[min(held)]
            numbers.append(number)
            shown[time_s] = number
            times.append(time_s)
            sharpness.append(sharpness_of(picture))
            chooser.feed(FlowFrame.of(grey))
            if [len(numbers) - 1] == chooser.cuts[-1:]:
                step.forget()
            for k in held.keys() & {*chooser.keys} - written:
                writer.add(*held[k], sharpness[k])
                written.add(k)
            held = {k: each for k, each in held.items() if k > chooser.keys[-1]}
        chooser.finish()
        for k in held.keys() & {*chooser.keys} - written:
            writer.add(*held[k], sharpness[k])
            written.add(k)
        reader.warn()
    if num_late:
        warnings.warn(
            f"{video.name}: {num_late} frames whose time runs back were left out", RsUndistortWarning, stacklevel=3
        )
    if len(numbers) < 2:
        some = "only one frame that shows anything new" if numbers else "no frame that shows anything"
        raise InputError(f"{video.name} has {some}; a path needs two")
    time = _with_repeated(video, np.array(numbers), np.array(times), len(repeated))
    frame_s = usual_step(time)
    breaks = {*chooser.cuts, *(np.flatnonzero(np.diff(time) > _PAUSE * frame_s) + 1).tolist()}
    # no path leads across a break
    ends = {k - side for k in breaks for side in (0, 1)}
    keys = np.array(sorted({*chooser.keys, *_between(len(numbers), len(chooser.keys)), *ends}))
    _add(writer, video, {numbers[k]: sharpness[k] for k in keys.tolist() if k not in written})
    part = np.cumsum([k in breaks for k in range(len(numbers))])
    if len(part) == 2:
        part[:] = 0  # of two frames features say whether they show the same, where points cannot be followed
    elif part[-1] == len(part) - 1:
        raise InputError(_ONLY_CUTS.format(video.name))
    names = tuple(frame_name(video, number) for number in numbers)
    flows = tuple(each for each in chooser.flows if part[each.keys[0]] == part[each.keys[1]])
    return Clip(
        video, folder, tuple(numbers), names, time, frame_s, part, keys, writer.finish(), flows, tuple(repeated),
        ShownFrames(np.array([*shown]), tuple(frame_name(video, number) for number in shown.values())),
    )  # fmt: skip


class _Step:
    """By how much frames differ from the one before."""

    def __init__(self) -> None:
        self._before: NDArray[np.uint8] | None = None
        self._sizes = deque[float](maxlen=_STEPS)

    def is_none(self, grey: NDArray[np.uint8]) -> bool:
        """Whether the next frame shows the same as the one before, while the content moves."""
        if self._before is not None:
            size = float(cv2.norm(grey, self._before, cv2.NORM_L1)) / grey.size
            if size < _SAME * min(self._sizes, default=_FIRST_STEP):
                return True
            self._sizes.append(size)
        self._before = grey
        return False

    def forget(self) -> None:
        """A new scene begins with this frame."""
        self._sizes.clear()


def _with_repeated(video: Path, numbers: Index, time_s: Array, num_repeated: int) -> Array:
    """The times (n,) of frames where so many others showed the same as the one before."""
    if not num_repeated:
        return time_s
    step_s = _even_step(numbers, time_s)
    others = "" if step_s is None else f"; the others are taken to be {1e3 * step_s:.1f} ms apart"
    warnings.warn(
        f"{video.name}: {num_repeated} of {num_repeated + len(numbers)} frames show the same as the one before, as if "
        f"the video was converted to another frame rate; they are corrected as that one{others}",
        RsUndistortWarning, stacklevel=4,
    )  # fmt: skip
    return time_s if step_s is None else time_s[0] + step_s * np.arange(len(time_s))


def _even_step(numbers: Index, time_s: Array) -> float | None:
    """Time from frame to frame before a conversion to a higher frame rate repeated some; None if it was none.

    Indices of the others (n,) after a conversion are the multiples of the ratio of both rates, rounded.
    """
    if (np.diff(numbers) > 1).sum() < _LEAST_REPEATS:
        return None
    place = np.arange(len(numbers))
    slope = float(np.polyfit(place, numbers, 1)[0])
    for largest in range(1, _LARGEST_RATE):
        ratio = float(Fraction(slope).limit_denominator(largest))
        if np.ptp(numbers - ratio * place) < _ROUNDED:
            return ratio * float(np.median(np.diff(time_s) / np.diff(numbers)))
    return None


def _add(writer: FrameWriter, video: Path, sharpness: Mapping[int, float]) -> None:
    """Write more frames of a video, by their numbers."""
    if not sharpness:
        return
    with VideoReader(video) as reader:
        for number, time_s, picture in reader:
            if number in sharpness:
                writer.add(number, time_s, picture, sharpness[number])


def _between(num_frames: int, num_keys: int) -> Iterable[int]:
    """More key frames, spread evenly, where the content hardly moved."""
    if num_keys >= _LEAST_KEYS:
        return ()
    return np.linspace(0, num_frames - 1, min(_LEAST_KEYS, num_frames)).round().astype(int).tolist()
