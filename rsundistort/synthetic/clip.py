"""A video of a synthetic scene: one path of the camera, and the frames that are taken along it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ..errors import FormatError, InputError
from ..model.array_types import Array
from ..model.camera import Camera
from ..model.checks import check_finite
from ..model.motion import RowMotion
from .entries import count, kind_of, number, take
from .flight import look_at

__all__ = ["CLIP_KINDS", "CameraPath", "Clip", "Tremor", "clip_of", "is_clip"]

CLIP_KINDS = ("walk", "pan")
# Intervals of a bend for half a period of the fastest tremor: these follow it to 4e-6 of its amplitude.
_INTERVALS = 16
_MOST_SITES = 1025
_HZ = (0.01, 100.0)


@dataclass(frozen=True)
class Tremor:
    """A hand's tremor: a few sinusoids about and along each axis, equally fast, so that slow ones are wide.

    Parameters
    ----------
    rotation_rad, travel : float
        Root mean square over time about each axis of the camera, and along each axis of the world (world units).
    hz : (float, float)
        Their frequencies: drawn between these, evenly in the logarithm, one from each of `num` stretches.
    num : int
        Sinusoids an axis.
    seed : int
        Of frequencies and phases.

    Attributes
    ----------
    waves : tuple of (num, 6) arrays
        Rate (radians a second), phase and amplitude (radians, then world units) of each sinusoid.
    """

    rotation_rad: float = 0.0
    travel: float = 0.0
    hz: tuple[float, float] = (1.0, 12.0)
    num: int = 5
    seed: int = 0
    waves: tuple[Array, Array, Array] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("rotation_rad", "travel"):
            if check_finite(getattr(self, name), (), f"tremor: {name}") < 0:
                raise InputError(f"tremor: {name}={getattr(self, name):g}, expected 0 or more")
        low, high = check_finite(self.hz, (2,), "tremor: hz").tolist()
        if not _HZ[0] <= low <= high <= _HZ[1]:
            raise InputError(f"tremor: hz={low:g} to {high:g}, expected a range between {_HZ[0]:g} and {_HZ[1]:g}")
        rng = np.random.default_rng([self.seed, 10])
        hz = low * (high / low) ** ((np.arange(self.num)[:, None] + rng.uniform(size=(self.num, 6))) / self.num)
        # of a sinusoid the mean square is half the square of its amplitude
        amplitude = (1 / hz) / np.sqrt((hz**-2.0).sum(axis=0) / 2)
        amplitude *= np.repeat([self.rotation_rad, self.travel], 3)
        object.__setattr__(self, "waves", (2 * np.pi * hz, rng.uniform(0, 2 * np.pi, hz.shape), amplitude))

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Rotation vectors (k, 3) in the camera, and ways (k, 3) in the world, at times (k,)."""
        rate, phase, amplitude = self.waves
        found = (amplitude * np.sin(rate * time_s[:, None, None] + phase)).sum(axis=1)
        return found[:, :3], found[:, 3:]


@dataclass(frozen=True)
class CameraPath:
    """Where a camera is, and how it is rotated, as a smooth function of time.

    Parameters
    ----------
    place, target, roll_deg : function
        Of times (k,): centre and what the camera looks at, (k, 3) in the world, and its roll (k,), all without tremor.
    tremor : Tremor
        Comes on top of these; of a level path the part about the vertical only.
    steps_hz, bob, sway : float
        Steps a second of who carries the camera; amplitudes of what each adds upwards, and each second one sideways,
        world units.
    level : bool
        Pitch and roll are zero at all times: the camera looks at the height where it is.
    """

    place: Callable[[Array], Array]
    target: Callable[[Array], Array]
    roll_deg: Callable[[Array], Array]
    tremor: Tremor = field(default_factory=Tremor)
    steps_hz: float = 0.0
    bob: float = 0.0
    sway: float = 0.0
    level: bool = False

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """R_cw (k, 3, 3) and center_w (k, 3) at times (k,), seconds."""
        time_s = np.asarray(time_s, np.float64)
        center, target = self.place(time_s), self.target(time_s)
        if self.level:
            target = np.column_stack([target[:, :2], center[:, 2]])
        looks = zip(center, target, self.roll_deg(time_s), strict=True)
        R_cw = np.array([look_at(*each) for each in looks]).reshape(-1, 3, 3)
        rotation, way = self.tremor.at(time_s)
        if self.level:
            rotation = rotation * [0.0, 1.0, 0.0]
        step = 2 * np.pi * self.steps_hz * time_s
        side = R_cw[:, 2, [1, 0, 2]] * [1.0, -1.0, 0.0]  # horizontal, to the right
        side = side / np.linalg.norm(side, axis=1, keepdims=True)
        way = way + self.bob * np.outer(np.sin(step), [0.0, 0.0, 1.0]) + self.sway * np.sin(step / 2)[:, None] * side
        return Rotation.from_rotvec(rotation).as_matrix() @ R_cw, center + way


@dataclass(frozen=True)
class Clip:
    """Frames taken at an even rate along one path.

    Parameters
    ----------
    fps : Fraction
        Frames a second.
    readout : float
        Share of the time of a frame for which it is read, above 0 and up to 1.
    references_every : int
        Frames whose number is a multiple of this have a global-shutter reference.
    """

    NAME = "clip.mp4"

    path: CameraPath
    num_frames: int
    fps: Fraction
    readout: float
    references_every: int = 10

    @property
    def readout_s(self) -> float:
        """Time for which a frame is read."""
        return self.readout / float(self.fps)

    @property
    def time_s(self) -> Array:
        """(num_frames,) seconds: when the line of the principal point of each frame is read, 0 for the first."""
        return np.arange(self.num_frames) / float(self.fps)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the frames, as `io.video.extract_frames` gives them."""
        return tuple(f"clip_{k:06d}.png" for k in range(self.num_frames))

    def frame(self, number: int, camera: Camera) -> tuple[Array, Array, RowMotion]:
        """R_cw, center_w and motion of a frame: what is nearest to steady, and how the path bends away from it.

        A line at the clock r has the pose of the path at the time `time_s[number] + readout_s r / camera.frame_span`.
        """
        periods = self.path.tremor.hz[1] * self.readout_s
        sites = min(_INTERVALS * max(1, int(np.ceil(2 * periods))) + 1, _MOST_SITES)
        clock = np.linspace(*camera.clock_range, 4 * (sites - 1) + 1)
        late = self.readout_s / camera.frame_span * clock
        R_cw, center_w = self.path.at(self.time_s[number] + np.append(0.0, late))
        rotation = Rotation.from_matrix(R_cw[1:] @ R_cw[0].T).as_rotvec()
        motion, correction, way = RowMotion.of(clock, rotation, center_w[1:] - center_w[0], sites)
        return correction @ R_cw[0], center_w[0] + way, motion


def is_clip(entry: Any) -> bool:
    """Whether a recipe's path is that of a video."""
    return isinstance(entry, dict) and entry.get("kind") in CLIP_KINDS


def clip_of(entry: Any, references: Any, seed: int) -> Clip:
    """The clip of a recipe's path, which `is_clip`, and of its global-shutter references."""
    pan = kind_of(entry, "path", CLIP_KINDS) == "pan"
    required = ("kind", "fps", "readout", "way", *(("center_w",) if pan else ()))
    optional = ("num_frames", "duration_s", "tremor", "level", *(() if pan else ("steps",)))
    take(entry, "path", required, optional)
    fps = number(entry["fps"], "path: fps")
    if not 1 <= fps <= 1000:
        raise FormatError(f"path: fps={fps:g}, expected 1 to 1000 frames a second")
    if ("num_frames" in entry) == ("duration_s" in entry):
        raise FormatError("path: expected either num_frames or duration_s")
    if "num_frames" in entry:
        num = count(entry["num_frames"], "path: num_frames")
    else:
        num = round(number(entry["duration_s"], "path: duration_s") * fps)
        count(max(num, 1), "path: frames")
    if num < 2:
        raise FormatError(f"path: {num} frames, a clip needs two or more")
    readout = number(entry["readout"], "path: readout")
    if not 0 < readout <= 1:
        raise FormatError(f"path: readout={readout:g}, expected a share of the frame's time above 0 and up to 1")
    level = entry.get("level", False)
    if not isinstance(level, bool):
        raise FormatError(f"path: level={level!r}, expected true or false")
    steps = take(entry.get("steps", {}), "path: steps", (), ("hz", "up_m", "side_m"))
    path = CameraPath(
        *_way(entry, pan, level, (num - 1) / fps),
        tremor=_tremor(entry.get("tremor", {}), pan, seed),
        steps_hz=number(steps.get("hz", 0.0), "path: steps: hz"),
        bob=number(steps.get("up_m", 0.0), "path: steps: up_m"),
        sway=number(steps.get("side_m", 0.0), "path: steps: side_m"),
        level=level,
    )
    every = count(take(references, "twins", (), ("every",)).get("every", 10), "twins: every")
    clip = Clip(path, num, Fraction(fps).limit_denominator(1001), readout, every)
    try:
        path.at(clip.time_s)
    except InputError as error:
        raise FormatError(f"path: {error}") from error
    return clip


def _tremor(entry: Any, pan: bool, seed: int) -> Tremor:
    take(entry, "path: tremor", (), ("rotation_deg", "hz", "num", *(() if pan else ("travel_m",))))
    rotation, travel = (number(entry.get(key, 0.0), f"path: tremor: {key}") for key in ("rotation_deg", "travel_m"))
    num = count(entry.get("num", 5), "path: tremor: num", 1000)
    low, high = check_finite(entry.get("hz", (1.0, 12.0)), (2,), "path: tremor: hz").tolist()
    return Tremor(float(np.radians(rotation)), travel, (low, high), num, seed)


def _way(
    entry: dict[str, Any], pan: bool, level: bool, end_s: float
) -> tuple[Callable[[Array], Array], Callable[[Array], Array], Callable[[Array], Array]]:
    """Place, target and roll as functions of time: cubic splines through the way points, evenly spread over it."""
    if not isinstance(entry["way"], list) or not entry["way"]:
        raise FormatError("path: way has no points, expected one or more")
    centers, targets, rolls = [], [], []
    for k, point in enumerate(entry["way"]):
        where = f"path: way[{k}]"
        take(point, where, ("look_at_w", *(() if pan else ("center_w",))), () if level else ("roll_deg",))
        stand = (entry["center_w"], "path: center_w") if pan else (point["center_w"], f"{where}: center_w")
        centers.append(check_finite(stand[0], (3,), stand[1]))
        targets.append(check_finite(point["look_at_w"], (3,), f"{where}: look_at_w"))
        rolls.append(number(point.get("roll_deg", 0.0), f"{where}: roll_deg"))

    def along(values: list[Any]) -> Callable[[Array], Array]:
        first = np.asarray(values[0], np.float64)
        if all(np.array_equal(each, first) for each in values):  # without rounding: a tripod does not move
            return lambda time_s: np.broadcast_to(first, (*np.shape(time_s), *first.shape))
        spline = CubicSpline(np.linspace(0.0, end_s, len(values)), np.array(values, np.float64))
        return lambda time_s: np.asarray(spline(time_s), np.float64)

    return along(centers), along(targets), along(rolls)
