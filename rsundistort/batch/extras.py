"""What `rectify` writes beside the photos: maps for other programs, and other images of the same frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from ..errors import InputError
from ..io import find_masks, output_name

__all__ = ["AlsoImage", "Extras", "find_extras"]


@dataclass(frozen=True)
class AlsoImage:
    """Another image of the same frame as a photo.

    Attributes
    ----------
    source : Path
        The image.
    target : str
        Where it goes, in the folder of the outputs.
    interpolation : str
        As `rectify` takes it.
    """

    source: Path
    target: str
    interpolation: str


@dataclass(frozen=True)
class Extras:
    """What is written beside rectified photos.

    Attributes
    ----------
    maps : str or None
        Kind of the maps in `out/maps`, as `RemapGrid.save` takes it.
    also : mapping of folder to (files by photo, interpolation)
        Other images of the same frames; they go to `out/also`, into folders of the same names.
    """

    maps: str | None = None
    also: Mapping[Path, tuple[Mapping[str, Path], str]] = field(default_factory=dict)

    def of(self, name: str) -> tuple[AlsoImage, ...]:
        """The other images of a photo's frame."""
        return tuple(
            AlsoImage(
                files[name],
                (PurePosixPath("also", folder.name) / files[name].relative_to(folder).parent).as_posix()
                + f"/{output_name(files[name].name)}",
                interpolation,
            )
            for folder, (files, interpolation) in self.also.items()
            if name in files
        )


def find_extras(maps: str | None, also: Sequence[tuple[Path, str]], names: Sequence[str]) -> Extras:
    """The extras of photos.

    Parameters
    ----------
    maps : str, optional
        Kind of the maps.
    also : sequence of (folder, interpolation)
        Folders of images of the photos' stems and sizes.
    names : sequence of str
        Photos.
    """
    found: dict[Path, tuple[Mapping[str, Path], str]] = {}
    for folder, interpolation in also:
        folder = folder.resolve()  # "." and ".." have no name of their own
        if folder.name in {other.name for other in found}:
            raise InputError(f"two folders named {folder.name} would both go to also/{folder.name}; rename one")
        found[folder] = find_masks(folder, names, "image"), interpolation
    return Extras(maps, found)
