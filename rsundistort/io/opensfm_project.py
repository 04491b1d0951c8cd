"""An OpenSfM project of the rectified photos: `reconstruction.json`, `tracks.csv` and what its steps need beside them.

Coordinates have their origin in the middle of the photo and its longer side for unit; poses are `x_c = R X + t`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..colmap.rectified_model import rectified_keypoints
from ..errors import InputError
from ..model import Camera
from ..model.geodesy import enu_from_geodetic
from .export_scene import ExportScene
from .photos.exif_facts import ExifFacts, read_exif

__all__ = ["check_opensfm_names", "write_opensfm"]


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
    keys = {image.camera_id: _key(image.camera_id, scene.camera(image)) for image in images}
    cameras = {keys[image.camera_id]: _camera(scene.camera(image)) for image in images}
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


def _key(camera_id: str, camera: Camera) -> str:
    return f"v2 rsundistort rectified {camera_id} {camera.width} {camera.height} {_camera(camera)['projection_type']}"


def _camera(camera: Camera) -> dict[str, Any]:
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
