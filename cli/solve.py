"""`rsundistort solve`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .closing import close
from .solve_options import parts_of, solve_options
from .terminal import Talk, errors_for_people, progress_bars


@click.command()
@click.argument("model", type=opt.LocalPath(path_type=Path))
@opt.out_option
@click.option(
    "--images",
    type=opt.LocalPath(exists=True, file_okay=False, path_type=Path),
    help="Folder of the photos that the model names; without it none are rectified.",
)
@click.option(
    "--database",
    type=click.Path(path_type=Path),
    metavar="DB",
    help="COLMAP's database behind the model: matches in it that the shutter spoiled are tried again with the motions "
    "found, and the tracks rebuilt.",
)
@solve_options
@opt.talk_options
def command(
    model: Path, out: Path, images: Path | None, database: Path | None, given: dict[str, Any], talk: Talk
) -> None:
    """Find how the camera moved during each photo's readout, from a model of another program.

    MODEL is the folder of a COLMAP model, text or binary, OpenMVG's sfm_data.json, OpenSfM's reconstruction.json with
    tracks.csv beside it, an OPF project, or Metashape's cameras.xml, for which the photos are measured. OUT gets what
    `rsundistort run` writes; images/ and masks/ if --images says where the photos are. Cameras of the model are the
    groups of --readout: --readout "camera 1=left-to-right".
    """
    with errors_for_people(opt.GOES_ON) as warned, progress_bars(talk) as progress:
        from rsundistort.solve import solve

        solving, rectify, outputs = parts_of(given)
        solution = solve(
            model, out, solving, rectify=rectify, outputs=outputs, images=images, database=database, progress=progress,
            **given,
        )  # fmt: skip
    close(solution, out, warned, talk)
