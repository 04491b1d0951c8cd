"""`rsundistort run`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from . import options as opt
from .closing import close
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
        show_default=True,
        help="Of a video: rectify its key frames, into images/; or all frames as well, into video.mp4.",
    ),
    click.option(
        "--every",
        type=click.IntRange(min=1),
        metavar="N",
        help="Of a video: take each N-th frame as a photo by itself; the frames then share no path,",
    ),
    click.option("--sharpest", type=click.IntRange(min=1), metavar="N", help="or the sharpest of each N frames."),
    click.option(
        "--gyro",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="FILE",
        help="A gyroscope's log: CSV with time_s, wx, wy, wz in rad/s, or Gyroflow's .gcsv.",
    ),
    click.option(
        "--gyro-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="Seconds that the gyroscope's clock shows when the camera's shows zero.",
    ),
    click.option(
        "--gyro-axes",
        metavar="XYZ",
        help="Axes of the gyroscope that point right, down and ahead in the stored pixels; small letters are reversed.",
    ),
    click.option(
        "--photo-times",
        type=click.Path(exists=True, dir_okay=False, path_type=Path),
        metavar="CSV",
        help="When photos were taken, for --gyro: name, time_s. Default: frames.csv among them.",
    ),
    click.option(
        "--max-features",
        type=click.IntRange(min=100),
        default=8192,
        show_default=True,
        help="Features of a photo, the largest.",
    ),
    click.option(
        "--feature-megapixels",
        type=click.FloatRange(min=0.05),
        default=1.0,
        show_default=True,
        metavar="MP",
        help="Larger photos are shrunk to this to find their features.",
    ),
    click.option(
        "--matching",
        type=click.Choice(opt.MATCHING_NAMES),
        default="auto",
        show_default=True,
        help="Photos matched with each other: all; neighbours in order of capture, by GPS or in looks; auto: these "
        "beyond more than 60.",
    ),
)


@click.command()
@opt.photos_argument
@opt.out_option
@_measure_options
@solve_options
@opt.talk_options
def command(photos: Path, out: Path, measuring: dict[str, Any], given: dict[str, Any], talk: Talk) -> None:
    """Find how the camera moved during each photo's readout, and take it out.

    PHOTOS is a folder of photos that one camera took of one scene, in any order, or a video. OUT gets images/, masks/,
    sparse/ (COLMAP), transforms.json (nerfstudio), solution.json and report.html.

    The frames of a video share one path of the camera. Its key frames are the photos. OUT gets frames/ (these, as they
    were) and path.csv (pose, velocity and turn at every frame), too.

    OUT stays as it was until the motions are solved. After an interruption, whatever it was, the same command with
    --resume goes on. Exit code 3 says that photos with a motion could not be rectified, or that the report could not be
    written; they are listed, and the rest is done.
    """
    with errors_for_people(opt.GOES_ON) as warned, progress_bars(talk) as progress:
        from rsundistort.input import GyroOptions
        from rsundistort.solve import RunOptions, run

        log = {field: measuring.pop(key) for key, field in _GYRO_FIELDS.items() if key in measuring}
        gyro = GyroOptions(**log) if "file" in log else None
        solve, rectify, outputs = parts_of(given)
        options = RunOptions(solve=solve, rectify=rectify, outputs=outputs, gyro=gyro, **measuring)
        solution = run(photos, out, options, progress, **given)
    close(solution, out, warned, talk)
