"""Options of the commands that solve: `run` and `solve`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt


def _readout_by_group(
    _context: click.Context, _option: click.Parameter, value: tuple[str, ...]
) -> dict[str, str] | None:
    """Directions by group, the empty name for all others, of DIRECTION or GROUP=DIRECTION."""
    directions: dict[str, str] = {}
    for text in value:
        group, _, direction = text.rpartition("=")
        if direction not in opt.READOUT_NAMES:
            raise click.BadParameter(f"{direction!r} is not one of {', '.join(opt.READOUT_NAMES)}")
        if directions.setdefault(group, direction) != direction:
            raise click.BadParameter(f"{text!r}: another direction was given before")
    return directions or None


#: How the motions are found, what is done to each photo and how; the command gets them as `given`, for `parts_of`.
solve_options = opt.gathered(
    "given",
    click.option(
        "--readout",
        multiple=True,
        metavar="[GROUP=]DIRECTION",
        callback=_readout_by_group,
        help=f"Direction of the readout in the stored pixels: {', '.join(opt.READOUT_NAMES)}; of all photos, or of a "
        "group (as the closing table names it). By default the camera file's, else guessed and settled by the photos.",
    ),
    click.option(
        "--masks",
        type=opt.LocalPath(exists=True, file_okay=False, path_type=Path),
        help="Folder of masks, a.png for a.jpg: what is black in them is not looked at, nor kept in OUT/masks.",
    ),
    click.option(
        "--model",
        "shutter_model",
        type=click.Choice(("auto", "constant-motion", "rotation", "linearized", "two-step", "global")),
        default="auto",
        show_default=True,
        help="How the shutter is modelled; auto is the model that foretells measurements held out from its fit.",
    ),
    click.option(
        "--refine",
        metavar="NAMES",
        help="Intrinsics to solve for with the rest: some of f (or fx, fy), cx, cy, k1, k2, p1, p2, k3 (of a "
        "fisheye k1 to k4) with commas between, or none. By default all, as far from a camera that was given, or from "
        "EXIF's guess, as these usually are off.",
    ),
    click.option(
        "--camera-sigma",
        metavar="NAME=SIGMA,...",
        help="How well the camera is known: standard deviations of some of f (or fx, fy), cx, cy in pixels, and of k1, "
        "k2, k3, p1, p2. Default: the key sigma of camera.json, else what calibrations usually are off by.",
    ),
    click.option(
        "--still",
        "--anchor",
        multiple=True,
        metavar="NAME[=MRAD]",
        help="A photo known not to have moved: its phi1, and where cameras travel its whole motion, is held at zero, "
        "or near zero with so many mrad per frame of standard deviation. May be repeated.",
    ),
    click.option(
        "--known",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="CSV",
        help="Motions known from elsewhere: name, phi1, phi2, phi3 (rad per frame; or omega1.. in rad/s) and sigma.",
    ),
    click.option(
        "--lengths",
        "--length",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="CSV",
        help="Lengths measured in the scene, two or more: photo1, x1, y1, photo2, x2, y2, length, sigma.",
    ),
    click.option(
        "--crs",
        metavar="CRS",
        help="Frame of poses and points: local, metres east, north and up by the photos' GPS; EPSG:..., a "
        "projected one in metres; none, one of their own. Default: local where three photos' GPS fits; of solve the "
        "model's.",
    ),
    click.option(
        "--gcp",
        "control",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="CSV",
        help="Control points, in the CRS: name, photo, x, y, E, N, U, sigma, and use, control or check.",
    ),
    click.option(
        "--readout-ms",
        type=click.FloatRange(min=0, min_open=True),
        help="Time of the readout of a frame. Default: the gyroscope's log, or a table of cameras.",
    ),
    click.option(
        "--remedy",
        type=click.Choice(("auto", "prior", "none")),
        default="auto",
        show_default=True,
        help="Where all cameras are level: auto looks for a photo that did not move, prior takes the motions to be "
        "zero in the mean, none does neither.",
    ),
    *opt.PHOTO_OPTIONS,
    click.option(
        "--sparse-format",
        type=click.Choice(("bin", "txt")),
        default="bin",
        show_default=True,
        help="How the COLMAP model is written.",
    ),
    click.option(
        "--rs-poses",
        is_flag=True,
        help="OUT/rs-poses: the original photos' cameras and poses with the shutter, for gsplat, instant-ngp and "
        "3dgs-deblur (docs/outputs.md).",
    ),
    click.option(
        "--usd",
        is_flag=True,
        help="Of a video: OUT/camera.usda, the camera at every frame and the points of the scene, for Blender.",
    ),
    click.option(
        "--export",
        "exports",
        multiple=True,
        type=click.Choice(opt.EXPORT_NAMES),
        help="Write OUT/NAME for another program: metashape (cameras.xml), opensfm (a project, for ODM), opf (Pix4D, "
        "the original photos) and opf-rectified, ncore (3DGUT), nuke (camera.nk). May be repeated.",
    ),
    opt.seed_option,
    opt.jobs_option,
    opt.scheduler_option,
    opt.overwrite_option,
    opt.resume_option(
        "Go on with a run of the same photos and options into OUT that ended early: what it came to is not made again."
    ),
    click.option(
        "--report/--no-report", default=True, help="Write OUT/report.html; rsundistort report makes it later, too."
    ),
)


def parts_of(given: dict[str, Any]) -> tuple[Any, Any, Any]:
    """`SolveOptions`, `RectifyOptions` and `OutputOptions` of what was given; the rest is left in it."""
    from rsundistort.io import read_control_points, read_known_lengths, read_known_motions
    from rsundistort.solve import OutputOptions, SolveOptions

    opt.check_resume(given)
    if "readout_ms" in given:
        given["readout_s"] = given.pop("readout_ms") / 1e3
    for key, read in (
        ("refine", _names_between_commas),
        ("camera_sigma", _sigmas),
        ("still", _anchors),
        ("known", lambda path: read_known_motions(path, given.get("readout_s"))),
        ("lengths", read_known_lengths),
        ("control", read_control_points),
    ):
        if key in given:
            given[key] = read(given[key])
    return opt.taken(given, SolveOptions), opt.rectify_options(given), opt.taken(given, OutputOptions)


def _names_between_commas(refine: str) -> tuple[str, ...]:
    """Names between commas; () for none."""
    names = tuple(name.strip() for name in refine.split(",") if name.strip())
    return () if names == ("none",) else names


def _sigmas(text: str) -> dict[str, float]:
    """Standard deviations by name, of NAME=SIGMA with commas between."""
    found: dict[str, float] = {}
    for each in text.split(",") if text else []:
        name, _, number = each.partition("=")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            raise click.BadParameter(
                f"{each!r}, expected NAME=SIGMA, such as f=1.5", param_hint="--camera-sigma"
            ) from None
    return found


def _anchors(still: tuple[str, ...]) -> dict[str, float]:
    """Photos and their standard deviations, radians per frame, of NAME or NAME=MRAD."""
    from rsundistort.errors import InputError

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
