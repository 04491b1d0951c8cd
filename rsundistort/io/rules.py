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


@dataclass(frozen=True, init=False)
class Numbers:
    """Lists of finite numbers of a shape; None: of any length."""

    shape: tuple[int | None, ...]

    def __init__(self, *shape: int | None) -> None:
        object.__setattr__(self, "shape", shape)

    def __str__(self) -> str:
        if len(self.shape) == 1:
            (count,) = self.shape
            return "numbers" if count is None else f"{_COUNTS[count] if count < len(_COUNTS) else count} numbers"
        return " x ".join("any" if n is None else str(n) for n in self.shape) + " numbers"

    def holds(self, value: Any, axis: int = 0) -> bool:
        """Whether the value is of this shape from an axis on."""
        if axis == len(self.shape):
            return _is(value, float)
        length = self.shape[axis]
        return (
            isinstance(value, list)
            and (length is None or len(value) == length)
            and all(self.holds(each, axis + 1) for each in value)
            and (length is not None or axis + 1 == len(self.shape) or len({len(each) for each in value}) < 2)
        )


@dataclass(frozen=True)
class Between:
    """A number, whole if `low` is, that lies between two, which belong to it."""

    low: float
    high: float

    def __str__(self) -> str:
        return f"{_TYPES[type(self.low)]} from {self.low:g} to {self.high:g}"


@dataclass(frozen=True, init=False)
class OneOf:
    """One of some texts."""

    words: tuple[str, ...]

    def __init__(self, *words: str) -> None:
        object.__setattr__(self, "words", words)

    def __str__(self) -> str:
        return f"one of {', '.join(self.words)}"


@dataclass(frozen=True)
class Maybe:
    """What a rule says, or null."""

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
    if kind is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        return isinstance(value, float) and math.isfinite(value) or isinstance(value, int) and abs(value) < 10**300
    if kind is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST
    return kind is not float and isinstance(value, kind)


def check(value: Any, rule: Any, where: str = "") -> None:
    """Refuse a value that a rule does not allow; `where` is its place, empty of the whole file.

    Raises
    ------
    FormatError
        "images[3].phi: expected three numbers, got 'x'".
    """
    if isinstance(rule, Maybe):
        if value is not None:
            check(value, rule.rule, where)
    elif isinstance(rule, dict):
        _check_object(value, rule, where)
    elif isinstance(rule, (list, tuple)):
        _expect(isinstance(value, list), "a list", value, where)
        if isinstance(rule, tuple):
            _expect(len(value) == len(rule), f"a list of {len(rule)}", value, where)
        for k, each in enumerate(value):
            check(each, rule[k] if isinstance(rule, tuple) else rule[0], f"{where}[{k}]")
    elif isinstance(rule, Numbers):
        _expect(rule.holds(value), str(rule), value, where)
    elif isinstance(rule, Between):
        _expect(_is(value, type(rule.low)) and rule.low <= value <= rule.high, str(rule), value, where)
    elif isinstance(rule, OneOf):
        _expect(isinstance(value, str) and value in rule.words, str(rule), value, where)
    elif rule is not Any:
        _expect(_is(value, rule), _TYPES[rule], value, where)


def _check_object(value: Any, rule: dict[Any, Any], where: str) -> None:
    _expect(isinstance(value, dict), "an object", value, where)
    if str in rule:
        for name, each in value.items():
            check(each, rule[str], _below(where, name))
        return
    for name, of_name in rule.items():
        bare = name.removesuffix("?")
        if bare in value:
            check(value[bare], of_name, _below(where, bare))
        elif bare == name:
            raise FormatError(f"{where}: lacks {name}" if where else f"lacks {name}")


def _below(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _expect(fits: bool, what: str, value: Any, where: str) -> None:
    if not fits:
        raise FormatError(f"{where}{': ' if where else ''}expected {what}, got {shown(value)}")
