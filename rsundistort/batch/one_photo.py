"""What is done to one photo, wherever it is done."""

from __future__ import annotations

import hashlib
import os
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..errors import FileError, InputError, MetadataWarning
from ..io import MAX_MEGAPIXELS, Photo, read_mask, read_photo, write_image
from ..io.outputs import CANNOT_WRITE, held_inside
from ..io.photos.exif import read_orientation
from ..io.places import File, Place, RemoteFile, fetched
from ..model import Depth
from ..model.array_types import Array, Index
from ..model.brightness import white_level
from ..model.orientation import orient_pixels, split_mirror
from ..rectify import MAP_KINDS, RemapGrid, ViewOptions, rectify
from .extras import AlsoImage
from .geometry import PhotoGeometry
from .rectify_options import RectifyOptions

__all__ = ["PhotoDone", "PhotoJob", "applied_part", "check_not_rectified", "feed", "photo_colors", "rectify_photo"]

# the two files of a photo's grid
_WAYS = ("forward", "inverse")
_VERSION = version("rsundistort")  # once: looking it up takes milliseconds, which every photo would wait for


@dataclass(frozen=True)
class PhotoJob:
    """All that rectifying one photo takes; small, and sent to where it is done.

    Attributes
    ----------
    name : str
        Of the photo, for people.
    image, mask : str
        Rectified photo and its mask, in `out`.
    geometry : PhotoGeometry
        All that its remap grid takes.
    posed : bool
        Whether the photo has a pose, which no mirror image has.
    own_mask : Path, RemoteFile or None
        The user's mask of it.
    maps : str or None
        Beginning of the names of the files of its grid, in `out`.
    sample_xy : (k, 2) int array or None
        Raw pixels whose colours are asked for.
    """

    name: str
    source: File
    out: Place
    image: str
    mask: str
    geometry: PhotoGeometry
    posed: bool
    options: RectifyOptions
    own_mask: File | None = None
    also: tuple[AlsoImage, ...] = ()
    maps: str | None = None
    sample_xy: Index | None = None

    @property
    def inputs(self) -> list[File]:
        """The files that are read."""
        given = (self.source, self.own_mask, self.geometry.own_map, *(each.source for each in self.also))
        return [each for each in given if each is not None]

    @property
    def targets(self) -> list[str]:
        """The files that are written, in `out`."""
        maps = []
        if self.maps is not None and self.options.maps is not None:
            maps = [f"{self.maps}.{way}{MAP_KINDS[self.options.maps]}" for way in _WAYS]
        return [self.image, self.mask, *(each.target for each in self.also), *maps]

    def fingerprint(self) -> str:
        """Digest of all that the outputs depend on: they are stale if it changes.

        Files count with size and time of change, all else with its value; a missing photo has no fingerprint ("").
        """
        digest = hashlib.sha256(f"{_VERSION} {cv2.__version__}".encode())
        # where things lie, and which photos are let in, does not change what comes of them; nor does a pose, but for
        # how the photo is rotated
        options = replace(
            self.options, masks=None, again=False, max_megapixels=MAX_MEGAPIXELS, depth="auto", view=ViewOptions(),
            also=(),
        )  # fmt: skip
        posed = self.posed and options.apply_orientation
        try:
            feed(digest, replace(self, out=Path(), posed=posed, options=options, sample_xy=None))
        except OSError:
            return ""
        return digest.hexdigest()[:32]


def feed(digest: Any, value: Any) -> None:
    """Take a value of plain types, arrays, dataclasses and files into a digest."""
    if isinstance(value, RemoteFile):
        if not value.version:
            raise FileError(f"{value} is missing, or nobody knows when it changed")
        digest.update(f"{value.version};".encode())
    elif is_dataclass(value) and not isinstance(value, type):
        for each in fields(value):
            feed(digest, each.name)
            feed(digest, getattr(value, each.name))
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str} {value.shape} ".encode())
        digest.update(np.ascontiguousarray(value).data)
    elif isinstance(value, os.PathLike):
        if os.fspath(value) != ".":
            found = os.stat(value)
            digest.update(f"{found.st_size} {found.st_mtime_ns};".encode())
    elif isinstance(value, Mapping):
        for key in sorted(value):
            feed(digest, key)
            feed(digest, value[key])
    elif isinstance(value, (list, tuple)):
        digest.update(f"{len(value)} ".encode())
        for each in value:
            feed(digest, each)
    else:
        digest.update(f"{value.item() if isinstance(value, np.generic) else value!r};".encode())


@dataclass(frozen=True)
class PhotoDone:
    """Outcome of one photo.

    Attributes
    ----------
    problem : str
        Why it was left out; empty if it was not.
    fingerprint : str
        See `PhotoJob.fingerprint`.
    files : mapping of path in the folder of outputs to int
        What was written, and how many bytes it has.
    orientation : int
        EXIF orientation that was applied.
    depth : (kind, shift_px, whole_shift_px) or None
        As in `PhotoDepth`, of a photo whose camera travelled.
    colors : (k, 3) array or None
        Red, green, blue of `PhotoJob.sample_xy`, 0 to 255.
    """

    name: str
    problem: str = ""
    fingerprint: str = ""
    files: Mapping[str, int] = field(default_factory=dict)
    orientation: int = 1
    depth: tuple[str, float, float] | None = None
    colors: Array | None = None


def check_not_rectified(photo: Photo) -> None:
    """Refuse a photo that is rectified already."""
    by = photo.metadata.rectified_by
    if by is not None:
        raise InputError(f"it was rectified already, by rsundistort {by}; --again rectifies it once more")


def applied_part(orientation: int, posed: bool) -> tuple[int, int]:
    """How a photo's orientation is applied, and what is left of it: mirrors are left where there is a pose."""
    return split_mirror(orientation) if posed else (orientation, 1)


def rectify_photo(job: PhotoJob) -> PhotoDone:
    """Rectify a photo into the folder of the outputs.

    What is wrong with the photo is in the result. That the outputs cannot be written (a full disk) is an error: the
    others would fare no better. Remote files pass through a folder of their own here.
    """
    fingerprint = job.fingerprint()  # before it is read: should it change meanwhile, the result is stale
    if isinstance(job.source, Path) and isinstance(job.out, Path) and not isinstance(job.own_mask, RemoteFile):
        return replace(_rectify(job, job.source, job.own_mask, job.out), fingerprint=fingerprint)
    try:
        with tempfile.TemporaryDirectory(prefix="rsundistort-") as work:
            return replace(_rectify_in(Path(work), job), fingerprint=fingerprint)
    except FileError:
        raise
    except OSError as error:
        here = tempfile.gettempdir()
        raise FileError(f"{here} cannot be written: {error.strerror}; set TMPDIR to another folder") from error


def _rectify_in(work: Path, job: PhotoJob) -> PhotoDone:
    """Rectify a photo by way of a local folder; the result has no fingerprint."""
    try:
        source = fetched(job.source, work / "photo")
        own_mask = None if job.own_mask is None else fetched(job.own_mask, work / "masks")
    except FileError as error:
        return PhotoDone(job.name, str(error))
    if isinstance(job.out, Path):
        done = _rectify(job, source, own_mask, job.out)
    else:
        out = work / "out"
        for name in job.targets:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
        done = _rectify(job, source, own_mask, out)
        for name in reversed([*done.files]):  # the photo last: it is never without its mask
            job.out.write(name, (out / name).read_bytes())
    return replace(done, problem=done.problem.replace(f"{work}{os.sep}", ""))


def _rectify(job: PhotoJob, source: Path, own_mask: Path | None, out: Path) -> PhotoDone:
    """Rectify a photo in local files; the result has no fingerprint."""
    options, geometry = job.options, job.geometry
    files: dict[str, int] = {}
    writing = False
    try:
        photo = read_photo(source, options.max_megapixels)
        if not options.again:
            check_not_rectified(photo)
        own = None if own_mask is None else read_mask(own_mask, geometry.camera.width, geometry.camera.height)
        found = geometry.find_depth()
        pixels, mask = rectify(photo.pixels, *geometry.grid, options.interpolation, mask=own, depth=found.depth)
        colors = None if job.sample_xy is None else _colors(photo, job.sample_xy)
        metadata, applied = photo.metadata.marked(_VERSION), 1
        if options.apply_orientation:
            applied, rest = applied_part(metadata.orientation, job.posed)
            pixels, mask = orient_pixels(pixels, applied), orient_pixels(mask, applied)
            _warn_of_orientation(job.name, photo, rest)
            metadata = metadata.with_orientation(rest)
        del photo, own  # not beside the encoded one
        writing = True
        with held_inside(out, job.image) as path:
            write_image(path, pixels, metadata, options.quality)
            files[job.image] = path.stat().st_size
        with held_inside(out, job.mask) as path:
            write_image(path, mask, flat=True)
            files[job.mask] = path.stat().st_size
        files.update(_write_extras(job, out, found.depth, applied))
    except (FileError, InputError, MemoryError, cv2.error) as error:
        if writing and getattr(error.__cause__, "errno", None) in CANNOT_WRITE:
            raise
        for name in files:  # no photo without its mask
            (out / name).unlink(missing_ok=True)
        return PhotoDone(job.name, " ".join(str(error).split()) or "it does not fit into the memory")
    note = None if found.whole_shift_px is None else (found.kind, found.shift_px, found.whole_shift_px)
    return PhotoDone(job.name, "", "", files, applied, note, colors)


def _write_extras(job: PhotoJob, out: Path, depth: Depth, applied: int) -> Iterator[tuple[str, int]]:
    """Write the other images of a photo's frame and its grids; their names and sizes, each when it is there."""
    for each in job.also:
        try:
            image = read_photo(each.source, job.options.max_megapixels)
            pixels, _ = rectify(image.pixels, *job.geometry.grid, each.interpolation, depth=depth)
        except (FileError, InputError) as error:
            raise InputError(f"{each.source.parent.name}/{each.source.name}: {error}") from error
        with held_inside(out, each.target) as path:
            write_image(path, orient_pixels(pixels, applied), image.metadata, job.options.quality)
            size = path.stat().st_size
        yield each.target, size
    if job.maps is not None and job.options.maps is not None:
        grid = RemapGrid.from_camera(*job.geometry.grid, depth)
        if applied != 1:
            map_x, map_y = (orient_pixels(m, applied) for m in (grid.map_x, grid.map_y))
            grid = RemapGrid(map_x, map_y, grid.source_width, grid.source_height)
        for name, each_way in zip(job.targets[-len(_WAYS) :], (grid, grid.inverse()), strict=True):
            with held_inside(out, name) as path:
                each_way.save(path, job.options.maps)
                size = path.stat().st_size
            yield name, size


def _warn_of_orientation(name: str, photo: Photo, rest: int) -> None:
    stored = read_orientation(photo.metadata.exif)
    if stored != photo.metadata.orientation:
        text = f"{name}: its EXIF orientation {stored} means nothing and is taken for 1"
    elif rest != 1:
        text = (
            f"{name}: mirrored by its EXIF orientation {stored}, it was rotated and keeps the mirror as its orientation"
        )
    else:
        return
    warnings.warn(text, MetadataWarning, stacklevel=2)


def photo_colors(job: PhotoJob) -> Array:
    """(k, 3) colours of a photo that is rectified already, at `PhotoJob.sample_xy`."""
    assert job.sample_xy is not None
    with tempfile.TemporaryDirectory(prefix="rsundistort-") as work:
        return _colors(read_photo(fetched(job.source, Path(work)), job.options.max_megapixels), job.sample_xy)


def _colors(photo: Photo, xy: Index) -> Array:
    """(k, 3) red, green, blue at pixels, 0 to 255."""
    h, w = photo.pixels.shape[:2]
    values = photo.pixels[np.clip(xy[:, 1], 0, h - 1), np.clip(xy[:, 0], 0, w - 1)].astype(float)
    if values.ndim == 1:
        values = np.repeat(values[:, None], 3, axis=1)
    return np.minimum(255.0 / white_level(photo.pixels) * values[:, 2::-1], 255.0)
