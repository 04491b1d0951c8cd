"""Masks that users drew: which pixels of a photo to leave out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import overload

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError
from .photos.images import read_plain
from .photos.kinds import PHOTO_SUFFIXES
from .places import File, Place, files_in

__all__ = ["check_one_photo_each", "find_masks", "read_mask"]

_SUFFIXES = (".png", *(each for each in PHOTO_SUFFIXES if each != ".png"), ".bmp")


@overload
def find_masks(
    folder: Path, names: Sequence[str], what: str = ..., suffixes: Sequence[str] = ...
) -> dict[str, Path]: ...
@overload
def find_masks(
    folder: Place, names: Sequence[str], what: str = ..., suffixes: Sequence[str] = ...
) -> Mapping[str, File]: ...
def find_masks(
    folder: Place, names: Sequence[str], what: str = "mask", suffixes: Sequence[str] = _SUFFIXES
) -> Mapping[str, File]:
    """Masks of photos: files of the same stem (`a.png` for `a.jpg`), or of the whole name, as COLMAP has them.

    Those of photos in sub-folders are in sub-folders of the same names.

    Parameters
    ----------
    folder : Path or RemoteFolder
        Of the masks. A photo need not have one.
    what : str
        What errors call them; other files of the same frames are found alike.
    suffixes : sequence of str
        Endings that they have, the most usual first.

    Raises
    ------
    FileError, InputError
        When the folder is missing, no mask in it is of one of the photos, or a photo has several.
    """
    if files_in(folder) is None:
        raise FileError(f"{folder} is no folder; give the folder that holds the {what}s")
    by_stem: dict[PurePosixPath, list[File]] = {}
    for within in sorted({PurePosixPath(name).parent for name in names}):
        for each, file in (files_in(folder, within.as_posix()) or {}).items():
            path = within / each
            if path.suffix.lower() in suffixes:
                by_stem.setdefault(path.with_suffix(""), []).append(file)
    found: dict[str, File] = {}
    for name in names:
        path = PurePosixPath(name)
        fitting = by_stem.get(path) or by_stem.get(path.with_suffix("")) or []
        if len(fitting) > 1:
            raise InputError(
                f"{name} has several {what}s: {', '.join(path.name for path in fitting)}; keep one of them"
            )
        if fitting:
            found[name] = fitting[0]
    if not found:
        such = PurePosixPath(names[0]).with_suffix(suffixes[0])
        raise InputError(f"{folder} holds no {what} of any photo; it should hold {such} and so on")
    return found


def check_one_photo_each(found: Mapping[str, Path], what: str) -> None:
    """Refuse files that `find_masks` found for two photos of one stem, such as `a.npy` for `a.jpg` and `a.png`."""
    photo_of: dict[Path, str] = {}
    for name, path in found.items():
        if (other := photo_of.setdefault(path, name)) != name:
            raise InputError(
                f"{what} {path} would be of {other} and of {name}; call it {PurePosixPath(name).name}{path.suffix} "
                "if it is of the latter"
            )


def read_mask(path: Path, width: int, height: int) -> NDArray[np.uint8]:
    """A mask of a photo's size: 255 where its pixels count, 0 where they do not.

    Raises
    ------
    FileError, InputError
        When it cannot be read, or is of another size.
    """
    pixels = read_plain(path, "mask", cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels.shape != (height, width):
        raise InputError(
            f"mask {path} has {pixels.shape[1]}x{pixels.shape[0]} pixels, its photo {width}x{height}; "
            "masks are of the stored photo, not rotated"
        )
    if pixels.any() and pixels.max() < 128:
        raise InputError(f"mask {path} holds values up to {pixels.max()}, expected 0 and 255; nothing of it is white")
    # masks kept as JPEG are not quite black and white
    return np.where(pixels >= 128, 255, 0).astype(np.uint8)
