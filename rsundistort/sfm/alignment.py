"""Measurements of tracks at full size: the windows of a track's photos are aligned with that of its best view.

Features are detected in reduced photos, and each photo sees the centre of a blob a little differently. With poses and
points the geometry predicts the appearance of a window around a point in every photo; what is left is a shift of a
fraction of a pixel, which an alignment finds, with its uncertainty, in the full-size photo. It also finds the point
where no feature was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array

from .._kernels.alignment import HALF, align
from ..model import Observations, Reconstruction
from ..model.array_types import Array, Index, Mask
from ..model.projection import project_points
from .features import SIFT_PX, size_of_sigma

__all__ = ["PatchPlaces", "PatchSource", "align_places", "align_tracks", "allowed_patches", "cut_patches"]

# Half the side of the cut-outs: a window rotated by 45 degrees and stretched by a half, and room for the shift.
_MARGIN = 24
_SIDE = 2 * _MARGIN + 1
# Samples of the window of a feature to its diameter: the window is 2.8 diameters wide.
_PER_SIZE = 5.0
# Smallest correlation of a measurement, and of a point without a feature; largest shift of both from the prediction, in
# pixels of the image that the features were detected in.
_LEAST_MEASURED, _LEAST_NEW = 0.7, 0.85
_MOST_SHIFT = 1.5
# A point without a feature is searched for in a photo that sees it from within this angle of the best view, and from a
# distance that differs by this factor at most; a feature is aligned from farther off, since its descriptor was alike,
# and points that only two photos show are searched for as far, since they are lost otherwise.
_MOST_ANGLE_DEG, _MOST_SCALE = 30.0, 1.7
_WIDE_ANGLE_DEG, _WIDE_SCALE = 60.0, 2.0
# Windows with less contrast (standard deviation in grey levels) hold nothing but noise.
_LEAST_CONTRAST = 3.0
# No alignment is more exact than this, in pixels of the finer window's level: interpolation, compression.
_FLOOR_PX = 0.03
# Points in common from which photos are searched for each other's points, and the largest number of these; nothing is
# searched nearer to the border.
_LEAST_COMMON, _MOST_PARTNERS, _BORDER_PX = 15, 30, 8
# Photos with this many measurements get no more.
_ENOUGH = 4000
# Patches in memory at a time (2.4 kB each).
_BLOCK = 120_000


@dataclass(frozen=True)
class PatchPlaces:
    """Cut-outs of a photo.

    Attributes
    ----------
    level : (n,) int array
        Halvings of the photo before they are cut.
    corner : (n, 2) int array
        Column and row of their first pixel there.
    """

    level: Index
    corner: Index


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
        # blocks of a wider photo are copied row by row, in a sixth of the time of pixels by their indices
        wider = cv2.copyMakeBorder(image, _SIDE, _SIDE, _SIDE, _SIDE, cv2.BORDER_REPLICATE)
        blocks = np.lib.stride_tricks.sliding_window_view(wider, (_SIDE, _SIDE))
        x, y = np.clip(places.corner[mine] + _SIDE, 0, np.array(blocks.shape[1::-1]) - 1).T
        out[mine] = blocks[y, x]
    return out


def allowed_patches(mask: NDArray[np.uint8] | None, places: PatchPlaces) -> Mask:
    """(n,) whether nothing of the cut-outs' middle parts, where windows lie, is masked."""
    allowed = np.ones(len(places.level), bool)
    if mask is None:
        return allowed
    hidden = cv2.integral((mask == 0).astype(np.uint8))
    scale = (1 << places.level)[:, None]
    low = np.clip((places.corner + _MARGIN // 2) * scale, 0, [mask.shape[1], mask.shape[0]])
    high = np.clip((places.corner + _SIDE - _MARGIN // 2) * scale, 0, [mask.shape[1], mask.shape[0]])
    inside = (
        hidden[high[:, 1], high[:, 0]] - hidden[low[:, 1], high[:, 0]]
        - hidden[high[:, 1], low[:, 0]] + hidden[low[:, 1], low[:, 0]]
    )  # fmt: skip
    return np.asarray(inside == 0)


def align_places(
    first: NDArray[np.uint8], second: NDArray[np.uint8], first_xy: Array, second_xy: Array,
    spacing: float, most_px: float,
) -> tuple[Array, Mask]:  # fmt: skip
    """Where a grey photo shows what lies at places of another one, whose windows may be rotated, stretched and sheared.

    A window that is only shifted ends up where the middle of its texture fits, which is not the place itself: what is
    wrong then grows as the photos change, and all places of a slanted plane err alike.

    Parameters
    ----------
    first_xy, second_xy : (n, 2) array
        Places in the first, and about where they are in the second.
    spacing : float
        Pixels from sample to sample of the windows, which have 15 x 15.
    most_px : float
        How far the places in the second may be off.

    Returns
    -------
    places : (n, 2) array
        In the second.
    found : (n,) bool array
        Which of them are right: their windows lie inside both photos and are alike, and were no farther off.
    """
    n = len(first_xy)
    at = np.asarray(np.concatenate([first_xy, second_xy]), np.float64)
    corner = np.asarray(np.rint(at), np.int64) - _MARGIN
    level = np.zeros(n, np.int64)
    patches = np.concatenate([
        cut_patches(photo, PatchPlaces(level, each)) for photo, each in ((first, corner[:n]), (second, corner[n:]))
    ])  # fmt: skip
    place, M = np.stack(np.split(at - corner, 2), 1), np.broadcast_to(spacing * np.eye(2), (n, 2, 2, 2)).copy()
    centre, correlation, covariance = np.full((n, 2), np.nan), np.empty(n), np.empty((n, 2, 2))
    align(patches, np.arange(n), n + np.arange(n), place, M, _LEAST_CONTRAST, centre, correlation, covariance)
    places = np.asarray(centre + corner[n:], np.float64)
    # NaN is not believed
    found = (correlation >= _LEAST_MEASURED) & (np.linalg.norm(places - second_xy, axis=1) <= most_px)
    reach = HALF * spacing
    for xy, photo in ((first_xy, first), (places, second)):
        found &= np.all((xy >= reach) & (xy <= np.array(photo.shape[::-1]) - 1 - reach), axis=1)
    return places, np.asarray(found)


#: What reads photos: places by photo to (photo, patches, which of them its mask allows).
PatchSource = Callable[[Mapping[int, PatchPlaces]], Iterable[tuple[int, NDArray[np.uint8], Mask]]]


@dataclass(frozen=True)
class _Windows:
    """Windows of points in photos; a row each.

    Attributes
    ----------
    frame, point : (n,) int array
        Of the reconstruction.
    xy : (n, 2) array
        Their centres, pixels of the photo; NaN where a photo cannot see a point.
    M : (n, 2, 2) array
        Pixels of the photo to a sample.
    """

    frame: Index
    point: Index
    xy: Array
    M: Array

    def select(self, keep: NDArray[Any]) -> _Windows:
        return _Windows(self.frame[keep], self.point[keep], self.xy[keep], self.M[keep])

    @property
    def spacing(self) -> Array:
        """(n,) pixels from sample to sample."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.M))))

    @property
    def level(self) -> Index:
        """(n,) halvings of the photo after which that is about one."""
        return np.asarray(np.clip(np.floor(np.log2(np.maximum(self.spacing, 1.0)) + 0.5), 0, 6), np.int64)


@dataclass(frozen=True)
class _Aligned:
    """Results of windows: places, correlations, and deviations in pixels; NaN for failures."""

    xy: Array
    correlation: Array
    sigma_px: Array


def align_tracks(reconstruction: Reconstruction, steps_px: Sequence[float], patches_of: PatchSource) -> Reconstruction:
    """The reconstruction with measurements aligned at full size, and new ones where no feature was.

    Parameters
    ----------
    reconstruction : Reconstruction
        Adjusted; its motions and points predict the windows.
    steps_px : (m,) sequence of float
        `Features.step_px` of each photo.
    patches_of : callable
        Given the places of patches by photo, gives (photo, patches as `cut_patches` cuts them, which of them its mask
        allows) for each of these photos, in any order.

    Returns
    -------
    Reconstruction
        With new observations; those that could not be aligned are as they were, and points that only two photos show
        are left out, since nothing checks them. Points, poses and motions stay.
    """
    rec, step = reconstruction, np.asarray(steps_px, np.float64)
    normal = _facing(rec)
    measured = replace(
        _windows_at(rec, rec.observations.frame_idx, rec.observations.point_idx, normal), xy=rec.observations.xy_raw
    )
    of_point, unit = _best_views(rec, step, measured)
    measured = replace(measured, M=measured.M * unit[measured.point, None, None])
    best = measured.select(of_point)
    wanted = _joined([measured, *_further(rec, best, unit, normal)])
    aligned = _Aligned(*(np.full((len(wanted.frame), *shape), np.nan) for shape in ((2,), (), ())))
    # photos of a point are near each other in the order of their best views: few have to be read twice
    order = np.argsort(best.frame[wanted.point], kind="stable")
    order = order[_looks_alike(rec, best, wanted)[order]]
    for block in np.array_split(order, -(-2 * len(order) // _BLOCK) or 1):
        _align_block(wanted, block, best, patches_of, aligned)
    return _with_aligned(rec, step, of_point, wanted, aligned)


def _joined(parts: Sequence[_Windows]) -> _Windows:
    return _Windows(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(_Windows)))


def _facing(rec: Reconstruction) -> Array:
    """(n, 3) mean direction from which the photos see each point."""
    obs = rec.observations
    back = _directions(rec, obs.frame_idx, obs.point_idx)
    total = -np.stack([np.bincount(obs.point_idx, back[:, k], rec.num_points) for k in range(3)], 1)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12))


def _directions(rec: Reconstruction, frame: Index, point: Index) -> Array:
    """(n, 3) unit vectors from photos to points."""
    ahead = rec.points_w[point] - rec.center_w[frame]
    return np.asarray(ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12))


def _windows_at(rec: Reconstruction, frame: Index, point: Index, normal: Array) -> _Windows:
    """Windows of points where the model predicts them, on planes with these normals; a sample is a unit of length."""
    across = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    down = np.cross(normal, across)
    xy, M = np.full((len(frame), 2), np.nan), np.full((len(frame), 2, 2), np.nan)
    for i in np.unique(frame).tolist():
        mine = np.flatnonzero(frame == i)
        k = point[mine]
        X = rec.points_w[k] - rec.center_w[i]
        small = 1e-4 * np.linalg.norm(X, axis=1, keepdims=True)
        at, right, below = (
            project_points(
                each @ rec.R_cw[i].T, rec.camera(i), rec.motion(i).in_camera(rec.R_cw[i]), rec.shutter_model
            )[0]
            for each in (X, X + small * across[k], X + small * down[k])
        )
        xy[mine] = at
        M[mine] = np.stack([right - at, below - at], axis=2) / small[:, :, None]
    return _Windows(frame, point, xy, M)


def _best_views(rec: Reconstruction, step: Array, measured: _Windows) -> tuple[Index, Array]:
    """(n,) measurement of each point from which the others differ least in direction and scale, and samples' lengths.

    A sample is as long as gives the window of that photo the size of the feature.
    """
    obs, n = rec.observations, rec.num_points
    direction, middle = _directions(rec, obs.frame_idx, obs.point_idx), -_facing(rec)
    scale = np.log(np.maximum(measured.spacing, 1e-300))
    counts = np.maximum(np.bincount(obs.point_idx, minlength=n), 1)
    mean = (np.bincount(obs.point_idx, scale, n) / counts)[obs.point_idx]
    apart = 2.0 - 2.0 * (direction * middle[obs.point_idx]).sum(1) + (scale - mean) ** 2
    apart[~np.isfinite(apart)] = np.inf
    order = np.lexsort((obs.frame_idx, apart, obs.point_idx))
    of_point = order[np.unique(obs.point_idx[order], return_index=True)[1]]
    size = size_of_sigma(obs.sigma[of_point], step[obs.frame_idx[of_point]])
    return of_point, np.maximum(size / _PER_SIZE, 1.0) / measured.spacing[of_point]


def _further(rec: Reconstruction, best: _Windows, unit: Array, normal: Array) -> Iterator[_Windows]:
    """Windows of points in photos that may show them, but measured none there; a photo at a time."""
    obs, m = rec.observations, rec.num_images
    ones = np.ones(len(obs), np.int64)
    seen = coo_array((ones, (obs.frame_idx, obs.point_idx)), shape=(m, rec.num_points)).tocsr()
    counts = np.bincount(obs.frame_idx, minlength=m)
    for i in np.flatnonzero(counts < _ENOUGH).tolist():
        mine = seen.indices[seen.indptr[i] : seen.indptr[i + 1]]
        common = np.bincount(obs.frame_idx[np.isin(obs.point_idx, mine)], minlength=m)
        common[i] = 0
        partners = np.argsort(-common, kind="stable")[:_MOST_PARTNERS]
        open_ = np.isin(best.frame, partners[common[partners] >= _LEAST_COMMON])
        open_[mine] = False
        points = np.flatnonzero(open_)
        windows = _windows_at(rec, np.full(len(points), i), points, normal)
        size = np.array([rec.camera(i).width, rec.camera(i).height])
        # NaN is not inside
        inside = np.all((windows.xy >= _BORDER_PX) & (windows.xy <= size - 1 - _BORDER_PX), axis=1)
        yield replace(windows, M=windows.M * unit[points, None, None]).select(inside)


def _looks_alike(rec: Reconstruction, best: _Windows, windows: _Windows) -> Mask:
    """Windows that may be aligned with the best view of their points: seen from a similar direction and distance.

    The first windows are those of the observations.
    """
    of = best.select(windows.point)
    cosine = (_directions(rec, windows.frame, windows.point) * _directions(rec, of.frame, of.point)).sum(1)
    is_measured = np.arange(len(windows.frame)) < len(rec.observations)
    is_wide = is_measured | (rec.track_lengths(np.ones(len(rec.observations), bool))[windows.point] < 3)
    angle, scale = np.where(is_wide, _WIDE_ANGLE_DEG, _MOST_ANGLE_DEG), np.where(is_wide, _WIDE_SCALE, _MOST_SCALE)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.abs(np.log(windows.spacing / of.spacing))
        alike = (cosine > np.cos(np.deg2rad(angle))) & (ratio < np.log(scale))
    finite = np.isfinite(windows.xy).all(1) & np.isfinite(windows.M).all((1, 2)) & np.isfinite(of.M).all((1, 2))
    return np.asarray(alike & finite & (windows.frame != of.frame))


def _align_block(wanted: _Windows, rows: Index, best: _Windows, patches_of: PatchSource, aligned: _Aligned) -> None:
    """Align these rows of the wanted windows with the best views of their points."""
    points, number = np.unique(wanted.point[rows], return_inverse=True)
    # patches of the best views first, then those of the rows
    windows = _joined([best.select(points), wanted.select(rows)])
    level = windows.level
    scale = np.exp2(level)[:, None]
    at = windows.xy / scale
    corner = np.asarray(np.rint(at), np.int64) - _MARGIN
    places, mine = {}, {}
    for frame in np.unique(windows.frame).tolist():
        mine[frame] = np.flatnonzero(windows.frame == frame)
        places[frame] = PatchPlaces(level[mine[frame]], corner[mine[frame]])
    patches = np.zeros((len(level), _SIDE, _SIDE), np.uint8)
    allowed = np.zeros(len(level), bool)
    for frame, cut, unmasked in patches_of(places):
        patches[mine[frame]], allowed[mine[frame]] = cut, unmasked
    first, second = number, len(points) + np.arange(len(rows))
    both = allowed[first] & allowed[second]
    rows, first, second = rows[both], first[both], second[both]
    place, M = at - corner, windows.M / scale[:, :, None]
    n = len(rows)
    centre, correlation, covariance = np.full((n, 2), np.nan), np.empty(n), np.full((n, 2, 2), np.nan)
    align(
        patches, first, second, np.stack([place[first], place[second]], 1), np.stack([M[first], M[second]], 1),
        _LEAST_CONTRAST, centre, correlation, covariance,
    )  # fmt: skip
    aligned.xy[rows] = (centre + corner[second]) * scale[second]
    aligned.correlation[rows] = correlation
    variance = 0.5 * np.trace(covariance, axis1=1, axis2=2) + _FLOOR_PX**2
    aligned.sigma_px[rows] = scale[second, 0] * np.sqrt(variance)


def _with_aligned(
    rec: Reconstruction, step: Array, of_point: Index, wanted: _Windows, aligned: _Aligned
) -> Reconstruction:
    """The reconstruction with the accepted alignments."""
    obs = rec.observations
    old = len(obs)
    sigma = aligned.sigma_px / SIFT_PX
    shift = np.linalg.norm(aligned.xy - wanted.xy, axis=1)
    expected = obs.sigma[of_point][wanted.point] / step[obs.frame_idx[of_point]][wanted.point] * step[wanted.frame]
    least = np.where(np.arange(len(shift)) < old, _LEAST_MEASURED, _LEAST_NEW)
    # NaN is not believed
    good = (aligned.correlation >= least) & (shift <= _MOST_SHIFT * expected) & (sigma <= expected)
    xy, sigmas = obs.xy_raw.copy(), obs.sigma.copy()
    xy[good[:old]], sigmas[good[:old]] = aligned.xy[:old][good[:old]], sigma[:old][good[:old]]
    # the best view defines the point: it is as good as those that were aligned with it
    good_idx = np.flatnonzero(good)
    log_mean = np.bincount(wanted.point[good_idx], np.log(sigma[good_idx]), rec.num_points)
    count = np.bincount(wanted.point[good_idx], minlength=rec.num_points)
    known = count > 0
    sigmas[of_point[known]] = np.exp(log_mean[known] / count[known])
    new = np.flatnonzero(good[old:]) + old
    observations = Observations(
        np.concatenate([obs.frame_idx, wanted.frame[new]]),
        np.concatenate([obs.point_idx, wanted.point[new]]),
        np.concatenate([xy, aligned.xy[new]]),
        np.concatenate([sigmas, sigma[new]]),
    )
    found = replace(rec, observations=observations)
    return found.with_points(np.ones(len(observations), bool), min_track=3)
