"""Four photos and a solution of theirs, to be rectified by the command."""

from __future__ import annotations

from click.testing import CliRunner
from rsundistort_cli.main import cli

from rsundistort import (
    Camera,
    RowMotion,
    Solution,
    SolvedImage,
    write_solution,
)

FOUR = ["a.png", "b.png", "c.png", "d.jpg"]


def save_solution(path, names, phi=0.03, width=320, height=240):
    camera = Camera(width, height, [[300.0, 0, width / 2], [0, 300, height / 2], [0, 0, 1]], [-0.05, 0.01, 0, 0])
    images = tuple(
        SolvedImage(name, "1", motion=RowMotion([phi, -0.01 * (k % 5), 0.02])) for k, name in enumerate(names)
    )
    write_solution(path, Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, images))
    return path


def arguments(folder, *more):
    return ["rectify", str(folder / "in"), "--solution", str(folder / "s.json"), "-o", str(folder / "out"), *more]


def invoke(*args):
    return CliRunner().invoke(cli, [str(arg) for arg in args])
