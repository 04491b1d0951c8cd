"""Folders of photos with a known shutter motion."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..batch.many_photos import mask_names
from ..batch.progress import ProgressCallback, StageLog
from ..batch.workers import use_threads
from ..errors import FormatError, InputError, RsUndistortWarning
from ..input.photo_cameras import camera_file_of, find_cameras
from ..io import facts_of_exif, list_photos, output_folder, output_name, read_photo, write_image, write_solution
from ..io.cameras import camera_to_json
from ..io.gyro import GyroLog
from ..io.json_text import read_json
from ..io.photos.images import Photo
from ..io.record import Record
from ..model import Camera, RowMotion, Solution, SolvedImage
from ..model.checks import check_finite
from ..rectify import largest_shift_px
from ..synthetic.fold import check_no_fold
from ..synthetic.unsteady import Poses, RowTable, Vibration, read_row_tables, row_table, tracks, unsteady_motions
from ..synthetic.warp import crop_camera, largest_rectangle, random_phi, warp_mask, warp_photo
from ..versions import versions

__all__ = ["WarpOptions", "read_motion_file", "simulate_warp"]

# x, y, width, height in pixels
Rectangle = tuple[int, int, int, int]

#: Share of the frame that a crop must keep; less is no photo of the scene any more.
_LEAST_CROP = 0.25


@dataclass(frozen=True)
class WarpOptions:
    """Options of `simulate_warp`.

    Parameters
    ----------
    camera, readout : str, optional
        As in `RunOptions`; EXIF's focal length serves if there is no camera.
    sigma_rad : float
        Standard deviation of the rotation over the frame, in radians.
    motion : mapping of name to (3,) phi or RowTable, optional
        Given motions, radians per unit of the clock, or rotations by row; photos not named do not move. Instead of
        random ones. A rotation that is constant stays out, so that the photo remains the reference.
    gyro : GyroLog, optional
        Motions are stretches of this log, drawn at random, instead of steady ones.
    readout_s : float, optional
        How long a frame is read in the time of the log; by default what the log says.
    acceleration : float
        Standard deviation of what the components of phi change by over half a frame, as a share of themselves; drawn
        for each photo and component.
    vibration : Vibration, optional
        On top of all of these.
    still : sequence of str
        Photos that do not move.
    crop : bool
        Cut all photos to the largest rectangle that every warped photo fills, the same for all, and write the originals
        cut alike as references into `global/`. Motions are drawn for the whole frame, so the rotation over the rows
        that are left is smaller.
    seed, jobs, quality, overwrite
        As in `RunOptions`.
    """

    camera: str | None = None
    readout: str | None = None
    sigma_rad: float = 0.05
    motion: Mapping[str, ArrayLike | RowTable] | None = None
    gyro: GyroLog | None = None
    readout_s: float | None = None
    acceleration: float = 0.0
    vibration: Vibration | None = None
    still: Sequence[str] = ()
    crop: bool = False
    seed: int = 0
    jobs: int = 0
    quality: int = 98
    overwrite: bool = False


def read_motion_file(path: Path) -> dict[str, list[float] | RowTable]:
    """Motions of photos.

    Parameters
    ----------
    path : path
        JSON `{name: [phi1, phi2, phi3]}`, radians per unit of the clock, or `{name: {"row": [...], "rotation": [[rx,
        ry, rz], ...]}}`, `clock` instead of `row` if it is that, as of `RowTable`; or CSV, as `read_row_tables` takes
        it.
    """
    if Path(path).suffix.lower() == ".csv":
        return dict(read_row_tables(path))
    value = read_json(path)
    if not isinstance(value, dict):
        raise FormatError(f"{path}: expected an object of name: [phi1, phi2, phi3]")
    return {
        name: row_table(each, f"{path}: table of {name}")
        if isinstance(each, dict)
        else check_finite(each, (3,), f"{path}: motion of {name}").tolist()
        for name, each in value.items()
    }


def simulate_warp(
    photos: Path | str, out: Path | str, options: WarpOptions | None = None, progress: ProgressCallback | None = None
) -> Solution:
    """Photos as if a rotating camera had taken them, with the truth.

    Writes `photos/` (warped), `masks/` (255 where the original had the direction), `camera.json` and
    `ground_truth.json`. The originals are the global-shutter references; with the option `crop` they are cut to the
    same rectangle, in `global/`, and camera and truth are those of the cut photos. The references have the lens of the
    photos, which rectified photos have not. What they lose would count as an error of the photos compared with them, so
    they are stored without loss, and JPEG at quality 100 (55 dB from the original where quality 98 is 49: measured on a
    photo of a facade). The EXIF of cut photos still gives the angle of the whole frame: go by `camera.json`.

    Parameters
    ----------
    photos, out : path
        Folder of photos taken without motion; folder for the outputs.
    options : WarpOptions, optional
        See there.
    progress : callable, optional
        Called as (stage, done, total).

    Returns
    -------
    Solution
        The truth: motions without poses.

    Raises
    ------
    InputError
        When photos differ in size, a motion is of none of them, or so fast that the rows of a photo fold over; with
        `crop`, also when less than a quarter of the frame would be left.
    """
    options = options or WarpOptions()
    photos, out = Path(photos), Path(out)
    names = list_photos(photos)
    log = StageLog(progress)
    jobs = use_threads(options.jobs)
    masks = mask_names(names)
    folders = ("photos", "masks", *(["global"] if options.crop else []))
    camera_file = camera_file_of(photos, options.camera)
    inputs = [photos] if camera_file is None else [photos, camera_file]
    with output_folder(out, overwrite=options.overwrite, apart_from=inputs, replaced=folders) as scratch:
        references = [f"{folder}/{output_name(name)}" for folder in folders if folder != "masks" for name in names]
        made = ["camera.json", "ground_truth.json", *references, *(f"masks/{name}" for name in masks.values())]
        Record(out).check(made, inputs)
        whole, source, sigma = _camera(photos, names[0], options)
        motions = _motions(photos, names, whole, options)
        for name in names:
            check_no_fold(name, whole, motions[name])
        crop = _common_rectangle(whole, motions, jobs, log) if options.crop else None
        for folder in folders:
            (scratch / folder).mkdir()

        def work(name: str) -> None:
            photo = read_photo(photos / name)
            height, width = photo.pixels.shape[:2]
            if (width, height) != (whole.width, whole.height):
                raise InputError(
                    f"{name} has {width}x{height} pixels, {names[0]} {whole.width}x{whole.height}; "
                    "warp photos of each size by themselves"
                )
            warped, mask = warp_photo(photo.pixels, whole, motions[name])
            write_image(scratch / "masks" / masks[name], _cut(mask, crop))
            _write_photos(scratch, output_name(name), photo, warped, crop, options.quality)

        log.begin("warping", len(names))
        with ThreadPoolExecutor(jobs) as pool:
            for done, _ in enumerate(pool.map(work, names), start=1):
                log.tell("warping", done, len(names))
        log.end("warping", photos=len(names))
        camera = whole if crop is None else crop_camera(whole, crop)
        truth = replace(_truth(camera, source, motions, crop, options), stages=tuple(log.stages))
        content = camera_to_json(camera) | ({"sigma": sigma} if sigma else {})
        (scratch / "camera.json").write_text(json.dumps(content) + "\n", encoding="utf-8")
        write_solution(scratch / "ground_truth.json", truth)
    return truth


def _camera(photos: Path, name: str, options: WarpOptions) -> tuple[Camera, str, dict[str, float]]:
    """The camera of the photos, as the first of them has it, where it is from, and what it is known to."""
    first = read_photo(photos / name)
    height, width = first.pixels.shape[:2]
    facts = [facts_of_exif(first.metadata.exif)]
    found = find_cameras(photos, [name], [(width, height)], facts, options.camera, options.readout)
    if found.without_focal:
        raise InputError(
            f"{name} has no focal length in its EXIF and there is no camera.json; "
            "give --camera FILE or --camera fx,fy,cx,cy in pixels"
        )
    if not found.calibrated:
        warnings.warn(
            f"{name}: the focal length is that of its EXIF; a warp by one that is wrong is not what a rotation of this "
            "camera would do, and no truth to compare with: give a calibration (--camera)",
            RsUndistortWarning,
            stacklevel=3,
        )
    return found.of(0), found.source, found.sigma_of_file(int(found.camera_idx[0]))


def _write_photos(
    folder: Path, name: str, photo: Photo, warped: NDArray[Any], crop: Rectangle | None, quality: int
) -> None:
    """Write what a photo was warped to, and its reference if they are cut."""
    # a photo that is sharp and was exposed for long shows that its camera did not move
    metadata = photo.metadata.without_exposure()
    write_image(folder / "photos" / name, _cut(warped, crop), metadata, quality)
    if crop is not None:
        # above 100, WebP is stored without loss
        best = 101 if name.lower().endswith(".webp") else 100
        write_image(folder / "global" / name, _cut(photo.pixels, crop), photo.metadata, best)


def _truth(
    camera: Camera, source: str, motions: Mapping[str, RowMotion], crop: Rectangle | None, options: WarpOptions
) -> Solution:
    """The motions of the photos, as the camera that took them, or to which they are cut, shows them."""
    images = tuple(
        SolvedImage(output_name(name), "1", motion=motion, rs_shift_px=largest_shift_px(camera, motion))
        for name, motion in motions.items()
    )
    return Solution(
        shutter_model="rotation",
        cameras={"1": camera},
        rectified_cameras={"1": camera.pinhole()},
        images=images,
        options={
            "simulation": "warp",
            "camera": source,
            "sigma_rad_per_frame": options.sigma_rad if options.motion is None and options.gyro is None else None,
            "seed": options.seed,
            "still": list(options.still),
            "crop_xywh": None if crop is None else list(crop),
            **({"acceleration": options.acceleration} if options.acceleration else {}),
            **({} if options.vibration is None else {"vibration": asdict(options.vibration)}),
        },
        generator=versions(),
    )


def _motions(photos: Path, names: Sequence[str], camera: Camera, options: WarpOptions) -> dict[str, RowMotion]:
    """The motion of each photo."""
    unknown = sorted({*(options.motion or ()), *options.still} - set(names))
    if unknown:
        raise InputError(f"motion or still photo {unknown[0]!r} is not among the photos of {photos}")
    given = options.motion or {}
    tables = [name for name, each in given.items() if isinstance(each, RowTable)]
    if options.gyro is not None and options.motion is not None:
        raise InputError("motions are given, and a gyroscope's log; expected one of them")
    if options.acceleration and (tables or options.gyro is not None):
        raise InputError("an acceleration goes with steady motions, not with tables or a gyroscope's log")
    start: Mapping[str, RowMotion | RowTable | Poses]
    cameras = [camera] * len(names)
    if options.gyro is not None:
        start = dict(zip(names, tracks(options.gyro, cameras, options.readout_s, options.seed), strict=True))
    elif options.motion is None:
        phi = random_phi(names, [camera.frame_span] * len(names), options.sigma_rad, options.seed, options.still)
        start = {name: RowMotion(phi[name]) for name in names}
    else:
        start = {name: RowMotion() for name in names} | {
            name: each if isinstance(each, RowTable) else RowMotion(np.asarray(each, np.float64))
            for name, each in given.items()
        }
    found = unsteady_motions(start, cameras, options.acceleration, options.vibration, options.seed, options.still)
    for name, (motion, _, _) in found.items():
        if motion.moves:
            raise InputError(f"table of {name}: it has positions, but a photo can be warped by rotations only")
    return {name: motion for name, (motion, _, _) in found.items()}


def _common_rectangle(camera: Camera, motions: Mapping[str, RowMotion], jobs: int, log: StageLog) -> Rectangle:
    """The largest rectangle (x, y, width, height) of pixels that all warped photos fill."""
    valid = np.ones((camera.height, camera.width), bool)
    smallest = ("", np.inf)
    log.begin("cropping", len(motions))
    with ThreadPoolExecutor(jobs) as pool:
        found = pool.map(lambda motion: warp_mask(camera, motion) > 0, motions.values())
        for done, (name, mask) in enumerate(zip(motions, found, strict=True), start=1):
            valid &= mask
            smallest = min(smallest, (name, float(mask.mean())), key=lambda each: each[1])
            log.tell("cropping", done, len(motions))
    rectangle = largest_rectangle(valid)
    width, height = rectangle[2:]
    if width * height < _LEAST_CROP * camera.width * camera.height:
        raise InputError(
            f"no more than {width}x{height} of {camera.width}x{camera.height} pixels are filled in all warped photos, "
            f"less than a quarter: the motion is too strong to crop ({smallest[0]} keeps {smallest[1]:.0%}); "
            "give a slower one"
        )
    log.end("cropping", rectangle=list(rectangle))
    return rectangle


def _cut(pixels: NDArray[Any], crop: Rectangle | None) -> NDArray[Any]:
    x, y, width, height = crop or (0, 0, pixels.shape[1], pixels.shape[0])
    return np.ascontiguousarray(pixels[y : y + height, x : x + width])
