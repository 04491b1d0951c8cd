"""Photos placed one by one in a scene that is known, each with the motion of its own shutter.

Mapping places photos as if they had no shutter. Where it is strong some get no place, or a wrong one; what the others
show of the scene, once their motion is known, finds the right one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..model import Camera, Reconstruction, RowMotion
from ..model.array_types import Array, Index, Mask
from ..model.path import cross_matrices
from ..model.projection import clock_of, project_points, project_points_with_jacobians, unproject_points
from .connected import LEAST_MEASUREMENTS, connected_photos
from .database import MatchedPhotos
from .epipolar import TIGHT_PX, Matches, agreeing_photos, read_matches

__all__ = ["Placed", "Registration", "place_photo", "points_of_keypoints", "register_photos"]

# COLMAP's own demands on the pose of a photo: so many points that fit, and this share of all. Features that a strong
# shutter sheared hardly match: then as many points do as a photo needs to stay (`LEAST_MEASUREMENTS`).
_LEAST_POINTS, _LEAST_SHARE = 30, 0.25
# Another place is the right one if so many times as many measurements fit it.
_CLEARLY = 1.25
# Points determine a photo's place if so many other photos show them: it may have led them astray.
_LEAST_OTHERS = 2
# Measurements that fit lie this near to their prediction, in thresholds of tracks: the scene is still a rough one.
_FIT = 2.0
# Within a part of the frame the shutter moves little: three points from there show where to look.
_PARTS = 3
# Thresholds of that search, in pixels, and then those of the adjustment, whose inliers grow around the ones found.
_SEARCH_PX, _WIDE_PX, _NARROWER_PX = (4.0, 16.0), 8.0, (4.0, 2.0)
# So many measurements show where to look, and so many of the suggestions are followed to their end.
_ENOUGH, _TRIED = 400, 2
_SEARCHES, _CONFIDENCE = 1000, 0.9999
# Three points suggest up to four poses, and a fourth decides which.
_LEAST_SUGGESTING = 4
# Prior standard deviation of phi, in radians a frame: strong shutters have room.
_PHI_SIGMA = 0.2
_MAX_STEPS, _CONVERGED, _GIVEN_UP = 20, 1e-3, 1e3
# What has no prediction lies this far from it.
_FAR_PX = 1e6


@dataclass(frozen=True)
class Placed:
    """Where a photo was taken from, and how its camera rotated while it was read.

    Attributes
    ----------
    R_cw, center_w : (3, 3), (3,) array
        Pose at the reference row.
    phi : (3,) array
        Rotation, radians per unit of the clock.
    fits : (n,) bool array
        Which measurements lie near their predictions.
    """

    R_cw: Array
    center_w: Array
    phi: Array
    fits: Mask


def place_photo(
    points_w: Array, xy_raw: Array, camera: Camera, step_px: float = 1.0, phi: Array | None = None
) -> Placed | None:
    """Pose and motion of a photo from points of the scene, many of which may be the wrong ones.

    Three points suggest a pose (RANSAC, over the whole frame and over parts of it, in which the shutter moves little);
    pose and rotation during the readout are then adjusted to all measurements under a robust loss (Geman and McClure's)
    whose width falls, so that the inliers grow. What most measurements fit is the answer.

    Parameters
    ----------
    points_w : (n, 3) array
        Points.
    xy_raw : (n, 2) array
        Where the photo shows them, pixels.
    step_px : float
        Unit of the thresholds: pixels of this photo to one of the image that the features were found in.
    phi : (3,) array, optional
        Rough rotation that the camera had, radians per unit of the clock; by default none.

    Returns
    -------
    Placed
        Or None where no pose could be found.
    """
    if len(points_w) < _LEAST_SUGGESTING:
        return None
    every = np.arange(len(points_w))
    few = every if len(every) <= _ENOUGH else np.linspace(0, len(every) - 1, _ENOUGH).astype(np.int64)
    suggested = _suggested(points_w[few], xy_raw[few], camera, step_px, np.zeros(3) if phi is None else phi)
    found = [_adjusted(pose, points_w[few], xy_raw[few], camera, _WIDE_PX * step_px) for pose in suggested]
    found.sort(key=lambda pose: pose.cost)
    best: Placed | None = None
    for pose in found[:_TRIED]:
        for width in _NARROWER_PX:
            pose = _adjusted(pose, points_w[few], xy_raw[few], camera, width * step_px)
        pose = _adjusted(pose, points_w, xy_raw, camera, _NARROWER_PX[-1] * step_px)
        fits = _fits(pose.R_cw, pose.center_w, RowMotion(pose.phi), points_w, xy_raw, camera, step_px)
        if best is None or fits.sum() > best.fits.sum():
            best = Placed(pose.R_cw, pose.center_w, pose.phi, fits)
    return best


@dataclass(frozen=True)
class _Pose:
    """A pose with the rotation during the readout, and what it costs."""

    R_cw: Array
    center_w: Array
    phi: Array = field(default_factory=lambda: np.zeros(3))
    cost: float = np.inf


def _suggested(points_w: Array, xy_raw: Array, camera: Camera, step_px: float, phi: Array) -> Iterator[_Pose]:
    """Poses by three points each, from the whole frame and from parts along the readout."""
    ideal, valid = unproject_points(xy_raw, camera, RowMotion(phi), "rotation")
    clock = clock_of(camera, xy_raw)
    borders = np.quantile(clock, np.linspace(0, 1, _PARTS + 1))
    parts = [valid, *(valid & (clock >= low) & (clock <= high) for low, high in pairwise(borders))]
    # a world of its own, for the sake of the scale of what is solved
    origin = np.median(points_w, axis=0)
    size = float(np.median(np.linalg.norm(points_w - origin, axis=1))) or 1.0
    local = (points_w - origin) / size
    for part in parts:
        if part.sum() < _LEAST_SUGGESTING:
            continue
        for within in _SEARCH_PX:
            found, turn, way, _ = cv2.solvePnPRansac(
                local[part], ideal[part], np.eye(3), None, iterationsCount=_SEARCHES, confidence=_CONFIDENCE,
                reprojectionError=within * step_px / float(camera.K[0, 0]), flags=cv2.SOLVEPNP_AP3P,
            )  # fmt: skip
            if found:
                R_cw = cv2.Rodrigues(turn)[0]
                yield _Pose(R_cw, origin - size * (R_cw.T @ way.ravel()), phi)


def _adjusted(start: _Pose, points_w: Array, xy_raw: Array, camera: Camera, width: float) -> _Pose:
    """Pose and phi by Levenberg and Marquardt's steps under a loss of such a width, in pixels."""
    prior = (camera.frame_span / _PHI_SIGMA) ** 2

    def cost_of(R_cw: Array, center_w: Array, phi: Array) -> tuple[_Pose, tuple[NDArray[Any], ...]]:
        x_c = (points_w - center_w) @ R_cw.T
        xy, valid, slopes = project_points_with_jacobians(x_c, camera, RowMotion(phi), "rotation")
        apart = np.where(valid[:, None], xy - xy_raw, _FAR_PX)
        square = (apart**2).sum(1) / width**2
        # a sum of squares in pixels, as far as these are small; the noise is about one
        cost = float(width**2 * (square / (1.0 + square)).sum() + prior * phi @ phi)
        # Exp(w) R (X - center - R' d): a point moves by w x x_c - d
        moves = np.concatenate([-cross_matrices(x_c), np.broadcast_to(-np.eye(3), (len(x_c), 3, 3))], axis=2)
        J = np.where(valid[:, None, None], np.concatenate([slopes.point @ moves, slopes.phi], axis=2), 0.0)
        return _Pose(R_cw, center_w, phi, cost), (J, apart, np.where(valid, 1.0 / (1.0 + square) ** 2, 0.0))

    (now, (J, apart, weight)), damping = cost_of(start.R_cw, start.center_w, start.phi), 1e-3
    for _ in range(_MAX_STEPS):
        weighted = (J * weight[:, None, None]).reshape(-1, 9)
        H, g = weighted.T @ J.reshape(-1, 9), weighted.T @ apart.ravel()
        H[range(6, 9), range(6, 9)] += prior
        g[6:] += prior * now.phi
        step = -np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-12), g)
        turned = Rotation.from_rotvec(step[:3]).as_matrix() @ now.R_cw
        then, terms = cost_of(turned, now.center_w + now.R_cw.T @ step[3:6], now.phi + step[6:])
        if then.cost >= now.cost:
            damping *= 10.0
            if damping > _GIVEN_UP:
                break
            continue
        settled = now.cost - then.cost < _CONVERGED * now.cost
        now, (J, apart, weight), damping = then, terms, damping / 10.0
        if settled:
            break
    return now


@dataclass(frozen=True)
class Registration:
    """Outcome of `register_photos`.

    Attributes
    ----------
    reconstruction : Reconstruction
        The photos that have a place, with their motions; those that are new have no measurements yet.
    added, moved, dropped : tuple of str
        Photos that the scene did not have, that it had elsewhere, and that do not fit anywhere in it.
    """

    reconstruction: Reconstruction
    added: tuple[str, ...]
    moved: tuple[str, ...]
    dropped: tuple[str, ...]

    @property
    def changes(self) -> bool:
        """Whether anything came of it."""
        return bool(self.added or self.moved or self.dropped)


def register_photos(
    matched: MatchedPhotos,
    num_verified: Mapping[tuple[int, int], int],
    scene: Reconstruction,
    *,
    strong: bool = True,
    rough_phi: Mapping[str, Array] | None = None,
) -> Registration:
    """Register photos by what the others show of the scene, each with a motion of its own, where that explains more.

    Parameters
    ----------
    num_verified : mapping of (first, second) to int
        As `read_num_verified` returns them.
    scene : Reconstruction
        Poses, motions, points; its measurements are keypoints of `matched`.
    strong : bool
        Whether the shutter is so strong that photos may have wrong places: they are then held against these, and those
        of a set that is connected by little against the points of the rest alone. Else only the others are placed.
    rough_phi : mapping of name to (3,) array, optional
        Rough rotations of photos that the scene lacks.

    Returns
    -------
    Registration
        A photo gets the new place if it fits as COLMAP demands it, and clearly more of its matches than the place that
        it has. One that fits nowhere and contradicts the others loses its place: a wrong one is worse than none.
    """
    matches = read_matches(matched)
    # such a set agrees with itself wherever it is
    connected = connected_photos(scene) if strong else np.ones(scene.num_images, bool)
    rest = scene if connected.all() else scene.take_photos(connected)
    shows, least = _Shown(matched, matches, rest), LEAST_MEASUREMENTS if strong else _LEAST_POINTS
    agreeing = agreeing_photos(matched, matches, num_verified, scene) if strong else np.zeros(0, bool)
    index_of = {name: i for i, name in enumerate(scene.image_names)}
    new: dict[int, Placed] = {}
    elsewhere: dict[int, Placed] = {}
    dropped = []
    for photo, name in enumerate(matched.names):
        i = index_of.get(name)
        if i is not None and not strong:
            continue
        keypoint, point = shows.by_others(photo)
        camera = scene.cameras[matched.camera_idx[photo]] if i is None else scene.camera(i)
        features, points_w = matched.features[photo], rest.points_w[point]
        xy, step_px = features.xy_raw[keypoint], features.step_px
        now, total = 0, len(np.unique(keypoint))
        if i is not None:
            fits = _fits(scene.R_cw[i], scene.center_w[i], scene.motion(i), points_w, xy, camera, step_px)
            now = len(np.unique(keypoint[fits]))
        enough = max(least, _LEAST_SHARE * total)
        placed = None
        if total >= max(enough, _CLEARLY * now):
            placed = place_photo(points_w, xy, camera, step_px, (rough_phi or {}).get(name))
        then = 0 if placed is None else len(np.unique(keypoint[placed.fits]))
        if placed is not None and then >= max(enough, _CLEARLY * now):
            if i is None:
                new[photo] = placed
            else:
                elsewhere[i] = placed
        elif i is not None and now < enough and not agreeing[photo]:
            dropped.append(name)
    return Registration(
        _with_places(scene, elsewhere, dropped, matched, new),
        tuple(matched.names[photo] for photo in new),
        tuple(scene.image_names[i] for i in elsewhere),
        tuple(dropped),
    )


def _with_places(
    scene: Reconstruction, elsewhere: Mapping[int, Placed], dropped: Sequence[str], matched: MatchedPhotos,
    new: Mapping[int, Placed],
) -> Reconstruction:  # fmt: skip
    """A reconstruction with photos in other places, without some, and with some more."""
    R_cw, center_w, phi = (np.array(each) for each in (scene.R_cw, scene.center_w, scene.phi))
    for i, placed in elsewhere.items():
        R_cw[i], center_w[i], phi[i] = placed.R_cw, placed.center_w, placed.phi
    kept = replace(scene, R_cw=R_cw, center_w=center_w, phi=phi)
    if dropped:
        kept = kept.take_photos(np.array([name not in dropped for name in kept.image_names]))
    if not new:
        return kept
    return kept.with_photos(
        [matched.names[photo] for photo in new],
        np.array([matched.camera_idx[photo] for photo in new]),
        np.array([placed.R_cw for placed in new.values()]),
        np.array([placed.center_w for placed in new.values()]),
        np.array([placed.phi for placed in new.values()]),
    )


class _Shown:
    """Which points of a scene the keypoints of photos show, by their matches with others."""

    def __init__(self, matched: MatchedPhotos, matches: Matches, scene: Reconstruction) -> None:
        self._point_of = points_of_keypoints(matched, scene)
        # by photo: the partner, and the keypoints of the photo and of the partner that match
        self._partners: dict[int, list[tuple[int, Index]]] = {}
        for (first, second), found in matches.items():
            self._partners.setdefault(first, []).append((second, found))
            self._partners.setdefault(second, []).append((first, found[:, ::-1]))
        self._num_photos = scene.track_lengths(np.ones(len(scene.observations), bool))

    def by_others(self, photo: int) -> tuple[Index, Index]:
        """Keypoints of a photo and the points that they show by the matches, each pair once; points of two others."""
        pairs = [np.zeros((0, 2), np.int64)]
        for partner, found in self._partners.get(photo, ()):
            if partner in self._point_of:
                point = self._point_of[partner][found[:, 1]]
                pairs.append(np.column_stack([found[:, 0], point])[point >= 0])
        keypoint, point = np.unique(np.concatenate(pairs), axis=0).T
        if photo in self._point_of:
            own_points = self._point_of[photo]
            others = self._num_photos.copy()
            others[np.unique(own_points[own_points >= 0])] -= 1
            held = others[point] >= _LEAST_OTHERS
            keypoint, point = keypoint[held], point[held]
        return keypoint, point


def _fits(
    R_cw: Array, center_w: Array, motion: RowMotion, points_w: Array, xy_raw: Array, camera: Camera, step_px: float
) -> Mask:
    """(n,) which measurements lie near the predictions of a pose."""
    xy, valid = project_points((points_w - center_w) @ R_cw.T, camera, motion, "rotation")
    return valid & (np.linalg.norm(np.where(valid[:, None], xy - xy_raw, 0.0), axis=1) <= _FIT * TIGHT_PX * step_px)


def points_of_keypoints(matched: MatchedPhotos, scene: Reconstruction) -> dict[int, Index]:
    """For each photo of a scene the point that each of its keypoints shows, or -1."""
    observations, found = scene.observations, {}
    photo_of = {name: photo for photo, name in enumerate(matched.names)}
    for i, rows in enumerate(observations.by_photo(scene.num_images)):
        photo = photo_of[scene.image_names[i]]
        xy = matched.features[photo].xy_raw
        place = {tuple(each): k for k, each in enumerate(xy.tolist())}
        point = np.full(len(xy), -1)
        for each, shown in zip(observations.xy_raw[rows].tolist(), observations.point_idx[rows].tolist(), strict=True):
            if (keypoint := place.get(tuple(each))) is not None:
                point[keypoint] = shown
        found[photo] = point
    return found
