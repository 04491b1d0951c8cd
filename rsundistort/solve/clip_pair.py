"""A clip of two frames: their relative pose with a shutter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..bundle.triangulate import triangulated
from ..errors import ReconstructionError
from ..input.key_frames import Clip, flow_frames_of
from ..input.load import LoadedPhotos
from ..model import Camera, Observations, Reconstruction, RowMotion
from ..model.array_types import Array
from ..model.projection import unproject_points
from ..sfm.flow import flow_between, from_reduced
from ..sfm.relative_pose import Pair, RelativePose, View, adjusted_pose
from .clip_pan import rotation_between, seen_again
from .clip_tracks import follow

__all__ = ["FramePair"]

# Readout times that are tried, as shares of the time between frames: a fifth more or less leaves little of the shutter.
_SHARES = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
# Tolerances of rays that agree on a pose between the frames, in pixels: what rotates steadily fits a narrow one.
_WITHIN_PX = (1.0, 2.0)
# Prior standard deviation of both frames' phi, radians a frame, when poses are adjusted to all points; the width of the
# loss, and the distance of points that agree.
_PHI_SIGMA, _WIDTH_PX, _AGREES_PX = 0.1, 1.5, 1.0
# Points that are followed from each frame: there are no others that average their errors.
_POINTS = 1000
_LEAST_AGREEING = 20


@dataclass(frozen=True)
class FramePair:
    """What two frames have in common.

    Attributes
    ----------
    xy : (2, n, 2) array
        Pixels of the points that were followed from either to the other.
    """

    camera: Camera
    names: tuple[str, ...]
    xy: Array

    @classmethod
    def of(cls, clip: Clip, keys: LoadedPhotos) -> FramePair:
        """The frames of a clip of two."""
        camera = keys.cameras.of(0)
        shown = dict(zip(clip.places(keys.names).tolist(), (found.xy_raw for found in keys.features), strict=True))
        followed = follow(clip, shown, camera, most=_POINTS)
        first, second = (shown[k][followed.chosen[k]] for k in (0, 1))
        if clip.flows:
            forward = followed.key == 0
            xy = _joined(
                first[followed.place[forward]],
                followed.xy_raw[forward],
                followed.xy_raw[~forward],
                second[followed.place[~forward]],
            )
            rotation = rotation_between(xy[0], xy[1], camera)
        else:  # nothing goes on from one to the other: a cut, or a roll, which is no obstacle to features
            before, after = keys.features
            seen = seen_again(before, np.arange(len(before.xy_raw)), after, camera)
            xy, rotation = np.zeros((2, 0, 2)), None if seen is None else Rotation.from_matrix(seen[0]).as_rotvec()
        if rotation is not None:
            xy = _followed_aligned(clip, (first, second), camera, rotation)
        return cls(camera, tuple(clip.names), xy)

    def placed(self, readout_share: float | None = None) -> Reconstruction:
        """Both frames and their common points, by the relative pose with a shutter that fits all of them best.

        Each begins with an essential matrix of rays of cameras that rotate steadily from frame to frame, for a share of
        the time: the one that is known, or several.

        Raises
        ------
        ReconstructionError
            When the frames share too little, or show no parallax.
        """
        camera, xy = self.camera, self.xy
        rotation = rotation_between(xy[0], xy[1], camera)
        both = f"{self.names[0]} and {self.names[1]}"
        if rotation is None:
            raise ReconstructionError(f"{both} share too little of the scene")
        no_parallax = ReconstructionError(
            f"{both} show the scene from one place, as far as their points tell; a camera that only rotated takes "
            "three frames, two take one that moved"
        )
        pair = Pair(*(View.of(each, camera) for each in xy))
        best: tuple[RelativePose, float] | None = None
        for share, within_px in product(_SHARES if readout_share is None else (readout_share,), _WITHIN_PX):
            motion = RowMotion(share * rotation / camera.frame_span)
            (a, seen_a), (b, seen_b) = (unproject_points(each, camera, motion, "rotation") for each in xy)
            seen, within = seen_a & seen_b, within_px / float(camera.K[0, 0])
            E, _ = cv2.findEssentialMat(a[seen], b[seen], np.eye(3), cv2.RANSAC, 0.9999, within)
            if E is None or E.shape != (3, 3):
                continue
            num, R, way, _ = cv2.recoverPose(E, a[seen], b[seen], np.eye(3))
            if num < _LEAST_AGREEING:
                continue
            phi = np.stack([motion.phi, motion.phi])
            fit = adjusted_pose(RelativePose(R, way.ravel(), phi), pair, _PHI_SIGMA, _WIDTH_PX)
            if best is None or fit.cost < best[0].cost:
                best = fit, share
        if best is None:
            raise no_parallax
        fit, share = best
        R, way = fit.R_21, fit.t_21
        motion = RowMotion(share * Rotation.from_matrix(R).as_rotvec() / camera.frame_span)
        mask = fit.distances_px(pair) < _AGREES_PX
        if mask.sum() < _LEAST_AGREEING:
            raise no_parallax
        rays = [unproject_points(each[mask], camera, motion, "rotation")[0] for each in xy]
        local = cv2.triangulatePoints(np.eye(3, 4), np.column_stack([R, way]), rays[0].T, rays[1].T)
        points_w = (local[:3] / local[3]).T
        ahead = np.isfinite(points_w).all(1) & (points_w[:, 2] > 0)
        R_cw, center_w = np.stack([np.eye(3), R]), np.stack([np.zeros(3), -R.T @ way])
        return Reconstruction(
            [camera], list(self.names), np.zeros(2, np.int64), R_cw, center_w, points_w[ahead],
            _seen(xy[:, mask][:, ahead]),
        )  # fmt: skip

    def of_all(self, found: Reconstruction) -> Reconstruction:
        """All that was followed, seen by the frames as they were found to move.

        The relative pose takes those for wrong that a velocity moves while they are read.
        """
        n = self.xy.shape[1]
        return triangulated(replace(found, points_w=np.zeros((n, 3)), observations=_seen(self.xy)), "constant-motion")


def _joined(*places: Array) -> Array:
    """(2, n, 2) pixels in both frames: of points of the first one, there and in the other, then of the second one."""
    return np.stack([np.concatenate(places[::2]), np.concatenate(places[1::2])])


def _followed_aligned(clip: Clip, starts: tuple[Array, Array], camera: Camera, rotation: Array) -> Array:
    """(2, n, 2) pixels of points of both frames that are followed to the other, rotated as the camera did.

    A window is sought as it is: one that rolled by ten degrees is found beside its place, if at all.
    """
    frames = dict(flow_frames_of(clip, [0, 1]))
    height, width = frames[0].grey.shape
    step = np.array([camera.width / width, camera.height / height])
    to_rays = np.linalg.inv(camera.K) @ from_reduced(step)
    H = np.linalg.inv(to_rays) @ Rotation.from_rotvec(rotation).as_matrix() @ to_rays
    first, second = ((each + 0.5) / step - 0.5 for each in starts)
    in_first = _mapped(np.linalg.inv(H), second)
    forward, backward = flow_between([frames[0], frames[1].aligned(H)], first, in_first, aligned=True)
    found = _joined(first[forward.point], _mapped(H, forward.xy), backward.xy, second[backward.point])
    return (found + 0.5) * step - 0.5


def _mapped(H: NDArray[np.floating[Any]], xy: Array) -> Array:
    """Pixels (n, 2) under a homography."""
    x = np.column_stack([xy, np.ones(len(xy))]) @ H.T
    return np.asarray(x[:, :2] / x[:, 2:])


def _seen(xy: Array) -> Observations:
    """The measurements (2, n, 2) of both frames."""
    n = xy.shape[1]
    return Observations(np.repeat([0, 1], n), np.tile(np.arange(n), 2), xy.reshape(-1, 2))
