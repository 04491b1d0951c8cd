"""The camera: pinhole matrix, lens model and distortion of OpenCV, size, and the way its shutter runs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyroots

from ..errors import InputError
from .array_types import Array
from .checks import check_finite, check_numbers, check_one_of, check_whole, frozen
from .field import folds, spline_coefficients
from .values import ComparedByFields

__all__ = ["LENSES", "READOUTS", "Camera", "check_readout", "opposite", "other_axis"]

#: Readout directions, in the stored pixel frame: (axis of the clock, its sign).
READOUTS: dict[str, tuple[int, float]] = {
    "top-to-bottom": (1, 1.0),
    "bottom-to-top": (1, -1.0),
    "left-to-right": (0, 1.0),
    "right-to-left": (0, -1.0),
}


def check_readout(readout: str, name: str = "readout") -> tuple[int, float]:
    """Axis of the clock of a readout direction (0 of columns, 1 of rows) and its sign; refused if it is none."""
    check_one_of(readout, READOUTS, name)
    return READOUTS[readout]


def other_axis(readout: str) -> str:
    """A readout direction along the other axis; to reverse one is to negate the motion, and changes nothing else."""
    return ("top-to-bottom", "left-to-right")[READOUTS[readout][0]]


def opposite(readout: str) -> str:
    """The readout direction that runs the other way."""
    axis, sign = READOUTS[readout]
    return next(name for name, each in READOUTS.items() if each == (axis, -sign))


#: Lens models, and the names of their coefficients in the order of `Camera.dist`.
LENSES: dict[str, tuple[str, ...]] = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}

# Pixels across or down a photo, and of a focal length or a principal point: numbers beyond are no camera's.
_LARGEST, _FARTHEST = 10**6, 1e9

_DIST_LENGTHS = {"pinhole": (0, 4, 5, 8, 12), "fisheye": (0, 4)}


def _flat(value: Any) -> Any:
    """Coefficients of any of OpenCV's shapes, (n,), (1, n) or (n, 1), in a row."""
    return value.ravel() if isinstance(value, np.ndarray) else np.ravel(np.array(value, object))


def _first_positive(coefficients: Array) -> float:
    """The smallest positive real root of a polynomial, the constant first; inf without one."""
    roots = polyroots(np.trim_zeros(coefficients, "b"))
    real = roots.real[(np.abs(roots.imag) < 1e-12 * (1 + np.abs(roots.real))) & (roots.real > 0)]
    return float(real.min()) if real.size else np.inf


def _fold_radius_squared(lens: str, dist: Array) -> float:
    """Squared undistorted radius up to which the radial part of the lens model is monotonic."""
    k1, k2, _, _, k3, k4, k5, k6 = dist[:8]
    if lens == "fisheye":
        # d/dt [t (1 + k1 t^2 + ...)] = 0 in s = t^2, where t is the angle from the axis
        angle = np.sqrt(_first_positive(np.array([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])))
        return float(np.tan(angle)) ** 2 if angle < np.pi / 2 else np.inf
    # d/dr [r num(r^2)/den(r^2)] = 0  <=>  (num + 2 s num') den - num 2 s den' = 0 with s = r^2
    num, den = np.array([1.0, k1, k2, k3]), np.array([1.0, k4, k5, k6])
    power = 2.0 * np.arange(4)
    slope = np.convolve((1.0 + power) * num, den) - np.convolve(num, power * den)
    return min(_first_positive(slope), _first_positive(den))


@dataclass(frozen=True, eq=False)
class Camera(ComparedByFields):
    """A physical camera in one mode.

    Parameters
    ----------
    width, height : int
        Size of the stored photo in pixels.
    K : (3, 3) array
        Pinhole matrix in pixels with integer pixel centres (OpenCV); no skew.
    dist : (0 | 4 | 5 | 8 | 12,) array
        OpenCV's distortion k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]; of a fisheye k1 k2 k3 k4. Empty is all zero.
    readout : str
        One of `READOUTS`, in the stored pixel frame.
    lens : {"pinhole", "fisheye"}
        Lens model: that of `cv2.projectPoints`, or that of `cv2.fisheye` (Kannala and Brandt 2006; COLMAP's
        OPENCV_FISHEYE), whose radius in the image is a polynomial of the angle from the optical axis.
    field : (rows, cols, 2) array, optional
        What the lens model leaves, in pixels: values of a smooth field at places spread evenly from corner to corner of
        the photo, four or more each way (`model.field`); none when left out.

    Examples
    --------
    >>> camera = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    >>> camera.frame_span
    0.96
    """

    width: int
    height: int
    K: Array
    dist: Array = field(default_factory=lambda: np.zeros(0))
    readout: str = "top-to-bottom"
    lens: str = "pinhole"
    field: Array = field(default_factory=lambda: np.zeros((0, 0, 2)))

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, check_whole(getattr(self, name), name, 1, _LARGEST))
        K = check_finite(self.K, (3, 3), "K")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise InputError(f"K has focal lengths {K[0, 0]:g}, {K[1, 1]:g}; both must be positive")
        if np.abs(K).max() > _FARTHEST or min(K[0, 0], K[1, 1]) < 1 / _FARTHEST:
            raise InputError(f"K={K.tolist()} px, expected focal lengths and a principal point of a camera")
        if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != [0, 0, 1]).any():
            raise InputError("K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew")
        check_one_of(self.lens, LENSES, "lens")
        dist = check_finite(_flat(self.dist), (None,), "dist")
        lengths = _DIST_LENGTHS[self.lens]
        if len(dist) not in lengths:
            raise InputError(f"dist has {len(dist)} numbers, a {self.lens} lens has one of {lengths} in OpenCV's order")
        check_readout(self.readout)
        object.__setattr__(self, "K", frozen(K))
        object.__setattr__(self, "dist", frozen(dist))
        object.__setattr__(self, "field", frozen(self._checked_field()))

    def _checked_field(self) -> Array:
        """The field, refused if it has not enough values, or folds the photo."""
        if not check_numbers(self.field, "field").size:
            return np.zeros((0, 0, 2))
        values = check_finite(self.field, (None, None, 2), "field")
        if min(values.shape[:2]) < 4:
            raise InputError(f"field.shape={values.shape}, expected at least 4 rows and 4 columns")
        if folds(values, self.width, self.height):
            raise InputError(f"field holds values of up to {np.abs(values).max():g} px: it would fold the photo")
        return values

    def varied(self, log_f: float, cx: float, cy: float) -> Camera:
        """The camera with its focal lengths times exp(log_f), its principal point shifted by cx fx and cy fy."""
        K = np.array(self.K)
        K[:2, 2] += [cx * K[0, 0], cy * K[1, 1]]
        K[[0, 1], [0, 1]] *= np.exp(log_f)
        return replace(self, K=K)

    @property
    def clock_axis(self) -> int:
        """Pixel axis along which the photo is read out: 0, x, of columns; 1, y, of rows."""
        return READOUTS[self.readout][0]

    @property
    def clock_sign(self) -> float:
        """1 where the photo is read out along that axis, -1 against it."""
        return READOUTS[self.readout][1]

    @property
    def num_lines(self) -> int:
        """Rows of the photo, or columns, that are read out one after the other."""
        return (self.width, self.height)[self.clock_axis]

    @property
    def frame_span(self) -> float:
        """How far the clock runs over the whole frame: height/fy, or width/fx for column readout."""
        return self.num_lines / float(self.K[self.clock_axis, self.clock_axis])

    @property
    def clock_range(self) -> tuple[float, float]:
        """The clock where the reading of a frame begins and where it ends: at the borders of the photo."""
        axis, sign = self.clock_axis, self.clock_sign
        f, c = float(self.K[axis, axis]), float(self.K[axis, 2])
        first, last = sign * (-0.5 - c) / f, sign * (self.num_lines - 0.5 - c) / f
        return min(first, last), max(first, last)

    @cached_property
    def kernel_args(self) -> tuple[Any, ...]:
        """(intrinsics (4,), lens (13,) or (1, 14), axis, sign) as the kernels take them."""
        lens = np.zeros(13)
        for name, value in self.coefficients.items():
            lens[LENSES["pinhole"].index(name)] = value
        lens[12] = _fold_radius_squared(self.lens, lens)
        if self.lens == "fisheye":
            lens = np.append(lens, 1.0)[None]
        K = self.K
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), lens, self.clock_axis, self.clock_sign

    @property
    def coefficients(self) -> dict[str, float]:
        """The lens coefficients by name, in the order of `LENSES`; zero where `dist` ends before."""
        names = LENSES[self.lens]
        return dict.fromkeys(names, 0.0) | dict(zip(names, self.dist.tolist(), strict=False))

    @property
    def is_pinhole(self) -> bool:
        """Whether the photo is a pinhole's: no lens distortion."""
        return self.lens == "pinhole" and not self.dist.any() and not self.field.any()

    @cached_property
    def spline(self) -> Array:
        """(rows, cols, 2) coefficients of the field's B-splines, as the kernels take them."""
        return spline_coefficients(self.field)

    def without_field(self) -> Camera:
        """The camera of the lens model alone."""
        return replace(self, field=np.zeros((0, 0, 2))) if self.field.size else self

    def pinhole(self) -> Camera:
        """The pinhole camera of the same K, without lens distortion: the default camera of rectified photos."""
        return Camera(self.width, self.height, self.K, np.zeros(0), self.readout)
