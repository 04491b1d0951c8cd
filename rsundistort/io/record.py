"""Which files of a folder rsundistort wrote: those it may replace or remove, and no others."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from ..errors import FileError, file_errors
from ..model.checks import check_photo_name
from .journal import Journal, entries_of
from .json_text import parse_json
from .places import File, Place, RemoteFolder, delete_in, stamps_of, text_in, write_in
from .solution_json import FORMAT

__all__ = ["Record", "is_inside"]

# The stamp of a file that is being written: whatever is there when the process is killed, is ours.
_ANY = ""


class Record:
    """A hidden file of one JSON list a line, [path, stamp], to which every file is added that is written.

    A file is ours as long as it has a stamp it was given: its size and when it changed. A line without a stamp (null)
    takes back that the file is being written. Of outputs of version 0.1, which kept no record, a batch's journal names
    the photos.

    Parameters
    ----------
    place : Path or RemoteFolder
        The folder of outputs. Records of folders in it count, too: outputs may hold outputs.
    """

    NAME = ".rsundistort-written"

    def __init__(self, place: Place) -> None:
        self._place = place
        self._claimed: set[str] = set()
        self._begun = False
        self._lines: list[str] = []  # of a remote record, since it was put last

    def check(
        self,
        paths: Iterable[str],
        inputs: Iterable[Place | File] = (),
        *,
        folders: Iterable[str] = (),
        again: bool = False,
    ) -> None:
        """Refuse to write or remove files where there are others' files, changed ones, or inputs.

        Parameters
        ----------
        paths : iterable of str
            In the folder.
        inputs : iterable of Path
            Files that are read, or folders of them, in whatever places: links to a file are the file.
        folders : iterable of str
            Folders in it that are to be there, besides those of the files.
        again : bool
            Whether files that were changed since they were written may be made again.

        Raises
        ------
        FileError
            Names the first such file, and says what to do.
        """
        paths = sorted(paths)
        mend = "; move it away, or give another folder for the outputs"
        known, there = self._read(), stamps_of(self._place, paths)
        read = _identities(inputs) if isinstance(self._place, Path) else {}
        if isinstance(self._place, Path):
            for within in sorted({*folders, *_parents(paths)}):
                self._check_folder(self._place, within, known)
        for path in paths:
            stamp = there.get(path)
            if stamp is None:
                continue
            if isinstance(self._place, Path) and (found := read.get(_identity(self._place / path))) is not None:
                said = "" if found == self._place / path else f" by way of {self._place / path}"
                raise FileError(f"{found} would be replaced by the outputs{said}; give another folder for them")
            if stamp == _ANY:
                raise FileError(f"{self._place}/{path} is a folder or a link, where a file is to be written{mend}")
            if _is_own(path) or _matches(stamp, known.get(path, ())) or (again and path in known):
                continue
            if path in known:
                raise FileError(f"{self._place}/{path} was changed since it was written here{mend}")
            raise FileError(
                f"{self._place}/{path} would be replaced, and nothing shows that rsundistort wrote it "
                f"(version 0.1 kept no record){mend}"
            )

    def ours(self, within: Collection[str]) -> set[str]:
        """Files that are there as they were written, in some of the folder's entries."""
        known = {path: stamps for path, stamps in self._read().items() if path.split("/")[0] in within}
        there = stamps_of(self._place, known)
        return {path for path, stamp in there.items() if _is_own(path) or _matches(stamp, known[path])}

    def claim(self, paths: Iterable[str]) -> None:
        """Note that files are about to be written; `check` let them pass."""
        if not self._begun:  # anew: a link is not followed, and a last line cut short does not run into the next
            self._write(self._own() or self._of_journal())
        self._begun = True
        new = [path for path in paths if path not in self._claimed]
        self._claimed.update(new)
        self._append((path, _ANY) for path in new)
        self._put()

    def add(self, paths: Collection[str]) -> None:
        """Note claimed files that were written, or were not. Remote ones are looked at in the end, all at once."""
        if isinstance(self._place, Path):
            self._note(paths)

    def _note(self, paths: Collection[str]) -> None:
        there = stamps_of(self._place, paths)
        self._claimed.difference_update(paths)
        self._append((path, there.get(path) or None) for path in paths)

    def remove(self, paths: Collection[str]) -> None:
        """Delete those of these files that are ours, and folders that this leaves empty."""
        gone = self.ours({path.split("/")[0] for path in paths}) & {*paths}
        delete_in(self._place, gone)
        if isinstance(self._place, Path):
            for parent in sorted(_parents(gone), reverse=True):  # what is in a folder before the folder
                with suppress(OSError):  # what holds more stays
                    (self._place / parent).rmdir()

    @contextmanager
    def writing(self, paths: Iterable[str] = ()) -> Iterator[None]:
        """Claim files, which `check` let pass, for a block that writes them."""
        self.claim(paths)
        try:
            yield
        except BaseException:
            with suppress(OSError):  # what ended the block matters more
                self.settle()
            raise
        self.settle()

    def settle(self) -> None:
        """Note what became of the claimed files, and forget what is not there any more."""
        self._note({*self._claimed, *(path for path, stamps in self._own().items() if _ANY in stamps)})
        known = self._own()
        there = [path for path, stamp in stamps_of(self._place, known).items() if stamp]
        self._lines = []
        if there:
            self._write({path: known[path] for path in there})
        else:
            delete_in(self._place, [self.NAME])

    def finish(self, key: str) -> None:
        """Note what the outputs as they are now were made of; whatever is written next takes that back."""
        self._append([("", key)])

    def is_finished(self, key: str) -> bool:
        """Whether all is there as it was when that was noted."""
        return self.changed(key) == []

    def changed(self, key: str) -> list[str] | None:
        """What is gone or changed since it was noted that all is there; None if that was not noted of `key`."""
        if text_in(self._place, self.NAME).splitlines()[-1:] != [_line("", key).strip()]:
            return None
        known = {path for path in self._own() if not _is_own(path)}  # the journal goes at the end
        return sorted(known - set(self.ours({path.split("/")[0] for path in known})))

    def _append(self, entries: Iterable[tuple[str, str | None]]) -> None:
        lines = [_line(path, stamp) for path, stamp in entries]
        if isinstance(self._place, RemoteFolder):
            self._lines += lines
        elif lines:
            with file_errors(self._place, "written"), (self._place / self.NAME).open("a", encoding="utf-8") as file:
                file.write("".join(lines))

    def _write(self, known: Mapping[str, Collection[str]]) -> None:
        """Begin anew, in one stroke."""
        lines = (_line(path, stamp) for path in sorted(known) for stamp in sorted(known[path]))
        with file_errors(self._place, "written"):
            write_in(self._place, self.NAME, "".join(lines).encode())

    def _put(self) -> None:
        """Put a remote record with what was added to it."""
        if isinstance(self._place, RemoteFolder) and self._lines:
            text = text_in(self._place, self.NAME) + "".join(self._lines)
            self._place.write(self.NAME, text.encode())
            self._lines = []

    def _read(self) -> dict[str, set[str]]:
        """The stamps that each file may have."""
        known = self._own() or self._of_journal()
        if isinstance(self._place, Path) and self._place.is_dir():
            for nested in self._place.glob(f"*/{self.NAME}"):
                for path, stamps in _parse(text_in(nested.parent, self.NAME)).items():
                    known.setdefault(f"{nested.parent.name}/{path}", set()).update(stamps)
        return known

    def _own(self) -> dict[str, set[str]]:
        """The same by the record of the folder itself."""
        return _parse(text_in(self._place, self.NAME) + "".join(self._lines))

    def _of_journal(self) -> dict[str, set[str]]:
        """What version 0.1 left: sizes, and the solution at the end of the batch."""
        known: dict[str, set[str]] = {}
        for entry in entries_of(text_in(self._place, Journal.NAME)).values():
            for path, size in entry.files.items():
                known.setdefault(path, set()).add(str(size) if entry.fingerprint else _ANY)
        if known:
            with suppress(ValueError, AttributeError):
                if parse_json(text_in(self._place, "solution.json")).get("format") == FORMAT:
                    known["solution.json"] = {_ANY}
        return known

    @staticmethod
    def _check_folder(folder: Path, within: str, known: dict[str, set[str]]) -> None:
        """Refuse to write into what is no folder, or lies elsewhere."""
        path = folder / within
        if not is_inside(path, folder):
            raise FileError(f"{path} leads out of {folder}; remove that link")
        there = stamps_of(folder, [within])
        if there and not path.is_dir() and not _matches(there[within], known.get(within, ())):
            raise FileError(f"{path} is in the way of a folder for the outputs; move it away")


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a path stays in a folder, wherever links lead."""
    return path.resolve().is_relative_to(folder.resolve())


def _is_own(path: str) -> bool:
    """Whether nobody else calls a file so."""
    return path.rpartition("/")[2] in (Record.NAME, Journal.NAME)


def _parents(paths: Iterable[str]) -> set[str]:
    """All folders that files lie in, below the outermost."""
    return {parent.as_posix() for path in paths for parent in list(PurePosixPath(path).parents)[:-1]}


def _matches(stamp: str, known: Collection[str]) -> bool:
    """Whether a file has one of the stamps it may have; journals know sizes only."""
    return bool(stamp) and any(each in (_ANY, stamp, stamp.split()[0]) for each in known)


def _line(path: str, stamp: str | None) -> str:
    return json.dumps([path, stamp]) + "\n"


def _parse(text: str) -> dict[str, set[str]]:
    """Stamps by file; a last line that was cut short is passed over."""
    known: dict[str, set[str]] = {}
    for line in text.splitlines():
        try:
            path, stamp = parse_json(line)
            stamps = known.setdefault(check_photo_name(path), set())
        except (ValueError, TypeError):
            continue
        stamps.discard(_ANY)
        if stamp is not None:
            stamps.add(str(stamp))
    return {path: stamps for path, stamps in known.items() if stamps}


def _identity(path: Path) -> tuple[int, int] | None:
    """The same for a file, its links and its hard links; None if there is none."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _identities(inputs: Iterable[Place | File]) -> dict[tuple[int, int] | None, Path]:
    """The files among inputs and in their folders, by identity."""
    local = [path for path in inputs if isinstance(path, Path)]
    files = [file for path in local for file in (path.iterdir() if path.is_dir() else [path])]
    return {identity: file for file in files if (identity := _identity(file)) is not None}
