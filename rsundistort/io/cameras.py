"""Cameras from files, from the command line and from EXIF."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FileError, FormatError, InputError
from ..model import Camera

__all__ = ["camera_from_exif", "camera_from_json", "camera_to_json", "check_camera_fits", "parse_camera"]

_REQUIRED = {"width", "height", "K"}
_KNOWN = _REQUIRED | {"dist", "readout", "lens"}


def camera_from_json(value: Any, where: str) -> Camera:
    """A camera of a parsed `camera.json`; `where` names it in errors."""
    if not isinstance(value, dict):
        raise FormatError(f"{where}: expected an object with width, height, K, dist, readout, lens")
    missing, unknown = _REQUIRED - value.keys(), value.keys() - _KNOWN
    if missing or unknown:
        what = f"lacks {', '.join(sorted(missing))}" if missing else f"has unknown {', '.join(sorted(unknown))}"
        raise FormatError(f"{where} {what}; expected width, height, K, dist, readout, lens")
    try:
        return Camera(
            value["width"],
            value["height"],
            value["K"],
            np.asarray(value.get("dist") or [], float),
            value.get("readout", "top-to-bottom"),
            value.get("lens", "pinhole"),
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{where}: {error}") from error


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """The object of `camera.json`; the lens model is named when it is not the pinhole one."""
    value: dict[str, Any] = {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "dist": camera.dist.tolist(),
        "readout": camera.readout,
    }
    if camera.lens != "pinhole":
        value["lens"] = camera.lens
    return value


def parse_camera(text: str, width: int, height: int, readout: str | None = None) -> Camera:
    """A camera from a file or from numbers.

    Parameters
    ----------
    text : str
        Path of a `camera.json`, path of a text file with the 3x3 matrix K, or "fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]".
    width, height : int
        Size of the photos; a file of another size is refused, with what both are.
    readout : str, optional
        Readout direction; overrides a file's.
    """
    path = Path(text)
    if "," in text and not _is_file(path):
        camera = _camera_from_numbers(text, width, height)
    else:
        camera = _camera_from_file(path, width, height)
    check_camera_fits(camera, width, height, text)
    if readout is not None and readout != camera.readout:
        camera = replace(camera, readout=readout)
    return camera


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a text too long to be a name
        return False


def check_camera_fits(camera: Camera, width: int, height: int, where: str) -> None:
    """Refuse a camera of another size than the photos, or whose principal point lies outside them."""
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"{where} is for {camera.width}x{camera.height} pixels but the photos have {width}x{height}; "
            "give the camera of these photos, or scale its K"
        )
    cx, cy = camera.K[0, 2], camera.K[1, 2]
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise InputError(
            f"{where} has its principal point at ({cx:g}, {cy:g}), outside the photos' {width}x{height} pixels"
        )


def _camera_from_numbers(text: str, width: int, height: int) -> Camera:
    try:
        values = [float(v) for v in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (4, 8, 9):
        shown = text if len(text) <= 60 else f"{text[:57]}..."
        raise InputError(f"camera {shown!r} is no file; expected a file or fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]")
    fx, fy, cx, cy = values[:4]
    return Camera(width, height, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(values[4:]))


def _camera_from_file(path: Path, width: int, height: int) -> Camera:
    try:
        content = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise FileError(f"camera file {path} cannot be read: {reason}") from error
    if content.lstrip().startswith("{"):
        try:
            value = json.loads(content)
        except json.JSONDecodeError as error:
            raise FormatError(f"{path} is no valid JSON: {error}") from error
        return camera_from_json(value, str(path))
    try:
        K = np.array([float(v) for v in content.replace(",", " ").split()]).reshape(3, 3)
    except ValueError:
        raise FormatError(f"{path} is neither a camera.json nor the nine numbers of K") from None
    try:
        return Camera(width, height, K / K[2, 2] if K[2, 2] else K)
    except InputError as error:
        raise FormatError(f"{path}: {error}") from error


def camera_from_exif(path: Path, width: int, height: int, readout: str = "top-to-bottom") -> Camera | None:
    """A camera with the focal length of the photo's EXIF and the centre as principal point; None without one.

    pycolmap reads the 35-mm equivalent, or the focal length with its table of sensor widths.
    """
    import pycolmap

    pycolmap.logging.minloglevel = 3
    try:
        guess = pycolmap.infer_camera_from_image(path)
    except (RuntimeError, ValueError):
        return None
    if not guess.has_prior_focal_length:
        return None
    focal = guess.mean_focal_length() * max(width, height) / max(guess.width, guess.height)
    if not 0.2 * max(width, height) < focal < 20 * max(width, height):
        return None
    return Camera(
        width,
        height,
        np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]]),
        readout=readout,
    )
