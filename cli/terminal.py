"""What a person sees: progress, warnings, errors, tables."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, NoReturn

import click

from .stopping import kept_is, stops_for_people

__all__ = [
    "SOME_FAILED",
    "Said",
    "Talk",
    "errors_for_people",
    "forget_stdout",
    "list_failed",
    "progress_bars",
    "say_json",
    "stdout_is_lost",
    "table",
    "tell",
]

#: Exit code when some photos failed, and the others are done.
SOME_FAILED = 3


@dataclass(frozen=True)
class Talk:
    """How much a command says, and in which form.

    Attributes
    ----------
    quiet : bool
        Nothing but warnings and errors.
    verbose : bool
        A line for each step of a stage, also where stderr is no terminal.
    as_json : bool
        One JSON object on stdout at the end, instead of what is for people.
    progress : str
        "bar", or "json" for lines on stdout.
    """

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    progress: str = "bar"

    @property
    def to_people(self) -> bool:
        """Whether stdout is for people."""
        return not (self.quiet or self.as_json or self.progress == "json")


_stdout = {"lost": False}


def tell(text: str) -> None:
    """Lines on stdout. Who does not read them any more loses no work; a device that takes no more is an error."""
    try:
        click.echo(text)
    except OSError as error:
        # what is left in its buffer must not fall at the end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            say("warning: nobody reads stdout any more; the work continues", fg="yellow")
        else:
            _stdout["lost"] = True
            say(f"error: stdout cannot be written: {error.strerror}", fg="red")


def forget_stdout() -> None:
    """Begin anew."""
    _stdout["lost"] = False


def stdout_is_lost() -> bool:
    """Whether something was to be written to stdout, and could not be."""
    return _stdout["lost"]


def say(text: str, **style: Any) -> None:
    """A line on stderr; styled if that is a terminal and nobody asked for NO_COLOR."""
    click.secho(text, err=True, color=False if os.environ.get("NO_COLOR") else None, **style)


class Said(list[str]):
    """Warnings, and the outputs that are missing by them, with the reason."""

    def __init__(self) -> None:
        super().__init__()
        self.missing: dict[str, str] = {}


@contextmanager
def warnings_for_people() -> Iterator[Said]:
    """Warnings become one line each, and are listed."""
    said = Said()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        said.append(str(message))
        if (file := getattr(message, "file", None)) is not None:
            said.missing[file] = str(message)
        say(f"warning: {message}", fg="yellow")

    with warnings.catch_warnings():
        warnings.simplefilter("default")
        warnings.simplefilter("ignore", RuntimeWarning)  # of NumPy, which are for developers
        warnings.showwarning = show
        yield said


@contextmanager
def errors_for_people(kept: str = "nothing was written", needed_gb: float = 1.2) -> Iterator[Said]:
    """Known errors become one line and exit code 1; warnings become one line each, and are listed.

    So does what the system says of files, memory and threads, wherever it says it. An interruption says what is
    `kept`. The block needs addresses of `needed_gb`.
    """
    kept_is(kept)
    _check_limit(needed_gb)
    with stops_for_people(), ExitStack() as stack:
        import cv2

        from rsundistort.errors import RsUndistortError
        from rsundistort.io.photos.codec_lines import heard

        # errors, which are heard: lines of codecs about broken files become ours, with the name. The function's place
        # is OpenCV 4's, or 5's
        (cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel)(2)
        stack.enter_context(heard())
        said = stack.enter_context(warnings_for_people())
        try:
            yield said
        except RsUndistortError as error:
            _fail(str(error))
        except (MemoryError, cv2.error) as error:
            if isinstance(error, cv2.error) and error.code != cv2.Error.StsNoMem:
                raise
            _fail("the memory does not suffice; close other programs, or give --jobs 1")
        except OSError as error:
            where = "" if error.filename is None else f"{os.fsdecode(error.filename)}: "
            why = error.strerror or " ".join(map(str, filter(None, error.args)))
            _fail(f"{where}{why or 'the system gives no more memory, threads or files'}")


def _check_limit(needed_gb: float) -> None:
    """Refuse a limit of addresses in which native code would crash, or wait for ever, while it is loaded or runs.

    The libraries alone take 1.2 GB of addresses, of which they use a part; threads of a run take more.
    """
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    if most != resource.RLIM_INFINITY and most < needed_gb * 1e9:
        _fail(f"addresses are limited to {most / 1e9:.1f} GB, {needed_gb:g} are needed; raise the limit (ulimit -v)")


def _fail(text: str) -> NoReturn:
    say(f"error: {text}", fg="red")
    sys.exit(1)


def say_json(value: Any) -> None:
    """One JSON object on stdout; numbers that JSON lacks, NaN and infinity, are null."""
    from rsundistort.io.json_text import plain

    tell(json.dumps(plain(value), allow_nan=False))


def list_failed(failed: Mapping[str, str], talk: Talk) -> None:
    """List what failed and why, and return the exit code that says so; nothing if nothing did."""
    if failed:
        lines = ["", "failed:", *(f"  {name}: {why}" for name, why in failed.items())]
        (tell if talk.to_people else say)("\n".join(lines))
        sys.exit(SOME_FAILED)


_NO_TOTAL = "{desc:<34} {elapsed}"


class _Bars:
    """On stderr a bar for the stage at work, and a line for each stage, or each step of one, that has ended."""

    def __init__(self, bars: bool, lines: bool, steps: bool) -> None:
        self._bars, self._lines, self._steps = bars, lines, steps
        self._bar: Any = None
        self._stage = ""
        self._count = 0
        self._began = time.perf_counter()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        if bars:
            # a stage inside pycolmap says nothing for a while: its clock must go on
            threading.Thread(target=self._tick, daemon=True).start()

    def _tick(self) -> None:
        while not self._ended.wait(0.5):
            with self._lock:
                if self._bar is not None:
                    self._bar.refresh()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if not self._lines:
            return
        with self._lock:
            # "model sequence: rotation" is a step of the stage "model sequence"
            name = stage if self._steps else stage.partition(":")[0]
            if name != self._stage:
                self._end()
                self._stage, self._began = name, time.perf_counter()
                self._begin(name, done, total)
            self._count = total
            if self._bar is not None:
                self._bar.n = done
                self._bar.refresh()

    def _begin(self, name: str, done: int, total: int) -> None:
        if not self._bars:
            return
        from tqdm import tqdm

        form = "{desc:<34} {n_fmt}/{total_fmt} {bar} {rate_fmt}, {remaining} left" if total else _NO_TOTAL
        self._bar = tqdm(
            total=total or None, desc=name, leave=False, file=sys.stderr, bar_format=form, initial=done,
            unit=" photos" if total else "it",
        )  # fmt: skip

    def _end(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        if self._stage:
            count = f"{self._count:>8}" if self._count else ""
            say(f"{self._stage:<34} {time.perf_counter() - self._began:8.1f} s{count}")

    def note(self, text: str) -> None:
        """A line between those of stages."""
        with self._lock:
            if self._bar is not None:
                self._bar.clear()
            say(text)

    def close(self) -> None:
        self._ended.set()
        with self._lock:
            self._end()
            self._stage = ""


class _Lines:
    """One JSON object a line on stdout: the first and last of each stage, and ten a second at most between."""

    _EVERY_S = 0.1

    def __init__(self) -> None:
        self._stage = ""
        self._first = 0
        self._began = self._said = 0.0

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.perf_counter()
        if stage != self._stage:
            self._stage, self._first, self._began = stage, done, now
        elif done < total and now - self._said < self._EVERY_S:
            return
        self._said = now
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
        tell(json.dumps(line))

    def close(self) -> None:
        pass


@contextmanager
def progress_bars(talk: Talk) -> Iterator[Callable[[str, int, int], None]]:
    """A progress callback: bars and lines on a terminal, lines where asked for, or JSON."""
    shown = sys.stderr.isatty() and not talk.quiet
    lines = shown or (talk.verbose and not talk.quiet)
    bars = _Lines() if talk.progress == "json" else _Bars(shown, lines, talk.verbose)
    with _noted(bars.note) if lines and isinstance(bars, _Bars) else nullcontext():
        try:
            yield bars
        finally:
            bars.close()


class _Notes(logging.Handler):
    """Gives what is logged to a function."""

    def __init__(self, note: Callable[[str], None]) -> None:
        super().__init__()
        self._note = note

    def emit(self, record: logging.LogRecord) -> None:
        self._note(record.getMessage())


@contextmanager
def _noted(note: Callable[[str], None]) -> Iterator[None]:
    """What the package logs is shown."""
    handler, logger = _Notes(note), logging.getLogger("rsundistort")
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def table(rows: Sequence[Sequence[str]]) -> str:
    """Rows as aligned columns: the first to the left, the others to the right."""
    width, *widths = (max(map(len, column)) for column in zip(*rows, strict=True))
    lines = []
    for first, *others in rows:
        cells = [first.ljust(width), *(cell.rjust(w) for cell, w in zip(others, widths, strict=True))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)
