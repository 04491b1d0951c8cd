"""What was measured in the scene: lengths, and control points and check points of a survey, in CSV files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from ..errors import FormatError, format_errors
from ..model import ControlPoint, KnownLength
from .tables import read_table

__all__ = ["read_control_points", "read_known_lengths"]

_OF_LENGTHS = ("photo1", "x1", "y1", "photo2", "x2", "y2", "length", "sigma")
_OF_POINTS = ("name", "photo", "x", "y", "E", "N", "U", "sigma")
_USES = {"": False, "control": False, "check": True}


def _check_columns(path: Path, columns: Sequence[str], needed: Sequence[str]) -> None:
    if missing := [column for column in needed if column not in columns]:
        raise FormatError(f"{path} has no column {missing[0]!r}; expected {', '.join(needed)}")


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
    _check_columns(path, columns, _OF_LENGTHS)
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


def read_control_points(path: Path | str) -> list[ControlPoint]:
    """Points whose places were measured, as `SolveOptions.control` takes them.

    Parameters
    ----------
    path : path
        CSV with the header `name, photo, x, y, E, N, U, sigma`, a line for each photo that shows a point: pixels of
        the stored photo (integer centres), the place in metres and its standard deviation. The lines of a point behind
        its first may leave the place empty. `sigma_up` may be a column, where heights are known to another deviation;
        and `use`, `control` (also where it is empty) or `check`.

    Raises
    ------
    FileError, FormatError
        Not readable; missing columns, numbers that are none, a point that is in two places, or twice in a photo.
    """
    path = Path(path)
    columns, rows = read_table(path)
    # other tables of ours say the unit: sigma_m is sigma here
    columns = [column.removesuffix("_m") for column in columns]
    rows = [{key.removesuffix("_m"): value for key, value in row.items()} for row in rows]
    _check_columns(path, columns, _OF_POINTS)
    if twice := [column for column in (*_OF_POINTS, "sigma_up", "use") if columns.count(column) > 1]:
        raise FormatError(f"{path} has two columns {twice[0]!r}; remove one")
    facts: dict[str, tuple[str, ...]] = {}
    seen: dict[str, dict[str, tuple[float, float]]] = {}
    named = (*_OF_POINTS[4:], *(each for each in ("sigma_up", "use") if each in columns))
    for number, row in enumerate(rows, start=2):
        name, photo = row["name"], row["photo"]
        where = f"{path}, line {number}"
        if not name or not photo:
            raise FormatError(f"{where}: expected the name of a point and that of a photo")
        stated = tuple(row[column] for column in named)
        if stated != facts.setdefault(name, stated) and any(stated):
            raise FormatError(f"{where}: {name} is given another place, deviation or use than in the lines before")
        if photo in seen.setdefault(name, {}):
            raise FormatError(f"{where}: {name} is in {photo} twice")
        x, y = (_number(row[column], column, where) for column in ("x", "y"))
        seen[name][photo] = x, y
    if not facts:
        raise FormatError(f"{path} holds no control points")
    return [_point(name, dict(zip(named, stated, strict=True)), seen[name], path) for name, stated in facts.items()]


def _number(text: str, column: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FormatError(f"{where}: {column}={text!r}, expected a number")
    return value


def _point(name: str, stated: dict[str, str], seen: dict[str, tuple[float, float]], path: Path) -> ControlPoint:
    where = f"{path}, point {name}"
    east, north, up, sigma = (_number(stated[column], column, where) for column in _OF_POINTS[4:])
    sigma_up = _number(stated["sigma_up"], "sigma_up", where) if stated.get("sigma_up") else sigma
    use = stated.get("use", "").lower()
    if use not in _USES:
        raise FormatError(f"{where}: use={use!r}, expected control or check")
    with format_errors(path):
        return ControlPoint(name, (east, north, up), (sigma, sigma, sigma_up), seen, _USES[use])
