"""Metashape's `cameras.xml` (File, Export, Export Cameras; and Import Cameras).

Its pixels have their centres at 0.5 and principal points count from the middle of the photo. P1 and P2 are OpenCV's p2
and p1. Poses are camera to world, x right, y down, z ahead. Of a sensor with rolling-shutter compensation a pose is
that of the middle of the frame; `rolling_shutter` of a camera holds a rotation and a translation, and nothing says
between which lines.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ..colmap.lenses import FIT_PX, nearest_camera
from ..errors import FormatError, InputError, RsUndistortWarning
from ..model import Camera, Solution
from ..model.checks import check_rotations
from .xml_text import read_xml

__all__ = ["PosedPhotos", "is_metashape", "named", "read_metashape", "write_metashape"]

_VERSION = "1.5.0"
# p3 and p4 are of PhotoScan and the first versions of Metashape
_PARAMETERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
# Geocentric and projected coordinates are millions of metres: digits of the cameras' own distances would be lost.
_FAR, _FAR_OF_SPREAD = 1e5, 100.0


@dataclass(frozen=True)
class PosedPhotos:
    """Photos with poses and cameras, and nothing measured in them.

    Attributes
    ----------
    labels : tuple of str, length m
        Names of the photos, perhaps without folder and ending.
    cameras, camera_idx : cameras, and the camera of each photo
        As they are now.
    camera_ids : tuple of int
        Metashape's, plus one.
    R_cw, center_w : (m, 3, 3), (m, 3) array
        `x_c = R_cw (X_w - center_w)`.
    unposed : tuple of str
        Photos without a pose.
    """

    labels: tuple[str, ...]
    cameras: tuple[Camera, ...]
    camera_ids: tuple[int, ...]
    camera_idx: NDArray[np.int64]
    R_cw: NDArray[np.float64]
    center_w: NDArray[np.float64]
    unposed: tuple[str, ...] = ()


def is_metashape(path: Path) -> bool:
    """Whether a path is that of an XML file: of the models that are read, Metashape's alone is."""
    return path.suffix.lower() == ".xml" and path.is_file()


def read_metashape(path: Path) -> PosedPhotos:
    """Cameras and poses of a `cameras.xml`, of its chunk with most of them, in the coordinates of its transform.

    Raises
    ------
    FileError, FormatError
        When there is none; when a lens is none that a camera of ours follows.
    """
    root = read_xml(path)
    chunks = [root] if root.tag == "chunk" else root.findall("chunk")
    if not chunks:
        raise FormatError(f"{path} holds no chunk; give what Metashape's Export Cameras wrote")
    try:
        return max((_chunk(chunk, str(path)) for chunk in chunks), key=lambda found: len(found.labels))
    except FormatError:
        raise
    except (InputError, KeyError, ValueError, AttributeError) as error:
        missing = f"{error} is missing" if isinstance(error, KeyError) else " ".join(str(error).split())
        raise FormatError(f"{path} is not whole: {missing}; export it again") from error


def _chunk(chunk: ElementTree.Element, where: str) -> PosedPhotos:
    sensors = {each.attrib["id"]: each for each in chunk.iter("sensor")}
    components = {each.attrib.get("id", ""): each.find("transform") for each in chunk.iter("component")}
    labels, of_sensor, matrices, unposed = [], [], [], []
    moved = [camera.attrib["label"] for camera in chunk.iter("camera") if camera.find("rolling_shutter") is not None]
    if moved:
        warnings.warn(
            f"{where}: rolling_shutter of {len(moved)} cameras, such as {moved[0]}, is left out, since what "
            "it means is not published; motions are solved for", RsUndistortWarning, stacklevel=5,
        )  # fmt: skip
    for camera in chunk.iter("camera"):
        label, pose = camera.attrib["label"], camera.find("transform")
        if camera.attrib.get("enabled", "true").lower() in ("false", "0") or pose is None:
            unposed.append(label)
            continue
        matrix = _numbers(pose, 16, f"{where}: transform of {label}").reshape(4, 4)
        transform = chunk.find("transform")
        if transform is None:
            transform = components.get(camera.attrib.get("component_id", ""))
        labels.append(label)
        of_sensor.append(camera.attrib["sensor_id"])
        matrices.append(_to_world(transform, where) @ matrix)
    used = sorted(set(of_sensor), key=int)
    cameras = tuple(_camera(sensors[key], f"{where}: sensor {key}") for key in used)
    poses = np.array(matrices, np.float64).reshape(-1, 4, 4)
    length = np.cbrt(np.linalg.det(poses[:, :3, :3]))
    if not (np.isfinite(poses).all() and (length > 0).all()):
        raise FormatError(f"{where}: a transform is no pose")
    R_cw = (poses[:, :3, :3] / length[:, None, None]).transpose(0, 2, 1)
    return PosedPhotos(
        tuple(labels), cameras, tuple(int(key) + 1 for key in used), np.array([used.index(k) for k in of_sensor], int),
        check_rotations(R_cw, len(labels), "the rotations"), _near(poses[:, :3, 3], where), tuple(unposed),
    )  # fmt: skip


def _near(center_w: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Centres about an origin that is not far from them."""
    if not len(center_w):
        return center_w
    middle = center_w.mean(0).round()
    if np.abs(middle).max() <= max(_FAR, _FAR_OF_SPREAD * float(np.ptp(center_w, axis=0).max())):
        return center_w
    warnings.warn(
        f"{where}: coordinates are counted from {', '.join(f'{each:.0f}' for each in middle)}, since they are so large",
        RsUndistortWarning, stacklevel=5,
    )  # fmt: skip
    return center_w - middle


def _to_world(transform: ElementTree.Element | None, where: str) -> NDArray[np.float64]:
    """The (4, 4) similarity of a chunk's coordinates; none where there is no scale."""
    matrix = np.eye(4)
    if transform is None or not len(transform):
        return matrix
    parts = {tag: transform.find(tag) for tag in ("rotation", "translation", "scale")}
    rotation, translation, scale = parts["rotation"], parts["translation"], parts["scale"]
    if rotation is not None:
        matrix[:3, :3] = _numbers(rotation, 9, f"{where}: rotation of the chunk").reshape(3, 3)
    if scale is not None:
        matrix[:3, :3] *= _numbers(scale, 1, f"{where}: scale of the chunk")
    if translation is not None:
        matrix[:3, 3] = _numbers(translation, 3, f"{where}: translation of the chunk")
    return matrix


def _numbers(element: ElementTree.Element, count: int, where: str) -> NDArray[np.float64]:
    try:
        found = np.array((element.text or "").split(), np.float64)
    except ValueError as error:
        raise FormatError(f"{where}: {error}") from error
    if len(found) != count or not np.isfinite(found).all():
        raise FormatError(f"{where}: expected {count} numbers, got {len(found)}")
    return found


def _camera(sensor: ElementTree.Element, where: str) -> Camera:
    found = sorted(sensor.findall("calibration"), key=lambda each: each.attrib.get("class") == "initial")
    if not found:
        raise FormatError(f"{where} has no calibration; align the photos first")
    calibration = found[0]
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise FormatError(f"{where} has no resolution")
    width, height = int(size.attrib["width"]), int(size.attrib["height"])
    kind = calibration.attrib.get("type", sensor.attrib.get("type", "frame"))
    if kind not in ("frame", "fisheye", "equidistant_fisheye"):
        raise FormatError(f"{where} is {kind}, expected frame or fisheye")
    p = dict.fromkeys(_PARAMETERS, 0.0)
    for name in _PARAMETERS:
        value = calibration.find(name)
        if value is not None:
            p[name] = float(_numbers(value, 1, f"{where}: {name}")[0])
    if p["f"] <= 0:
        raise FormatError(f"{where} has the focal length {p['f']:g}, expected a positive one in pixels")
    cx, cy = width / 2 - 0.5 + p["cx"], height / 2 - 0.5 + p["cy"]
    K = np.array([[p["f"] + p["b1"], 0, cx], [0, p["f"], cy], [0, 0, 1]])
    fisheye = kind != "frame"
    others = [name for name in (("b2", "p1", "p2", "p3", "p4") if fisheye else ("b2", "k4", "p3", "p4")) if p[name]]
    if not others:
        dist = [p["k1"], p["k2"], p["p2"], p["p1"], p["k3"]]
        dist = [p[k] for k in ("k1", "k2", "k3", "k4")] if fisheye else dist
        return Camera(width, height, K, np.array(dist), lens="fisheye" if fisheye else "pinhole")
    rays, xy = _rays_and_pixels(p, fisheye, width, height)
    camera, miss = nearest_camera(rays, xy, Camera(width, height, K))
    if camera is None or miss > FIT_PX:
        raise FormatError(
            f"{where} has {', '.join(others)}, which no camera of ours follows to {FIT_PX} px (to {miss:.2g} px); "
            "optimize the cameras without"
        )
    return camera


def _pixels(
    p: Mapping[str, float], fisheye: bool, width: int, height: int, rays: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pixels with integer centres of normalized coordinates (n, 2), by the camera models of Metashape's manual."""
    x, y = np.asarray(rays, np.float64).T
    if fisheye:
        radius = np.hypot(x, y)
        bend = np.divide(np.arctan(radius), radius, out=np.ones_like(radius), where=radius > 0)
        x, y = x * bend, y * bend
    r2 = x * x + y * y
    radial = 1 + r2 * (p["k1"] + r2 * (p["k2"] + r2 * (p["k3"] + r2 * p["k4"])))
    decentred = 1 + r2 * (p["p3"] + r2 * p["p4"])
    x, y = (
        x * radial + decentred * (p["p1"] * (r2 + 2 * x * x) + 2 * p["p2"] * x * y),
        y * radial + decentred * (p["p2"] * (r2 + 2 * y * y) + 2 * p["p1"] * x * y),
    )
    u = width / 2 + p["cx"] + x * p["f"] + x * p["b1"] + y * p["b2"]
    return np.column_stack([u, height / 2 + p["cy"] + y * p["f"]]) - 0.5


def _rays_and_pixels(
    p: Mapping[str, float], fisheye: bool, width: int, height: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rays that a photo shows, all over it, and where."""
    reach = np.hypot(width, height) / p["f"]
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-reach, reach, 121)] * 2))
    rays = np.column_stack([x, y])
    if fisheye:  # evenly by angle, to 80 degrees from the axis
        angle = np.clip(np.hypot(x, y), 1e-12, np.radians(80))
        rays *= (np.tan(angle) / np.maximum(np.hypot(x, y), 1e-12))[:, None]
    xy = _pixels(p, fisheye, width, height, rays)
    inside = ((xy >= -0.5) & (xy <= [width - 0.5, height - 0.5])).all(1)
    # a polynomial comes back far out: what is nearer to the axis than half of the diagonal is meant
    inside &= np.hypot(x, y) < 0.75 * reach
    return rays[inside], xy[inside]


def write_metashape(path: Path, solution: Solution, names: Mapping[str, str]) -> None:
    """Write a `cameras.xml` of the rectified photos, which Import Cameras takes into a chunk that holds them.

    Parameters
    ----------
    path : Path
        File to write.
    solution : Solution
        Poses and rectified cameras.
    names : mapping of photo name to file name
        Of the rectified photos; those without are left out. Metashape knows a photo by its name without the ending.
    """
    images = [image for image in solution.registered if image.posed and image.name in names]
    used = list(dict.fromkeys(image.camera_id for image in images))
    document = ElementTree.Element("document", version=_VERSION)
    chunk = ElementTree.SubElement(document, "chunk", label="rsundistort", enabled="true")
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(len(used)))
    for key, camera_id in enumerate(used):
        _add_sensor(sensors, key, camera_id, solution.rectified_cameras[camera_id])
    cameras = ElementTree.SubElement(chunk, "cameras", next_id=str(len(images)), next_group_id="0")
    stems = [PurePosixPath(names[image.name]).stem for image in images]
    for key, (image, stem) in enumerate(zip(images, stems, strict=True)):
        assert image.R_cw is not None
        assert image.center_w is not None
        label = stem if stems.count(stem) == 1 else names[image.name]
        camera = ElementTree.SubElement(
            cameras, "camera", id=str(key), sensor_id=str(used.index(image.camera_id)), label=label, enabled="true"
        )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = image.R_cw.T, image.center_w
        ElementTree.SubElement(camera, "transform").text = " ".join(map(repr, pose.ravel().tolist()))
        ElementTree.SubElement(camera, "orientation").text = "1"
    ElementTree.indent(document)
    path.parent.mkdir(parents=True, exist_ok=True)
    ElementTree.ElementTree(document).write(path, encoding="UTF-8", xml_declaration=True)


def _add_sensor(sensors: ElementTree.Element, key: int, label: str, camera: Camera) -> None:
    size = {"width": str(camera.width), "height": str(camera.height)}
    sensor = ElementTree.SubElement(sensors, "sensor", id=str(key), label=f"rectified camera {label}", type="frame")
    ElementTree.SubElement(sensor, "resolution", size)
    calibration = ElementTree.SubElement(sensor, "calibration", {"type": "frame", "class": "adjusted"})
    ElementTree.SubElement(calibration, "resolution", size)
    K = camera.K
    values = {
        "f": K[1, 1],
        "cx": K[0, 2] + 0.5 - camera.width / 2,
        "cy": K[1, 2] + 0.5 - camera.height / 2,
        "b1": K[0, 0] - K[1, 1],
    }
    for name, value in values.items():
        if value:
            ElementTree.SubElement(calibration, name).text = repr(float(value))


def named(posed: PosedPhotos, files: Sequence[str], where: str) -> PosedPhotos:
    """The photos by the names of their files: a label is a path, a file's name, or that without its ending."""
    by_label: dict[str, list[str]] = {}
    for file in files:
        path = PurePosixPath(file)
        for label in {file, path.name, path.stem, str(path.with_suffix(""))}:
            by_label.setdefault(label, []).append(file)
    found = []
    for label in posed.labels:
        options = by_label.get(label.replace("\\", "/"), [])
        if len(options) != 1:
            what = "no photo" if not options else f"{len(options)} photos"
            raise InputError(f"{where} holds {what} called {label!r}; give the folder that Metashape's photos are in")
        found.append(options[0])
    twice = sorted({file for file in found if found.count(file) > 1})
    if twice:
        raise InputError(f"{where}: {twice[0]} is the photo of two cameras of Metashape; give each a name of its own")
    return replace(posed, labels=tuple(found))
