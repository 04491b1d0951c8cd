"""Measurements of tracks at full size: the windows of a track's photos are aligned with that of its best view.

Features are found in shrunk photos, and a blob's centre is seen a little differently by each photo. Once poses and
points stand, the geometry says how a window around a point looks in every photo; what is left is a shift of a fraction
of a pixel, which an alignment finds, with its uncertainty, in the full-size photo. It also finds the point where no
feature was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .._kernels.alignment import HALF, align
from ..model import Camera, Observations, Reconstruction
from ..model.projection import project_points
from .features import SIFT_PX

__all__ = ["PatchPlaces", "align_tracks", "cut_patches"]

# Half the side of the cut-outs: a window turned by 45 degrees and stretched by a half, and room for the shift.
_MARGIN = 24
_SIDE = 2 * _MARGIN + 1
# Samples of the window of a feature to its diameter: the window is 2.8 diameters wide.
_PER_SIZE = 5.0
# Of the correlation, below which a measurement, and a point where no feature was, is not believed; of the shift of
# both from where they were expected, in pixels of the image that the features were found in.
_LEAST_MEASURED, _LEAST_NEW = 0.7, 0.85
_MOST_SHIFT = 1.5
# A photo is asked for a point that it does not show by a feature if it looks at it from within this angle of the
# best view, and no more than this factor farther or nearer.
_MOST_ANGLE_DEG, _MOST_SCALE = 30.0, 1.7
# Windows with less contrast (standard deviation in grey levels) hold nothing but noise.
_LEAST_CONTRAST = 3.0
# No alignment is trusted to better than this, in pixels of the finer window's level: interpolation, compression.
_FLOOR_PX = 0.03
# Patches in memory at a time (2.4 kB each).
_BLOCK = 120_000


@dataclass(frozen=True)
class PatchPlaces:
    """Which cut-outs of a photo are wanted.

    Attributes
    ----------
    level : (n,) int array
        Halvings of the photo that they are cut from.
    corner : (n, 2) int array
        Column and row of their first pixel there.
    """

    level: NDArray[np.int64]
    corner: NDArray[np.int64]


def cut_patches(gray: NDArray[np.uint8], places: PatchPlaces) -> NDArray[np.uint8]:
    """(n, side, side) cut-outs of a grey photo; what lies beyond its border repeats the border.

    Pixel k of a level lies at 2^level k of the photo, as `cv2.pyrDown` has it.
    """
    out = np.empty((len(places.level), _SIDE, _SIDE), np.uint8)
    image = gray
    for level in range(int(places.level.max(initial=0)) + 1):
        if level:
            image = np.asarray(cv2.pyrDown(image), np.uint8)
        mine = np.flatnonzero(places.level == level)
        rows = np.clip(places.corner[mine, 1, None] + np.arange(_SIDE), 0, image.shape[0] - 1)
        cols = np.clip(places.corner[mine, 0, None] + np.arange(_SIDE), 0, image.shape[1] - 1)
        out[mine] = image[rows[:, :, None], cols[:, None, :]]
    return out


@dataclass(frozen=True)
class _Windows:
    """Windows of points in photos; a row each.

    Attributes
    ----------
    frame, point : (n,) int array
        Of the reconstruction.
    xy : (n, 2) array
        Their centres, pixels of the photo.
    M : (n, 2, 2) array
        Pixels of the photo to a sample.
    """

    frame: NDArray[np.int64]
    point: NDArray[np.int64]
    xy: NDArray[np.float64]
    M: NDArray[np.float64]

    def select(self, keep: NDArray[np.bool_] | NDArray[np.int64]) -> _Windows:
        return _Windows(self.frame[keep], self.point[keep], self.xy[keep], self.M[keep])

    @property
    def level(self) -> NDArray[np.int64]:
        """(n,) halvings of the photo after which a sample is about a pixel."""
        spacing = np.sqrt(np.abs(np.linalg.det(self.M)))
        return np.asarray(np.clip(np.floor(np.log2(np.maximum(spacing, 1.0)) + 0.5), 0, 6), np.int64)


def align_tracks(
    reconstruction: Reconstruction,
    steps_px: Sequence[float],
    patches_of: Callable[[dict[int, PatchPlaces]], Iterable[tuple[int, NDArray[np.uint8], NDArray[np.bool_] | None]]],
) -> Reconstruction:
    """The reconstruction with measurements aligned at full size, and such where no feature was.

    Parameters
    ----------
    reconstruction : Reconstruction
        Adjusted; its motions and points say how windows look.
    steps_px : (m,) sequence of float
        `Features.step_px` of each photo.
    patches_of : callable
        Given the places of patches by photo, gives (photo, patches as `cut_patches` cuts them, which of them are allowed
        by its mask or None) for each of these photos, in any order.

    Returns
    -------
    Reconstruction
        With new observations, in the order of photos: aligned ones with the deviations that the alignment shows, those
        that could not be aligned as they were. Points, poses and motions stay.
    """
    rec = reconstruction
    step = np.asarray(steps_px, np.float64)
    best, windows = _best_views(rec, step)
    wanted = _wanted(rec, best, windows)
    aligned = _Aligned.nothing(len(wanted.frame))
    order = np.argsort(best.frame[wanted.point], kind="stable")
    for block in np.array_split(order, max(1, -(-2 * len(order) // _BLOCK))):
        aligned.fill(block, _align_block(wanted.select(block), best, patches_of))
    return _measured(rec, step, best, wanted, aligned)


def _best_views(rec: Reconstruction, step: NDArray[np.float64]) -> tuple[_Windows, _Windows]:
    """The window of each point in the photo that sees it best, and that of each measurement.

    The best view is the one from which the others differ least in direction and in scale.
    """
    obs = rec.observations
    windows = _windows_at(rec, obs.frame_idx, obs.point_idx, None)
    ahead = rec.points_w[obs.point_idx] - rec.center_w[obs.frame_idx]
    direction = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    n = rec.num_points
    counts = np.maximum(np.bincount(obs.point_idx, minlength=n), 1)
    middle = np.stack([np.bincount(obs.point_idx, direction[:, k], n) for k in range(3)], 1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    scale = 0.5 * np.log(np.maximum(np.abs(np.linalg.det(windows.M)), 1e-12))
    mean_scale = np.bincount(obs.point_idx, scale, n) / counts
    apart = 2.0 - 2.0 * (direction * middle[obs.point_idx]).sum(1) + (scale - mean_scale[obs.point_idx]) ** 2
    first = np.lexsort((obs.frame_idx, apart, obs.point_idx))
    of_point = first[np.unique(obs.point_idx[first], return_index=True)[1]]
    # where the feature lies, and samples of its size; SIFT's deviation of a position is a measure of the size
    size = 3.0 * step[obs.frame_idx] * np.sqrt(np.maximum((obs.sigma / step[obs.frame_idx]) ** 2 - 1.0, 0.25))
    spacing = np.maximum(size / _PER_SIZE, 1.0)[of_point]
    per_pixel = np.sqrt(np.abs(np.linalg.det(windows.M[of_point])))
    unit = np.full(n, np.nan)
    unit[obs.point_idx[of_point]] = spacing / per_pixel
    best = _Windows(
        obs.frame_idx[of_point],
        obs.point_idx[of_point],
        obs.xy_raw[of_point],
        windows.M[of_point] * unit[obs.point_idx[of_point], None, None],
    )
    return best, replace(windows, xy=obs.xy_raw, M=windows.M * unit[obs.point_idx, None, None])


def _windows_at(
    rec: Reconstruction, frame: NDArray[np.int64], point: NDArray[np.int64], normal: NDArray[np.float64] | None
) -> _Windows:
    """Windows of points where the model predicts them, on planes that face the middle of the photos that see them.

    A sample is a unit of length of the scene times the point's distance from its mean photo; NaN where a photo does not
    see a point.
    """
    if normal is None:
        normal = _facing(rec)
    across = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    down = np.cross(normal, across)
    xy, M = np.full((len(frame), 2), np.nan), np.full((len(frame), 2, 2), np.nan)
    for i in np.unique(frame):
        mine = np.flatnonzero(frame == i)
        camera, motion = rec.camera(int(i)), rec.motion(int(i)).in_camera(rec.R_cw[i])
        X = rec.points_w[point[mine]]
        small = 1e-4 * np.linalg.norm(X - rec.center_w[i], axis=1, keepdims=True)
        ends = [X, X + small * across[point[mine]], X + small * down[point[mine]]]
        places = [
            project_points((end - rec.center_w[i]) @ rec.R_cw[i].T, camera, motion, rec.shutter_model)[0]
            for end in ends
        ]
        xy[mine] = places[0]
        M[mine] = np.stack([places[1] - places[0], places[2] - places[0]], axis=2) / small[:, :, None]
    return _Windows(frame, point, xy, M)


def _facing(rec: Reconstruction) -> NDArray[np.float64]:
    """(n, 3) mean direction from which the photos see each point."""
    obs = rec.observations
    ahead = rec.center_w[obs.frame_idx] - rec.points_w[obs.point_idx]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    total = np.stack([np.bincount(obs.point_idx, ahead[:, k], rec.num_points) for k in range(3)], 1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))
