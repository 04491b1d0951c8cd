"""`rsundistort experiment`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .terminal import Talk, errors_for_people, progress_bars, table, tell


@click.group()
def command() -> None:
    """Repeat the paper's experiments, with its methods and ours."""


@command.command()
@click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
@opt.out_option
@opt.gathered(
    "given",
    click.option("--trials", type=click.IntRange(min=1), default=100, show_default=True, help="Trials a scene."),
    click.option(
        "--motion",
        type=click.Choice(("both", "rotation")),
        default="both",
        show_default=True,
        help="Rotation and translation as in the paper, or rotation only.",
    ),
    click.option("--method", "methods", multiple=True, metavar="NAME", help="Only this method; may be repeated."),
    opt.seed_option,
    opt.jobs_option,
)
@opt.quiet_option
def one(scenes: tuple[Path, ...], out: Path, given: dict[str, Any], quiet: bool) -> None:
    """Bundle adjustment of synthetic measurements of SCENES (.npz, COLMAP models, outputs of runs).

    OUT gets trials.jsonl, summary.json, summary.csv and histograms.png; trials that it already holds are not repeated.
    """
    with errors_for_people("the same command goes on where it was"), progress_bars(Talk(quiet)) as progress:
        from rsundistort.experiments import OneOptions, experiment_one

        if given.pop("motion", None) == "rotation":
            given["translation"] = 0.0
        summary = experiment_one(scenes, out, OneOptions(**given), progress)
    if not quiet:
        rows = [("scene", "method", "rotation deg", "translation", "structure", "iterations")]
        for scene, found in summary.items():
            for method, metrics in found.items():
                numbers = (metrics[m]["median"] for m in ("rotation_deg", "translation", "structure"))
                rows.append((scene, method, *(f"{v:.4f}" for v in numbers), f"{metrics['iterations']['median']:.0f}"))
        tell(f"{table(rows)}\n\nmedians; outputs  {out}")


@command.command()
@click.argument("still", type=click.Path(path_type=Path))
@click.argument("swung", type=click.Path(path_type=Path))
@opt.out_option
@opt.gathered(
    "given",
    opt.camera_option,
    opt.readout_option,
    click.option(
        "--model",
        "shutter_model",
        type=click.Choice(("auto", "constant-motion", "rotation", "linearized", "two-step")),
        default="auto",
        show_default=True,
        help="How the shutter of SWUNG is modelled, as in run.",
    ),
    opt.seed_option,
    opt.jobs_option,
    opt.overwrite_option,
)
@opt.quiet_option
def two(still: Path, swung: Path, out: Path, given: dict[str, Any], quiet: bool) -> None:
    """Camera positions of real photos taken in motion, against those of photos taken still.

    STILL and SWUNG are folders of photos with the same names, each pair taken from one place by one camera. OUT gets
    the outputs of three runs (still/, swung/ and, without a shutter model, swung-global/), summary.json, photos.csv
    and paths.png.
    """
    with errors_for_people(), progress_bars(Talk(quiet)) as progress:
        from rsundistort.experiments import TwoOptions, experiment_two

        summary = experiment_two(still, swung, out, TwoOptions(**given), progress)
    if not quiet:
        tell(_comparison(summary, out))


def _comparison(summary: dict[str, Any], out: Path) -> str:
    """Errors with and without the shutter model, and which photos were joined."""
    rows = [["", "mean", "median", "worst"]]
    for label, metric in (("position error, baselines", "position"), ("rotation error, deg", "rotation_deg")):
        for kind in ("without", "with"):
            v = summary[f"{kind}_shutter_model"][metric]
            numbers = (f"{v[part]:.4f}" for part in ("mean", "median", "max"))
            rows.append([f"{label}, {kind} a shutter model", *numbers])
    joined = ", ".join(f"{key} {count}" for key, count in summary["registered"].items())
    lines = [
        table(rows),
        "",
        f"shutter model      {summary['shutter_model']}",
        f"photos registered  {joined} of {summary['photos']}; {summary['compared']} compared",
    ]
    for key, lost in summary["not_registered"].items():
        lines += [f"  {key}: {name} not joined: {reason}" for name, reason in lost.items()]
    return "\n".join([*lines, f"outputs            {out}"])
