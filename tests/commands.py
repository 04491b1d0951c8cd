"""What tests of the commands share: how they are called, and what a refusal looks like."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from rsundistort import (
    Camera,
    RowMotion,
    Solution,
    SolvedImage,
    write_solution,
)

COMMAND = Path(sys.executable).with_name("rsundistort")

CAMERA = "300,300,160,120"

FEW = ["--max-features", "500"]

THREE = ["a.png", "b.png", "c.png"]


def error_line(result):
    """The error of a refused job: one line, exit code 1, no traceback."""
    assert result.exit_code == 1, (result.exit_code, result.exception, result.stderr)
    assert isinstance(result.exception, SystemExit), result.exception
    lines = result.stderr.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert len(errors) == 1, lines
    assert lines[-1] == errors[0]
    assert all(line.startswith("warning: ") for line in lines[:-1]), lines
    assert result.stdout == ""
    return errors[0]


def solution_of(path, names, camera=None):
    camera = camera or Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
    images = [
        SolvedImage(name, "1", np.eye(3), np.array([i, i * i / 9, 0.0]), RowMotion([0.02, -0.01, 0.03]))
        for i, name in enumerate(names)
    ]
    write_solution(path, Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, tuple(images)))
    return path
