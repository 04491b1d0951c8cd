"""`rsundistort experiment`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .terminal import errors_for_people, progress_bars, table


@click.group()
def command() -> None:
    """Repeat the paper's experiments, with its methods and ours."""


@command.command()
@click.argument("scenes", nargs=-1, required=True, type=click.Path(path_type=Path))
@opt.out_option
@click.option("--trials", type=click.IntRange(min=1), default=100, show_default=True, help="Trials a scene.")
@click.option(
    "--motion",
    type=click.Choice(("both", "rotation")),
    default="both",
    show_default=True,
    help="Rotation and translation as in the paper, or rotation only.",
)
@click.option("--method", "methods", multiple=True, metavar="NAME", help="Only this method; may be repeated.")
@opt.seed_option
@opt.jobs_option
@opt.quiet_option
def one(
    scenes: tuple[Path, ...],
    out: Path,
    trials: int,
    motion: str,
    methods: tuple[str, ...],
    seed: int,
    jobs: int,
    quiet: bool,
) -> None:
    """Bundle adjustment of synthetic measurements of SCENES (.npz, COLMAP models, outputs of runs).

    OUT gets trials.jsonl, summary.json, summary.csv and histograms.png; trials that it already holds are not repeated.
    """
    with errors_for_people(), progress_bars(quiet) as progress:
        from rsundistort.experiments import OneOptions, experiment_one

        kinds: dict[str, Any] = {"methods": methods} if methods else {}
        if motion == "rotation":
            kinds["translation"] = 0.0
        summary = experiment_one(scenes, out, OneOptions(trials=trials, seed=seed, jobs=jobs, **kinds), progress)
    if not quiet:
        rows = [("scene", "method", "rotation deg", "translation", "structure", "iterations")]
        for scene, found in summary.items():
            for method, metrics in found.items():
                numbers = (metrics[m]["median"] for m in ("rotation_deg", "translation", "structure"))
                rows.append((scene, method, *(f"{v:.4f}" for v in numbers), f"{metrics['iterations']['median']:.0f}"))
        click.echo(f"{table(rows)}\n\nmedians; outputs  {out}")
