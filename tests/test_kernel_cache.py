"""Compiled kernels are kept where they can be; nothing falls where they cannot, or where what was kept is damaged."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

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
CALL = "import numba; from small import twice; print(twice(21)); print(sum(twice.stats.cache_hits.values()))"


@pytest.fixture
def small(tmp_path):
    """A program with one kernel: what it says, and how often it found the kernel compiled."""
    (tmp_path / "small.py").write_text(MODULE)
    (tmp_path / "callee.py").write_text(CALLEE)

    def run(expected=42, **environment):
        kept = {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(tmp_path)}
        done = subprocess.run(
            [sys.executable, "-c", CALL], capture_output=True, text=True, env=os.environ | kept | environment
        )
        assert done.returncode == 0, done.stderr
        answer, found = map(int, done.stdout.split())
        assert answer == expected
        return found, done.stderr

    return run


def test_a_kernel_is_compiled_once(small):
    assert small() == (0, "")
    assert small() == (1, "")


@pytest.mark.parametrize(
    ("old", "new", "answer"),
    [("x + 0", "x + 1", 43), ("FACTOR = 2", "FACTOR = 3", 63)],
    ids=["callee", "constant"],
)
def test_a_change_in_the_file_of_a_callee_is_noticed(small, tmp_path, old, new, answer):
    small()
    (tmp_path / "callee.py").write_text(CALLEE.replace(old, new))
    assert small(answer) == (0, "")
    assert small(answer) == (1, "")


@pytest.mark.parametrize(("suffix", "length"), [(".nbi", 40), (".nbc", 0)])
def test_what_was_cut_short_is_compiled_again(small, tmp_path, suffix, length):
    small()
    (damaged,) = (tmp_path / "kept").rglob(f"small.twice*{suffix}")
    damaged.write_bytes(damaged.read_bytes()[:length])
    assert [small(), small()] == [(0, ""), (1, "")]


def test_without_a_folder_it_is_compiled_in_memory_and_told_once(small):
    nowhere = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "NUMBA_CACHE_DIR": os.devnull + "/x"}
    found, said = small(**nowhere)
    assert found == 0
    assert said.count("RsUndistortWarning") == 1
    assert "set NUMBA_CACHE_DIR" in said


def test_the_command_says_so_in_one_line(tmp_path):
    nowhere = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "NUMBA_CACHE_DIR": os.devnull + "/x"}
    program = "from rsundistort_cli.main import cli; cli()"
    command = [sys.executable, "-c", program, "analyze", str(tmp_path / "none")]
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | nowhere)
    kept, error = done.stderr.strip().splitlines()
    assert kept.startswith("warning: compiled kernels cannot be kept")
    assert error.startswith("error: ")
