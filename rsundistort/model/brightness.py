"""How bright white is in a photo: its file says how many bits a number has, not how many of them its camera used."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["white_level"]

# Sensors count in so many bits, whatever the file holds.
_BITS = (8, 10, 12, 14)
# White of floats, where whole numbers of one of these depths were converted.
_WHITES = tuple(float((1 << bits) - 1) for bits in (*_BITS, 16))
# Parts of 1 that darker floats fit in, a quarter each as of the depths above.
_PARTS = (1 / 256, 1 / 64, 1 / 16, 1 / 4)
# So few numbers may be brighter than white: defective pixels, and what sharpening adds at edges. Floats may have lights
# that are meant to be brighter.
_FEW, _LIGHTS = 1e-4, 1e-2
_OVERSHOOT = 1.05
_MOST_NUMBERS = 1_000_000


def white_level(photo: NDArray[Any]) -> float:
    """The number that stands for white.

    Of whole numbers the largest of the depth that they fit in: 8, 10, 12, 14 bits, or all of their own. Floats are
    whole numbers that were converted where more than the lights are beyond 1; otherwise 1 is white, or a part of it as
    small as a lower depth would be.

    Parameters
    ----------
    photo : (h, w) or (h, w, 3 | 4) array
        uint8, uint16 or float; a fourth channel is alpha.

    Returns
    -------
    float
        Above 0. The same for the same photo, whatever was read before.

    Examples
    --------
    >>> white_level(np.full((4, 4), 4000, np.uint16))
    4095.0
    >>> white_level(np.full((4, 4), 0.5, np.float32))
    1.0
    """
    values = photo if photo.ndim == 2 else photo[..., :3]
    if values.dtype.kind != "f":
        own = 8 * values.itemsize
        # a photo of the whole range is counted once
        fitting = own
        for bits in reversed([each for each in _BITS if each < own]):
            if np.count_nonzero(values >= 1 << bits) > _FEW * values.size:
                break
            fitting = bits
        return float((1 << fitting) - 1)
    step = max(1, int(np.sqrt(values.size / _MOST_NUMBERS)))
    sample = values[::step, ::step]
    sample = sample[np.isfinite(sample)]
    if not sample.size:
        return 1.0
    lights, level = (float(each) for each in np.quantile(sample, [1 - _LIGHTS, 1 - _FEW]))
    if lights <= _OVERSHOOT:
        return next((part for part in _PARTS if level <= part), 1.0)
    white = next((each for each in _WHITES if lights <= _OVERSHOOT * each), lights)
    return white if lights > white / 4 else lights
