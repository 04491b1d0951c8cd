"""Cameras in the calibration files of OpenCV, ROS and Kalibr.

All are trees of named values; the names differ a little from program to program, the meaning does not. YAML is read by
PyYAML and XML by the standard library, not by `cv2.FileStorage`: that refuses what ROS writes (lists in block style,
empty names, Windows line ends), and a file with deep nesting ends the process.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import format_errors
from ..model import Camera
from ..model.array_types import Array
from .xml_text import parse_xml as parse_elements

__all__ = ["camera_from_calibration", "has_size", "is_calibration", "kalibr_cameras", "parse_xml", "parse_yaml"]

# names without case, underscores, hyphens and blanks; the first are what OpenCV's and ROS's own programs write
_MATRIX = ("cameramatrix", "k", "intrinsicmatrix", "mtx")
_DISTORTION = ("distortioncoefficients", "distcoeffs", "d", "dist", "distortion", "distortioncoeffs", "distcoeff")
_WIDTH = ("imagewidth", "width")
_HEIGHT = ("imageheight", "height")
_SIZE = ("imagesize", "size", "resolution")

# the names of lens models
_PINHOLE = {"", "none", "pinhole", "plumbbob", "radtan", "rationalpolynomial", "thinprism", "opencv"}
_FISHEYE = {"fisheye", "equidistant", "opencvfisheye", "kannalabrandt", "kannalabrandt4", "kannalabrandt8"}


def parse_yaml(text: str) -> Any:
    """The first document of a YAML text, every scalar as a string.

    Raises
    ------
    ValueError
        When it is no YAML.
    """
    import yaml

    # OpenCV 4 writes %YAML:1.0, which YAML's own directive is not
    text = re.sub(r"\A\s*%YAML:[^\n]*\n", "", text)
    try:
        # in Python, not in C, which overflows the stack where this raises; the first document only, since
        # `ros2 topic echo` ends each message with ---
        found = next(iter(yaml.load_all(text, yaml.BaseLoader)), None)
    except yaml.MarkedYAMLError as error:
        line = f" in line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ValueError(f"{error.problem}{line}") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise ValueError(" ".join(str(error).split())) from error
    _check_size(found, len(text))
    return found


def _check_size(tree: Any, length: int) -> None:
    """Refuse aliases of aliases, which say more than the text is long."""
    count, open_ = 0, [tree]
    while open_:
        each = open_.pop()
        count += 1
        if count > length + 1:
            raise ValueError("its aliases repeat each other; write out what they stand for")
        if isinstance(each, dict):
            open_ += each.values()
        elif isinstance(each, list):
            open_ += each


def parse_xml(text: str) -> Any:
    """The tree of an XML text, as `parse_yaml` gives it; a list of numbers is one string.

    Raises
    ------
    ValueError
        When it is no XML, or declares a document type.
    """

    def value(element: Any) -> Any:
        return {child.tag: value(child) for child in element} if len(element) else (element.text or "").strip()

    return value(parse_elements(text))


def kalibr_cameras(tree: Any) -> dict[str, Mapping[str, Any]]:
    """The calibrations in a camera chain of Kalibr, by name (cam0, cam1, ...); empty if it is none."""
    if not isinstance(tree, Mapping) or not tree or not all(re.fullmatch(r"cam\d+", str(name)) for name in tree):
        return {}
    return {} if not all(_has_intrinsics(each) for each in tree.values()) else {str(k): v for k, v in tree.items()}


def _has_intrinsics(tree: Any) -> bool:
    return isinstance(tree, Mapping) and "intrinsics" in _fields(tree)


def is_calibration(tree: Any) -> bool:
    """Whether a tree holds a camera matrix under one of its usual names."""
    return isinstance(tree, Mapping) and any(name in _fields(tree) for name in _MATRIX)


def camera_from_calibration(tree: Mapping[str, Any], where: str, width: int, height: int) -> Camera:
    """The camera of a calibration of OpenCV, of a ROS `camera_info`, or of one camera of Kalibr.

    Parameters
    ----------
    tree : mapping
        With a camera matrix, distortion coefficients in OpenCV's order, width and height; `distortion_model` (or
        `camera_model`, or OpenCV's flag `fisheye_model`) says whether the lens is a fisheye. The binning and the region
        of interest of ROS (REP 104: given in pixels of the full sensor) are applied.
    where : str
        Names the file in errors.
    width, height : int
        Size of the photos, for a file that holds none.

    Returns
    -------
    Camera
        In pixels with integer centres, as all write them.
    """
    fields = _fields(tree)
    with format_errors(where, (TypeError, ValueError, OverflowError)):
        matrix = _matrix(fields)
        width, height = _size(fields, width, height)
        width, height, K = _read_out(fields, width, height, matrix.reshape(3, 3))
        dist, lens = _distortion(fields)
        return Camera(width, height, K, dist, lens=lens)


def _matrix(fields: Mapping[str, Any]) -> Array:
    """The nine numbers of K."""
    if not any(name in fields for name in _MATRIX):
        four = _numbers(fields.get("intrinsics"))
        if len(four) != 4:
            raise ValueError(f"its intrinsics are {len(four)} numbers, expected fx, fy, cx, cy of a pinhole camera")
        fx, fy, cx, cy = four
        return np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    matrix = _numbers(_first(fields, _MATRIX))
    if len(matrix) != 9:
        raise ValueError(f"its camera matrix has {len(matrix)} numbers, expected 9")
    return matrix


def has_size(tree: Mapping[str, Any]) -> bool:
    """Whether a calibration that can be read holds the size of its photos."""
    fields = _fields(tree)
    roi = _fields(fields["roi"]) if isinstance(fields.get("roi"), Mapping) else {}
    stated = any(len(_numbers(_first(fields, names))) for names in (_WIDTH, _HEIGHT, _SIZE))
    return stated or _whole(roi, "width") > 0


def _fields(tree: Mapping[str, Any]) -> dict[str, Any]:
    return {_plain(key): value for key, value in tree.items()}


def _plain(name: Any) -> str:
    return re.sub(r"[\s_-]", "", str(name)).lower()


def _first(fields: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((fields[name] for name in names if name in fields), None)


def _numbers(value: Any) -> Array:
    """The numbers of a matrix, of lists, or of a text; none of nothing."""
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, str):
        value = value.split()
    return np.ravel(np.array([] if value is None else value, float))


def _whole(fields: Mapping[str, Any], name: str) -> int:
    """A whole number that may be missing, which is zero."""
    values = _numbers(fields.get(name))
    if not len(values):
        return 0
    if len(values) != 1 or values[0] != int(values[0]) or values[0] < 0:
        raise ValueError(f"{name} is {fields[name]}, expected a whole number")
    return int(values[0])


def _size(fields: Mapping[str, Any], width: int, height: int) -> tuple[int, int]:
    wide, high = _first(fields, _WIDTH), _first(fields, _HEIGHT)
    given = np.concatenate([_numbers(wide), _numbers(high)])
    if not len(given):
        given = _numbers(_first(fields, _SIZE))
    if not len(given):
        return width, height
    if len(given) != 2 or (given != np.round(given)).any() or (given < 1).any():
        raise ValueError(f"its image size is {given.tolist()}, expected a width and a height")
    return int(given[0]), int(given[1])


def _read_out(fields: Mapping[str, Any], width: int, height: int, K: Array) -> tuple[int, int, Array]:
    """Size and matrix of the pixels that a ROS driver hands out: the region of interest, then binned."""
    roi = _fields(fields["roi"]) if isinstance(fields.get("roi"), Mapping) else {}
    binning = np.maximum([_whole(fields, "binningx"), _whole(fields, "binningy")], 1)
    K = K.copy()
    K[:2, 2] -= _whole(roi, "xoffset"), _whole(roi, "yoffset")
    # a binned pixel has its centre where the mean of the centres of its pixels is
    K[:2] /= binning[:, None]
    K[:2, 2] += (1 / binning - 1) / 2
    size = (_whole(roi, "width") or width) // binning[0], (_whole(roi, "height") or height) // binning[1]
    return int(size[0]), int(size[1]), K


def _distortion(fields: Mapping[str, Any]) -> tuple[Array, str]:
    """Coefficients and lens model."""
    if not any(name in fields for name in _DISTORTION):
        for name in fields:  # a lens lost to a misspelling would be missed by nobody
            if name.startswith(("distc", "distort")) and name != "distortionmodel":
                raise ValueError(f"{name!r} is no name of distortion coefficients; say distortion_coefficients")
    dist = _numbers(_first(fields, _DISTORTION))
    flag = _plain(fields.get("fisheyemodel", "")) not in ("", "0", "false")
    models = [str(fields.get(name, "")) for name in ("distortionmodel", "cameramodel")]
    for model in models:
        if _plain(model) not in _PINHOLE | _FISHEYE:
            raise ValueError(f"lens model {model!r} is none of plumb_bob, rational_polynomial, equidistant (fisheye)")
    if flag or any(_plain(model) in _FISHEYE for model in models):
        return dist, "fisheye"
    if len(dist) == 14:  # the last two tilt the sensor
        if dist[12:].any():
            raise ValueError("the distortion of a tilted sensor (14 numbers) is not supported; calibrate without it")
        dist = dist[:12]
    return dist, "pinhole"
