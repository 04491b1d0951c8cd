"""Options of the rectification of each photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import InputError
from ..io import MAX_MEGAPIXELS, RAW_AS
from ..io.places import local_place
from ..model.checks import check_fields
from ..rectify import INTERPOLATIONS, MAP_KINDS, ViewOptions
from .geometry import DEPTHS, check_depth

__all__ = ["RectifyOptions"]


@dataclass(frozen=True)
class RectifyOptions:
    """Options of the rectification of each photo.

    Parameters
    ----------
    interpolation : {"cubic", "linear", "lanczos", "nearest"}
        Of the rectified photos.
    quality : int
        Of JPEG and WebP, 1 to 100.
    raw_as : {"tif", "jpg", "png"}
        What RAW and HEIC are written as: 16 bit, but for jpg.
    apply_orientation : bool
        Rotate the rectified photos, their masks, cameras and poses by the EXIF orientation, which then is 1.
    again : bool
        Take photos that are rectified already.
    max_megapixels : float
        Photos with more pixels are left out before they are decoded.
    masks : path or URL, optional
        Folder of masks, as `io.find_masks` takes it: nothing of what is black in them is in the masks of the rectified
        photos.
    depth : str or Path
        How far away what the photos show is, for the constant-motion model: "auto", "infinity", "plane", "points", or a
        folder of depth maps, as `io.find_depth_maps` takes it. "auto" is the plane nearest to most points where it
        predicts the depths as well as a map between the points does, else that map; and infinity for photos that it
        would change by half a pixel at most.
    view : ViewOptions
        What the rectified photos show and how large they are; by default as the solution has it.
    maps : {"npz", "exr", "stmap"}, optional
        Write each photo's remap grid and its inverse into `maps`, as `RemapGrid.save` does.
    also : sequence of (folder, interpolation)
        Folders of other images of the same frames (labels, depth, near infrared), of the photos' stems and sizes: they
        are rectified alike into `also`.
    """

    interpolation: str = "cubic"
    quality: int = 98
    raw_as: str = "tif"
    apply_orientation: bool = False
    again: bool = False
    max_megapixels: float = MAX_MEGAPIXELS
    masks: Path | str | None = None
    depth: str | Path = "auto"
    view: ViewOptions = field(default_factory=ViewOptions)
    maps: str | None = None
    also: Sequence[tuple[Path, str]] = ()

    @property
    def inputs(self) -> list[Path | str]:
        """Folders that are read: of masks, other images and depth maps."""
        found = [self.masks, *(folder for folder, _ in self.also), None if str(self.depth) in DEPTHS else self.depth]
        return [each for each in found if each is not None]

    def __post_init__(self) -> None:
        check_fields(self)
        check_depth(self.depth)
        for folder, _ in self.also:
            local_place(folder)
        for interpolation in (self.interpolation, *(each for _, each in self.also)):
            if interpolation not in INTERPOLATIONS:
                raise InputError(f"interpolation={interpolation!r}, expected one of {', '.join(INTERPOLATIONS)}")
        if self.maps is not None and self.maps not in MAP_KINDS:
            raise InputError(f"maps={self.maps!r}, expected one of {', '.join(MAP_KINDS)}")
        if self.raw_as not in RAW_AS:
            raise InputError(f"raw_as={self.raw_as!r}, expected one of {', '.join(RAW_AS)}")
        if not self.max_megapixels > 0:
            raise InputError(f"max_megapixels={self.max_megapixels!r}, expected a positive number")
        if not 1 <= self.quality <= 100:
            raise InputError(f"quality={self.quality!r}, expected 1 to 100")
