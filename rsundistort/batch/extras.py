"""Other images of the same frames as the photos, which are rectified alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ..errors import InputError
from ..io import find_masks, output_name
from ..io.masks import check_one_photo_each

__all__ = ["AlsoImage", "find_extras"]


@dataclass(frozen=True)
class AlsoImage:
    """Another image of the same frame as a photo.

    Attributes
    ----------
    target : str
        Where it goes, in the folder of the outputs.
    interpolation : str
        As `rectify` takes it.
    """

    source: Path
    target: str
    interpolation: str


def find_extras(also: Sequence[tuple[Path, str]], names: Sequence[str]) -> dict[str, list[AlsoImage]]:
    """The other images of the frame of each photo.

    Parameters
    ----------
    also : sequence of (folder, interpolation)
        Folders of images of the photos' stems and sizes; they go to `out/also`, into folders of the same names.

    Raises
    ------
    FileError, InputError
        A folder is missing or has the name of another one; a photo has several images in it, or two photos share one.
    """
    found: dict[str, list[AlsoImage]] = {name: [] for name in names}
    folders: set[str] = set()
    for folder, interpolation in also:
        folder = folder.resolve()  # "." and ".." have no name of their own
        if folder.name in folders:
            raise InputError(f"two folders named {folder.name} would both go to also/{folder.name}; rename one")
        folders.add(folder.name)
        files = find_masks(folder, names, "image")
        check_one_photo_each(files, "image")  # both would be written to one place
        for name, file in files.items():
            within = PurePosixPath("also", folder.name) / file.relative_to(folder).parent / output_name(file.name)
            found[name].append(AlsoImage(file, within.as_posix(), interpolation))
    return found
