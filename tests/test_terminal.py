"""What a person sees in a terminal, and what other programs get."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from rsundistort_cli.closing import closing_table, summary
from rsundistort_cli.main import cli
from rsundistort_cli.terminal import Talk, progress_bars

from rsundistort import Camera, RowMotion, Solution, SolvedImage

# a program that says what a run says: stages, what the package logs, a warning, an error
TALKER = """
import logging, sys, warnings
from rsundistort_cli.terminal import Talk, errors_for_people, progress_bars
from rsundistort.errors import InputError, RsUndistortWarning
with errors_for_people(), progress_bars(Talk(verbose="-v" in sys.argv, quiet="-q" in sys.argv)) as progress:
    progress("features", 0, 10)
    progress("features", 10, 10)
    progress("model sequence: global", 0, 0)
    progress("model sequence: rotation", 0, 0)
    logging.getLogger("rsundistort").info("compiling kernels")
    warnings.warn("take another photo", RsUndistortWarning)
    progress("writing", 0, 0)
    raise InputError("no photos; give another folder")
"""


def solution(names, reason=None, advice=(), features="auto", stages=(), why="shares too little with the other photos"):
    camera = Camera(4000, 3000, [[3000, 0, 1999.5], [0, 3000, 1499.5], [0, 0, 1]], [0.01, -0.02, 0, 0])
    images = [
        SolvedImage(
            name, "1", np.eye(3), np.array([i, 0, 0]), RowMotion([0.01, 0.02, 0.03]), np.full(3, 1e-3), 123456, 0.123,
            345.6, reason=reason,
        )
        for i, name in enumerate(names)
    ]  # fmt: skip
    images.append(SolvedImage("lost.jpg", "1", reason=why))
    return Solution(
        "constant-motion",
        {"1": camera},
        {"1": camera.pinhole()},
        images,
        quality={
            "rms_px": 0.2,
            "global_rms_px": 12.3,
            "held_out_error": {"global": 12.345, "two-step": 1.234, "rotation": 1.23, "constant-motion": 1.35},
            "held_out_gain": {"two-step": 123.45, "rotation": 1.2, "constant-motion": -4.5},
            "held_out_kept": ["global", "two-step"],
            "sigma_intrinsics": {"1": {"f": 1.0, "k1": 0.001, "k2": 0.002, "cx": 1.0, "cy": 1.0}},
            "phi_sigma_rad_per_frame": 0.03,
            "readout_times": {"1": {"ms": 30.0, "source": "the table of readout times, a phone of some maker"}},
        },
        critical_motion={
            "flagged": True,
            "sigma_log_k": 0.1,
            "remedy": "prior",
            "sentence": "The height of the scene is uncertain by 10 %, " * 4,
            "advice": list(advice),
        },
        options={
            "camera": "EXIF, refined",
            "readout": "top-to-bottom",
            "guesses": ["the direction of the readout is a guess of the size of the photos " * 2],
            "features": features,
        },
        stages=[{"name": name, "seconds": 1.5} for name in ("features", *stages)],
    )


def in_a_terminal(code, *args, environment=None):
    """What a program writes on stderr, if that is a terminal."""
    ours, theirs = pty.openpty()
    said = []

    def read():
        while True:
            try:
                data = os.read(ours, 4096)
            except OSError:
                return
            if not data:
                return
            said.append(data)

    with subprocess.Popen(
        [sys.executable, "-c", code, *args], stdout=subprocess.PIPE, stderr=theirs,
        env={**os.environ, "TERM": "xterm", **(environment or {})},
    ) as process:  # fmt: skip
        os.close(theirs)
        reader = threading.Thread(target=read)
        reader.start()
        process.wait(timeout=60)
        reader.join(timeout=10)
    os.close(ours)
    return b"".join(said).decode(), process.returncode


def test_closing_table_tells_what_the_model_was_chosen_by():
    assert (
        "held-out error global 12.345, two-step 1.234 (better by 123.5 standard errors), rotation 1.230 "
        "(better by 1.2: not kept), constant-motion 1.350 (worse by 4.5: not kept) camera"
    ) in " ".join(closing_table(solution(["0001.jpg"]), Path("out")).split())


def test_closing_table_says_whose_lens_it_is_where_there_are_several():
    one = solution(["a.jpg", "b.jpg", "c.jpg"])
    assert " of a.jpg" not in closing_table(one, Path("out"))
    other = replace(one.cameras["1"], K=np.diag([2000.0, 2000.0, 1.0]))
    images = [replace(each, camera_id="2") if each.name == "c.jpg" else each for each in one.images]
    quality = one.quality | {"sigma_intrinsics": {key: {"f": 1.0} for key in "12"}, "readout_times": {}}
    two = replace(one, cameras={**one.cameras, "2": other}, images=images, quality=quality)
    said = " ".join(closing_table(two, Path("out")).split())
    assert "refined of a.jpg and 1 other: f 3000.0 +- 1.0 refined of c.jpg: f 2000.0 +- 1.0" in said


def test_closing_table_fits_80_columns():
    names = ["0001.jpg", f"{'a' * 90}.jpg", "sub/folder/of/many/levels/photo with a long name.jpg"]
    text = closing_table(
        solution(names, advice=["Take a photo rotated by 90 degrees about the line of sight " * 3]), Path("out")
    )
    assert max(len(line) for line in text.splitlines()) <= 80
    for said in ("3 of 4", "constant-motion", "lost.jpg", "At the next shoot", "f 3000.0 +- 1.0"):
        assert said in text


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ({}, True),
        ({"features": "affine"}, False),
        ({"features": None}, False),  # of a video, or a model
        ({"stages": ["affine features"]}, False),
        ({"why": "shows another scene"}, False),
    ],
)
def test_other_features_are_named_where_they_may_register_photos(told, says):
    assert ("--features affine" in closing_table(solution(["a.jpg"], **told), Path("out"))) == says


def test_summary_says_what_the_table_says():
    found = json.loads(json.dumps(summary(solution(["a.jpg"], reason="it vanished"), Path("out"), ["beware"])))
    assert found["out"] == "out"
    assert (found["photos"], found["registered"]) == (2, 1)
    assert found["shift_px"] == {"median": 345.6, "largest": 345.6}
    assert found["not_joined"] == {"lost.jpg": "shares too little with the other photos"}
    assert found["failed"] == {"a.jpg": "it vanished"}
    assert found["critical_motion"]["flagged"] is True
    assert found["warnings"] == ["beware"]


def test_stages_errors_and_warnings_in_a_terminal():
    said, code = in_a_terminal(TALKER)
    assert code == 1
    for stage in ("features", "model sequence", "writing"):
        assert stage in said
    assert "model sequence: rotation" not in said
    assert "\ncompiling kernels" in said
    assert "\x1b[33mwarning: take another photo" in said
    assert "\x1b[31merror: no photos; give another folder" in said


def test_no_color_is_kept():
    said, _ = in_a_terminal(TALKER, environment={"NO_COLOR": "1"})
    assert "warning: take another photo" in said
    assert "\x1b[3" not in said


def test_verbose_tells_steps_and_quiet_only_what_went_wrong():
    said, _ = in_a_terminal(TALKER, "-v")
    assert "model sequence: rotation" in said
    quiet, _ = in_a_terminal(TALKER, "-q")
    assert "model sequence" not in quiet
    assert "compiling" not in quiet
    assert "warning: " in quiet


def test_without_a_terminal_there_are_lines_only_if_asked_for(capsys):
    for talk, lines in ((Talk(), 0), (Talk(verbose=True), 2), (Talk(quiet=True), 0)):
        with progress_bars(talk) as progress:
            progress("model sequence: global", 0, 0)
            progress("model sequence: rotation", 0, 0)
        assert len(capsys.readouterr().err.splitlines()) == lines


def test_quiet_and_verbose_contradict(tmp_path):
    result = CliRunner().invoke(cli, ["run", str(tmp_path), "-o", str(tmp_path / "out"), "-q", "-v"])
    assert result.exit_code == 2
    assert "contradict" in result.stderr


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete(shell):
    script = CliRunner().invoke(cli, ["completion", shell])
    assert script.exit_code == 0
    assert "_RSUNDISTORT_COMPLETE" in script.stdout


def test_commands_and_flags_are_completed():
    command = Path(sys.executable).with_name("rsundistort")
    for words, expected in (("rsundistort so", "solve"), ("rsundistort run --inter", "--interpolation")):
        place = str(len(words.split()) - 1)
        done = subprocess.run(
            [command], capture_output=True, text=True, check=False, timeout=60,
            env={**os.environ, "_RSUNDISTORT_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": place},
        )  # fmt: skip
        assert expected in done.stdout


def test_info_names_optional_parts():
    found = json.loads(CliRunner().invoke(cli, ["info", "--json"]).stdout)
    assert {"dask", "exr", "heif", "mesh", "video", "figures"} <= set(found["extras"])
    assert "dev" not in found["extras"]
    text = CliRunner().invoke(cli, ["info"]).stdout
    assert "optional part" in text
    assert "rsundistort" in text
