"""What a photo's EXIF says of its camera."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..model import Camera

__all__ = ["ExifFacts", "camera_from_exif", "facts_of_exif", "focal_from_exif", "read_exif"]

# diagonal of the 36 x 24 mm frame that 35-mm equivalents refer to (CIPA DCG-001)
_FILM_DIAGONAL_MM = math.hypot(36, 24)
# mm per FocalPlaneResolutionUnit: inch, cm, mm, micrometre
_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


@dataclass(frozen=True)
class ExifFacts:
    """What a photo's EXIF says of its camera; None where it says nothing that can be believed.

    Attributes
    ----------
    make, model, lens, serial : str or None
        Maker and model of the camera, model of the lens, serial number of the body.
    focal_mm : float or None
        Focal length in mm.
    focal_35mm : float or None
        Focal length that sees the same diagonal on 36 x 24 mm.
    sensor_width_mm : float or None
        Long side of the sensor, from the resolution of the focal plane.
    digital_zoom : float or None
        Above 1 where the camera enlarged the middle of its picture.
    orientation : int or None
        1 to 8; how to turn the stored pixels for a person.
    width, height : int or None
        Size of the photo in pixels, as EXIF claims it.
    """

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    serial: str | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    sensor_width_mm: float | None = None
    digital_zoom: float | None = None
    orientation: int | None = None
    width: int | None = None
    height: int | None = None


def read_exif(path: Path) -> ExifFacts:
    """The facts of a JPEG, PNG, WebP, TIFF, HEIC, DNG or another RAW file that is a TIFF.

    Never raises: what is missing, damaged or not to be believed is None. It changes Python's filters of warnings while
    it reads, so it is not for several threads at once.
    """
    with _quiet():
        try:
            block = _exif_block(Path(path))
        except Exception:  # Pillow raises whatever it tripped over
            block = b""
    return facts_of_exif(block)


def facts_of_exif(block: bytes) -> ExifFacts:
    """The facts of an EXIF block, a TIFF structure with or without the head that it has in a JPEG; as `read_exif`."""
    from PIL import Image
    from PIL.ExifTags import IFD

    exif = Image.Exif()
    with _quiet():
        try:
            exif.load(block)
            return _facts({**_entries(exif.get_ifd(IFD.Exif)), **_entries(exif)})
        except Exception:  # as above; what was read before is good
            return _facts(_entries(exif))


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the warnings that Pillow gives of damage."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _exif_block(path: Path) -> bytes:
    """The EXIF block of a photo; empty if there is none."""
    from PIL import ImageFile, JpegImagePlugin, PngImagePlugin, WebPImagePlugin

    # not Image.open, which refuses photos of 180 megapixels and more before it has read their EXIF
    openers: dict[bytes, type[ImageFile.ImageFile]] = {
        b"\xff\xd8": JpegImagePlugin.JpegImageFile,
        b"\x89P": PngImagePlugin.PngImageFile,
        b"RI": WebPImagePlugin.WebPImageFile,
    }
    with path.open("rb") as file:
        head = file.read(12)
        file.seek(0)
        if head[:2] in (b"II", b"MM"):
            return file.read()
        if head[4:8] == b"ftyp":  # with the extra that reads it
            import pillow_heif

            return bytes(pillow_heif.open_heif(file).info.get("exif") or b"")
        return bytes(openers[head[:2]](file).info.get("exif", b"")) if head[:2] in openers else b""


def _facts(tags: dict[int, Any]) -> ExifFacts:
    """What the tags of the main and of the EXIF directory say."""
    from PIL.ExifTags import Base

    def text(tag: int) -> str | None:
        return _text(tags.get(tag))

    def number(tag: int, low: float, high: float) -> float | None:
        return _number(tags.get(tag), low, high)

    def whole(tag: int, low: int, high: int) -> int | None:
        value = number(tag, low, high)
        return int(value) if value is not None and value == int(value) else None

    focal_mm = number(Base.FocalLength, 0.5, 3000)
    focal_35mm = number(Base.FocalLengthIn35mmFilm, 4, 5000)
    width, height = whole(Base.ExifImageWidth, 1, 10**6), whole(Base.ExifImageHeight, 1, 10**6)
    sensor = None
    per_unit = number(Base.FocalPlaneXResolution, 1e-3, 1e9)
    unit_mm = _UNITS_MM.get(whole(Base.FocalPlaneResolutionUnit, 0, 100) or 2)
    if per_unit and unit_mm and width and height:
        sensor = _number(max(width, height) / per_unit * unit_mm, 1, 100)
    if sensor and focal_mm and focal_35mm:
        # two ways to the same figure; editors that scale a photo leave one of them as it was
        ratio = focal_mm * 36 / sensor / focal_35mm
        sensor = sensor if 0.75 < ratio < 1.33 else None
    return ExifFacts(
        make=text(Base.Make),
        model=text(Base.Model),
        lens=text(Base.LensModel),
        serial=text(Base.BodySerialNumber),
        focal_mm=focal_mm,
        focal_35mm=focal_35mm,
        sensor_width_mm=sensor,
        digital_zoom=number(Base.DigitalZoomRatio, 1, 100),
        orientation=whole(Base.Orientation, 1, 8),
        width=width,
        height=height,
    )


def _entries(directory: Any) -> dict[int, Any]:
    """A directory without the entries that cannot be read."""
    found = {}
    for tag in list(directory):
        try:
            found[tag] = directory[tag]
        except Exception:  # as above; the other entries may be good
            continue
    return found


def _text(value: Any) -> str | None:
    """A text without the padding of fixed-length fields; None if nothing is left."""
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    if not isinstance(value, str):
        return None
    value = value.split("\0")[0]
    with contextlib.suppress(UnicodeError):  # Pillow takes every text for Latin-1, cameras write UTF-8 too
        value = value.encode("latin-1").decode()
    value = " ".join("".join(c for c in value if c.isprintable()).split())[:100]
    return value if any(c.isalnum() for c in value) and value.lower() not in ("unknown", "n/a", "none") else None


def _number(value: Any, low: float, high: float) -> float | None:
    """The number, or the first of several, if it lies between the bounds."""
    if isinstance(value, tuple) and value:
        value = value[0]
    if isinstance(value, str):  # of another type than it should be
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if low <= number <= high else None


def focal_from_exif(facts: ExifFacts, width: int, height: int) -> float | None:
    """Focal length in pixels of a photo of this size, from the sensor's size or else the 35-mm equivalent.

    The photo is taken to show all of the frame: of one that was cut, EXIF knows the focal length only before the cut.
    """
    if facts.focal_mm and facts.sensor_width_mm:
        focal = facts.focal_mm / facts.sensor_width_mm * max(width, height) * (facts.digital_zoom or 1)
    elif facts.focal_35mm:
        focal = facts.focal_35mm / _FILM_DIAGONAL_MM * math.hypot(width, height)
    else:
        return None
    return focal if _is_credible(focal, width, height) else None


def _is_credible(focal: float, width: int, height: int) -> bool:
    return 0.2 * max(width, height) < focal < 20 * max(width, height)


def camera_from_exif(path: Path, width: int, height: int, readout: str = "top-to-bottom") -> Camera | None:
    """A camera with the focal length of the photo's EXIF and the centre as principal point; None without one.

    Where EXIF has neither the sensor's size nor a 35-mm equivalent, pycolmap's table of sensor widths by make and model
    is asked.
    """
    focal = focal_from_exif(read_exif(path), width, height) or _focal_of_model(path, width, height)
    if focal is None:
        return None
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(width, height, K, readout=readout)


def _focal_of_model(path: Path, width: int, height: int) -> float | None:
    import pycolmap

    pycolmap.logging.minloglevel = 3
    try:
        guess = pycolmap.infer_camera_from_image(path)
    except (RuntimeError, ValueError):
        return None
    focal = guess.mean_focal_length() * max(width, height) / max(guess.width, guess.height)
    return focal if guess.has_prior_focal_length and _is_credible(focal, width, height) else None
