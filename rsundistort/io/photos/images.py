"""Photos in and out, always in the stored pixel frame of the sensor: the EXIF orientation is carried, never applied."""

from __future__ import annotations

import mmap
import re
import sys
import warnings

# Before cv2 and before anybody's pycolmap. pycolmap exports a zlib of its own; if the system's zlib is first loaded
# after it, the two get mixed and whatever compresses (PNG, Python's own zlib) aborts the process.
import zlib  # noqa: F401
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import DamagedPhotoWarning, FileError, FileKindWarning, InputError, MetadataWarning, file_errors
from ..aside import write_aside
from ..places import Place, files_in, place_of
from .codec_lines import with_lines
from .containers import Parts, metadata_of, with_metadata
from .heif import read_heif
from .kinds import (
    HEIF_SUFFIXES,
    PHOTO_SUFFIXES,
    RAW_SUFFIXES,
    can_hold,
    is_whole,
    kind_of_content,
    kind_of_name,
    picture_size,
)
from .metadata import Metadata
from .raw import read_raw
from .tiff import damaged_strips, encode_tiff, tiff_metadata
from .tiff_pixels import misread_as_plain, read_tiff

__all__ = [
    "LARGEST_SIDE",
    "MAX_MEGAPIXELS",
    "RAW_AS",
    "Photo",
    "check_compression",
    "list_photos",
    "natural_order",
    "output_name",
    "read_photo",
    "read_plain",
    "stored_size",
    "unread_pictures",
    "write_image",
]

# Pictures that are not read: a folder that holds some was meant to have more photos.
_UNREAD = (
    *(".apng", ".avif", ".bmp", ".dib", ".exr", ".fit", ".fits", ".gif", ".hdr", ".j2k", ".jp2", ".jpf", ".jpx"),
    *(".jxl", ".jxr", ".pam", ".pbm", ".pfm", ".pgm", ".pnm", ".ppm", ".psb", ".psd", ".ras", ".tga", ".wdp", ".xcf"),
    # several pictures in one, or of several lenses
    *(".avifs", ".heics", ".insp", ".jps", ".mpo"),
    # RAW that LibRaw unpacks only with libraries of their makers, or that is no more than numbers
    *(".ari", ".bay", ".braw", ".cap", ".eip", ".gpr", ".k25", ".mdc", ".ptx", ".pxn", ".raw", ".rwz"),
)

#: Photos of more pixels are refused, unless specified otherwise: a small file can claim to be a huge picture.
MAX_MEGAPIXELS = 250.0

_SUFFIX_OF = {"JPEG": ".jpg", "PNG": ".png", "WebP": ".webp"}

#: Kinds that RAW and HEIC can be written as.
RAW_AS = ("tif", "jpg", "png")

#: Pixels across or down a photo that `cv2.remap` can count.
LARGEST_SIDE = 32766


@dataclass(frozen=True)
class Photo:
    """Pixels of a photo with its metadata.

    Attributes
    ----------
    pixels : (h, w) or (h, w, 3 | 4) array
        uint8, uint16 or float32 in OpenCV's channel order (BGR), in the stored frame.
    """

    pixels: NDArray[Any]
    metadata: Metadata = field(default_factory=Metadata)


def list_photos(folder: Place | str, raw_as: str = "tif", sub_folders: Collection[str] = ()) -> list[str]:
    """Names of the photos in a folder, by path or URL, 9.jpg before 10.jpg.

    Files of other kinds and hidden ones are passed over.
    Of sub-folders only those named are looked into ("a", "a/b"), if they are there; their photos are "a/name.jpg".
    """
    folder = place_of(folder)
    top = files_in(folder)
    if top is None:
        raise FileError(f"{folder} is no folder; give the folder that holds the photos")
    suffixes = PHOTO_SUFFIXES + HEIF_SUFFIXES + RAW_SUFFIXES
    found = (
        (PurePosixPath(within) / name).as_posix()
        for within, files in ((".", top), *((each, files_in(folder, each)) for each in sorted(sub_folders)))
        for name in files or ()
        if PurePosixPath(name).suffix.lower() in suffixes and not name.startswith(".")
    )
    names = sorted(found, key=natural_order)
    outputs: dict[str, str] = {}
    for name in names:
        other = outputs.setdefault(output_name(name, raw_as), name)
        if other != name:
            raise InputError(
                f"{other} and {name} would both be rectified to {output_name(name, raw_as)}; move one away"
            )
    if not names:
        unread = _unread(top)
        others = f" ({unread[0]} is of no such kind; convert it to PNG or TIFF, and RAW to DNG)" if unread else ""
        raise FileError(
            f"no photos in {folder}; it should hold JPEG, PNG, TIFF, WebP, HEIC or RAW files{others}, and sub-folders "
            "are not searched"
        )
    return names


def natural_order(name: str) -> tuple[tuple[int, str], ...]:
    """Key that sorts 9.jpg before 10.jpg."""
    parts = re.split(r"([0-9]+)", name)
    return (*((int(part), "") if k % 2 else (-1, part) for k, part in enumerate(parts)), (-1, name))


def unread_pictures(folder: Path) -> list[str]:
    """Names of pictures in a folder that `list_photos` passes over, since their kinds are not read."""
    return _unread(files_in(folder) or ())


def _unread(names: Iterable[str]) -> list[str]:
    return [name for name in names if name.lower().endswith(_UNREAD) and not name.startswith(".")]


def output_name(name: str, raw_as: str = "tif") -> str:
    """Name of a rectified photo: the photo's own; RAW and HEIC become one of `RAW_AS`."""
    return Path(name).with_suffix(f".{raw_as}").as_posix() if kind_of_name(name) in ("RAW", "HEIC") else name


def stored_size(path: Path) -> tuple[int, int] | None:
    """Width and height of the pixels in a photo's file by its header; None where that does not say, as of RAW.

    Raises
    ------
    FileError
        When the file cannot be read.
    """
    path = Path(path)
    try:
        with file_errors(path), path.open("rb") as file:
            # only the pages that hold the header are read, wherever they are
            data = cast(bytes, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))  # which is read like bytes
    except ValueError:  # an empty file
        return None
    return picture_size(data, kind_of_content(data, path.name))


def read_photo(path: Path, max_megapixels: float = MAX_MEGAPIXELS) -> Photo:
    """A photo as the sensor stored it.

    The content says what kind it is of; a warning says so where the name's ending says another, unless that is RAW.

    Parameters
    ----------
    path : Path
        JPEG, PNG, TIFF, WebP (8 or 16 bit, float TIFF), RAW, or HEIC (extra `heif`). RAW is developed to 16 bit with
        the camera's white balance; HEIC comes as 16 bit too.
    max_megapixels : float
        Photos with more are refused before they are decoded.

    Raises
    ------
    FileError
        When the file is missing, cut short, no photo or too large.
    """
    path = Path(path)
    stamp = _stamp(path)
    with file_errors(path.name):
        data = path.read_bytes()
    kind = kind_of_content(data, path.name)
    if not data or not is_whole(data):
        raise FileError(f"{path.name} is cut short or empty; copy it again from the camera")
    if not kind:
        raise FileError(f"{path.name} cannot be decoded; it is no photo of a known kind")
    named = kind_of_name(path.name)
    if named == "RAW" != kind:
        # rotated or cropped by whoever made it of the RAW, perhaps: no longer what the sensor's rows saw
        raise FileError(f"{path.name} is {kind} by its content, not RAW; if it is a photo of its own, rename it")

    def check_size(width: int, height: int) -> None:
        if width * height > max_megapixels * 1e6:
            raise FileError(
                f"{path.name} has {width}x{height} pixels, more than the limit of {max_megapixels:g} million; "
                "raise it with --max-pixels if that is true"
            )
        if max(width, height) > LARGEST_SIDE:
            raise FileError(
                f"{path.name} has {width}x{height} pixels; sides above {LARGEST_SIDE} cannot be rectified: cut it up"
            )

    size = picture_size(data, kind)
    if size is not None:
        check_size(*size)
        if not can_hold(data, kind, size):
            raise FileError(
                f"{path.name} has {size[0]}x{size[1]} pixels by its header, far more than its {len(data)} bytes can "
                "hold; copy it again from the camera"
            )
    elif kind in ("JPEG", "PNG", "WebP"):
        raise FileError(f"{path.name} cannot be decoded: its header does not say how large it is; copy it again")
    if kind == "RAW":
        pixels, metadata = read_raw(data, path.name, check_size)
    elif kind == "HEIC":
        pixels, metadata = read_heif(data, path.name)
    else:
        pixels, said = with_lines(
            lambda: (
                read_tiff(data, path.name, lambda stored: _decode(stored, path.name))
                if kind == "TIFF"
                else _decode_file(path, stamp, data)
            )
        )
        if kind == "TIFF" and (count := damaged_strips(data)):
            said = [f"the checksum of {count} of its strips is wrong"]
        if said:
            text = f"{path.name} seems damaged: {said[0]}; if it looks wrong, copy it again from the camera"
            warnings.warn(text, DamagedPhotoWarning, stacklevel=2)
        metadata = tiff_metadata(data) if kind == "TIFF" else metadata_of(data, kind)
    if kind != named:
        warnings.warn(
            f"{path.name} is {kind} by its content{f', not {named}' if named else ''}; it is read as that",
            FileKindWarning,
            stacklevel=2,
        )
    return Photo(pixels, metadata)


def _stamp(path: Path) -> tuple[int, int] | None:
    """Another one when the file has changed."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


def _decode_file(path: Path, stamp: tuple[int, int] | None, data: bytes) -> NDArray[Any]:
    """Pixels of a file that has this content, unless it has changed since `stamp`: then of the content.

    `cv2.imread` with a place for the result decodes into it. `cv2.imdecode` decodes elsewhere and copies, which takes
    half as long again and twice the memory; but it needs no name, and `cv2.imread` opens only ASCII ones everywhere.
    """
    if str(path).isascii():
        try:
            pixels: NDArray[Any] | None = cv2.imread(str(path), None, cv2.IMREAD_UNCHANGED)
        except cv2.error:
            pixels = None
        if pixels is not None and pixels.size and _stamp(path) == stamp:
            return pixels
    return _decode(data, path.name)


def _decode(data: bytes | bytearray, name: str) -> NDArray[Any]:
    try:
        pixels: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FileError(f"{name} cannot be decoded: {error.err}") from error
    if pixels is None or pixels.size == 0:
        raise FileError(f"{name} cannot be decoded; it is no whole photo of a known kind")
    return pixels


def read_plain(path: Path, what: str, flags: int) -> NDArray[Any]:
    """Pixels of a picture that is no photo, such as a mask, without its metadata; `what` it is, for errors.

    Raises
    ------
    FileError
        When it cannot be read or decoded, or claims more pixels than it can hold or than any photo has.
    """
    with file_errors(f"{what} {path}"):
        data = path.read_bytes()
    kind = kind_of_content(data, path.name)
    if not is_whole(data):
        raise FileError(f"{what} {path} cannot be decoded: it is cut short, or damaged")
    size = picture_size(data, kind)
    if size is not None and (size[0] * size[1] > MAX_MEGAPIXELS * 1e6 or not can_hold(data, kind, size)):
        raise FileError(f"{what} {path} has {size[0]}x{size[1]} pixels by its header, more than it can hold")
    if kind == "TIFF" and (misread := misread_as_plain(data)):
        raise FileError(f"{what} {path} is {misread}, which is not read; save it as PNG, or as a plain TIFF")
    try:
        decoded = with_lines(lambda: cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None)
    except cv2.error as error:
        raise FileError(f"{what} {path} cannot be decoded: {error.err}") from error
    pixels, said = decoded
    if pixels is None:
        raise FileError(f"{what} {path} cannot be decoded; it is no picture of a known kind")
    if said:
        warnings.warn(f"{what} {path} seems damaged: {said[0]}", DamagedPhotoWarning, stacklevel=2)
    return np.asarray(pixels)


def _encode_params(kind: str, quality: int, flat: bool) -> list[int]:
    if kind == "JPEG":
        # colour at full resolution: halved again after the camera halved it, it costs 2 to 4 dB (measured)
        full = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        return [cv2.IMWRITE_JPEG_QUALITY, quality, *full]
    if kind == "WebP":
        return [cv2.IMWRITE_WEBP_QUALITY, quality]
    if kind == "PNG" and flat:
        # runs of the difference to the row above: 12 megapixels in 21 ms, not 54, and 18 kB, not 66 (measured)
        up = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP] if hasattr(cv2, "IMWRITE_PNG_FILTER") else []
        return [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE, *up]
    if kind == "PNG":
        return [cv2.IMWRITE_PNG_COMPRESSION, 3]
    return []


def write_image(
    path: Path, pixels: NDArray[Any], metadata: Metadata | None = None, quality: int = 95, flat: bool = False
) -> None:
    """Write an image of the kind that the path's ending says, whole or not at all.

    Parameters
    ----------
    pixels, metadata
        As in `Photo`. JPEG and WebP hold 8 bits: 16-bit pixels are rounded to them. What the metadata says of the size
        is made true; its thumbnail, and what it says of other pictures that were in the file, is left out.
    quality : int
        Of JPEG and WebP, 1 to 100; above 100, WebP is stored without loss.
    flat : bool
        Whether it is of plain areas, as masks are: a PNG is then made in half the time, and smaller.

    Raises
    ------
    InputError
        When a file of that kind cannot hold such pixels; for PNG, when pycolmap was imported before rsundistort.
    FileError
        When it cannot be written.
    """
    path = Path(path)
    parts = _encode(path, np.asarray(pixels), metadata or Metadata(), quality, flat)
    with file_errors(path, "written"):
        write_aside(path, *parts)


def _encode(path: Path, pixels: NDArray[Any], metadata: Metadata, quality: int, flat: bool) -> Parts:
    """The parts of the file."""
    suffix, kind = path.suffix.lower(), kind_of_name(path.name)
    depths = {"PNG": "uint8 uint16", "TIFF": "uint8 uint16 float32", "JPEG": "uint8 uint16", "WebP": "uint8 uint16"}
    if str(pixels.dtype) not in depths.get(kind, "").split():
        raise InputError(
            f"an image {pixels.shape} {pixels.dtype} cannot be stored as {suffix or 'a file without kind'}"
        )
    if kind in ("JPEG", "WebP") and pixels.dtype == np.uint16:
        pixels = np.rint(pixels / np.float32(257)).astype(np.uint8)
    channels = 1 if pixels.ndim == 2 else 3 if kind == "JPEG" else pixels.shape[2]
    metadata, problems = metadata.fitted(pixels.shape[1], pixels.shape[0], channels)
    try:
        if kind == "TIFF":
            data, lost = encode_tiff(pixels, metadata)
            parts: Parts = [data]
        else:
            if kind == "PNG":
                check_compression()
            # by kind: OpenCV does not know each of its endings
            done, array = cv2.imencode(_SUFFIX_OF[kind], pixels, _encode_params(kind, quality, flat))
            if not done:
                raise InputError(f"an image {pixels.shape} {pixels.dtype} cannot be stored as {suffix}")
            parts, lost = with_metadata(array.data, kind, metadata)
    except cv2.error as error:
        raise InputError(f"an image {pixels.shape} {pixels.dtype} cannot be stored as {suffix}: {error.err}") from error
    if lost:
        problems = [*problems, f"not kept: {', '.join(lost)}"]
    if problems:
        warnings.warn(f"{path.name}: {'; '.join(problems)}", MetadataWarning, stacklevel=3)
    return parts


def check_compression() -> None:
    """Refuse to work where pycolmap came before zlib (see the top of this file): PNG would abort the process."""
    order = list(sys.modules)
    if "pycolmap" not in order:
        return
    loaded = [order.index(name) for name in ("zlib", "cv2") if name in order]
    if order.index("pycolmap") < min(loaded, default=len(order)):
        raise InputError(
            "PNG cannot be written: pycolmap was imported before rsundistort, and its zlib is not that of Python; "
            "import rsundistort first, then pycolmap"
        )
