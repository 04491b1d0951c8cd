"""The camera of a video as the file shows it: a pose for each frame, by the file's own times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .array_types import Array
from .camera import Camera
from .path import CameraPath

__all__ = ["CameraTrack", "ShownFrames", "camera_track", "even_camera", "usual_step"]

# Time stamps are whole milliseconds in some files: a frame of 1/120 s is then off by less than this share of itself.
_ROUNDED = 0.13


@dataclass(frozen=True)
class ShownFrames:
    """What a video shows when.

    These are the times of the container, at which players and other programs show the frames. The times of a path say
    when the camera took them; they are others where the video was converted to another frame rate.

    Attributes
    ----------
    time_s : (n,) array
        Seconds since the first frame, ascending.
    names : tuple of str, length n
        The frame that is shown; one that shows the same as the one before has that one's name.
    """

    time_s: Array
    names: tuple[str, ...]

    @property
    def frame_s(self) -> float:
        """The time from one frame to the next."""
        return usual_step(self.time_s)


def usual_step(time_s: Array) -> float:
    """The time from one frame to the next, as exact as rounded time stamps (n,) say it: over all frames, gaps apart."""
    step_s = np.diff(time_s)
    frame_s = float(step_s[step_s < 1.5 * np.median(step_s)].mean())
    return float(step_s.sum() / np.maximum(np.round(step_s / frame_s), 1).sum())


@dataclass(frozen=True)
class CameraTrack:
    """Poses of the frames of a video, for programs that play it.

    Attributes
    ----------
    time_s : (n,) array
        When the video shows each, seconds since its first frame.
    frame_s : float
        The usual time from one frame to the next.
    R_cw, center_w : (n, 3, 3), (n, 3) array
        `x_c = R_cw (X_w - center_w)`.
    camera : Camera
        Of the rectified frames, a pinhole.
    """

    time_s: Array
    frame_s: float
    R_cw: Array
    center_w: Array
    camera: Camera

    @property
    def numbers(self) -> Array:
        """(n,) number of each frame, counted from 0 by the times; whole where they are the rounded ones of a frame."""
        number = self.time_s / self.frame_s
        whole = np.round(number)
        return np.where(np.abs(number - whole) < _ROUNDED, whole, np.round(number, 6))


def camera_track(
    path: CameraPath, names: Sequence[str], shown: ShownFrames, camera: Camera, *, even: bool = False
) -> CameraTrack:
    """The poses of a path whose moments are the frames of these names, wherever the video shows one of them.

    With `even` the camera's sides are even, as those of a coded video: `even_camera`.
    """
    place = {name: k for k, name in enumerate(names)}
    seen = [k for k, name in enumerate(shown.names) if name in place]
    of_path = [place[shown.names[k]] for k in seen]
    camera = even_camera(camera) if even else camera
    return CameraTrack(shown.time_s[seen], shown.frame_s, path.R_cw[of_path], path.center_w[of_path], camera)


def even_camera(camera: Camera) -> Camera:
    """A camera of even sides, a pixel less where they are odd: encoders take colours for two pixels each way."""
    return replace(camera, width=camera.width - camera.width % 2, height=camera.height - camera.height % 2)
