"""The COLMAP model of the rectified photos."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..model import Camera, Reconstruction
from ..model.array_types import Array
from ..model.projection import at_depth, unproject_points
from .conventions import HALF, import_pycolmap, rigid_of
from .lenses import pinhole_to_colmap

__all__ = ["ModelIds", "check_text_names", "colmap_model", "rectified_keypoints", "write_colmap_model"]


@dataclass(frozen=True)
class ModelIds:
    """Names by which COLMAP knows the parts of a reconstruction.

    Attributes
    ----------
    cameras, images, points : sequences of int
        Ids of its cameras, photos and points.
    """

    cameras: Sequence[int]
    images: Sequence[int]
    points: Sequence[int]

    @classmethod
    def in_order(cls, rec: Reconstruction) -> ModelIds:
        """Counted from one."""
        return cls(*(range(1, 1 + count) for count in (len(rec.cameras), rec.num_images, rec.num_points)))


def rectified_keypoints(reconstruction: Reconstruction, rectified: list[Camera]) -> Array:
    """(o, 2) where the measurements lie in the rectified photos, pixels with integer centres.

    Parameters
    ----------
    reconstruction : Reconstruction
        Measurements in raw pixels.
    rectified : list of Camera
        New camera of each camera of the reconstruction.
    """
    obs = reconstruction.observations
    xy = np.full((len(obs), 2), np.nan)
    for i, of_photo in enumerate(obs.by_photo(reconstruction.num_images)):
        motion = reconstruction.motion(i).in_camera(reconstruction.R_cw[i])
        ideal, _ = unproject_points(
            obs.xy_raw[of_photo], reconstruction.camera(i), motion, reconstruction.shutter_model
        )
        if reconstruction.shutter_model == "constant-motion":
            # where the rectified photo shows the point depends on how far away it is
            X_w = reconstruction.points_w[obs.point_idx[of_photo]]
            depth = (X_w - reconstruction.center_w[i]) @ reconstruction.R_cw[i, 2]
            ideal = at_depth(ideal, obs.xy_raw[of_photo], reconstruction.camera(i), motion, depth)
        K = rectified[int(reconstruction.camera_idx[i])].K
        xy[of_photo] = ideal @ K[:2, :2].T + K[:2, 2]
    return xy


def colmap_model(
    reconstruction: Reconstruction,
    rectified: list[Camera],
    names: Sequence[str | None],
    colors: NDArray[np.uint8] | None = None,
    ids: ModelIds | None = None,
) -> Any:
    """The `pycolmap.Reconstruction` of the rectified photos: PINHOLE cameras, and where the photos show the points.

    Parameters
    ----------
    reconstruction : Reconstruction
        Poses, motions, points and raw measurements.
    rectified : list of Camera
        New camera of each camera of the reconstruction.
    names : sequence of str or None
        File names of the rectified photos; those without are left out.
    colors : (n, 3) uint8 array, optional
        Red, green, blue of the points.
    ids : ModelIds, optional
        Counted from one when left out.
    """
    pycolmap = import_pycolmap()

    ids = ids or ModelIds.in_order(reconstruction)
    model = pycolmap.Reconstruction()
    for index in np.unique(reconstruction.camera_idx).tolist():
        model.add_camera_with_trivial_rig(pinhole_to_colmap(rectified[index], ids.cameras[index]))
    obs = reconstruction.observations
    xy = rectified_keypoints(reconstruction, rectified)
    usable = np.asarray(np.isfinite(xy).all(1))
    by_photo = obs.by_photo(reconstruction.num_images)
    place = np.full(len(obs), -1)
    for i, name in enumerate(names):
        if name is None:
            continue
        of_photo = by_photo[i][usable[by_photo[i]]]
        place[of_photo] = np.arange(len(of_photo))
        image = pycolmap.Image(
            name=name,
            keypoints=xy[of_photo] + HALF,
            camera_id=ids.cameras[int(reconstruction.camera_idx[i])],
            image_id=ids.images[i],
        )
        model.add_image_with_trivial_frame(image, rigid_of(reconstruction.R_cw[i], reconstruction.center_w[i]))
    # what a loop over measurements reads one by one, Python holds in lists
    order = np.flatnonzero(place >= 0)
    order = order[np.argsort(obs.point_idx[order], kind="stable")]
    bounds = np.searchsorted(obs.point_idx[order], np.arange(reconstruction.num_points + 1)).tolist()
    seen_in, seen_as = np.asarray(ids.images)[obs.frame_idx[order]].tolist(), place[order].tolist()
    if colors is None:
        colors = np.zeros((reconstruction.num_points, 3), np.uint8)
    images = {key: model.image(key) for key in set(seen_in)}
    for p, (start, end) in enumerate(pairwise(bounds)):
        if end - start < 2:
            continue
        track = pycolmap.Track()
        for key, index in zip(seen_in[start:end], seen_as[start:end], strict=True):
            track.add_element(key, index)
            images[key].set_point3D_for_point2D(index, ids.points[p])
        point = pycolmap.Point3D(xyz=reconstruction.points_w[p], color=colors[p], track=track)
        model.add_point3D_with_id(ids.points[p], point)
    model.update_point_3d_errors()
    return model


def check_text_names(names: Iterable[str]) -> None:
    """Refuse photos whose names COLMAP's text files, a line for each photo, cannot hold."""
    for name in names:
        if len(f"{name}.".splitlines()) > 1:
            raise InputError(
                f"photo {name!r} has a line break in its name, which a model as text cannot hold; rename it"
            )


def write_colmap_model(folder: Path, *model: Any, text: bool = False) -> None:
    """Write cameras, images, points3D, and rigs, frames, of `colmap_model(*model)`, as `.bin` or as `.txt`."""
    found = colmap_model(*model)
    if text:
        check_text_names([image.name for image in found.images.values()])
    folder.mkdir(parents=True, exist_ok=True)
    if text:
        found.write_text(folder)
    else:
        found.write(folder)
