"""All frames of a clip, registered with the points of its key frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from ..input.key_frames import Clip, flow_frames_of
from ..model import Camera, Observations, Reconstruction, RowMotion
from ..model.array_types import Array, Index
from ..model.projection import unproject_points
from ..sfm.flow import FlowFrame, flow_between
from ..sfm.resection import resect

__all__ = ["Followed", "focused_as", "follow", "follow_points", "followed_again", "with_all_frames"]

# Number of points of a key frame that are followed: those of the most key frames first, from all its cells.
_POINTS = 120
_CELLS = 6
# Tolerance for the shutter where a frame is registered without it, in pixels.
_ROOM_PX = 12.0


class Followed:
    """Points of key frames in the frames around them: their measurements by key, and their places in the frames.

    Attributes
    ----------
    chosen : mapping of frame number to (n,) int array
        Indices of the measurements of each key that are followed.
    frame, key, place : (o,) int array
        Frame, key frame, and place among those of the key, of each measurement.
    xy_raw : (o, 2) array
        Pixels.
    """

    def __init__(self, chosen: Mapping[int, Index]) -> None:
        self.chosen = chosen
        self.frame = self.key = self.place = np.zeros(0, np.int64)
        self.xy_raw = np.zeros((0, 2))

    def of(self, chosen: Mapping[int, Index]) -> Followed:
        """The same places, by other indices (n,) of the keys' measurements; without points of which it is negative."""
        anew = Followed({key: index[index >= 0] for key, index in chosen.items()})
        place = {key: np.where(index >= 0, np.cumsum(index >= 0) - 1, -1) for key, index in chosen.items()}
        places = np.array([place[key][k] for key, k in zip(self.key.tolist(), self.place.tolist(), strict=True)], int)
        there = places >= 0
        anew.frame, anew.key, anew.place = self.frame[there], self.key[there], places[there]
        anew.xy_raw = self.xy_raw[there]
        return anew

    def add(self, found: list[tuple[int, Index, Index, Array]]) -> None:
        """The places found of keys' points: key, frames (o,), places (o,) and pixels (o, 2) of each."""
        if not found:
            return
        keys, *parts = zip(*found, strict=True)
        self.frame, self.place, self.xy_raw = (np.concatenate(part) for part in parts)
        self.key = np.repeat(np.array(keys, np.int64), [len(frame) for frame in parts[0]])

    def add_more(self, key: int, frame: int, place: Index, xy_raw: Array) -> None:
        """Places (n,) of a key's points at pixels (n, 2) of one more frame."""
        self.frame = np.concatenate([self.frame, np.full(len(place), frame)])
        self.key = np.concatenate([self.key, np.full(len(place), key)])
        self.place = np.concatenate([self.place, place])
        self.xy_raw = np.concatenate([self.xy_raw, xy_raw])


def _spread(xy: Array, worth: Index, size: tuple[int, int], most: int) -> Index:
    """Indices of the points (n, 2) that are followed: the best of each cell of the frame, then the next best."""
    cell = np.clip(_CELLS * (xy + 0.5) / size, 0, _CELLS - 1).astype(int) @ [1, _CELLS]
    order = np.lexsort((-worth, cell))
    rank = np.empty(len(xy), np.int64)
    start = np.searchsorted(cell[order], np.arange(_CELLS**2))
    rank[order] = np.arange(len(xy)) - start[cell[order]]
    return np.sort(np.lexsort((-worth, rank))[:most])


def _between_keys(clip: Clip, keys: list[int]) -> Iterator[tuple[int, int, list[FlowFrame]]]:
    """Neighbouring key frames of one part, with the frames from one to the other."""
    wanted = [k for a, b in pairwise(keys) if clip.part[a] == clip.part[b] for k in range(a, b)]
    wanted = sorted({*wanted, *keys})
    held: dict[int, FlowFrame] = {}
    place = 0
    for number, frame in flow_frames_of(clip, wanted):
        held[number] = frame
        while place + 1 < len(keys) and keys[place + 1] <= number:
            a, b = keys[place], keys[place + 1]
            if clip.part[a] == clip.part[b]:
                yield a, b, [held[k] for k in range(a, b + 1)]
            held = {k: each for k, each in held.items() if k >= b}
            place += 1


def follow_points(clip: Clip, reconstruction: Reconstruction) -> Followed:
    """Follow a reconstruction's points in its key frames to the key frames before and after.

    The chosen values are indices of its measurements.
    """
    rec, obs = reconstruction, reconstruction.observations
    mine = _of_keys(clip, rec)
    worth = np.bincount(obs.point_idx, minlength=rec.num_points)[obs.point_idx]
    shown = {key: obs.xy_raw[each] for key, each in mine.items()}
    followed = follow(clip, shown, rec.cameras[0], {key: worth[each] for key, each in mine.items()})
    followed.chosen = {key: mine[key][chosen] for key, chosen in followed.chosen.items()}
    return followed


def followed_again(clip: Clip, followed: Followed, before: Reconstruction, reconstruction: Reconstruction) -> Followed:
    """What was followed of a reconstruction's points, of another one's: of features that both measure."""
    mine, chosen = _of_keys(clip, reconstruction), {}
    for key, starts in followed.chosen.items():
        own = mine.get(key, np.zeros(0, np.int64))
        index_of = dict(zip(map(tuple, reconstruction.observations.xy_raw[own]), own.tolist(), strict=True))
        found = [index_of.get(xy, -1) for xy in map(tuple, before.observations.xy_raw[starts])]
        chosen[key] = np.array(found, np.int64)
    return followed.of(chosen)


def _of_keys(clip: Clip, rec: Reconstruction) -> dict[int, Index]:
    """The measurements of each key frame, by its number."""
    by_photo = rec.observations.by_photo(rec.num_images)
    return dict(zip(clip.places(rec.image_names).tolist(), by_photo, strict=True))


def _poses(clip: Clip, rec: Reconstruction) -> dict[int, tuple[Array, Array]]:
    """The pose of each frame, by its number."""
    return dict(zip(clip.places(rec.image_names).tolist(), zip(rec.R_cw, rec.center_w, strict=True), strict=True))


def follow(
    clip: Clip, shown: Mapping[int, Array], camera: Camera,
    worth: Mapping[int, Index] | None = None, most: int = _POINTS,
) -> Followed:  # fmt: skip
    """Follow points of key frames to the key frames before and after.

    Parameters
    ----------
    shown : mapping of frame number to (n, 2) array
        Points of each key frame, pixels.
    worth : mapping of frame number to (n,) int array, optional
        Worth of the points: of those in the same part of a frame the best are followed; by default the first.
    most : int
        Number of points of each key frame that are followed.
    """
    size = camera.width, camera.height
    keys = sorted(shown)
    chosen = {}
    for key, xy in shown.items():
        value = np.arange(len(xy))[::-1] if worth is None else worth[key]
        chosen[key] = _spread(xy, value, size, most)
    found = []
    for a, b, frames in _between_keys(clip, keys):
        step = np.array(size) / frames[0].grey.shape[::-1]
        starts = [(shown[key][chosen[key]] + 0.5) / step - 0.5 for key in (a, b)]
        for key, tracks in zip((a, b), flow_between(frames, *starts), strict=True):
            found.append((key, tracks.frame + a, tracks.point, (tracks.xy + 0.5) * step - 0.5))
    followed = Followed(chosen)
    followed.add(found)
    return followed


class CameraPoses:
    """Poses between those of some frames of a clip."""

    def __init__(self, clip: Clip, poses: Mapping[int, tuple[Array, Array]]) -> None:
        self._clip, self._poses = clip, dict(poses)
        self._frames = np.array(sorted(poses))

    def near(self, frame: int) -> tuple[Array, Array]:
        """A steady motion's pose between the two frames around one, or that of the only neighbour in its part."""
        part = self._clip.part
        after = int(np.searchsorted(self._frames, frame))
        around = [int(k) for k in self._frames[max(after - 1, 0) : after + 1] if part[k] == part[frame]]
        a, b = around[0], around[-1]
        (R_a, c_a), (R_b, c_b) = self._poses[a], self._poses[b]
        if a == b:
            return R_a, c_a
        time = self._clip.time_s
        share = (time[frame] - time[a]) / (time[b] - time[a])
        rotation = Rotation.from_rotvec(share * Rotation.from_matrix(R_b @ R_a.T).as_rotvec())
        return rotation.as_matrix() @ R_a, c_a + share * (c_b - c_a)


def with_all_frames(
    clip: Clip, reconstruction: Reconstruction, followed: Followed, placed_before: Reconstruction | None = None
) -> Reconstruction:
    """A reconstruction of all frames that could be registered, from that of the key frames.

    Each followed point is a point of its own, at the place of the point in its key frame: the start of the flow counts
    as the measurement of the key frame, so an error there is the same in all frames, and moves the point. Points of the
    key frames connect these, as before. Frames that were `placed_before` keep their poses.
    """
    rec, obs = reconstruction, reconstruction.observations
    keys = sorted(followed.chosen)
    start = dict(zip(keys, np.cumsum([0, *(len(followed.chosen[k]) for k in keys)])[:-1].tolist(), strict=True))
    own = np.concatenate([followed.chosen[k] for k in keys])
    frames = clip.places(rec.image_names)
    points_w = np.concatenate([rec.points_w, rec.points_w[obs.point_idx[own]]])
    point = rec.num_points + np.array([start[k] for k in followed.key.tolist()], np.int64) + followed.place
    at_key = np.concatenate([np.full(len(followed.chosen[k]), k) for k in keys])
    poses = _poses(clip, rec)
    if placed_before is not None:
        poses = _poses(clip, placed_before) | poses
    camera = rec.cameras[0]
    rays, valid = unproject_points(followed.xy_raw, camera, RowMotion(), "global")
    within = _ROOM_PX / float(camera.K[0, 0])
    known = CameraPoses(clip, poses)
    for k in sorted({*followed.frame.tolist()} - {*poses}):
        mine = np.flatnonzero((followed.frame == k) & valid)
        guess = known.near(k)
        poses[k] = resect(rays[mine], points_w[point[mine]], *guess, within) or guess
    placed = np.array(sorted(poses))
    image = np.full(len(clip.names), -1)
    image[placed] = np.arange(len(placed))
    frame = image[np.concatenate([frames[obs.frame_idx], at_key, followed.frame])]
    of_point = np.concatenate([obs.point_idx, rec.num_points + np.arange(len(own)), point])
    xy_raw = np.concatenate([obs.xy_raw, obs.xy_raw[own], followed.xy_raw])
    sigma = np.concatenate([obs.sigma, np.ones(len(own) + len(followed.frame))])
    seen = frame >= 0
    whole = Reconstruction(
        rec.cameras, [clip.names[k] for k in placed.tolist()], np.zeros(len(placed), np.int64),
        np.array([poses[k][0] for k in placed.tolist()]), np.array([poses[k][1] for k in placed.tolist()]), points_w,
        Observations(frame[seen], of_point[seen], xy_raw[seen], sigma[seen]),
    )  # fmt: skip
    return whole.with_points(np.ones(int(seen.sum()), bool))


def focused_as(before: Reconstruction, whole: Reconstruction) -> Reconstruction:
    """A reconstruction with the focal lengths that another one found for the same frames."""
    of_frame = dict(zip(before.image_names, before.variation, strict=True))
    none = np.zeros(3)
    return replace(whole, variation=np.array([of_frame.get(name, none) for name in whole.image_names]))
