"""What a parsed file may hold: a table of rules for each format, and errors that name the place.

A rule is

- `float` (a finite number), `int`, `str`, `bool` or `dict`, none of which passes for another but a whole number for a
  number;
- `Numbers(3, 3)`: lists of finite numbers of a shape, `None` where any length goes;
- `Between(low, high)`, of the type of `low`, and `OneOf("a", "b")`;
- `Maybe(rule)`: that, or null;
- `[rule]`: a list; `(rule, rule)`: a list of so many; `{str: rule}`: an object, whatever its names;
- `{"name": rule, "other?": rule}`: an object; names with a question mark may be left out, and others may be there.

>>> check({"phi": ["x"]}, {"phi": Numbers(3)}, "images[3]")
Traceback (most recent call last):
rsundistort.errors.FormatError: images[3].phi: expected three numbers, got ['x']
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

from ..errors import FormatError

__all__ = ["Between", "Maybe", "Numbers", "OneOf", "check", "shown"]

_TYPES = {float: "a number", int: "a whole number", str: "a text", bool: "true or false", dict: "an object"}
_COUNTS = ("no", "one", "two", "three", "four", "five", "six")
# Beyond, whole numbers are no counts, and NumPy holds them no more.
_LARGEST = 2**53
_SHOWN = 60


class Numbers:
    """Lists of finite numbers of a shape; None: of any length."""

    def __init__(self, *shape: int | None) -> None:
        self.shape = shape

    def __str__(self) -> str:
        if len(self.shape) == 1:
            (count,) = self.shape
            return "numbers" if count is None else f"{_COUNTS[count] if count < len(_COUNTS) else count} numbers"
        return " x ".join("any" if n is None else str(n) for n in self.shape) + " numbers"

    def holds(self, value: Any, axis: int = 0) -> bool:
        """Whether the value is of this shape from an axis on."""
        length, *inner = self.shape[axis:]
        if type(value) is not list or (length is not None and len(value) != length):
            return False
        if not inner:
            return all(_is(each, float) for each in value)
        same = inner[0] is not None
        return all(self.holds(each, axis + 1) for each in value) and (same or len({len(each) for each in value}) < 2)


@dataclass(frozen=True)
class Between:
    """A number, whole if `low` is, that lies between two, which belong to it."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{_TYPES[type(self.low)]} from {self.low:g} to {self.high:g}"

    def allows(self, value: Any) -> bool:
        """Whether it is one."""
        return _is(value, type(self.low)) and self.low <= value <= self.high


class OneOf:
    """One of some texts."""

    def __init__(self, *words: str) -> None:
        self.words = words

    def __str__(self) -> str:
        return f"one of {', '.join(self.words)}"

    def allows(self, value: Any) -> bool:
        """Whether it is one."""
        return isinstance(value, str) and value in self.words


@dataclass(frozen=True)
class Maybe:
    """A value that follows a rule, or null."""

    rule: Any


def shown(value: Any) -> str:
    """A value for an error: as JSON has it, and short."""
    if isinstance(value, (list, dict)) and len(value) > _SHOWN:
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    try:
        text = repr(value) if isinstance(value, (str, list)) else json.dumps(value)
    except (ValueError, TypeError, RecursionError):  # a number of thousands of digits
        return f"a {type(value).__name__}"
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def _is(value: Any, kind: type) -> bool:
    """Whether a value is of a type, in the sense of JSON; numbers are finite."""
    its = type(value)
    if its is float:
        return kind is float and math.isfinite(value)
    if its is int:
        return (kind is int and -_LARGEST <= value <= _LARGEST) or (kind is float and abs(value) < 10**300)
    return its is kind


class _Wrong(Exception):
    """Error in a value, with its place, from within outwards."""

    def __init__(self, expected: str, value: Any, lacks: str = "") -> None:
        super().__init__(f"lacks {lacks}" if lacks else f"expected {expected}, got {shown(value)}")
        self.value = value
        self.place: list[str] = []


def check(value: Any, rule: Any, where: str = "") -> None:
    """Refuse a value that a rule does not allow; `where` is its place, empty of the whole file.

    Raises
    ------
    FormatError
        "images[3].phi: expected three numbers, got 'x'".
    """
    try:
        _check(value, rule)
    except _Wrong as wrong:
        place = (where + "".join(reversed(wrong.place))).removeprefix(".")
        raise FormatError(f"{place}{': ' if place else ''}{wrong}") from None


def _check(value: Any, rule: Any) -> None:
    kind = type(rule)
    if kind is type or rule is Any:
        if rule is not Any and not _is(value, rule):
            raise _Wrong(_TYPES[rule], value)
    elif kind is dict:
        _check_object(value, rule)
    elif kind is list or kind is tuple:
        if type(value) is not list or (kind is tuple and len(value) != len(rule)):
            raise _Wrong("a list" if kind is list else f"a list of {len(rule)}", value)
        k = -1
        try:
            for k, each in enumerate(value):
                _check(each, rule[0] if kind is list else rule[k])
        except _Wrong as wrong:
            wrong.place.append(f"[{k}]")
            raise
    elif kind is Maybe:
        if value is not None:
            _check(value, rule.rule)
    elif kind is Numbers:
        if not rule.holds(value):
            raise _Wrong(str(rule), value)
    elif not rule.allows(value):
        raise _Wrong(str(rule), value)


def _check_object(value: Any, rule: dict[Any, Any]) -> None:
    if type(value) is not dict:
        raise _Wrong("an object", value)
    place = ""
    try:
        for name, of_name in rule.items() if str not in rule else zip(value, [rule[str]] * len(value), strict=True):
            place = name if name in value else name.removesuffix("?")
            if place in value:
                _check(value[place], of_name)
            elif place == name:
                raise _Wrong("", value, lacks=name)
    except _Wrong as wrong:
        if wrong.value is not value:
            wrong.place.append(f".{place}")
        raise
