"""`rsundistort simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .terminal import Talk, errors_for_people, progress_bars, table, tell


@click.group()
def command() -> None:
    """Make photos with a known shutter motion, and the truth to judge results by."""


@command.command()
@opt.photos_argument
@opt.out_option
@opt.gathered(
    "given",
    opt.camera_option,
    opt.readout_option,
    click.option(
        "--sigma",
        "sigma_rad",
        type=click.FloatRange(min=0),
        default=0.05,
        show_default=True,
        help="Standard deviation of the rotation over the frame, radians.",
    ),
    click.option(
        "--motion",
        type=click.Path(path_type=Path),
        help="JSON {name: [phi1, phi2, phi3]} in radians per unit of the clock, instead of random motion; or rotations "
        "by row: CSV with name, row, rx, ry, rz, or JSON {name: {row: [...], rotation: [[rx, ry, rz], ...]}}.",
    ),
    click.option(
        "--acceleration",
        type=click.FloatRange(min=0),
        default=0.0,
        show_default=True,
        help="Standard deviation of what the rate of turn changes by over half a frame, as a share of itself.",
    ),
    click.option(
        "--vibration",
        type=click.FloatRange(min=0),
        metavar="MRAD",
        help="Amplitude of a vibration, on top of the motion.",
    ),
    click.option(
        "--vibration-periods",
        "periods",
        type=float,
        nargs=2,
        default=(2.0, 5.0),
        show_default=True,
        help="Periods of the vibration a frame: drawn between these.",
    ),
    click.option(
        "--vibration-axis",
        "axis",
        type=click.Choice(["random", "x", "y", "z"]),
        default="random",
        show_default=True,
        help="Axis of the camera that it turns about.",
    ),
    click.option(
        "--gyro",
        type=click.Path(path_type=Path),
        help="Stretches of a gyroscope's log instead of random motion: CSV with time_s, wx, wy, wz, or Gyroflow's "
        ".gcsv.",
    ),
    click.option(
        "--gyro-axes",
        metavar="XYZ",
        help="Axes of the gyroscope that point right, down and ahead in the stored pixels; small letters are reversed.",
    ),
    click.option(
        "--readout-ms",
        type=click.FloatRange(min=0, min_open=True),
        help="How long a frame is read, in the time of --gyro. Default: what the log says.",
    ),
    click.option("--still", multiple=True, metavar="NAME", help="A photo that does not move."),
    click.option(
        "--crop",
        is_flag=True,
        help="Cut all photos to the largest rectangle that every one fills, and the originals alike into global/.",
    ),
    opt.quality_option,
    opt.seed_option,
    opt.jobs_option,
    opt.overwrite_option,
)
@opt.quiet_option
def warp(photos: Path, out: Path, given: dict[str, Any], quiet: bool) -> None:
    """Warp real photos as if a rotating camera had taken them.

    OUT gets photos/, masks/ (what the originals hold), camera.json and ground_truth.json; with --crop also global/,
    and camera and truth of the cut photos. --sigma is of the whole frame, also with --crop, and so is what is not
    steady.
    """
    with errors_for_people(), progress_bars(Talk(quiet)) as progress:
        from rsundistort.io import read_gyro
        from rsundistort.simulate import WarpOptions, read_motion_file, simulate_warp
        from rsundistort.synthetic import Vibration

        axes, amplitude = given.pop("gyro_axes", None), given.pop("vibration", None)
        shaking = {key: given.pop(key) for key in ("periods", "axis") if key in given}
        if "motion" in given:
            given["motion"] = read_motion_file(given["motion"])
        if "gyro" in given:
            given["gyro"] = read_gyro(given["gyro"], axes)
        if "readout_ms" in given:
            given["readout_s"] = given.pop("readout_ms") / 1e3
        if amplitude:
            given["vibration"] = Vibration(amplitude / 1e3, **shaking)
        truth = simulate_warp(photos, out, WarpOptions(**given), progress)
    if not quiet:
        rows = [("photo", "shift px"), *((image.name, f"{image.rs_shift_px:.1f}") for image in truth.images)]
        size = f"\n\nsize     {truth.cameras['1'].width}x{truth.cameras['1'].height}" if given.get("crop") else "\n"
        tell(f"{table(rows)}{size}\noutputs  {out}")


@command.command()
@click.argument("recipe", type=click.Path(path_type=Path))
@opt.out_option
@opt.gathered(
    "given",
    click.option("--depth/--no-depth", default=True, show_default=True, help="Write depth maps."),
    opt.jobs_option,
    opt.overwrite_option,
)
@opt.quiet_option
def scene(recipe: Path, out: Path, given: dict[str, Any], quiet: bool) -> None:
    """Render the rolling-shutter photos of a scene, with everything that is true about them.

    OUT gets photos/ (or clip.mp4, if the recipe's path is that of a video), global/ (the twins), depth/, global-depth/,
    tracks.npz, camera.json (cameras.json if there are several), ground_truth.json and the recipe.
    """
    with errors_for_people(), progress_bars(Talk(quiet)) as progress:
        from rsundistort.simulate import SceneOptions, simulate_scene

        truth = simulate_scene(recipe, out, SceneOptions(**given), progress)
    if not quiet:
        rows = [("photo", "shift px"), *((image.name, f"{image.rs_shift_px:.1f}") for image in truth.images)]
        tell(f"{table(rows)}\n\noutputs  {out}")
