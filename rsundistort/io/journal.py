"""Which outputs of a batch are whole, and what they were made of."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from ..errors import InputError
from ..model.checks import check_photo_name
from .aside import write_aside

__all__ = ["Journal", "JournalEntry"]


@dataclass(frozen=True)
class JournalEntry:
    """The outputs of one photo.

    Attributes
    ----------
    name : str
        Of the photo.
    fingerprint : str
        Of what they were made of, and how.
    files : mapping of path in the folder of outputs to int
        How many bytes each has.
    turn : int
        EXIF orientation that was applied.
    depth : (kind, shift_px, whole_shift_px) or None
        How far away what the photo shows was taken to be, and what the shutter did to it, px.
    """

    name: str
    fingerprint: str
    files: Mapping[str, int]
    turn: int = 1
    depth: tuple[str, float, float] | None = None

    def is_whole(self, folder: Path) -> bool:
        """Whether all of them are there, as long as they were."""
        try:
            return all((folder / path).stat().st_size == size for path, size in self.files.items())
        except OSError:
            return False


class Journal:
    """A file of one JSON object a line, to which each photo is added when its outputs are whole.

    A process that is killed leaves at worst a last line cut short, which is passed over: its photo is done again.

    Parameters
    ----------
    folder : Path
        Of the outputs; the journal is a hidden file in it.
    """

    NAME = ".rectified.jsonl"

    def __init__(self, folder: Path) -> None:
        self.path = folder / self.NAME
        self._file: IO[str] | None = None

    def read(self) -> dict[str, JournalEntry]:
        """What was done, by photo; the last word on each counts."""
        entries = {}
        if self.path.is_file():
            for line in self.path.read_text(encoding="utf-8", errors="replace").splitlines():
                try:
                    entry = _entry(json.loads(line))
                except (ValueError, TypeError, KeyError, IndexError, AttributeError):
                    continue
                entries[entry.name] = entry
        return entries

    def write(self, entries: Iterable[JournalEntry]) -> None:
        """Begin anew with these, in one stroke."""
        write_aside(self.path, "".join(_line(entry) for entry in entries).encode())

    def add(self, entry: JournalEntry) -> None:
        """Note that a photo is done."""
        if self._file is None:
            self._file = self.path.open("a", encoding="utf-8")
        self._file.write(_line(entry))
        self._file.flush()

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


def _line(entry: JournalEntry) -> str:
    return json.dumps(asdict(entry), sort_keys=True) + "\n"


def _entry(value: dict[str, Any]) -> JournalEntry:
    name, fingerprint, turn, depth = (value[key] for key in ("name", "fingerprint", "turn", "depth"))
    if not (isinstance(name, str) and isinstance(fingerprint, str) and turn in range(1, 9)):
        raise InputError("no entry of a journal")
    files = {check_photo_name(path): int(size) for path, size in value["files"].items()}
    return JournalEntry(name, fingerprint, files, turn, depth and (str(depth[0]), float(depth[1]), float(depth[2])))
