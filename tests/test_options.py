"""Options of the commands that solve and rectify: each sets a field, and its default is the field's."""

from __future__ import annotations

import json
import sys
from dataclasses import fields, replace
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner
from rsundistort_cli.rectify import command as rectify_command
from rsundistort_cli.run import command as run_command
from rsundistort_cli.solve import command as solve_command

from rsundistort import GyroOptions, KnownLength, RectifyOptions, RunOptions, SolveOptions, ViewOptions

# of the command itself, or arguments of the function beside the options
NOT_OPTIONS = {
    "photos", "model", "out", "solution", "resume", "images", "database",
    "progress_form", "as_json", "quiet", "verbose", "help",
}  # fmt: skip
ARGUMENTS_OF_RECTIFY = {"jobs", "scheduler", "overwrite"}

PHOTO = [
    (["--masks", "."], {"masks": Path()}),
    (["--depth", "plane"], {"depth": "plane"}),
    (["--alpha", "0.5"], {"view": ViewOptions(alpha=0.5)}),
    (["--scale", "0.5"], {"view": ViewOptions(scale=0.5)}),
    (["--max-size", "800"], {"view": ViewOptions(max_size=800)}),
    (["--interpolation", "linear"], {"interpolation": "linear"}),
    (["--quality", "80"], {"quality": 80}),
    (["--raw-as", "png"], {"raw_as": "png"}),
    (["--apply-orientation"], {"apply_orientation": True}),
    (["--again"], {"again": True}),
    (["--max-pixels", "12"], {"max_megapixels": 12.0}),
    (["--maps", "npz"], {"maps": "npz"}),
    (["--also", "."], {"also": ((Path(), "nearest"),)}),
]
SOLVE = [
    *PHOTO,
    (["--readout", "left-to-right"], {"readout": {"": "left-to-right"}}),
    (["--model", "rotation"], {"shutter_model": "rotation"}),
    (["--refine", "f,k1"], {"refine": ("f", "k1")}),
    (["--camera-sigma", "f=2"], {"camera_sigma": {"f": 2.0}}),
    (["--still", "a.jpg=5"], {"still": {"a.jpg": 0.005}}),
    (["--lengths", "lengths.csv"], {"lengths": [KnownLength(("a", 1.0, 2.0), ("a", 3.0, 4.0), 5.0, 0.1)] * 2}),
    (["--readout-ms", "20"], {"readout_s": 0.02}),
    (["--remedy", "none"], {"remedy": "none"}),
    (["--sparse-format", "txt"], {"sparse_format": "txt"}),
    (["--rs-poses"], {"rs_poses": True}),
    (["--seed", "3"], {"seed": 3}),
    (["--jobs", "1"], {"jobs": 1}),
    (["--scheduler", "tcp://host:8786"], {"scheduler": "tcp://host:8786"}),
    (["--overwrite"], {"overwrite": True}),
    (["--no-report"], {"report": False}),
]
RUN = [
    *SOLVE,
    (["--camera", "camera.json"], {"camera": "camera.json"}),
    (["--every", "4"], {"every": 4}),
    (["--sharpest", "4"], {"sharpest": 4}),
    (["--gyro", "log.csv"], {"gyro": GyroOptions(Path("log.csv"))}),
    (["--gyro", "log.csv", "--gyro-offset", "0.1"], {"gyro": GyroOptions(Path("log.csv"), 0.1)}),
    (["--gyro", "log.csv", "--gyro-axes", "zxy"], {"gyro": GyroOptions(Path("log.csv"), 0.0, "zxy")}),
    (["--gyro", "log.csv", "--photo-times", "t.csv"], {"gyro": GyroOptions(Path("log.csv"), times=Path("t.csv"))}),
    (["--max-features", "500"], {"max_features": 500}),
    (["--feature-megapixels", "2"], {"feature_megapixels": 2.0}),
    (["--matching", "neighbours"], {"matching": "neighbours"}),
]
COMMANDS = {
    "run": (run_command, "rsundistort.solve", "run", RunOptions(), RUN, ["photos", "-o", "out"]),
    "solve": (solve_command, "rsundistort.solve", "solve", SolveOptions(), SOLVE, ["model", "-o", "out"]),
    "rectify": (
        rectify_command, "rsundistort.batch", "rectify_folder", RectifyOptions(), PHOTO,
        ["photos", "--solution", "s.json", "-o", "out"],
    ),
}  # fmt: skip


class Seen(Exception):
    """Carries the options that a command made."""


@pytest.fixture
def options_of(monkeypatch, tmp_path):
    """What options a command makes of its arguments."""
    monkeypatch.chdir(tmp_path)
    for name in ("lengths.csv", "log.csv", "t.csv"):
        Path(name).write_text("photo1,x1,y1,photo2,x2,y2,length,sigma\n" + "a,1,2,,3,4,5,0.1\n" * 2)
    Path("s.json").write_text("{}")

    def options(name, *arguments):
        command, package, function, default, _, required = COMMANDS[name]

        def stop(*given, **_):
            raise Seen(next(each for each in given if isinstance(each, type(default))))

        monkeypatch.setattr(sys.modules[package], function, stop)
        result = CliRunner().invoke(command, [*required, *arguments])
        assert isinstance(result.exception, Seen), result.output
        return result.exception.args[0]

    return options


def as_plain(options):
    """Fields in a form that compares."""
    return {each.name: json.dumps(getattr(options, each.name), default=repr) for each in fields(options)}


@pytest.mark.parametrize("name", COMMANDS)
def test_defaults_are_those_of_the_fields(name, options_of):
    assert as_plain(options_of(name)) == as_plain(COMMANDS[name][3])


@pytest.mark.parametrize(
    ("name", "arguments", "changed"), [(name, *each) for name, of in COMMANDS.items() for each in of[4]]
)
def test_an_option_sets_its_field_and_no_other(name, arguments, changed, options_of):
    expected = replace(COMMANDS[name][3], **changed)
    assert as_plain(options_of(name, *arguments)) == as_plain(expected)


def test_known_motions_set_their_field(options_of, tmp_path):
    (tmp_path / "known.csv").write_text("name,phi1,phi2,phi3,sigma\na.jpg,0.01,0,0,0.001\n")
    for name in ("run", "solve"):
        known = options_of(name, "--known", "known.csv").known
        assert list(known) == ["a.jpg"]
        np.testing.assert_array_equal(known["a.jpg"][0], [0.01, 0, 0])


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_tried(name):
    command, *_, tried, _ = COMMANDS[name]
    flags = {flag for arguments, _ in tried for flag in arguments if flag.startswith("--")} | {"--known"}
    beside = NOT_OPTIONS | (ARGUMENTS_OF_RECTIFY if name == "rectify" else set())
    options = [each for each in command.params if isinstance(each, click.Option) and each.name not in beside]
    assert [each.name for each in options if not flags & {*each.opts, *each.secondary_opts}] == []


@pytest.mark.parametrize("name", COMMANDS)
def test_every_field_has_an_option(name):
    _, _, _, default, tried, _ = COMMANDS[name]
    # a gyroscope's, which no file holds
    without = {"known", "known_bends"}
    assert {each.name for each in fields(default)} - without == {
        field for _, changed in tried for field in changed
    } - without
