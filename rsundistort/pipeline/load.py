"""Photos with their features and their camera, from a folder."""

from __future__ import annotations

import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from ..errors import FileError, InputError, SkippedPhotoWarning
from ..io import MAX_MEGAPIXELS, camera_from_exif, list_photos, parse_camera, read_photo
from ..model import Camera
from ..sfm import Features, detect_features
from .progress import StageLog
from .write import check_not_rectified

__all__ = ["LoadedPhotos", "find_camera", "load_photos"]


@dataclass(frozen=True)
class LoadedPhotos:
    """What a folder holds.

    Attributes
    ----------
    names, features : lists of length m
        Readable photos.
    skipped : dict of name to reason
        Unreadable ones.
    camera : Camera
        Of all of them.
    calibrated : bool
        Whether the camera was given; else it is EXIF's guess.
    camera_source : str
        Where the camera comes from, for people.
    """

    names: list[str]
    features: list[Features]
    skipped: dict[str, str]
    camera: Camera
    calibrated: bool
    camera_source: str


def find_camera(
    folder: Path, names: list[str], sizes: list[tuple[int, int]], camera: str | None, readout: str | None
) -> tuple[Camera, bool, str]:
    """The camera of a folder's photos: as told, `camera.json` in the folder or beside it, or EXIF.

    Parameters
    ----------
    folder : Path
        Of the photos.
    names, sizes : lists
        Photos and their (width, height).
    camera : str, optional
        As `parse_camera` takes it.
    readout : str, optional
        Readout direction; overrides the file's.

    Returns
    -------
    camera, calibrated, source
        See `LoadedPhotos`.
    """
    width, height = sizes[0]
    for name, size in zip(names, sizes, strict=True):
        if size != (width, height):
            raise InputError(
                f"{names[0]} has {width}x{height} pixels but {name} has {size[0]}x{size[1]}; "
                "one run takes the photos of one camera in one mode: put the others into a folder of their own"
            )
    if camera is not None:
        return parse_camera(camera, width, height, readout), True, camera
    for path in (folder / "camera.json", folder.parent / "camera.json"):
        if path.is_file():
            return parse_camera(str(path), width, height, readout), True, str(path)
    for name in names:
        guess = camera_from_exif(folder / name, width, height, readout or "top-to-bottom")
        if guess is not None:
            return guess, False, f"EXIF of {name}, refined"
    raise InputError(
        f"{names[0]} has no focal length in its EXIF and there is no camera.json; "
        "give --camera FILE or --camera fx,fy,cx,cy in pixels"
    )


def load_photos(
    folder: Path,
    camera: str | None,
    readout: str | None,
    max_features: int,
    jobs: int,
    log: StageLog,
    raw_as: str = "tif",
    again: bool = True,
    max_megapixels: float = MAX_MEGAPIXELS,
) -> LoadedPhotos:
    """Read every photo of a folder once, for its size and features; unusable ones are skipped with a warning."""
    listed = list_photos(folder, raw_as)
    if len(listed) < 3:
        raise InputError(
            f"{folder} holds {len(listed)} photo{'s' * (len(listed) > 1)}; the shutter needs at least three"
        )
    log.begin("features", len(listed))
    done = 0

    def load(name: str) -> tuple[tuple[int, int], Features] | str:
        try:
            photo = read_photo(folder / name, max_megapixels)
            if not again:
                check_not_rectified(photo)
            pixels = photo.pixels
        except FileError as error:
            return str(error)
        except InputError as error:
            return f"{name}: {error}"
        return (pixels.shape[1], pixels.shape[0]), detect_features(pixels, max_features)

    names: list[str] = []
    sizes: list[tuple[int, int]] = []
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
                features.append(found[1])
    if len(names) < 3:
        raise InputError(
            f"{folder} holds {len(names)} readable photo{'s' * (len(names) != 1)} of {len(listed)}; "
            f"the shutter needs at least three ({next(iter(skipped.values()))})"
        )
    found_camera, calibrated, source = find_camera(folder, names, sizes, camera, readout)
    log.end("features", photos=len(names), keypoints=sum(len(f.xy_raw) for f in features))
    return LoadedPhotos(names, features, skipped, found_camera, calibrated, source)
