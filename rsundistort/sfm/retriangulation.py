"""New tracks from known poses and motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colmap.conventions import quiet_pycolmap
from ..colmap.lenses import camera_to_colmap
from ..model import Camera, Reconstruction, RowMotion
from ..model.projection import unproject_points
from .database import MatchedPhotos, from_pycolmap, ideal_keypoints, pipeline_options

__all__ = ["retriangulate"]

# Of a measurement from its prediction, in pixels of the image that the features were found in.
_TIGHT_PX = 2.0
# A pair with fewer matches that fit is likely to have only such as fit by chance.
_MIN_EXPLAINED = 15


def retriangulate(matched: MatchedPhotos, reconstruction: Reconstruction, *, of_two: bool = False) -> Reconstruction:
    """New tracks and points for a reconstruction's poses, from keypoints freed of the shutter.

    The keypoints are corrected by the reconstruction's motion; matches that its poses explain are triangulated with
    tight thresholds: measurements that the shutter had cut off return, false ones that the loose thresholds had let in
    go.

    Parameters
    ----------
    matched : MatchedPhotos
        Keypoints and matches of at least the reconstruction's photos.
    reconstruction : Reconstruction
        Poses, motions and cameras.
    of_two : bool
        Whether points that only two photos show are among the new ones: `align_tracks` may find them in others.

    Returns
    -------
    Reconstruction
        The same photos, poses and motions, with new points and raw measurements.
    """
    pycolmap = quiet_pycolmap()
    index_of = {name: i for i, name in enumerate(reconstruction.image_names)}
    posed = np.array([index_of.get(name, -1) for name in matched.names])
    cameras = reconstruction.cameras
    tight_px = _TIGHT_PX * float(np.median([each.step_px for each in matched.features]))
    with pycolmap.Database.open(matched.database) as db:
        for index, camera in enumerate(cameras):
            db.update_camera(camera_to_colmap(camera, True, index + 1))
        for index, found in enumerate(matched.features):
            camera = cameras[matched.camera_idx[index]]
            model, motion, own = "global", RowMotion(), camera
            if (i := int(posed[index])) >= 0:
                model, motion, own = reconstruction.shutter_model, reconstruction.motion(i), reconstruction.camera(i)
            db.update_keypoints(index + 1, ideal_keypoints(found, camera, motion, model, own))
        db.clear_two_view_geometries()
        _write_explained(db, matched, reconstruction, posed)
    empty = _posed_model(matched, reconstruction, cameras)
    options = pipeline_options(1.0, matched.seed, False, len(matched.names))
    options.mapper.filter_max_reproj_error = tight_px
    options.triangulation.merge_max_reproj_error = tight_px
    options.triangulation.complete_max_reproj_error = tight_px
    options.triangulation.ignore_two_view_tracks = not of_two
    # poses and cameras are held: once through is enough, our own adjustment follows
    options.ba_global_max_refinements = 1
    model = pycolmap.triangulate_points(
        empty, matched.database, matched.database.parent, matched.database.parent, options=options
    )
    return from_pycolmap(model, matched, reconstruction)


def _write_explained(db: Any, matched: MatchedPhotos, rec: Reconstruction, posed: NDArray[np.int64]) -> None:
    """Write the matches that the poses explain as verified: no pair is searched for a geometry that is known.

    A match is explained if both of its rays, freed of the shutter, lie within tight thresholds of the other's epipolar
    plane (Sampson's distance).
    """
    pycolmap = quiet_pycolmap()
    rays: dict[int, NDArray[np.float64]] = {}

    def rays_of(index: int) -> NDArray[np.float64]:
        if index not in rays:
            i = int(posed[index])
            xy, valid = unproject_points(
                matched.features[index].xy_raw, rec.camera(i), rec.motion(i), rec.shutter_model
            )  # fmt: skip
            rays[index] = np.column_stack([np.where(valid[:, None], xy, np.nan), np.ones(len(xy))])
        return rays[index]

    for pair_id in db.read_all_matches()[0]:
        first, second = (k - 1 for k in pycolmap.pair_id_to_image_pair(pair_id))
        if posed[first] < 0 or posed[second] < 0:
            continue
        matches = np.asarray(db.read_matches(first + 1, second + 1))
        i, j = int(posed[first]), int(posed[second])
        distance = sampson_distance(
            rays_of(first)[matches[:, 0]], rays_of(second)[matches[:, 1]], rec.R_cw[j] @ rec.R_cw[i].T,
            rec.R_cw[j] @ (rec.center_w[i] - rec.center_w[j]),
        )  # fmt: skip
        allowed = [
            _TIGHT_PX * matched.features[k].step_px / float(rec.camera(int(posed[k])).K[0, 0]) for k in (first, second)
        ]
        explained = matches[distance <= max(allowed)]
        if len(explained) >= _MIN_EXPLAINED:
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = explained
            db.write_two_view_geometry(first + 1, second + 1, geometry)


def sampson_distance(
    x_1: NDArray[np.float64], x_2: NDArray[np.float64], R_21: NDArray[np.float64], t_21: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance of matches from a relative pose: to first order, what both must move by to fit it.

    Parameters
    ----------
    x_1, x_2 : (n, 3) arrays
        Normalized coordinates and 1; NaN where there are none.
    R_21, t_21 : (3, 3) and (3,) arrays
        From the first camera to the second, `x_2 ~ R_21 X_1 + t_21`.

    Returns
    -------
    (n,) array
        In normalized coordinates; NaN where these are. Inf for two photos from one place, which have no planes.
    """
    length = float(np.linalg.norm(t_21))
    if length == 0.0:
        return np.full(len(x_1), np.inf)
    x, y, z = t_21 / length
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R_21
    line_2, line_1 = x_1 @ E.T, x_2 @ E
    slope = np.sqrt((line_1[:, :2] ** 2).sum(1) + (line_2[:, :2] ** 2).sum(1))
    return np.asarray(np.abs((line_2 * x_2).sum(1)) / np.maximum(slope, 1e-300))


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
