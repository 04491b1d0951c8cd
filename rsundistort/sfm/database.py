"""The pycolmap database of a set of photos, whose keypoints we correct.

Every camera in pycolmap is a pinhole camera: lens and shutter are removed from keypoints as far as these are known, and
the results written into its database. Only a fisheye keeps its lens, which pycolmap has too: in a pinhole photo the
noise of a keypoint would grow with the square of the distance from the centre, 33 times at 80 degrees from the axis.
The measurements of the adjustment remain the raw pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colmap.conventions import HALF, poses_of, quiet_pycolmap
from ..colmap.lenses import camera_to_colmap
from ..errors import ReconstructionError
from ..model import Camera, Observations, Reconstruction, RowMotion
from ..model.array_types import Array, Index
from ..model.projection import at_depth, project_points, unproject_points
from .features import Features

__all__ = [
    "LOOSE",
    "MatchedPhotos",
    "from_pycolmap",
    "ideal_keypoints",
    "pipeline_options",
    "verification_options",
    "without_motions",
    "write_photos",
]

#: A rotation by 0.05 rad over the frame moves pixels by tens; epipolar geometry absorbs most of it. With thresholds
#: four times COLMAP's own, all photos register and tracks stay complete; with its own, a third is cut off.
LOOSE = 4.0


@dataclass(frozen=True)
class MatchedPhotos:
    """Features and matches of a folder, and the pycolmap database that holds them.

    Attributes
    ----------
    database : Path
        pycolmap's database; image ids are 1 + index of the photo, and so are its images' names.
    cameras, camera_idx : cameras, and the camera of each photo
        Intrinsics; a guess where `calibrated` is False.
    calibrated : bool
        Whether the intrinsics are known; if not, mapping refines focal length and k1.
    seed : int
        Seed of every random choice of pycolmap.
    """

    database: Path
    names: Sequence[str]
    features: Sequence[Features]
    cameras: Sequence[Camera]
    camera_idx: Index
    calibrated: bool
    seed: int

    @property
    def step_px(self) -> float:
        """Pixels of the photos per pixel of the images that the features were detected in."""
        return float(np.median([each.step_px for each in self.features]))


def ideal_keypoints(
    features: Features,
    camera: Camera,
    motion: RowMotion,
    model: str,
    own: Camera | None = None,
    depth: Array | None = None,
) -> NDArray[np.float32]:
    """Keypoints without shutter in the camera of the database, COLMAP's centres; where none exists, far outside.

    `own` is the camera at the time of the photo, if it differs; `depth` (n,) that of the keypoints at the reference
    row, if the motion, in the camera, travels.
    """
    own = own or camera
    ideal, valid = unproject_points(features.xy_raw, own, motion, model)
    if depth is not None:
        ideal = at_depth(ideal, features.xy_raw, own, motion, depth)
    if camera.lens == "fisheye":
        rays = np.column_stack([np.where(valid[:, None], ideal, 0.0), np.ones(len(ideal))])
        xy = project_points(rays, camera.without_field(), None, "global")[0]
    else:
        xy = ideal @ camera.K[:2, :2].T + camera.K[:2, 2]
    xy[~valid] = -1e4
    return (xy + HALF).astype(np.float32)


def without_motions(matched: MatchedPhotos, phi: Array, own: Sequence[Camera] | None = None) -> MatchedPhotos:
    """Photos whose keypoints have neither lens nor rotation, and cameras that have no lens either.

    Parameters
    ----------
    phi : (m, 3) array
        Rotations that are taken out, radians per unit of the clock.
    own : m cameras, optional
        Those at the time of each photo, if they vary.
    """
    cameras = [matched.cameras[k] for k in matched.camera_idx]
    features = [
        replace(
            found, xy_raw=ideal_keypoints(found, camera, RowMotion(each), "rotation", of_photo).astype(float) - HALF
        )
        for found, camera, each, of_photo in zip(matched.features, cameras, phi, own or cameras, strict=True)
    ]
    # what a fisheye shows has no place in a pinhole photo
    ideal = [camera.without_field() if camera.lens == "fisheye" else camera.pinhole() for camera in matched.cameras]
    return replace(matched, features=features, cameras=ideal)


def write_photos(db: Any, matched: MatchedPhotos, limit: int | None = None) -> None:
    """Cameras, photos and their first `limit` keypoints into an empty database."""
    pycolmap = quiet_pycolmap()
    rig_ids = []
    for index, camera in enumerate(matched.cameras):
        colmap_camera = camera_to_colmap(camera, matched.calibrated, index + 1)
        db.write_camera(colmap_camera, use_camera_id=True)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(colmap_camera.sensor_id)
        rig_ids.append(db.write_rig(rig))
    for index, found in enumerate(matched.features):
        camera_index = int(matched.camera_idx[index])
        # lists of pairs are of names between spaces: the photo's own may hold some
        image = pycolmap.Image(name=str(index + 1), camera_id=camera_index + 1, image_id=index + 1)
        db.write_image(image, use_image_id=True)
        frame = pycolmap.Frame()
        frame.rig_id = rig_ids[camera_index]
        frame.add_data_id(image.data_id)
        db.write_frame(frame)
        if matched.calibrated:
            keypoints = ideal_keypoints(found, matched.cameras[camera_index], RowMotion(), "global")
        else:
            keypoints = (found.xy_raw + HALF).astype(np.float32)
        db.write_keypoints(index + 1, keypoints[:limit])


def verification_options(max_error_px: float, seed: int) -> Any:
    """Options of the geometric verification of pairs."""
    options = quiet_pycolmap().TwoViewGeometryOptions()
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = seed
    # with three right matches of ten these find them almost surely; pairs without a right one take all of them
    options.ransac.max_num_trials = 3000
    options.detect_watermark = False
    return options


def pipeline_options(loose: float, seed: int, refine_intrinsics: bool, num_photos: int) -> Any:
    """Options of mapping and triangulation, with thresholds `loose` times COLMAP's own."""
    options = quiet_pycolmap().IncrementalPipelineOptions()
    options.random_seed = seed
    # one thread: with more, the same seed sometimes takes another first pair; small problems are no slower
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
    # smaller models are dropped and another first pair is tried
    options.min_model_size = min(10, max(min(3, num_photos), num_photos // 2))
    options.ba_refine_focal_length = refine_intrinsics
    options.ba_refine_extra_params = refine_intrinsics
    mapper, triangulation = options.mapper, options.triangulation
    mapper.random_seed = triangulation.random_seed = seed
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = refine_intrinsics
    mapper.init_max_error *= loose
    mapper.abs_pose_max_error *= loose
    mapper.filter_max_reproj_error *= loose
    triangulation.create_max_angle_error *= loose
    triangulation.continue_max_angle_error *= loose
    triangulation.merge_max_reproj_error *= loose
    triangulation.complete_max_reproj_error *= loose
    triangulation.re_max_angle_error *= loose
    return options


def from_pycolmap(model: Any, matched: MatchedPhotos, posed: Reconstruction | None) -> Reconstruction:
    """Our reconstruction of a pycolmap model, with the raw pixels as measurements.

    Poses, cameras and motions are `posed`'s when it is given (triangulation leaves them alone), else the model's.
    """
    ids = sorted(model.reg_image_ids())
    names = [matched.names[i - 1] for i in ids]
    rows, track_points = [], []
    frame_of = {image_id: k for k, image_id in enumerate(ids)}
    for number, point_id in enumerate(sorted(model.point3D_ids())):
        point = model.points3D[point_id]
        track_points.append(point.xyz)
        # COLMAP tracks can hold a photo twice: the first of its keypoints counts
        seen = dict(sorted(((each.image_id, each.point2D_idx) for each in point.track.elements), reverse=True))
        rows += [(frame_of[image_id], number, seen[image_id]) for image_id in sorted(seen)]
    if not track_points:
        raise ReconstructionError(
            "the photos were registered, but no scene point could be triangulated: from one spot there is no parallax; "
            "use photos from places apart, or check the camera's focal length"
        )
    frame, point_idx, keypoint = np.array(rows).T
    found = [matched.features[image_id - 1] for image_id in ids]
    start = np.concatenate([[0], np.cumsum([len(each.sigma) for each in found])])
    at = start[frame] + keypoint
    xy_raw = np.concatenate([each.xy_raw for each in found])[at]
    sigma = np.concatenate([each.sigma for each in found])[at]
    observations = Observations(frame, point_idx, xy_raw, sigma)
    points_w = np.array(track_points)
    if posed is not None:
        index_of = {name: i for i, name in enumerate(posed.image_names)}
        of = [index_of[name] for name in names]
        return replace(posed, image_names=names, points_w=points_w, observations=observations, **posed.rows(of))
    R_cw, center_w = poses_of([model.images[i] for i in ids])
    camera_idx = np.array([matched.camera_idx[i - 1] for i in ids])
    return Reconstruction(matched.cameras, names, camera_idx, R_cw, center_w, points_w, observations)
