"""What `readout` says of a video, and how it is reported."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from rsundistort_cli.main import cli

from rsundistort import (
    GyroOptions,
    RunOptions,
    SolveOptions,
)
from rsundistort.errors import InputError
from rsundistort.report.facts import readout_facts
from rsundistort.solve import MeasuredReadout
from rsundistort.verdict.judge_path import problem_of

STATED = {
    "seconds": 0.0205, "sigma": 0.0003, "source": "the video", "of_frame": 0.615, "frames": 90,
    "halves": [{"seconds": 0.0206, "sigma": 0.0005}, {"seconds": 0.0204, "sigma": 0.0005}],
    "stabilisation": {"verdict": "none", "reason": "not stabilised"},
}  # fmt: skip


def test_the_readout_time_is_reported_with_its_evidence():
    facts = dict(readout_facts(STATED))
    assert facts["readout time"] == "20.5 +- 0.3 ms (0.61 of the frame), measured from the video"
    assert facts["its halves say"] == "20.6 +- 0.5 ms and 20.4 +- 0.5 ms"
    gyro = {"axes": "yxz", "offset_s": -0.0177, "offset_sigma_s": 0.0002, "correlation": 0.9991, "rotation_ratio": 1.0}
    facts = dict(readout_facts({**STATED, "source": "what was known before", "gyroscope": gyro, "halves": []}))
    assert facts["readout time"].endswith("(0.61 of the frame), what was known before")
    assert facts["gyroscope"] == "axes yxz, offset -17.7 +- 0.2 ms, correlation 0.999"
    assert "its halves say" not in facts
    # of two frames each
    facts = dict(readout_facts({**STATED, "halves": [{"seconds": 0.02, "sigma": float("inf")}] * 2}))
    assert facts["its halves say"].startswith("20.0 ms, of unknown standard deviation and")


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({}, ""),
        ({"stabilisation": {"verdict": "stabilised", "reason": "stabilised: why"}}, "stabilised: why"),
        ({"stands": True, "sigma": 0.1}, "the camera hardly moves"),
        ({"source": "what was known before"}, "does not determine it better than it was known before"),
        ({"sigma": 0.007}, "the camera moved too little: 20.5 +- 7.0 ms"),
        (
            {"halves": [{"seconds": 0.030, "sigma": 0.0005}, {"seconds": 0.0204, "sigma": 0.0005}]},
            "contradict each other, 14 standard deviations apart",
        ),
        ({"unfollowed_px": 2.0}, "the frames rotate by 2.0 px more than their path explains"),
        ({"share_that_fits": 0.5}, "the poses fit only 50 % of what key frames share: something large moves"),
        ({"seconds": 0.04, "of_frame": 1.2}, "longer than the time from frame to frame"),
        ({"unbounded_seconds": 0.0345, "sigma": 0.001}, ""),
        ({"unbounded_seconds": 0.0345, "sigma": 0.004}, "it would be 34 +- 4 ms, longer than the time from frame to"),
        (
            {"seconds": -0.0205, "of_frame": -0.615},
            "the last line is read first (--readout), the video runs backwards, or",
        ),
    ],
)
def test_readout_says_whether_the_video_tells(tmp_path, monkeypatch, changed, says):
    stated = {**STATED, **changed}
    found = MeasuredReadout(stated["seconds"], stated["sigma"], stated["of_frame"], problem_of(stated), stated)
    assert found.measured is (not says)
    monkeypatch.setattr(sys.modules["rsundistort.solve"], "measure_readout", lambda *_, **__: found)
    (tmp_path / "clip.mp4").write_bytes(b"")
    result = CliRunner().invoke(cli, ["readout", str(tmp_path / "clip.mp4")])
    as_json = CliRunner().invoke(cli, ["readout", str(tmp_path / "clip.mp4"), "--json"])
    assert result.exit_code == as_json.exit_code == (3 if says else 0)
    assert says in " ".join(result.stdout.split())
    assert max(map(len, result.stdout.splitlines())) <= 80
    assert json.loads(as_json.stdout) == {"measured": not says, "problem": found.problem, **stated, "warnings": []}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ([], RunOptions()),
        (["--camera", "c.json"], RunOptions(camera="c.json")),
        (["--readout", "left-to-right"], RunOptions(solve=SolveOptions(readout="left-to-right"))),
        (["--readout-ms", "20"], RunOptions(solve=SolveOptions(readout_s=0.02))),
        (["--seed", "3"], RunOptions(solve=SolveOptions(seed=3))),
        (["--gyro", "clip.mp4"], RunOptions(gyro=GyroOptions(Path("clip.mp4")))),
    ],
)
def test_options_of_readout_set_those_of_a_run(tmp_path, monkeypatch, given, expected):
    seen = []

    def stop(video, options, progress, jobs):
        seen.append((video, options, jobs))
        raise InputError("seen")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys.modules["rsundistort.solve"], "measure_readout", stop)
    Path("clip.mp4").write_bytes(b"")
    CliRunner().invoke(cli, ["readout", "clip.mp4", "--jobs", "2", *given])
    assert seen == [(Path("clip.mp4"), expected, 2)]
