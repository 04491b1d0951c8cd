"""Matching, verification, mapping and re-triangulation by pycolmap, on keypoints that we correct.

Everything that pycolmap sees is a pinhole camera: keypoints are freed of lens and shutter as far as these are known
and written into its database. Only a fisheye keeps its lens, which pycolmap has too: in a pinhole photo the noise of a
keypoint would grow with the square of the distance from the centre, 33 times at 80 degrees from the axis. The
measurements of the adjustment remain the raw pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ReconstructionError
from ..model import Camera, Observations, Reconstruction, RowMotion
from ..model.projection import project_points, unproject_points
from .features import Features

__all__ = ["MatchedPhotos", "map_photos", "match_photos", "retriangulate"]

# COLMAP's pixel centres are at 0.5
_HALF = 0.5
# A shutter that turns by 0.05 rad over the frame moves pixels by tens; epipolar geometry absorbs most of it. With
# thresholds four times COLMAP's own, all photos register and tracks stay whole; with its own, a third is cut off.
_LOOSE = 4.0
_TIGHT_PX = 2.0
# Mapping only has to place the photos: it gets this many of the strongest keypoints of each. All of them come back
# when the tracks are rebuilt. (herz-jesus-8: 16384 keypoints map in 4.7 s, 4096 of them in 1.1 s, poses alike.)
_MAPPING_KEYPOINTS = 4096


@dataclass(frozen=True)
class MatchedPhotos:
    """Features and matches of a folder, and the pycolmap database that holds them.

    Attributes
    ----------
    database : Path
        pycolmap's database; image ids are 1 + index of the photo.
    names, features : sequences of length m
        Photos.
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
    camera_idx: NDArray[np.int64]
    calibrated: bool
    seed: int


def _pycolmap() -> Any:
    """Pycolmap, quiet, and imported late: it takes half a second, and cv2 must come first (see `io.photos.images`)."""
    import pycolmap

    pycolmap.logging.minloglevel = 3
    return pycolmap


def _database_camera(camera: Camera, calibrated: bool, camera_id: int) -> Any:
    K = camera.K
    cx, cy = K[0, 2] + _HALF, K[1, 2] + _HALF
    fisheye = camera.lens == "fisheye"
    if not calibrated:
        model = "SIMPLE_RADIAL_FISHEYE" if fisheye else "SIMPLE_RADIAL"
        params = [K[0, 0], cx, cy, camera.coefficients["k1"]]
    elif fisheye:
        model, params = "OPENCV_FISHEYE", [K[0, 0], K[1, 1], cx, cy, *camera.coefficients.values()]
    else:
        model, params = "PINHOLE", [K[0, 0], K[1, 1], cx, cy]
    result = _pycolmap().Camera(
        model=model, width=camera.width, height=camera.height, params=params, camera_id=camera_id
    )
    result.has_prior_focal_length = True
    return result


def _ideal_keypoints(features: Features, camera: Camera, motion: RowMotion, model: str) -> NDArray[np.float32]:
    """Keypoints without shutter in the camera of the database, COLMAP's centres; where none exists, far outside."""
    ideal, valid = unproject_points(features.xy_raw, camera, motion, model)
    if camera.lens == "fisheye":
        rays = np.column_stack([np.where(valid[:, None], ideal, 0.0), np.ones(len(ideal))])
        xy = project_points(rays, camera, None, "global")[0]
    else:
        xy = ideal @ camera.K[:2, :2].T + camera.K[:2, 2]
    xy[~valid] = -1e4
    return (xy + _HALF).astype(np.float32)


def match_photos(
    database: Path,
    names: Sequence[str],
    features: Sequence[Features],
    cameras: Sequence[Camera],
    camera_idx: NDArray[np.int64],
    *,
    calibrated: bool = True,
    seed: int = 0,
) -> MatchedPhotos:
    """Match all photos with each other and verify the pairs, with room for shutter distortion.

    Parameters
    ----------
    database : Path
        File to make.
    names, features, cameras, camera_idx
        As in `MatchedPhotos`.
    calibrated : bool
        Whether the cameras are known.
    seed : int
        Seed of the verification.
    """
    pycolmap = _pycolmap()
    matched = MatchedPhotos(database, tuple(names), tuple(features), tuple(cameras), camera_idx, calibrated, seed)
    with pycolmap.Database.open(database) as db:
        _write_photos(db, matched)
        sift = pycolmap.FeatureExtractorType.SIFT
        for index, found in enumerate(features):
            db.write_descriptors(index + 1, pycolmap.FeatureDescriptors(type=sift, data=found.descriptors))
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    pycolmap.match_exhaustive(
        database, matching, verification_options=_verification(4.0 * _LOOSE, seed), device=pycolmap.Device.cpu
    )
    return matched


def _write_photos(db: Any, matched: MatchedPhotos, limit: int | None = None) -> None:
    """Cameras, photos and their first `limit` keypoints into an empty database."""
    pycolmap = _pycolmap()
    rig_ids = []
    for index, camera in enumerate(matched.cameras):
        colmap_camera = _database_camera(camera, matched.calibrated, index + 1)
        db.write_camera(colmap_camera, use_camera_id=True)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(colmap_camera.sensor_id)
        rig_ids.append(db.write_rig(rig))
    for index, (name, found) in enumerate(zip(matched.names, matched.features, strict=True)):
        camera_index = int(matched.camera_idx[index])
        image = pycolmap.Image(name=name, camera_id=camera_index + 1, image_id=index + 1)
        db.write_image(image, use_image_id=True)
        frame = pycolmap.Frame()
        frame.rig_id = rig_ids[camera_index]
        frame.add_data_id(image.data_id)
        db.write_frame(frame)
        if matched.calibrated:
            keypoints = _ideal_keypoints(found, matched.cameras[camera_index], RowMotion(), "global")
        else:
            keypoints = (found.xy_raw + _HALF).astype(np.float32)
        db.write_keypoints(index + 1, keypoints[:limit])


def _mapping_database(matched: MatchedPhotos, folder: Path, limit: int | None) -> Path:
    """A database of the strongest keypoints (all: None) and the verified matches among them."""
    pycolmap = _pycolmap()
    path = folder / "mapping.db"
    with pycolmap.Database.open(matched.database) as db, pycolmap.Database.open(path) as small:
        _write_photos(small, matched, limit)
        for i in range(1, len(matched.names) + 1):
            for j in range(i + 1, len(matched.names) + 1):
                if not db.exists_two_view_geometry(i, j):
                    continue
                pair = db.read_two_view_geometry(i, j)
                matches = np.asarray(pair.inlier_matches)
                if limit is not None and len(matches):
                    pair.inlier_matches = matches[(matches < limit).all(1)]
                small.write_two_view_geometry(i, j, pair)
    return path


def _verification(max_error_px: float, seed: int) -> Any:
    options = _pycolmap().TwoViewGeometryOptions()
    options.ransac.max_error = max_error_px
    options.ransac.random_seed = seed
    options.detect_watermark = False
    return options


def _pipeline_options(loose: float, seed: int, refine_intrinsics: bool, num_photos: int) -> Any:
    options = _pycolmap().IncrementalPipelineOptions()
    options.random_seed = seed
    # one thread: with more, the same seed now and then takes another first pair; small problems are no slower
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
    # smaller models are given up and another first pair is tried
    options.min_model_size = min(10, max(3, num_photos // 2))
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


def map_photos(matched: MatchedPhotos, progress: Callable[[int], None] | None = None) -> Reconstruction:
    """Global-shutter reconstruction by incremental mapping with loosened thresholds.

    Only photos that registered are in it. Mapping is tried with the strongest keypoints first, then with all, then
    with less loose thresholds, until all photos are in one model; the attempt with the most photos is returned. A
    camera that is only a guess is refined first, with tight thresholds: loose ones let the focal length run away.

    Parameters
    ----------
    matched : MatchedPhotos
        Photos with their matches.
    progress : callable, optional
        Called with the number of photos registered so far.

    Raises
    ------
    ReconstructionError
        When no two photos could be joined.
    """
    best = None
    if not matched.calibrated:
        best = _best_model(matched, [(None, 1.0), (None, 2.0)], progress)
        if best is not None:
            cameras = [_refined_camera(best.cameras[k + 1], camera) for k, camera in enumerate(matched.cameras)]
            matched = replace(matched, cameras=tuple(cameras), calibrated=True)
    attempts = [(_MAPPING_KEYPOINTS, _LOOSE), (None, _LOOSE), (None, 2.0), (None, 1.0)]
    found = _best_model(matched, attempts, progress)
    if found is None:
        raise ReconstructionError(
            f"none of the {len(matched.names)} photos overlap enough to be joined; "
            "use photos that share more of the scene, or check the camera's focal length"
        )
    return _from_pycolmap(found, matched, None)


def _best_model(
    matched: MatchedPhotos,
    attempts: Sequence[tuple[int | None, float]],
    progress: Callable[[int], None] | None,
) -> Any:
    """The pycolmap model with the most photos over attempts (number of keypoints, looseness), or None."""
    pycolmap = _pycolmap()
    total = len(matched.names)
    best, best_count = None, (0, 0)
    for number, (limit, loose) in enumerate(attempts):
        registered = [2]

        def on_next_image(registered: list[int] = registered) -> None:
            registered[0] += 1
            if progress is not None:
                progress(min(registered[0], total))

        work = matched.database.parent / f"mapping-{matched.calibrated}-{number}"
        work.mkdir()
        models = pycolmap.incremental_mapping(
            _mapping_database(matched, work, limit),
            work,
            work,
            _pipeline_options(loose, matched.seed, not matched.calibrated, total),
            next_image_callback=on_next_image,
        )
        for model in models.values():
            count = (model.num_reg_images(), model.num_points3D())
            if count > best_count:
                best, best_count = model, count
        if best_count[0] == total:
            break
    return best


def retriangulate(matched: MatchedPhotos, reconstruction: Reconstruction) -> Reconstruction:
    """New tracks and points for a reconstruction's poses, from keypoints freed of the shutter.

    The keypoints are corrected by the reconstruction's motion, the matches verified again and triangulated with tight
    thresholds: measurements that the shutter had cut off return, false ones that the loose thresholds had let in go.

    Returns
    -------
    Reconstruction
        The same photos, poses and motions, with new points and raw measurements.
    """
    pycolmap = _pycolmap()
    index_of = {name: i for i, name in enumerate(reconstruction.image_names)}
    cameras = reconstruction.cameras
    with pycolmap.Database.open(matched.database) as db:
        for index, camera in enumerate(cameras):
            db.update_camera(_database_camera(camera, True, index + 1))
        for index, name in enumerate(matched.names):
            camera = cameras[matched.camera_idx[index]]
            model, motion = "global", RowMotion()
            if name in index_of:
                model, motion = reconstruction.shutter_model, reconstruction.motion(index_of[name])
            db.update_keypoints(index + 1, _ideal_keypoints(matched.features[index], camera, motion, model))
        db.clear_two_view_geometries()
    pycolmap.geometric_verification(matched.database, two_view_geometry_options=_verification(_TIGHT_PX, matched.seed))
    empty = _posed_model(matched, reconstruction, cameras)
    options = _pipeline_options(1.0, matched.seed, False, len(matched.names))
    options.mapper.filter_max_reproj_error = _TIGHT_PX
    options.triangulation.merge_max_reproj_error = _TIGHT_PX
    options.triangulation.complete_max_reproj_error = _TIGHT_PX
    model = pycolmap.triangulate_points(
        empty, matched.database, matched.database.parent, matched.database.parent, options=options
    )
    return _from_pycolmap(model, matched, reconstruction)


def _posed_model(matched: MatchedPhotos, reconstruction: Reconstruction, cameras: Sequence[Camera]) -> Any:
    """A pycolmap model of the database's images with the reconstruction's poses and no points."""
    pycolmap = _pycolmap()
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


def _from_pycolmap(model: Any, matched: MatchedPhotos, posed: Reconstruction | None) -> Reconstruction:
    """Our reconstruction of a pycolmap model, with the raw pixels as measurements.

    Poses, cameras and motions are `posed`'s when it is given (triangulation leaves them alone), else the model's.
    """
    ids = sorted(i for i in model.reg_image_ids())
    names = [model.images[i].name for i in ids]
    frame_idx, point_idx, keypoint, track_points = [], [], [], []
    frame_of = {image_id: k for k, image_id in enumerate(ids)}
    for number, point_id in enumerate(sorted(model.point3D_ids())):
        point = model.points3D[point_id]
        track_points.append(point.xyz)
        seen = set()
        for element in sorted((e.image_id, e.point2D_idx) for e in point.track.elements):
            if element[0] in seen:  # COLMAP tracks can hold a photo twice
                continue
            seen.add(element[0])
            frame_idx.append(frame_of[element[0]])
            point_idx.append(number)
            keypoint.append(element[1])
    if not track_points:
        raise ReconstructionError("the photos were joined, but no scene point could be triangulated")
    frame = np.array(frame_idx)
    kp = np.array(keypoint)
    xy_raw, sigma = np.empty((len(frame), 2)), np.empty(len(frame))
    for k, image_id in enumerate(ids):
        of_photo = frame == k
        xy_raw[of_photo] = matched.features[image_id - 1].xy_raw[kp[of_photo]]
        sigma[of_photo] = matched.features[image_id - 1].sigma[kp[of_photo]]
    observations = Observations(frame, np.array(point_idx), xy_raw, sigma)
    points_w = np.array(track_points)
    if posed is not None:
        at = [posed.image_names.index(name) for name in names]
        return Reconstruction(
            posed.cameras, names, posed.camera_idx[at], posed.R_cw[at], posed.center_w[at], points_w, observations,
            posed.phi[at], posed.velocity[at], posed.shutter_model,
        )  # fmt: skip
    poses = np.array([model.images[i].cam_from_world().matrix() for i in ids])
    R_cw = poses[:, :, :3]
    center_w = -np.einsum("mji,mj->mi", R_cw, poses[:, :, 3])
    camera_idx = np.array([matched.camera_idx[i - 1] for i in ids])
    return Reconstruction(matched.cameras, names, camera_idx, R_cw, center_w, points_w, observations)


def _refined_camera(refined: Any, camera: Camera) -> Camera:
    """Our camera of a SIMPLE_RADIAL or SIMPLE_RADIAL_FISHEYE camera that mapping refined."""
    f, cx, cy, k1 = refined.params
    K = [[f, 0, cx - _HALF], [0, f, cy - _HALF], [0, 0, 1]]
    return replace(camera, K=np.array(K), dist=np.array([k1, 0, 0, 0]))
