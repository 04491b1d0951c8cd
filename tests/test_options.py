"""Options of the commands that solve and rectify: each sets a field, and its default is the field's."""

from __future__ import annotations

import inspect
import json
import re
import sys
from dataclasses import fields, replace
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from rsundistort_cli import experiment, simulate
from rsundistort_cli.readout import command as readout_command
from rsundistort_cli.rectify import command as rectify_command
from rsundistort_cli.run import command as run_command
from rsundistort_cli.sections import SECTIONS
from rsundistort_cli.solve import command as solve_command

from rsundistort import (
    GyroOptions,
    KnownLength,
    RectifyOptions,
    RunOptions,
    SolveOptions,
    ViewOptions,
    rectify_folder,
    run,
    solve,
)
from rsundistort.errors import InputError
from rsundistort.experiments import OneOptions, TwoOptions
from rsundistort.io import GyroLog
from rsundistort.model import ControlPoint
from rsundistort.simulate import SceneOptions, WarpOptions
from rsundistort.solve import OutputOptions
from rsundistort.synthetic import Vibration

# of the command itself, or no options
NOT_OPTIONS = {
    "photos",
    "model",
    "out",
    "solution",
    "images",
    "database",
    "progress_form",
    "as_json",
    "quiet",
    "verbose",
    "resume",
}

CONTROL = ControlPoint("P", (3.0, 4.0, 5.0), (0.1, 0.1, 0.1), {"a": (1.0, 2.0), "b": (6.0, 7.0)})
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
    (["--readout", "left-to-right"], {"readout": {"": "left-to-right"}}),
    (["--model", "rotation"], {"shutter_model": "rotation"}),
    (["--refine", "f,k1"], {"refine": ("f", "k1")}),
    (["--camera-sigma", "f=2"], {"camera_sigma": {"f": 2.0}}),
    (["--still", "a.jpg=5"], {"still": {"a.jpg": 0.005}}),
    (["--crs", "none"], {"crs": "none"}),
    (["--gcp", "gcp.csv"], {"control": [CONTROL]}),
    (["--lengths", "lengths.csv"], {"lengths": [KnownLength(("a", 1.0, 2.0), ("a", 3.0, 4.0), 5.0, 0.1)] * 2}),
    (["--readout-ms", "20"], {"readout_s": 0.02}),
    (["--remedy", "none"], {"remedy": "none"}),
    (["--seed", "3"], {"seed": 3}),
]
OUTPUTS = [
    (["--sparse-format", "txt"], {"sparse_format": "txt"}),
    (["--rs-poses"], {"rs_poses": True}),
    (["--usd"], {"usd": True}),
    (["--export", "nuke", "--export", "opensfm"], {"exports": ("nuke", "opensfm")}),
    (["--no-report"], {"report": False}),
]
WORK = [
    (["--jobs", "1"], {"jobs": 1}),
    (["--scheduler", "tcp://host:8786"], {"scheduler": "tcp://host:8786"}),
    (["--overwrite"], {"overwrite": True}),
]
MEASURE = [
    (["--camera", "camera.json"], {"camera": "camera.json"}),
    (["--frames", "all"], {"frames": "all"}),
    (["--every", "4"], {"every": 4}),
    (["--sharpest", "4"], {"sharpest": 4}),
    (["--gyro", "log.csv"], {"gyro": GyroOptions(Path("log.csv"))}),
    (["--gyro", "log.csv", "--gyro-offset", "0.1"], {"gyro": GyroOptions(Path("log.csv"), 0.1)}),
    (["--gyro", "log.csv", "--gyro-axes", "zxy"], {"gyro": GyroOptions(Path("log.csv"), 0.0, "zxy")}),
    (["--gyro", "log.csv", "--photo-times", "t.csv"], {"gyro": GyroOptions(Path("log.csv"), times=Path("t.csv"))}),
    (["--max-features", "500"], {"max_features": 500}),
    (["--feature-megapixels", "2"], {"feature_megapixels": 2.0}),
    (["--features", "affine"], {"features": "affine"}),
    (["--matching", "neighbours"], {"matching": "neighbours"}),
]
# command, package and name of its function, required arguments
COMMANDS = {
    "run": (run_command, "rsundistort.solve", run, ["photos", "-o", "out"]),
    "solve": (solve_command, "rsundistort.solve", solve, ["model", "-o", "out"]),
    "rectify": (
        rectify_command, "rsundistort.batch", rectify_folder, ["photos", "--solution", "s.json", "-o", "out"],
    ),
}  # fmt: skip
# which options set fields of which part, under the name that the function has for it; "" are its own arguments
PARTS = {
    "run": {"options": MEASURE, "solve": SOLVE, "rectify": PHOTO, "outputs": OUTPUTS, "": WORK},
    "solve": {"options": SOLVE, "rectify": PHOTO, "outputs": OUTPUTS, "": WORK},
    "rectify": {"options": PHOTO, "": [*WORK, (["--resume"], {"resume": True})]},
}
DEFAULTS = {
    "run": {"options": RunOptions(), "solve": SolveOptions(), "rectify": RectifyOptions(), "outputs": OutputOptions()},
    "solve": {"options": SolveOptions(), "rectify": RectifyOptions(), "outputs": OutputOptions()},
    "rectify": {"options": RectifyOptions()},
}
TRIED = [(name, part, *each) for name, parts in PARTS.items() for part, tried in parts.items() for each in tried]
# no file holds what a gyroscope knows; the parts of `RunOptions` are seen by themselves
WITHOUT_OPTION = {"known", "known_bends", "solve", "rectify", "outputs"}

COMMON = [(["--seed", "3"], {"seed": 3}), (["--jobs", "2"], {"jobs": 2})]
# of commands with one class of options: command, module and name of the function, its options, arguments, tried ones
OTHERS = [
    (
        simulate.warp, "rsundistort.simulate", "simulate_warp", WarpOptions(), ["photos", "-o", "out"],
        [
            *COMMON,
            (["--camera", "c.json"], {"camera": "c.json"}),
            (["--readout", "left-to-right"], {"readout": "left-to-right"}),
            (["--sigma", "0.1"], {"sigma_rad": 0.1}),
            (["--motion", "motion.json"], {"motion": {"a": [1.0, 2.0, 3.0]}}),
            (["--acceleration", "0.5"], {"acceleration": 0.5}),
            (["--vibration", "2"], {"vibration": Vibration(2e-3)}),
            (["--vibration", "2", "--vibration-periods", "3", "4"], {"vibration": Vibration(2e-3, (3.0, 4.0))}),
            (["--vibration", "2", "--vibration-axis", "x"], {"vibration": Vibration(2e-3, axis="x")}),
            (["--gyro", "log.csv"], {"gyro": GyroLog([0, 1], [[1, 2, 3]] * 2)}),
            (["--gyro", "log.csv", "--gyro-axes", "YZX"], {"gyro": GyroLog([0, 1], [[2, 3, 1]] * 2)}),
            (
                ["--gyro", "log.csv", "--readout-ms", "20"],
                {"gyro": GyroLog([0, 1], [[1, 2, 3]] * 2), "readout_s": 0.02},
            ),
            (["--still", "a.jpg", "--still", "b.jpg"], {"still": ("a.jpg", "b.jpg")}),
            (["--crop"], {"crop": True}),
            (["--quality", "80"], {"quality": 80}),
            (["--overwrite"], {"overwrite": True}),
        ],
    ),
    (
        simulate.scene, "rsundistort.simulate", "simulate_scene", SceneOptions(), ["recipe.json", "-o", "out"],
        [COMMON[1], (["--no-depth"], {"depth": False}), (["--overwrite"], {"overwrite": True})],
    ),
    (
        experiment.one, "rsundistort.experiments", "experiment_one", OneOptions(), ["scene.npz", "-o", "out"],
        [
            *COMMON,
            (["--trials", "3"], {"trials": 3}),
            (["--motion", "rotation"], {"translation": 0.0}),
            (["--method", "rs", "--method", "rotation"], {"methods": ("rs", "rotation")}),
        ],
    ),
    (
        experiment.two, "rsundistort.experiments", "experiment_two", TwoOptions(), ["still", "swung", "-o", "out"],
        [
            *COMMON,
            (["--camera", "c.json"], {"camera": "c.json"}),
            (["--readout", "left-to-right"], {"readout": "left-to-right"}),
            (["--model", "rotation"], {"shutter_model": "rotation"}),
            (["--overwrite"], {"overwrite": True}),
        ],
    ),
]  # fmt: skip


class Seen(Exception):
    """Carries what a command calls its function with."""


@pytest.fixture
def call_of(monkeypatch, tmp_path):
    """What a command calls its function with: options by part, and arguments as ""."""
    monkeypatch.chdir(tmp_path)
    for name in ("lengths.csv", "log.csv", "t.csv"):
        Path(name).write_text("photo1,x1,y1,photo2,x2,y2,length,sigma\n" + "a,1,2,,3,4,5,0.1\n" * 2)
    Path("gcp.csv").write_text("name,photo,x,y,E,N,U,sigma_m\nP,a,1,2,3,4,5,0.1\nP,b,6,7,,,,\n")
    Path("s.json").write_text("{}")

    def call(name, *arguments):
        command, package, function, required = COMMANDS[name]

        def stop(*given, **named):
            raise Seen(inspect.signature(function).bind(*given, **named))

        monkeypatch.setattr(sys.modules[package], function.__name__, stop)
        result = CliRunner().invoke(command, [*required, *arguments])
        assert isinstance(result.exception, Seen), result.output
        found = result.exception.args[0]
        found.apply_defaults()
        found = {**found.arguments}
        if name == "run":
            found |= {part: getattr(found["options"], part) for part in ("solve", "rectify", "outputs")}
        parts = {part: as_plain(found[part]) for part in DEFAULTS[name]}
        return {**parts, "": {key: found[key] for key in arguments_of(name)}}

    return call


def arguments_of(name):
    """Arguments of the function that options set."""
    return [field for _, changed in PARTS[name][""] for field in changed]


def as_plain(options):
    """Fields in a form that compares."""
    plain = {each.name: json.dumps(getattr(options, each.name), default=repr) for each in fields(options)}
    return {key: value for key, value in plain.items() if key not in ("solve", "rectify", "outputs")}


def untouched(name):
    """What a command calls its function with where no option is given."""
    signature = inspect.signature(COMMANDS[name][2]).parameters
    parts = {part: as_plain(each) for part, each in DEFAULTS[name].items()}
    return {**parts, "": {key: signature[key].default for key in arguments_of(name)}}


@pytest.mark.parametrize("name", COMMANDS)
def test_defaults_are_those_of_the_fields(name, call_of):
    assert call_of(name) == untouched(name)


@pytest.mark.parametrize(("name", "part", "arguments", "changed"), TRIED)
def test_an_option_sets_its_field_and_no_other(name, part, arguments, changed, call_of):
    expected = untouched(name)
    expected[part] = as_plain(replace(DEFAULTS[name][part], **changed)) if part else expected[part] | changed
    assert call_of(name, *arguments) == expected


@pytest.mark.parametrize(("name", "part", "arguments", "changed"), TRIED)
def test_the_default_that_help_shows_is_that_of_the_field(name, part, arguments, changed):
    (field,) = changed
    option = next(each for each in COMMANDS[name][0].params if arguments[-2:][0] in [*each.opts, *each.secondary_opts])
    shown = option.to_info_dict()["default"]
    if shown is None:  # without a default the library is not passed any
        return
    kept = getattr(DEFAULTS[name][part], field) if part else untouched(name)[part][field]
    if field == "gyro":
        kept = GyroOptions("log.csv").offset_s
    elif field == "view":
        kept = getattr(kept, option.name)
    assert shown == kept


@pytest.mark.parametrize(("command", "module", "function", "options", "required", "tried"), OTHERS)
def test_options_of_other_commands_set_their_fields(
    command, module, function, options, required, tried, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    Path("log.csv").write_text("time_s,wx,wy,wz\n0,1,2,3\n1,1,2,3\n")
    Path("motion.json").write_text('{"a": [1, 2, 3]}')

    def stop(*given, **named):
        raise Seen(*(each for each in given if isinstance(each, type(options))))

    monkeypatch.setattr(sys.modules[module], function, stop)

    def call(*arguments):
        result = CliRunner().invoke(command, [*required, *arguments])
        assert isinstance(result.exception, Seen), result.output
        return as_plain(result.exception.args[0])

    assert call() == as_plain(options)
    for arguments, changed in tried:
        assert call(*arguments) == as_plain(replace(options, **changed))
    named = [each for each in command.params if isinstance(each, click.Option)]
    flags = {flag for arguments, _ in tried for flag in arguments}
    untried = {each.name for each in named if not flags & {*each.opts, *each.secondary_opts}}
    assert untried <= NOT_OPTIONS
    for option in named:
        kept = [getattr(options, next(iter(fields))) for arguments, fields in tried if arguments[0] in option.opts]
        shown = option.to_info_dict()["default"]
        if shown is not None and kept and option.name != "motion":  # which has a name of its own for two fields
            assert shown == kept[0]


@pytest.mark.parametrize(
    ("arguments", "options", "jobs"),
    [
        ([], RunOptions(), 0),
        (["--camera", "c.json"], RunOptions(camera="c.json"), 0),
        (["--readout", "left-to-right"], RunOptions(solve=SolveOptions(readout="left-to-right")), 0),
        (["--readout-ms", "20"], RunOptions(solve=SolveOptions(readout_s=0.02)), 0),
        (["--gyro", "log.csv"], RunOptions(gyro=GyroOptions(Path("log.csv"))), 0),
        (["--seed", "3"], RunOptions(solve=SolveOptions(seed=3)), 0),
        (["--jobs", "2"], RunOptions(), 2),
    ],
)
def test_options_of_readout_set_their_fields(arguments, options, jobs, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("clip.mp4", "log.csv"):
        Path(name).touch()

    def stop(video, given, progress, *, jobs):
        raise Seen(given, jobs)

    monkeypatch.setattr(sys.modules["rsundistort.solve"], "measure_readout", stop)
    result = CliRunner().invoke(readout_command, ["clip.mp4", *arguments])
    assert result.exception.args == (options, jobs)


def test_known_motions_set_their_field(call_of, tmp_path):
    (tmp_path / "known.csv").write_text("name,phi1,phi2,phi3,sigma\na.jpg,0.01,0,0,0.001\n")
    for name, part in (("run", "solve"), ("solve", "options")):
        (known,) = json.loads(call_of(name, "--known", "known.csv")[part]["known"]).items()
        assert known[0] == "a.jpg"
        assert "0.01" in str(known[1])


@pytest.mark.parametrize("name", COMMANDS)
def test_help_lists_every_option_under_a_heading(name):
    command = COMMANDS[name][0]
    text = command.get_help(click.Context(command, help_option_names=["-h", "--help"]))
    headings = re.findall(r"^(\S.*):$", text, re.MULTILINE)
    assert headings[0] == "Options for a first run"
    assert set(headings) <= set(SECTIONS)
    listed = [name for names in SECTIONS.values() for name in names]
    options = [each for each in command.params if isinstance(each, click.Option)]
    assert len(listed) == len(set(listed))
    assert {each.name for each in options} <= {*listed}
    for option in options:
        assert re.search(rf"^  .*{option.opts[0]}\b", text, re.MULTILINE)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_tried(name):
    flags = {flag for of, _, arguments, _ in TRIED if of == name for flag in arguments if flag.startswith("--")}
    options = [each for each in COMMANDS[name][0].params if isinstance(each, click.Option)]
    untried = [each.name for each in options if not (flags | {"--known"}) & {*each.opts, *each.secondary_opts}]
    assert not {*untried} - NOT_OPTIONS


@pytest.mark.parametrize(("name", "part"), [(name, part) for name, parts in DEFAULTS.items() for part in parts])
def test_every_field_has_an_option(name, part):
    tried = {field for _, changed in PARTS[name][part] for field in changed}
    assert {each.name for each in fields(DEFAULTS[name][part])} - WITHOUT_OPTION == tried - WITHOUT_OPTION


@pytest.mark.parametrize(
    ("kind", "given", "says"),
    [
        (
            RunOptions,
            {"shutter_model": "rotation"},
            "RunOptions has no 'shutter_model', which is a field of SolveOptions",
        ),
        (RunOptions, {"quality": 90}, "RunOptions has no 'quality', which is a field of RectifyOptions"),
        (SolveOptions, {"report": False}, "SolveOptions has no 'report', which is a field of OutputOptions"),
        (SolveOptions, {"jobs": 2}, "SolveOptions has no 'jobs', which is an argument of run and solve"),
    ],
)
def test_an_option_that_moved_is_refused_with_its_place(kind, given, says):
    with pytest.raises(InputError, match=f"^{says}$"):
        kind(**given)
    with pytest.raises(TypeError, match="unexpected keyword argument 'no_such'"):
        kind(no_such=1)
