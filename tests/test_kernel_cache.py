"""Compiled kernels are kept where they can be; nothing falls where they cannot, or where what was kept is damaged."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys

import numba
import pytest

from rsundistort._kernels import _jit
from rsundistort.errors import RsUndistortWarning

MODULE = """
from rsundistort._kernels._jit import kernel
from callee import FACTOR, add
@kernel()
def twice(x):
    return add(FACTOR * x)
"""
CALLEE = """
from rsundistort._kernels._jit import kernel
FACTOR = 2
@kernel()
def add(x):
    return x + 0
"""
CALL = "from small import twice; print(twice(21), sum(twice.stats.cache_hits.values()))"
# the reduced system of random blocks of six photos
SUMS = """
import hashlib
import numpy as np
from rsundistort._kernels import schur
from rsundistort._kernels._jit import unknowns_of
rng = np.random.default_rng(0)
m, n, nb = 6, 200, 9
rows, cols = np.triu_indices(m)
frame_idx, point_idx = np.tile(np.arange(m), n), np.repeat(np.arange(n), m)
S, rhs = np.empty((len(cols), nb, nb)), np.empty((m, nb))
schur.reduced_system(
    unknowns_of(nb), np.arange(m + 1) * n, np.argsort(frame_idx, kind="stable"), frame_idx, point_idx,
    np.arange(n + 1) * m, np.searchsorted(rows, np.arange(m + 1)), cols, rng.normal(size=(m * n, 2, nb)),
    rng.normal(size=(n, 3, 3)), rng.normal(size=(n, 3)), rng.normal(size=(m, nb)), rng.normal(size=(m, nb)), S, rhs,
)
print(hashlib.sha256(S.tobytes() + rhs.tobytes()).hexdigest(), sum(schur.reduced_system.stats.cache_hits.values()))
"""
NOWHERE = {"CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "CACHE_DIR": os.devnull + "/x"}


@pytest.fixture
def written(tmp_path):
    """A program with one kernel, and where its compiled kernels are kept."""
    (tmp_path / "small.py").write_text(MODULE)
    (tmp_path / "callee.py").write_text(CALLEE)
    return tmp_path, tmp_path / "kept"


@pytest.fixture
def small(written, monkeypatch):
    """Starts the program anew, as far as kernels go: how often it found its one compiled."""
    folder, kept = written
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # sources change within a second

    def run(expected=42, **config):
        for name, value in ({"CACHE_DIR": str(kept)} | config).items():
            monkeypatch.setattr(numba.config, name, value)
        for module in ("small", "callee"):
            sys.modules.pop(module, None)
        importlib.invalidate_caches()
        _jit._stamp.cache_clear()
        for once in (_jit._tell, _jit._tell_of_compiling):
            once.cache_clear()
        twice = importlib.import_module("small").twice
        assert twice(21) == expected
        return sum(twice.stats.cache_hits.values())

    yield run
    for module in ("small", "callee"):
        sys.modules.pop(module, None)
    _jit._tell.cache_clear()


@pytest.mark.slow
def test_a_kernel_is_compiled_once_for_all_processes(written):
    folder, kept = written
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(kept)}
    environment["PYTHONPATH"] = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    for found in ("0", "1"):
        done = subprocess.run([sys.executable, "-c", CALL], capture_output=True, text=True, env=environment)
        assert (done.stdout.split(), done.stderr) == (["42", found], "")


def test_kernels_read_back_give_the_same_bits_as_those_just_compiled(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    compiled, kept = (
        subprocess.run([sys.executable, "-c", SUMS], capture_output=True, text=True, env=environment).stdout.split()
        for _ in range(2)
    )
    assert (compiled[1], kept[1]) == ("0", "1")
    assert compiled[0] == kept[0]


@pytest.mark.parametrize(
    ("old", "new", "answer"),
    [("x + 0", "x + 1", 43), ("FACTOR = 2", "FACTOR = 3", 63)],
    ids=["callee", "constant"],
)
def test_a_change_in_the_file_of_a_callee_is_noticed(small, written, old, new, answer):
    assert [small(), small()] == [0, 1]
    (written[0] / "callee.py").write_text(CALLEE.replace(old, new))
    assert [small(answer), small(answer)] == [0, 1]


@pytest.mark.parametrize(("suffix", "length"), [(".nbi", 40), (".nbc", 0)])
def test_what_was_cut_short_is_compiled_again(small, written, suffix, length):
    small()
    (damaged,) = written[1].rglob(f"small.twice*{suffix}")
    damaged.write_bytes(damaged.read_bytes()[:length])
    assert [small(), small()] == [0, 1]


def test_compiling_is_logged_and_reading_is_not(small, caplog):
    caplog.set_level("INFO", logger="rsundistort")
    assert [small(), small()] == [0, 1]
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == ["compiling kernels"]


def test_without_a_folder_it_is_compiled_in_memory_and_reported_once(small):
    with pytest.warns(RsUndistortWarning, match="set NUMBA_CACHE_DIR") as stated:
        assert small(**NOWHERE) == 0
    assert len(stated) == 1


def test_the_command_says_so_in_one_line(tmp_path):
    nowhere = {f"NUMBA_{name}": value for name, value in NOWHERE.items()}
    program = "from rsundistort_cli.main import cli; cli()"
    command = [sys.executable, "-c", program, "analyze", str(tmp_path / "none")]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | nowhere)
    kept, error = done.stderr.strip().splitlines()
    assert kept.startswith("warning: compiled kernels cannot be kept")
    assert error.startswith("error: ")
