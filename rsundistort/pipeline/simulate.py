"""Folders of photos with a known shutter motion."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FileError, FormatError, InputError
from ..io import facts_of_exif, list_photos, output_folder, output_name, read_photo, write_image, write_solution
from ..io.cameras import camera_to_json
from ..io.record import Record
from ..model import Camera, RowMotion, Solution, SolvedImage
from ..model.checks import check_finite
from ..rectify import largest_shift_px
from ..synthetic.fold import check_no_fold
from ..synthetic.warp import crop_camera, largest_rectangle, random_phi, warp_mask, warp_photo
from .cameras import camera_file_of, find_cameras
from .outcome import versions
from .progress import ProgressCallback, StageLog
from .workers import use_threads
from .write import mask_names

__all__ = ["WarpOptions", "read_motion_file", "simulate_warp"]

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
    motion : mapping of name to (3,) phi, optional
        Given motions, radians per unit of the clock; photos not named do not move. Instead of random ones.
    still : sequence of str
        Photos that do not move.
    crop : bool
        Cut all photos to the largest rectangle that every warped photo fills, the same for all, and write the originals
        cut alike as twins into `global/`. Motions are drawn for the whole frame, so the rotation over the rows that are
        left is smaller.
    seed, jobs, quality, overwrite
        As in `RunOptions`.
    """

    camera: str | None = None
    readout: str | None = None
    sigma_rad: float = 0.05
    motion: Mapping[str, ArrayLike] | None = None
    still: Sequence[str] = ()
    crop: bool = False
    seed: int = 0
    jobs: int = 0
    quality: int = 98
    overwrite: bool = False


def read_motion_file(path: Path) -> dict[str, list[float]]:
    """Motions of a JSON file `{name: [phi1, phi2, phi3]}`, radians per unit of the clock."""
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FormatError(f"{path} is no valid JSON: {error}") from error
    if not isinstance(value, dict):
        raise FormatError(f"{path}: expected an object of name: [phi1, phi2, phi3]")
    return {name: check_finite(phi, (3,), f"{path}: motion of {name}").tolist() for name, phi in value.items()}


def simulate_warp(
    photos: Path | str,
    out: Path | str,
    options: WarpOptions | None = None,
    progress: ProgressCallback | None = None,
) -> Solution:
    """Photos as if a rotating camera had taken them, with the truth.

    Writes `photos/` (warped), `masks/` (255 where the original had the direction), `camera.json` and
    `ground_truth.json`. The originals are the global-shutter twins; with the option `crop` they are cut to the same
    rectangle, in `global/`, and camera and truth are those of the cut photos. The twins have the lens of the photos,
    which rectified photos have not. What they lose would count as an error of the photos compared with them, so they
    are stored without loss, and JPEG at quality 100 (55 dB from the original where quality 98 is 49: measured on a
    photo of a facade). The EXIF of cut photos still tells the angle of the whole frame: go by `camera.json`.

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
        When a motion is of no photo of the folder, or so fast that the rows of a photo fold over; with `crop`, also
        when less than a quarter of the frame would be left.
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
        twins = [f"{folder}/{output_name(name)}" for folder in folders if folder != "masks" for name in names]
        made = ["camera.json", "ground_truth.json", *twins, *(f"masks/{name}" for name in masks.values())]
        Record(out).check(made, inputs)
        first = read_photo(photos / names[0])
        height, width = first.pixels.shape[:2]
        facts = [facts_of_exif(first.metadata.exif)]
        found = find_cameras(photos, names[:1], [(width, height)], facts, options.camera, options.readout)
        camera, source = found.of(0), found.source
        if options.motion is None:
            phi = random_phi(names, [camera.frame_span] * len(names), options.sigma_rad, options.seed, options.still)
        else:
            unknown = sorted({*options.motion, *options.still} - set(names))
            if unknown:
                raise InputError(f"motion or still photo {unknown[0]!r} is not among the photos of {photos}")
            phi = {name: np.asarray(options.motion.get(name, np.zeros(3)), np.float64) for name in names}
            phi.update({name: np.zeros(3) for name in options.still})
        motions = {name: RowMotion(phi[name]) for name in names}
        for name in names:
            check_no_fold(name, camera, motions[name].phi, bend=motions[name].bend)
        whole, crop = camera, (0, 0, camera.width, camera.height)
        if options.crop:
            crop = _common_rectangle(whole, motions, jobs, log)
            camera = crop_camera(whole, crop)
        kept = np.s_[crop[1] : crop[1] + crop[3], crop[0] : crop[0] + crop[2]]
        for folder in folders:
            (scratch / folder).mkdir()

        def work(name: str) -> None:
            photo = read_photo(photos / name)
            warped, mask = warp_photo(photo.pixels, whole, motions[name])
            out_name = output_name(name)
            write_image(scratch / "photos" / out_name, _cut(warped, kept), photo.metadata, options.quality)
            write_image(scratch / "masks" / masks[name], _cut(mask, kept))
            if options.crop:
                # above 100, WebP is stored without loss
                best = 101 if out_name.lower().endswith(".webp") else 100
                write_image(scratch / "global" / out_name, _cut(photo.pixels, kept), photo.metadata, best)

        log.begin("warping", len(names))
        with ThreadPoolExecutor(jobs) as pool:
            for done, _ in enumerate(pool.map(work, names), start=1):
                log.tell("warping", done, len(names))
        log.end("warping", photos=len(names))
        images = tuple(
            SolvedImage(output_name(n), "1", motion=motions[n], rs_shift_px=largest_shift_px(camera, motions[n]))
            for n in names
        )
        truth = Solution(
            shutter_model="rotation",
            cameras={"1": camera},
            rectified_cameras={"1": camera.pinhole()},
            images=images,
            stages=tuple(log.stages),
            options={
                "simulation": "warp",
                "camera": source,
                "sigma_rad_per_frame": None if options.motion is not None else options.sigma_rad,
                "seed": options.seed,
                "still": list(options.still),
                "crop_xywh": list(crop) if options.crop else None,
            },
            generator=versions(),
        )
        (scratch / "camera.json").write_text(json.dumps(camera_to_json(camera)) + "\n", encoding="utf-8")
        write_solution(scratch / "ground_truth.json", truth)
    return truth


def _common_rectangle(
    camera: Camera, motions: Mapping[str, RowMotion], jobs: int, log: StageLog
) -> tuple[int, int, int, int]:
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


def _cut(pixels: NDArray[Any], kept: tuple[slice, slice]) -> NDArray[Any]:
    return np.ascontiguousarray(pixels[kept])
