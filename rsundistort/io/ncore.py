"""NVIDIA's NCore, version 4, for 3DGUT: the original photos with a pose at the start and at the end of each.

Its own library writes it (extra `ncore`). Pixel centres are at 0.5; the time of a line is its place between those that
are read first and last, where the poses are. Cameras are float32 there, poses float64.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..model import Camera
from ..model.array_types import Array
from .export_scene import ExportScene
from .photos.kinds import kind_of_name
from .shutter_poses import end_poses

__all__ = ["write_ncore"]

#: Microseconds from photo to photo, and of a readout whose time is not known.
_STEP_US, _READOUT_US = 1_000_000, 20_000
_SEQUENCE = "rsundistort"
_FORMATS = {"JPEG": "jpeg", "PNG": "png"}


def write_ncore(folder: Path, scene: ExportScene) -> str:
    """Write a sequence, a component of poses, one of intrinsics and one for each camera; the photos are in it.

    Photos follow each other by name, a second apart: only the order within a photo means anything. Nothing of a steady
    motion is left over; of one that is not steady, what two poses leave is in `quality["rs_poses_px"]`.

    Raises
    ------
    InputError
        Without photos, or of some that it cannot hold: any but JPEG and PNG.
    """
    from ncore.data.v4 import CameraSensorComponent, IntrinsicsComponent, PosesComponent, SequenceComponentGroupsWriter
    from ncore.impl.common.transformations import HalfClosedInterval
    from upath import UPath

    solution, source = scene.stored, scene.source
    images = sorted((solution.image(image.name) for image in scene.images), key=lambda image: image.name)
    others = [image.name for image in images if kind_of_name(image.name) not in _FORMATS]
    if others:
        raise InputError(f"{others[0]} is no JPEG or PNG, which alone NCore holds")
    if source is None:
        raise InputError("it holds the photos; say where they are (--images)")
    folder.mkdir(parents=True, exist_ok=True)
    known = solution.quality.get("readout_times") or {}
    readout_us = {key: max(1, round(entry["ms"] * 1e3)) for key, entry in known.items()}
    times, poses = [], []
    for k, image in enumerate(images):
        start = k * _STEP_US
        times += [start, start + readout_us.get(image.camera_id, _READOUT_US)]
        poses += [_world_from_camera(*pose) for pose in end_poses(solution, image)]
    interval = HalfClosedInterval(times[0], times[-1] + 1)
    writer = SequenceComponentGroupsWriter(UPath(folder), _SEQUENCE, _SEQUENCE, interval, {}, store_type="directory")
    table = writer.register_component_writer(PosesComponent.Writer, "default")
    table.store_dynamic_pose("rig", "world", np.array(poses), np.array(times, np.uint64))
    lenses = writer.register_component_writer(IntrinsicsComponent.Writer, "default")
    stores: dict[str, Any] = {}
    for k, image in enumerate(images):
        name = f"camera{image.camera_id}"
        if name not in stores:
            table.store_static_pose(name, "rig", np.eye(4))
            lenses.store_camera_intrinsics(name, _parameters(solution.cameras[image.camera_id]))
            stores[name] = writer.register_component_writer(CameraSensorComponent.Writer, name, group_name=name)
        kind = _FORMATS[kind_of_name(image.name)]
        span = np.array(times[2 * k : 2 * k + 2], np.uint64)
        stores[name].store_frame((source / image.name).read_bytes(), kind, span, {}, {"name": image.name})
    writer.finalize()
    return ""


def _world_from_camera(R_cw: Array, center_w: Array) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R_cw.T, center_w
    return matrix


def _parameters(camera: Camera) -> Any:
    """NCore's camera of ours."""
    from ncore.data import OpenCVFisheyeCameraModelParameters, OpenCVPinholeCameraModelParameters, ShutterType

    def numbers(*names: str) -> NDArray[np.float32]:
        return np.array([camera.coefficients.get(name, 0.0) for name in names], np.float32)

    common: dict[str, Any] = {
        "resolution": np.array([camera.width, camera.height], np.uint64),
        "shutter_type": ShutterType[f"ROLLING_{camera.readout.upper().replace('-', '_')}"],
        "principal_point": (camera.K[:2, 2] + 0.5).astype(np.float32),
        "focal_length": camera.K[[0, 1], [0, 1]].astype(np.float32),
    }
    if camera.lens == "fisheye":
        corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
        radius = np.linalg.norm((corners - common["principal_point"]) / common["focal_length"], axis=1).max()
        lens = numbers("k1", "k2", "k3", "k4")
        return OpenCVFisheyeCameraModelParameters(**common, radial_coeffs=lens, max_angle=float(min(radius, np.pi / 2)))
    return OpenCVPinholeCameraModelParameters(
        **common, radial_coeffs=numbers("k1", "k2", "k3", "k4", "k5", "k6"), tangential_coeffs=numbers("p1", "p2"),
        thin_prism_coeffs=numbers("s1", "s2", "s3", "s4"),
    )  # fmt: skip
