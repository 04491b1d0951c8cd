"""A clip of two frames: their relative pose with a shutter."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ReconstructionError
from ..input.key_frames import Clip
from ..input.load import LoadedPhotos
from ..model import Observations, Reconstruction, RowMotion
from ..model.projection import unproject_points
from .clip_pan import rotation_between
from .clip_tracks import follow

__all__ = ["two_frames"]

# Readout times that are tried, as shares of the time between frames: a fifth more or less leaves little of the shutter.
_SHARES = (0.0, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9)
# Tolerance of rays that agree on a pose between the frames, in pixels.
_WITHIN_PX = 1.0
_LEAST_AGREEING = 20


def two_frames(clip: Clip, keys: LoadedPhotos) -> Reconstruction:
    """Both frames of a clip, and their common points, by the essential matrix of rays without shutter.

    The camera is assumed to rotate steadily from frame to frame, for the share of the time that explains most points.

    Raises
    ------
    ReconstructionError
        When the frames share too little.
    """
    camera = keys.cameras.of(0)
    number = {name: k for k, name in enumerate(clip.names)}
    shown = {number[name]: found.xy_raw for name, found in zip(keys.names, keys.features, strict=True)}
    followed = follow(clip, shown, camera)
    forward = followed.key == 0
    first, second = (shown[k][followed.chosen[k]] for k in (0, 1))
    starts = np.concatenate([first[followed.place[forward]], second[followed.place[~forward]]])
    xy = np.stack([np.where((forward == (k == 0))[:, None], starts, followed.xy_raw) for k in (0, 1)])
    rotation = rotation_between(xy[0], xy[1], camera)
    if rotation is None:
        raise ReconstructionError(f"the two frames of {clip.video.name} share too little of the scene")
    best: tuple[int, NDArray[np.float64], NDArray[np.float64], RowMotion, NDArray[np.bool_]] | None = None
    for share in _SHARES:
        motion = RowMotion(share * rotation / camera.frame_span)
        (a, seen_a), (b, seen_b) = (unproject_points(each, camera, motion, "rotation") for each in xy)
        seen = seen_a & seen_b
        E, _ = cv2.findEssentialMat(a[seen], b[seen], np.eye(3), cv2.RANSAC, 0.9999, _WITHIN_PX / float(camera.K[0, 0]))
        if E is None or E.shape != (3, 3):
            continue
        _, R, way, agree = cv2.recoverPose(E, a[seen], b[seen], np.eye(3))
        mask = np.zeros(len(seen), bool)
        mask[np.flatnonzero(seen)[agree.ravel() > 0]] = True
        if best is None or mask.sum() > best[0]:
            best = int(mask.sum()), R, way.ravel(), motion, mask
    if best is None or best[0] < _LEAST_AGREEING:
        raise ReconstructionError(f"the two frames of {clip.video.name} share too little of the scene")
    _, R, way, motion, mask = best
    rays = [unproject_points(each[mask], camera, motion, "rotation")[0] for each in xy]
    local = cv2.triangulatePoints(np.eye(3, 4), np.column_stack([R, way]), rays[0].T, rays[1].T)
    points_w = (local[:3] / local[3]).T
    ahead = np.isfinite(points_w).all(1) & (points_w[:, 2] > 0)
    n = int(ahead.sum())
    return Reconstruction(
        [camera], clip.names, np.zeros(2, np.int64), np.stack([np.eye(3), R]), np.stack([np.zeros(3), -R.T @ way]),
        points_w[ahead],
        Observations(np.repeat([0, 1], n), np.tile(np.arange(n), 2), xy[:, mask][:, ahead].reshape(-1, 2)),
    )  # fmt: skip
