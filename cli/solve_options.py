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
        help=f"Direction of the readout in the stored pixels: {', '.join(opt.READOUT_NAMES)}. It applies to all "
        "photos, or to one group, as the closing table names it. By default the direction is taken from the camera "
        "file, or guessed and then decided by the measurements.",
    ),
    click.option(
        "--masks",
        type=opt.LocalPath(exists=True, file_okay=False, path_type=Path),
        help="Folder of masks (a.png for a.jpg). Black pixels are not measured, and they are black in OUT/masks.",
    ),
    click.option(
        "--model",
        "shutter_model",
        type=click.Choice(("auto", "constant-motion", "rotation", "linearized", "two-step", "global")),
        default="auto",
        help="Model of the shutter. auto chooses the model that best predicts measurements held out from its fit.",
    ),
    click.option(
        "--refine",
        metavar="NAMES",
        help="Intrinsics to refine: names among f (or fx, fy), cx, cy, k1, k2, p1, p2, k3 (of a fisheye k1 to k4), "
        "with commas between them, or none. By default all are refined, with priors as wide as the usual errors of a "
        "calibration or of EXIF.",
    ),
    click.option(
        "--camera-sigma",
        metavar="NAME=SIGMA,...",
        help="Standard deviations of the given intrinsics: of f (or fx, fy), cx and cy in pixels, and of k1, k2, k3, "
        "p1 and p2. By default they are those of the key sigma of camera.json, else the usual errors of a calibration.",
    ),
    click.option(
        "--still",
        "--anchor",
        multiple=True,
        metavar="NAME[=MRAD]",
        help="A photo that is known not to have moved. Its phi1, or its whole motion if the cameras travel, is "
        "constrained to zero, or to zero with a standard deviation of MRAD per frame. May be repeated.",
    ),
    click.option(
        "--known",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="CSV",
        help="Motions that are known from elsewhere: name, phi1, phi2, phi3 in rad per frame (or omega1, omega2, "
        "omega3 in rad/s), and sigma.",
    ),
    click.option(
        "--lengths",
        "--length",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="CSV",
        help="Two or more lengths that were measured in the scene: photo1, x1, y1, photo2, x2, y2, length, sigma.",
    ),
    click.option(
        "--crs",
        metavar="CRS",
        help="Coordinate system of poses and points. local: metres east, north and up, by the GPS of the photos; "
        "EPSG:...: projected coordinates in metres; none: an arbitrary frame. The default is local if the GPS of "
        "three photos fits; solve keeps the frame of the model.",
    ),
    click.option(
        "--gcp",
        "control",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="CSV",
        help="Control points in the coordinate system of --crs: name, photo, x, y, E, N, U, sigma, and use (control or "
        "check).",
    ),
    click.option(
        "--readout-ms",
        type=click.FloatRange(min=0, min_open=True),
        help="Readout time of a frame in milliseconds. By default it is taken from the gyroscope's log or from a "
        "table of cameras.",
    ),
    click.option(
        "--remedy",
        type=click.Choice(("auto", "prior", "none")),
        default="auto",
        help="Remedy if all cameras are level, which is a critical motion. auto looks for a photo that did not move; "
        "prior relies on the prior of the motions alone; none does neither.",
    ),
    *opt.PHOTO_OPTIONS,
    click.option(
        "--sparse-format",
        type=click.Choice(("bin", "txt")),
        default="bin",
        help="Format of the COLMAP model: binary or text.",
    ),
    click.option(
        "--rs-poses",
        is_flag=True,
        help="Write OUT/rs-poses: cameras and poses of the original photos with their shutter, for gsplat, instant-ngp "
        "and 3dgs-deblur (see docs/outputs.md).",
    ),
    click.option(
        "--usd",
        is_flag=True,
        help="Write OUT/camera.usda for Blender: the camera of every frame of a video, and the points of the scene.",
    ),
    click.option(
        "--export",
        "exports",
        multiple=True,
        type=click.Choice(opt.EXPORT_NAMES),
        help="Write OUT/NAME for another program: metashape (cameras.xml), opensfm (a project, also for ODM), opf "
        "(Pix4D, original photos), opf-rectified (Pix4D, rectified photos), ncore (3DGUT) or nuke (camera.nk). May be "
        "repeated.",
    ),
    opt.seed_option,
    opt.jobs_option,
    opt.scheduler_option,
    opt.overwrite_option,
    opt.resume_option(
        "Continue an interrupted run of the same photos with the same options. What is finished in OUT is kept."
    ),
    click.option(
        "--report/--no-report", default=True, help="Write OUT/report.html. `rsundistort report` can write it later."
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
        if name.strip() in found:
            raise click.BadParameter(f"{name.strip()} is given twice", param_hint="--camera-sigma")
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
