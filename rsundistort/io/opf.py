"""Pix4D's Open Photogrammetry Format, by its own library (extra `opf`): projects written, and read as models.

Principal points and measurements count from the upper left corner, pixel centres are at 0.5. Angles are omega, phi and
kappa of camera axes x right, y up, z back; R1 R2 R3 T1 T2 are OpenCV's k1 k2 k3 p1 p2. Points and measurements are
stored as float32. `rolling_shutter` is how far the camera travelled while the frame was read, from the uppermost row to
the lowest, in the coordinates of its position, which is that of the middle: the paper that the specification refers to
models nothing else, so rotations and columns that are read one after the other have no room.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta, timezone
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote, unquote, urlparse
from uuid import NAMESPACE_URL, uuid5

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..colmap.cameras_and_poses import checked_name
from ..colmap.measured_model import ColmapModel
from ..colmap.rectified_model import rectified_keypoints
from ..errors import FormatError, InputError
from ..model import Camera, Observations, Reconstruction, Solution, SolvedImage
from ..model.array_types import Array, Index
from .export_scene import ExportScene, euler_deg, lens_left_px, rotation_left_px
from .photos.exif_facts import ExifFacts, read_exif
from .usd import FLIP

__all__ = ["opf_model", "write_opf", "write_rectified_opf"]

# glTF has y up, OPF z: what its own converter undoes.
_GLTF = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
# Errors of a lens that are not worth a word.
_REPORTED_PX = 0.01
_FULL_FRAME_UM = 36e3
# Standard deviation of an unknown height, metres.
_UNKNOWN_M = 1e4
_IDS = uuid5(NAMESPACE_URL, "urn:rsundistort:opf")


def write_opf(folder: Path, scene: ExportScene) -> str:
    """Write a project of the original photos, with the way that each camera travelled while it was read.

    Returns
    -------
    str
        What the format has no room for, and the error that this leaves.
    """
    stored = scene.stored
    images = [stored.image(image.name) for image in scene.images]
    if any(stored.cameras[image.camera_id].lens != "pinhole" for image in images):
        raise InputError("OPF has no fisheye like ours; take opf-rectified")
    if stored.shutter_model != "global" and any(stored.cameras[image.camera_id].clock_axis == 0 for image in images):
        raise InputError("OPF takes photos to be read row by row, and these are by column; take opf-rectified")
    if any(image.applied_orientation != 1 for image in scene.solution.images):
        raise InputError("points and measurements are rotated as the photos are; leave --apply-orientation out")
    left, lens = 0.0, 0.0
    for image in images:
        camera = stored.cameras[image.camera_id]
        lens = max(lens, lens_left_px(camera, _carried(camera)))
        if image.taken_out is not None and stored.shutter_model != "global":
            left = max(left, rotation_left_px(camera, image.taken_out))
    shown = [scene.originals.get(image.name, image.name) for image in images]
    _write(folder, scene, images, shown, rolling=True)
    said = []
    if left > _REPORTED_PX:
        said.append(f"rotations during the readout have no room: the worst pixel is off by {left:.2g} px")
    if lens > _REPORTED_PX:
        said.append(f"the lens has no room for all of ours: the worst pixel is off by {lens:.2g} px")
    return "; ".join(said) + ("; opf-rectified is exact" if said else "")


def write_rectified_opf(folder: Path, scene: ExportScene) -> str:
    """Write a project of the rectified photos: no lens, no shutter; a focal length for both axes."""
    images, cameras = scene.images, scene.solution.rectified_cameras
    of = {key: cameras[key] for key in {image.camera_id for image in images}}
    left = max((lens_left_px(camera, _carried(camera)) for camera in of.values()), default=0.0)
    shown = [f"../images/{scene.names[image.name]}" for image in images]
    _write(folder, scene, images, shown, rolling=False)
    return f"two focal lengths have no room: the worst pixel is off by {left:.2g} px" if left > _REPORTED_PX else ""


def _carried(camera: Camera) -> Camera:
    """The camera as the format has it."""
    lens, K = camera.coefficients, camera.K.copy()
    if K[0, 0] != K[1, 1]:
        K[0, 0] = K[1, 1] = np.sqrt(K[0, 0] * K[1, 1])
    return Camera(camera.width, camera.height, K, np.array([lens.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")]))


def _internals(camera: Camera) -> Any:
    from pyopf.cameras import PerspectiveInternals

    carried = _carried(camera)
    lens = carried.coefficients
    return PerspectiveInternals(
        carried.K[:2, 2] + 0.5, float(carried.K[0, 0]), np.array([lens[k] for k in ("k1", "k2", "k3")]),
        np.array([lens[k] for k in ("p1", "p2")]),
    )  # fmt: skip


def _write(
    folder: Path, scene: ExportScene, images: Sequence[SolvedImage], shown: Sequence[str], *, rolling: bool
) -> None:
    """The project of these photos, shown under these paths: `rolling` as they were taken, else rectified."""
    from pyopf import cameras as opf
    from pyopf.io import save
    from pyopf.project import Calibration, CoreProjectItemType, Metadata, ProjectObjects, ProjectSource
    from pyopf.uid64 import Uid64

    folder.mkdir(parents=True, exist_ok=True)
    solution, rec = scene.stored if rolling else scene.solution, scene.reconstruction
    cameras = solution.cameras if rolling else solution.rectified_cameras
    xy = rec.observations.xy_raw if rolling else rectified_keypoints(rec, scene.rectified_cameras)
    used = list(dict.fromkeys(image.camera_id for image in images))
    sensor_id = {key: Uid64(int=1 + k) for k, key in enumerate(used)}
    ids = {image.name: Uid64(int=1 + k) for k, image in enumerate(images)}
    shutter = opf.ShutterType.ROLLING if rolling else opf.ShutterType.GLOBAL
    bands = [opf.BandInformation(weight, name) for name, weight in (("Red", 0.25), ("Green", 0.5), ("Blue", 0.25))]
    sensors = [
        opf.Sensor(
            sensor_id[key], f"camera {key}", bands, np.array([cameras[key].width, cameras[key].height]),
            _internals(cameras[key]), _FULL_FRAME_UM / cameras[key].width, shutter,
        )
        for key in used
    ]  # fmt: skip
    captures, calibrated = [], []
    for k, image in enumerate(images):
        facts = ExifFacts() if scene.source is None else read_exif(scene.source / image.name)
        captures.append(_capture(Uid64(int=1 + k), sensor_id[image.camera_id], facts))
        assert image.R_cw is not None
        R_cw, center_w, way = _middle(solution, image) if rolling else (image.R_cw, image.center_w, None)
        angles = euler_deg(R_cw.T @ FLIP, "XYZ")
        calibrated.append(opf.CalibratedCamera(ids[image.name], sensor_id[image.camera_id], angles, center_w, way))
    types = CoreProjectItemType

    def metadata(kind: Any, name: str, *sources: Any) -> Any:
        # the same outputs of the same inputs: ids by name, not by chance
        return Metadata(id=uuid5(_IDS, name), type=kind, name=name, sources=list(sources))

    objects = ProjectObjects()
    objects.metadata.id = uuid5(_IDS, "project")
    objects.metadata.name, objects.metadata.description = "rsundistort", "poses found by rsundistort"
    camera_list = opf.CameraList(
        [opf.CameraData(ids[i.name], quote(uri)) for i, uri in zip(images, shown, strict=True)]
    )
    camera_list.metadata = metadata(types.CAMERA_LIST, "camera list")
    inputs = opf.InputCameras(captures, sensors)
    listed = ProjectSource(id=camera_list.metadata.id, type=types.CAMERA_LIST)
    inputs.metadata = metadata(types.INPUT_CAMERAS, "input cameras", listed)
    calibration = Calibration(
        calibrated_cameras_objs=[opf.CalibratedCameras(calibrated, [
            opf.CalibratedSensor(sensor_id[key], _internals(cameras[key])) for key in used
        ])],
        point_cloud_objs=[_points(rec, xy, ids, scene.colors())],
    )  # fmt: skip
    source = ProjectSource(id=inputs.metadata.id, type=types.INPUT_CAMERAS)
    calibration.metadata = metadata(types.CALIBRATION, "calibration", source)
    objects.camera_list_objs, objects.input_cameras_objs = [camera_list], [inputs]
    objects.calibration_objs = [calibration]
    frame = _scene_frame(solution.georeference)
    if frame is not None:
        frame.metadata = metadata(types.SCENE_REFERENCE_FRAME, "scene reference frame")
        objects.scene_reference_frame_objs = [frame]
    save(objects, folder / "project.opf", use_item_name_for_resource_uri=True, write_point_cloud_buffers=True)


def _scene_frame(georeference: Mapping[str, Any] | None) -> Any:
    """How the positions lie in a projection; None of a frame that is none, for which the format has no room."""
    from pyopf.crs import BaseToTranslatedCanonicalCrsTransform, Crs, SceneReferenceFrame

    if georeference is None or georeference["crs"] in ("local", "control"):
        return None
    matrix = np.linalg.inv(np.array(georeference["transformation"], np.float64))
    swapped = bool(matrix[0, 0] == 0)
    scale = np.abs(matrix[:3, :3]).max(0)
    return SceneReferenceFrame(
        BaseToTranslatedCanonicalCrsTransform(scale, matrix[:3, 3], swapped),
        Crs(georeference["crs"], georeference.get("geoid_height")),
    )


def _georeference(project: Any) -> dict[str, Any] | None:
    """The projection of a project, and how its coordinates lie in it; None of one without."""
    frames = project.scene_reference_frame_objs
    if not frames or not frames[0].crs.definition:
        return None
    matrix = np.linalg.inv(np.array(frames[0].base_to_canonical.transformation_matrix, np.float64))
    crs, geoid = frames[0].crs.definition, frames[0].crs.geoid_height
    found = {"crs": crs, "origin": matrix[:3, 3].tolist(), "target": crs, "transformation": matrix.tolist()}
    return found if geoid is None else {**found, "geoid_height": geoid}


def _capture(uid: Any, sensor_id: Any, facts: ExifFacts) -> Any:
    from pyopf import cameras as opf
    from pyopf.crs import Crs, Geolocation

    camera = opf.Camera(uid, sensor_id=sensor_id, model_source=opf.ModelSource.USER, image_orientation=1,
                        pixel_range=opf.StaticPixelRange(0.0, 255.0), pixel_type=opf.PixelType.UINT8)  # fmt: skip
    place, height_m = None, None
    if (fix := facts.fix) is not None and facts.place_deg is not None:
        # receivers with RTK give the height above the ellipsoid, others above the sea
        crs = Crs("EPSG:4979" if fix.sigma_from == "RTK" else "EPSG:4326+5773")
        east, north, up = fix.sigma_m if fix.altitude_m is not None else (*fix.sigma_m[:2], _UNKNOWN_M)
        # in the order of the axes: latitude first
        place = Geolocation(np.array([*facts.place_deg, fix.altitude_m or 0.0]), crs, np.array([north, east, up]))
        height_m = fix.height_m
    taken = datetime(1970, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=facts.taken_s or 0.0)
    return opf.Capture(uid, [camera], height_m, uid, opf.RigModelSource.NOT_APPLICABLE, taken, place)


def _middle(solution: Solution, image: SolvedImage) -> tuple[Array, Array, Array]:
    """The pose at the middle of the readout, and the way from the uppermost row to the lowest."""
    from .shutter_poses import end_poses

    ends = end_poses(solution, image)
    (R_first, first), (R_last, last) = ends if solution.cameras[image.camera_id].clock_sign > 0 else ends[::-1]
    rotation = Rotation.from_matrix(R_last @ R_first.T).as_rotvec()
    R_cw = Rotation.from_rotvec(rotation / 2).as_matrix() @ R_first
    return R_cw, (first + last) / 2, last - first


def _points(rec: Reconstruction, xy: Array, ids: dict[str, Any], rgb: NDArray[np.uint8]) -> Any:
    from pyopf.pointcloud.pcl import GlTFPointCloud, ImagePoints, Matches, Node, PointIndexRanges

    obs = rec.observations
    names = list(rec.image_names)
    uid_of = {name: k for k, name in enumerate(ids)}
    keep = np.array([name in uid_of for name in names])[obs.frame_idx] & np.isfinite(xy).all(1)
    order = np.flatnonzero(keep)[np.argsort(obs.point_idx[keep], kind="stable")]
    counts = np.bincount(obs.point_idx[order], minlength=rec.num_points)
    seen = np.flatnonzero(counts)
    node, matches, points = Node(), Matches(), ImagePoints()
    node.position = (rec.points_w[seen] @ _GLTF).astype(np.float32)
    node.color = np.column_stack([rgb[seen], np.full(len(seen), 255, np.uint8)])
    node.matrix = np.eye(4)
    matches.camera_uids = list(ids.values())
    matches.camera_ids = np.array([uid_of[names[k]] for k in obs.frame_idx[order].tolist()], np.uint32)
    ranges = PointIndexRanges(np.zeros((len(seen), 2), np.uint32))
    ends = np.cumsum(counts[seen])
    for k, (end, count) in enumerate(zip(ends.tolist(), counts[seen].tolist(), strict=True)):
        ranges[k] = (end - count, count)
    matches.point_index_ranges = ranges
    points.pixelCoordinates = (xy[order] + 0.5).astype(np.float32)
    points.featureIds = np.arange(len(order), dtype=np.uint32)
    points.scales = np.ones(len(order), np.float32)
    matches.image_points = points
    node.matches = matches
    cloud = GlTFPointCloud()
    cloud.nodes = [node]
    return cloud


def opf_model(path: Path) -> ColmapModel:
    """The calibrated cameras and tracks of an OPF project; `solve` finds the motions anew.

    Raises
    ------
    InputError
        Without the extra `opf`.
    FormatError
        When it holds no calibration with tracks, another camera than a perspective one, or is no OPF.
    """
    try:
        from pyopf.io import load
        from pyopf.resolve import resolve
    except ImportError as error:
        raise InputError(f'{path} needs Pix4D\'s library: pip install "rsundistort[opf]"') from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            project = resolve(load(str(path)))
        return _model(project, str(path))
    except (FormatError, OSError):
        raise
    except Exception as error:  # whatever the library trips over
        raise FormatError(
            f"{path} is no OPF project: {' '.join(str(error).split()) or type(error).__name__}"
        ) from error


def _model(project: Any, where: str) -> ColmapModel:
    calibration = project.calibration_objs[0] if project.calibration_objs else None
    if calibration is None or calibration.calibrated_cameras is None or calibration.tracks is None:
        raise FormatError(f"{where} holds no calibrated cameras with tracks; calibrate the project first")
    sizes = {s.id.int: s.image_size_px for each in project.input_cameras_objs for s in each.sensors}
    files = _files({camera.id.int: camera.uri for each in project.camera_list_objs for camera in each.cameras})
    found = calibration.calibrated_cameras
    sensors = [sensor.id.int for sensor in found.sensors]
    cameras = [_camera(s.internals, sizes[s.id.int], f"{where}: sensor {s.id.int}") for s in found.sensors]
    place = {camera.id.int: k for k, camera in enumerate(found.cameras)}
    names = [checked_name(files[camera.id.int], where) for camera in found.cameras]
    R_wc = Rotation.from_euler("XYZ", [c.orientation_deg for c in found.cameras], degrees=True).as_matrix() @ FLIP
    node = calibration.tracks.nodes[0]
    matches = node.matches
    if matches is None or matches.image_points is None:
        raise FormatError(f"{where}: its tracks hold no measurements; export them with image points")
    matrix = np.eye(4) if node.matrix is None else node.matrix
    points_w = (np.asarray(node.position, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]) @ _GLTF.T
    ranges = np.array([matches.point_index_ranges[k] for k in range(len(points_w))], np.int64).reshape(-1, 2)
    if (ranges.sum(1) > np.size(matches.camera_ids)).any() or ranges[:, 1].sum() > np.size(matches.camera_ids):
        raise FormatError(f"{where}: points claim more measurements than its tracks hold")
    point = np.repeat(np.arange(len(points_w)), ranges[:, 1])
    within = np.arange(len(point)) - np.repeat(np.cumsum(ranges[:, 1]) - ranges[:, 1], ranges[:, 1])
    at = np.repeat(ranges[:, 0], ranges[:, 1]) + within
    uids = np.array([place[uid.int] for uid in matches.camera_uids], np.int64)
    frame = uids[np.asarray(matches.camera_ids, np.int64).ravel()[at]]
    xy = np.asarray(matches.image_points.pixelCoordinates, np.float64)[at] - 0.5
    camera_idx = np.array([sensors.index(c.sensor_id.int) for c in found.cameras], np.int64)
    center_w, velocity = _travels(found.cameras, [cameras[k] for k in camera_idx])
    rec = Reconstruction(
        cameras, names, camera_idx, R_wc.transpose(0, 2, 1), center_w, points_w, Observations(frame, point, xy),
        velocity=velocity, shutter_model="constant-motion" if velocity.any() else "global",
    )  # fmt: skip
    rgb = np.zeros((len(points_w), 3), np.uint8) if node.color is None else np.asarray(node.color)[:, :3]
    if len(rgb) != len(points_w):
        raise FormatError(f"{where}: {len(points_w)} points have {len(rgb)} colours")
    unposed = [file for uid, file in files.items() if uid not in place]
    return ColmapModel(
        rec, np.arange(1, 1 + len(cameras)), np.arange(1, 1 + len(names)), np.arange(1, 1 + len(points_w)),
        np.asarray(matches.image_points.featureIds, np.int64).ravel()[at], rgb.astype(np.uint8), tuple(unposed),
        self_calibrated=True, has_colors=node.color is not None, georeference=_georeference(project),
    )  # fmt: skip


def _travels(found: Sequence[Any], cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """Centres at the principal row (m, 3), and velocities (m, 3) a unit of the clock, of rows read downwards."""
    position = np.array([c.position for c in found], np.float64).reshape(-1, 3)
    way = np.array([np.zeros(3) if c.rolling_shutter is None else c.rolling_shutter for c in found]).reshape(-1, 3)
    rows, f, cy = (np.array(values, np.float64) for values in zip(
        *((c.height - 1, c.K[1, 1], c.K[1, 2]) for c in cameras), strict=True
    ))  # fmt: skip
    velocity = way * (f / rows)[:, None]
    return position - velocity * ((rows / 2 - cy) / f)[:, None], velocity


def _files(uris: dict[int, str]) -> dict[int, str]:
    """Photos by their paths below the folder that holds them all: where that is, `--images` says."""
    paths = {uid: PurePosixPath(unquote(urlparse(uri).path)) for uid, uri in uris.items()}
    above = [path.parent.parts for path in paths.values()]
    depth = len([*takewhile(lambda parts: len({*parts}) == 1, zip(*above, strict=False))])
    return {uid: PurePosixPath(*path.parts[depth:]).as_posix() for uid, path in paths.items()}


def _camera(internals: Any, size: Index, where: str) -> Camera:
    if internals.type != "perspective":
        raise FormatError(f"{where} is {internals.type}, expected perspective")
    f, (cx, cy) = internals.focal_length_px, np.asarray(internals.principal_point_px, np.float64) - 0.5
    (k1, k2, k3), (p1, p2) = internals.radial_distortion, internals.tangential_distortion
    K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]])
    return Camera(int(size[0]), int(size[1]), K, np.array([k1, k2, p1, p2, k3]))
