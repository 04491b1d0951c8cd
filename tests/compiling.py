"""Each kernel is compiled once by all processes that test side by side, not once by each of them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher

from rsundistort._kernels._jit import _Kept

try:
    import fcntl
except ImportError:  # Windows: each compiles its own
    fcntl = None


def compile_once(folder: Path) -> None:
    """Who comes second waits, and finds the kernel among the compiled ones; locks are files in a folder."""
    if fcntl is None:
        return
    compiled = Dispatcher.compile

    def compile_or_wait(self, sig):
        if not isinstance(self._cache, _Kept):
            return compiled(self, sig)
        what = f"{self.py_func.__module__}.{self.py_func.__qualname__}{sig}"
        # threads before processes, as within numba; a kernel waits for those that it calls alone, so nobody for ever
        with global_compiler_lock, locked(folder / hashlib.sha256(what.encode()).hexdigest()[:16]):
            return compiled(self, sig)

    Dispatcher.compile = compile_or_wait


@contextmanager
def locked(path: Path) -> Iterator[None]:
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
