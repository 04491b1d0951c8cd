"""Cameras from files and from the command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..colmap import read_colmap_cameras
from ..errors import FileError, FormatError, InputError, file_errors, format_errors
from ..model import Camera
from ..model.orientation import orient_camera
from .calibrations import camera_from_calibration, has_size, is_calibration, kalibr_cameras, parse_xml, parse_yaml
from .json_text import parse_json

__all__ = [
    "SIGMA_NAMES",
    "CameraFile",
    "camera_from_json",
    "camera_to_json",
    "check_camera_fits",
    "check_sigma",
    "read_camera_file",
]

#: Intrinsics whose standard deviations a file may state.
SIGMA_NAMES = ("f", "fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")

_REQUIRED = {"width", "height", "K"}
_KNOWN = _REQUIRED | {"dist", "readout", "lens", "field", "sigma"}


def camera_from_json(value: Any, where: str) -> Camera:
    """A camera of a parsed `camera.json`; `where` names it in errors."""
    if not isinstance(value, dict):
        raise FormatError(f"{where}: expected an object with width, height, K, dist, readout, lens, field, sigma")
    missing, unknown = _REQUIRED - value.keys(), value.keys() - _KNOWN
    if missing or unknown:
        what = f"lacks {', '.join(sorted(missing))}" if missing else f"has unknown {', '.join(sorted(unknown))}"
        raise FormatError(f"{where} {what}; expected width, height, K, dist, readout, lens, field, sigma")
    given = {key: each for key, each in value.items() if key != "sigma"}
    if objects := [key for key in ("K", "dist", "field") if isinstance(value.get(key), dict)]:
        raise FormatError(f"{where}: {objects[0]} is an object, expected a list of numbers")
    with format_errors(where, (TypeError, ValueError, OverflowError)):
        arrays = {key: np.asarray(value.get(key) or [], float) for key in ("dist", "field")}
        return Camera(**{**given, **arrays})


def sigma_from_json(value: Any, where: str) -> dict[str, float]:
    """Standard deviations by intrinsic, in pixels or of coefficients, of a parsed `camera.json`; {} without any."""
    sigma = value.get("sigma") or {}
    if not isinstance(sigma, dict):
        raise FormatError(f'{where}: sigma is {sigma!r}, expected an object such as {{"f": 1.5, "k1": 0.003}}')
    return check_sigma(sigma, where)


def check_sigma(sigma: Mapping[str, Any], where: str) -> dict[str, float]:
    """Standard deviations of intrinsics by name, refused where one is of no intrinsic or no positive number."""
    for name, each in sigma.items():
        if name not in SIGMA_NAMES:
            raise FormatError(f"{where}: sigma of {name!r}, expected some of {', '.join(SIGMA_NAMES)}")
        if isinstance(each, bool) or not isinstance(each, (int, float)) or not 0 < each < np.inf:
            raise FormatError(f"{where}: sigma of {name} is {each!r}, expected a positive number")
    if "f" in sigma and {"fx", "fy"} & sigma.keys():
        raise FormatError(f"{where}: sigma of f and of fx or fy; give one or the other")
    return {name: float(each) for name, each in sigma.items()}


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """The object of `camera.json`; lens model and field are named where they are not the pinhole's."""
    value: dict[str, Any] = {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "dist": camera.dist.tolist(),
        "readout": camera.readout,
    }
    if camera.lens != "pinhole":
        value["lens"] = camera.lens
    if camera.field.size:
        value["field"] = camera.field.tolist()
    return value


@dataclass(frozen=True)
class CameraFile:
    """Content of a file or a folder of cameras.

    Attributes
    ----------
    cameras : dict of id to Camera
        One under the id "camera"; of COLMAP and `cameras.json` under their ids; of a folder under the files' stems.
    camera_of_image : dict of photo name to id
        Where the file says which photo is whose, else empty.
    source : str
        The file and its kind, for people.
    readout_specified : set of id
        Cameras whose file says which way they are read out; of the others "top-to-bottom" is but a guess.
    sigma : dict of id to standard deviations
        Where the file says how well a camera is known: by intrinsic, in pixels or of the coefficients.
    without_size : set of id
        Cameras whose file does not say for what size they are: they have the one that the reader was called with.
    """

    cameras: Mapping[str, Camera]
    camera_of_image: Mapping[str, str] = field(default_factory=dict)
    source: str = ""
    readout_specified: frozenset[str] = frozenset()
    sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    without_size: frozenset[str] = frozenset()


_KINDS = (
    "camera.json, cameras.json, the nine numbers of K, a calibration of OpenCV (YAML, XML, JSON) or ROS (YAML), "
    "Kalibr's camchain.yaml, or COLMAP's cameras.txt or cameras.bin"
)
_ONLY = "camera"  # the id of one that has none
_SUFFIXES = (".json", ".txt", ".yaml", ".yml", ".xml", ".bin")


def read_camera_file(text: str | Path, width: int, height: int) -> CameraFile:
    """The cameras of a file, of a folder, or of numbers; whether they fit the photos is not checked.

    Parameters
    ----------
    text : str or Path
        A file (`camera.json`, `cameras.json`, the nine numbers of K, a calibration of OpenCV or ROS, COLMAP's
        `cameras.txt` or `cameras.bin`), recognised by its content; a folder with a COLMAP model, or with such files of
        one camera each; or "fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]".
    width, height : int
        Size of the photos, for formats that hold none.

    Raises
    ------
    FileError, FormatError, InputError
        When there is no such file, when it cannot be read, when two cameras have one name.
    """
    path = Path(text)
    if "," in str(text) and not _exists(path):
        camera = _camera_from_numbers(str(text), width, height)
        return CameraFile({_ONLY: camera}, source="numbers", without_size=frozenset({_ONLY}))
    if not (_exists(path) and path.is_dir()):
        return _read_file(path, width, height)
    if (path / "cameras.bin").is_file() or (path / "cameras.txt").is_file():
        return CameraFile(*read_colmap_cameras(path), source=f"{path} (COLMAP)")
    return _read_folder(path, width, height)


def check_camera_fits(camera: Camera, width: int, height: int, where: str) -> None:
    """Refuse a camera of another size than the photos, or whose principal point lies outside them."""
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"{where} is for {camera.width}x{camera.height} pixels but the photos have {width}x{height}; "
            + _how_to_fit(camera, width, height)
        )
    cx, cy = camera.K[0, 2], camera.K[1, 2]
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise InputError(
            f"{where} has its principal point at ({cx:g}, {cy:g}), outside the photos' {width}x{height} pixels"
        )


def _how_to_fit(camera: Camera, width: int, height: int) -> str:
    """What to do about a camera of another size."""
    if (camera.width, camera.height) == (height, width):
        stored = "portrait" if height > width else "landscape"
        ways = [orient_camera(camera, orientation) for orientation in (8, 6)]
        here = " or ".join(f"cx {each.K[0, 2]:g}, cy {each.K[1, 2]:g} and the readout {each.readout}" for each in ways)
        return (
            f"they are stored in {stored}, rotated since they were read out: give a camera with width and height, fx "
            f"and fy exchanged, and {here}, by the way that they were rotated"
        )
    factor = Fraction(width, camera.width)
    if factor == Fraction(height, camera.height):
        return (
            f"that is {factor} of its size: if they were scaled and not cut, multiply fx, fy, cx + 0.5 and cy + 0.5 "
            f"by {factor}"
        )
    return "give the camera of these photos"


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a text that is too long for a name, or holds a NUL
        return False


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


def _read_folder(folder: Path, width: int, height: int) -> CameraFile:
    """Cameras under the stems of their files."""
    with file_errors(folder):
        files = sorted(
            entry
            for entry in folder.iterdir()
            if entry.suffix.lower() in _SUFFIXES and not entry.name.startswith(".") and entry.is_file()
        )
    if not files:
        raise FileError(f"{folder} holds no camera files; expected {_KINDS}")
    found: dict[str, CameraFile] = {}
    for file in files:
        other = next(each for each in files if each.stem == file.stem)
        if other != file:
            raise InputError(f"{other} and {file.name} are two cameras with one name, {file.stem}; take one away")
        found[file.stem] = _read_file(file, width, height)
        if (count := len(found[file.stem].cameras)) != 1:
            raise InputError(f"{file} holds {count} cameras; in a folder each file holds one")
    cameras = {stem: next(iter(each.cameras.values())) for stem, each in found.items()}
    sigma = {stem: next(iter(each.sigma.values()), {}) for stem, each in found.items()}
    stated = frozenset(stem for stem, each in found.items() if each.readout_specified)
    source = f"{folder} ({len(cameras)} camera file{'s' * (len(cameras) > 1)})"
    without_size = frozenset(stem for stem, each in found.items() if each.without_size)
    return CameraFile(cameras, source=source, readout_specified=stated, sigma=sigma, without_size=without_size)


def _read_file(path: Path, width: int, height: int) -> CameraFile:
    if path.suffix.lower() == ".bin":
        return CameraFile(*read_colmap_cameras(path), source=f"{path} (COLMAP)")
    try:
        content = path.read_text(encoding="utf-8-sig").strip()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        mend = "check the path, or give the numbers fx,fy,cx,cy"
        raise FileError(f"camera file {path} cannot be read: {reason}; {mend}") from error
    if _is_colmap_text(content):
        return CameraFile(*read_colmap_cameras(path), source=f"{path} (COLMAP)")
    K = _nine_numbers(content)
    if K is not None:
        with format_errors(path):
            return CameraFile({_ONLY: Camera(width, height, K)}, source=f"{path} (K)", without_size=frozenset({_ONLY}))
    try:
        tree, kind = _parse(content)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{path} cannot be understood ({error}); expected {_KINDS}") from error
    if chain := kalibr_cameras(tree):
        cameras = {
            name: camera_from_calibration(each, f"{path}, {name}", width, height) for name, each in chain.items()
        }
        without = frozenset(name for name, each in chain.items() if not has_size(each))
        return CameraFile(cameras, source=f"{path} (Kalibr)", without_size=without)
    source = f"{path} ({kind})"
    if is_calibration(tree) and not (kind == "JSON" and "K" in tree):
        camera = camera_from_calibration(tree, str(path), width, height)
        return CameraFile({_ONLY: camera}, source=source, without_size=frozenset(() if has_size(tree) else {_ONLY}))
    if kind != "JSON":
        raise FormatError(f"{path} holds no camera; expected {_KINDS}")
    if "cameras" in tree:
        return _several_of_json(tree, path)
    stated = frozenset({_ONLY} if "readout" in tree else ())
    camera, sigma = camera_from_json(tree, str(path)), sigma_from_json(tree, str(path))
    return CameraFile({_ONLY: camera}, source=str(path), readout_specified=stated, sigma={_ONLY: sigma})


def _parse(content: str) -> tuple[Any, str]:
    """The tree of a text, and its format."""
    if content.startswith("{"):
        return parse_json(content, _unique), "JSON"
    if content.startswith("<"):
        return parse_xml(content), "OpenCV XML"
    return parse_yaml(content), "OpenCV YAML" if "opencv-matrix" in content else "ROS YAML"


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON, which may name a thing once."""
    value = dict(pairs)
    if len(value) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice!r} is there twice")
    return value


def _several_of_json(value: dict[str, Any], path: Path) -> CameraFile:
    """The cameras of a `cameras.json`."""
    cameras, images = value["cameras"], value.get("images", {})
    if not isinstance(cameras, dict) or not isinstance(images, dict) or value.keys() - {"cameras", "images"}:
        raise FormatError(f'{path}: expected {{"cameras": {{id: camera}}, "images": {{name: id}}}} and no more')
    if not cameras:
        raise FormatError(f"{path} holds no camera")
    for name, key in images.items():
        if not isinstance(key, str) or key not in cameras:
            raise FormatError(f"{path}: photo {name!r} has camera {key!r}, which is not among its cameras")
    found = {key: camera_from_json(each, f"{path}: camera {key}") for key, each in cameras.items()}
    sigma = {key: sigma_from_json(each, f"{path}: camera {key}") for key, each in cameras.items()}
    return CameraFile(found, images, str(path), frozenset(key for key in found if "readout" in cameras[key]), sigma)


def _is_colmap_text(content: str) -> bool:
    """Whether the first line of data is "CAMERA_ID MODEL ...", which no other format here begins with."""
    lines = (line.split() for line in content.splitlines() if line.strip() and not line.startswith("#"))
    words = next(lines, [])
    return len(words) > 4 and words[0].isdigit() and words[1].isidentifier()


def _nine_numbers(content: str) -> Any:
    """K, or None if the text is no nine numbers."""
    try:
        K = np.array([float(v) for v in content.replace(",", " ").split()]).reshape(3, 3)
    except ValueError:
        return None
    with np.errstate(all="ignore"):  # the camera refuses what is not finite
        return K / K[2, 2] if K[2, 2] else K
