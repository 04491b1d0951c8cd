"""Where a photo was taken, by the GPS of its EXIF and of the XMP that drones write."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from .exif import Entry, TiffStructure
from .xmp import xmp_values

__all__ = ["ALTITUDES", "GpsFix", "fix_of"]

_LATITUDE_REF, _LONGITUDE_REF, _ALTITUDE_REF, _ALTITUDE, _DOP = 0x0001, 0x0003, 0x0005, 0x0006, 0x000B
_SPEED_REF, _SPEED, _TRACK_REF, _TRACK, _POSITIONING_ERROR = 0x000C, 0x000D, 0x000E, 0x000F, 0x001F
# of kilometres and miles an hour, and knots
_SPEEDS_M_S = {b"K": 1 / 3.6, b"M": 1609.344 / 3600, b"N": 1852 / 3600}

_DJI = ("http://www.dji.com/drone-dji/1.0/",)
_SENSEFLY = ("http://ns.sensefly.com/sensefly/1.0/",)
_PARROT = ("http://www.parrot.com/drone-parrot/1.0/", "http://www.parrot.com/namespace/drone-parrot/1.0/")
_GIMBAL = ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree")
_PARROT_GIMBAL = ("CameraYawDegree", "CameraPitchDegree", "CameraRollDegree")
_ATTITUDE = ("Yaw", "Pitch", "Roll")
_SENSEFLY_ATTITUDE = ("Heading", "PitchAngle", "RollAngle")
_CAMERA = ("http://pix4d.com/camera/1.0/", "http://ns.sensefly.com/Camera/1.0/", "http://ns.pix4d.com/camera/1.0/")

# what a position may claim to be exact to, metres: the lever arm from antenna to lens is of this size
_SIGMA_M = (0.02, 200.0)
# a horizontal error that is not exceeded in 68 % of all cases, over the standard deviation along each axis
_RADIUS_68 = float(np.sqrt(-2 * np.log(1 - 0.68)))
# the vertical is known worse than each horizontal axis by about so much, since no satellites are below
_VERTICAL = 1.7
#: Altitudes of XMP by name, the one to be taken first.
ALTITUDES = ("AbsoluteAltitude", "AltitudeWGS84", "AltitudeAMSL")
#: Standard deviations east, north and up of a position that says nothing of its accuracy, metres, at the dilution of
#: precision that a clear sky has.
DEFAULT_SIGMA_M = (3.0, 3.0, 5.0)
_CLEAR_SKY_DOP = 2.0


@dataclass(frozen=True)
class GpsFix:
    """A position by GPS.

    Attributes
    ----------
    latitude_deg, longitude_deg : float
        North and east positive.
    altitude_m : float or None
        Above whatever the camera takes for zero: the sea, or the ellipsoid.
    sigma_m : (float, float, float)
        Standard deviations east, north and up.
    sigma_from : str
        What says so: "RTK", "accuracy", "positioning error", "DOP", or "default".
    speed_m_s : float or None
        Over ground.
    velocity_m_s : (float, float, float) or None
        East, north and up.
    altitudes_m : mapping of str to float
        All altitudes that the photo holds, by name.
    height_m : float or None
        Above the place of take-off.
    R_cw : three rows of three floats or None
        From east, north and up to the axes of the camera, as gimbal or autopilot measured it.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None
    sigma_m: tuple[float, float, float] = DEFAULT_SIGMA_M
    sigma_from: str = "default"
    speed_m_s: float | None = None
    velocity_m_s: tuple[float, float, float] | None = None
    altitudes_m: Mapping[str, float] = field(default_factory=dict)
    height_m: float | None = None
    R_cw: tuple[tuple[float, float, float], ...] | None = None

    @property
    def is_nowhere(self) -> bool:
        """Whether it is the place in the Atlantic where cameras without a fix are."""
        return self.latitude_deg == 0 and self.longitude_deg == 0


def fix_of(structure: TiffStructure, gps: Mapping[int, Entry], xmp: bytes) -> GpsFix | None:
    """The position of a photo; None without one.

    EXIF counts where both have a value; nothing that is damaged or out of range does.
    """
    stated = _of_xmp(xmp)
    place = _place(structure, gps)
    if place in (None, (0, 0)):
        place = _specified_place(stated) or place
    if place is None:
        return None
    stored = _altitude(structure, gps)
    altitudes = {} if stored is None else {"EXIF": stored}
    altitudes |= {name: stated[name] for name in ALTITUDES if name in stated}
    sigma, sigma_from = _sigma(structure, gps, stated)
    speed = _speed(structure, gps)
    if speed is None:
        speed = _specified_speed(stated)
    return GpsFix(
        *place, next(iter(altitudes.values()), None), sigma, sigma_from, speed, _velocity(structure, gps, stated),
        altitudes, stated.get("RelativeAltitude", stated.get("Height")), _rotation(stated),
    )  # fmt: skip


def _place(structure: TiffStructure, gps: Mapping[int, Entry]) -> tuple[float, float] | None:
    """Latitude and longitude of EXIF."""
    degrees = []
    for ref, positive, negative, most in ((_LATITUDE_REF, b"N", b"S", 90), (_LONGITUDE_REF, b"E", b"W", 180)):
        if ref + 1 not in gps:
            return None
        parts = structure.fractions(gps[ref + 1])
        value = sum(part / 60**k for k, part in enumerate(parts))
        letter = _letter(structure, gps, ref)
        if not 1 <= len(parts) <= 3 or letter not in (positive, negative) or not 0 <= value <= most:
            return None
        degrees.append(value if letter == positive else -value)
    return degrees[0], degrees[1]


def _number(structure: TiffStructure, gps: Mapping[int, Entry], tag: int, low: float, high: float) -> float | None:
    value = structure.first_value(gps[tag]) if tag in gps else None
    return value if isinstance(value, float) and low <= value <= high else None


def _letter(structure: TiffStructure, gps: Mapping[int, Entry], tag: int) -> bytes:
    """What a tag of EXIF says another one refers to; empty where it is missing."""
    return structure.value(gps[tag])[:1].upper() if tag in gps else b""


def _altitude(structure: TiffStructure, gps: Mapping[int, Entry]) -> float | None:
    """That of EXIF: 1 and 3 of its reference are below sea level and below the ellipsoid."""
    height = _number(structure, gps, _ALTITUDE, 0, 2e4)
    below = _number(structure, gps, _ALTITUDE_REF, 0, 3) in (1, 3)
    return None if height is None else -height if below else height


def _speed(structure: TiffStructure, gps: Mapping[int, Entry]) -> float | None:
    speed = _number(structure, gps, _SPEED, 0, 5000)
    unit = _letter(structure, gps, _SPEED_REF) if _SPEED_REF in gps else b"K"
    return None if speed is None or unit not in _SPEEDS_M_S else speed * _SPEEDS_M_S[unit]


def _velocity(
    structure: TiffStructure, gps: Mapping[int, Entry], stated: Mapping[str, float]
) -> tuple[float, float, float] | None:
    """East, north and up; DJI's axes are north, east and down. A track by the compass is not by the map's north."""
    if {"FlightXSpeed", "FlightYSpeed", "FlightZSpeed"} <= stated.keys():
        return stated["FlightYSpeed"], stated["FlightXSpeed"], -stated["FlightZSpeed"]
    speed, track = _speed(structure, gps), _number(structure, gps, _TRACK, 0, 360)
    if speed is None or track is None or _letter(structure, gps, _TRACK_REF) != b"T":
        return None
    return float(speed * np.sin(np.deg2rad(track))), float(speed * np.cos(np.deg2rad(track))), 0.0


def _sigma(
    structure: TiffStructure, gps: Mapping[int, Entry], stated: Mapping[str, float]
) -> tuple[tuple[float, float, float], str]:
    """Standard deviations east, north and up, and what says so, the most direct first."""

    def bounded(*values: float) -> tuple[float, float, float]:
        east, north, up = np.clip(values, *_SIGMA_M).tolist()
        return east, north, up

    if {"RtkStdLon", "RtkStdLat", "RtkStdHgt"} <= stated.keys() and stated["RtkStdLon"] > 0:
        return bounded(stated["RtkStdLon"], stated["RtkStdLat"], stated["RtkStdHgt"]), "RTK"
    across = stated.get("GPSXYAccuracy", 0.0)
    if across > 0:
        up = stated.get("GPSZAccuracy", 0.0)
        return bounded(across, across, up if up > 0 else _VERTICAL * across), "accuracy"
    if (radius := _number(structure, gps, _POSITIONING_ERROR, 1e-3, 1e5)) is not None:
        across = radius / _RADIUS_68
        return bounded(across, across, _VERTICAL * across), "positioning error"
    if (dop := _number(structure, gps, _DOP, 0.1, 100)) is not None:
        return bounded(*(each * dop / _CLEAR_SKY_DOP for each in DEFAULT_SIGMA_M)), "DOP"
    return DEFAULT_SIGMA_M, "default"


def _of_xmp(xmp: bytes) -> dict[str, float]:
    """Numbers that drones write, by name."""
    wanted = {
        _DJI: (
            "GpsLatitude", "GpsLongitude", "GpsLongtitude", "Latitude", "Longitude", "AbsoluteAltitude",
            "RelativeAltitude", "RtkStdLon", "RtkStdLat", "RtkStdHgt", "FlightXSpeed", "FlightYSpeed", "FlightZSpeed",
            *_GIMBAL,
        ),
        _SENSEFLY: (
            "Latitude", "Longitude", "AltitudeAMSL", "AltitudeWGS84", "Height", "GroundSpeed", *_SENSEFLY_ATTITUDE,
        ),
        _PARROT: ("SpeedX", "SpeedY", *_PARROT_GIMBAL),
        _CAMERA: ("GPSXYAccuracy", "GPSZAccuracy", *_ATTITUDE),
    }  # fmt: skip
    found: dict[str, float] = {}
    for name, text in xmp_values(xmp, [(each, names) for spaces, names in wanted.items() for each in spaces]).items():
        above, _, below = text.partition("/")
        try:
            value = float(above) / float(below or 1)
        except (ValueError, ZeroDivisionError):
            continue
        if abs(value) < 1e5:
            found[name] = value
    return found


def _specified_place(stated: Mapping[str, float]) -> tuple[float, float] | None:
    """Latitude and longitude of XMP; some of DJI's have a slip in the name."""
    for latitude, longitude in (
        ("GpsLatitude", "GpsLongitude"), ("GpsLatitude", "GpsLongtitude"), ("Latitude", "Longitude"),
    ):  # fmt: skip
        if latitude in stated and longitude in stated:
            north, east = stated[latitude], stated[longitude]
            if abs(north) <= 90 and abs(east) <= 180 and (north or east):
                return north, east
    return None


def _rotation(stated: Mapping[str, float]) -> tuple[tuple[float, float, float], ...] | None:
    """Yaw, pitch and roll as a rotation; all zeros are those of a camera that does not know them.

    All rotate about the axes ahead, right and down of north, east and down. DJI's camera and Parrot's look ahead at
    zero; that of the `Camera` namespace looks down, the top of its photo ahead (Pix4D, "Yaw, Pitch, Roll and Omega,
    Phi, Kappa angles"). So does that of senseFly's wings, whose angles are those of the aircraft (13 photos solved
    without them: the top of the photo is 0 degrees off the heading in the mean, 10 from photo to photo).
    """
    ahead, below = ((0, 1, 0), (0, 0, 1)), ((0, 1, 0), (-1, 0, 0))
    for names, (right, down) in (
        (_GIMBAL, ahead), (_PARROT_GIMBAL, ahead), (_ATTITUDE, below), (_SENSEFLY_ATTITUDE, below),
    ):  # fmt: skip
        if stated.keys() >= {*names}:
            yaw, pitch, roll = (stated[name] for name in names)
            if any((yaw, pitch, roll)) and abs(yaw) <= 360 and abs(pitch) <= 180 and abs(roll) <= 180:
                axes = np.stack([right, down, np.cross(right, down)])
                rotated = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix()
                north, east, down_w = (rotated @ axes.T).tolist()
                return tuple(zip(east, north, np.negative(down_w).tolist(), strict=True))
    return None


def _specified_speed(stated: Mapping[str, float]) -> float | None:
    if "GroundSpeed" in stated:
        return stated["GroundSpeed"] if stated["GroundSpeed"] >= 0 else None
    for across, ahead in (("FlightXSpeed", "FlightYSpeed"), ("SpeedX", "SpeedY")):
        if across in stated and ahead in stated:
            return float(np.hypot(stated[across], stated[ahead]))
    return None
