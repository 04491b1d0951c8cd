"""`rsundistort analyze`."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import click

from . import options as opt
from .terminal import errors_for_people, say_json, tell

if TYPE_CHECKING:
    from rsundistort.analysis import PoseAnalysis


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
@opt.readout_option
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
def command(path: Path, readout: str | None, as_json: bool) -> None:
    """Check whether the shutter and the shape of the scene can be distinguished from these camera poses.

    PATH is a solution (solution.json, or the folder of a run), a COLMAP model, or a transforms.json. The degeneracy
    measure is near zero where the poses are a critical motion.
    """
    with errors_for_people():
        from rsundistort.analysis import analyze

        result = analyze(path, readout)
    if as_json:
        say_json(result.to_json())
    else:
        tell(_text(result))


def _text(result: PoseAnalysis) -> str:
    degeneracy = result.degeneracy
    values = ", ".join(f"{value:.3f}" for value in degeneracy.singular_values)
    ds, da, *p = degeneracy.null_vector
    lines = [
        f"photos             {result.photos}, readout {', '.join(result.readout)}",
        f"degeneracy         {degeneracy.value:.3f} of {values}",
        f"y axes             {degeneracy.y_axis_spread_deg:.1f} degrees apart (root mean square)",
        f"hidden best        skew {ds:.2f}, aspect {da:.2f}, plane at infinity {', '.join(f'{x:.2f}' for x in p)}",
        f"confounded         {degeneracy.meaning}",
    ]
    if result.sentence:
        lines += ["", *textwrap.wrap(result.sentence, 80)]
    if result.advice:
        lines += ["", "at the next shoot:"]
        for each in result.advice:
            lines += textwrap.wrap(each, 80, initial_indent="  ", subsequent_indent="    ")
    return "\n".join(lines)
