"""Checks of arguments: each returns the array it was given, as float64 of the shape asked for."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

__all__ = ["check_array", "check_finite", "check_index", "check_photo_name", "check_rotations", "frozen"]


def _shape_text(shape: tuple[int | None, ...]) -> str:
    names = iter("NMKL")
    parts = [next(names) if s is None else str(s) for s in shape]
    return "(" + ", ".join(parts) + ("," if len(parts) == 1 else "") + ")"


def check_array(value: ArrayLike, shape: tuple[int | None, ...], name: str, dtype: Any = np.float64) -> NDArray[Any]:
    """The value as an array of `shape` (None: any length); else an error with expected and got."""
    try:
        array = np.asarray(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: expected numbers of shape {_shape_text(shape)}, got {value!r}") from error
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True)):
        raise InputError(f"{name}.shape={array.shape}, expected {_shape_text(shape)}")
    return array


def check_finite(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> NDArray[np.float64]:
    """The value as a float64 array of `shape` without NaN and infinity."""
    array = check_array(value, shape, name)
    if not np.isfinite(array).all():
        raise InputError(f"{name} holds NaN or infinity")
    return array


def check_index(value: ArrayLike, length: int, upper: int, name: str) -> NDArray[np.int64]:
    """Indices of shape (length,) in [0, upper)."""
    array = check_array(value, (length,), name, np.int64)
    if length and (array.min() < 0 or array.max() >= upper):
        raise InputError(f"{name} goes from {array.min()} to {array.max()}, expected 0 to {upper - 1}")
    return array


def check_photo_name(value: Any) -> str:
    """The name of a photo inside its folder, sub-folders with forward slashes; an error for one that leads elsewhere.

    Examples
    --------
    >>> check_photo_name("walk/0001.jpg")
    'walk/0001.jpg'
    """
    path = PurePath(value) if isinstance(value, str) and "\0" not in value else PurePath()
    if path.anchor or ".." in path.parts or path.as_posix() != value or not path.name:
        raise InputError(f"a photo is called {value!r}; expected a name inside the folder of photos")
    return str(value)


def check_rotations(value: ArrayLike, length: int, name: str) -> NDArray[np.float64]:
    """Rotation matrices of shape (length, 3, 3), orthonormal to 1e-6 and of determinant +1."""
    array = check_finite(value, (length, 3, 3), name)
    if length:
        off = np.abs(array @ array.transpose(0, 2, 1) - np.eye(3)).max()
        if off > 1e-6 or (np.linalg.det(array) < 0).any():
            raise InputError(f"{name} holds a matrix that is no rotation (off by {off:.2g})")
    return array


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only copy, for the fields of frozen dataclasses."""
    copy = np.array(array, order="C")
    copy.flags.writeable = False
    return copy
