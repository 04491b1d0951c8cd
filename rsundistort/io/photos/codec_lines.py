"""What codecs say of damaged pictures: libjpeg, libpng and libtiff write to stderr, and name no file.

While `heard` is open, what the process's own code writes there goes through a thread, which keeps the lines of codecs
and passes on the rest. Pictures are decoded side by side, so that a line may be another's: a picture during which one
was heard is decoded again alone.
"""

from __future__ import annotations

import itertools
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

__all__ = ["heard", "with_lines"]

T = TypeVar("T")

_OF_CODECS = re.compile(
    rb"libpng |Corrupt JPEG|Premature end of JPEG|Invalid |Unsupported marker|\[ *(ERROR|WARN)\S*\].*grfmt"
)
# Tags of cameras and programs that libtiff has no name for: no damage.
_HARMLESS = re.compile(rb"Unknown field with tag")
_OF_OPENCV = re.compile(rb"\[ *(ERROR|WARN|INFO)[:@]")


class _Ear:
    """A pipe in the place of stderr, and who listens to it."""

    def __init__(self) -> None:
        self.true_stderr = os.dup(2)
        read, write = os.pipe()
        os.dup2(write, 2)
        os.close(write)
        self._lines: list[str] = []
        self._marks: dict[bytes, threading.Event] = {}
        self._numbers = itertools.count()
        self._turn, self._at_work, self._alone = threading.Condition(), 0, False
        self._thread = threading.Thread(target=self._listen, args=(read,), daemon=True)
        self._thread.start()

    def _listen(self, read: int) -> None:
        with os.fdopen(read, "rb") as stream:
            for line in stream:
                if (mark := self._marks.pop(line, None)) is not None:
                    mark.set()
                elif _OF_CODECS.match(line) and not _HARMLESS.search(line):
                    self._lines.append(line.decode(errors="replace").strip())
                elif not _OF_OPENCV.match(line):
                    with suppress(OSError):
                        os.write(self.true_stderr, line)

    def close(self) -> None:
        os.dup2(self.true_stderr, 2)
        self._thread.join(timeout=5)
        os.close(self.true_stderr)

    def _count(self) -> int:
        """Lines that were written until now."""
        line, event = b"\0%d\n" % next(self._numbers), threading.Event()
        self._marks[line] = event
        os.write(2, line)
        event.wait(timeout=5)
        return len(self._lines)

    @contextmanager
    def _working(self, alone: bool) -> Iterator[None]:
        with self._turn:
            self._turn.wait_for(lambda: not self._alone and not (alone and self._at_work))
            self._alone, self._at_work = alone, self._at_work + 1
        try:
            yield
        finally:
            with self._turn:
                self._alone, self._at_work = False, self._at_work - 1
                self._turn.notify_all()

    def hear(self, decode: Callable[[], T], alone: bool) -> tuple[T, list[str]]:
        with self._working(alone):
            before = self._count()
            found = decode()
            return found, self._lines[before : self._count()]


_ear: _Ear | None = None


@contextmanager
def heard() -> Iterator[None]:
    """Listen to codecs; Python's own stderr stays what it is. Nothing is heard where there is no stderr."""
    global _ear
    if _ear is not None:
        yield
        return
    try:
        ear = _Ear()
    except OSError:  # closed
        yield
        return
    _ear, python = ear, sys.stderr
    if _is_second(python):
        sys.stderr = os.fdopen(
            os.dup(ear.true_stderr), "w", encoding=python.encoding, errors=python.errors, buffering=1
        )
    try:
        yield
    finally:
        _ear = None
        if sys.stderr is not python and _is_second(python):
            sys.stderr.close()
            sys.stderr = python
        ear.close()


def _is_second(stream: object) -> bool:
    """Whether Python's stderr is that of the process."""
    try:
        return stream is not None and stream.fileno() == 2  # type: ignore[attr-defined]
    except (AttributeError, OSError, ValueError):
        return False


def with_lines(decode: Callable[[], T]) -> tuple[T, list[str]]:
    """What a function gives that decodes a picture, and what its codec said; nothing where nobody listens."""
    ear = _ear
    if ear is None:
        return decode(), []
    found, lines = ear.hear(decode, alone=False)
    return ear.hear(decode, alone=True) if lines else (found, lines)
