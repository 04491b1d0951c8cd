"""A video as programs, lamps and passers-by leave it."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from rsundistort.io.video_writer import write_video

__all__ = ["EDITS", "OF_NO_CAMERA", "edited"]

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


def _at_rate(frames: Frames, ratio: float) -> Frames:
    """At another frame rate, so many times the present one: those that are nearest in time."""
    return [frames[int(k / ratio + 0.5 - 1e-9)] for k in range(int((len(frames) - 1) * ratio))]


def _frozen(frames: Frames) -> Frames:
    half = len(frames) // 2
    return [*frames[:half], *[frames[half]] * 40, *frames[half:]]


def _twice(frames: Frames) -> Frames:
    """Some frames, as a recorder that could not keep up wrote them, show the one before."""
    late = {4, 9, 17, 20, 26}
    return [frames[k - 1] if k % 31 in late else frame for k, frame in enumerate(frames)]


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


def _hood(frames: Frames) -> Frames:
    """A quarter of the frame moves with the camera, as the hood of a car does."""
    height, width = frames[0].shape[:2]
    size = width, height // 4
    hood = cv2.resize(np.random.default_rng(3).integers(20, 120, (30, 60, 3), np.uint8), size, interpolation=2)
    return [np.vstack([frame[: height - len(hood)], hood]) for frame in frames]


def _snow(frames: Frames) -> Frames:
    """Flakes that fall, 2 to 8 px large."""
    rng = np.random.default_rng(8)
    size = np.array(frames[0].shape[1::-1])
    start, step, radius = (
        rng.uniform(0, size, (150, 2)),
        rng.uniform((-3, 6), (3, 14), (150, 2)),
        rng.integers(1, 5, 150),
    )
    found = [frame.copy() for frame in frames]
    for k, frame in enumerate(found):
        for place, each in zip((start + k * step) % size, radius, strict=True):
            cv2.circle(frame, place.astype(int).tolist(), int(each), (240, 240, 240), -1)
    return found


def _magnified(frames: Frames, by: Callable[[float], float]) -> Frames:
    """Magnified about the middle, by a function of the time from 0 to 1."""
    size = frames[0].shape[1::-1]
    middle = (np.array(size) - 1) / 2
    found = []
    for time, frame in zip(np.linspace(0, 1, len(frames)), frames, strict=True):
        warp = by(time) * np.eye(2, 3)
        warp[:, 2] = middle - warp[:, :2] @ middle
        found.append(cv2.warpAffine(frame, warp, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
    return found


def _focusing(frames: Frames) -> Frames:
    """A lens that focuses to and fro, which changes its focal length by a hundredth."""
    return _magnified(frames, lambda time: 1 + 0.01 * np.sin(2.7 * np.pi * time))


def _cropped(frames: Frames) -> Frames:
    """A zoom by cropping, which shortens the readout of what it shows: in the mean by an eighth."""
    return _magnified(frames, lambda time: 1 + 0.3 * time)


#: What becomes of the frames, by name, and the frame rate that they are then said to have, by the present one.
EDITS: dict[str, tuple[Callable[[Frames], Frames], float]] = {
    "lamps": (_lamps, 1.0),
    "exposure": (_exposure, 1.0),
    "flash": (_flash, 1.0),
    "higher rate": (lambda frames: _at_rate(frames, 1.25), 1.25),
    "lower rate": (lambda frames: _at_rate(frames, 5 / 6), 5 / 6),
    "half the rate": (lambda frames: frames[::2], 0.5),
    "frozen": (_frozen, 1.0),
    "dropped": (lambda frames: [each for k, each in enumerate(frames) if k % 31 not in (4, 11, 20, 21)], 1.0),
    "passers-by": (_passers_by, 1.0),
    "captions": (_captions, 1.0),
    "blur": (lambda frames: [cv2.GaussianBlur(frame, (0, 0), 2.0) for frame in frames], 1.0),
    "noise": (_noise, 1.0),
    "hood": (_hood, 1.0),
    "snow": (_snow, 1.0),
    "focusing": (_focusing, 1.0),
    "zoom": (_cropped, 1.0),
    "no camera": (lambda frames: frames, 1.0),
    "some twice, no camera": (_twice, 1.0),
    "focusing, no camera": (_focusing, 1.0),
    "upright": (lambda frames: [cv2.rotate(frame, cv2.ROTATE_90_CLOCKWISE) for frame in frames], 1.0),
    "backwards": (lambda frames: frames[::-1], 1.0),
}

#: Edits after which nobody knows the camera.
OF_NO_CAMERA = ("no camera", "some twice, no camera", "focusing, no camera", "upright")


def edited(video: Path, out: Path, edit: str) -> None:
    """Write a video anew, changed."""
    change, faster = EDITS[edit]
    with av.open(str(video)) as container:
        rate = Fraction(container.streams.video[0].average_rate)
        frames = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    write_video(out, change(frames), rate * Fraction(faster).limit_denominator(100))
