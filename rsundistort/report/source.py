"""The content of a folder of outputs, as far as it exists."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

from ..errors import FileError, FormatError
from ..io import output_name, read_solution
from ..io.solution_json import BENT_VERSION
from ..model import Solution
from .diagnostics import Diagnostics, read_diagnostics

__all__ = ["Source", "read_source", "relative_folder"]


@dataclass(frozen=True)
class Source:
    """The input of a report.

    Attributes
    ----------
    diagnostics : Diagnostics or None
        Of `report.npz`, if it is there and of this solution.
    photos : Path or None
        Folder of the raw photos, if it is there.
    notes : tuple of str
        What is missing, and how to mend it, for people.
    """

    out: Path
    solution: Solution
    diagnostics: Diagnostics | None
    photos: Path | None
    notes: tuple[str, ...] = ()

    def before(self, name: str) -> Path | None:
        """The raw photo."""
        return _inside(self.photos, name)

    def after(self, name: str) -> Path | None:
        """The rectified photo."""
        return _inside(self.out / "images", output_name(name, str(self.solution.options.get("raw_as") or "tif")))


def read_source(out: Path, photos: Path | None = None) -> Source:
    """Read what exists in a folder of outputs.

    Parameters
    ----------
    out : Path
        As `run` and `solve` leave it.
    photos : Path, optional
        Folder of the raw photos; else where it was when the solution was made, seen from `out`.

    Raises
    ------
    FileError, FormatError
        When there is no solution, or it cannot be understood.
    """
    if not out.is_dir():
        raise FileError(f"{out} is no folder; give the one that rsundistort run or solve wrote")
    if not (out / "solution.json").is_file():
        raise FileError(f"{out} holds no solution.json; give the folder that rsundistort run or solve wrote")
    if photos is not None and not photos.is_dir():
        raise FileError(f"{photos} is no folder; give the one that holds the photos")
    solution, notes = _solution(out / "solution.json")
    diagnostics = None
    try:
        diagnostics = read_diagnostics(out / "report.npz")
        if set(diagnostics.names) != {image.name for image in solution.registered}:
            diagnostics = None
            notes.append("report.npz is of another solution: residuals and the global shutter's result are not shown.")
    except FormatError as error:
        notes.append(f"{error}: residuals and the global shutter's result are not shown.")
    except FileError:
        notes.append("report.npz is missing: residuals and the global shutter's result are not shown.")
    if photos is None and diagnostics is not None and diagnostics.photos:
        folder = out / diagnostics.photos
        photos = folder if folder.is_dir() else None
    source = Source(out, solution, diagnostics, photos)
    return replace(source, notes=(*notes, *_missing(source)))


def _solution(path: Path) -> tuple[Solution, list[str]]:
    """The solution, and remarks on it: one of a newer version is shown as far as it can be read."""
    try:
        return read_solution(path), []
    except FormatError as refused:
        try:
            solution = read_solution(path, newer=True)
        except FormatError:
            raise refused from None
        return solution, [
            f"solution.json is of a newer version of its format than {BENT_VERSION}, which this program reads: what is "
            "shown may be incomplete, or mean something else; update rsundistort."
        ]


def _missing(source: Source) -> list[str]:
    """Remarks on missing photos."""
    # for those that could not be rectified
    names = [image.name for image in source.solution.registered if image.reason is None]
    if not (source.out / "images").is_dir():
        return []  # solved without photos
    notes = []
    if source.photos is None:
        notes.append(
            "The original photos are not at hand, so only the rectified ones are shown; "
            "rsundistort report OUT --photos DIR takes them from DIR."
        )
    for folder, lost in (
        ("the photos' folder", [name for name in names if source.photos is not None and not source.before(name)]),
        ("images", [name for name in names if not source.after(name)]),
    ):
        if lost:
            more = "" if len(lost) == 1 else f" and {len(lost) - 1} more"
            are = "is" if len(lost) == 1 else "are"
            notes.append(f"{lost[0]}{more} {are} missing in {folder}.")
    return notes


def _inside(folder: Path | None, name: str) -> Path | None:
    """A file below a folder, if it is there."""
    if folder is None:
        return None
    path = folder / name
    return path if path.is_file() else None


def relative_folder(folder: Path, out: Path) -> str:
    """A folder as seen from another; empty where there is no way."""
    try:
        return Path(os.path.relpath(folder.resolve(), out.resolve())).as_posix()
    except ValueError:  # another drive
        return ""
