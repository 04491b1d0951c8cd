"""Where the photos of a recipe are taken from, and how the camera moves meanwhile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FormatError, InputError
from ..io.gyro import read_gyro
from ..model.array_types import Array
from ..model.camera import Camera
from ..model.checks import check_finite
from ..model.motion import RowMotion
from .entries import count, kind_of, number, take
from .unsteady import Poses, RowTable, Vibration, read_row_tables, row_table, tracks, unsteady_motions

__all__ = ["Pose", "look_at", "motions_of", "poses_and_motions", "poses_of"]

_UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Pose:
    """Pose at mid-frame, the camera that has it, and which way the path goes on there (unit or zero)."""

    R_cw: Array
    center_w: Array
    camera_id: str
    heading_w: Array


def look_at(center_w: ArrayLike, target_w: ArrayLike, roll_deg: float = 0.0, up_w: ArrayLike = _UP) -> NDArray[Any]:
    """R_cw (3, 3) of a camera at center_w that looks at target_w.

    Parameters
    ----------
    center_w, target_w : (3,) array
        World frame.
    roll_deg : float
        Rotation of the camera about the viewing direction, clockwise as the photographer sees it; at 0 the x axis
        is perpendicular to `up_w`.
    up_w : (3,) array
        What is up in the photo.

    Examples
    --------
    >>> look_at(np.zeros(3), np.array([0.0, 2.0, 0.0])).round().astype(int).tolist()
    [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    """
    forward = np.asarray(target_w, float) - center_w
    length = float(np.linalg.norm(forward))
    if length < 1e-9:
        raise InputError("a camera cannot look at the point where it stands")
    forward = forward / length
    right = np.cross(forward, np.asarray(up_w, float))
    if np.linalg.norm(right) < 1e-9:
        raise InputError("a camera that looks straight up or down needs up_w: what is up in its photo")
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    return np.array([cos * right + sin * down, cos * down - sin * right, forward])


def _headings(centers: Array) -> Array:
    """Unit direction (n, 3) in which a path passes through its places; zero for a single place."""
    if len(centers) < 2:
        return np.zeros_like(centers)
    step = np.gradient(centers, axis=0)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.divide(step, length, out=np.zeros_like(step), where=length > 1e-12)


def _listed(entries: list[Any], default_camera: str) -> list[Pose]:
    centers, rotations, ids = [], [], []
    for k, entry in enumerate(entries):
        where = f"path[{k}]"
        take(entry, where, ("center_w", "look_at_w"), ("roll_deg", "up_w", "camera"))
        center = check_finite(entry["center_w"], (3,), f"{where}: center_w")
        target = check_finite(entry["look_at_w"], (3,), f"{where}: look_at_w")
        up = check_finite(entry.get("up_w", _UP), (3,), f"{where}: up_w")
        try:
            rotations.append(look_at(center, target, number(entry.get("roll_deg", 0.0), f"{where}: roll_deg"), up))
        except InputError as error:
            raise FormatError(f"{where}: {error}") from error
        centers.append(center)
        ids.append(str(entry.get("camera", default_camera)))
    return [Pose(*each) for each in zip(rotations, centers, ids, _headings(np.array(centers)), strict=True)]


def _orbit(entry: dict[str, Any], camera: str) -> list[Pose]:
    take(entry, "path", ("kind", "center_w", "radius_m", "num", "look_at_w"), ("start_deg", "arc_deg", "roll_deg"))
    middle = check_finite(entry["center_w"], (3,), "path: center_w")
    target = check_finite(entry["look_at_w"], (3,), "path: look_at_w")
    radius, arc = number(entry["radius_m"], "path: radius_m"), number(entry.get("arc_deg", 360.0), "path: arc_deg")
    num = count(entry["num"], "path: num")
    # a whole round does not take its first photo twice
    arcs = np.linspace(0.0, arc, num, endpoint=abs(arc) < 360.0)
    angle = np.radians(number(entry.get("start_deg", 0.0), "path: start_deg") + arcs)
    centers = middle + radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(num)], 1)
    roll = number(entry.get("roll_deg", 0.0), "path: roll_deg")
    headings = np.sign(arc or 1.0) * np.stack([-np.sin(angle), np.cos(angle), np.zeros(num)], 1)
    return [Pose(look_at(c, target, roll), c, camera, h) for c, h in zip(centers, headings, strict=True)]


def _lines(entry: dict[str, Any], camera: str, flying: bool) -> list[Pose]:
    """A street: places along a line, looking one way. A flyover: the same from above, to and fro on several lines."""
    optional = ("roll_deg", "lines", "line_spacing_m", "look_w") if flying else ("roll_deg",)
    take(entry, "path", ("kind", "start_w", "end_w", "num", *(() if flying else ("look_w",))), optional)
    start = check_finite(entry["start_w"], (3,), "path: start_w")
    end = check_finite(entry["end_w"], (3,), "path: end_w")
    look = check_finite(entry.get("look_w", (0.0, 0.0, -1.0)), (3,), "path: look_w")
    num, lines = count(entry["num"], "path: num"), count(entry.get("lines", 1), "path: lines")
    count(num * lines, "path: num times lines")
    along = end - start
    if np.linalg.norm(along) < 1e-9:
        raise FormatError("path: start_w and end_w are the same place")
    along = along / np.linalg.norm(along)
    side = np.cross(along, _UP)
    if lines > 1 and np.linalg.norm(side) < 1e-9:
        raise FormatError("path: lines that rise straight up have no side to lie on")
    spacing = number(entry.get("line_spacing_m", 0.0), "path: line_spacing_m")
    roll = number(entry.get("roll_deg", 0.0), "path: roll_deg")
    # looking down, the flight direction is up in the photo, on the way back too: the drone rotates
    steep = abs(look[2]) > 0.99 * np.linalg.norm(look)
    poses = []
    for line in range(lines):
        back = line % 2 == 1
        heading = -along if back else along
        shift = line * spacing * (side / np.linalg.norm(side) if lines > 1 else 0.0)
        for share in np.linspace(0, 1, num)[:: -1 if back else 1]:
            center = start + share * (end - start) + shift
            poses.append(Pose(look_at(center, center + look, roll, heading if steep else _UP), center, camera, heading))
    return poses


def poses_of(entry: Any, default_camera: str) -> list[Pose]:
    """Poses of a recipe's path: a list of places, or an orbit, a street, a flyover."""
    if isinstance(entry, list):
        if not entry:
            raise FormatError("path: it has no places")
        return _listed(entry, default_camera)
    kind = kind_of(entry, "path", ("orbit", "street", "flyover"))
    return _orbit(entry, default_camera) if kind == "orbit" else _lines(entry, default_camera, kind == "flyover")


KINDS = ("none", "rotation", "random", "given", "gyro")
#: Keys of a recipe's motion that say what is not steady, with the kinds that each goes with.
UNSTEADY = {
    "acceleration": ("rotation", "random", "given"),
    "vibration": KINDS,
    "tables": ("given",),
    "log": ("gyro",),
    "axes": ("gyro",),
    "readout_ms": ("gyro",),
}


def _directions(rng: np.random.Generator, num: int) -> Array:
    axes = rng.normal(size=(num, 3))
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))


def motions_of(entry: Any, poses: list[Pose], frame_spans: list[float], seed: int) -> list[RowMotion]:
    """Motion of each photo: random, given, or none.

    Random motion rotates about an axis uniform on the sphere by an angle over the frame drawn from N(0, sigma^2), and
    moves alike; `drift_m_per_frame` carries the camera along its path besides.
    """
    kind = kind_of(entry, "motion", KINDS)
    entry = {key: value for key, value in entry.items() if key not in UNSTEADY}
    num, spans = len(poses), np.array(frame_spans)[:, None]
    if kind in ("none", "gyro"):
        take(entry, "motion", ("kind",))
        return [RowMotion()] * num
    if kind == "given":
        take(entry, "motion", ("kind",), ("phi_rad_per_frame", "velocity_m_per_frame"))
        zero = np.zeros((num, 3))
        phi = check_finite(entry.get("phi_rad_per_frame", zero), (num, 3), "motion: phi_rad_per_frame")
        velocity = check_finite(entry.get("velocity_m_per_frame", zero), (num, 3), "motion: velocity_m_per_frame")
        return [RowMotion(p, v) for p, v in zip(phi / spans, velocity / spans, strict=True)]
    if kind == "rotation":
        take(entry, "motion", ("kind", "sigma_rad_per_frame"), ("still",))
        rotation, shift, drift = number(entry["sigma_rad_per_frame"], "motion: sigma_rad_per_frame"), 0.0, 0.0
    else:
        optional = ("rotation_rad_per_frame", "translation_m_per_frame", "drift_m_per_frame")
        take(entry, "motion", ("kind",), (*optional, "still"))
        rotation, shift, drift = (number(entry.get(key, 0.0), f"motion: {key}") for key in optional)
    still = entry.get("still", [])
    if any(isinstance(k, bool) or not isinstance(k, int) or not 0 <= k < num for k in still):
        raise FormatError(f"motion: still={still!r}, expected numbers of photos, 0 to {num - 1}")
    rng, shift_rng = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 5])
    motions = []
    for k, pose in enumerate(poses):
        axis = rng.normal(size=3)
        phi = rotation * rng.normal() / frame_spans[k] * axis / np.linalg.norm(axis)
        velocity = shift * shift_rng.normal() / frame_spans[k] * _directions(shift_rng, 1)[0]
        velocity = velocity + drift / frame_spans[k] * pose.heading_w
        motions.append(RowMotion() if k in still else RowMotion(phi, velocity))
    return motions


def poses_and_motions(
    entry: Mapping[str, Any],
    names: Sequence[str],
    cameras: Sequence[Camera],
    poses: Sequence[Pose],
    motions: Sequence[RowMotion],
    seed: int,
    readout_ms: float | None,
    folder: Path,
) -> tuple[list[Pose], list[RowMotion]]:
    """Poses and motions with what is not steady in a recipe's motion; the poses become those of the nearest steady one.

    `entry` is the recipe's, `motions` what `motions_of` makes of it; tables and logs are looked for in `folder`.
    """
    kind = entry["kind"]
    if wrong := [key for key, kinds in UNSTEADY.items() if key in entry and kind not in kinds]:
        raise FormatError(f"motion: unknown key {wrong[0]!r} of the kind {kind}")
    if not set(UNSTEADY) & set(entry) and kind != "gyro":
        return list(poses), list(motions)
    start: dict[str, RowMotion | RowTable | Poses] = dict(zip(names, motions, strict=True))
    if kind == "gyro":
        if "log" not in entry:
            raise FormatError("motion: missing key 'log'")
        log = read_gyro(folder / entry["log"], entry.get("axes"))
        given_ms = entry.get("readout_ms", readout_ms)
        seconds = None if given_ms is None else number(given_ms, "motion: readout_ms") / 1e3
        start = dict(zip(names, tracks(log, list(cameras), seconds, seed), strict=True))
    if "tables" in entry:
        said = entry["tables"]
        if isinstance(said, str):
            tables = read_row_tables(folder / said)
        else:
            tables = {name: row_table(each, f"motion: table of {name}") for name, each in dict(said).items()}
        if unknown := sorted(set(tables) - set(names)):
            raise FormatError(f"motion: there is no photo {unknown[0]!r} for its table")
        start |= tables
    share = number(entry.get("acceleration", 0.0), "motion: acceleration")
    vibration = None
    if "vibration" in entry:
        keys = ("amplitude_rad", "travel_m", "periods", "axis")
        options = dict(take(entry["vibration"], "motion: vibration", (), keys))
        vibration = Vibration(travel=options.pop("travel_m", 0.0), **options)
    still = {names[k] for k in entry.get("still", [])}
    found = unsteady_motions(start, cameras, share, vibration, seed, still)
    rotated = [
        replace(pose, R_cw=rotation @ pose.R_cw, center_w=pose.center_w + way)
        for pose, (_, rotation, way) in zip(poses, found.values(), strict=True)
    ]
    return rotated, [motion for motion, _, _ in found.values()]
