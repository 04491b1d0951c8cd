"""`rsundistort readout`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import options as opt
from .closing import fitted
from .terminal import SOME_FAILED, Talk, errors_for_people, progress_bars, say_json, tell

if TYPE_CHECKING:
    from rsundistort.solve import MeasuredReadout

_measure_options = opt.gathered(
    "given",
    opt.camera_option,
    opt.readout_option,
    click.option(
        "--readout-ms",
        type=click.FloatRange(min=0, min_open=True),
        help="A readout time in milliseconds that is known to 2 %. The result differs from it only if the video is "
        "more exact.",
    ),
    click.option(
        "--gyro",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="FILE",
        help="Log of a gyroscope, as for `run`. Its axes and its clock offset are estimated. By default the log in the "
        "video is used.",
    ),
    opt.seed_option,
    opt.jobs_option,
)


@click.command()
@click.argument("video", type=opt.LocalPath(exists=True, dir_okay=False, path_type=Path))
@_measure_options
@opt.talk_options
def command(video: Path, given: dict[str, Any], talk: Talk) -> None:
    """Measure the readout time of a camera from a video that it took. Nothing is written.

    VIDEO is any clip of a static scene. The camera should shake, rotate or travel. Its video stabilisation must be
    off.

    Exit code 3 means that the readout time cannot be measured from this video. The reason is printed.
    """
    with errors_for_people(needed_gb=2.0) as warned, progress_bars(talk) as progress:
        from rsundistort.input import GyroOptions
        from rsundistort.solve import RunOptions, SolveOptions, measure_readout

        gyro = GyroOptions(given.pop("gyro")) if "gyro" in given else None
        jobs, camera = given.pop("jobs", 0), given.pop("camera", None)
        if "readout_ms" in given:
            given["readout_s"] = given.pop("readout_ms") / 1e3
        options = RunOptions(solve=SolveOptions(**given), gyro=gyro, camera=camera)
        found = measure_readout(video, options, progress, jobs=jobs)
    if talk.as_json:
        say_json({**found.to_json(), "warnings": list(warned)})
    elif talk.to_people:
        tell("\n".join(_lines(found)))
    if not found.measured:
        sys.exit(SOME_FAILED)


def _lines(found: MeasuredReadout) -> list[str]:
    from rsundistort.report import readout_facts

    facts = [*readout_facts(found.evidence), ("frames", str(found.evidence["frames"]))]
    if found.problem:
        facts[0] = ("readout time", f"not measured: {found.problem}")
    return [part for label, text in facts for part in fitted(f"{label:<19}{text}")]
