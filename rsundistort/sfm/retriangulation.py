"""New tracks from known poses and motions."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..colmap.conventions import quiet_pycolmap, rigid_of
from ..colmap.lenses import camera_to_colmap
from ..model import Reconstruction, RowMotion
from .database import MatchedPhotos, from_pycolmap, ideal_keypoints, pipeline_options
from .epipolar import TIGHT_PX, FreedMatches, matches_that_fit

__all__ = ["retriangulate"]


def retriangulate(
    matched: MatchedPhotos, reconstruction: Reconstruction, *, of_two: bool = False, least_deg: float | None = None
) -> Reconstruction:
    """New tracks and points for a reconstruction's poses, from keypoints without shutter.

    The keypoints are corrected by the reconstruction's motion, and matches that fit its poses are triangulated with
    tight thresholds: measurements that the shutter had cut off return, and false ones that passed the loose thresholds
    are dropped.

    Parameters
    ----------
    matched : MatchedPhotos
        Keypoints and matches of at least the reconstruction's photos.
    of_two : bool
        Whether points that only two photos show are among the new ones: `align_tracks` may find them in others.
    least_deg : float, optional
        Rays of a point meet at this angle or a larger one; by default at COLMAP's, 1.5 degrees.

    Returns
    -------
    Reconstruction
        The same photos, poses and motions, with new points and raw measurements.
    """
    pycolmap = quiet_pycolmap()
    freed, cameras = FreedMatches(matched, reconstruction), reconstruction.cameras
    tight_px = TIGHT_PX * matched.step_px
    explained = matches_that_fit(matched, reconstruction)
    depths = freed.depths(explained)
    with pycolmap.Database.open(matched.database) as db:
        for index, camera in enumerate(cameras):
            db.update_camera(camera_to_colmap(camera, True, index + 1))
        for index, found in enumerate(matched.features):
            camera = cameras[matched.camera_idx[index]]
            model, motion, own = "global", RowMotion(), camera
            if (i := int(freed.posed[index])) >= 0:
                model, own = reconstruction.shutter_model, reconstruction.camera(i)
                motion = reconstruction.motion(i).in_camera(reconstruction.R_cw[i])
            db.update_keypoints(index + 1, ideal_keypoints(found, camera, motion, model, own, depths.get(index)))
        db.clear_two_view_geometries()
        # written as verified: pairs with known geometry need no search for one
        for (first, second), matches in explained.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches
            db.write_two_view_geometry(first + 1, second + 1, geometry)
    empty = _posed_model(matched, reconstruction)
    options = pipeline_options(1.0, matched.seed, False, len(matched.names))
    if least_deg is not None:
        options.mapper.filter_min_tri_angle = options.triangulation.min_angle = least_deg
    options.mapper.filter_max_reproj_error = tight_px
    options.triangulation.merge_max_reproj_error = tight_px
    options.triangulation.complete_max_reproj_error = tight_px
    options.triangulation.ignore_two_view_tracks = not of_two
    # poses and cameras are fixed: one pass is enough, our own adjustment follows
    options.ba_global_max_refinements = 1
    model = pycolmap.triangulate_points(
        empty, matched.database, matched.database.parent, matched.database.parent, options=options
    )
    return from_pycolmap(model, matched, reconstruction)


def _posed_model(matched: MatchedPhotos, reconstruction: Reconstruction) -> Any:
    """A pycolmap model of the database's images with the reconstruction's poses and no points."""
    pycolmap = quiet_pycolmap()
    model = pycolmap.Reconstruction()
    index_of = {name: i for i, name in enumerate(reconstruction.image_names)}
    with pycolmap.Database.open(matched.database) as db:
        for index in range(len(reconstruction.cameras)):
            model.add_camera(db.read_camera(index + 1))
        for rig in db.read_all_rigs():
            model.add_rig(rig)
        frame_of_image = {each.id: frame for frame in db.read_all_frames() for each in frame.data_ids}
        for index, name in enumerate(matched.names):
            frame = frame_of_image[index + 1]
            if name not in index_of:
                continue
            i = index_of[name]
            frame.rig_from_world = rigid_of(reconstruction.R_cw[i], reconstruction.center_w[i])
            model.add_frame(frame)
            image = db.read_image(index + 1)
            image.frame_id = frame.frame_id
            image.points2D = pycolmap.Image(keypoints=db.read_keypoints(index + 1)[:, :2].astype(np.float64)).points2D
            model.add_image(image)
            model.register_frame(frame.frame_id)
    return model
