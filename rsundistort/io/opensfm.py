"""OpenSfM's `reconstruction.json`, and `tracks.csv` beside it.

Its coordinates have their origin in the middle of the photo and its longer side for unit. Poses are `x_c = R X + t`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..colmap.cameras_and_poses import checked_name
from ..colmap.measured_model import ColmapModel
from ..errors import FormatError, file_errors
from ..model import Camera, Observations, Reconstruction
from .rules import Numbers, OneOf, check

__all__ = ["opensfm_model"]

#: Cameras of OpenSfM that are ours: the lens, and its coefficients in OpenCV's order.
_LENSES: dict[str, tuple[str, tuple[str, ...]]] = {
    "perspective": ("pinhole", ("k1", "k2", "", "")),
    "simple_radial": ("pinhole", ("k1", "", "", "")),
    "radial": ("pinhole", ("k1", "k2", "", "")),
    "brown": ("pinhole", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2", "", "")),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}


_SHOT = {"rotation": Numbers(3), "translation": Numbers(3), "camera": str}
#: What is read of a reconstruction; of its cameras those that have shots.
_RULES = {
    "cameras": {str: dict},
    "shots": {str: _SHOT},
    "points": {str: {"coordinates": Numbers(3), "color": Numbers(3)}},
}
_CAMERA = {
    "projection_type?": OneOf(*_LENSES),
    "width": int,
    "height": int,
    **{f"{name}?": float for name in ("focal", "focal_x", "focal_y", "c_x", "c_y", "k1", "k2", "k3", "k4", "p1", "p2")},
}


def opensfm_model(value: list[dict[str, Any]], path: Path) -> ColmapModel:
    """The largest of a file's reconstructions. Ids count photos and cameras by name, tracks from one."""
    check(value, [{"shots": dict}])
    largest = max(range(len(value)), key=lambda k: len(value[k]["shots"]))
    found = value[largest]
    check(found, _RULES, f"[{largest}]")
    shots, points = found["shots"], found["points"]
    names = [checked_name(name, str(path)) for name in sorted(shots)]
    if len(names) < 2 or not points:
        raise FormatError(f"{path} holds {len(names)} photos and {len(points)} points, expected more")
    if odd := next((key for key in points if not key.isdecimal() or len(key) > 18), None):
        raise FormatError(f"{path}: points.{odd}: expected a number for a name")
    labels = sorted({shots[name]["camera"] for name in names})
    if lost := set(labels) - found["cameras"].keys():
        raise FormatError(f"{path}: camera {min(lost)!r} of a shot is missing")
    cameras = [_camera(found["cameras"][label], f"{path}: camera {label!r}") for label in labels]
    tracks = sorted(points, key=int)
    R_cw = Rotation.from_rotvec([shots[name]["rotation"] for name in names]).as_matrix()
    t = np.array([shots[name]["translation"] for name in names], np.float64)
    camera_idx = np.array([labels.index(shots[name]["camera"]) for name in names], np.int64)
    frame, point, feature, xy, others = _observations(path.with_name("tracks.csv"), names, tracks)
    width, height = np.array([(camera.width, camera.height) for camera in cameras], np.float64)[camera_idx[frame]].T
    middle = np.column_stack([width, height]) / 2 - 0.5
    return ColmapModel(
        Reconstruction(
            cameras,
            names,
            camera_idx,
            R_cw,
            -np.einsum("mji,mj->mi", R_cw, t),
            np.array([points[track]["coordinates"] for track in tracks], np.float64),
            Observations(frame, point, xy * np.maximum(width, height)[:, None] + middle),
        ),
        np.arange(1, 1 + len(cameras)),
        np.arange(1, 1 + len(names)),
        np.array(tracks, np.int64) + 1,
        feature,
        np.array([points[track]["color"] for track in tracks], np.float64).round().clip(0, 255).astype(np.uint8),
        tuple(sorted(others)),
        self_calibrated=True,
    )


def _camera(found: dict[str, Any], where: str) -> Camera:
    check(found, _CAMERA, where)
    if "focal" not in found and not {"focal_x", "focal_y"} <= found.keys():
        raise FormatError(f"{where} has no focal length")
    kind = found.get("projection_type", "perspective")
    lens, coefficients = _LENSES[kind]
    width, height = found["width"], found["height"]
    size = max(width, height)
    fx, fy = (found["focal"],) * 2 if "focal" in found else (found["focal_x"], found["focal_y"])
    center = [0.5 * side - 0.5 + size * found.get(name, 0.0) for side, name in ((width, "c_x"), (height, "c_y"))]
    K = np.array([[size * fx, 0, center[0]], [0, size * fy, center[1]], [0, 0, 1.0]])
    return Camera(width, height, K, np.array([found.get(name, 0.0) for name in coefficients]), lens=lens)


def _observations(path: Path, names: list[str], tracks: list[str]) -> tuple[Any, ...]:
    """Photo, point, feature and place of each measurement in `tracks.csv`, and which photos of it have no pose."""
    photo_of = {name: i for i, name in enumerate(names)}
    point_of = {track: k for k, track in enumerate(tracks)}
    try:
        with file_errors(path, mend="; the measurements of reconstruction.json are in it"):
            lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is no UTF-8 text") from error
    seen, others = [], set()
    for number, line in enumerate(lines, start=1):
        if not line or (number == 1 and line.startswith("OPENSFM_TRACKS_VERSION")):
            continue
        cells = line.split("\t")
        if len(cells) < 5:
            raise FormatError(f"{path}, line {number}: {len(cells)} columns, expected image, track, feature, x, y ...")
        if cells[0] not in photo_of:
            others.add(checked_name(cells[0], str(path)))
        elif cells[1] in point_of:
            try:
                seen.append((photo_of[cells[0]], point_of[cells[1]], int(cells[2]), *map(float, cells[3:5])))
            except ValueError as error:
                raise FormatError(f"{path}, line {number}: {error}") from error
    table = np.array(seen, np.float64).reshape(-1, 5)
    return (*table[:, :3].T.astype(np.int64), table[:, 3:], others)
