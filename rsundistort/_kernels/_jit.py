"""The one place where numba is asked to compile."""

from __future__ import annotations

import hashlib
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numba
from numba.core import types
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import cpu_target
from numba.extending import overload

from ..errors import RsUndistortWarning

# Threads of OpenMP that spin while they wait take the processors from those that work as soon as anything else runs:
# a launch then takes 7 ms, not 10 us. libgomp reads this when numba loads it, at the first launch.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# Those that wait for some 50 us before they sleep are there for the next kernel: 0.95 of the time of a run.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")


class _Kept(FunctionCache):
    """Compiled kernels in files, where possible: a damaged file, or one that cannot be written, means compiling again.

    Kernels of other sources are compiled again, too. Numba asks only whether a kernel's own file is the same; a kernel
    holds the code and the constants of those that it calls, too, and these may stand in any file beside it.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        sources = _stamp(Path(function.__code__.co_filename).parent)
        self._cache_file._source_stamp = self._cache_file._source_stamp, sources

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # pickle raises many kinds for a file that was cut short
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _tell(f"compiled kernels cannot be kept ({error.strerror})")


@lru_cache
def _stamp(folder: Path) -> bytes:
    """Changes with any source file of a folder; of a package in a zip file, whose stamp numba takes, it is constant."""
    digest = hashlib.sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.digest()


@lru_cache
def _tell(what: str) -> None:
    warnings.warn(
        f"{what}, so that each run takes a minute to compile them; set NUMBA_CACHE_DIR to a folder that can be written",
        RsUndistortWarning,
        stacklevel=2,
    )


@lru_cache
def _tell_of_compiling() -> None:
    """Said once, since a stage may stand still for a minute; commands show it where they show progress."""
    logging.getLogger("rsundistort").info("compiling kernels: one to two minutes, once per installation")


class _SelfContained(JITCodeLibrary):
    """Machine code that runs its own copies of the kernels that it calls.

    Numba leaves these copies open to a link with others of the same name. A process that compiled a callee would run
    that code, one that read the caller from a file the caller's copy, and the two, optimised in different surroundings,
    differ by rounding: a second run would not repeat the first. The parallel loops of a kernel, which numba compiles
    as libraries of their own ("gufuncs"), become part of it and share its copies.
    """

    def _optimize_final_module(self) -> None:
        if "gufunc" not in self.name.lower():
            for function in self._final_module.functions:
                if not function.is_declaration and function.linkage.name in ("linkonce_odr", "weak_odr"):
                    function.linkage = "internal"
        super()._optimize_final_module()


@contextmanager
def _self_contained() -> Iterator[None]:
    """Kernels that are compiled in this block are self-contained; numba's lock of its compiler is held."""
    _tell_of_compiling()
    codegen = cpu_target.target_context.codegen()
    before = codegen._library_class
    codegen._library_class = _SelfContained
    try:
        yield
    finally:
        codegen._library_class = before


# fastmath: products are fused into sums, nothing else; infinities and NaN keep their meaning.
# error_model: a division by zero gives inf, which the validity flags catch, and loops can vectorise.
# _Kept: compiled once per installation, not per run.
# forceinline, for callees in inner loops: else each call counts the references of its arrays, twice the whole time.
def kernel(
    fastmath: Any = frozenset({"contract"}), forceinline: bool = False, parallel: bool = False
) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of a function that is compiled when it is first called with arrays of a kind."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(
            nogil=True, error_model="numpy", fastmath=set(fastmath), forceinline=forceinline, parallel=parallel
        )(function)
        dispatcher._compiler.compile = _self_contained()(dispatcher._compiler.compile)
        try:
            dispatcher._cache = _Kept(function)
        except RuntimeError:  # nowhere to keep it
            _tell("compiled kernels cannot be kept (no folder for them can be written)")
        return dispatcher

    return compiled


parallel_kernel = partial(kernel, parallel=True)
prange = numba.prange

# fastmath of sums whose order the compiler may choose, so that they use vectors; infinities and NaN keep their meaning.
SUMS = {"reassoc", "contract", "nsz"}

# Blocks of more columns are not unrolled: compiling would take minutes.
_MOST_UNROLLED = 18


def unknowns_of(nb: int) -> tuple[float, ...] | int:
    """Argument of kernels for the columns of a block: a tuple whose length they are compiled for, or the number."""
    return (0.0,) * nb if nb <= _MOST_UNROLLED else nb


def columns(unknowns: tuple[float, ...] | int) -> int:
    """The number of columns, in a kernel."""
    return unknowns if isinstance(unknowns, int) else len(unknowns)


@overload(columns)
def _columns(unknowns):
    if isinstance(unknowns, types.BaseTuple):
        return lambda unknowns: len(unknowns)
    return lambda unknowns: unknowns
