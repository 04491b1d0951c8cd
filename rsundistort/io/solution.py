"""`solution.json`: writing, and reading with checks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FormatError, InputError
from ..model import Bend, Camera, RowMotion, Solution, SolvedImage
from .aside import write_aside
from .cameras import camera_from_json, camera_to_json
from .json_text import read_json

__all__ = ["FORMAT", "VERSION", "read_solution", "solution_to_bytes", "solution_to_json", "write_solution"]

FORMAT = "rsundistort-solution"
VERSION = 1
#: Of solutions with motions that are not steady: who reads the older one only would take them for steady ones.
BENT_VERSION = 2


def _plain(value: Any) -> Any:
    """The value with arrays as lists and NumPy scalars as numbers; NaN becomes null."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _bend_to_json(bend: Bend) -> dict[str, Any]:
    value = {"clock": bend.clock, "rotation": bend.rotation}
    return value | {"position": bend.position} if bend.moves else value


def _bend_from_json(entry: dict[str, Any]) -> Bend | None:
    value = entry.get("bend")
    if value is None:
        return None
    clock = np.asarray(value["clock"], float)
    if clock.ndim != 1 or len(clock) < 2 or not np.allclose(np.diff(clock), np.diff(clock).mean(), rtol=1e-6):
        raise InputError(f"the bend of photo {entry['name']} is not read at even steps of the clock")
    rotation = np.asarray(value["rotation"], float)
    if rotation.shape != (len(clock), 3):
        raise InputError(f"the bend of photo {entry['name']} has {len(clock)} readings and rotations {rotation.shape}")
    return Bend(float(clock[0]), float(clock[-1]), rotation, value.get("position"))


def solution_to_json(solution: Solution) -> dict[str, Any]:
    """The object of `solution.json`."""
    images = []
    for image in solution.images:
        entry: dict[str, Any] = {
            "name": image.name,
            "camera_id": image.camera_id,
            "registered": image.registered,
            "R_cw": image.R_cw,
            "center_w": image.center_w,
            "phi": None,
            "velocity": None,
            "aspect": None,
            "skew": None,
            "sigma_phi": image.sigma_phi,
            "num_observations": image.num_observations,
            "rms_px": image.rms_px,
            "rs_shift_px": image.rs_shift_px,
            "doubtful": image.doubtful,
            "lens_only": image.lens_only,
        }
        if image.motion is not None:
            entry["phi"], entry["velocity"] = image.motion.phi, image.motion.velocity
            entry["aspect"], entry["skew"] = image.motion.imaginary_camera(solution.cameras[image.camera_id].readout)
            if image.motion.bend is not None:
                entry["bend"] = _bend_to_json(image.motion.bend)
        if image.depth is not None:
            entry["depth"], entry["translation_shift_px"] = image.depth, image.translation_shift_px
        if image.reason is not None:
            entry["reason"] = image.reason
        if image.turned != 1:
            entry["turned"] = image.turned
        if image.roi is not None:
            entry["roi"] = image.roi
        images.append(entry)
    value = {
        "format": FORMAT,
        "version": BENT_VERSION if any("bend" in entry for entry in images) else VERSION,
        "generator": dict(solution.generator),
        "options": dict(solution.options),
        "cameras": {k: camera_to_json(c) for k, c in solution.cameras.items()},
        "rectified_cameras": {
            k: {"width": c.width, "height": c.height, "K": c.K} for k, c in solution.rectified_cameras.items()
        },
        "shutter_model": solution.shutter_model,
        "verdict": solution.verdict,
        "images": images,
        "critical_motion": solution.critical_motion,
        "quality": dict(solution.quality),
        "stages": list(solution.stages),
    }
    if solution.georeference is not None:
        value["georeference"] = dict(solution.georeference)
    result: dict[str, Any] = _plain(value)
    return result


def write_solution(path: Path, solution: Solution) -> None:
    """Write `solution.json`, whole or not at all."""
    write_aside(Path(path), solution_to_bytes(solution))


def solution_to_bytes(solution: Solution) -> bytes:
    """The content of `solution.json`."""
    return (json.dumps(solution_to_json(solution), indent=1) + "\n").encode()


def read_solution(path: Path, newer: bool = False) -> Solution:
    """Read a solution or a ground-truth file.

    Parameters
    ----------
    path : Path
        Of the file.
    newer : bool
        Read one of a newer version as if it were of this, as far as that goes.

    Raises
    ------
    FileError, FormatError
        When the file is missing, no solution, of another version, or inconsistent.
    """
    path = Path(path)
    value = read_json(path)
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise FormatError(f"{path} is no solution: its format is not {FORMAT!r}")
    version = value.get("version")
    known = (VERSION, BENT_VERSION)
    if version not in known and not (newer and isinstance(version, int) and version > max(known)):
        raise FormatError(
            f"{path} has version {version!r} of the format, this program reads {VERSION} and {BENT_VERSION}; "
            "update rsundistort"
        )
    try:
        return _solution_from_json(value, str(path))
    except InputError as error:
        raise FormatError(f"{path}: {error}") from error
    except KeyError as error:
        raise FormatError(f"{path} lacks {error}") from error
    except (TypeError, AttributeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path} is garbled: {error}") from error


def _orientation(entry: dict[str, Any]) -> int:
    turned = entry.get("turned", 1)
    if turned not in range(1, 9):
        raise InputError(f"photo {entry['name']} was turned by {turned!r}, expected an EXIF orientation, 1 to 8")
    return int(turned)


def _roi(entry: dict[str, Any]) -> tuple[int, int, int, int] | None:
    roi = entry.get("roi")
    if roi is None:
        return None
    whole = isinstance(roi, list) and len(roi) == 4 and all(isinstance(v, int) and v >= 0 for v in roi)
    if not whole or not (roi[2] and roi[3]):
        raise InputError(f"photo {entry['name']} has the roi {roi!r}, expected [x, y, width, height]")
    return roi[0], roi[1], roi[2], roi[3]


def _verdict(value: dict[str, Any]) -> dict[str, Any] | None:
    said = value.get("verdict")
    if said is None:
        return None
    words = [said.get("shutter"), said.get("shape"), *said.get("reasons", ())]
    if not all(isinstance(word, str) for word in words):
        raise InputError(f"the verdict is {said!r}, expected shutter, shape and reasons in words")
    return {"shutter": words[0], "shape": words[1], "reasons": words[2:]}


def _georeference(value: dict[str, Any]) -> dict[str, Any] | None:
    said = value.get("georeference")
    if said is None:
        return None
    matrix = np.asarray(said["transformation"], float)
    if not isinstance(said["crs"], str) or matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError("the georeference has no crs, or its transformation is no 4 x 4 matrix")
    return dict(said)


def _solution_from_json(value: dict[str, Any], where: str) -> Solution:
    cameras = {k: camera_from_json(c, f"camera {k}") for k, c in value["cameras"].items()}
    rectified = {k: Camera(c["width"], c["height"], c["K"]) for k, c in value["rectified_cameras"].items()}
    images = []
    for entry in value["images"]:
        if entry["camera_id"] not in rectified:
            raise InputError(f"photo {entry['name']} has camera {entry['camera_id']!r}, which is not rectified")
        motion = None
        if entry["registered"] and entry.get("phi") is not None:
            velocity = np.asarray(entry.get("velocity") or [0, 0, 0], float)
            motion = RowMotion(np.asarray(entry["phi"], float), velocity, _bend_from_json(entry))
        images.append(
            SolvedImage(
                name=entry["name"],
                camera_id=entry["camera_id"],
                R_cw=entry.get("R_cw"),
                center_w=entry.get("center_w"),
                motion=motion,
                sigma_phi=None if entry.get("sigma_phi") is None else np.asarray(entry["sigma_phi"], float),
                num_observations=entry.get("num_observations") or 0,
                rms_px=entry.get("rms_px"),
                rs_shift_px=entry.get("rs_shift_px"),
                depth=entry.get("depth"),
                translation_shift_px=entry.get("translation_shift_px"),
                reason=entry.get("reason"),
                turned=_orientation(entry),
                roi=_roi(entry),
                doubtful=None if entry.get("doubtful") is None else str(entry["doubtful"]),
                lens_only=bool(entry.get("lens_only")),
            )
        )
    return Solution(
        shutter_model=value["shutter_model"],
        cameras=cameras,
        rectified_cameras=rectified,
        images=tuple(images),
        critical_motion=value.get("critical_motion"),
        quality=value.get("quality") or {},
        stages=value.get("stages") or (),
        options=value.get("options") or {},
        generator=value.get("generator") or {},
        verdict=_verdict(value),
        georeference=_georeference(value),
    )
