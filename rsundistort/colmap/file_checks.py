"""Whether COLMAP's binary files hold what they claim, before any program makes room for it."""

from __future__ import annotations

import mmap
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from struct import Struct
from typing import Any

from ..errors import FileError, FormatError, file_errors
from .conventions import import_pycolmap, quiet_pycolmap

__all__ = ["check_colmap_cameras", "check_colmap_files", "pycolmap_model"]

# models of large scenes have gigabytes of points
Bytes = mmap.mmap

_COUNT, _SHORT, _MODEL = Struct("<Q"), Struct("<I"), Struct("<i")
_POSE = 7 * 8  # a quaternion and a translation


class _Cut(Exception):
    """The bytes end before what they claim."""


def _take(data: Bytes, at: int, kind: Struct) -> int:
    if at + kind.size > len(data):
        raise _Cut
    return int(kind.unpack_from(data, at)[0])


@lru_cache
def _num_parameters(model: int) -> int:
    """Number of parameters of COLMAP's camera model of this number; 0 for one that COLMAP refuses itself."""
    pycolmap = import_pycolmap()

    try:
        camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    except Exception:  # pycolmap raises what its C++ raised
        return 0
    return len(camera.params)


def _after_camera(data: Bytes, at: int) -> int:
    """Where the entry after this one begins."""
    return at + 24 + 8 * _num_parameters(_take(data, at + 4, _MODEL))


def _after_image(data: Bytes, at: int) -> int:
    end_of_name = data.find(b"\0", at + 8 + _POSE)
    if end_of_name < 0:
        raise _Cut
    return end_of_name + 9 + 24 * _take(data, end_of_name + 1, _COUNT)


def _after_point(data: Bytes, at: int) -> int:
    return at + 51 + 8 * _take(data, at + 43, _COUNT)


def _after_rig(data: Bytes, at: int) -> int:
    sensors, at = _take(data, at + 4, _SHORT), at + 8
    for sensor in range(sensors):
        at += 8  # the first has no pose: the others' are by it
        if sensor:
            if at >= len(data):
                raise _Cut
            at += 1 + _POSE * (data[at] != 0)
    return at


def _after_frame(data: Bytes, at: int) -> int:
    return at + 12 + _POSE + 16 * _take(data, at + 8 + _POSE, _SHORT)


_AFTER: dict[str, Callable[[Bytes, int], int]] = {
    "cameras.bin": _after_camera,
    "images.bin": _after_image,
    "points3D.bin": _after_point,
    "rigs.bin": _after_rig,
    "frames.bin": _after_frame,
}


def check_colmap_files(folder: Path) -> None:
    """Refuse binary files of a model that are cut short, or that count more entries than their bytes can hold.

    pycolmap takes what was cut off for zeros, and makes room for whatever a file counts. Files that are not there, and
    texts, are passed over.

    Raises
    ------
    FileError, FormatError
        When one cannot be read; when one does not hold what it claims.
    """
    for name, after in _AFTER.items():
        path = folder / name
        if path.is_file():
            _check(path, after)


def pycolmap_model(folder: Path) -> Any:
    """The `pycolmap.Reconstruction` of a folder, whose files are checked first.

    Raises
    ------
    FileError, FormatError
        It cannot be read.
    """
    check_colmap_files(folder)
    try:
        model = quiet_pycolmap().Reconstruction(folder)
    except Exception as error:  # pycolmap raises what its C++ raised
        raise FileError(f"{folder} is no COLMAP model: {' '.join(str(error).split())}") from error
    if not (folder / "images.bin").is_file():
        _complete_names(model, folder / "images.txt")
    return model


def _complete_names(model: Any, path: Path) -> None:
    """Give photos of a model in text their names with spaces: COLMAP writes them, and reads up to the space."""
    lines = (line.strip() for line in path.read_text(encoding="utf-8", errors="replace").split("\n"))
    for line in lines:
        fields = line.split(" ", 9)
        if not line or line.startswith("#") or len(fields) < 10:
            continue
        next(lines, None)  # the measurements
        key, name = int(fields[0]), fields[9].strip()
        if " " in name and "\ufffd" not in name and model.images[key].name == name.split(" ")[0]:
            model.images[key].name = name


def check_colmap_cameras(path: Path) -> None:
    """Check a file of cameras alone, whatever its name."""
    _check(path, _after_camera)


def _check(path: Path, after: Callable[[Bytes, int], int]) -> None:
    try:
        with file_errors(path), path.open("rb") as file:
            if not path.stat().st_size:  # which cannot be mapped
                raise _Cut
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                _walk(data, after)
    except _Cut:
        raise FormatError(f"{path} is cut short: it claims more than it holds; copy it again") from None


def _walk(data: Bytes, after: Callable[[Bytes, int], int]) -> None:
    """Go from entry to entry, as many as the file counts."""
    count, at = _take(data, 0, _COUNT), _COUNT.size
    for _ in range(count):
        if at >= len(data):
            raise _Cut
        at = after(data, at)
    if at > len(data):
        raise _Cut
