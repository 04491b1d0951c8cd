"""`rsundistort run`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .closing import close
from .sections import Sectioned
from .solve_options import parts_of, solve_options
from .terminal import Talk, errors_for_people, progress_bars

_GYRO_FIELDS = {"gyro": "file", "gyro_offset": "offset_s", "gyro_axes": "axes", "photo_times": "times"}

# How photos are measured, as `RunOptions` takes it.
_measure_options = opt.gathered(
    "measuring",
    opt.camera_option,
    click.option(
        "--frames",
        type=click.Choice(opt.FRAMES_NAMES),
        default="key",
        help="Frames of a video that are rectified. key: the key frames, into images/; all: every frame as well, into "
        "video.mp4.",
    ),
    click.option(
        "--every",
        type=click.IntRange(min=1),
        metavar="N",
        help="Use each N-th frame of a video as a single photo. These photos share no path of the camera.",
    ),
    click.option(
        "--sharpest",
        type=click.IntRange(min=1),
        metavar="N",
        help="Use the sharpest of each N frames of a video as a single photo.",
    ),
    click.option(
        "--gyro",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="FILE",
        help="Log of a gyroscope: CSV with time_s, wx, wy, wz in rad/s, a .gcsv file of Gyroflow, or a video of a "
        "GoPro.",
    ),
    click.option(
        "--gyro-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="Time in seconds on the gyroscope's clock when the camera's clock shows zero. For a video without --every "
        "and --sharpest it is estimated, within 10 s of this.",
    ),
    opt.gyro_axes_option,
    click.option(
        "--photo-times",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="CSV",
        help="Times at which the photos were taken, for --gyro: name, time_s. By default they are read from "
        "frames.csv among the photos. A video without --every and --sharpest takes none.",
    ),
    click.option(
        "--max-features",
        type=click.IntRange(min=100),
        default=None,
        help="Largest number of features of a photo. By default 8192, and 2048 for key frames of a video.",
    ),
    click.option(
        "--feature-megapixels",
        type=click.FloatRange(min=0.05),
        default=1.0,
        metavar="MP",
        help="Size in megapixels at which features are detected. Larger photos are shrunk for it.",
    ),
    click.option(
        "--features",
        type=click.Choice(("auto", "affine")),
        default="auto",
        help="If photos are not registered, affine: also detect features of the shape of their surroundings, "
        "which match between photos from sides further apart, and keep the solution with more photos; they take six "
        "times as long. auto: do so only if a strong shutter may be why.",
    ),
    click.option(
        "--matching",
        type=click.Choice(opt.MATCHING_NAMES),
        default="auto",
        help="Photos that are matched with each other. exhaustive: all pairs; neighbours: neighbours in order of "
        "capture, by GPS or by appearance; auto: exhaustive up to 60 photos, else neighbours.",
    ),
)


@click.command(cls=Sectioned)
@opt.photos_argument
@opt.out_option
@_measure_options
@solve_options
@opt.talk_options
def command(photos: Path, out: Path, measuring: dict[str, Any], given: dict[str, Any], talk: Talk) -> None:
    """Estimate the camera motion during the readout of each photo, and rectify the photos.

    PHOTOS is a folder of photos of one scene, in any order, or a video. The command writes images/, masks/, sparse/
    (COLMAP), transforms.json (nerfstudio), solution.json and report.html into OUT.

    The frames of a video share one path of the camera, and its key frames are used as the photos. The command also
    writes frames/ (the original key frames) and path.csv (pose, velocity and rotation rate of every frame).

    Nothing in OUT changes until the motions are solved. After an interruption, the same command with --resume
    continues. Exit code 3 means that some photos could not be rectified, or that the report or an export could not be
    written. They are listed, and everything else is complete.
    """
    with errors_for_people(opt.GOES_ON, needed_gb=2.0) as warned, progress_bars(talk) as progress:
        from rsundistort.input import GyroOptions
        from rsundistort.solve import RunOptions, run

        log = {field: measuring.pop(key) for key, field in _GYRO_FIELDS.items() if key in measuring}
        if "file" not in log:
            names = {field: f"--{key.replace('_', '-')}" for key, field in _GYRO_FIELDS.items()}
            opt.check_needed(log, "--gyro", names)
        gyro = GyroOptions(**log) if log else None
        solve, rectify, outputs = parts_of(given)
        options = RunOptions(solve=solve, rectify=rectify, outputs=outputs, gyro=gyro, **measuring)
        solution = run(photos, out, options, progress, **given)
    close(solution, out, warned, talk)
