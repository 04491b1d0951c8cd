"""What all tests share: reproducible randomness, drawn anew for each test."""

from __future__ import annotations

import zlib

import hypothesis
import numba
import numpy as np
import pytest

hypothesis.settings.register_profile("rsundistort", max_examples=40, deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("rsundistort")


@pytest.fixture
def rng(request):
    """A generator that depends on the test's id only: neither on the order of tests nor on other draws."""
    return np.random.default_rng(zlib.crc32(request.node.nodeid.encode()))


@pytest.fixture
def one_thread():
    """The kernels on one thread; a test may ask for more."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)
