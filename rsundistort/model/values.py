"""Equality of values that hold arrays: dataclasses compare these as if they were numbers, and fail."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

__all__ = ["ComparedByFields"]


class ComparedByFields:
    """Base of dataclasses (`eq=False`) that are equal if all their fields are, NaN to NaN."""

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(map(_equal, _held(self), _held(other)))

    def __hash__(self) -> int:
        return hash(tuple(map(_key, _held(self))))


def _held(value: Any) -> list[Any]:
    """What the fields of a dataclass hold."""
    return [getattr(value, each.name) for each in fields(value)]


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        one, other = np.asarray(one), np.asarray(other)
        return np.array_equal(one, other, equal_nan=one.dtype.kind == other.dtype.kind == "f")
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(_equal, one, other))
    return bool(one == other)


def _key(value: Any) -> Any:
    """Something with a hash, the same of equal values: -0.0 is 0.0, whatever the type."""
    if not isinstance(value, np.ndarray):
        return value
    return value.shape, (value.astype(np.float64) + 0.0).tobytes() if value.dtype.kind in "biuf" else None
