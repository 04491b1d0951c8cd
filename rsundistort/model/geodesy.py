"""Places on the Earth in metres: the ellipsoid of WGS 84, and the frame that points east, north and up at a place."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .array_types import Array

__all__ = ["ecef_from_geodetic", "enu_axes", "enu_from_geodetic"]

# semi-major axis and flattening of WGS 84 (NGA.STND.0036, 2014)
_A_M, _F = 6378137.0, 1 / 298.257223563
_E2 = _F * (2 - _F)


def ecef_from_geodetic(geodetic: ArrayLike) -> Array:
    """Metres from the centre of the Earth (..., 3) of latitude and longitude in degrees and height in metres (..., 3).

    The height is above the ellipsoid; one above sea level shifts all places of a survey alike, and scales them by a
    hundred-thousandth at most.
    """
    latitude, longitude, height = np.moveaxis(np.asarray(geodetic, np.float64), -1, 0)
    phi, lam = np.deg2rad(latitude), np.deg2rad(longitude)
    normal = _A_M / np.sqrt(1 - _E2 * np.sin(phi) ** 2)
    out = (normal + height) * np.cos(phi)
    return np.stack([out * np.cos(lam), out * np.sin(lam), (normal * (1 - _E2) + height) * np.sin(phi)], axis=-1)


def enu_axes(latitude_deg: float, longitude_deg: float) -> Array:
    """Unit vectors east, north and up at a place, as rows (3, 3) in the axes of `ecef_from_geodetic`."""
    phi, lam = np.deg2rad([latitude_deg, longitude_deg])
    (sp, cp), (sl, cl) = (np.sin(phi), np.cos(phi)), (np.sin(lam), np.cos(lam))
    return np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


def enu_from_geodetic(geodetic: ArrayLike, origin: ArrayLike) -> Array:
    """Metres east, north and up (..., 3) of an origin, both as `ecef_from_geodetic` takes them."""
    origin = np.asarray(origin, np.float64)
    offset = ecef_from_geodetic(geodetic) - ecef_from_geodetic(origin)
    return np.asarray(offset @ enu_axes(origin[0], origin[1]).T)
