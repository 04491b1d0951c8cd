"""Maps by interpolation: the exact model at the nodes of a coarse grid, cubics between, and how far they are off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._kernels import maps as kernels
from ..model import Camera, RowMotion, check_shutter_model
from ..model.array_types import Array, Mask
from ..model.field import add_field
from .maps import EDGE_PX, seen_by

__all__ = ["TOLERANCE_PX", "CoarseGrid", "coarse_grid"]

#: How far an interpolated map may be off, in raw pixels.
TOLERANCE_PX = 0.01
# The error is measured in the middle between nodes, where that of a cubic is largest, or 0.94 of that in the outer
# cells; and doubled, since it may be larger between the measurements, or those in x and y may cancel there.
_SAFETY = 2.0
_SPACINGS = (64, 32, 16, 8)
# A finer grid is worth it while more patches than this would be evaluated pixel by pixel.
_MAX_ROUGH = 0.02
# Cubic through values at 0, 1, 2, 3: its values at 0.5, 1.5, 2.5.
_BETWEEN = np.array([[5, 15, -5, 1], [-1, 9, 9, -1], [1, -5, 15, 5]]) / 16


@dataclass(frozen=True)
class CoarseGrid:
    """The map of a photo at nodes `spacing` pixels apart, in patches of 3 x 3 cells.

    Attributes
    ----------
    nodes_x, nodes_y : (3 m + 1, 3 n + 1) array
        Raw pixels of the lens model, exact; the camera's field is added to each pixel.
    smooth : (m, n) bool array
        Patches that are interpolated; the others are evaluated pixel by pixel.
    spacing : int
        Rectified pixels between nodes.
    error_px : float
        Bound of the error of the interpolation, in x and in y: twice the largest that was measured between the nodes.
    """

    camera: Camera
    motion: RowMotion
    shutter_model: str
    rays: Array
    nodes_x: Array
    nodes_y: Array
    smooth: Mask
    spacing: int
    error_px: float

    def fill(self, row0: int, map_x: NDArray[np.float32], map_y: NDArray[np.float32], seen: NDArray[np.uint8]) -> bool:
        """Fill the rows `row0 ...` of a map and of a mask (255 where the raw photo answers); True if it does all over.

        The mask is exact: pixels within the error of the border of the raw photo are evaluated one by one.
        """
        camera = self.camera
        intr, lens, axis, sign = camera.kernel_args
        # float32 rounds besides, and the field moves the border
        field = camera.field
        band = self.error_px + 1e-3 + float(np.abs(field).max(initial=0.0))
        unseen: int = kernels.interpolate_map(
            check_shutter_model(self.shutter_model), axis, sign, intr, lens, self.motion.kernel_phi, self.rays,
            self.nodes_x, self.nodes_y, self.smooth, self.spacing, band, EDGE_PX, camera.width, camera.height, row0,
            map_x, map_y, seen,
        )  # fmt: skip
        if field.size:
            add_field(camera, map_x, map_y)
            seen[:] = seen_by(map_x, map_y, camera.width, camera.height)
            return bool(seen.all())
        return unseen == 0


def coarse_grid(
    camera: Camera, motion: RowMotion, shutter_model: str, rays: Array, size: tuple[int, int]
) -> CoarseGrid:
    """The coarsest grid of a map that is off by at most `TOLERANCE_PX`.

    Parameters
    ----------
    camera, motion, shutter_model
        As in `init_rectify_map`.
    rays : (3, 3) array
        As of `rectified_rays`.
    size : (width, height)
        Of the rectified photo.
    """
    intr, lens, axis, sign = camera.kernel_args
    model = check_shutter_model(shutter_model)

    def at_nodes(rows: int, cols: int, spacing: int, offset: float) -> tuple[Array, Array]:
        step = np.array([[spacing, 0, offset], [0, spacing, offset], [0, 0, 1.0]])
        x, y = np.empty((rows, cols)), np.empty((rows, cols))
        kernels.fill_map(model, axis, sign, intr, lens, motion.kernel_phi, rays @ step, 0, x, y)
        return x, y

    for spacing in _SPACINGS:
        n, m = (-(-length // (3 * spacing)) for length in size)
        nodes_x, nodes_y = at_nodes(3 * m + 1, 3 * n + 1, spacing, 0.0)
        between_x, between_y = at_nodes(3 * m, 3 * n, spacing, spacing / 2)
        answers = _corners(nodes_x > -1e5).all((1, 3)) & _blocks(between_x > -1e5).all((1, 3))
        off = np.maximum(abs(_interpolated(nodes_x) - between_x), abs(_interpolated(nodes_y) - between_y))
        error = _SAFETY * _blocks(off).max((1, 3))
        smooth = answers & (error <= TOLERANCE_PX)
        if (answers & ~smooth).sum() <= _MAX_ROUGH * answers.sum():
            break
    bound = float(error[smooth].max(initial=0.0))
    return CoarseGrid(camera, motion, shutter_model, rays, nodes_x, nodes_y, smooth, spacing, bound)


def _blocks(values: NDArray[Any]) -> NDArray[Any]:
    """(3 m, 3 n) values by patches: (m, 3, n, 3)."""
    return values.reshape(values.shape[0] // 3, 3, -1, 3)


def _corners(values: NDArray[Any]) -> NDArray[Any]:
    """(3 m + 1, 3 n + 1) nodes by patches, which share those at their rims: (m, 4, n, 4)."""
    rows, cols = (3 * np.arange(length // 3)[:, None] + np.arange(4) for length in values.shape)
    return values[rows][:, :, cols]


def _interpolated(nodes: Array) -> Array:
    """(3 m, 3 n) values in the middles between nodes."""
    m, n = (length // 3 for length in nodes.shape)
    return (_BETWEEN @ (_corners(nodes) @ _BETWEEN.T).reshape(m, 4, -1)).reshape(3 * m, 3 * n)
