"""The installed command: signals are heard before all else is imported, which takes half a second."""

from __future__ import annotations

import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # without Python's traceback, until `hears_signals` has a line for it

import errno
import gc
import io
import os
import sys
from typing import Any

from .stopping import hears_signals

_STREAM_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF, errno.EPIPE)


def main() -> None:
    """Run the command."""
    _open_streams()
    # by default all that is loaded is looked through for circles 500 times in a run of eight seconds: 2 % of it
    gc.set_threshold(20_000, 20, 20)
    with hears_signals():
        from .main import cli

        try:
            cli()
        except OSError as error:
            if error.errno not in _STREAM_ERRORS:  # a library that was not given memory to be loaded
                sys.exit(f"error: {' '.join(str(error).split())}")
            try:  # of click itself
                sys.stderr.write(f"error: stdout cannot be written: {error.strerror}\n")
                sys.stderr.flush()
            except OSError:  # then it was this one: click says there how it was called wrongly
                _forget_unwritten(2)
                sys.exit(2)
            _forget_unwritten(1)
            sys.exit(3)
        finally:
            gc.freeze()  # the end of the process need not look for circles in all that it loaded: a third of a second


def _forget_unwritten(number: int) -> None:
    """Let the stream take what it still holds: else Python tries again at its end, and exits with a code of its own."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), number)


def _open_streams() -> None:
    """Give closed streams a file that takes all: else the next file that is opened would be taken for them."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream: Any = getattr(sys, name)
        if stream is None:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest number that is free: this one
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False))
        elif isinstance(stream, io.TextIOWrapper) and number == 1:
            stream.reconfigure(errors="backslashreplace")  # a name of a file may be no text


if __name__ == "__main__":
    main()
