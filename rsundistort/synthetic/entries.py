"""Checks of the entries of a recipe: each error names the entry."""

from __future__ import annotations

import math
from typing import Any

from ..errors import FormatError

__all__ = ["count", "kind_of", "number", "take"]


def take(entry: Any, where: str, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    """The entry, which must be an object with these keys and no others."""
    if not isinstance(entry, dict):
        raise FormatError(f"{where}: expected an object, got {entry!r}")
    unknown, missing = sorted(set(entry) - set(required) - set(optional)), sorted(set(required) - set(entry))
    if unknown or missing:
        problem = [f"unknown key {key!r}" for key in unknown] + [f"missing key {key!r}" for key in missing]
        raise FormatError(f"{where}: {', '.join(problem)}")
    return entry


def kind_of(entry: Any, where: str, kinds: tuple[str, ...]) -> str:
    """The kind that an entry names, one of these."""
    kind = entry.get("kind") if isinstance(entry, dict) else None
    if kind not in kinds:
        raise FormatError(f"{where}: kind {kind!r}, expected one of {', '.join(kinds)}")
    return str(kind)


def number(value: Any, where: str) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise FormatError(f"{where}: {value!r}, expected a number")
    return float(value)


def count(value: Any, where: str, most: int = 100_000) -> int:
    """A whole number of at least 1, and no more than anybody would render."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise FormatError(f"{where}: {value!r}, expected a whole number of at least 1")
    if value > most:
        raise FormatError(f"{where}: {value}, expected no more than {most}")
    return value
