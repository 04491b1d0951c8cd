"""A video as programs, lamps and passers-by leave it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from rsundistort.io.video_writer import write_video

__all__ = ["EDITS", "edited"]

Frames = list[np.ndarray]


def _scaled(frame: np.ndarray, gain: float | np.ndarray, more: float = 0.0) -> np.ndarray:
    return np.clip(gain * frame + more, 0, 255).astype(np.uint8)


def _lamps(frames: Frames) -> Frames:
    """Bands of lamps that flicker, two in each frame."""
    y = np.linspace(0, 1, len(frames[0]))[:, None, None]
    return [_scaled(frame, 1 + 0.25 * np.sin(2 * np.pi * (2 * y + 0.37 * k))) for k, frame in enumerate(frames)]


def _exposure(frames: Frames) -> Frames:
    return [_scaled(frame, 1 + 0.3 * np.sin(2 * np.pi * k / 24)) for k, frame in enumerate(frames)]


def _flash(frames: Frames) -> Frames:
    return [_scaled(frame, 1, 120 * (k % 31 == 20)) for k, frame in enumerate(frames)]


def _converted(frames: Frames) -> Frames:
    """To a frame rate that is higher by a fifth."""
    return [frames[k * 5 // 6] for k in range(len(frames) * 6 // 5)]


def _frozen(frames: Frames) -> Frames:
    half = len(frames) // 2
    return [*frames[:half], *[frames[half]] * 40, *frames[half:]]


def _passers_by(frames: Frames) -> Frames:
    """Four that cover up to a fifth of the frame."""
    height, width = frames[0].shape[:2]
    looks = np.random.default_rng(7).integers(0, 255, (4, 12, 4, 3), np.uint8)
    found = []
    for k, frame in enumerate(frames):
        crowded = frame.copy()
        for i, look in enumerate(looks):
            x = int(i * 170 + (2 + i) * k * (1 if i % 2 else -1)) % (width - 60)
            crowded[height - 200 : height - 10, x : x + 60] = cv2.resize(look, (60, 190), interpolation=0)
        found.append(crowded)
    return found


def _captions(frames: Frames) -> Frames:
    found = [frame.copy() for frame in frames]
    for k, frame in enumerate(found):
        cv2.putText(frame, f"REC {k:05d} ALT 12.{k % 10}m", (20, 30), 0, 0.7, (255, 255, 255), 2)
        cv2.drawMarker(frame, (frame.shape[1] // 2, frame.shape[0] // 2), (0, 255, 0), 0, 40, 2)
    return found


def _noise(frames: Frames) -> Frames:
    rng = np.random.default_rng(0)
    return [_scaled(frame, 0.35, rng.normal(0, 8, frame.shape)) for frame in frames]


#: What becomes of the frames, by name, and by how much the readout takes longer by the clock of the file.
EDITS: dict[str, tuple[Callable[[Frames], Frames], float]] = {
    "lamps": (_lamps, 1.0),
    "exposure": (_exposure, 1.0),
    "flash": (_flash, 1.0),
    "converted": (_converted, 1.2),
    "frozen": (_frozen, 1.0),
    "one in seven missing": (lambda frames: [frame for k, frame in enumerate(frames) if k % 7 != 3], 1.0),
    "every second": (lambda frames: frames[::2], 0.5),
    "passers-by": (_passers_by, 1.0),
    "captions": (_captions, 1.0),
    "blur": (lambda frames: [cv2.GaussianBlur(frame, (0, 0), 2.0) for frame in frames], 1.0),
    "noise": (_noise, 1.0),
}


def edited(video: Path, out: Path, change: Callable[[Sequence[np.ndarray]], Frames]) -> None:
    """Write a video anew, changed, at its frame rate."""
    with av.open(str(video)) as container:
        rate = Fraction(container.streams.video[0].average_rate)
        frames = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    write_video(out, change(frames), rate)
