"""What a photo's EXIF says of its camera, and of when and where it was taken."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from ...colmap.conventions import quiet_pycolmap
from ...errors import RsUndistortError
from ...model import Camera
from .containers import metadata_of
from .exif import EXIF_IFD, GPS_IFD, ORIENTATION, Damaged, TiffStructure
from .gps import GpsFix, fix_of
from .heif import heif_metadata
from .kinds import kind_of_content
from .xmp import rectified_by

__all__ = ["ExifFacts", "camera_from_exif", "facts_of_exif", "focal_from_exif", "read_exif"]

# diagonal of the 36 x 24 mm frame that 35-mm equivalents refer to (CIPA DCG-001)
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_MAKE, _MODEL, _FOCAL_LENGTH, _DIGITAL_ZOOM_RATIO = 0x010F, 0x0110, 0x920A, 0xA404
_EXPOSURE_TIME, _FLASH = 0x829A, 0x9209
_FOCAL_LENGTH_IN35MM_FILM, _BODY_SERIAL_NUMBER, _LENS_MODEL = 0xA405, 0xA431, 0xA434
_EXIF_IMAGE_WIDTH, _EXIF_IMAGE_HEIGHT = 0xA002, 0xA003
_FOCAL_PLANE_X_RESOLUTION, _FOCAL_PLANE_RESOLUTION_UNIT = 0xA20E, 0xA210
_DATE_TIME_ORIGINAL, _SUB_SEC_TIME_ORIGINAL = 0x9003, 0x9291
# a block of EXIF that says nothing
_EMPTY = b"II*\0" + bytes(4)
# mm per FocalPlaneResolutionUnit: inch, cm, mm, micrometre
_UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


@dataclass(frozen=True)
class ExifFacts:
    """What a photo's EXIF says of its camera and of its capture; None where it says nothing that can be believed.

    Attributes
    ----------
    make, model, lens, serial : str or None
        Maker and model of the camera, model of the lens, serial number of the body.
    focal_35mm : float or None
        Focal length that sees the same diagonal on 36 x 24 mm.
    sensor_width_mm : float or None
        Long side of the sensor, from the resolution of the focal plane.
    digital_zoom : float or None
        Above 1 where the camera enlarged the middle of its picture.
    orientation : int or None
        1 to 8; how to rotate the stored pixels for a person.
    width, height : int or None
        Size of the photo in pixels, as EXIF claims it.
    taken_s : float or None
        When it was taken, by the camera's clock: seconds since the beginning of 1970 there.
    exposure_s : float or None
        How long the shutter was open, seconds.
    rectified_by : str or None
        Version of rsundistort that rectified the photo, of XMP.
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
    taken_s: float | None = None
    exposure_s: float | None = None
    flash: bool | None = None
    fix: GpsFix | None = None
    rectified_by: str | None = None

    @property
    def place_deg(self) -> tuple[float, float] | None:
        """Latitude and longitude by GPS, north and east positive; None of a camera without a fix."""
        return None if self.fix is None or self.fix.is_nowhere else (self.fix.latitude_deg, self.fix.longitude_deg)


def read_exif(path: Path) -> ExifFacts:
    """The facts of a JPEG, PNG, WebP, TIFF, HEIC, DNG or another RAW file that is a TIFF.

    Never raises: what is missing, damaged or not to be believed is None.
    """
    try:
        data = Path(path).read_bytes()
    except OSError:
        return ExifFacts()
    kind = kind_of_content(data, Path(path).name)
    if data[:2] in (b"II", b"MM"):
        return facts_of_exif(data)
    try:
        metadata = heif_metadata(data, Path(path).name) if kind == "HEIC" else metadata_of(data, kind)
    except (KeyError, RsUndistortError):  # a kind without EXIF, or one that needs an extra
        return ExifFacts()
    return facts_of_exif(metadata.exif, metadata.xmp)


def facts_of_exif(block: bytes, xmp: bytes = b"") -> ExifFacts:
    """The facts of an EXIF block, a TIFF structure with or without the head that it has in a JPEG; as `read_exif`.

    An XMP packet contains more on the position, and that a photo was rectified.
    """
    by = rectified_by(xmp)
    try:
        structure = TiffStructure(block.removeprefix(b"Exif\0\0"))
        main = structure.main()[0]
        entries = {**structure.sub(main, EXIF_IFD, "the Exif IFD"), **main}
        gps = structure.sub(main, GPS_IFD, "the GPS IFD")
        facts = _facts({tag: structure.first_value(entry) for tag, entry in entries.items()})
        return replace(facts, fix=fix_of(structure, gps, xmp), rectified_by=by)
    except Damaged:
        return ExifFacts(fix=fix_of(TiffStructure(_EMPTY), {}, xmp), rectified_by=by)


def _facts(tags: dict[int, bytes | float | None]) -> ExifFacts:
    """Facts in the tags of the main and of the EXIF directory."""

    def text(tag: int) -> str | None:
        return _text(tags.get(tag))

    def number(tag: int, low: float, high: float) -> float | None:
        return _number(tags.get(tag), low, high)

    def whole(tag: int, low: int, high: int) -> int | None:
        value = number(tag, low, high)
        return int(value) if value is not None and value == int(value) else None

    focal_mm, flash = number(_FOCAL_LENGTH, 0.5, 3000), whole(_FLASH, 0, 255)
    focal_35mm = number(_FOCAL_LENGTH_IN35MM_FILM, 4, 5000)
    width, height = whole(_EXIF_IMAGE_WIDTH, 1, 10**6), whole(_EXIF_IMAGE_HEIGHT, 1, 10**6)
    sensor = None
    per_unit = number(_FOCAL_PLANE_X_RESOLUTION, 1e-3, 1e9)
    unit_mm = _UNITS_MM.get(whole(_FOCAL_PLANE_RESOLUTION_UNIT, 0, 100) or 2)
    if per_unit and unit_mm and width and height:
        sensor = _number(max(width, height) / per_unit * unit_mm, 1, 100)
    if sensor and focal_mm and focal_35mm:
        # two ways to the same figure; editors that scale a photo leave one of them as it was
        ratio = focal_mm * 36 / sensor / focal_35mm
        sensor = sensor if 0.75 < ratio < 1.33 else None
    return ExifFacts(
        make=text(_MAKE),
        model=text(_MODEL),
        lens=text(_LENS_MODEL),
        serial=text(_BODY_SERIAL_NUMBER),
        focal_mm=focal_mm,
        focal_35mm=focal_35mm,
        sensor_width_mm=sensor,
        digital_zoom=number(_DIGITAL_ZOOM_RATIO, 1, 100),
        orientation=whole(ORIENTATION, 1, 8),
        width=width,
        height=height,
        exposure_s=number(_EXPOSURE_TIME, 1e-7, 3600),
        flash=None if flash is None else bool(flash & 1),
        taken_s=_taken(text(_DATE_TIME_ORIGINAL), text(_SUB_SEC_TIME_ORIGINAL)),
    )


def _taken(date: str | None, fraction: str | None) -> float | None:
    """Seconds of "2026:11:21 16:08:42" and the digits behind the seconds."""
    try:
        whole = datetime.strptime(date or "", "%Y:%m:%d %H:%M:%S") - datetime(1970, 1, 1)
    except ValueError:
        return None
    digits = (fraction or "").strip()
    return whole.total_seconds() + (float(f"0.{digits}") if digits.isascii() and digits.isdigit() else 0.0)


def _text(value: bytes | float | None) -> str | None:
    """A text without the padding of fixed-length fields; None if nothing is left."""
    if not isinstance(value, bytes):
        return None
    stored = value.split(b"\0")[0]
    try:
        text = stored.decode()
    except UnicodeDecodeError:  # old cameras
        text = stored.decode("latin-1")
    text = " ".join("".join(c for c in text if c.isprintable()).split())[:100]
    return text if any(c.isalnum() for c in text) and text.lower() not in ("unknown", "n/a", "none") else None


def _number(value: bytes | float | None, low: float, high: float) -> float | None:
    """The number, if it lies between the bounds."""
    return value if isinstance(value, float) and low <= value <= high else None


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
    pycolmap = quiet_pycolmap()
    try:
        guess = pycolmap.infer_camera_from_image(path)
    except (RuntimeError, ValueError):
        return None
    focal = guess.mean_focal_length() * max(width, height) / max(guess.width, guess.height)
    return focal if guess.has_prior_focal_length and _is_credible(focal, width, height) else None
