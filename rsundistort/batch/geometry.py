"""What the remap grid of each photo takes: cameras, motion, and how far away what it shows is."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import numpy as np

from ..errors import FileError, InputError, RsUndistortWarning
from ..io import find_depth_maps, output_name, read_colmap_poses, read_depth_map
from ..io.places import local_place
from ..model import AtInfinity, Camera, Depth, DepthMap, Plane, Reconstruction, RowMotion, Solution
from ..model.array_types import Array, Index
from ..rectify import (
    depth_from_points,
    fit_plane,
    largest_shift_px,
    plane_in_camera,
    prefers_plane,
    translation_shift_px,
)

__all__ = ["DEPTHS", "PhotoDepth", "PhotoGeometry", "SceneGeometry", "ScenePoints", "check_depth", "with_depths"]

#: What `--depth` may say besides a folder.
DEPTHS = ("auto", "infinity", "plane", "points")

# Below this the translation of the camera is not seen, and depths could only do harm.
_LEAST_SHIFT_PX = 0.5
# Maps whose depths are this many times those of the points have another scale.
_OTHER_SCALE = 1.5


def check_depth(depth: str | Path) -> None:
    """Refuse what is neither of `DEPTHS` nor a folder."""
    depth = local_place(depth)
    if str(depth) not in DEPTHS and not Path(depth).is_dir():
        raise FileError(f"depth {str(depth)!r} is no folder, nor one of {', '.join(DEPTHS)}")


@dataclass(frozen=True)
class ScenePoints:
    """Points of a scene, and which of them each photo sees.

    Attributes
    ----------
    points_w : (n, 3) array
        World frame of the solution.
    seen : mapping of photo name to index array
        Points that a photo measured.
    num_photos : (n,) index array
        How many photos measured each point, whether or not they are in `seen`.
    """

    points_w: Array
    seen: Mapping[str, Index]
    num_photos: Index

    @classmethod
    def of_reconstruction(cls, rec: Reconstruction) -> ScenePoints:
        """Points of a reconstruction."""
        seen = _by_photo(rec.image_names, rec.observations.frame_idx, rec.observations.point_idx)
        return cls(rec.points_w, seen, _num_photos(seen, len(rec.points_w)))

    @classmethod
    def of_colmap_model(cls, folder: Path, names: Sequence[str], raw_as: str) -> ScenePoints:
        """Points of the COLMAP model that a run wrote, by the names of the raw photos."""
        _, written, _, _, _, points_w, frame_idx, point_idx = read_colmap_poses(folder)
        seen = _by_photo(written, frame_idx, point_idx)
        mine = {name: seen.get(output_name(name, raw_as)) for name in names}
        mine_only = {name: points for name, points in mine.items() if points is not None}
        return cls(points_w, mine_only, _num_photos(seen, len(points_w)))


def _by_photo(names: Sequence[str], frame_idx: Index, point_idx: Index) -> dict[str, Index]:
    order = np.argsort(frame_idx, kind="stable")
    bounds = np.searchsorted(frame_idx[order], np.arange(len(names) + 1))
    return {name: np.unique(point_idx[order[bounds[i] : bounds[i + 1]]]) for i, name in enumerate(names)}


def _num_photos(seen: Mapping[str, Index], num_points: int) -> Index:
    """(num_points,) photos that measured each point."""
    num = np.zeros(num_points, np.int64)
    for points in seen.values():
        num[points] += 1
    return num


class _Seen(NamedTuple):
    """Points that a photo measured: rectified pixels (n, 2), directions (n, 3) of z = 1, depths, and by how many."""

    xy: Array
    rays_c: Array
    depth: Array
    num_photos: Index


@dataclass(frozen=True)
class PhotoDepth:
    """How far away what one photo shows is, as it is rectified.

    Attributes
    ----------
    depth : Depth
        For `rectify`.
    kind : str
        "infinity", "plane", "points" or "map".
    shift_px : float
        Largest displacement that the translation alone caused.
    whole_shift_px : float or None
        Largest displacement that the shutter caused; None of a photo whose camera did not travel.
    """

    depth: Depth
    kind: str
    shift_px: float = 0.0
    whole_shift_px: float | None = None


# Not every threading layer of numba lets parallel kernels be called from several threads at once.
_ONE_AT_A_TIME = Lock()


@dataclass(frozen=True)
class PhotoGeometry:
    """All that the remap grid of one photo takes, in its camera's frame; small, and sent to where it is rectified.

    Attributes
    ----------
    name : str
        Of the photo, for people.
    camera, new_camera : Camera
        Of the raw photo, and the pinhole of the rectified one.
    motion : RowMotion
        What is taken out.
    shutter_model : str
        By which.
    how : str or None
        How the depth is found: one of `DEPTHS`, or "map"; None of a photo whose camera did not travel, which is
        rectified at infinity.
    points_c : (n, 3) array or None
        Points that the photo measured.
    num_photos : (n,) index array or None
        How many photos measured each of them.
    plane : Plane or None
        The plane nearest to most points of the scene.
    own_map : Path or None
        The user's depth map of it.
    """

    name: str
    camera: Camera
    new_camera: Camera
    motion: RowMotion
    shutter_model: str
    how: str | None = None
    points_c: Array | None = None
    num_photos: Index | None = None
    plane: Plane | None = None
    own_map: Path | None = None

    @property
    def grid(self) -> tuple[Camera, RowMotion, str, Camera]:
        """What `rectify` and `RemapGrid.from_camera` take, but for the depth."""
        return self.camera, self.motion, self.shutter_model, self.new_camera

    def find_depth(self) -> PhotoDepth:
        """How far away what the photo shows is."""
        if self.how is None:
            return PhotoDepth(AtInfinity(), "infinity")
        depth, kind = self._choose()
        with _ONE_AT_A_TIME:
            shift = translation_shift_px(self.camera, self.motion, depth, self.new_camera)
            if self.how == "auto" and not shift > _LEAST_SHIFT_PX:
                depth, kind = AtInfinity(), "infinity"
            whole = largest_shift_px(self.camera, self.motion, self.shutter_model, depth, self.new_camera)
        return PhotoDepth(depth, kind, shift, whole)

    def _choose(self) -> tuple[Depth, str]:
        size = (self.new_camera.width, self.new_camera.height)
        seen = self._seen()
        if self.how == "map":
            return self._own_map(size, seen)
        plane = self.plane
        if plane is not None and self.how == "auto" and seen is not None:
            plane = plane if prefers_plane(plane, seen.xy, seen.rays_c, seen.depth, size, seen.num_photos) else None
        if plane is not None:
            return plane, "plane"
        if seen is not None and self.how in ("auto", "points"):
            return depth_from_points(seen.xy, seen.depth, size, seen.num_photos), "points"
        return AtInfinity(), "infinity"

    def _seen(self) -> _Seen | None:
        if self.points_c is None or self.num_photos is None:
            return None
        K = self.new_camera.K
        before = self.points_c[:, 2] > 0
        X_c = self.points_c[before]
        rays = X_c / X_c[:, 2:]
        if not len(X_c):
            return None
        return _Seen(rays[:, :2] @ K[:2, :2].T + K[:2, 2], rays, X_c[:, 2], self.num_photos[before])

    def _own_map(self, size: tuple[int, int], seen: _Seen | None) -> tuple[Depth, str]:
        path = self.own_map
        if path is None:
            text = f"{self.name} has no depth map and is rectified at infinity"
            warnings.warn(text, RsUndistortWarning, stacklevel=2)
            return AtInfinity(), "infinity"
        values = read_depth_map(path)
        rows, cols = values.shape
        # of another size, but of the same shape to a pixel
        if abs(cols * size[1] - rows * size[0]) > max(size[0], size[1], rows, cols):
            raise InputError(f"depth map {path} has {cols}x{rows} pixels, the rectified photo {size[0]}x{size[1]}")
        try:
            depth = DepthMap(values, size)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        if seen is not None:
            at = np.floor((seen.xy + 0.5) * [cols / size[0], rows / size[1]]).astype(int)
            inside = (at >= 0).all(1) & (at < [cols, rows]).all(1)
            ratio = values[at[inside, 1], at[inside, 0]] / seen.depth[inside]
            ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
            times = float(np.median(ratio)) if len(ratio) else 1.0
            if not 1 / _OTHER_SCALE < times < _OTHER_SCALE:
                text = f"{path}: depths are {times:.3g} times those of the solution's points; is their unit another?"
                warnings.warn(text, RsUndistortWarning, stacklevel=2)
        return depth, "map"


class SceneGeometry:
    """Geometry of the photos of a solution.

    Parameters
    ----------
    solution : Solution
        In the stored frames of the photos.
    depth : str or Path
        One of `DEPTHS`, or a folder of depth maps.
    points : ScenePoints, optional
        For "auto", "plane" and "points"; without them, "auto" is at infinity.
    """

    def __init__(self, solution: Solution, depth: str | Path, points: ScenePoints | None) -> None:
        check_depth(depth)
        self.solution = solution
        self._how = str(depth) if str(depth) in DEPTHS else "map"
        self._points = points
        moving = solution.shutter_model == "constant-motion"
        self._moving = {image.name for image in solution.registered if moving and image.posed}
        own = self._how == "map" and self._moving
        if self._how == "map" and not self._moving:
            text = f"{depth} is not used: no camera travelled while it was read, or the shutter model has no velocity"
            warnings.warn(text, RsUndistortWarning, stacklevel=2)
        self._maps = find_depth_maps(Path(depth).absolute(), sorted(self._moving)) if own else {}
        if self._how in ("plane", "points") and points is None and self._moving:
            raise InputError(f"depth {self._how!r} needs the points of the scene, and there are none")
        self._plane: tuple[Array, float] | None = None
        if self._moving and points is not None and len(points.points_w) >= 3 and self._how in ("auto", "plane"):
            self._plane = fit_plane(points.points_w)

    def of(self, name: str) -> PhotoGeometry:
        """Geometry of a photo."""
        solution, image = self.solution, self.solution.image(name)
        motion = image.taken_out or RowMotion()
        cameras = solution.cameras[image.camera_id], solution.rectified_cameras[image.camera_id]
        if name not in self._moving or not motion.moves:
            return PhotoGeometry(name, *cameras, motion, solution.shutter_model)
        R_cw, center_w = image.R_cw, image.center_w
        assert R_cw is not None
        assert center_w is not None
        points_c, num_photos = None, None
        if self._points is not None:
            seen = self._points.seen.get(name, np.zeros(0, np.int64))
            points_c = (self._points.points_w[seen] - center_w) @ R_cw.T
            num_photos = self._points.num_photos[seen]
        plane = None if self._plane is None else plane_in_camera(*self._plane, R_cw, center_w)
        return PhotoGeometry(
            name, *cameras, motion.in_camera(R_cw), solution.shutter_model, self._how, points_c, num_photos,
            plane, self._maps.get(name),
        )  # fmt: skip


def with_depths(solution: Solution, found: Mapping[str, tuple[str, float, float]]) -> Solution:
    """The solution with the depths that were used, and the shifts that they mean."""
    images = []
    for image in solution.images:
        if image.name in found:
            kind, shift, whole = found[image.name]
            image = replace(image, depth=kind, translation_shift_px=shift, rs_shift_px=whole)
        images.append(image)
    return replace(solution, images=tuple(images))
