"""`rsundistort evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from . import options as opt
from .terminal import Talk, errors_for_people, progress_bars, table


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--truth", type=click.Path(path_type=Path), required=True, help="ground_truth.json.")
@click.option("--poses", type=click.Path(path_type=Path), help="A solution to take the true poses from.")
@click.option("--twins", type=click.Path(path_type=Path), help="Global-shutter photos. Default: global/ by the truth.")
@click.option("--raw", type=click.Path(path_type=Path), help="Photos before. Default: photos/ by the truth.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@opt.quiet_option
def command(
    out: Path,
    truth: Path,
    poses: Path | None,
    twins: Path | None,
    raw: Path | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Compare the outputs of a run, in the folder OUT, with the truth."""
    with errors_for_people(), progress_bars(Talk(quiet, as_json=as_json)) as progress:
        from rsundistort.analysis import evaluate

        result = evaluate(out, truth, poses=poses, twins=twins, raw=raw, progress=progress)
    if as_json:
        click.echo(json.dumps(result))
    elif not quiet:
        click.echo(_text(result))


def _text(result: dict[str, Any]) -> str:
    rows = [("", "mean", "median", "worst")]
    for key, label in (
        ("rotation_deg", "rotation error, deg"),
        ("center", "position error, baselines"),
        ("phi_mrad_per_frame", "phi error, mrad per frame"),
    ):
        if key in result:
            v = result[key]
            rows.append((label, f"{v['mean']:.4f}", f"{v['median']:.4f}", f"{v['max']:.4f}"))
    for key, label in (("psnr_before_db", "raw against twin, dB"), ("psnr_db", "rectified against twin, dB")):
        if key in result:
            v = result[key]
            rows.append((label, "", f"{v['median']:.2f}", f"{v['min']:.2f}"))
    return f"{table(rows)}\n\nphotos registered  {result['registered']} of {result['photos']}"
