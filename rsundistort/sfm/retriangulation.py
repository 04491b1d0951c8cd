"""New tracks from known poses and motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..model import Camera, Reconstruction, RowMotion
from .database import (
    MatchedPhotos,
    database_camera,
    from_pycolmap,
    ideal_keypoints,
    pipeline_options,
    quiet_pycolmap,
    verification_options,
)

__all__ = ["retriangulate"]

_TIGHT_PX = 2.0


def retriangulate(matched: MatchedPhotos, reconstruction: Reconstruction) -> Reconstruction:
    """New tracks and points for a reconstruction's poses, from keypoints freed of the shutter.

    The keypoints are corrected by the reconstruction's motion, the matches verified again and triangulated with tight
    thresholds: measurements that the shutter had cut off return, false ones that the loose thresholds had let in go.

    Returns
    -------
    Reconstruction
        The same photos, poses and motions, with new points and raw measurements.
    """
    pycolmap = quiet_pycolmap()
    index_of = {name: i for i, name in enumerate(reconstruction.image_names)}
    cameras = reconstruction.cameras
    with pycolmap.Database.open(matched.database) as db:
        for index, camera in enumerate(cameras):
            db.update_camera(database_camera(camera, True, index + 1))
        for index, name in enumerate(matched.names):
            camera = cameras[matched.camera_idx[index]]
            model, motion = "global", RowMotion()
            if name in index_of:
                model, motion = reconstruction.shutter_model, reconstruction.motion(index_of[name])
            db.update_keypoints(index + 1, ideal_keypoints(matched.features[index], camera, motion, model))
        db.clear_two_view_geometries()
    pycolmap.geometric_verification(
        matched.database, two_view_geometry_options=verification_options(_TIGHT_PX, matched.seed)
    )
    empty = _posed_model(matched, reconstruction, cameras)
    options = pipeline_options(1.0, matched.seed, False, len(matched.names))
    options.mapper.filter_max_reproj_error = _TIGHT_PX
    options.triangulation.merge_max_reproj_error = _TIGHT_PX
    options.triangulation.complete_max_reproj_error = _TIGHT_PX
    model = pycolmap.triangulate_points(
        empty, matched.database, matched.database.parent, matched.database.parent, options=options
    )
    return from_pycolmap(model, matched, reconstruction)


def _posed_model(matched: MatchedPhotos, reconstruction: Reconstruction, cameras: Sequence[Camera]) -> Any:
    """A pycolmap model of the database's images with the reconstruction's poses and no points."""
    pycolmap = quiet_pycolmap()
    model = pycolmap.Reconstruction()
    index_of = {name: i for i, name in enumerate(reconstruction.image_names)}
    with pycolmap.Database.open(matched.database) as db:
        for index in range(len(cameras)):
            model.add_camera(db.read_camera(index + 1))
        for rig in db.read_all_rigs():
            model.add_rig(rig)
        frames = {frame.frame_id: frame for frame in db.read_all_frames()}
        frame_of_image = {d.id: frame for frame in frames.values() for d in frame.data_ids}
        for index, name in enumerate(matched.names):
            frame = frame_of_image[index + 1]
            if name not in index_of:
                continue
            i = index_of[name]
            R = reconstruction.R_cw[i]
            pose = np.column_stack([R, -R @ reconstruction.center_w[i]])
            frame.rig_from_world = pycolmap.Rigid3d(pose)
            model.add_frame(frame)
            image = db.read_image(index + 1)
            image.frame_id = frame.frame_id
            image.points2D = pycolmap.Point2DList(
                [pycolmap.Point2D(xy) for xy in db.read_keypoints(index + 1)[:, :2].astype(np.float64)]
            )
            model.add_image(image)
            model.register_frame(frame.frame_id)
    return model
