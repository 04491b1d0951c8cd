"""Options that several commands share: one flag, one meaning."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from .terminal import Talk, errors_for_people

# as in `model`, `rectify` and `pipeline`: not to be imported for --help
READOUT_NAMES = ("top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left")
INTERPOLATION_NAMES = ("cubic", "linear", "lanczos", "nearest")
MAP_KIND_NAMES = ("npz", "exr", "stmap")
MATCHING_NAMES = ("auto", "exhaustive", "neighbours")


class LocalPath(click.Path):
    """A path, also as a file:// URL; other URLs are refused."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if isinstance(value, str) and "://" in value:
            with errors_for_people():
                from rsundistort.io.places import local_place

                value = local_place(value)
        return super().convert(value, param, ctx)


class PathOrUrl(click.Path):
    """A path, or a URL as it is."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if isinstance(value, str) and "://" in value else super().convert(value, param, ctx)


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


def view_alpha(_context: click.Context, _option: click.Parameter, value: str | None) -> float | str | None:
    """A number from 0 to 1, or keep."""
    if value in (None, "keep"):
        return value
    try:
        alpha = float(value)
    except ValueError:
        alpha = -1.0
    if not 0.0 <= alpha <= 1.0:
        raise click.BadParameter(f"{value!r} is neither keep nor a number from 0 to 1")
    return alpha


def also_folders(
    context: click.Context, option: click.Parameter, value: tuple[str, ...]
) -> tuple[tuple[Path, str], ...]:
    """Folders and their interpolation, of FOLDER or FOLDER=INTERPOLATION; nearest makes up no values."""
    found = []
    for text in value:
        folder, _, name = text.rpartition("=")
        if name not in INTERPOLATION_NAMES:
            folder, name = text, "nearest"
        found.append((LocalPath(path_type=Path).convert(folder, option, context), name))
    return tuple(found)


Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

photos_argument: Decorator = click.argument("photos", type=LocalPath(path_type=Path))
out_option: Decorator = click.option(
    "-o", "--out", type=LocalPath(path_type=Path), required=True, help="Folder for the outputs."
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
    "under the same paths or URLs.",
)
progress_option: Decorator = click.option(
    "--progress",
    "progress_form",
    type=click.Choice(("bar", "json")),
    default="bar",
    show_default=True,
    help="json: lines on stdout for other programs, and nothing else there.",
)
report_option: Decorator = click.option(
    "--report/--no-report", default=True, help="Write OUT/report.html; rsundistort report makes it later, too."
)
json_option: Decorator = click.option(
    "--json", "as_json", is_flag=True, help="One JSON object on stdout at the end, instead of what is for people."
)
quiet_option: Decorator = click.option("-q", "--quiet", is_flag=True, help="Nothing but warnings and errors.")
verbose_option: Decorator = click.option(
    "-v", "--verbose", is_flag=True, help="A line for each step, also where stderr is no terminal."
)
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
readout_groups_option: Decorator = click.option(
    "--readout",
    multiple=True,
    metavar="[GROUP=]DIRECTION",
    callback=readout_by_group,
    help=f"Direction of the readout in the stored pixels: {', '.join(READOUT_NAMES)}; of all photos, or of a "
    "group (as the closing table names it). By default the camera file's, else guessed and settled by the photos.",
)
masks_option: Decorator = click.option(
    "--masks",
    type=LocalPath(exists=True, file_okay=False, path_type=Path),
    help="Folder of masks, a.png for a.jpg: what is black in them is not looked at, nor kept in OUT/masks.",
)
model_option: Decorator = click.option(
    "--model",
    "shutter_model",
    type=click.Choice(("auto", "constant-motion", "rotation", "linearized", "two-step", "global")),
    default="auto",
    show_default=True,
    help="How the shutter is modelled; auto is the model that foretells measurements held out from its fit.",
)
refine_option: Decorator = click.option(
    "--refine",
    metavar="NAMES",
    help="Intrinsics to solve for with the rest: some of f (or fx, fy), cx, cy, k1, k2, p1, p2, k3 (of a "
    "fisheye k1 to k4) with commas between, or none. By default none of a camera that was given, f,k1,k2 of one that "
    "EXIF guessed.",
)
still_option: Decorator = click.option(
    "--still",
    "--anchor",
    multiple=True,
    metavar="NAME[=MRAD]",
    help="A photo known not to have moved: its phi1 is held at zero, or near zero with so many mrad per frame of "
    "standard deviation. May be repeated.",
)
known_option: Decorator = click.option(
    "--known",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="CSV",
    help="Motions known from elsewhere: name, phi1, phi2, phi3 (rad per frame; or omega1.. in rad/s) and sigma.",
)
lengths_option: Decorator = click.option(
    "--lengths",
    "--length",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="CSV",
    help="Lengths measured in the scene, two or more: photo1, x1, y1, photo2, x2, y2, length, sigma.",
)
readout_ms_option: Decorator = click.option(
    "--readout-ms",
    type=click.FloatRange(min=0, min_open=True),
    help="Time of the readout of a frame. Default: the gyroscope's log, or a table of cameras.",
)
remedy_option: Decorator = click.option(
    "--remedy",
    type=click.Choice(("auto", "prior", "none")),
    default="auto",
    show_default=True,
    help="Where all cameras are level: auto looks for a photo that did not move, prior takes the motions to be zero "
    "in the mean, none does neither.",
)
depth_option: Decorator = click.option(
    "--depth",
    metavar="auto|infinity|plane|points|DIR",
    default="auto",
    show_default=True,
    help="How far away what the photos show is, which matters where the camera travelled during the readout: on a "
    "plane, as the known points, or as maps of your own (a.npy, .npz or float .tif for a.jpg: docs/depth.md).",
)
sparse_format_option: Decorator = click.option(
    "--sparse-format",
    type=click.Choice(("bin", "txt")),
    default="bin",
    show_default=True,
    help="How the COLMAP model is written.",
)
rs_poses_option: Decorator = click.option(
    "--rs-poses",
    is_flag=True,
    help="OUT/rs-poses: the original photos' cameras and poses with the shutter, for gsplat, instant-ngp and "
    "3dgs-deblur (docs/outputs.md).",
)
interpolation_option: Decorator = click.option(
    "--interpolation", type=click.Choice(INTERPOLATION_NAMES), default="cubic", show_default=True
)


def talk_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """How much the command says: it gets one `Talk`."""

    @functools.wraps(function)
    def with_talk(*args: Any, progress_form: str, as_json: bool, quiet: bool, verbose: bool, **named: Any) -> Any:
        if quiet and verbose:
            raise click.UsageError("--quiet and --verbose contradict each other")
        return function(*args, talk=Talk(quiet, verbose, as_json, progress_form), **named)

    decorated: Callable[..., Any] = with_talk
    for option in (verbose_option, quiet_option, json_option, progress_option):
        decorated = option(decorated)
    return decorated


def view_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """What rectified photos show, and how large they are."""
    for option in (
        click.option(
            "--max-size", type=click.IntRange(min=2), metavar="PIXELS", help="Longest side of the rectified photos."
        ),
        click.option(
            "--scale",
            type=click.FloatRange(min=0, min_open=True),
            default=1.0,
            show_default=True,
            help="Size of the rectified photos in that of the raw ones; what shrinks is averaged.",
        ),
        click.option(
            "--alpha",
            metavar="keep|0..1",
            callback=view_alpha,
            help="keep: K and size of the raw photos; 0: no empty pixel in any photo of a camera; 1: every pixel of "
            "all of them is kept; between: between. Default: keep, or as the solution has it.",
        ),
    ):
        function = option(function)
    return function


def names_between_commas(refine: str | None) -> tuple[str, ...] | None:
    """Names between commas; () for none, None where nothing was said."""
    if refine is None:
        return None
    names = tuple(name.strip() for name in refine.split(",") if name.strip())
    return () if names == ("none",) else names


def anchors(still: tuple[str, ...]) -> dict[str, float]:
    """Photos and their standard deviations, radians per frame, of NAME or NAME=MRAD."""
    from rsundistort import InputError

    anchors: dict[str, float] = {}
    for text in still:
        name, equals, number = text.rpartition("=")
        try:
            sigma = float(number) / 1e3 if equals else 0.0
        except ValueError:  # a name with = in it
            name, sigma = text, 0.0
        if not equals:
            name = text
        if equals and not sigma > 0 and name != text:
            raise InputError(f"--still {text}: the standard deviation must be positive")
        if anchors.get(name, sigma) != sigma:
            raise InputError(f"--still {name} is named twice, with different standard deviations")
        anchors[name] = sigma
    return anchors
