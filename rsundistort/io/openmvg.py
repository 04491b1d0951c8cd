"""OpenMVG's `sfm_data.json`.

Pixels have integer centres there too: its undistortion samples photos at whole numbers. Measurements are of the photos
as they are, with the lens; poses are `x_c = R (X - center)`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..colmap.cameras_and_poses import checked_name
from ..colmap.measured_model import ColmapModel
from ..errors import FormatError
from ..model import Camera, Observations, Reconstruction
from .rules import Numbers, check

__all__ = ["openmvg_model"]

#: The lens by the key of its coefficients, and where these go in OpenCV's order.
_LENSES: dict[str, tuple[str, list[int], int]] = {
    "disto_k1": ("pinhole", [0], 4),
    "disto_k3": ("pinhole", [0, 1, 4], 5),
    "disto_t2": ("pinhole", [0, 1, 4, 2, 3], 5),
    "fisheye": ("fisheye", [0, 1, 2, 3], 4),
}


_POINTER = {"value": {"ptr_wrapper": {"data": {"value0?": dict}}}}
_POSE = {"rotation": Numbers(3, 3), "center": Numbers(3)}
_OBSERVATION = {"key": int, "value": {"id_feat": int, "x": Numbers(2)}}
#: What is read of the file; what pointers hold is checked where they are followed.
_RULES = {
    "views": [_POINTER],
    "intrinsics": [{"key": int, **_POINTER}],
    "extrinsics": [{"key": int, "value": _POSE}],
    "structure": [{"key": int, "value": {"X": Numbers(3), "observations": [_OBSERVATION]}}],
}
_VIEW = {"id_view": int, "id_pose": int, "id_intrinsic": int, "local_path": str, "filename": str}
_INTRINSIC = {"width": int, "height": int, "focal_length": float, "principal_point": Numbers(2)}


def openmvg_model(value: dict[str, Any], where: str) -> ColmapModel:
    """The model of a parsed `sfm_data.json`; `where` names it in errors. Ids are OpenMVG's and one."""
    check(value, _RULES)
    poses = {entry["key"]: entry["value"] for entry in value["extrinsics"]}
    listed = [_data(entry) for entry in value["views"]]
    for k, data in enumerate(listed):
        check(data, _VIEW, f"views[{k}]")
    views = {data["id_view"]: data for data in listed}
    names = {key: checked_name(_name(data), where) for key, data in views.items()}
    intrinsics = {entry["key"]: _data(entry) for entry in value["intrinsics"]}
    # OpenMVG gives an id that stands for none to views without a pose or a camera
    posed = [
        key for key in sorted(views) if views[key]["id_pose"] in poses and views[key]["id_intrinsic"] in intrinsics
    ]
    structure = [entry for entry in value["structure"] if entry["value"]["observations"]]
    if len(posed) < 2 or not structure:
        raise FormatError(f"{where} holds {len(posed)} photos with a pose and {len(structure)} points, expected more")
    camera_ids = sorted({views[key]["id_intrinsic"] for key in posed})
    place = {key: i for i, key in enumerate(posed)}
    seen = [
        (place[each["key"]], point, each["value"]["id_feat"], *each["value"]["x"])
        for point, entry in enumerate(structure)
        for each in entry["value"]["observations"]
        if each["key"] in place
    ]
    table = np.array(seen, np.float64).reshape(-1, 5)
    return ColmapModel(
        Reconstruction(
            [_camera(intrinsics[key], f"{where}: intrinsic {key}") for key in camera_ids],
            [names[key] for key in posed],
            np.array([camera_ids.index(views[key]["id_intrinsic"]) for key in posed], np.int64),
            np.array([poses[views[key]["id_pose"]]["rotation"] for key in posed], np.float64),
            np.array([poses[views[key]["id_pose"]]["center"] for key in posed], np.float64),
            np.array([entry["value"]["X"] for entry in structure], np.float64),
            Observations(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 3:]),
        ),
        np.array(camera_ids, np.int64) + 1,
        np.array(posed, np.int64) + 1,
        np.array([entry["key"] for entry in structure], np.int64) + 1,
        table[:, 2].astype(np.int64),
        np.zeros((len(structure), 3), np.uint8),
        tuple(sorted(set(names.values()) - {names[key] for key in posed})),
        self_calibrated=True,
        has_colors=False,
    )


def _data(entry: dict[str, Any]) -> dict[str, Any]:
    """What a pointer of cereal holds; a derived class holds its base apart."""
    data = dict(entry["value"]["ptr_wrapper"]["data"])
    return data | data.pop("value0", {})


def _name(view: dict[str, Any]) -> str:
    return str(view["local_path"]).strip("/") + "/" * bool(view["local_path"].strip("/")) + str(view["filename"])


def _camera(data: dict[str, Any], where: str) -> Camera:
    if "focal_length" not in data:
        raise FormatError(f"{where} has no focal length; expected a pinhole, radial, brown or fisheye camera")
    check(data, _INTRINSIC, where)
    f, (cx, cy) = data["focal_length"], data["principal_point"]
    lens, dist = "pinhole", np.zeros(0)
    for key, (kind, order, length) in _LENSES.items():
        if key in data:
            check(data[key], Numbers(len(order)), f"{where}.{key}")
            lens, dist = kind, np.zeros(length)
            dist[order] = data[key]
    return Camera(data["width"], data["height"], np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]]), dist, lens=lens)
