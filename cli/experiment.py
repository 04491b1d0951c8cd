"""`rsundistort experiment`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .terminal import Talk, errors_for_people, progress_bars, table, tell


@click.group()
def command() -> None:
    """Repeat the experiments of the paper, with its methods and with those of this project."""


@command.command()
@click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
@opt.out_option
@opt.gathered(
    "given",
    click.option("--trials", type=click.IntRange(min=1), default=100, help="Number of trials per scene."),
    click.option(
        "--motion",
        type=click.Choice(("both", "rotation")),
        default="both",
        help="Simulated motion: rotation and translation, as in the paper, or rotation only.",
    ),
    click.option("--method", "methods", multiple=True, metavar="NAME", help="Run this method only. May be repeated."),
    opt.seed_option,
    opt.jobs_option,
)
@opt.quiet_option
def one(scenes: tuple[Path, ...], out: Path, given: dict[str, Any], quiet: bool) -> None:
    """Compare methods of bundle adjustment on synthetic measurements.

    SCENES are .npz files, COLMAP models or folders of runs. The command writes trials.jsonl, summary.json, summary.csv
    and histograms.png. Trials that OUT already holds are not repeated.
    """
    with errors_for_people("the same command continues"), progress_bars(Talk(quiet)) as progress:
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
        help="Model of the shutter of the photos in SWUNG, as for `run`.",
    ),
    opt.seed_option,
    opt.jobs_option,
    opt.overwrite_option,
)
@opt.quiet_option
def two(still: Path, swung: Path, out: Path, given: dict[str, Any], quiet: bool) -> None:
    """Compare camera positions of real photos taken in motion with those of photos taken at rest.

    STILL and SWUNG are folders of photos with the same names. Both photos of a pair are taken from one place by one
    camera. The command writes the outputs of three runs (still/, swung/ and, without a shutter model, swung-global/),
    summary.json, photos.csv and paths.png.
    """
    with errors_for_people(), progress_bars(Talk(quiet)) as progress:
        from rsundistort.experiments import TwoOptions, experiment_two

        summary = experiment_two(still, swung, out, TwoOptions(**given), progress)
    if not quiet:
        tell(_comparison(summary, out))


def _comparison(summary: dict[str, Any], out: Path) -> str:
    """Errors with and without the shutter model, and the photos that were not registered."""
    rows = [["", "mean", "median", "worst"]]
    for label, metric in (("position error, baselines", "position"), ("rotation error, deg", "rotation_deg")):
        for kind in ("without", "with"):
            v = summary[f"{kind}_shutter_model"][metric]
            numbers = (f"{v[part]:.4f}" for part in ("mean", "median", "max"))
            rows.append([f"{label}, {kind} a shutter model", *numbers])
    counts = ", ".join(f"{key} {count}" for key, count in summary["registered"].items())
    lines = [
        table(rows),
        "",
        f"shutter model      {summary['shutter_model']}",
        f"photos registered  {counts} of {summary['photos']}; {summary['compared']} compared",
    ]
    for key, lost in summary["not_registered"].items():
        lines += [f"  {key}: {name} not registered: {reason}" for name, reason in lost.items()]
    return "\n".join([*lines, f"outputs            {out}"])
