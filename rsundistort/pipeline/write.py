"""The outputs of a run."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, MetadataWarning, SkippedPhotoWarning
from ..io import MAX_MEGAPIXELS, Photo, find_masks, output_name, read_mask, read_photo, write_image
from ..io.photos.exif import read_orientation
from ..model import Reconstruction, Solution, SolvedImage
from ..model.orientation import split_mirror, turn_pixels
from ..rectify import rectify
from .depth import PhotoDepths
from .extras import Extras
from .progress import StageLog

__all__ = ["PointColors", "check_not_rectified", "mask_names", "rectify_photos", "turn_of"]


def mask_names(names: Sequence[str]) -> dict[str, str]:
    """Name of each photo's mask: its stem, unless two photos share it (a.jpg and a.png)."""
    stems = [Path(name).stem for name in names]
    return {
        name: f"{stem}.png" if stems.count(stem) == 1 else f"{name}.png"
        for name, stem in zip(names, stems, strict=True)
    }


def check_not_rectified(photo: Photo) -> None:
    """Refuse a photo that is rectified already."""
    by = photo.metadata.rectified_by
    if by is not None:
        raise InputError(f"it was rectified already, by rsundistort {by}; --again rectifies it once more")


def turn_of(image: SolvedImage, photo: Photo) -> tuple[int, int]:
    """How a photo's orientation is applied, and what is left of it: mirrors are left where there is a pose."""
    orientation = photo.metadata.orientation
    return split_mirror(orientation) if image.posed else (orientation, 1)


def rectify_photos(
    folder: Path,
    solution: Solution,
    names: Sequence[str],
    out: Path,
    *,
    interpolation: str,
    quality: int,
    jobs: int,
    log: StageLog,
    depths: PhotoDepths,
    masks: Path | None = None,
    raw_as: str = "tif",
    apply_orientation: bool = False,
    again: bool = True,
    max_megapixels: float = MAX_MEGAPIXELS,
    extras: Extras | None = None,
) -> Iterator[tuple[str, Photo]]:
    """Rectify photos into `out/images` and `out/masks`, and yield each raw photo by the way.

    Photos that cannot be read, are of another size than their camera, or (unless `again`) are rectified already, are
    skipped with a warning. `depths` says how far away what they show is. With `apply_orientation` photo and mask are
    turned as `turn_of` says. What the users' own masks (a folder, as `io.find_masks` takes it) leave out is left out of
    `out/masks`. `extras` are written beside them.
    """
    (out / "images").mkdir()
    (out / "masks").mkdir()
    mask_name = mask_names([image.name for image in solution.images])
    mask_of = {} if masks is None else find_masks(masks, names)
    mark = version("rsundistort")

    def work(name: str) -> tuple[str, Photo | None, str]:
        image = solution.image(name)
        camera = solution.cameras[image.camera_id]
        try:
            photo = read_photo(folder / name, max_megapixels)
            if not again:
                check_not_rectified(photo)
            own = read_mask(mask_of[name], camera.width, camera.height) if name in mask_of else None
            seen = depths.of(name)
            pixels, mask = rectify(
                photo.pixels, camera, seen.motion, solution.shutter_model,
                solution.rectified_cameras[image.camera_id], interpolation, mask=own, depth=seen.depth,
            )  # fmt: skip
            metadata = photo.metadata.marked(mark)
            if extras is not None:
                extras.write(
                    out, name, Path(mask_name[name]).stem, camera, seen.motion, solution.shutter_model,
                    solution.rectified_cameras[image.camera_id], seen.depth,
                    turn_of(image, photo)[0] if apply_orientation else 1, max_megapixels,
                )  # fmt: skip
            if apply_orientation:
                turn, rest = turn_of(image, photo)
                pixels, mask, metadata = (
                    turn_pixels(pixels, turn),
                    turn_pixels(mask, turn),
                    metadata.with_orientation(rest),
                )
                _warn_of_orientation(name, photo, rest)
            write_image(out / "images" / output_name(name, raw_as), pixels, metadata, quality)
            write_image(out / "masks" / mask_name[name], mask)
        except (FileError, InputError) as error:
            return name, None, str(error)
        return name, photo, ""

    log.begin("rectifying", len(names))
    done = 0
    written = 0
    with ThreadPoolExecutor(jobs) as pool:
        # a few photos ahead of the consumer, never the whole folder
        for start in range(0, len(names), 2 * jobs):
            for name, photo, problem in pool.map(work, names[start : start + 2 * jobs]):
                done += 1
                log.tell("rectifying", done, len(names))
                if photo is None:
                    warnings.warn(f"skipped: {name}: {problem}", SkippedPhotoWarning, stacklevel=2)
                else:
                    written += 1
                    yield name, photo
    log.end("rectifying", photos=written)


def _warn_of_orientation(name: str, photo: Photo, rest: int) -> None:
    stored = read_orientation(photo.metadata.exif)
    if stored != photo.metadata.orientation:
        text = f"{name}: its EXIF orientation {stored} means nothing and is taken for 1"
    elif rest != 1:
        text = (
            f"{name}: mirrored by its EXIF orientation {stored}, it was turned and keeps the mirror as its orientation"
        )
    else:
        return
    warnings.warn(text, MetadataWarning, stacklevel=2)


class PointColors:
    """Mean colour of each point over the photos that see it."""

    def __init__(self, reconstruction: Reconstruction) -> None:
        self._rec = reconstruction
        self._sum = np.zeros((reconstruction.num_points, 3))
        self._count = np.zeros(reconstruction.num_points)

    def add(self, name: str, photo: Photo) -> None:
        """Take the colours of one photo."""
        obs = self._rec.observations
        of_photo = obs.frame_idx == self._rec.image_names.index(name)
        xy = np.rint(obs.xy_raw[of_photo]).astype(int)
        h, w = photo.pixels.shape[:2]
        values = photo.pixels[np.clip(xy[:, 1], 0, h - 1), np.clip(xy[:, 0], 0, w - 1)].astype(float)
        if values.ndim == 1:
            values = np.repeat(values[:, None], 3, axis=1)
        scale = 255.0 / np.iinfo(photo.pixels.dtype).max if photo.pixels.dtype.kind == "u" else 255.0
        np.add.at(self._sum, obs.point_idx[of_photo], scale * values[:, 2::-1])
        np.add.at(self._count, obs.point_idx[of_photo], 1)

    def rgb(self) -> NDArray[np.uint8]:
        """(n, 3) red, green, blue."""
        mean = self._sum / np.maximum(self._count, 1)[:, None]
        return np.clip(np.rint(mean), 0, 255).astype(np.uint8)
