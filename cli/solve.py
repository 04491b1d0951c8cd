"""`rsundistort solve`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .closing import close
from .sections import Sectioned
from .solve_options import parts_of, solve_options
from .terminal import Talk, errors_for_people, progress_bars


@click.command(cls=Sectioned)
@click.argument("model", type=opt.LocalPath(path_type=Path))
@opt.out_option
@click.option(
    "--images",
    type=opt.LocalPath(exists=True, file_okay=False, path_type=Path),
    help="Folder of the photos that the model names. Without it no photo is rectified.",
)
@click.option(
    "--database",
    type=click.Path(path_type=Path),
    metavar="DB",
    help="COLMAP database of the model. Matches that were rejected because of the shutter are verified again with the "
    "estimated motions, and the tracks are rebuilt.",
)
@solve_options
@opt.talk_options
def command(
    model: Path, out: Path, images: Path | None, database: Path | None, given: dict[str, Any], talk: Talk
) -> None:
    """Estimate the camera motion during the readout of each photo from a model of another program.

    MODEL is the folder of a COLMAP model (text or binary), sfm_data.json of OpenMVG, reconstruction.json of OpenSfM
    with tracks.csv beside it, an OPF project, or cameras.xml of Metashape. Metashape's file has no measurements: the
    photos are measured again. The command writes what `rsundistort run` writes; images/ and masks/ need --images. The
    cameras of the model are the groups of --readout, as in --readout "camera 1=left-to-right".
    """
    with errors_for_people(opt.GOES_ON) as warned, progress_bars(talk) as progress:
        from rsundistort.solve import solve

        solving, rectify, outputs = parts_of(given)
        solution = solve(
            model, out, solving, rectify=rectify, outputs=outputs, images=images, database=database, progress=progress,
            **given,
        )  # fmt: skip
    close(solution, out, warned, talk)
