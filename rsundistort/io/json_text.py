"""JSON as people hand it in: whatever is wrong with it is one error with one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FormatError, file_errors

__all__ = ["parse_json", "plain", "read_json"]

# Brackets within brackets: our own files have seven.
_DEEPEST = 100


def parse_json(text: str, pairs: Callable[[list[tuple[str, Any]]], Any] | None = None) -> Any:
    """Value of a JSON text; if it is none, a ValueError whose words are for people.

    Parameters
    ----------
    text : str
        Not nested deeper than a hundred brackets, without numbers of thousands of digits.
    pairs : callable, optional
        As `object_pairs_hook` of `json.loads`.
    """
    # so few are soon counted: journals have a text a line
    if text.count("[") + text.count("{") > _DEEPEST and _deepest(text) > _DEEPEST:
        raise ValueError("it is nested too deeply")
    try:
        return json.loads(text, object_pairs_hook=pairs)
    except json.JSONDecodeError:
        raise
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except ValueError as error:
        if "digits" in str(error):  # Python's limit, whose words are about Python
            raise ValueError("a number has too many digits") from error
        raise


def _deepest(text: str) -> int:
    """How many brackets stand within each other; those in names count, too, of which nobody's has a hundred."""
    marks = np.frombuffer(text.encode("utf-8", "surrogatepass"), np.uint8)
    step = np.zeros(len(marks), np.int8)
    for pair, way in (("[{", 1), ("]}", -1)):
        for mark in pair.encode():
            step[marks == mark] = way
    return int(np.cumsum(step[step != 0], dtype=np.int64).max(initial=0))


def read_json(path: Path | str) -> Any:
    """Value of a JSON file.

    Raises
    ------
    FileError, FormatError
        When it cannot be read; when it is no JSON, nested without end, or has numbers of thousands of digits.
    """
    try:
        with file_errors(path):
            text = Path(path).read_text(encoding="utf-8")
        return parse_json(text)
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is no valid JSON: it is no UTF-8 text") from error
    except ValueError as error:
        raise FormatError(f"{path} is no valid JSON: {error}") from error


def plain(value: Any) -> Any:
    """The value with arrays as lists and NumPy scalars as numbers; NaN and infinity, which JSON lacks, become null."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
