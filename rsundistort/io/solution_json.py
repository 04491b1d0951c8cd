"""`solution.json`: writing, and reading with checks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FileError, FormatError, InputError, format_errors
from ..model import Bend, Camera, RowMotion, Solution, SolvedImage
from .aside import write_aside
from .cameras import camera_from_json, camera_to_json
from .json_text import plain, read_json
from .photos.images import LARGEST_SIDE, RAW_AS
from .rules import Between, Maybe, Numbers, OneOf, check, shown

__all__ = ["FORMAT", "VERSION", "read_solution", "solution_to_bytes", "solution_to_json", "write_solution"]

FORMAT = "rsundistort-solution"
VERSION = 1
#: Of solutions with motions that are not steady: who reads the older one only would take them for steady ones.
BENT_VERSION = 2


# Numbers that are NaN, or infinite, are written as null.
_NUMBER, _BY_NAME = Maybe(float), Maybe({str: Maybe(float)})
_AMOUNT = Maybe(Between(0.0, 1e300))
_SIDE, _PLACE = Between(1, LARGEST_SIDE), Between(0, LARGEST_SIDE)

_IMAGE = {
    "name": str,
    "camera_id": str,
    "registered": bool,
    "R_cw?": Maybe(Numbers(3, 3)),
    "center_w?": Maybe(Numbers(3)),
    "phi?": Maybe(Numbers(3)),
    "velocity?": Maybe(Numbers(3)),
    "bend?": Maybe({"clock": Numbers(None), "rotation": Numbers(None, 3), "position?": Maybe(Numbers(None, 3))}),
    **{f"sigma_{name}?": Maybe((_NUMBER, _NUMBER, _NUMBER)) for name in ("phi", "rotation", "center")},
    "num_observations?": Maybe(Between(0, 2**53)),
    "rms_px?": _AMOUNT,
    "rs_shift_px?": _AMOUNT,
    "depth?": Maybe(str),
    "translation_shift_px?": _AMOUNT,
    "reason?": Maybe(str),
    "turned?": Between(1, 8),
    "roi?": Maybe((_PLACE, _PLACE, _SIDE, _SIDE)),
    "doubtful?": Maybe(str),
    "lens_only?": Maybe(bool),
}
_CRITICAL_MOTION = {
    "singular_values?": Maybe([_NUMBER]),
    "null_vector?": Maybe([_NUMBER]),
    "y_axis_spread_deg?": _NUMBER,
    "sigma_log_k?": _NUMBER,
    "flagged?": Maybe(bool),
    "anchors?": Maybe({str: float}),
    **{f"{name}?": Maybe(str) for name in ("meaning", "remedy", "sentence")},
    **{f"{name}?": Maybe([str]) for name in ("warnings", "advice")},
}
_TIME = {"seconds": float, "sigma": float}
_READOUT_TIME = {
    **_TIME,
    "source": str,
    "of_frame?": float,
    "unbounded_seconds?": float,
    "unfollowed_px?": float,
    "share_that_fits?": float,
    "stands?": bool,
    "halves?": Maybe([_TIME]),
    "by_speed?": Maybe([_TIME]),
    "by_pictures?": Maybe(_TIME),
    "by_gyroscope?": Maybe(_TIME),
    "gyroscope?": Maybe({"axes": str, "offset_s": float, "offset_sigma_s": float, "correlation": float}),
    "stabilisation?": Maybe({"verdict?": Maybe(str), "reason?": Maybe(str)}),
}
_QUALITY = {
    **{f"{name}?": _NUMBER for name in ("num_points", "num_observations", "rms_px", "global_rms_px", "rs_poses_px")},
    **{f"{name}?": _NUMBER for name in ("focal_sigma", "centre_sigma_focal_lengths")},
    **{f"held_out_{name}?": _BY_NAME for name in ("rms_px", "error", "gain")},
    "held_out_kept?": Maybe([str]),
    "held_out_chosen?": Maybe(str),
    "shared_travel?": Maybe(bool),
    "sigma_intrinsics?": Maybe({str: _BY_NAME}),
    "lens_fields?": Maybe({str: _BY_NAME}),
    "readout_times?": Maybe({str: {"ms": float, "source": str}}),
    "readout_time?": Maybe(_READOUT_TIME),
}
_OF_MODEL = {"model?": Maybe(str), "rms_px?": _NUMBER, "iterations?": _NUMBER}
_STAGE = {
    "name?": str,
    "seconds?": _NUMBER,
    "models?": Maybe([_OF_MODEL]),
    "rungs?": Maybe([_OF_MODEL]),  # what earlier versions call them
}
#: What `solution.json` holds, as far as it is read; other names may be there.
_RULES = {
    "shutter_model": str,
    "cameras": {str: dict},
    "rectified_cameras": {str: {"width": _SIDE, "height": _SIDE, "K": Numbers(3, 3)}},
    "images": [_IMAGE],
    "verdict?": Maybe({"shutter": str, "shape": str, "reasons?": Maybe([str])}),
    "critical_motion?": Maybe(_CRITICAL_MOTION),
    "quality?": Maybe(_QUALITY),
    "stages?": Maybe([_STAGE]),
    "options?": Maybe({"raw_as?": Maybe(OneOf(*RAW_AS)), "shutter_model?": Maybe(str)}),
    "generator?": Maybe({str: Maybe(str)}),
    "georeference?": Maybe({"crs": str, "transformation": Numbers(4, 4)}),
}


def _bend_to_json(bend: Bend) -> dict[str, Any]:
    value = {"clock": bend.clock, "rotation": bend.rotation}
    return value | {"position": bend.position} if bend.moves else value


def _bend_from_json(entry: dict[str, Any]) -> Bend | None:
    value = entry.get("bend")
    if value is None:
        return None
    clock = np.asarray(value["clock"], float)
    if len(clock) < 2 or not np.allclose(np.diff(clock), np.diff(clock).mean(), rtol=1e-6):
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
            "sigma_rotation": image.sigma_rotation,
            "sigma_center": image.sigma_center,
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
        if image.applied_orientation != 1:
            entry["turned"] = image.applied_orientation
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
    result: dict[str, Any] = plain(value)
    return result


def write_solution(path: Path, solution: Solution) -> None:
    """Write `solution.json`, whole or not at all; a `FileError` if it cannot be written there."""
    path = Path(path)
    try:
        write_aside(path, solution_to_bytes(solution))
    except OSError as error:
        mend = "give a file in a folder that is there"
        raise FileError(f"{path} cannot be written ({error.strerror}); {mend}") from error


def solution_to_bytes(solution: Solution) -> bytes:
    """The content of `solution.json`."""
    value = solution_to_json(solution)
    try:
        check(value, _RULES)
    except FormatError as error:  # which nobody could read again
        raise InputError(f"the solution cannot be written: {error}") from error
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


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
    with format_errors(path):
        check(value, _RULES)
        return _solution_from_json(value)


def _solution_from_json(value: dict[str, Any]) -> Solution:
    cameras = {k: camera_from_json(c, f"cameras.{k}") for k, c in value["cameras"].items()}
    rectified = {k: Camera(c["width"], c["height"], c["K"]) for k, c in value["rectified_cameras"].items()}
    for k, entry in enumerate(value["images"]):
        if entry["camera_id"] not in rectified:
            raise InputError(f"images[{k}].camera_id: {shown(entry['camera_id'])} is not among rectified_cameras")
    said = value.get("verdict")
    return Solution(
        shutter_model=value["shutter_model"],
        cameras=cameras,
        rectified_cameras=rectified,
        images=tuple(_image_from_json(entry, f"images[{k}]") for k, entry in enumerate(value["images"])),
        critical_motion=value.get("critical_motion"),
        quality=value.get("quality") or {},
        stages=value.get("stages") or (),
        options=value.get("options") or {},
        generator=value.get("generator") or {},
        verdict=said and {**said, "reasons": said.get("reasons") or []},
        georeference=value.get("georeference"),
    )


# Fields of `SolvedImage` that are the same in the file.
_AS_THEY_ARE = (
    "name", "camera_id", "R_cw", "center_w", "rms_px", "rs_shift_px", "depth", "translation_shift_px", "reason",
    "doubtful",
)  # fmt: skip


def _image_from_json(entry: dict[str, Any], where: str) -> SolvedImage:
    motion = None
    with format_errors(where):
        if entry["registered"] and entry.get("phi") is not None:
            velocity = entry.get("velocity") or [0.0, 0.0, 0.0]
            motion = RowMotion(np.array(entry["phi"], float), np.array(velocity, float), _bend_from_json(entry))
        roi = entry.get("roi")
        same: dict[str, Any] = {name: entry.get(name) for name in _AS_THEY_ARE}
        for name in ("sigma_phi", "sigma_rotation", "sigma_center"):  # what is not known is NaN
            same[name] = None if entry.get(name) is None else np.array(entry[name], float)
        return SolvedImage(
            motion=motion,
            num_observations=entry.get("num_observations") or 0,
            applied_orientation=entry.get("turned", 1),
            roi=None if roi is None else (roi[0], roi[1], roi[2], roi[3]),
            lens_only=bool(entry.get("lens_only")),
            **same,
        )
