"""`rsundistort evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import options as opt
from .terminal import Talk, errors_for_people, progress_bars, say_json, table, tell

if TYPE_CHECKING:
    from rsundistort.analysis import Evaluation


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--truth", type=click.Path(path_type=Path), required=True, help="ground_truth.json of the simulation.")
@opt.gathered(
    "given",
    click.option("--poses", type=click.Path(path_type=Path), help="Solution whose poses are used as the true ones."),
    click.option(
        "--twins",
        type=click.Path(path_type=Path),
        help="Folder of the global-shutter references. By default it is global/ beside the truth.",
    ),
    click.option(
        "--raw",
        type=click.Path(path_type=Path),
        help="Folder of the rolling-shutter photos. By default it is photos/ beside the truth.",
    ),
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@opt.quiet_option
def command(out: Path, truth: Path, given: dict[str, Any], as_json: bool, quiet: bool) -> None:
    """Compare the outputs of a run in OUT with the ground truth of a simulation."""
    with errors_for_people(), progress_bars(Talk(quiet, as_json=as_json)) as progress:
        from rsundistort.analysis import evaluate

        result = evaluate(out, truth, progress=progress, **given)
    if as_json:
        say_json(result.to_json())
    elif not quiet:
        tell(_text(result))


def _text(result: Evaluation) -> str:
    rows = [("", "mean", "median", "worst")]
    for errors, label in (
        (result.rotation_deg, "rotation error, deg"),
        (result.center, "position error, baselines"),
        (result.phi_mrad_per_frame, "phi error, mrad per frame"),
    ):
        if errors is not None:
            rows.append((label, f"{errors.mean:.4f}", f"{errors.median:.4f}", f"{errors.max:.4f}"))
    for likeness, label in (
        (result.psnr_before_db, "raw against reference, dB"),
        (result.psnr_db, "rectified against reference, dB"),
    ):
        if likeness is not None:
            rows.append((label, "", f"{likeness.median:.2f}", f"{likeness.min:.2f}"))
    return f"{table(rows)}\n\nphotos registered  {result.registered} of {result.photos}"
