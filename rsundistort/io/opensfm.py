"""OpenSfM: `reconstruction.json` with `tracks.csv` beside it, read as a model, and projects of the rectified photos.

Its coordinates have their origin in the middle of the photo and its longer side for unit. Poses are `x_c = R X + t`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..colmap.cameras_and_poses import checked_name
from ..colmap.measured_model import ColmapModel
from ..colmap.rectified_model import rectified_keypoints
from ..errors import FormatError, InputError, file_errors
from ..model import Camera, Observations, Reconstruction
from ..model.geodesy import enu_from_geodetic
from .export_scene import ExportScene
from .photos.exif_facts import ExifFacts, read_exif
from .rules import Numbers, OneOf, check

__all__ = ["check_opensfm_names", "opensfm_model", "write_opensfm"]

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
    cameras = [_read_camera(found["cameras"][label], f"{path}: camera {label!r}") for label in labels]
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


def _read_camera(found: dict[str, Any], where: str) -> Camera:
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


def check_opensfm_names(names: list[str]) -> None:
    """Refuse photos that OpenSfM would take for one: it knows them by their names without folders."""
    seen: dict[str, str] = {}
    for name in names:
        other = seen.setdefault(PurePosixPath(name).name, name)
        if other != name:
            raise InputError(f"OpenSfM knows photos by their names alone, which {other} and {name} share; rename one")


def write_opensfm(folder: Path, scene: ExportScene) -> str:
    """Write the project; nothing is left over: the text is empty.

    Its `image_list.txt` leads to `OUT/images`; cameras are `perspective`, or `brown` without distortion where fx is not
    fy or the principal point is not in the middle. `exif/` keeps the GPS of the original photos.
    """
    (folder / "exif").mkdir(parents=True, exist_ok=True)
    images = scene.images
    check_opensfm_names([scene.names[image.name] for image in images])
    names = {image.name: PurePosixPath(scene.names[image.name]).name for image in images}
    of_id = {image.camera_id: _written_camera(scene.camera(image)) for image in images}
    keys = {key: _key(key, camera) for key, camera in of_id.items()}
    cameras = {keys[key]: camera for key, camera in of_id.items()}
    shots, reference = {}, _reference(scene.solution.georeference)
    for image in images:
        assert image.R_cw is not None
        assert image.center_w is not None
        facts = ExifFacts() if scene.source is None else read_exif(scene.source / image.name)
        exif = _exif(facts, scene.camera(image), keys[image.camera_id], cameras[keys[image.camera_id]])
        _write(folder / "exif" / f"{names[image.name]}.exif", exif)
        shots[names[image.name]] = {
            "rotation": Rotation.from_matrix(image.R_cw).as_rotvec().tolist(),
            "translation": (-image.R_cw @ image.center_w).tolist(),
            "camera": keys[image.camera_id],
            "orientation": 1,
            "capture_time": exif["capture_time"],
            **_on_the_map(exif["gps"], reference),
        }
    colors = scene.colors().astype(float).tolist()
    tracks, used = _tracks(scene, names)
    points = {
        str(k): {"color": colors[k], "coordinates": xyz}
        for k, xyz in enumerate(scene.reconstruction.points_w.tolist())
        if k in used
    }
    found: dict[str, Any] = {"cameras": cameras, "shots": shots, "points": points}
    if reference is not None:
        found["reference_lla"] = reference
        _write(folder / "reference_lla.json", reference)
    _write(folder / "reconstruction.json", [found])
    _write(folder / "camera_models.json", cameras)
    (folder / "tracks.csv").write_text(tracks, encoding="utf-8")
    lines = "".join(f"../images/{scene.names[image.name]}\n" for image in images)
    (folder / "image_list.txt").write_text(lines, encoding="utf-8")
    return ""


def _write(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1), encoding="utf-8")


def _key(camera_id: str, camera: dict[str, Any]) -> str:
    return f"v2 rsundistort rectified {camera_id} {camera['width']} {camera['height']} {camera['projection_type']}"


def _written_camera(camera: Camera) -> dict[str, Any]:
    K, width, height = camera.K, camera.width, camera.height
    side = max(width, height)
    fx, fy = float(K[0, 0] / side), float(K[1, 1] / side)
    cx, cy = float((K[0, 2] - (width - 1) / 2) / side), float((K[1, 2] - (height - 1) / 2) / side)
    size = {"width": width, "height": height}
    if fx == fy and cx == cy == 0.0:
        return {"projection_type": "perspective", **size, "focal": fx, "k1": 0.0, "k2": 0.0}
    lens = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}
    return {"projection_type": "brown", **size, "focal_x": fx, "focal_y": fy, "c_x": cx, "c_y": cy, **lens}


def _exif(facts: ExifFacts, camera: Camera, key: str, model: dict[str, Any]) -> dict[str, Any]:
    """What OpenSfM would read of the photo, without the lens and with the camera of the rectified one."""
    gps: dict[str, float] = {}
    if (fix := facts.fix) is not None and facts.place_deg is not None:
        # its `dop` is an accuracy in metres
        gps = {"latitude": fix.latitude_deg, "longitude": fix.longitude_deg, "dop": float(max(fix.sigma_m[:2]))}
        gps |= {} if fix.altitude_m is None else {"altitude": fix.altitude_m}
    return {
        "make": facts.make or "unknown",
        "model": facts.model or "unknown",
        "width": camera.width,
        "height": camera.height,
        "projection_type": model["projection_type"],
        "focal_ratio": float(camera.K[0, 0] / max(camera.width, camera.height)),
        "orientation": 1,
        "capture_time": facts.taken_s or 0.0,
        "gps": gps,
        "camera": key,
    }


def _reference(georeference: Mapping[str, Any] | None) -> dict[str, float] | None:
    """Where a frame of metres east, north and up has its origin, as OpenSfM writes it; None of other frames."""
    if georeference is None or georeference["crs"] != "local":
        return None
    return dict(zip(("latitude", "longitude", "altitude"), georeference["origin"], strict=True))


def _on_the_map(gps: Mapping[str, float], reference: Mapping[str, float] | None) -> dict[str, Any]:
    """GPS entry of a shot: its place in the frame where that is one of the map."""
    if not gps:
        return {"gps_dop": 0.0}
    if reference is None:
        return {"gps_dop": gps["dop"]}
    origin = reference["latitude"], reference["longitude"], reference["altitude"]
    place = np.array([[gps["latitude"], gps["longitude"], gps.get("altitude", origin[2])]])
    return {"gps_dop": gps["dop"], "gps_position": enu_from_geodetic(place, origin)[0].tolist()}


def _tracks(scene: ExportScene, names: dict[str, str]) -> tuple[str, set[int]]:
    """The text of `tracks.csv`, and the points in it: those that two photos show."""
    rec, colors, rectified = scene.reconstruction, scene.colors(), scene.rectified_cameras
    xy, obs = rectified_keypoints(rec, rectified), rec.observations
    written = np.array([name in names for name in rec.image_names])[obs.frame_idx] & np.isfinite(xy).all(1)
    seen_by = np.bincount(obs.point_idx[written], minlength=rec.num_points)
    keep = np.flatnonzero(written & (seen_by[obs.point_idx] >= 2))
    size = np.array([(rectified[k].width, rectified[k].height) for k in rec.camera_idx.tolist()], float)[obs.frame_idx]
    normal = (xy - (size - 1) / 2) / size.max(1, keepdims=True)
    lines = ["OPENSFM_TRACKS_VERSION_v2"]
    for feature, k in enumerate(keep.tolist()):
        point = int(obs.point_idx[k])
        color = "\t".join(map(str, colors[point].tolist()))
        x, y = normal[k].tolist()
        name = names[rec.image_names[int(obs.frame_idx[k])]]
        lines.append(f"{name}\t{point}\t{feature}\t{x!r}\t{y!r}\t0.004\t{color}\t-1\t-1")
    return "\n".join(lines) + "\n", set(obs.point_idx[keep].tolist())
