"""How long cameras take to read a frame: facts of others, each with its source, in `readout_times.csv`.

They convert rotations per frame into rotations per second, and say which samples of a gyroscope belong to a photo. A
solution never depends on them.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from .tables import read_table

__all__ = ["readout_time"]

_TABLE = Path(__file__).with_name("readout_times.csv")


def readout_time(make: str, model: str, width: int, height: int) -> tuple[float, str] | None:
    """Time of the readout of a frame, by camera and size of its pictures; None if it is not in the table.

    A camera reads another number of lines in each of its modes, so the size counts, whichever way round. Where a source
    names no size, its time is that of the camera's largest photos, and is given for any size that is not in the table.

    Parameters
    ----------
    make, model : str
        As EXIF has them; case, spaces and hyphens do not matter.
    width, height : int
        Of the picture as it was stored, not resized since.

    Returns
    -------
    seconds, source
        From the first line to the last, and who measured it.

    Examples
    --------
    >>> readout_time("DJI", "FC8482", 4032, 3024)
    (0.021, 'OpenDroneMap, ODM PR 1859 (Mini 4 Pro)')
    """
    sizes = _table().get(_key(make, model), {})
    found = sizes.get((max(width, height), min(width, height)))
    if found is None and (0, 0) in sizes:
        seconds, source = sizes[0, 0]
        found = seconds, f"{source}, for no stated size"
    return found


def _key(make: str, model: str) -> str:
    """A camera's name in one spelling, whoever writes it: "NIKON CORPORATION", "NIKON Z 9" -> "nikoncorporationz9"."""
    words = [re.sub(r"[^\w+ ]", " ", text.replace("\0", "").casefold()).split() for text in (make, model)]
    brand = words[0][:1]
    return "".join(words[0] + (words[1][1:] if brand and words[1][:1] == brand else words[1]))


@cache
def _table() -> dict[str, dict[tuple[int, int], tuple[float, str]]]:
    """Times and sources by camera and size, the longer side first; (0, 0) where none is stated."""
    found: dict[str, dict[tuple[int, int], tuple[float, str]]] = {}
    for row in read_table(_TABLE)[1]:
        size = int(row["width"] or 0), int(row["height"] or 0)
        key = max(size), min(size)
        times = found.setdefault(_key(row["make"], row["model"]), {})
        times[key] = float(row["readout_ms"]) / 1e3, row["source"]
    return found
