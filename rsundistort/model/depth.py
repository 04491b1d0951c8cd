"""How far away what a photo shows is: at infinity, on a plane, or a map. Translation moves pixels by it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .array_types import Array
from .checks import check_array, check_finite, check_number, check_numbers, check_size, frozen
from .values import ComparedByFields

__all__ = ["AtInfinity", "Depth", "DepthMap", "Plane", "check_depth"]


@dataclass(frozen=True)
class AtInfinity:
    """Everything is so far away that the translation of the camera moves nothing."""


@dataclass(frozen=True, eq=False)
class Plane(ComparedByFields):
    """Everything lies on a plane, such as the ground below a drone; beyond its horizon things are at infinity.

    Parameters
    ----------
    normal : (3,) array
        Of any length, in the camera frame at the reference row: x right, y down, z ahead.
    distance : float
        Points X of the plane have `normal @ X = distance * |normal|`; positive, in the unit of the velocity.

    Examples
    --------
    >>> Plane([0, 0, 1], 40.0).inverse_depth([[0.1, 0.2, 1.0]])
    array([0.025])
    """

    normal: Array
    distance: float

    def __post_init__(self) -> None:
        normal = check_finite(self.normal, (3,), "normal")
        length = float(np.linalg.norm(normal))
        if not length > 0:
            raise InputError("the plane's normal is zero")
        if not check_number(self.distance, "distance") > 0:
            raise InputError(f"the plane's distance is {self.distance}, expected a positive number")
        object.__setattr__(self, "normal", frozen(normal / length))

    def inverse_depth(self, rays: ArrayLike) -> Array:
        """1 / s of the points s * ray where rays (..., 3) of the camera frame meet the plane; 0 where they do not."""
        directions = check_numbers(rays, "rays")
        if directions.shape[-1:] != (3,):
            raise InputError(f"rays.shape={directions.shape}, expected (..., 3)")
        return np.maximum(directions @ self.normal / self.distance, 0.0)


@dataclass(frozen=True, eq=False)
class DepthMap(ComparedByFields):
    """A depth for each pixel of the rectified photo.

    Parameters
    ----------
    depth : (h, w) array
        z in the frame of the rectified camera at the reference row, in the unit of the velocity; inf is far. What is
        not known (NaN, 0 or negative) takes the depth of the nearest pixel that is.
    size : (width, height), optional
        Of the rectified photo, when it is not that of the map, which is then stretched over it as `cv2.resize` does;
        in between, inverse depths are interpolated.
    """

    depth: NDArray[np.float32]
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        depth = check_array(self.depth, (None, None), "depth", np.float32)
        if not (depth > 0).any():
            raise InputError("the depth map holds no positive depth")
        size = check_size((depth.shape[1], depth.shape[0]) if self.size is None else self.size)
        object.__setattr__(self, "depth", frozen(depth))
        object.__setattr__(self, "size", size)

    @cached_property
    def inverse(self) -> NDArray[np.float32]:
        """(h, w) inverse depths, without gaps."""
        known = self.depth > 0
        inverse = np.divide(1, self.depth, out=np.zeros_like(self.depth), where=known)
        if not known.all():
            from scipy.ndimage import distance_transform_edt

            nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
            inverse = inverse[tuple(nearest)]
        return inverse


Depth = AtInfinity | Plane | DepthMap


def check_depth(depth: Depth | None) -> None:
    """Refuse what is neither of these."""
    if depth is not None and not isinstance(depth, (AtInfinity, Plane, DepthMap)):
        raise InputError(f"depth: expected AtInfinity, Plane or DepthMap, got {type(depth).__name__}")
