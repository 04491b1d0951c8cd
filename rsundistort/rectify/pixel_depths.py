"""Depths of the pixels of a rectified photo, in rows and at points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .._kernels import depth as kernels
from ..errors import InputError
from ..model import AtInfinity, Camera, Depth, DepthMap, Plane, RowMotion
from ..model.array_types import Array
from ..model.projection import clock_of

__all__ = ["DepthRows", "inverse_depth_at", "stretch"]


def stretch(depth: DepthMap) -> Array:
    """(2,) pixels of the map per pixel of the rectified photo, in x and y."""
    assert depth.size is not None
    rows, cols = depth.depth.shape
    return np.array([cols / depth.size[0], rows / depth.size[1]])


def inverse_depth_at(depth: Depth, xy: Array, rays: Array) -> Array:
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
    camera, motion
        Of the raw photo; the velocity in the camera frame.
    rays : (3, 3) array
        As of `rectified_rays`.
    size : (width, height)
        Of the rectified photo.
    """

    depth: Depth
    camera: Camera
    motion: RowMotion
    rays: Array
    size: tuple[int, int]

    def __post_init__(self) -> None:
        if isinstance(self.depth, DepthMap) and self.depth.size != tuple(self.size):
            wrong = self.depth.size or ()
            raise InputError(
                f"the depth map is one of {'x'.join(map(str, wrong))} pixels, the rectified photo has "
                f"{self.size[0]}x{self.size[1]}; give the map that size, or its size= so that it is stretched"
            )

    def matters(self, shutter_model: str) -> bool:
        """Whether the photo looks otherwise than at infinity."""
        moves = shutter_model == "constant-motion" and self.motion.moves
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

    def mark_hidden(self, row0: int, map_x: NDArray[np.float32], map_y: NDArray[np.float32]) -> None:
        """Point the rows of a grid far outside where something nearer hid what they should show."""
        if isinstance(self.depth, DepthMap):
            kernels.mark_hidden(
                self.depth.inverse, stretch(self.depth), float(self.depth.inverse.max()), self._slopes, self._epipoles,
                self.camera.clock_axis, row0, map_x, map_y,
            )  # fmt: skip

    @cached_property
    def _epipoles(self) -> Array:
        """(lines, 3) where the camera was when it read each line, in homogeneous pixels of the rectified photo."""
        lines = np.arange(self.camera.num_lines, dtype=np.float64)
        way = self.motion.at(clock_of(self.camera, np.stack([lines, lines], axis=1)))[1]
        return np.ascontiguousarray(np.linalg.solve(self.rays, way.T).T)

    @cached_property
    def _slopes(self) -> NDArray[np.float32]:
        """Largest change of the inverse depth per pixel in each tile of the photo and in all that may hide it."""
        assert isinstance(self.depth, DepthMap)
        from scipy.ndimage import maximum_filter

        field, scale = self.depth.inverse, stretch(self.depth)
        steps = np.zeros((2, *field.shape), np.float32)
        steps[0, :, :-1], steps[1, :-1] = np.abs(np.diff(field, axis=1)), np.abs(np.diff(field, axis=0))
        # a cell lies between two rows and two columns
        steps[0, :-1] = np.maximum(steps[0, :-1], steps[0, 1:])
        steps[1, :, :-1] = np.maximum(steps[1, :, :-1], steps[1, :, 1:])
        slope = np.hypot(steps[0] * np.float32(scale[0]), steps[1] * np.float32(scale[1]))
        edges = [
            np.clip((np.arange(0, side, kernels.TILE_PX) + 0.5) * k - 0.5, 0, num - 1).astype(int)
            for side, k, num in zip(self.size[::-1], scale[::-1], field.shape, strict=True)
        ]
        tiles = np.maximum.reduceat(np.maximum.reduceat(slope, edges[0], axis=0), edges[1], axis=1)
        width, height = self.size
        e = np.abs(self._epipoles).max(0)
        reach_px = field.max() * max(e[0] + e[2] * width, e[1] + e[2] * height)
        reach = min(int(np.ceil(reach_px / kernels.TILE_PX)) + 1, max(tiles.shape))
        return np.ascontiguousarray(maximum_filter(tiles, 2 * reach + 1, mode="nearest"))
