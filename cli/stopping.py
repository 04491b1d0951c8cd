"""Signals that end a command: one line, the exit code of shells (128 and the number), and no native stack."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

__all__ = ["hears_signals", "kept_is", "stops_for_people"]

# Seconds that it may take to stop between two photos, before the process is ended as it stands.
_GRACE_S = 5.0
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")

_state: dict[str, Any] = {"number": int(signal.SIGINT), "kept": "nothing was written", "said": False, "heard": False}


def kept_is(text: str) -> None:
    """What is left of the work if a signal ends it where nothing better is known; for people."""
    _state.update(kept=text, said=False)


def say_stopped(text: str = "") -> int:
    """One line on stderr; the exit code."""
    if not _state["said"]:
        _state["said"] = True
        with suppress(OSError, AttributeError):  # nobody listens
            sys.stderr.write(f"stopped; {text or _state['kept']}\n")
            sys.stderr.flush()
    return 128 + int(_state["number"])


@contextmanager
def stops_for_people() -> Iterator[None]:
    """An interruption of the block becomes one line and the exit code."""
    try:
        yield
    except KeyboardInterrupt as stop:
        sys.exit(say_stopped(str(stop)))
    except Exception:
        if not _state["heard"]:
            raise
        sys.exit(say_stopped())  # native code that was being imported makes an error of its own of it


def _hear(number: int, _frame: Any) -> None:
    _state.update(number=number, heard=True)
    raise KeyboardInterrupt


def _watch(pipe: int, stderr: int) -> None:
    """End the process if native code does not let Python hear a signal, or a second one comes."""
    number = os.read(pipe, 1)[0]
    until = time.monotonic() + _GRACE_S
    os.set_blocking(pipe, False)
    while time.monotonic() < until:
        time.sleep(0.05)
        try:
            if os.read(pipe, 1):
                break
        except BlockingIOError:
            continue
    if not _state["said"]:  # past sys.stderr: who holds its lock may be stopped
        with suppress(OSError):
            os.write(stderr, f"stopped; {_state['kept']}\n".encode(errors="backslashreplace"))
    os._exit(128 + number)


def _hear_again(lost: sys.UnraisableHookArgs) -> None:
    """Raise an interruption again that Python dropped, as it does in what native code and the collector call."""
    if isinstance(lost.exc_value, KeyboardInterrupt):
        threading.Thread(target=_interrupt_main, daemon=True).start()
    elif not _state["heard"]:  # else it is of objects that the interruption left half made
        sys.__unraisablehook__(lost)


def _interrupt_main() -> None:
    """Raise an interruption in the main thread once it has left the hook, in which it would be dropped again."""
    main = threading.main_thread().ident or 0
    while True:
        time.sleep(0.05)
        frame = sys._current_frames().get(main)
        while frame is not None and frame.f_code is not _hear_again.__code__:
            frame = frame.f_back
        if frame is None:
            raise_in = ctypes.pythonapi.PyThreadState_SetAsyncExc
            raise_in(ctypes.c_ulong(main), ctypes.py_object(KeyboardInterrupt))
            return


@contextmanager
def hears_signals() -> Iterator[None]:
    """The block may be ended by signals; who ignores one, as nohup does, goes on doing so."""
    for name in _NAMES:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _hear)
    sys.unraisablehook = _hear_again
    if os.name == "posix":
        here, there = os.pipe()
        os.set_blocking(there, False)
        signal.set_wakeup_fd(there, warn_on_full_buffer=False)
        threading.Thread(target=_watch, args=(here, os.dup(2)), daemon=True).start()
    with stops_for_people():
        yield
