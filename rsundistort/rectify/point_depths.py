"""Depths of a photo from the few points that are known of its scene."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from .._kernels import depth as kernels
from ..errors import InputError
from ..model import DepthMap, Plane
from ..model.array_types import Array, Index, Mask
from .pixel_depths import inverse_depth_at

__all__ = ["depth_from_points", "fit_plane", "plane_in_camera", "prefers_plane"]

# A point is believed if this many of its nearest neighbours in the photo lie as far away, give or take this share. The
# edge of a thing has neighbours on either side; a stray point has none.
_NEIGHBOURS = 8
_SUPPORT = 2
_SHARE = 0.1
# So many photos confirm a point. Two fit any match along the epipolar line, and false ones by a period of what repeats
# agree with each other; if this share of a photo's points is confirmed, only these are asked.
_CONFIRMING, _CONFIRMED_SHARE = 3, 0.5
# The map has at most this many cells along the longer side, none smaller than this many pixels: a photo has a few
# thousand points, and finer cells gained nothing (benchmarks/depth.py).
_MAX_CELLS = 96
_CELL_PX = 6
_NUM_TRIPLES = 500


def _believed(xy: Array, inverse: Array, num_photos: Index | None) -> Mask:
    """(n,) points that agree with neighbours."""
    from scipy.spatial import cKDTree

    everybody = np.ones(len(xy), bool)
    asked = everybody if num_photos is None else num_photos >= _CONFIRMING
    if asked.mean() < _CONFIRMED_SHARE:
        asked = everybody
    num = min(_NEIGHBOURS + 1, int(asked.sum()))
    if num <= _SUPPORT:
        return everybody
    nearest = np.asarray(cKDTree(xy[asked]).query(xy, k=num)[1])
    # the nearest one of those asked is the point itself
    neighbours = np.flatnonzero(asked)[np.where(asked[:, None], nearest[:, 1:], nearest[:, :-1])]
    apart = np.abs(inverse[neighbours] - inverse[:, None])
    tolerance = _SHARE * np.maximum(inverse, np.median(inverse))[:, None]
    believed = (apart < tolerance).sum(1) >= _SUPPORT
    return believed if believed.any() else everybody


def _interpolate(xy: Array, inverse: Array, size: tuple[int, int]) -> Array:
    """Coarse map (rows, cols): linear in the triangles between the points, that of the nearest point beyond them."""
    from scipy.spatial import Delaunay, QhullError, cKDTree

    cell = max(max(size) / _MAX_CELLS, _CELL_PX)
    cols, rows = (max(int(np.ceil(side / cell)), 1) for side in size)
    # points in the pixels of the map, which is stretched over the photo as `cv2.resize` does
    at = (xy + 0.5) * [cols / size[0], rows / size[1]] - 0.5
    centres = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), -1)
    field = inverse[np.asarray(cKDTree(at).query(centres)[1])]
    if len(xy) >= 3:
        # SciPy's LinearNDInterpolator solves each triangle by LAPACK, whose threads wait for each other: five to twenty
        # times as long where several photos are at work
        with suppress(QhullError):  # all on one line
            kernels.fill_triangles(at, inverse, Delaunay(at).simplices, field)
    return field


def depth_from_points(xy: Array, depth: Array, size: tuple[int, int], num_photos: Index | None = None) -> DepthMap:
    """A coarse depth map of a photo from the depths of some points.

    Inverse depth is interpolated linearly in the Delaunay triangles between the points, and is that of the nearest
    point beyond them. Points that fewer than two of their eight neighbours agree with are left out; where most points
    are seen in three photos, neighbours of two are not asked.

    Parameters
    ----------
    xy : (n, 2) array
        Pixels of the rectified photo; n is at least 1.
    depth : (n,) array
        z in the frame of the rectified camera; positive.
    size : (width, height)
        Of the rectified photo.
    num_photos : (n,) index array, optional
        How many photos measured each point; three at least when left out.

    Examples
    --------
    >>> depth_from_points(np.array([[50.0, 50.0]]), np.array([8.0]), (100, 100)).depth.max()
    np.float32(8.0)
    """
    if not len(xy):
        raise InputError("no point to take depths from")
    inverse = 1.0 / depth
    believed = _believed(xy, inverse, num_photos)
    smooth = _interpolate(xy[believed], inverse[believed], size)
    return DepthMap((1.0 / smooth).astype(np.float32), size)


def fit_plane(points_w: Array) -> tuple[Array, float]:
    """The plane nearest to most of the points (n, 3): unit normal and offset, normal @ X = offset.

    Least median of squares over planes through three of the points, then least squares over those that lie near
    (Rousseeuw 1984).
    """
    rng = np.random.default_rng(0)
    few = points_w[rng.permutation(len(points_w))[:2000]]
    corners = few[rng.integers(0, len(few), (_NUM_TRIPLES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    if not (lengths > 0).any():
        raise InputError("the points lie on one line; no plane fits")
    corners, normals = corners[lengths > 0], normals[lengths > 0] / lengths[lengths > 0, None]
    away = np.abs(normals @ few.T - (normals * corners[:, 0]).sum(1)[:, None])
    middle = np.median(away, axis=1)
    best = int(np.argmin(middle))
    normal, offset = normals[best], float(normals[best] @ corners[best, 0])
    for _ in range(5):
        distance = np.abs(points_w @ normal - offset)
        near = points_w[distance <= max(2.5 * 1.4826 * float(np.median(distance)), 1e-12)]
        centre = near.mean(0)
        normal = np.linalg.svd(near - centre, full_matrices=False)[2][2]
        offset = float(normal @ centre)
    return normal, offset


def plane_in_camera(normal_w: Array, offset: float, R_cw: Array, center_w: Array) -> Plane | None:
    """A plane of the world as a camera sees it; None if the camera stands on it."""
    distance = offset - float(normal_w @ center_w)
    if distance == 0:
        return None
    return Plane(R_cw @ normal_w * np.sign(distance), abs(distance))


def prefers_plane(
    plane: Plane,
    xy: Array,
    rays_c: Array,
    depth: Array,
    size: tuple[int, int],
    num_photos: Index | None = None,
) -> bool:
    """Whether a plane predicts the depths of half of the points at least as well as a map of the other half does.

    Parameters
    ----------
    plane : Plane
        In the camera frame.
    xy, depth, size, num_photos
        As in `depth_from_points`.
    rays_c : (n, 3) array
        Directions of the points in the camera frame, of z = 1.
    """
    inverse = 1.0 / depth
    believed = np.flatnonzero(_believed(xy, inverse, num_photos))
    fitted, held = believed[::2], believed[1::2]
    if not len(held):
        return True
    half = DepthMap((1.0 / _interpolate(xy[fitted], inverse[fitted], size)).astype(np.float32), size)
    by_map = np.abs(inverse_depth_at(half, xy[held], np.eye(3)) - inverse[held])
    by_plane = np.abs(plane.inverse_depth(rays_c[held]) - inverse[held])
    return bool(by_plane.mean() <= by_map.mean())
