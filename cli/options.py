"""Options that several commands share: one flag, one meaning."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

# as `rsundistort.model.READOUTS` and `rsundistort.rectify.INTERPOLATIONS`, which must not be imported for --help
READOUT_NAMES = ("top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left")
INTERPOLATION_NAMES = ("cubic", "linear", "lanczos", "nearest")


def readout_by_group(
    _context: click.Context, _option: click.Parameter, value: tuple[str, ...]
) -> dict[str, str] | None:
    """Directions by group, the empty name for all others, of DIRECTION or GROUP=DIRECTION."""
    directions: dict[str, str] = {}
    for text in value:
        group, _, direction = text.rpartition("=")
        if direction not in READOUT_NAMES:
            raise click.BadParameter(f"{direction!r} is not one of {', '.join(READOUT_NAMES)}")
        if directions.setdefault(group, direction) != direction:
            raise click.BadParameter(f"{text!r}: another direction was given before")
    return directions or None


Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

photos_argument: Decorator = click.argument("photos", type=click.Path(path_type=Path))
out_option: Decorator = click.option(
    "-o", "--out", type=click.Path(path_type=Path), required=True, help="Folder for the outputs."
)
camera_option: Decorator = click.option(
    "--camera",
    metavar="FILE|FOLDER|NUMBERS",
    help="camera.json, cameras.json, OpenCV or ROS calibration, COLMAP cameras, a text file with the 3x3 matrix K, a "
    "folder of such files named by group, or fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]. "
    "Default: camera.json or cameras.json in or beside PHOTOS, else EXIF.",
)
readout_option: Decorator = click.option(
    "--readout", type=click.Choice(READOUT_NAMES), help="Direction of the readout in the stored pixels."
)
seed_option: Decorator = click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
jobs_option: Decorator = click.option(
    "--jobs", type=click.IntRange(min=0), default=0, help="Threads; 0, the default, takes all cores."
)
overwrite_option: Decorator = click.option("--overwrite", is_flag=True, help="Replace outputs that are in OUT.")
scheduler_option: Decorator = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Work on photos by the workers of the Dask cluster at tcp://host:8786; they see PHOTOS and OUT "
    "under the same paths.",
)
progress_option: Decorator = click.option(
    "--progress",
    "progress_form",
    type=click.Choice(("bar", "json")),
    default="bar",
    show_default=True,
    help="json: lines on stdout for other programs, and nothing else there.",
)
quiet_option: Decorator = click.option("-q", "--quiet", is_flag=True, help="Nothing but warnings and errors.")
quality_option: Decorator = click.option(
    "--quality", type=click.IntRange(1, 100), default=98, show_default=True, help="Of JPEG and WebP."
)
raw_as_option: Decorator = click.option(
    "--raw-as",
    type=click.Choice(("tif", "jpg", "png")),
    default="tif",
    show_default=True,
    help="What RAW and HEIC are written as; jpg has 8 bits, the others 16.",
)
apply_orientation_option: Decorator = click.option(
    "--apply-orientation",
    is_flag=True,
    help="Turn photos, masks, cameras and poses by the EXIF orientation, which otherwise is carried along.",
)
again_option: Decorator = click.option("--again", is_flag=True, help="Take photos that are rectified already.")
max_pixels_option: Decorator = click.option(
    "--max-pixels",
    "max_megapixels",
    type=click.FloatRange(min=0, min_open=True),
    default=250.0,
    show_default=True,
    metavar="MILLIONS",
    help="Photos with more pixels are left out: a small file can claim to be a huge picture.",
)
interpolation_option: Decorator = click.option(
    "--interpolation", type=click.Choice(INTERPOLATION_NAMES), default="cubic", show_default=True
)
