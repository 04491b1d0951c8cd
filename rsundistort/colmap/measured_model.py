"""COLMAP models with their measurements, as reconstructions of ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FormatError
from ..model import Observations, Reconstruction
from ..model.array_types import Index, Mask
from ..model.reprojection import reprojection_residuals
from .cameras_and_poses import image_name
from .conventions import HALF, poses_of
from .file_checks import pycolmap_model
from .lenses import camera_from_colmap
from .rectified_model import ModelIds

__all__ = ["ColmapModel", "colmap_model_of", "read_colmap_model", "surviving_points"]


# files of every model, text or binary; newer ones have rigs and frames, too
_PARTS = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class ColmapModel:
    """A COLMAP model as a reconstruction, with the names by which COLMAP knows its parts.

    Attributes
    ----------
    reconstruction : Reconstruction
        Registered photos in the order of their ids, points that two of them see, and the keypoints as measurements.
    camera_ids, image_ids, point_ids : (cameras,), (m,), (n,) int array
        COLMAP's ids.
    keypoint_idx : (o,) int array
        Which keypoint of its photo each measurement is.
    colors : (n, 3) uint8 array
        Red, green, blue of the points.
    unregistered : sequence of str
        Photos without a pose.
    self_calibrated : bool
        Whether a camera is of a model that COLMAP refines by default: any but PINHOLE. Without a model of the shutter
        its intrinsics took up some of it.
    has_colors : bool
        Whether the colours are known.
    georeference : mapping or None
        Where on the map the model is, as of `Solution`, where it says so.
    camera_of : mapping of name to int
        Place of the camera of photos, also of those without a pose, as far as the model says it.
    """

    reconstruction: Reconstruction
    camera_ids: Index
    image_ids: Index
    point_ids: Index
    keypoint_idx: Index
    colors: NDArray[np.uint8]
    unregistered: Sequence[str]
    self_calibrated: bool = False
    has_colors: bool = True
    georeference: Mapping[str, Any] | None = None
    camera_of: Mapping[str, int] = field(default_factory=dict)

    def once_a_photo(self) -> ColmapModel:
        """The model with one measurement of a point in a photo, the nearest, and the points that two photos see."""
        rec = self.reconstruction
        once = _once_a_photo(rec)
        alive = rec.track_lengths(once) >= 2
        return replace(
            self,
            reconstruction=rec.with_points(once),
            point_ids=self.point_ids[alive],
            keypoint_idx=self.keypoint_idx[once & alive[rec.observations.point_idx]],
            colors=self.colors[alive],
        )

    def ids_of(self, points: Index, names: Sequence[str]) -> ModelIds:
        """Ids of a reconstruction's parts, of which these old points (-1: none) and photos became.

        Points without an old one get ids above all that there are.
        """
        image_id = dict(zip(self.reconstruction.image_names, self.image_ids.tolist(), strict=True))
        new = points < 0
        ids = np.where(new, 0, self.point_ids[points])
        ids[new] = self.point_ids.max() + 1 + np.arange(new.sum())
        return ModelIds(self.camera_ids.tolist(), [image_id[name] for name in names], ids.tolist())


def surviving_points(before: Reconstruction, after: Reconstruction) -> Index:
    """(n,) for each point of `after` the point of `before` that it continues, or -1.

    It is the one most of its measurements belonged to; an old point goes on in the new one that has most of them.
    """
    place = {name: i for i, name in enumerate(before.image_names)}
    of_photo = np.array([place.get(name, -1) for name in after.image_names], np.int64)
    old, new = before.observations, after.observations
    frame = np.concatenate([old.frame_idx, of_photo[new.frame_idx]])
    x, y = np.concatenate([old.xy_raw, new.xy_raw]).T
    order = np.lexsort((y, x, frame))
    fresh = np.ones(len(order), bool)
    fresh[1:] = (np.diff(frame[order]) != 0) | (np.diff(x[order]) != 0) | (np.diff(y[order]) != 0)
    place_of = np.empty(len(order), np.int64)
    place_of[order] = np.cumsum(fresh) - 1
    old_place, new_place = place_of[: len(old)], place_of[len(old) :]
    by_place = np.argsort(old_place, kind="stable")
    first = np.searchsorted(old_place[by_place], new_place, "left")
    end = np.searchsorted(old_place[by_place], new_place, "right")
    pairs = []
    # keypoints of several directions share a place: each votes
    for k in range(int((end - first).max(initial=0))):
        has = np.flatnonzero(first + k < end)
        pairs.append(np.column_stack([new.point_idx[has], old.point_idx[by_place[first[has] + k]]]))
    new_of, old_of = np.concatenate(pairs).T if pairs else np.zeros((2, 0), np.int64)
    votes, count = np.unique(new_of * before.num_points + old_of, return_counts=True)
    of_new, of_old = np.divmod(votes, before.num_points)
    survivors = np.full(after.num_points, -1)
    gone_on = np.zeros(before.num_points, bool)
    # each new point takes the old one with most votes that is left; of several that want one, the first
    open_pairs = np.lexsort((of_old, of_new, -count))
    while len(open_pairs):
        of_each = open_pairs[np.sort(np.unique(of_new[open_pairs], return_index=True)[1])]
        chosen = of_each[np.unique(of_old[of_each], return_index=True)[1]]
        survivors[of_new[chosen]] = of_old[chosen]
        gone_on[of_old[chosen]] = True
        open_pairs = open_pairs[(survivors[of_new[open_pairs]] < 0) & ~gone_on[of_old[open_pairs]]]
    return survivors


def read_colmap_model(folder: Path) -> ColmapModel:
    """The COLMAP model of a folder, text or binary.

    Raises
    ------
    FileError, FormatError
        When there is none, or one that cannot be taken (see `colmap_model_of`).
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileError(f"{folder} is no folder; give the folder with cameras, images and points3D of a COLMAP model")
    if not any(all((folder / f"{part}.{kind}").is_file() for part in _PARTS) for kind in ("bin", "txt")):
        raise FileError(f"{folder} is no COLMAP model; give the folder with its cameras, images and points3D")
    return colmap_model_of(pycolmap_model(folder), str(folder))


def colmap_model_of(model: Any, where: str = "the model") -> ColmapModel:
    """Our reconstruction of a `pycolmap.Reconstruction`; `where` names it in errors.

    A photo that a track holds twice is measured once, by the keypoint nearer to where the point projects.

    Raises
    ------
    FormatError
        When it has a camera of a model that is not ours, a rig of several sensors, a pose or a point that is no number,
        fewer than two photos, or no point.
    """
    for rig in model.rigs.values():
        if rig.num_sensors() > 1:
            raise FormatError(
                f"{where}: rig {rig.rig_id} holds {rig.num_sensors()} sensors, expected one; see docs/colmap.md"
            )
    camera_ids = sorted(model.cameras)
    cameras = [camera_from_colmap(model.cameras[k], f"{where}: camera {k}") for k in camera_ids]
    images = [model.images[k] for k in sorted(model.reg_image_ids())]
    if len(images) < 2 or not model.num_points3D():
        raise FormatError(
            f"{where} holds {len(images)} registered photos and {model.num_points3D()} points, expected more"
        )
    R_cw, center_w = poses_of(images)
    point_ids = np.array(sorted(model.point3D_ids()), np.int64)
    points_w = np.array([model.points3D[k].xyz for k in point_ids.tolist()])
    colors = np.array([model.points3D[k].color for k in point_ids.tolist()], np.uint8)
    for name, values in (("pose", R_cw), ("pose", center_w), ("point", points_w)):
        if not np.isfinite(values).all():
            raise FormatError(f"{where} holds a {name} that is no number")
    tables = []  # photo, keypoint, id of the point, x, y
    for i, image in enumerate(images):
        seen = [(i, k, p.point3D_id, *p.xy) for k, p in enumerate(image.points2D) if p.has_point3D()]
        tables.append(np.array(seen, np.float64).reshape(-1, 5))
    table = np.concatenate(tables)
    frame, keypoint, ids = table[:, :3].T.astype(np.int64)
    place = {key: k for k, key in enumerate(camera_ids)}
    rec = Reconstruction(
        cameras,
        [image_name(image, where) for image in images],
        np.array([place[image.camera_id] for image in images], np.int64),
        R_cw,
        center_w,
        points_w,
        Observations(frame, np.searchsorted(point_ids, ids), table[:, 3:] - HALF),
    )
    camera_of = {image_name(image, where): place.get(image.camera_id) for image in model.images.values()}
    return ColmapModel(
        rec,
        np.array(camera_ids, np.int64),
        np.array([image.image_id for image in images], np.int64),
        point_ids,
        keypoint,
        colors,
        tuple(sorted({*camera_of} - {*rec.image_names})),
        any(model.cameras[k].model_name != "PINHOLE" for k in camera_ids),
        camera_of={name: k for name, k in camera_of.items() if k is not None},
    ).once_a_photo()


def _once_a_photo(rec: Reconstruction) -> Mask:
    """(o,) measurements but those by which a photo sees a point again, farther from its projection."""
    obs = rec.observations
    res, valid = reprojection_residuals(rec)
    square = np.where(valid, (res**2).sum(1), np.inf)
    order = np.lexsort((square, obs.point_idx, obs.frame_idx))
    pair = np.column_stack([obs.frame_idx, obs.point_idx])[order]
    first = np.ones(len(order), bool)
    first[1:] = (pair[1:] != pair[:-1]).any(1)
    kept = np.zeros(len(order), bool)
    kept[order[first]] = True
    return kept
