"""Photos in and out, always in the stored pixel frame of the sensor: the EXIF orientation is carried, never applied."""

from __future__ import annotations

import subprocess
import sys
import warnings

# Before cv2 and before anybody's pycolmap. pycolmap exports a zlib of its own; if the system's zlib is first loaded
# after it, the two get mixed and whatever compresses (PNG, Python's own zlib) aborts the process.
import zlib  # noqa: F401
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, MetadataWarning

__all__ = [
    "PHOTO_SUFFIXES",
    "RAW_SUFFIXES",
    "Photo",
    "list_photos",
    "output_name",
    "read_photo",
    "write_image",
]

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
RAW_SUFFIXES = (".dng", ".nef", ".cr2", ".cr3", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")


@dataclass(frozen=True)
class Photo:
    """Pixels of a photo with its metadata.

    Attributes
    ----------
    pixels : (h, w) or (h, w, 3 | 4) array
        uint8, uint16 or float32 in OpenCV's channel order (BGR), in the stored frame.
    metadata : tuple of (kind, bytes)
        EXIF, XMP and ICC blocks as OpenCV names them; empty where OpenCV cannot read them.
    """

    pixels: NDArray[Any]
    metadata: tuple[tuple[int, NDArray[np.uint8]], ...] = ()


def list_photos(folder: Path) -> list[str]:
    """Names of the photos in a folder, sorted; files of other kinds and hidden ones are passed over."""
    folder = Path(folder)
    if not folder.is_dir():
        raise FileError(f"{folder} is no folder; give the folder that holds the photos")
    names = sorted(
        entry.name
        for entry in folder.iterdir()
        if entry.suffix.lower() in PHOTO_SUFFIXES + RAW_SUFFIXES and not entry.name.startswith(".") and entry.is_file()
    )
    outputs: dict[str, str] = {}
    for name in names:
        other = outputs.setdefault(output_name(name), name)
        if other != name:
            raise InputError(f"{other} and {name} would both be rectified to {output_name(name)}; move one away")
    if not names:
        kinds = ", ".join(s[1:] for s in PHOTO_SUFFIXES) + " and RAW"
        raise FileError(f"no photos in {folder}; it should hold files of the kinds {kinds}")
    return names


def output_name(name: str) -> str:
    """Name of a rectified photo: the photo's own; RAW becomes TIFF."""
    path = Path(name)
    return f"{path.stem}.tif" if path.suffix.lower() in RAW_SUFFIXES else name


def _is_whole(data: bytes) -> bool:
    """Whether a JPEG or PNG has its end; some decoders fill what is missing with grey and say nothing."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return data.rfind(b"IEND") > 0
    if data[:2] != b"\xff\xd8":
        return True
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:  # segments before the pixels
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return data.find(b"\xff\xd9", at) > 0


def read_photo(path: Path) -> Photo:
    """A photo as the sensor stored it.

    Parameters
    ----------
    path : Path
        JPEG, PNG, TIFF, WebP (8 or 16 bit, float TIFF), or RAW.

    Raises
    ------
    FileError
        When the file is missing, cut short or no photo.
    """
    path = Path(path)
    if path.suffix.lower() in RAW_SUFFIXES:
        return Photo(_read_raw(path))
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FileError(f"{path.name} cannot be read: {error.strerror}") from error
    if not data or not _is_whole(data):
        raise FileError(f"{path.name} is cut short or empty; copy it again from the camera")
    buffer = np.frombuffer(data, np.uint8)
    metadata: tuple[tuple[int, NDArray[np.uint8]], ...] = ()
    try:
        if hasattr(cv2, "imdecodeWithMetadata"):
            pixels, kinds, blocks = cv2.imdecodeWithMetadata(buffer, flags=cv2.IMREAD_UNCHANGED)
            metadata = tuple((int(k), np.asarray(b)) for k, b in zip(np.ravel(kinds), blocks, strict=True))
        else:
            pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FileError(f"{path.name} cannot be decoded: {error.err}") from error
    if pixels is None or pixels.size == 0:
        raise FileError(f"{path.name} cannot be decoded; it is no whole photo of a known kind")
    return Photo(pixels, metadata)


def _read_raw(path: Path) -> NDArray[np.uint16]:
    """Developed RAW, 16 bit, camera white balance, in the sensor's rows (not turned by the tag)."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            rgb = raw.postprocess(use_camera_wb=True, output_bps=16, user_flip=0, no_auto_bright=True)
    except (rawpy.LibRawError, OSError) as error:
        reason = error.args[0] if error.args else error
        text = reason.decode(errors="replace") if isinstance(reason, bytes) else str(reason)
        raise FileError(f"{path.name} cannot be developed ({text}); copy it again from the camera") from error
    return np.ascontiguousarray(rgb[..., ::-1])


def _encode_params(suffix: str, quality: int) -> list[int]:
    if suffix in (".jpg", ".jpeg"):
        # colour at full resolution: halved again after the camera halved it, it costs 2 to 4 dB (measured)
        full = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        return [cv2.IMWRITE_JPEG_QUALITY, quality, *full]
    if suffix == ".webp":
        return [cv2.IMWRITE_WEBP_QUALITY, quality]
    if suffix == ".png":
        return [cv2.IMWRITE_PNG_COMPRESSION, 3]
    return []


def write_image(
    path: Path,
    pixels: NDArray[Any],
    metadata: Sequence[tuple[int, NDArray[np.uint8]]] = (),
    quality: int = 95,
) -> None:
    """Write an image of the kind that the path's ending says, whole or not at all.

    Parameters
    ----------
    path : Path
        File to write.
    pixels, metadata
        As in `Photo`.
    quality : int
        Of JPEG and WebP, 1 to 100.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".png" and _compression_is_broken():
        data = _encode_elsewhere(suffix, pixels, quality)
    else:
        data = _encode(suffix, pixels, metadata, quality)
    aside = path.with_name(f".{path.name}.partial")
    try:
        aside.write_bytes(data)
        aside.replace(path)
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise FileError(f"{path} cannot be written: {error.strerror}") from error


def _encode(suffix: str, pixels: NDArray[Any], metadata: Sequence[Any], quality: int) -> bytes:
    params = _encode_params(suffix, quality)
    try:
        if metadata and hasattr(cv2, "imencodeWithMetadata") and suffix not in (".tif", ".tiff"):
            kinds, blocks = zip(*metadata, strict=True)
            done, data = cv2.imencodeWithMetadata(suffix, pixels, list(kinds), list(blocks), params)
        else:
            if metadata:
                warnings.warn(f"EXIF, XMP and ICC are not kept in {suffix[1:]} files", MetadataWarning, stacklevel=3)
            done, data = cv2.imencode(suffix, pixels, params)
    except cv2.error as error:
        raise InputError(f"an image {pixels.shape} {pixels.dtype} cannot be stored as {suffix}: {error.err}") from error
    if not done:
        raise InputError(f"an image {pixels.shape} {pixels.dtype} cannot be stored as {suffix}")
    return bytes(data)


def _compression_is_broken() -> bool:
    """Whether pycolmap was imported before zlib (see the top of this file): then compressing aborts this process."""
    order = list(sys.modules)
    if "pycolmap" not in order:
        return False
    loaded = [order.index(name) for name in ("zlib", "cv2") if name in order]
    return order.index("pycolmap") < min(loaded, default=len(order))


def _encode_elsewhere(suffix: str, pixels: NDArray[Any], quality: int) -> bytes:
    """Encode in a clean process; slower, but this one would abort."""
    code = (
        "import sys, cv2, numpy as np;"
        "shape, dtype, suffix, params = eval(sys.argv[1]);"
        "pixels = np.frombuffer(sys.stdin.buffer.read(), dtype).reshape(shape);"
        "sys.stdout.buffer.write(bytes(cv2.imencode(suffix, pixels, params)[1]))"
    )
    job = repr((pixels.shape, pixels.dtype.str, suffix, _encode_params(suffix, quality)))
    done = subprocess.run(
        [sys.executable, "-c", code, job],
        input=np.ascontiguousarray(pixels).tobytes(),
        capture_output=True,
        check=False,
    )
    if done.returncode or not done.stdout:
        raise InputError(
            "PNG cannot be written because pycolmap was imported before rsundistort in this program; "
            "import rsundistort first"
        )
    return done.stdout
