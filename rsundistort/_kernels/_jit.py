"""The one place where numba is asked to compile."""

from __future__ import annotations

import os
from functools import partial

import numba
from numba.core import types
from numba.extending import overload

# Threads of OpenMP that spin while they wait take the processors from those that work as soon as anything else runs:
# a launch then takes 7 ms, not 10 us. libgomp reads this when numba loads it, at the first launch.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# fastmath: products are fused into sums, nothing else; infinities and NaN keep their meaning.
# error_model: a division by zero gives inf, which the validity flags catch, and loops can vectorise.
# cache: compiled once per installation, not per run. Numba's cache does not notice a changed callee in another
# file, so a kernel and all its callees stay in one file.
# forceinline, for callees in inner loops: else each call counts the references of its arrays, twice the whole time.
kernel = partial(numba.njit, cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
parallel_kernel = partial(kernel, parallel=True)
prange = numba.prange

# fastmath of sums whose order the compiler may choose, so that they use vectors; infinities and NaN keep their meaning.
SUMS = {"reassoc", "contract", "nsz"}

# Blocks of more columns are not unrolled: compiling would take minutes.
_MOST_UNROLLED = 18


def unknowns_of(nb: int) -> tuple[float, ...] | int:
    """What kernels take for the number of columns of a block: a tuple whose length they are compiled for, or it."""
    return (0.0,) * nb if nb <= _MOST_UNROLLED else nb


def columns(unknowns: tuple[float, ...] | int) -> int:
    """That number, in a kernel."""
    return unknowns if isinstance(unknowns, int) else len(unknowns)


@overload(columns)
def _columns(unknowns):
    if isinstance(unknowns, types.BaseTuple):
        return lambda unknowns: len(unknowns)
    return lambda unknowns: unknowns
