"""New triangulation of points where no photo can see them, or at infinity; how near to a camera a point may be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array, Index, Mask
from ..model.projection import clock_of, unproject_points
from ..model.reprojection import reprojection_residuals

__all__ = ["least_distance", "retriangulated", "triangulated"]

# Rays that do not meet ahead of the cameras are taken to meet this many sizes of the scene away: so near that they pull
# (at 50 sizes the way back takes five times as many steps).
_FAR = 3.0
# Points beyond so many sizes of the scene are as good as at infinity: no step brings them back.
_LOST = 1e4
# How near to a camera a point of the scene may be, as a share of the extent of the cameras' places, or of the distances
# at which they see the scene, whichever is smaller. A match between photos that are taken from one place ends nearer,
# since noise drives a depth that nothing determines.
_AT_LENS = 1e-2
# Share of the measurements whose distances count: a scene may be far for the most part.
_NEAREST = 0.1


def _world_rays(reconstruction: Reconstruction, some: Index, shutter_model: str) -> tuple[Array, Array, Mask]:
    """Centres and unit directions (k, 3) along which some observations were seen, each at the moment of its line."""
    obs = reconstruction.observations
    centers, rays = np.empty((len(some), 3)), np.empty((len(some), 3))
    valid = np.empty(len(some), bool)
    for i in np.unique(obs.frame_idx[some]):
        mine = obs.frame_idx[some] == i
        camera, xy = reconstruction.camera(i), obs.xy_raw[some[mine]]
        ideal, valid[mine] = unproject_points(xy, camera, reconstruction.motion(i), shutter_model)
        moves = shutter_model == "constant-motion"
        centers[mine] = reconstruction.center_w[i] + moves * clock_of(camera, xy)[:, None] * reconstruction.velocity[i]
        rays[mine] = np.column_stack([ideal, np.ones(len(ideal))]) @ reconstruction.R_cw[i]
    rays[~valid] = (0.0, 0.0, 1.0)
    return centers, rays / np.linalg.norm(rays, axis=1, keepdims=True), valid


def _meeting_points(
    reconstruction: Reconstruction, lost: Index, shutter_model: str, size: float
) -> tuple[Array, Mask, Array]:
    """Where the rays of some points (k,) come nearest to each other (k, 3), and whether that is ahead of all cameras.

    With places (k, 3) far along the rays, at some sizes of the scene.
    """
    obs = reconstruction.observations
    number = np.full(reconstruction.num_points, -1)
    number[lost] = np.arange(len(lost))
    some = np.flatnonzero(number[obs.point_idx] >= 0)
    centers, rays, valid = _world_rays(reconstruction, some, shutter_model)
    some, centers, rays = some[valid], centers[valid], rays[valid]
    of = number[obs.point_idx[some]]
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    A, b, middle, way = (np.zeros((len(lost), *shape)) for shape in ((3, 3), (3,), (3,), (3,)))
    np.add.at(A, of, across)
    np.add.at(b, of, np.einsum("kij,kj->ki", across, centers))
    np.add.at(middle, of, centers)
    np.add.at(way, of, rays)
    count = np.bincount(of, minlength=len(lost))
    middle, way = (
        middle / np.maximum(count, 1)[:, None],
        way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12),
    )
    # a ridge of 1e-9 leaves parallel rays at a finite place
    found = np.asarray(np.linalg.solve(A + 1e-9 * np.eye(3), (b + 1e-9 * middle)[..., None])[..., 0], np.float64)
    ahead = count > 0
    np.logical_and.at(ahead, of, ((found[of] - centers) * rays).sum(1) > 1e-6 * size)
    return found, ahead, middle + _FAR * size * way


def triangulated(reconstruction: Reconstruction, shutter_model: str) -> Reconstruction:
    """The reconstruction with all points where their rays come nearest to each other, if that is ahead of the cameras.

    Poses and motions are those of the photos; the other points are dropped.
    """
    every = np.arange(reconstruction.num_points)
    points_w, ahead, _ = _meeting_points(reconstruction, every, shutter_model, reconstruction.baseline)
    return replace(reconstruction, points_w=points_w).take_points(ahead)


def retriangulated(reconstruction: Reconstruction, shutter_model: str, from_afar: bool = False) -> Reconstruction:
    """The reconstruction with points triangulated anew that no adjustment could bring back.

    A measurement that cannot be seen (its point is behind the camera) has no derivative, and a point that ran off to
    infinity has next to none; a shutter that was not modelled yet sends points there whose rays it bent apart. The new
    place is where the rays come nearest to each other. Where that is behind a camera, it is far along them, for a point
    at infinity only if `from_afar`: in a solution that models the shutter it may belong there.
    """
    obs = reconstruction.observations
    points = reconstruction.points_w
    if not len(points):
        return reconstruction
    size = reconstruction.size
    far = np.linalg.norm(points - reconstruction.center_w.mean(0), axis=1) > _LOST * size
    unseen = np.zeros(reconstruction.num_points, bool)
    unseen[obs.point_idx[~reprojection_residuals(reconstruction, shutter_model)[1]]] = True
    lost = np.flatnonzero(unseen | far)
    if not len(lost):
        return reconstruction
    found, ahead, way = _meeting_points(reconstruction, lost, shutter_model, size)
    found = np.where(ahead[:, None], found, way)
    moved = ahead & (np.linalg.norm(found - reconstruction.center_w.mean(0), axis=1) <= _LOST * size)
    moved |= unseen[lost] | from_afar
    if not moved.any():
        return reconstruction
    points = points.copy()
    points[lost[moved]] = found[moved]
    return replace(reconstruction, points_w=points)


def least_distance(reconstruction: Reconstruction) -> float:
    """Distance from a camera, world units, within which nothing is a point of the scene; 0 where nothing says so."""
    rec, obs = reconstruction, reconstruction.observations
    if not len(obs):
        return 0.0
    away = np.linalg.norm(rec.points_w[obs.point_idx] - rec.center_w[obs.frame_idx], axis=1)
    extent = float(np.linalg.norm(np.ptp(rec.center_w, axis=0)))
    return _AT_LENS * min(extent, float(np.quantile(away, _NEAREST)))
