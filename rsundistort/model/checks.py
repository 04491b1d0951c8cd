"""Checks of arguments: each returns the array it was given, as float64 of the shape asked for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from numbers import Real
from pathlib import PurePath
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .array_types import Array, Index

__all__ = [
    "check_annotated",
    "check_array",
    "check_fields",
    "check_finite",
    "check_index",
    "check_kind",
    "check_number",
    "check_numbers",
    "check_one_of",
    "check_photo_name",
    "check_rotation",
    "check_rotations",
    "check_size",
    "check_whole",
    "frozen",
]


def _shape_text(shape: tuple[int | None, ...]) -> str:
    names = iter("NMKL")
    parts = [next(names) if s is None else str(s) for s in shape]
    return "(" + ", ".join(parts) + ("," if len(parts) == 1 else "") + ")"


def check_array(value: ArrayLike, shape: tuple[int | None, ...], name: str, dtype: Any = np.float64) -> NDArray[Any]:
    """The value as an array of `shape` (None: any length); else an error with expected and got."""
    array = check_numbers(value, name, f" of shape {_shape_text(shape)}", dtype)
    if array.ndim != len(shape) or any(s is not None and s != n for s, n in zip(shape, array.shape, strict=True)):
        raise InputError(f"{name}.shape={array.shape}, expected {_shape_text(shape)}")
    return array


def check_numbers(value: ArrayLike, name: str, what: str = "", dtype: Any = np.float64) -> NDArray[Any]:
    """The value as an array of any shape; `what` is said of the numbers that were expected."""
    try:
        given = np.asarray(value)
        # texts, None and complex numbers would be taken for others; of nothing NumPy knows no type
        if given.dtype.kind not in "biuf" and given.size and not _are_numbers(given):
            raise TypeError
        with np.errstate(invalid="ignore"):  # NaN as a whole number
            return np.asarray(value, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: expected numbers{what}, got {_short(value)}") from error


def _are_numbers(array: NDArray[Any]) -> bool:
    """Whether Python's own numbers, too large or too exact for NumPy's, are in an array of objects."""
    return array.dtype.kind == "O" and all(isinstance(each, Real) for each in array.flat)


def _short(value: Any) -> str:
    """A value for an error: of an array what it is, not what it holds."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    text = repr(value) if not isinstance(value, (list, tuple)) or len(value) < 50 else f"{len(value)} of them"
    return text if len(text) < 100 else f"{text[:97]}..."


def check_finite(value: ArrayLike, shape: tuple[int | None, ...], name: str) -> Array:
    """The value as a float64 array of `shape` without NaN and infinity."""
    array = check_array(value, shape, name)
    if not np.isfinite(array).all():
        raise InputError(f"{name} holds NaN or infinity")
    return array


def _is_number(value: Any) -> bool:
    """Whether a value is a single number, and one that a float can hold."""
    if isinstance(value, (int, np.integer)):
        return not isinstance(value, bool) and abs(int(value)) < 10**300
    return isinstance(value, (float, np.floating))


def check_number(value: Any, name: str, low: float = -np.inf, high: float = np.inf) -> float:
    """A finite number between two, which belong to it."""
    if not _is_number(value) or not np.isfinite(float(value)) or not low <= value <= high:
        span = "a number" if np.isinf([low, high]).all() else f"a number from {low:g} to {high:g}"
        raise InputError(f"{name}={_short(value)}, expected {span}")
    return float(value)


def check_whole(value: Any, name: str, low: int, high: int = 2**31 - 1) -> int:
    """A whole number between two, which belong to it."""
    if not _is_number(value) or not low <= value <= high or int(value) != value:
        most = "" if high == 2**31 - 1 else f" and at most {high}"
        least = "a positive whole number" if low == 1 else f"a whole number, at least {low}"
        raise InputError(f"{name}={_short(value)}, expected {least}{most}")
    return int(value)


def check_size(value: Any, name: str = "size", least: int = 1) -> tuple[int, int]:
    """A (width, height) in pixels."""
    several = isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim == 1)
    if not several or len(value) != 2:
        raise InputError(f"{name}={_short(value)}, expected (width, height)")
    return check_whole(value[0], f"{name}[0]", least), check_whole(value[1], f"{name}[1]", least)


def check_kind(value: Any, kind: type, name: str) -> None:
    """Refuse what is not of a class of ours."""
    if not isinstance(value, kind):
        raise InputError(f"{name}: expected a {kind.__name__}, got {_short(value)}")


def check_fields(value: Any) -> None:
    """Refuse fields of a dataclass that are of other types than their annotations say; arrays are left to others."""
    kind: Any = type(value)
    for name, hint in _hints(kind).items():
        check_annotated(getattr(value, name), hint, name)


def check_annotated(value: Any, hint: Any, name: str) -> None:
    """Refuse a value that is of another type than an annotation says."""
    if not _fits(value, hint):
        raise InputError(f"{name}={_short(value)}, expected {_spelled(hint)}")


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {each.name: hints[each.name] for each in fields(kind)}


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of an annotated type, as far as its content shows that."""
    kind, inside = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return any(_fits(value, each) for each in inside)
    if kind is Any or kind is np.ndarray:
        return True
    if kind in (int, float):
        return _is_number(value) and (kind is float or isinstance(value, (int, np.integer)))
    if kind is bool:
        return isinstance(value, (bool, np.bool_))
    if kind in (tuple, Sequence):
        if not isinstance(value, (list, tuple, np.ndarray, Sequence)) or isinstance(value, (str, bytes)):
            return False
        if kind is tuple and inside[-1] is not ...:
            return len(value) == len(inside) and all(map(_fits, value, inside))
        return (not isinstance(value, np.ndarray) or value.ndim > 0) and all(_fits(each, inside[0]) for each in value)
    if kind is Mapping:
        return isinstance(value, Mapping) and all(_fits(key, inside[0]) for key in value)
    return not isinstance(kind, type) or _is_protocol(kind) or isinstance(value, kind)


def _is_protocol(kind: type) -> bool:
    """Whether a type says what can be done with a value, as those of arrays do, which others check."""
    return getattr(kind, "_is_protocol", False) or not kind.__module__.startswith(
        ("rsundistort", "builtins", "pathlib")
    )


def _spelled(hint: Any) -> str:
    """An annotation as people write it."""
    if get_origin(hint) in (Union, UnionType):
        return " or ".join(_spelled(each) for each in get_args(hint))
    return "None" if hint is type(None) else getattr(hint, "__name__", str(hint))


def check_one_of(value: Any, words: Iterable[str], name: str) -> None:
    """Refuse what is none of some words."""
    if not isinstance(value, str) or value not in words:
        raise InputError(f"{name}={_short(value)}, expected one of {', '.join(words)}")


def check_index(value: ArrayLike, length: int, upper: int, name: str) -> Index:
    """Indices of shape (length,) in [0, upper)."""
    array = check_array(value, (length,), name, np.int64)
    if not np.array_equal(array, np.asarray(value)):
        raise InputError(f"{name} holds numbers that are not whole")
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
    if not isinstance(value, str) or path.anchor or ".." in path.parts or path.as_posix() != value or not path.name:
        raise InputError(f"a photo is called {value!r}; expected a name inside the folder of photos")
    return str(value)


def check_rotations(value: ArrayLike, length: int, name: str) -> Array:
    """Rotation matrices of shape (length, 3, 3), orthonormal to 1e-6 and of determinant +1."""
    array = check_finite(value, (length, 3, 3), name)
    if length:
        off = np.abs(array @ array.transpose(0, 2, 1) - np.eye(3)).max()
        if off > 1e-6:
            raise InputError(f"{name} holds a matrix that is no rotation (off by {off:.2g})")
        if (np.linalg.det(array) < 0).any():
            raise InputError(f"{name} holds a matrix that mirrors (determinant -1); a rotation has +1")
    return array


def check_rotation(value: ArrayLike, name: str) -> Array:
    """One rotation matrix (3, 3)."""
    return np.asarray(check_rotations(check_finite(value, (3, 3), name)[None], 1, name)[0])


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only copy, for the fields of frozen dataclasses."""
    copy = np.array(array, order="C")
    copy.flags.writeable = False
    return copy
