"""A clip whose camera only rotates: directions instead of points, rotations instead of poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation

from ..bundle.intrinsics import moved_camera
from ..input.key_frames import Clip
from ..input.load import LoadedPhotos
from ..model import Camera, Observations, Reconstruction, RowMotion
from ..model.array_types import Array, Index
from ..model.field import PINHOLE_ENDS
from ..model.projection import project_points, unproject_points
from ..sfm.descriptor_matches import DescriptorIndex, match_descriptors
from ..sfm.features import Features
from ..sfm.flow import flow_size
from .clip_tracks import Followed, follow

__all__ = ["as_directions", "lens_shows_px", "rotates_by", "rotating_only", "rotation_between", "seen_again"]

_Corners = tuple[Array, Array]

# Tolerance for the shutter where frames are rotated onto each other, pixels; and median that may be left when rotations
# of the lines of both frames are removed, too: the content moves by fifty from key to key, and translation leaves a
# part of that.
_ROOM_PX, _LEFT_PX = 40.0, 0.5
_LEAST_AGREEING = 12
_TRIALS = 20
# Samples of so many points that are asked for rotations of the lines, radians by which a camera may rotate, times the
# median that may be left by which points may differ from them, and times that all points are asked then.
_SAMPLES, _FEW, _FAST, _AT_FIRST, _FITS = 100, 6, 0.1, 6.0, 10
# A focal length that nobody knows is off by such a factor at most; how many are tried, and key frames asked.
_MOST_OFF, _GRID, _ASKED = 2.0, 9, 6
# Distortions k1 of wide lenses that are tried where none is known, in pixels what of these may be left at first, trials
# that find the best one, and how much less likely a lens gets per standard deviation, in pixels.
_WIDE, _NEAR_PX, _LENS_TRIALS, _UNLIKELY_PX = (-0.1, -0.2, -1.0 / 3.0), 1.0, 80, 0.02
# What is left by it must be so much less than by no perspective at all: what slides by is seen by any lens.
_MUCH_LESS = 0.5
_LENS_SIGMAS = np.array([0.5, 0.2, 0.2])
# Places along each side of a frame, and frames, where a lens may show; and a rotation that is small, radians.
_LOOKED_AT, _FRAMES, _SMALL = 7, 60, 1e-6
# Key frames before a cut that one after it may show again, and its features that may.
_LAST, _MATCHED = 4, 2048


def rotating_only(clip: Clip, keys: LoadedPhotos) -> Reconstruction | None:
    """All frames of a clip, chained by the rotations between them, with directions as points.

    The centres are all at the origin, the points at a distance of 1. None if most frames are not connected, or differ
    from rotations by more than a shutter explains.
    """
    camera = keys.cameras.of(0)
    corners = _corners(clip, camera)
    if corners and keys.cameras.without_focal:
        camera = _with_likeliest_lens(corners, camera)
    # corners of key frames show it in no time, so that the frames between need not be followed
    if corners and not _only_rotates([_beyond_rotation(first, second, camera) for first, second in corners], camera):
        return None
    features = dict(zip(clip.places(keys.names).tolist(), keys.features, strict=True))
    shown = {key: found.xy_raw for key, found in features.items()}
    chained = _chained(clip, camera, features)
    if chained is None or 2 * len(chained[2]) < len(clip.names):
        return None
    return _joined(clip, camera, chained[0], shown, *chained[1:])


def rotates_by(clip: Clip, camera: Camera) -> bool:
    """Whether rotations explain corners of key frames and the next ones by such a lens of any focal length."""
    corners = _corners(clip, camera)
    if not corners:
        return False
    camera = _with_likeliest_lens(corners, camera)
    return _only_rotates([_beyond_rotation(first, second, camera) for first, second in corners], camera)


def _corners(clip: Clip, camera: Camera) -> list[_Corners]:
    """Corners of key frames, and where the next ones show them, in pixels."""
    step = np.array([camera.width, camera.height]) / flow_size(camera.width, camera.height)
    return [(step * (each.first_xy + 0.5) - 0.5, step * (each.second_xy + 0.5) - 0.5) for each in clip.flows]


def _with_likeliest_lens(corners: Sequence[_Corners], camera: Camera) -> Camera:
    """The camera with the focal length by which rotations explain corners of key frames and the next ones best.

    That of a guess, since no parallax says more, may be off by half, and rotations do not explain any frame by it. If
    they do by no focal length, the lens of an action camera may be the reason: what it distorts slides by evenly, as if
    the focal length were longer.
    """
    some = [corners[k] for k in np.unique(np.linspace(0, len(corners) - 1, _ASKED).astype(int)).tolist()]

    def left_px(log_ratio: float, *distortion: float) -> float:
        other = _with_lens(camera, log_ratio, *distortion)
        return float(np.median([_beyond_rotation_px(first, second, other) for first, second in some]))

    tried = np.linspace(-np.log(_MOST_OFF), np.log(_MOST_OFF), _GRID)
    values = [left_px(each) for each in tried.tolist()]
    best = int(np.argmin(values))
    found = camera
    # what slides by without any perspective asks for ever longer ones
    if best not in (0, _GRID - 1) and np.isfinite(values[best]):
        around = tried[best - 1], tried[best + 1]
        log_ratio = minimize_scalar(left_px, bounds=around, method="bounded", options={"xatol": 1e-3}).x
        found = _with_lens(camera, float(log_ratio))
        if left_px(float(log_ratio)) < _LEFT_PX:
            return found
    if camera.lens != "pinhole" or camera.dist.any():
        return found

    def unlikeliness(lens: Array) -> float:
        left = left_px(*lens.tolist())
        return left + _UNLIKELY_PX * float(((lens / _LENS_SIGMAS) ** 2).sum()) if np.isfinite(left) else np.inf

    # k2 as where all directions are spread evenly: r_d = arctan(w r) / w, with k1 = -w^2 / 3
    lenses = [np.array([log_ratio, k1, 1.8 * k1**2]) for k1 in _WIDE for log_ratio in tried.tolist()]
    costs = [unlikeliness(each) for each in lenses]
    if not min(costs) < _NEAR_PX:
        return found
    start = lenses[int(np.argmin(costs))]
    simplex = start + np.vstack([np.zeros(3), 0.3 * np.diag(_LENS_SIGMAS)])
    how: Any = {"maxfev": _LENS_TRIALS, "initial_simplex": simplex}
    best_lens = np.asarray(minimize(unlikeliness, start, method="Nelder-Mead", options=how).x).tolist()
    if left_px(*best_lens) > min(_LEFT_PX, _MUCH_LESS * values[-1]):
        return found
    return _with_lens(camera, *best_lens)


def _with_lens(camera: Camera, log_ratio: float, *distortion: float) -> Camera:
    """The camera with another focal length, and k1 and k2, if they are given."""
    ratio = np.exp(log_ratio)
    other = replace(camera, K=camera.K * [[ratio, 1.0, 1.0], [1.0, ratio, 1.0], [1.0, 1.0, 1.0]])
    return replace(other, dist=np.array([*distortion, 0.0, 0.0])) if distortion else other


def _beyond_rotation_px(xy_before: Array, xy_after: Array, camera: Camera) -> float:
    """Median distance of pixels (n, 2) of two frames beyond what rotations of their lines explain, in such pixels.

    Lenses differ by how much of the tangent plane a pixel is.
    """
    left = _sizes_beyond_rotation(xy_before, xy_after, camera)
    if left is None:
        return float("inf")
    ends = (
        [unproject_points(xy_after + sign * each, camera, RowMotion(), "global")[0] for sign in (1, -1)]
        for each in 0.5 * np.eye(2)
    )
    (a, b), (c, d) = ((ahead - behind).T for ahead, behind in ends)
    return float(np.nanmedian(left / np.sqrt(np.abs(a * d - b * c))))


def _only_rotates(left: Sequence[float], camera: Camera) -> bool:
    """Whether key frames and the next ones differ by rotations of their lines only, up to distances `left`."""
    return len(left) > 0 and bool(np.median(left) * camera.K[0, 0] < _LEFT_PX)


def _beyond_rotation(xy_before: Array, xy_after: Array, camera: Camera) -> float:
    """Median distance of pixels (n, 2) of two frames, as directions, beyond what rotations of their lines explain."""
    left = _sizes_beyond_rotation(xy_before, xy_after, camera)
    return float("inf") if left is None else float(np.nanmedian(left))


def _sizes_beyond_rotation(xy_before: Array, xy_after: Array, camera: Camera) -> Array | None:
    """(n,) those distances, NaN where there is no direction; None if too few pixels agree on a rotation."""
    before, after = _directions(xy_before, camera), _directions(xy_after, camera)
    rotation = _agreed_rotation(before, after, _ROOM_PX / float(camera.K[0, 0]))
    return None if rotation is None else _sizes_beyond_shutter(before @ rotation.T, after, camera)


def _chained(
    clip: Clip, camera: Camera, features: dict[int, Features]
) -> tuple[Followed, dict[int, Array], dict[int, Array]] | None:
    """Followed points of key frames, their directions, and the frames' rotations; None if they do not only rotate."""
    shown = {key: found.xy_raw for key, found in features.items()}
    followed = follow(clip, shown, camera)
    rays = _directions(followed.xy_raw, camera)
    own = {key: _directions(shown[key][followed.chosen[key]], camera) for key in followed.chosen}
    order = sorted(followed.chosen)
    R_cw, again = {order[0]: np.eye(3)}, []
    for a, b in pairwise(order):
        if a not in R_cw or clip.part[a] != clip.part[b]:
            # after a cut, or a flash, what was seen before may be seen again
            for key in reversed([each for each in order if each in R_cw][-_LAST:]):
                seen = seen_again(features[key], followed.chosen[key], features[b], camera)
                if seen is not None:
                    R_cw[b] = seen[0] @ R_cw[key]
                    again.append((key, b, *seen[1:]))
                    break
            continue
        for k in range(a + 1, b + 1):
            mine = (followed.frame == k) & (followed.key == a)
            rotation = _agreed_rotation(own[a][followed.place[mine]], rays[mine], _ROOM_PX / float(camera.K[0, 0]))
            if rotation is not None:
                R_cw[k] = rotation @ R_cw[a]
    left = []
    for a, b in pairwise(order):
        if a in R_cw and b in R_cw and clip.part[a] == clip.part[b]:
            mine = (followed.frame == b) & (followed.key == a)
            before = own[a][followed.place[mine]] @ (R_cw[b] @ R_cw[a].T).T
            left.append(_left_by_shutter(before, rays[mine], camera))
    if not _only_rotates(left, camera):
        return None
    for each in again:
        followed.add_more(*each)
    return followed, own, R_cw


def seen_again(before: Features, chosen: Index, after: Features, camera: Camera) -> tuple[Array, Index, Array] | None:
    """The rotation from a frame to another one that shows features of it, which of the chosen ones, and their pixels.

    None if too few agree on a rotation.
    """
    looks = DescriptorIndex.of(before.descriptors[chosen]), DescriptorIndex.of(after.descriptors[:_MATCHED])
    first, second = match_descriptors(*looks).astype(np.int64).T
    xy, within = after.xy_raw[second], _ROOM_PX / float(camera.K[0, 0])
    own, seen = _directions(before.xy_raw[chosen[first]], camera), _directions(xy, camera)
    rotation = _agreed_rotation(own, seen, within)
    if rotation is None:
        return None
    agree = np.linalg.norm(own @ rotation.T - seen, axis=1) < within
    return rotation, first[agree], xy[agree]


def _joined(
    clip: Clip, camera: Camera, followed: Followed, shown: dict[int, Array],
    own: dict[int, Array], R_cw: dict[int, Array],
) -> Reconstruction:  # fmt: skip
    """The frames with known rotations, and their measurements."""
    placed = np.array(sorted(R_cw))
    index = np.full(len(clip.names), -1)
    index[placed] = np.arange(len(placed))
    order = [key for key in sorted(followed.chosen) if key in R_cw]
    start = dict(zip(order, np.cumsum([0, *(len(own[key]) for key in order)])[:-1].tolist(), strict=True))
    there = np.isin(followed.key, order) & (index[followed.frame] >= 0)
    point = np.array([start[key] for key in followed.key[there].tolist()], np.int64) + followed.place[there]
    num = sum(len(own[key]) for key in order)
    at_key = np.concatenate([np.full(len(own[key]), index[key]) for key in order])
    rec = Reconstruction(
        [camera], [clip.names[k] for k in placed.tolist()], np.zeros(len(placed), np.int64),
        np.array([R_cw[k] for k in placed.tolist()]), np.zeros((len(placed), 3)),
        np.concatenate([own[key] @ R_cw[key] for key in order]),
        Observations(
            np.concatenate([at_key, index[followed.frame[there]]]), np.concatenate([np.arange(num), point]),
            np.concatenate([*(shown[key][followed.chosen[key]] for key in order), followed.xy_raw[there]]),
        ),
    )  # fmt: skip
    return rec.with_points(np.ones(len(rec.observations), bool))


def lens_shows_px(turned: Reconstruction, sigma: Mapping[str, float]) -> float:
    """By how much frames that only rotate would look different through another lens, root mean square in pixels.

    That of a standard deviation of the intrinsic (of `GuessedCameras`) that shows most. Rotations make up for most of
    it, and for all of it where they are small: a lens shows by how it moves the edge of the frame and its middle.
    """
    camera = turned.cameras[0]
    ends = np.array([camera.width - 1.0, camera.height - 1.0])
    xy = np.stack(np.meshgrid(*np.linspace(0.0, ends, _LOOKED_AT).T), axis=2).reshape(-1, 2)
    some = np.unique(np.linspace(0, turned.num_images - 1, _FRAMES).astype(int))
    after = [turned.R_cw[k] @ turned.R_cw[0].T for k in some.tolist()]

    def seen(R: Array, lens: Camera) -> Array:
        there, valid = project_points(_directions(xy, lens) @ R.T, lens, RowMotion(), "global")
        inside = valid & (there >= 0.0).all(axis=1) & (there <= ends).all(axis=1)
        return np.where(inside[:, None], there, np.nan)

    small = [Rotation.from_rotvec(_SMALL * axis).as_matrix() for axis in np.eye(3)]
    rays = _directions(xy, camera)
    by_rotation = np.stack(
        [(project_points(rays @ R.T, camera, RowMotion(), "global")[0] - xy) / _SMALL for R in small], axis=2
    ).reshape(-1, 3)
    through, most = [seen(R, camera) for R in after], 0.0
    for name, value in sigma.items():
        lens, left = moved_camera(camera, [name], np.array([value])), [np.zeros(0)]
        for R, before in zip(after, through, strict=True):
            apart = (seen(R, lens) - before).ravel()
            there = np.isfinite(apart) & np.isfinite(by_rotation).all(axis=1)
            turn = np.linalg.lstsq(by_rotation[there], apart[there], rcond=None)[0]
            left.append(apart[there] - by_rotation[there] @ turn)
        each = np.concatenate(left)
        most = max(most, float(np.sqrt(2.0 * (each**2).mean()))) if len(each) else np.inf
    return most


def as_directions(scene: Reconstruction, turned: Reconstruction) -> Reconstruction:
    """The photos and measurements of a scene, with the cameras and motions of frames that only rotate.

    These have all its photos; its points are directions.
    """
    place = {name: i for i, name in enumerate(turned.image_names)}
    own, obs = turned.rows([place[name] for name in scene.image_names]), scene.observations
    R_cw, rays = own["R_cw"][obs.frame_idx], np.empty((len(obs), 3))
    for k, camera in enumerate(turned.cameras):
        mine = own["camera_idx"][obs.frame_idx] == k
        rays[mine] = _directions(obs.xy_raw[mine], camera)
    seen = np.isfinite(rays).all(axis=1)
    total = np.zeros((scene.num_points, 3))
    np.add.at(total, obs.point_idx[seen], np.einsum("nji,nj->ni", R_cw, rays)[seen])
    size = np.linalg.norm(total, axis=1)
    points_w = total / np.maximum(size, 1e-12)[:, None]
    frames = replace(turned, image_names=scene.image_names, points_w=points_w, observations=obs, **own)
    return frames.with_points(seen & (size[obs.point_idx] > 0))


def _directions(xy_raw: Array, camera: Camera) -> Array:
    """(n, 3) unit rays of pixels; NaN where there is none."""
    rays, valid = unproject_points(xy_raw, camera, RowMotion(), "global")
    ahead = np.column_stack([rays, np.ones(len(rays))])
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    ahead[~valid] = np.nan
    return ahead


def _left_by_shutter(before: Array, after: Array, camera: Camera) -> float:
    """Median distance of directions (n, 3) of two frames, beyond what rotations of their lines explain."""
    left = _sizes_beyond_shutter(before, after, camera)
    return float("inf") if left is None else float(np.nanmedian(left))


def _sizes_beyond_shutter(before: Array, after: Array, camera: Camera) -> Array | None:
    """(n,) those distances, in the tangent plane; NaN where there is no direction, None if there are too few."""
    seen = np.asarray(np.isfinite(np.hstack([before, after])).all(axis=1))
    seen[seen] = np.minimum(before[seen, 2], after[seen, 2]) > np.cos(PINHOLE_ENDS)  # that plane is endless
    if seen.sum() < _LEAST_AGREEING:
        return None
    before, after = before[seen], after[seen]
    size = np.full(len(before), np.inf)
    for _ in range(2):  # what both frames were rotated by at first may be off by as much as some things moved
        rotation, size = _rotations_of_lines(before, after, camera)
        before = before @ rotation.T
    found = np.full(len(seen), np.nan)
    found[seen] = size
    return found


def _rotations_of_lines(before: Array, after: Array, camera: Camera) -> tuple[Array, Array]:
    """The rotation from one frame to another, to first order, and how far directions (n, 3) are off nevertheless (n,).

    The lines of both rotate steadily. It begins at what most agree with of all that a few do, then those count less and
    less that move otherwise, together.
    """
    (u, v), (x, y) = (each[:, :2].T / each[:, 2] for each in (before, after))
    # dx / dt of x = X / Z where X rotates about the three axes, against the clock
    by_R = np.stack([np.stack([x * y, -(1 + x**2), y], 1), np.stack([1 + y**2, -x * y, -x], 1)], axis=1)
    r_before, r_after = (u, x) if camera.clock_axis == 0 else (v, y)
    A = np.concatenate([by_R, r_after[:, None, None] * by_R, -r_before[:, None, None] * by_R], axis=2)
    apart, least = np.stack([x - u, y - v], axis=1), _LEFT_PX / float(camera.K[0, 0])
    few = np.array([np.random.default_rng(k).choice(len(x), _FEW, replace=False) for k in range(_SAMPLES)])
    some, rest = A[few].reshape(_SAMPLES, -1, 9), apart[few].reshape(_SAMPLES, -1, 1)
    turned = some.transpose(0, 2, 1)
    fits = np.linalg.solve(turned @ some + (least / _FAST) ** 2 * np.eye(9), turned @ rest)[..., 0]
    sizes = np.linalg.norm(apart - np.einsum("oij,sj->soi", A, fits), axis=2)
    within = _AT_FIRST * least
    best = np.argmin(np.minimum(sizes, within).sum(axis=1))
    fit, size = fits[best], sizes[best]
    for _ in range(_FITS):
        root = 1.0 / (1.0 + (size / within) ** 2)
        fit = np.linalg.lstsq((root[:, None, None] * A).reshape(-1, 9), (root[:, None] * apart).ravel(), rcond=None)[0]
        size = np.linalg.norm(apart - A @ fit, axis=1)
        within = max(0.7 * within, least)
    return Rotation.from_rotvec(-fit[:3]).as_matrix(), size


def rotation_between(xy_before: Array, xy_after: Array, camera: Camera) -> Array | None:
    """The rotation vector from directions of pixels (n, 2) to those in another frame; None if none fits."""
    before, after = _directions(xy_before, camera), _directions(xy_after, camera)
    rotation = _agreed_rotation(before, after, _ROOM_PX / float(camera.K[0, 0]))
    return None if rotation is None else np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def _agreed_rotation(before: Array, after: Array, within: float) -> Array | None:
    """The rotation that takes most directions (n, 3) to those of another frame; None if too few agree on one."""
    seen = np.isfinite(before).all(1) & np.isfinite(after).all(1)
    before, after = before[seen], after[seen]
    if len(before) < _LEAST_AGREEING:
        return None
    rng = np.random.default_rng(0)
    best, most = None, 0
    for _ in range(_TRIALS):
        pair = rng.choice(len(before), 2, replace=False)
        rotation = _aligned(before[pair], after[pair])
        agree = np.linalg.norm(before @ rotation.T - after, axis=1) < within
        if agree.sum() > most:
            best, most = agree, int(agree.sum())
    if best is None or most < _LEAST_AGREEING:
        return None
    return _aligned(before[best], after[best])


def _aligned(before: Array, after: Array) -> Array:
    """The rotation (3, 3) that takes directions (n, 3) nearest to others (Kabsch 1976)."""
    U, _, Vt = np.linalg.svd(after.T @ before)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
