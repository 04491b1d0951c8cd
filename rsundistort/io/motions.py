"""Motions known from elsewhere, such as a gyroscope: CSV files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import FormatError
from ..model.array_types import Array
from .tables import read_table

__all__ = ["read_known_motions"]

# A standard deviation of so many radians knows nothing.
_UNKNOWN = 1e6
# rad per frame. No camera is rotated by more: a quarter of a turn in the 10 to 60 ms of a readout.
_MOST = np.pi / 2

Known = dict[str, tuple[Array, Array]]


def read_known_motions(path: Path | str, readout_s: float | None = None) -> Known:
    """Rotations during the readout, radians per frame, and their standard deviations.

    Parameters
    ----------
    path : path
        CSV with a header: `name`; `phi1, phi2, phi3` in radians per frame, or `omega1, omega2, omega3` in radians per
        second, about the camera's axes (x right, y down, z ahead in the stored pixels); and `sigma`, or `sigma1,
        sigma2, sigma3`, in the same unit. An empty cell is an unknown component. Both rotate the world in the camera's
        axes, the way of phi: a gyroscope, which feels the camera rotate, has the other sign (`io.read_gyro` sees to
        it).
    readout_s : float, optional
        Time of the readout of a frame in seconds, which rad/s need.

    Returns
    -------
    dict of photo name to (phi, sigma)
        As `BundleOptions.known_phi` takes them.

    Raises
    ------
    FileError, FormatError
        Not readable; mixed units, missing columns, numbers that are none, sigmas that are not positive, motions beyond
        a quarter of a turn per frame, a name twice.
    """
    path = Path(path)
    columns, rows = read_table(path)
    units = [unit for unit in ("phi", "omega") if any(f"{unit}{k}" in columns for k in (1, 2, 3))]
    if len(units) > 1:
        raise FormatError(f"{path} mixes phi (rad per frame) and omega (rad/s); give one of them")
    if "name" not in columns or not units:
        raise FormatError(f"{path} needs the columns name, phi1, phi2, phi3 (or omega1, omega2, omega3) and sigma")
    scale = 1.0
    if units[0] == "omega":
        if readout_s is None or not readout_s > 0:
            raise FormatError(f"{path} is in rad/s: give the time of the readout, --readout-ms")
        scale = readout_s
    found: Known = {}
    for number, row in enumerate(rows, start=2):
        name = row["name"]
        where = f"{path}, line {number} ({name or 'no name'})"
        if not name or name in found:
            raise FormatError(f"{where}: expected a name, and each once")
        phi, sigma = np.zeros(3), np.full(3, np.inf)
        for k in range(3):
            text = row.get(f"{units[0]}{k + 1}", "")
            spread = row.get(f"sigma{k + 1}") or row.get("sigma", "")
            if not text:
                continue
            try:
                phi[k], sigma[k] = scale * float(text), scale * float(spread)
            except ValueError:
                raise FormatError(f"{where}: {units[0]}{k + 1}={text!r}, sigma={spread!r}: expected numbers") from None
            if not np.isfinite(phi[k]) or not 0 < sigma[k] < _UNKNOWN:
                raise FormatError(
                    f"{where}: {units[0]}{k + 1}={text}, sigma={spread}: sigma must be positive, and an unknown "
                    "component's cell is empty"
                )
            if abs(phi[k]) > _MOST:
                raise FormatError(
                    f"{where}: {units[0]}{k + 1}={text}, which is {abs(phi[k]):.3g} rad while a frame is read; no "
                    "camera rotates so fast: is it in degrees? One degree is 0.01745 rad"
                )
        found[name] = (phi, sigma)
    return found
