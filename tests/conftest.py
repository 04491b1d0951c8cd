"""What all tests share: reproducible randomness, drawn anew for each test."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
import zlib
from functools import lru_cache

import hypothesis
import numba
import numpy as np
import pytest
from click.testing import CliRunner
from compiling import compile_once
from rsundistort_cli.main import cli
from solved_scene import solve_scene

from rsundistort.synthetic import scene

# processes of tests hold back what they write, as the command does where nobody has set this
os.environ.pop("PYTHONUNBUFFERED", None)
# the compiler of kernels makes millions of objects that stay: to search them again and again takes a tenth of its time
gc.set_threshold(200_000, 50, 100)
hypothesis.settings.register_profile("rsundistort", max_examples=40, deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("rsundistort")


@pytest.fixture(scope="session", autouse=True)
def _compile_once(tmp_path_factory):
    if "PYTEST_XDIST_WORKER" in os.environ:
        compile_once(tmp_path_factory.getbasetemp().parent)  # of all workers


@pytest.fixture(scope="session", autouse=True)
def _skies_once():
    """Scenes of one light and seed share their sky, a third of a second each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "_sky_image", lru_cache(scene._sky_image))
        yield


@pytest.fixture
def rng(request):
    """A generator that depends on the test's id only: neither on the order of tests nor on other draws."""
    return np.random.default_rng(zlib.crc32(request.node.nodeid.encode()))


@pytest.fixture
def invoke(monkeypatch, tmp_path):
    """Runs the command inside an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*args):
        return CliRunner().invoke(cli, [str(arg) for arg in args])

    return run


@pytest.fixture(scope="session")
def solved_courtyard(tmp_path_factory):
    """Outputs of the courtyard, and its solution; not to be changed."""
    out = tmp_path_factory.mktemp("courtyard") / "out"
    return out, solve_scene("courtyard", out)


@pytest.fixture
def one_thread():
    """The kernels on one thread; a test may ask for more."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    yield
    numba.set_num_threads(threads)


@pytest.fixture
def cluster(tmp_path):
    """Address of a scheduler, and its two workers, processes of one thread each."""
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"
    base = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path}
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    command = [*base, "scheduler", "--port", "0", "--scheduler-file", str(file), *local]
    worker = [*base, "worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-nanny", *local]
    processes = [subprocess.Popen(each, **quiet) for each in (command, worker, worker)]
    try:
        until = time.monotonic() + 60
        while not file.is_file() or not file.read_text().strip():
            assert time.monotonic() < until
            time.sleep(0.05)
        yield json.loads(file.read_text())["address"], processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()
