"""`rsundistort report`."""

from __future__ import annotations

from pathlib import Path

import click

from . import options as opt
from .terminal import Talk, errors_for_people, progress_bars, tell


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--photos",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Folder of the original photos. By default it is looked for where it was during the run.",
)
@click.option(
    "--figures",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write figures for papers into DIR instead, as PNG and PDF: shutter models, displacement fields, camera paths "
    "and the sphere of the critical motion.",
)
@opt.jobs_option
@opt.quiet_option
def command(out: Path, photos: Path | None, figures: Path | None, jobs: int, quiet: bool) -> None:
    """Write OUT/report.html again from the outputs of a run in OUT.

    The report names what is missing, such as photos that were moved, and shows the rest.
    """
    with errors_for_people(), progress_bars(Talk(quiet)) as progress:
        from rsundistort.report import write_figures, write_report

        if figures is not None:
            written = write_figures(out, figures)
        else:
            written = [write_report(out, photos, jobs=jobs, progress=progress)]
    if not quiet:
        tell("\n".join(str(path) for path in written))
