"""Options that several commands share: one flag, one meaning."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from .terminal import Talk, errors_for_people

# as in `model`, `rectify` and `input`: not to be imported for --help
READOUT_NAMES = ("top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left")
INTERPOLATION_NAMES = ("cubic", "linear", "lanczos", "nearest")
MAP_KIND_NAMES = ("npz", "exr", "stmap")
FRAMES_NAMES = ("key", "all")
MATCHING_NAMES = ("auto", "exhaustive", "neighbours")
EXPORT_NAMES = ("metashape", "ncore", "nuke", "opensfm", "opf", "opf-rectified")

#: What an interruption leaves of a work that can be gone on with.
GOES_ON = "what is done is whole, the same command with --resume continues"


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
    "-o", "--out", type=LocalPath(path_type=Path), required=True, help="Folder that the outputs are written to."
)
camera_option: Decorator = click.option(
    "--camera",
    metavar="FILE|FOLDER|NUMBERS",
    help="Calibration of the camera: camera.json, cameras.json, a calibration of OpenCV, ROS or Kalibr, COLMAP "
    "cameras, a text file with the 3x3 matrix K, a folder of such files named by group, or "
    "fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]. "
    "By default it is camera.json or cameras.json in or beside PHOTOS, else EXIF, else the focal length that the "
    "photos show.",
)
readout_option: Decorator = click.option(
    "--readout", type=click.Choice(READOUT_NAMES), help="Direction of the readout in the stored pixels."
)
seed_option: Decorator = click.option("--seed", type=click.IntRange(min=0), default=0, help="Seed of all random draws.")
jobs_option: Decorator = click.option(
    "--jobs", type=click.IntRange(min=0), default=0, help="Number of threads. 0 uses all cores."
)
overwrite_option: Decorator = click.option(
    "--overwrite", is_flag=True, help="Replace the files that rsundistort wrote in OUT. Other files stay."
)


def resume_option(text: str) -> Decorator:
    """`--resume`, in the words of a command."""
    return click.option("--resume", is_flag=True, help=text)


def check_resume(given: dict[str, Any]) -> None:
    """Refuse to begin anew and go on at once."""
    if given.get("overwrite") and given.get("resume"):
        raise click.UsageError("--overwrite begins anew and --resume continues; give one of them")


scheduler_option: Decorator = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Process the photos on the workers of a Dask cluster (tcp://host:8786). The workers must see PHOTOS and OUT "
    "under the same paths or URLs.",
)
progress_option: Decorator = click.option(
    "--progress",
    "progress_form",
    type=click.Choice(("bar", "json")),
    default="bar",
    help="Form of the progress. json prints JSON lines, and nothing else, on stdout, for other programs.",
)
json_option: Decorator = click.option(
    "--json", "as_json", is_flag=True, help="Print one JSON object at the end instead of the closing table."
)
quiet_option: Decorator = click.option("-q", "--quiet", is_flag=True, help="Print warnings and errors only.")
verbose_option: Decorator = click.option(
    "-v", "--verbose", is_flag=True, help="Print a line for each step, even if stderr is not a terminal."
)
quality_option: Decorator = click.option(
    "--quality", type=click.IntRange(1, 100), default=98, help="Quality of JPEG and WebP."
)
gyro_axes_option: Decorator = click.option(
    "--gyro-axes",
    metavar="XYZ",
    help="Axes of the gyroscope that point right, down and ahead in the stored pixels. Small letters stand for "
    "reversed axes.",
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


def gathered(name: str, *options: Decorator) -> Decorator:
    """Options whose values the command gets as one mapping of those that were given: defaults are the library's."""

    def with_options(function: Callable[..., Any]) -> Callable[..., Any]:
        return functools.reduce(lambda inner, option: option(inner), reversed(options), function)

    keys = [str(each.name) for each in click.command()(with_options(lambda: None)).params]

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def with_mapping(*args: Any, **named: Any) -> Any:
            source = click.get_current_context().get_parameter_source
            values = {key: named.pop(key) for key in keys}
            given = {key: value for key, value in values.items() if source(key) is not ParameterSource.DEFAULT}
            return function(*args, **named, **{name: given})

        return with_options(with_mapping)

    return decorate


#: What is done to each photo; for `rectify_options`.
PHOTO_OPTIONS: tuple[Decorator, ...] = (
    click.option(
        "--depth",
        metavar="auto|infinity|plane|points|DIR",
        default="auto",
        help="Depth of the scene. It matters if the camera travelled during the readout. plane: a plane through the "
        "scene; points: interpolated between the reconstructed points; DIR: depth maps of your own (a.npy, .npz or "
        "float .tif for a.jpg, see docs/depth.md).",
    ),
    click.option(
        "--alpha",
        metavar="keep|0..1",
        callback=view_alpha,
        help="View of the rectified photos. keep: K, as it was found, and size of the raw photos; 0: no photo of a "
        "camera has an empty pixel; 1: every pixel of all its photos is kept; numbers between are views between "
        "these. The default is the view of the solution, whose pixels stay as near to the raw ones as they can.",
    ),
    click.option(
        "--scale",
        type=click.FloatRange(min=0, min_open=True),
        help="Size of the rectified photos relative to the raw ones. Photos that shrink are averaged. The default is "
        "that of the solution, 1 for a new one.",
    ),
    click.option(
        "--max-size",
        type=click.IntRange(min=2),
        metavar="PIXELS",
        help="Largest width or height of the rectified photos.",
    ),
    click.option(
        "--interpolation",
        type=click.Choice(INTERPOLATION_NAMES),
        default="cubic",
        help="Interpolation of the rectified photos.",
    ),
    quality_option,
    click.option(
        "--raw-as",
        type=click.Choice(("tif", "jpg", "png")),
        default="tif",
        help="Format in which RAW and HEIC photos are written. jpg has 8 bits, the others have 16.",
    ),
    click.option(
        "--apply-orientation",
        is_flag=True,
        help="Rotate photos, masks, cameras and poses by the EXIF orientation. By default the tag is copied instead.",
    ),
    click.option("--again", is_flag=True, help="Accept photos that rsundistort has rectified before."),
    click.option(
        "--max-pixels",
        "max_megapixels",
        type=click.FloatRange(min=0, min_open=True),
        default=250.0,
        metavar="MILLIONS",
        help="Leave out photos with more pixels. (A small file can claim to be a huge picture.)",
    ),
    click.option(
        "--maps",
        type=click.Choice(MAP_KIND_NAMES),
        help="Write the map of each photo and its inverse into OUT/maps, as NumPy arrays (npz), as OpenEXR in pixels "
        "(exr), or as the ST map of compositing programs (stmap). exr and stmap need the extra exr.",
    ),
    click.option(
        "--also",
        multiple=True,
        metavar="FOLDER[=INTERPOLATION]",
        callback=also_folders,
        help="Rectify other images of the same frames with the same maps (a.png for a.jpg), such as labels, depth or "
        "near infrared. The default interpolation is nearest, which invents no values. May be repeated.",
    ),
)


def check_needed(given: dict[str, Any], option: str, needing: dict[str, str]) -> None:
    """Refuse options, by their keys, that say nothing without another one which was not given."""
    if alone := [name for key, name in needing.items() if key in given]:
        raise click.UsageError(f"{alone[0]} is for {option}; give {option} too, or leave {alone[0]} out")


def taken(given: dict[str, Any], kind: type) -> Any:
    """Options of a kind, of its fields among what was given; these are taken out."""
    return kind(**{key: given.pop(key) for key in [*given] if key in kind.__dataclass_fields__})  # type: ignore[attr-defined]


def rectify_options(given: dict[str, Any]) -> Any:
    """`RectifyOptions` of what was given; it is taken out."""
    from rsundistort.batch import RectifyOptions
    from rsundistort.rectify import ViewOptions

    given["view"] = taken(given, ViewOptions)
    return taken(given, RectifyOptions)
