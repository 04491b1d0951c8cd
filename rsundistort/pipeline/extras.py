"""What `rectify` writes beside the photos: maps for other programs, and other images of the same frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import FileError, InputError
from ..io import MAX_MEGAPIXELS, find_masks, output_name, read_photo, write_image
from ..model import Camera, Depth, RowMotion
from ..model.orientation import turn_pixels
from ..rectify import INTERPOLATIONS, MAP_KINDS, RemapGrid, rectify, remap_grid

__all__ = ["Extras", "find_extras"]


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

    def write(
        self,
        out: Path,
        name: str,
        stem: str,
        camera: Camera,
        motion: RowMotion | None,
        shutter_model: str,
        new_camera: Camera,
        depth: Depth,
        orientation: int = 1,
        max_megapixels: float = MAX_MEGAPIXELS,
    ) -> None:
        """Write what belongs to one photo; `orientation` is how its rectified photo is turned.

        Raises
        ------
        FileError, InputError
            When an image cannot be read, rectified or written; it is named.
        """
        for folder, (files, interpolation) in self.also.items():
            if name not in files:
                continue
            path = files[name]
            try:
                image = read_photo(path, max_megapixels)
                pixels, _ = rectify(image.pixels, camera, motion, shutter_model, new_camera, interpolation, depth=depth)
                target = out / "also" / folder.name
                target.mkdir(parents=True, exist_ok=True)
                write_image(target / output_name(path.name), turn_pixels(pixels, orientation), image.metadata, 98)
            except (FileError, InputError) as error:
                raise InputError(f"{folder.name}/{path.name}: {error}") from error
        if self.maps is not None:
            grid = remap_grid(camera, motion, shutter_model, new_camera, depth)
            if orientation != 1:
                map_x, map_y = (turn_pixels(each, orientation) for each in (grid.map_x, grid.map_y))
                grid = RemapGrid(map_x, map_y, grid.source_width, grid.source_height)
            (out / "maps").mkdir(exist_ok=True)
            ending = MAP_KINDS[self.maps]
            grid.save(out / "maps" / f"{stem}.forward{ending}", self.maps)
            grid.inverse().save(out / "maps" / f"{stem}.inverse{ending}", self.maps)


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
    if maps is not None and maps not in MAP_KINDS:
        raise InputError(f"maps={maps!r}, expected one of {', '.join(MAP_KINDS)}")
    found: dict[Path, tuple[Mapping[str, Path], str]] = {}
    for folder, interpolation in also:
        if interpolation not in INTERPOLATIONS:
            raise InputError(f"interpolation={interpolation!r}, expected one of {', '.join(INTERPOLATIONS)}")
        folder = folder.resolve()  # "." and ".." have no name of their own
        if folder.name in {other.name for other in found}:
            raise InputError(f"two folders named {folder.name} would both go to also/{folder.name}; rename one")
        found[folder] = find_masks(folder, names, "image"), interpolation
    return Extras(maps, found)
