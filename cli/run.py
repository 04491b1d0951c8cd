"""`rsundistort run`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from . import options as opt
from .closing import close
from .terminal import Talk, errors_for_people, progress_bars

if TYPE_CHECKING:
    pass


@click.command()
@opt.photos_argument
@opt.out_option
@opt.camera_option
@opt.readout_groups_option
@opt.masks_option
@opt.model_option
@opt.refine_option
@opt.still_option
@opt.known_option
@opt.lengths_option
@opt.readout_ms_option
@click.option("--every", type=click.IntRange(min=1), metavar="N", help="Of a video: the photos are each N-th frame,")
@click.option("--sharpest", type=click.IntRange(min=1), metavar="N", help="or the sharpest of each N frames.")
@click.option(
    "--gyro",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE",
    help="A gyroscope's log: CSV with time_s, wx, wy, wz in rad/s, or Gyroflow's .gcsv.",
)
@click.option(
    "--gyro-offset",
    type=float,
    default=0.0,
    metavar="S",
    help="Seconds that the gyroscope's clock shows when the camera's shows zero.",
)
@click.option(
    "--gyro-axes",
    metavar="XYZ",
    help="Axes of the gyroscope that point right, down and ahead in the stored pixels; small letters are reversed.",
)
@click.option(
    "--photo-times",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="CSV",
    help="When photos were taken, for --gyro: name, time_s. Default: frames.csv among them.",
)
@opt.remedy_option
@click.option(
    "--max-features",
    type=click.IntRange(min=100),
    default=16384,
    show_default=True,
    help="Features of a photo.",
)
@opt.depth_option
@opt.view_options
@opt.interpolation_option
@opt.quality_option
@opt.raw_as_option
@opt.sparse_format_option
@opt.rs_poses_option
@opt.apply_orientation_option
@opt.again_option
@opt.max_pixels_option
@opt.seed_option
@opt.jobs_option
@opt.scheduler_option
@opt.overwrite_option
@opt.report_option
@opt.talk_options
def command(
    photos: Path,
    out: Path,
    camera: str | None,
    readout: dict[str, str] | None,
    masks: Path | None,
    shutter_model: str,
    refine: str | None,
    still: tuple[str, ...],
    known: Path | None,
    lengths: Path | None,
    readout_ms: float | None,
    every: int | None,
    sharpest: int | None,
    gyro: Path | None,
    gyro_offset: float,
    gyro_axes: str | None,
    photo_times: Path | None,
    remedy: str,
    max_features: int,
    depth: str,
    alpha: float | str | None,
    scale: float,
    max_size: int | None,
    interpolation: str,
    quality: int,
    raw_as: str,
    sparse_format: str,
    rs_poses: bool,
    apply_orientation: bool,
    again: bool,
    max_megapixels: float,
    seed: int,
    jobs: int,
    scheduler: str | None,
    overwrite: bool,
    report: bool,
    talk: Talk,
) -> None:
    """Find how the camera moved during each photo's readout, and take it out.

    PHOTOS is a folder of photos that one camera took of one scene, in any order, or a video. OUT gets images/, masks/,
    sparse/ (COLMAP), transforms.json (nerfstudio), solution.json and report.html; of a video frames/, too.

    OUT stays as it was until the motions are solved. If the rest is interrupted, `rectify --resume` goes on with it.
    Exit code 3 says that photos with a motion could not be rectified; they are listed, and the others are done.
    """
    with errors_for_people() as warned, progress_bars(talk) as progress:
        from rsundistort.io import read_known_lengths, read_known_motions
        from rsundistort.pipeline import GyroOptions, RunOptions, run
        from rsundistort.rectify import ViewOptions

        readout_s = readout_ms and readout_ms / 1e3
        solution = run(
            photos,
            out,
            RunOptions(
                camera=camera,
                readout=readout,
                masks=masks,
                shutter_model=shutter_model,
                seed=seed,
                jobs=jobs,
                max_features=max_features,
                depth=depth,
                view=ViewOptions(alpha, scale, max_size),
                interpolation=interpolation,
                quality=quality,
                raw_as=raw_as,
                sparse_format=sparse_format,
                rs_poses=rs_poses,
                apply_orientation=apply_orientation,
                again=again,
                max_megapixels=max_megapixels,
                refine=opt.names_between_commas(refine),
                still=opt.anchors(still),
                known={} if known is None else read_known_motions(known, readout_s),
                lengths=() if lengths is None else read_known_lengths(lengths),
                remedy=remedy,
                every=every,
                sharpest=sharpest,
                gyro=None if gyro is None else GyroOptions(gyro, gyro_offset, gyro_axes, photo_times),
                readout_s=readout_s,
                overwrite=overwrite,
                scheduler=scheduler,
                report=report,
            ),
            progress,
        )
    close(solution, out, warned, talk)
