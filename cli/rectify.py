"""`rsundistort rectify`."""

from __future__ import annotations

from pathlib import Path

import click

from . import options as opt
from .terminal import errors_for_people, progress_bars


@click.command()
@opt.photos_argument
@click.option(
    "--solution",
    type=click.Path(path_type=Path),
    required=True,
    help="solution.json, or a ground-truth file.",
)
@opt.out_option
@click.option(
    "--masks",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder of masks, a.png for a.jpg: what is black in them is black in OUT/masks.",
)
@opt.view_options
@click.option(
    "--maps",
    type=click.Choice(opt.MAP_KIND_NAMES),
    help="Write each photo's map and its inverse into OUT/maps: NumPy (npz), OpenEXR in pixels, or the ST map of "
    "compositing programs (extra exr).",
)
@click.option(
    "--also",
    multiple=True,
    metavar="FOLDER[=INTERPOLATION]",
    callback=opt.also_folders,
    help="Rectify other images of the same frames alike (a.png for a.jpg): labels, depth, near infrared; by nearest, "
    "which makes up no values, or as told. May be repeated.",
)
@opt.depth_option
@opt.interpolation_option
@opt.quality_option
@opt.raw_as_option
@opt.apply_orientation_option
@opt.again_option
@opt.max_pixels_option
@opt.jobs_option
@opt.overwrite_option
@opt.quiet_option
def command(
    photos: Path,
    solution: Path,
    out: Path,
    masks: Path | None,
    alpha: float | str | None,
    scale: float,
    max_size: int | None,
    maps: str | None,
    also: tuple[tuple[Path, str], ...],
    depth: str,
    interpolation: str,
    quality: int,
    raw_as: str,
    apply_orientation: bool,
    again: bool,
    max_megapixels: float,
    jobs: int,
    overwrite: bool,
    quiet: bool,
) -> None:
    """Rectify the photos of a folder with the motions of a solution."""
    with errors_for_people(), progress_bars(quiet) as progress:
        from rsundistort.pipeline import rectify_folder
        from rsundistort.rectify import ViewOptions

        solved, left_out = rectify_folder(
            photos, solution, out,
            interpolation=interpolation, quality=quality, jobs=jobs, overwrite=overwrite, masks=masks,
            progress=progress, depth=depth, raw_as=raw_as, apply_orientation=apply_orientation, again=again,
            max_megapixels=max_megapixels, view=ViewOptions(alpha, scale, max_size), maps=maps, also=also,
        )  # fmt: skip
    if not quiet:
        count = len(list((out / "images").iterdir()))
        done = f"{count} photo{'s' * (count != 1)} rectified with the {solved.shutter_model} model"
        click.echo(f"{done}, {len(left_out)} left out: {out}")
