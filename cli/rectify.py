"""`rsundistort rectify`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .sections import Sectioned
from .terminal import Talk, errors_for_people, list_failed, progress_bars, say_json, tell


@click.command(cls=Sectioned)
@click.argument("photos", type=opt.PathOrUrl(path_type=Path))
@click.option(
    "--solution",
    type=opt.LocalPath(path_type=Path),
    required=True,
    help="solution.json of a run, or ground_truth.json of a simulation.",
)
@click.option(
    "-o",
    "--out",
    type=opt.PathOrUrl(path_type=Path),
    required=True,
    help="Folder or URL that the outputs are written to.",
)
@opt.gathered(
    "given",
    click.option(
        "--masks",
        type=opt.PathOrUrl(exists=True, file_okay=False, path_type=Path),
        help="Folder of masks (a.png for a.jpg). Their black pixels are black in OUT/masks.",
    ),
    *opt.PHOTO_OPTIONS,
    opt.jobs_option,
    opt.scheduler_option,
    opt.overwrite_option,
    opt.resume_option("Continue an interrupted batch. Outputs in OUT that are complete and current are kept."),
)
@opt.talk_options
def command(photos: Path | str, solution: Path, out: Path | str, given: dict[str, Any], talk: Talk) -> None:
    """Rectify the photos of a folder with the motions of a solution.

    PHOTOS, OUT and the masks are folders, given by path or by a URL that fsspec supports (s3://bucket/folder,
    gs://...). Exit code 3 means that some photos failed. They are listed, and all others are complete.
    """
    opt.check_resume(given)
    with errors_for_people(opt.GOES_ON) as warned, progress_bars(talk) as progress:
        from rsundistort.batch import rectify_folder
        from rsundistort.batch.folder import photos_of

        options = opt.rectify_options(given)
        solved, left_out = rectify_folder(photos, solution, out, options, progress=progress, **given)
        # others may lie in OUT/images, too
        count = len({*photos_of(photos, solved, options.raw_as)} - left_out.keys())
    # the solution itself names the photos that it could not register
    known = {image.name for image in solved.images if not image.registered}
    failed = {name: why for name, why in left_out.items() if name not in known}
    if talk.as_json:
        summary = {"out": str(out), "rectified": count, "shutter_model": solved.shutter_model, "left_out": left_out}
        say_json({**summary, "warnings": warned})
    elif talk.to_people:
        done = f"{count} photo{'s' * (count != 1)} rectified with the {solved.shutter_model} model"
        tell(f"{done}, {len(left_out)} left out: {out}")
    list_failed(failed, talk)
