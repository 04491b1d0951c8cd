"""Depths of the pixels of a rectified photo, in rows and at points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .._kernels import depth as kernels
from ..errors import InputError
from ..model import AtInfinity, Camera, Depth, DepthMap, Plane, RowMotion

__all__ = ["DepthRows", "inverse_depth_at", "stretch"]


def stretch(depth: DepthMap) -> NDArray[np.float64]:
    """(2,) pixels of the map per pixel of the rectified photo, in x and y."""
    assert depth.size is not None
    rows, cols = depth.depth.shape
    return np.array([cols / depth.size[0], rows / depth.size[1]])


def inverse_depth_at(depth: Depth, xy: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) inverse depths of what pixels (n, 2) of the rectified photo show; `rays` as of `rectified_rays`."""
    if isinstance(depth, Plane):
        return depth.inverse_depth(np.column_stack([xy, np.ones(len(xy))]) @ rays.T)
    inverse = np.zeros(len(xy))
    if isinstance(depth, DepthMap):
        known = np.isfinite(xy).all(1)
        found = np.empty(int(known.sum()))
        kernels.sample_points(depth.inverse, stretch(depth), xy[known], found)
        inverse[known] = found
    return inverse


@dataclass(frozen=True)
class DepthRows:
    """A depth of a rectified photo, for one strip of it after the other.

    Parameters
    ----------
    depth : Depth
        Of the photo.
    rays : (3, 3) array
        As of `rectified_rays`.
    size : (width, height)
        Of the rectified photo.
    """

    depth: Depth
    rays: NDArray[np.float64]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        if isinstance(self.depth, DepthMap) and self.depth.size != tuple(self.size):
            wrong = self.depth.size or ()
            raise InputError(
                f"the depth map is one of {'x'.join(map(str, wrong))} pixels, the rectified photo has "
                f"{self.size[0]}x{self.size[1]}; give the map that size, or its size= so that it is stretched"
            )

    def matters(self, motion: RowMotion, shutter_model: str) -> bool:
        """Whether a photo of this motion looks otherwise than at infinity."""
        moves = shutter_model == "constant-motion" and bool(motion.velocity.any())
        return moves and not isinstance(self.depth, AtInfinity)

    def inverse(self, row0: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Inverse depths of the rows from row0 on."""
        rows, cols = shape
        inverse = np.zeros((rows, cols), np.float32)
        if isinstance(self.depth, Plane):
            u, v = np.arange(cols), row0 + np.arange(rows)[:, None]
            along = self.depth.normal @ self.rays / self.depth.distance
            inverse[:] = np.maximum(along[0] * u + along[1] * v + along[2], 0.0)
        elif isinstance(self.depth, DepthMap):
            kernels.sample_rows(self.depth.inverse, stretch(self.depth), row0, inverse)
        return inverse

    def mark_hidden(
        self, camera: Camera, motion: RowMotion, row0: int, map_x: NDArray[np.float32], map_y: NDArray[np.float32]
    ) -> None:
        """Point the rows of a grid far outside where something nearer hid what they should show."""
        if not isinstance(self.depth, DepthMap):
            return
        intr, _, axis, sign = camera.kernel_args
        field = self.depth.inverse
        epipole = np.linalg.solve(self.rays, motion.velocity)
        kernels.mark_hidden(
            field, stretch(self.depth), float(field.max()), epipole, axis, sign, intr, row0, map_x, map_y
        )
