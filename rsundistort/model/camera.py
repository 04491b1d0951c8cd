"""The camera: pinhole matrix, lens model and distortion of OpenCV, size, and the way its shutter runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .checks import check_finite, frozen

__all__ = ["LENSES", "READOUTS", "Camera"]

#: Readout directions, in the stored pixel frame: (axis of the clock, its sign).
READOUTS: dict[str, tuple[int, float]] = {
    "top-to-bottom": (1, 1.0),
    "bottom-to-top": (1, -1.0),
    "left-to-right": (0, 1.0),
    "right-to-left": (0, -1.0),
}

#: Lens models, and how many numbers their distortion may have.
LENSES: dict[str, tuple[int, ...]] = {
    "pinhole": (0, 4, 5, 8, 12),
    "fisheye": (0, 4),
}


def _fold_radius_squared(dist: NDArray[np.float64]) -> float:
    """Squared undistorted radius up to which the radial part of the lens model is monotonic."""
    k1, k2, _, _, k3, k4, k5, k6 = dist[:8]
    # d/dr [r num(r^2)/den(r^2)] = 0  <=>  (num + 2 s num') den - 2 s num den' = 0 with s = r^2
    num = np.polynomial.Polynomial([1.0, k1, k2, k3])
    den = np.polynomial.Polynomial([1.0, k4, k5, k6])
    s = np.polynomial.Polynomial([0.0, 1.0])
    slope = (num + 2 * s * num.deriv()) * den - 2 * s * num * den.deriv()
    roots = np.concatenate([slope.trim().roots(), den.trim().roots()])
    real = roots.real[(np.abs(roots.imag) < 1e-12 * (1 + np.abs(roots.real))) & (roots.real > 0)]
    return float(real.min()) if real.size else np.inf


@dataclass(frozen=True)
class Camera:
    """A physical camera in one mode.

    Parameters
    ----------
    width, height : int
        Size of the stored photo in pixels.
    K : (3, 3) array
        Pinhole matrix in pixels with integer pixel centres (OpenCV); no skew.
    dist : (0 | 4 | 5 | 8 | 12,) array
        OpenCV's distortion k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]; of a fisheye k1 k2 k3 k4.
    readout : str
        One of `READOUTS`, in the stored pixel frame.
    lens : {"pinhole", "fisheye"}
        Lens model: that of `cv2.projectPoints`, or that of `cv2.fisheye` (Kannala and Brandt 2006; COLMAP's
        OPENCV_FISHEYE), whose radius in the image is a polynomial of the angle from the optical axis.

    Examples
    --------
    >>> camera = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> camera.frame_span
    0.96
    """

    width: int
    height: int
    K: NDArray[np.float64]
    dist: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    readout: str = "top-to-bottom"
    lens: str = "pinhole"

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            whole = isinstance(value, (int, float, np.number)) and not isinstance(value, bool) and np.isfinite(value)
            if not whole or int(value) != value or value < 1:
                raise InputError(f"{name}={value!r}, expected a positive whole number")
            object.__setattr__(self, name, int(value))
        K = check_finite(self.K, (3, 3), "K")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise InputError(f"K has focal lengths {K[0, 0]:g}, {K[1, 1]:g}; both must be positive")
        if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != [0, 0, 1]).any():
            raise InputError("K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew")
        if self.lens not in LENSES:
            raise InputError(f"lens={self.lens!r}, expected one of {', '.join(LENSES)}")
        dist = check_finite(np.ravel(self.dist), (None,), "dist")
        if len(dist) not in LENSES[self.lens]:
            raise InputError(
                f"dist has {len(dist)} numbers, a {self.lens} lens has one of {LENSES[self.lens]} in OpenCV's order"
            )
        if self.readout not in READOUTS:
            raise InputError(f"readout={self.readout!r}, expected one of {', '.join(READOUTS)}")
        object.__setattr__(self, "K", frozen(K))
        object.__setattr__(self, "dist", frozen(dist))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Camera):
            return NotImplemented
        return (
            (self.width, self.height, self.readout, self.lens) == (other.width, other.height, other.readout, other.lens)
            and np.array_equal(self.K, other.K)
            and np.array_equal(self.dist, other.dist)
        )

    def __hash__(self) -> int:
        return hash((self.width, self.height, self.readout, self.lens, self.K.tobytes(), self.dist.tobytes()))

    @property
    def frame_span(self) -> float:
        """How far the clock runs over the whole frame: height/fy, or width/fx for column readout."""
        if READOUTS[self.readout][0] == 1:
            return self.height / float(self.K[1, 1])
        return self.width / float(self.K[0, 0])

    @cached_property
    def kernel_args(self) -> tuple[Any, ...]:
        """(intrinsics (4,), lens (13,), axis, sign) as the kernels take them."""
        lens = np.zeros(13)
        lens[: len(self.dist)] = self.dist
        lens[12] = _fold_radius_squared(lens)
        axis, sign = READOUTS[self.readout]
        K = self.K
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), lens, axis, sign

    def pinhole(self) -> Camera:
        """The pinhole camera of the same K, without lens distortion: the default camera of rectified photos."""
        return Camera(self.width, self.height, self.K, np.zeros(0), self.readout)
