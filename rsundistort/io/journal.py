"""Which outputs of a batch are whole, and what they were made of."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from ..errors import FileError, InputError
from ..model.checks import check_photo_name
from .aside import write_aside
from .json_text import parse_json
from .places import RemoteFolder

__all__ = ["Journal", "JournalEntry", "RemoteJournal", "entries_of"]


@dataclass(frozen=True)
class JournalEntry:
    """The outputs of one photo.

    Attributes
    ----------
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

    def is_whole(self, sizes: Mapping[str, int]) -> bool:
        """Whether all of them are there by the sizes of what is, as long as they were."""
        return all(sizes.get(path) == size for path, size in self.files.items())


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
        """Entries by photo; the last one of each photo counts."""
        text = self.path.read_text(encoding="utf-8", errors="replace") if self.path.is_file() else ""
        return entries_of(text)

    def write(self, entries: Iterable[JournalEntry]) -> None:
        """Begin anew with these, in one stroke."""
        write_aside(self.path, "".join(_line(entry) for entry in entries).encode())

    def add(self, entry: JournalEntry) -> None:
        """Note that a photo is done."""
        if self._file is None:
            self._file = self.path.open("a", encoding="utf-8")
        self._file.write(_line(entry))
        self._file.flush()

    def settle(self) -> None:
        """Make sure that what was added stays, whatever happens to this process."""

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


class RemoteJournal(Journal):
    """A journal that is kept here, and put into a remote folder now and then, and at the end.

    What a killed process did not put is done again. What it is about to do again must not pass for done: `settle`.
    """

    # Seconds from one put to the next; and how many times as long as the last one took, for long journals.
    _EVERY_S, _TIMES = 5.0, 20.0

    def __init__(self, folder: RemoteFolder) -> None:
        self._work = tempfile.TemporaryDirectory(prefix="rsundistort-")
        super().__init__(Path(self._work.name))
        self._folder = folder
        self._due = 0.0
        self._said = True

    def fetch(self) -> None:
        """Begin with what is in the folder."""
        self.path.write_bytes(self._folder.read(self.NAME))

    def write(self, entries: Iterable[JournalEntry]) -> None:
        """Begin anew with these, in one stroke."""
        super().write(entries)
        self._said = False
        self.settle()

    def add(self, entry: JournalEntry) -> None:
        """Note that a photo is done."""
        super().add(entry)
        self._said = False
        if time.monotonic() > self._due:
            self.settle()

    def settle(self) -> None:
        """Put it."""
        if not self._said:
            began = time.monotonic()
            self._folder.write(self.NAME, self.path.read_bytes())
            ended = time.monotonic()
            self._due, self._said = ended + max(self._EVERY_S, self._TIMES * (ended - began)), True

    def drop(self) -> None:
        """Leave no journal in the folder."""
        self._said = True
        self._folder.delete([self.NAME])

    def __exit__(self, kind: object, *_: object) -> None:
        super().__exit__(kind)
        try:
            # what ended the block matters more than that this failed, too
            with suppress(FileError) if kind is not None else nullcontext():
                self.settle()
        finally:
            self._work.cleanup()


def entries_of(text: str) -> dict[str, JournalEntry]:
    """Entries by photo of the text of a journal; the last one of each photo counts."""
    entries = {}
    for line in text.splitlines():
        try:
            entry = _entry(parse_json(line))
        except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError):
            continue
        entries[entry.name] = entry
    return entries


def _line(entry: JournalEntry) -> str:
    return json.dumps(asdict(entry), sort_keys=True) + "\n"


def _entry(value: dict[str, Any]) -> JournalEntry:
    name, fingerprint, turn, depth = (value[key] for key in ("name", "fingerprint", "turn", "depth"))
    if not (isinstance(name, str) and isinstance(fingerprint, str) and turn in range(1, 9)):
        raise InputError("no entry of a journal")
    files = {check_photo_name(path): size for path, size in value["files"].items()}
    if not all(type(size) is int and size >= 0 for size in files.values()):
        raise InputError("no sizes of files")
    return JournalEntry(name, fingerprint, files, turn, depth and (str(depth[0]), float(depth[1]), float(depth[2])))
