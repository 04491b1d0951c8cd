"""Lengths that were measured in the scene: CSV files."""

from __future__ import annotations

from pathlib import Path

from ..errors import FormatError, format_errors
from ..model import KnownLength
from .tables import read_table

__all__ = ["read_known_lengths"]

_COLUMNS = ("photo1", "x1", "y1", "photo2", "x2", "y2", "length", "sigma")


def read_known_lengths(path: Path | str) -> list[KnownLength]:
    """Lengths between points of the scene, as `BundleOptions.lengths` takes them.

    Parameters
    ----------
    path : path
        CSV with the header `photo1, x1, y1, photo2, x2, y2, length, sigma`: where the two ends are seen (pixels of the
        stored photos, integer centres; `photo2` may be empty for the same photo), the length, in any unit, and its
        standard deviation. Two lines or more.

    Raises
    ------
    FileError, FormatError
        Not readable; missing columns, numbers that are none or not positive.
    """
    path = Path(path)
    columns, rows = read_table(path)
    if missing := [column for column in _COLUMNS if column not in columns]:
        raise FormatError(f"{path} has no column {missing[0]!r}; expected {', '.join(_COLUMNS)}")
    found = []
    for number, row in enumerate(rows, start=2):
        first = row["photo1"]
        second = row["photo2"] or first
        with format_errors(f"{path}, line {number}", ValueError):
            x1, y1, x2, y2, length, sigma = (float(row[c]) for c in ("x1", "y1", "x2", "y2", "length", "sigma"))
            found.append(KnownLength((first, x1, y1), (second, x2, y2), length, sigma))
    if len(found) < 2:
        raise FormatError(f"{path} holds {len(found)} lengths; ratios need two, such as a height and a width")
    return found
