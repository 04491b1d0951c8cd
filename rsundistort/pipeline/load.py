"""Photos with their features and their cameras, from a folder."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from ..errors import FileError, InputError, SkippedPhotoWarning
from ..io import MAX_MEGAPIXELS, ExifFacts, facts_of_exif, find_masks, list_photos, read_mask, read_photo
from ..sfm import Features, detect_features
from .cameras import PhotoCameras, find_cameras
from .progress import StageLog
from .write import check_not_rectified

__all__ = ["LoadedPhotos", "load_photos"]


@dataclass(frozen=True)
class LoadedPhotos:
    """What a folder holds.

    Attributes
    ----------
    names, features : lists of length m
        Readable photos.
    skipped : dict of name to reason
        Unreadable ones.
    cameras : PhotoCameras
        Which camera took which.
    """

    names: list[str]
    features: list[Features]
    skipped: dict[str, str]
    cameras: PhotoCameras


def load_photos(
    folder: Path,
    camera: str | None,
    readout: str | Mapping[str, str] | None,
    max_features: int,
    jobs: int,
    log: StageLog,
    masks: Path | None = None,
    raw_as: str = "tif",
    again: bool = True,
    max_megapixels: float = MAX_MEGAPIXELS,
) -> LoadedPhotos:
    """Read every photo of a folder once, for its size and features; unusable ones are skipped with a warning.

    Parameters
    ----------
    folder : Path
        Of the photos.
    camera, readout
        As in `find_cameras`.
    max_features : int
        Of a photo.
    jobs : int
        Threads.
    log : StageLog
        Told the progress.
    masks : Path, optional
        Folder of the users' masks, as `io.find_masks` takes it.
    raw_as, again, max_megapixels
        As in `RunOptions`.
    """
    listed = list_photos(folder, raw_as)
    if len(listed) < 3:
        raise InputError(
            f"{folder} holds {len(listed)} photo{'s' * (len(listed) > 1)}; the shutter needs at least three"
        )
    mask_of = {} if masks is None else find_masks(masks, listed)
    log.begin("features", len(listed))
    done = 0

    def load(name: str) -> tuple[tuple[int, int], ExifFacts, Features] | str:
        try:
            photo = read_photo(folder / name, max_megapixels)
            if not again:
                check_not_rectified(photo)
            pixels = photo.pixels
        except FileError as error:
            return str(error)
        except InputError as error:
            return f"{name}: {error}"
        # a mask that cannot be used stops the run: without it, what it hides would be measured
        size = pixels.shape[1], pixels.shape[0]
        mask = read_mask(mask_of[name], *size) if name in mask_of else None
        return size, facts_of_exif(photo.metadata.exif), detect_features(pixels, max_features, mask)

    names: list[str] = []
    sizes: list[tuple[int, int]] = []
    facts: list[ExifFacts] = []
    features: list[Features] = []
    skipped: dict[str, str] = {}
    with ThreadPoolExecutor(jobs) as pool:
        for name, found in zip(listed, pool.map(load, listed), strict=True):
            done += 1
            log.tell("features", done, len(listed))
            if isinstance(found, str):
                skipped[name] = found
                warnings.warn(f"skipped: {found}", SkippedPhotoWarning, stacklevel=2)
            else:
                names.append(name)
                sizes.append(found[0])
                facts.append(found[1])
                features.append(found[2])
    if len(names) < 3:
        raise InputError(
            f"{folder} holds {len(names)} readable photo{'s' * (len(names) != 1)} of {len(listed)}; "
            f"the shutter needs at least three ({next(iter(skipped.values()))})"
        )
    cameras = find_cameras(folder, names, sizes, facts, camera, readout)
    log.end("features", photos=len(names), keypoints=sum(len(f.xy_raw) for f in features))
    return LoadedPhotos(names, features, skipped, cameras)
