"""Whether COLMAP's binary files hold what they claim, before any program makes room for it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from struct import Struct

from ..errors import FileError, FormatError

__all__ = ["check_colmap_cameras", "check_colmap_files"]

_COUNT, _SHORT = Struct("<Q"), Struct("<I")
# Numbers of parameters of COLMAP's camera models, by their ids; of a newer one COLMAP itself says what is wrong.
_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}
_POSE = 7 * 8  # a quaternion and a translation


class _Cut(Exception):
    """The bytes end before what they claim."""


class _Unknown(Exception):
    """A camera of a model whose parameters nobody here can count."""


def _take(data: bytes, at: int, kind: Struct) -> int:
    if at + kind.size > len(data):
        raise _Cut
    return int(kind.unpack_from(data, at)[0])


def _after_camera(data: bytes, at: int) -> int:
    """Where the entry after this one begins."""
    model = _take(data, at + 4, _SHORT)
    if model not in _PARAMETERS:
        raise _Unknown
    return at + 24 + 8 * _PARAMETERS[model]


def _after_image(data: bytes, at: int) -> int:
    end_of_name = data.find(b"\0", at + 8 + _POSE)
    if end_of_name < 0:
        raise _Cut
    return end_of_name + 9 + 24 * _take(data, end_of_name + 1, _COUNT)


def _after_point(data: bytes, at: int) -> int:
    return at + 51 + 8 * _take(data, at + 43, _COUNT)


def _after_rig(data: bytes, at: int) -> int:
    sensors, at = _take(data, at + 4, _SHORT), at + 8
    for sensor in range(sensors):
        at += 8  # the first has no pose: the others' are by it
        if sensor:
            if at >= len(data):
                raise _Cut
            at += 1 + _POSE * (data[at] != 0)
    return at


def _after_frame(data: bytes, at: int) -> int:
    return at + 12 + _POSE + 16 * _take(data, at + 8 + _POSE, _SHORT)


_AFTER: dict[str, Callable[[bytes, int], int]] = {
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


def check_colmap_cameras(path: Path) -> None:
    """The same of a file of cameras alone, whatever its name."""
    _check(path, _after_camera)


def _check(path: Path, after: Callable[[bytes, int], int]) -> None:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror}") from error
    try:
        count, at = _take(data, 0, _COUNT), _COUNT.size
        for _ in range(count):
            if at >= len(data):
                raise _Cut
            at = after(data, at)
        if at > len(data):
            raise _Cut
    except _Unknown:
        return
    except _Cut:
        raise FormatError(f"{path} is cut short: it claims more than it holds; copy it again") from None
