"""What a person sees: progress, warnings, errors, tables."""

from __future__ import annotations

import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

__all__ = ["errors_for_people", "progress_bars", "table"]


@contextmanager
def errors_for_people(kept: str = "nothing was written") -> Iterator[None]:
    """Known errors become one line and exit code 1; warnings become one line each."""
    import cv2

    from rsundistort.errors import RsUndistortError

    # OpenCV's and libtiff's own lines about broken files: ours say it once, with the name. 0 is silent; the function's
    # place is OpenCV 4's, or 5's
    (cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel)(0)

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        click.echo(f"warning: {message}", err=True)

    with warnings.catch_warnings():
        warnings.simplefilter("default")
        warnings.showwarning = show
        try:
            yield
        except RsUndistortError as error:
            click.echo(f"error: {error}", err=True)
            sys.exit(1)
        except KeyboardInterrupt:
            click.echo(f"stopped; {kept}", err=True)
            sys.exit(130)


class _Bars:
    """One bar a stage on stderr; nothing when it is no terminal."""

    def __init__(self, shown: bool) -> None:
        self._shown = shown
        self._bar: Any = None
        self._stage = ""
        self._lock = threading.Lock()
        self._ended = threading.Event()
        if shown:
            # a stage inside pycolmap says nothing for a while: its clock must go on
            threading.Thread(target=self._tick, daemon=True).start()

    def _tick(self) -> None:
        while not self._ended.wait(0.5):
            with self._lock:
                if self._bar is not None:
                    self._bar.refresh()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if not self._shown:
            return
        from tqdm import tqdm

        with self._lock:
            if stage != self._stage:
                if self._bar is not None:
                    self._bar.close()
                self._stage = stage
                form = "{desc:<34} {n_fmt}/{total_fmt} {bar} {elapsed}" if total else "{desc:<34} {elapsed}"
                self._bar = tqdm(total=total or None, desc=stage, leave=False, file=sys.stderr, bar_format=form)
            self._bar.n = done
            self._bar.refresh()

    def close(self) -> None:
        self._ended.set()
        with self._lock:
            if self._bar is not None:
                self._bar.close()
                self._bar = None


@contextmanager
def progress_bars(quiet: bool) -> Iterator[_Bars]:
    """A progress callback that draws bars, unless told to be quiet or stderr is no terminal."""
    bars = _Bars(not quiet and sys.stderr.isatty())
    try:
        yield bars
    finally:
        bars.close()


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows as aligned columns: the first to the left, the others to the right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [
            row[0].ljust(widths[0]),
            *(cell.rjust(w) for cell, w in zip(row[1:], widths[1:], strict=True)),
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)
