"""`rsundistort solve`."""

from __future__ import annotations

from pathlib import Path

import click

from . import options as opt
from .closing import close
from .terminal import Talk, errors_for_people, progress_bars


@click.command()
@click.argument("model", type=opt.LocalPath(path_type=Path))
@opt.out_option
@click.option(
    "--images",
    type=opt.LocalPath(exists=True, file_okay=False, path_type=Path),
    help="Folder of the photos that the model names; without it none are rectified.",
)
@click.option(
    "--database",
    type=click.Path(path_type=Path),
    metavar="DB",
    help="COLMAP's database behind the model: matches in it that the shutter spoiled are tried again with the motions "
    "found, and the tracks rebuilt.",
)
@opt.readout_groups_option
@opt.masks_option
@opt.model_option
@opt.refine_option
@opt.still_option
@opt.known_option
@opt.lengths_option
@opt.readout_ms_option
@opt.remedy_option
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
    model: Path,
    out: Path,
    images: Path | None,
    database: Path | None,
    readout: dict[str, str] | None,
    masks: Path | None,
    shutter_model: str,
    refine: str | None,
    still: tuple[str, ...],
    known: Path | None,
    lengths: Path | None,
    readout_ms: float | None,
    remedy: str,
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
    """Find how the camera moved during each photo's readout, from a model of COLMAP, OpenMVG or OpenSfM.

    MODEL is the folder of a COLMAP model, text or binary, OpenMVG's sfm_data.json, or OpenSfM's reconstruction.json
    with tracks.csv beside it. OUT gets what `rsundistort run` writes; images/ and masks/ if
    --images says where the photos are. Cameras of the model are the groups of --readout: --readout "camera
    1=left-to-right".
    """
    with errors_for_people() as warned, progress_bars(talk) as progress:
        from rsundistort.io import read_known_lengths, read_known_motions
        from rsundistort.pipeline import SolveOptions, solve_model
        from rsundistort.rectify import ViewOptions

        readout_s = readout_ms and readout_ms / 1e3
        solution = solve_model(
            model,
            out,
            SolveOptions(
                readout=readout,
                masks=masks,
                shutter_model=shutter_model,
                seed=seed,
                jobs=jobs,
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
                readout_s=readout_s,
                overwrite=overwrite,
                scheduler=scheduler,
                report=report,
            ),
            images=images,
            database=database,
            progress=progress,
        )
    close(solution, out, warned, talk)
