"""Positions of photos in metres: GPS of EXIF and XMP, and their frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..io import ExifFacts
from ..io.photos.gps import ALTITUDES
from ..model.array_types import Array
from ..model.geodesy import ecef_from_geodetic, enu_axes, enu_from_geodetic

__all__ = ["MapFrame", "PhotoPositions", "check_crs", "frame_at", "frame_of_control", "positions_of"]

# Altitudes of one photo that differ by more are of two datums, metres.
_ANOTHER_DATUM_M = 1.0
# Standard deviation of the height of a photo without altitude, metres.
_UNKNOWN_UP_M = 1e4
# Standard deviation of a barometer's heights during a flight, metres: 10 Pa of weather or wind are 0.8 m of air.
_BAROMETER_M = 1.0
# Heights that differ from altitudes otherwise than the rest by more standard deviations count from another take-off.
_ANOTHER_START = 3.0
# Median absolute deviation to standard deviation, of a normal distribution.
_MAD = 1.4826
# Origins of projections are whole multiples of this, metres.
_ROUND_M = 100.0
# Projections for surveys are true to a fifth of this where they are meant for; heights are not scaled with them.
_MOST_STRETCH = 0.01
# A way from one datum to another that is known worse is reported, metres.
_DATUM_M = 1.0
# Half a step by which projections are differentiated, degrees: ten metres.
_STEP_DEG = 1e-4


@dataclass(frozen=True)
class PhotoPositions:
    """Photos that have a position.

    Attributes
    ----------
    geodetic : (m, 3) array
        Latitude and longitude in degrees, altitude in metres as in the photos.
    sigma_m : (m, 3) array
        Standard deviations east, north and up.
    speed_m_s : (m,) array
        Over ground; NaN where unknown.
    velocity_m_s : (m, 3) array
        East, north and up; NaN where unknown.
    R_cw : (m, 3, 3) array
        From axes east, north and up to those of the camera, by its gimbal; NaN where unknown.
    sigma_from : tuple of str
        Source of the standard deviations.
    common_up_m : float
        Standard deviation of an error that all altitudes share, which `sigma_m` does not contain.
    """

    names: list[str]
    geodetic: Array
    sigma_m: Array
    speed_m_s: Array
    velocity_m_s: Array
    R_cw: Array
    sigma_from: tuple[str, ...]
    notes: tuple[str, ...]
    common_up_m: float = 0.0

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class MapFrame:
    """A frame in metres, x east, y north, z up.

    Attributes
    ----------
    crs : str
        "local": east, north and up at the origin; "control": that of the control points; or a projected one, as
        pyproj takes it, whose coordinates less the origin's are those of the frame.
    origin : (float, float, float)
        Of "local" latitude, longitude and altitude; else what is subtracted from east, north and up.
    convergence_rad : float
        By how much east and north are rotated in the frame, counter-clockwise: a grid's north is not the north pole's.
    """

    crs: str
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    convergence_rad: float = 0.0
    note: str = ""

    def of_geodetic(self, geodetic: Array) -> Array:
        """Places (m, 3) of latitudes, longitudes and altitudes (m, 3)."""
        if self.crs == "local":
            return enu_from_geodetic(geodetic, self.origin)
        return _projected(self.crs, geodetic) - self.origin

    def of_control(self, place_m: Sequence[float]) -> tuple[float, float, float]:
        """The place of a control point, which is given in the CRS."""
        east, north, up = (np.asarray(place_m, np.float64) - self.origin).tolist()
        return east, north, up

    def rotated(self, positions: PhotoPositions) -> PhotoPositions:
        """Positions whose velocities and rotations are along the axes of the frame."""
        c, s = np.cos(self.convergence_rad), np.sin(self.convergence_rad)
        from_enu = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return replace(positions, velocity_m_s=positions.velocity_m_s @ from_enu.T, R_cw=positions.R_cw @ from_enu.T)

    @property
    def target(self) -> str:
        """What `matrix` leads to."""
        return "EPSG:4978" if self.crs == "local" else self.crs

    @property
    def matrix(self) -> Array:
        """(4, 4) from the frame to the CRS; from the local one to metres from the centre of the Earth (EPSG:4978)."""
        value = np.eye(4)
        value[:3, 3] = self.origin
        if self.crs == "local":
            value[:3, :3] = enu_axes(*self.origin[:2]).T
            value[:3, 3] = ecef_from_geodetic(self.origin)
        return value


def check_crs(crs: str | None) -> None:
    """Refuse a CRS that is none in metres, and any if there is no library to read it with."""
    if crs not in (None, "local", "none"):
        _transformer(str(crs))


def _transformer(crs: str) -> Any:
    """The transformation from longitude and latitude of WGS 84 to a projection."""
    try:
        import pyproj
    except ImportError:
        raise InputError(f'--crs {crs} needs pyproj: pip install "rsundistort[survey]"') from None
    pyproj.network.set_network_enabled(False)  # grids are not fetched
    try:
        found = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise InputError(
            f"--crs {crs}: no such CRS; expected local, none, or a projected one such as EPSG:32632"
        ) from None
    if not found.is_projected or found.is_compound:
        kind = "compound" if found.is_compound else found.type_name[:1].lower() + found.type_name[1:]
        raise InputError(f"--crs {crs} ({found.name}) is a {kind}; expected a projected one in metres, without heights")
    units = {axis.unit_name for axis in found.axis_info}
    if units != {"metre"}:
        raise InputError(f"--crs {crs} ({found.name}) is in {', '.join(sorted(units))}; expected one in metres")
    return pyproj.Transformer.from_crs("EPSG:4326", found, always_xy=True)


def _projected(crs: str, geodetic: Array) -> Array:
    """East, north (m) in a projection, and the altitude as it was."""
    east, north = _transformer(crs).transform(geodetic[:, 1], geodetic[:, 0])
    value = np.stack([east, north, geodetic[:, 2]], axis=1)
    if not np.isfinite(value).all():
        raise InputError(f"--crs {crs} does not reach to the photos' GPS; give the CRS of their country or UTM zone")
    return value


def _convergence(crs: str, place: Array) -> float:
    """The rotation of east and north by a projection at a place (3,), which is refused where it stretches them."""
    around = place + _STEP_DEG * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    there, true = _projected(crs, around)[:, :2], enu_from_geodetic(around, place)[:, :2]
    jacobian = np.linalg.solve(true[::2] - true[1::2], there[::2] - there[1::2]).T
    stretch = np.linalg.svd(jacobian, compute_uv=False)
    if np.abs(stretch - 1).max() > _MOST_STRETCH:
        raise InputError(
            f"--crs {crs}: a metre on the ground is up to {stretch[0]:.3g} of its metres there, and heights are "
            "true; give the UTM zone or the national grid of the place"
        )
    if np.linalg.det(jacobian) < 0:
        raise InputError(f"--crs {crs} has axes that are not east and north; give the CRS that has")
    return float(np.arctan2(jacobian[1, 0] - jacobian[0, 1], jacobian[0, 0] + jacobian[1, 1]))


def frame_at(crs: str, geodetic: Array) -> MapFrame:
    """The frame of a CRS at the median of positions (m, 3): at that for "local", else rounded and without a height.

    Raises
    ------
    InputError
        When a projection does not reach there, or is no map in metres there.
    """
    middle = np.median(geodetic, axis=0)
    if crs == "local":
        return MapFrame("local", (float(middle[0]), float(middle[1]), float(middle[2])))
    east, north, _ = np.round(_projected(crs, middle[None])[0] / _ROUND_M) * _ROUND_M
    origin = float(east), float(north), 0.0
    transformer = _transformer(crs)
    transformer.transform(middle[1], middle[0])
    known_m = transformer.get_last_used_operation().accuracy
    note = f"GPS is put into {crs} to {known_m:g} m, since that has a datum of its own" if known_m > _DATUM_M else ""
    return MapFrame(crs, origin, _convergence(crs, middle), note)


def frame_of_control(crs: str, places_m: Array) -> MapFrame:
    """The frame of a projection at the median of places in it (m, 3), as `frame_at`."""
    middle = np.median(places_m, axis=0)
    longitude, latitude = _transformer(crs).transform(middle[0], middle[1], direction="INVERSE")
    place = np.array([latitude, longitude, middle[2]])
    if not np.isfinite(place).all():
        raise InputError(f"--crs {crs} does not reach to the control points; are they in it, E before N?")
    return replace(frame_at(crs, place[None]), note="")


def positions_of(names: Sequence[str], facts: Sequence[ExifFacts]) -> PhotoPositions:
    """The photos that have a position, and remarks on that."""
    fixed = [(name, fact, fact.fix) for name, fact in zip(names, facts, strict=True) if fact.fix is not None]
    placed = [(name, fact, fix) for name, fact, fix in fixed if not fix.is_nowhere]
    notes = []
    nowhere = [name for name, _, fix in fixed if fix.is_nowhere]
    if nowhere:
        notes.append(f"GPS at 0,0 is no position: {_some(nowhere)}")
    fixes = [fix for _, _, fix in placed]
    altitudes = np.array([np.nan if fix.altitude_m is None else fix.altitude_m for fix in fixes])
    known = np.isfinite(altitudes)
    middle = float(np.median(altitudes[known])) if known.any() else 0.0
    if known.any() and not known.all():
        notes.append(f"{(~known).sum()} photos have GPS without an altitude")
    for other in ALTITUDES:
        apart = [
            fix.altitudes_m[other] - fix.altitude_m
            for fix in fixes
            if fix.altitude_m is not None and other in fix.altitudes_m
        ]
        if apart and abs(np.median(apart)) > _ANOTHER_DATUM_M:
            first = next(iter(fixes[0].altitudes_m), "EXIF")
            notes.append(
                f"altitudes are of two datums: {other} is {np.median(apart):+.1f} m from {first}'s, which is taken"
            )
    sigma = np.array([fix.sigma_m for fix in fixes]).reshape(-1, 3)
    sigma[~known, 2] = _UNKNOWN_UP_M
    heights = np.array([np.nan if fix.height_m is None else fix.height_m for fix in fixes])
    altitudes, leveled, common_up_m = _leveled(altitudes, heights, sigma[:, 2])
    by_height = leveled != sigma[:, 2]
    sigma[:, 2] = leveled
    geodetic = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes]).reshape(-1, 2)
    unknown = np.full((3, 3), np.nan)
    return PhotoPositions(
        [name for name, _, _ in placed],
        np.column_stack([geodetic, np.where(known, altitudes, middle)]),
        sigma,
        np.array([np.nan if fix.speed_m_s is None else fix.speed_m_s for fix in fixes]),
        np.array([fix.velocity_m_s or (np.nan,) * 3 for fix in fixes]).reshape(-1, 3),
        # a photo that is stored rotated does not say about which axes
        np.array(
            [fix.R_cw if fact.orientation in (None, 1) and fix.R_cw else unknown for _, fact, fix in placed]
        ).reshape(-1, 3, 3),
        tuple(sorted({fix.sigma_from for fix in fixes} | ({"height above take-off"} if by_height.any() else set()))),
        tuple(notes),
        common_up_m,
    )


def _leveled(altitudes: Array, heights: Array, sigma_up: Array) -> tuple[Array, Array, float]:
    """Altitudes (m,) by heights above the take-off, their standard deviations, and that of their common error.

    Where altitudes and heights of a barometer differ by nearly the same in all photos, the errors of both are nearly
    common, and many photos do not average them out. The rest is as large as these differences scatter, and a metre at
    least. A photo keeps its altitude if that is the better one, or if its difference is another one: it was taken in a
    flight from another place, or one of the two is wrong. NaN is none.
    """
    apart = altitudes - heights
    both = np.isfinite(apart)
    if not both.any():
        return altitudes, sigma_up, 0.0
    middle = float(np.median(apart[both]))
    off = np.abs(apart - middle)
    sigma = max(_BAROMETER_M, _MAD * float(np.median(off[both])))
    better = both & (off <= _ANOTHER_START * sigma) & (sigma < sigma_up)
    if not better.any():
        return altitudes, sigma_up, 0.0
    common_up_m = float(np.median(sigma_up[better]))
    return np.where(better, heights + middle, altitudes), np.where(better, sigma, sigma_up), common_up_m


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f", ... ({len(names)})" if len(names) > 3 else "")
