"""What a person sees: progress, warnings, errors, tables."""

from __future__ import annotations

import json
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import click

__all__ = ["SOME_FAILED", "errors_for_people", "list_failed", "progress_bars", "table"]

#: Exit code when some photos failed, and the others are done.
SOME_FAILED = 3


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
        except KeyboardInterrupt as stop:
            click.echo(f"stopped; {stop or kept}", err=True)
            sys.exit(130)


def list_failed(failed: Mapping[str, str], err: bool) -> None:
    """What failed and why, and the exit code that says so; nothing if nothing did."""
    if failed:
        click.echo("\n".join(["", "failed:", *(f"  {name}: {why}" for name, why in failed.items())]), err=err)
        sys.exit(SOME_FAILED)


_NO_TOTAL = "{desc:<34} {elapsed}"


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
                form = "{desc:<34} {n_fmt}/{total_fmt} {bar} {rate_fmt}, {remaining} left" if total else _NO_TOTAL
                self._bar = tqdm(
                    total=total or None, desc=stage, leave=False, file=sys.stderr, bar_format=form, initial=done,
                    unit=" photos" if total else "it",
                )  # fmt: skip
            self._bar.n = done
            self._bar.refresh()

    def close(self) -> None:
        self._ended.set()
        with self._lock:
            if self._bar is not None:
                self._bar.close()
                self._bar = None


class _Lines:
    """One JSON object a line on stdout: the first and last of each stage, and ten a second at most between."""

    _EVERY_S = 0.1

    def __init__(self) -> None:
        self._stage = ""
        self._first = 0
        self._began = self._told = 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.perf_counter()
        if stage != self._stage:
            self._stage, self._first, self._began = stage, done, now
        elif done < total and now - self._told < self._EVERY_S:
            return
        self._told = now
        count, seconds = done - self._first, now - self._began
        rate = count / seconds if count > 0 and seconds > 0 else None
        eta = (total - done) / rate if rate and total else None
        line = {
            "stage": stage,
            "done": done,
            "total": total or None,
            "rate": rate and round(rate, 3),
            "eta_s": None if eta is None else round(eta, 1),
        }
        click.echo(json.dumps(line))

    def close(self) -> None:
        pass


@contextmanager
def progress_bars(quiet: bool, form: str = "bar") -> Iterator[Callable[[str, int, int], None]]:
    """A progress callback: bars, unless told to be quiet or stderr is no terminal; or JSON, if that was asked for."""
    bars = _Lines() if form == "json" else _Bars(not quiet and sys.stderr.isatty())
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
