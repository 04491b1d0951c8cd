"""The one place where numba is asked to compile."""

from __future__ import annotations

from functools import partial

import numba

# error_model: a division by zero gives inf, which the validity flags catch, and loops can vectorise.
# cache: compiled once per installation, not per run. Numba's cache does not notice a changed callee in another
# file, so a kernel and all its callees stay in one file.
kernel = partial(numba.njit, fastmath={"contract"}, cache=True, nogil=True, error_model="numpy")
parallel_kernel = partial(numba.njit, fastmath={"contract"}, cache=True, nogil=True, error_model="numpy", parallel=True)
prange = numba.prange
