"""`rsundistort run`."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from . import options as opt
from .terminal import errors_for_people, list_failed, progress_bars, table

if TYPE_CHECKING:
    from rsundistort.model import Solution


@click.command()
@opt.photos_argument
@opt.out_option
@opt.camera_option
@click.option(
    "--readout",
    multiple=True,
    metavar="[GROUP=]DIRECTION",
    callback=opt.readout_by_group,
    help=f"Direction of the readout in the stored pixels: {', '.join(opt.READOUT_NAMES)}; of all photos, or of a "
    "group (as the closing table names it). By default the camera file's, else guessed and settled by the photos.",
)
@click.option(
    "--masks",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder of masks, a.png for a.jpg: what is black in them is not looked at, nor kept in OUT/masks.",
)
@click.option(
    "--model",
    "shutter_model",
    type=click.Choice(("auto", "constant-motion", "rotation", "linearized", "two-step", "global")),
    default="auto",
    show_default=True,
    help="How the shutter is modelled; auto is the model that foretells measurements held out from its fit.",
)
@click.option(
    "--refine",
    metavar="NAMES",
    help="Intrinsics to solve for with the rest: some of f (or fx, fy), cx, cy, k1, k2, p1, p2, k3 (of a "
    "fisheye k1 to k4) with commas between, or none. By default none of a camera that was given, f,k1,k2 of one that "
    "EXIF guessed.",
)
@click.option(
    "--still",
    "--anchor",
    multiple=True,
    metavar="NAME[=MRAD]",
    help="A photo known not to have moved: its phi1 is held at zero, or near zero with so many mrad per frame of "
    "standard deviation. May be repeated.",
)
@click.option(
    "--known",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="CSV",
    help="Motions known from elsewhere: name, phi1, phi2, phi3 (rad per frame; or omega1.. in rad/s) and sigma.",
)
@click.option(
    "--lengths",
    "--length",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="CSV",
    help="Lengths measured in the scene, two or more: photo1, x1, y1, photo2, x2, y2, length, sigma.",
)
@click.option(
    "--readout-ms",
    type=click.FloatRange(min=0, min_open=True),
    help="Time of the readout of a frame. Default: the gyroscope's log, or a table of cameras.",
)
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
@click.option(
    "--remedy",
    type=click.Choice(("auto", "prior", "none")),
    default="auto",
    show_default=True,
    help="Where all cameras are level: auto looks for a photo that did not move, prior takes the motions to be zero "
    "in the mean, none does neither.",
)
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
@opt.apply_orientation_option
@opt.again_option
@opt.max_pixels_option
@opt.seed_option
@opt.jobs_option
@opt.scheduler_option
@opt.overwrite_option
@opt.progress_option
@opt.quiet_option
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
    apply_orientation: bool,
    again: bool,
    max_megapixels: float,
    seed: int,
    jobs: int,
    scheduler: str | None,
    overwrite: bool,
    progress_form: str,
    quiet: bool,
) -> None:
    """Find how the camera moved during each photo's readout, and take it out.

    PHOTOS is a folder of photos that one camera took of one scene, in any order, or a video. OUT gets images/, masks/,
    sparse/ (COLMAP), transforms.json (nerfstudio) and solution.json; of a video frames/, too.

    OUT stays as it was until the motions are solved. If the rest is interrupted, `rectify --resume` goes on with it.
    Exit code 3 says that photos with a motion could not be rectified; they are listed, and the others are done.
    """
    with errors_for_people(), progress_bars(quiet, progress_form) as progress:
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
                apply_orientation=apply_orientation,
                again=again,
                max_megapixels=max_megapixels,
                refine=_names(refine),
                still=_anchors(still),
                known={} if known is None else read_known_motions(known, readout_s),
                lengths=() if lengths is None else read_known_lengths(lengths),
                remedy=remedy,
                every=every,
                sharpest=sharpest,
                gyro=None if gyro is None else GyroOptions(gyro, gyro_offset, gyro_axes, photo_times),
                readout_s=readout_s,
                overwrite=overwrite,
                scheduler=scheduler,
            ),
            progress,
        )
    silent = quiet or progress_form == "json"
    if not silent:
        click.echo(closing_table(solution, out))
    list_failed({image.name: image.reason for image in solution.registered if image.reason}, err=silent)


def _names(refine: str | None) -> tuple[str, ...] | None:
    """Names between commas; () for none, None where nothing was said."""
    if refine is None:
        return None
    names = tuple(name.strip() for name in refine.split(",") if name.strip())
    return () if names == ("none",) else names


def _anchors(still: tuple[str, ...]) -> dict[str, float]:
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


def closing_table(solution: Solution, out: Path) -> str:
    """What was found, a line a photo, in 80 columns."""
    rows = [("photo", "measurements", "rms px", "deg/frame", "shift px")]
    for image in solution.images:
        name = image.name if len(image.name) <= 32 else f"...{image.name[-29:]}"
        if image.motion is None:
            rows.append((name, "-", "-", "-", "not joined"))
            continue
        span = solution.cameras[image.camera_id].frame_span
        turn = float((image.motion.phi**2).sum() ** 0.5) * span * 57.29577951308232
        rows.append(
            (
                name,
                str(image.num_observations),
                f"{image.rms_px:.2f}",
                f"{turn:.2f}",
                f"{image.rs_shift_px:.1f}",
            )
        )
    quality = solution.quality
    total = sum(stage["seconds"] for stage in solution.stages)
    lines = [
        table(rows),
        "",
        f"photos registered  {len(solution.registered)} of {len(solution.images)}",
        f"shutter model      {solution.shutter_model}",
        *_held_out(quality["held_out_rms_px"]),
        *_cameras(solution),
        *_video(solution),
        *_intrinsics(solution),
        *_readout(solution),
        *_depths(solution),
        f"rms residual       {quality['global_rms_px']:.2f} px with a global shutter, {quality['rms_px']:.2f} px now",
        f"outputs            {out}  ({total:.0f} s)",
    ]
    critical = solution.critical_motion
    if critical is not None:
        said = [critical["sentence"]]
        if critical["flagged"]:
            said += ["at the next shoot:", *critical["advice"]]
        lines += ["", *(line for text in said for line in textwrap.wrap(text, 80))]
    doubtful = _doubtful(solution)
    if doubtful:
        lines += [
            "",
            "doubtful (few measurements, or a motion far from the others'; check these, or leave them out):",
            f"  {', '.join(doubtful)}",
        ]
    lost = [image for image in solution.images if not image.registered]
    if lost:
        lines += ["", "not joined:", *(f"  {image.name}: {image.reason}" for image in lost)]
    return "\n".join(lines)


def _cameras(solution: Solution) -> list[str]:
    """Where the cameras come from, which way they are read out by group where they differ, and what was guessed."""
    source, readout = solution.options["camera"], solution.options["readout"]
    if isinstance(readout, str):
        lines = [f"camera             {source}, readout {readout}"]
    else:
        lines = [f"cameras            {source}", *(f"  {group}: readout {each}" for group, each in readout.items())]
    guesses = solution.options.get("guesses", ())
    return lines + [f"  {line}" for text in guesses for line in textwrap.wrap(text, 78)]


def _intrinsics(solution: Solution) -> list[str]:
    """A line on each camera whose intrinsics were solved for, with standard deviations."""
    lines = []
    for key, sigmas in solution.quality["sigma_intrinsics"].items():
        camera = solution.cameras[key]
        values = {
            "f": camera.K[0, 0],
            "fx": camera.K[0, 0],
            "fy": camera.K[1, 1],
            "cx": camera.K[0, 2],
            "cy": camera.K[1, 2],
        }
        values |= camera.coefficients
        found = [
            f"{name} {values[name]:.{4 if name[0] in 'kp' else 1}f} +- {sigma:.{4 if name[0] in 'kp' else 1}f}"
            for name, sigma in sigmas.items()
        ]
        lines += [f"{'refined' if i == 0 else '':19}{', '.join(found[i : i + 3])}" for i in range(0, len(found), 3)]
    return lines


def _video(solution: Solution) -> list[str]:
    """A line on the video whose frames the photos are."""
    video = solution.options.get("video")
    if not video:
        return []
    turned = {3: 180, 6: 90, 8: 270}.get(video["orientation"])
    said = f", players turn them by {turned} degrees clockwise, the files do not" if turned else ""
    return [f"video              {len(solution.images)} of {video['frames']} frames{said}"]


def _readout(solution: Solution) -> list[str]:
    """Lines on how fast the photos turned, where the time of the readout is known."""
    times = solution.quality.get("readout_times") or {}
    rates = sorted(
        float((image.motion.phi**2).sum() ** 0.5)
        * solution.cameras[image.camera_id].frame_span
        / times[image.camera_id]["ms"]
        * 57295.77951308232
        for image in solution.registered
        if image.motion is not None and image.camera_id in times
    )
    if not rates:
        return []
    said = dict.fromkeys(f"{time['ms']:g} ms ({time['source']})" for time in times.values())
    return [
        f"rates of turn      median {rates[len(rates) // 2]:.1f}, largest {rates[-1]:.1f} deg/s, by a readout of",
        *(f"{'':19}{each}" for each in said),
    ]


def _depths(solution: Solution) -> list[str]:
    """A line on how far away the photos of a camera that travelled were taken to show things."""
    used = [image.depth for image in solution.images if image.depth is not None]
    kinds = {"points": "as the points", "plane": "on a plane", "map": "by maps", "infinity": "at infinity"}
    counts = [f"{text} in {used.count(kind)} photos" for kind, text in kinds.items() if kind in used]
    return [f"depth              {', '.join(counts)}"] if counts else []


def _held_out(rms_px: Mapping[str, float]) -> list[str]:
    """A line on how well each rung of the ladder foretold measurements that it was not fitted to."""
    if not rms_px:
        return []
    return ["held-out residual  " + ", ".join(f"{model} {rms:.3f}" for model, rms in rms_px.items()) + " px"]


def _doubtful(solution: Solution) -> list[str]:
    """Photos whose motion is known to no better than two pixels, or lies beyond five spreads of all of them."""
    spread = solution.quality["phi_sigma_rad_per_frame"]
    names = []
    for image in solution.registered:
        if image.motion is None or image.sigma_phi is None:
            continue
        camera = solution.cameras[image.camera_id]
        largest = float(abs(image.motion.phi).max()) * camera.frame_span
        # over half the frame a rotation by an angle moves pixels by about the angle times half the focal length
        uncertain_px = float(image.sigma_phi.max()) * camera.frame_span * float(camera.K[0, 0]) / 2
        if uncertain_px > 2.0 or largest > 5.0 * spread:
            names.append(image.name)
    return names
