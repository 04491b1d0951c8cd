"""`rsundistort simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .terminal import Talk, errors_for_people, progress_bars, table, tell

_warp_options = opt.gathered(
    "given",
    opt.camera_option,
    opt.readout_option,
    click.option(
        "--sigma",
        "sigma_rad",
        type=click.FloatRange(min=0),
        default=0.05,
        help="Standard deviation of the rotation over a frame, in radians.",
    ),
    click.option(
        "--motion",
        type=click.Path(path_type=Path),
        help="File of motions instead of random ones: JSON {name: [phi1, phi2, phi3]} in radians per unit of the "
        "clock; or rotations by row, as CSV with name, row, rx, ry, rz, or as JSON {name: {row: [...], rotation: "
        "[[rx, ry, rz], ...]}}.",
    ),
    click.option(
        "--acceleration",
        type=click.FloatRange(min=0),
        default=0.0,
        help="Standard deviation of the change of the rotation rate over half a frame, as a fraction of the rate.",
    ),
    click.option(
        "--vibration",
        type=click.FloatRange(min=0),
        metavar="MRAD",
        help="Amplitude of a vibration that is added to the motion.",
    ),
    click.option(
        "--vibration-periods",
        "periods",
        type=float,
        nargs=2,
        default=(2.0, 5.0),
        help="Range of the vibration's periods per frame; the number is drawn from it.",
    ),
    click.option(
        "--vibration-axis",
        "axis",
        type=click.Choice(["random", "x", "y", "z"]),
        default="random",
        help="Axis of the camera about which the vibration rotates it.",
    ),
    click.option(
        "--gyro",
        type=click.Path(path_type=Path),
        help="Log of a gyroscope, of which random parts are used as motions: CSV with time_s, wx, wy, wz, or a .gcsv "
        "file of Gyroflow.",
    ),
    opt.gyro_axes_option,
    click.option(
        "--readout-ms",
        type=click.FloatRange(min=0, min_open=True),
        help="Readout time of a frame in milliseconds, for --gyro. By default it is taken from the log.",
    ),
    click.option("--still", multiple=True, metavar="NAME", help="A photo that does not move. May be repeated."),
    click.option(
        "--crop",
        is_flag=True,
        help="Crop all photos to the largest rectangle that every one fills, and the originals likewise into global/.",
    ),
    opt.quality_option,
    opt.seed_option,
    opt.jobs_option,
    opt.overwrite_option,
)


@click.group()
def command() -> None:
    """Make photos with a known shutter motion, and the truth to compare results with."""


@command.command()
@opt.photos_argument
@opt.out_option
@_warp_options
@opt.quiet_option
def warp(photos: Path, out: Path, given: dict[str, Any], quiet: bool) -> None:
    """Warp real photos as if a rotating camera had taken them.

    The command writes photos/, masks/ (pixels that the originals cover), camera.json and ground_truth.json. With --crop
    it also writes global/, and camera.json and ground_truth.json describe the cropped photos. --sigma, --acceleration
    and --vibration always refer to the whole frame.
    """
    with errors_for_people(), progress_bars(Talk(quiet)) as progress:
        from rsundistort.io import read_gyro
        from rsundistort.simulate import WarpOptions, read_motion_file, simulate_warp
        from rsundistort.synthetic import Vibration

        if "gyro" not in given:
            opt.check_needed(given, "--gyro", {"gyro_axes": "--gyro-axes", "readout_ms": "--readout-ms"})
        if not given.get("vibration"):
            opt.check_needed(given, "--vibration", {"periods": "--vibration-periods", "axis": "--vibration-axis"})
        if "motion" in given and "sigma_rad" in given:
            raise click.UsageError("--motion gives the motions, and --sigma is for random ones; give one of them")
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
    click.option("--depth/--no-depth", default=True, help="Write depth maps."),
    opt.jobs_option,
    opt.overwrite_option,
)
@opt.quiet_option
def scene(recipe: Path, out: Path, given: dict[str, Any], quiet: bool) -> None:
    """Render rolling-shutter photos or a video of a scene, with the ground truth.

    The command writes photos/ (or clip.mp4, if the recipe describes a video), global/ (the global-shutter references),
    depth/, global-depth/, tracks.npz, camera.json (cameras.json if there are several), ground_truth.json and the
    recipe.
    """
    with errors_for_people(), progress_bars(Talk(quiet)) as progress:
        from rsundistort.simulate import SceneOptions, simulate_scene

        truth = simulate_scene(recipe, out, SceneOptions(**given), progress)
    if not quiet:
        rows = [("photo", "shift px"), *((image.name, f"{image.rs_shift_px:.1f}") for image in truth.images)]
        tell(f"{table(rows)}\n\noutputs  {out}")
