"""Scenes with known cameras, points and visibility: what an experiment projects its own measurements from."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import FileError, FormatError, InputError
from ..io import read_colmap_poses
from ..model import Camera
from ..model.array_types import Array, Index
from ..model.arrays import read_arrays
from ..model.checks import check_finite, check_index, check_rotations, frozen

__all__ = ["KnownScene", "load_scene"]

_ARRAYS = ("K", "width", "height", "R_cw", "center_w", "points_w", "frame_idx", "point_idx")


@dataclass(frozen=True)
class KnownScene:
    """Cameras, points, and which photo sees which point.

    Attributes
    ----------
    R_cw, center_w : (m, 3, 3), (m, 3) array
        Poses in the order of the sequence; the mean distance of consecutive centres is 1.
    points_w : (n, 3) array
        Points.
    frame_idx, point_idx : (o,) int array
        Photo `frame_idx[k]` sees point `point_idx[k]`.
    """

    name: str
    camera: Camera
    R_cw: Array
    center_w: Array
    points_w: Array
    frame_idx: Index
    point_idx: Index

    def __post_init__(self) -> None:
        for name, dimensions in (("R_cw", 3), ("points_w", 2), ("frame_idx", 1)):  # whose lengths are taken
            if np.ndim(getattr(self, name)) != dimensions:
                raise InputError(f"{name} has the shape {np.shape(getattr(self, name))}, expected {dimensions} axes")
        checked = {
            "R_cw": check_rotations(self.R_cw, len(self.R_cw), "R_cw"),
            "center_w": check_finite(self.center_w, (len(self.R_cw), 3), "center_w"),
            "points_w": check_finite(self.points_w, (None, 3), "points_w"),
            "frame_idx": check_index(self.frame_idx, len(self.frame_idx), len(self.R_cw), "frame_idx"),
            "point_idx": check_index(self.point_idx, len(self.frame_idx), len(self.points_w), "point_idx"),
        }
        for name, array in checked.items():
            object.__setattr__(self, name, frozen(array))

    @property
    def digest(self) -> str:
        """Digest of camera, poses, points and visibility, whatever the name."""
        parts = (self.camera.K, self.R_cw, self.center_w, self.points_w, self.frame_idx, self.point_idx)
        total = hashlib.sha256(f"{self.camera.width} {self.camera.height} {self.camera.readout}".encode())
        for part in parts:
            total.update(part.tobytes())
        return total.hexdigest()[:16]

    @property
    def num_images(self) -> int:
        """Number of photos."""
        return len(self.R_cw)


def _scaled(scene: KnownScene) -> KnownScene:
    """The scene in units of its mean distance of consecutive centres (the paper's t-bar)."""
    step = float(np.linalg.norm(np.diff(scene.center_w, axis=0), axis=1).mean())
    if not step > 0:
        raise InputError(f"{scene.name}: all photos are taken from one place")
    return replace(scene, center_w=scene.center_w / step, points_w=scene.points_w / step)


def load_scene(path: Path | str) -> KnownScene:
    """A scene from an `.npz` (arrays as in `tracks.npz`), a COLMAP model, or the output folder of a run.

    Points that fewer than two photos see are left out.

    Raises
    ------
    FileError, FormatError, InputError
        When there is nothing to read, or no scene of one camera, or fewer than three photos.
    """
    path = Path(path)
    if path.is_dir():
        folder = path / "sparse" if (path / "sparse").is_dir() else path
        cameras, names, _, R, center, points, frame, point = read_colmap_poses(folder)
        if len(set(cameras)) != 1:
            raise InputError(f"{path} has {len(cameras)} cameras; the experiment takes scenes of one")
        order = np.argsort(names)
        rank = np.argsort(order)
        scene = KnownScene(path.resolve().name, cameras[0], R[order], center[order], points, rank[frame], point)
    elif path.suffix == ".npz":
        scene = _from_npz(path)
    else:
        raise FileError(f"{path} is no scene; give an .npz, a COLMAP model or the output folder of a run")
    if scene.num_images < 3:
        raise InputError(f"{path} has {scene.num_images} photos; the experiment needs at least three")
    return _scaled(_seen_twice(scene))


def _from_npz(path: Path) -> KnownScene:
    found = read_arrays(path)
    if "" in found:
        raise FormatError(f"{path} is no scene: it holds a single array; write one with np.savez")
    for name in _ARRAYS:
        if name not in found:
            raise FormatError(f"{path} is no scene: it lacks {name}")
    if found["K"].ndim == 3:
        raise InputError(f"{path} has several cameras; the experiment takes scenes of one")
    if found["width"].ndim or found["height"].ndim:
        raise FormatError(f"{path} is no scene: width and height must be single numbers")
    for name in _ARRAYS:
        array = found[name]
        if array.dtype.kind not in "fiu":
            raise FormatError(f"{path} is no scene: {name} holds {array.dtype}, expected numbers")
    try:
        return KnownScene(
            path.stem if path.stem != "tracks" else path.resolve().parent.name,
            Camera(int(found["width"]), int(found["height"]), found["K"]),
            *(found[name] for name in ("R_cw", "center_w", "points_w", "frame_idx", "point_idx")),
        )
    except InputError as error:
        raise FormatError(f"{path} is no scene: {error}") from error


def _seen_twice(scene: KnownScene) -> KnownScene:
    """The scene without points that fewer than two photos see."""
    seen = np.unique(np.stack([scene.point_idx, scene.frame_idx]), axis=1)
    kept = np.bincount(seen[0], minlength=len(scene.points_w)) >= 2
    new = np.cumsum(kept) - 1
    point, frame = seen[:, kept[seen[0]]]
    blind = np.flatnonzero(np.bincount(frame, minlength=scene.num_images) == 0)
    if len(blind):
        raise InputError(f"{scene.name}: photo {blind[0]} shares no point with another photo")
    return replace(scene, points_w=scene.points_w[kept], frame_idx=frame, point_idx=new[point])
