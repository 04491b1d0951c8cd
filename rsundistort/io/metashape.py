"""Metashape's `cameras.xml` (File, Export, Export Cameras; and Import Cameras).

Its pixels have their centres at 0.5 and principal points count from the middle of the photo. P1 and P2 are OpenCV's p2
and p1. Poses are camera to world, x right, y down, z ahead.

With rolling-shutter compensation a camera has `rolling_shutter`, a rotation and a translation (`Camera.shutter` of
Metashape's Python interface, which calls it the rolling shutter correction model). Agisoft's support says what they
are, not how they enter the projection: two parameters, "axis shift XY in the plane of the photo" (regularized), or six,
"shift along the XYZ axes and rotation along the XYZ axes" (full; forum, topic 14670). The translation is therefore one
in the axes of the camera. Whether both count from the first line to the last or from the middle to the border, and
their signs, is not published, and no reader of the file that we know of applies them. So they are kept as they are, and
no motion is made of them.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import numpy as np

from ..colmap.lenses import FIT_PX, nearest_camera
from ..errors import FormatError, InputError, RsUndistortWarning, format_errors
from ..model import Camera
from ..model.array_types import Array, Index
from ..model.checks import check_rotations
from .export_scene import ExportScene
from .xml_text import read_xml

__all__ = [
    "PosedPhotos",
    "Sensor",
    "ShutterTerms",
    "is_metashape",
    "named",
    "read_metashape",
    "write_metashape",
    "write_posed_photos",
]

_VERSION = "1.5.0"
# p3 and p4 are of PhotoScan and the first versions of Metashape
_PARAMETERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
# Geocentric and projected coordinates are millions of metres: digits of the cameras' own distances would be lost.
_FAR, _FAR_OF_SPREAD = 1e5, 100.0


@dataclass(frozen=True)
class ShutterTerms:
    """What Metashape estimated of a photo's shutter. No motion: between which lines it counts is not published.

    Attributes
    ----------
    rotation : (3, 3) array
        As in the file; the identity where it has none.
    translation : (3,) array
        In the camera's axes, in the units of the centres; zero where the file has none.
    """

    rotation: Array
    translation: Array

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation, degrees, 0 to 180."""
        return float(np.degrees(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1, 1))))


@dataclass(frozen=True)
class Sensor:
    """A sensor as the file describes it; `PosedPhotos.cameras` has what we make of it.

    Attributes
    ----------
    kind : {"frame", "fisheye", "equidistant_fisheye"}
        Type of its calibration.
    parameters : mapping of name to value
        Of the calibration, by Metashape's names: f, cx, cy, ... The principal point counts from the middle.
    shutter : mapping of name to text
        Its properties on rolling-shutter compensation: `rolling_shutter`, `rolling_shutter_flags`.
    """

    kind: str
    parameters: Mapping[str, float]
    shutter: Mapping[str, str] = field(default_factory=dict)


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
    sensors : tuple of Sensor
        Of the cameras, as the file describes them.
    shutter : mapping of int to ShutterTerms
        `rolling_shutter` by the position of the photo, of those that have it.
    """

    labels: tuple[str, ...]
    cameras: tuple[Camera, ...]
    camera_ids: tuple[int, ...]
    camera_idx: Index
    R_cw: Array
    center_w: Array
    unposed: tuple[str, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    shutter: Mapping[int, ShutterTerms] = field(default_factory=dict)


def is_metashape(path: Path) -> bool:
    """Whether a path is that of an XML file: of the models that are read, Metashape's alone is."""
    return path.suffix.lower() == ".xml" and path.is_file()


def read_metashape(path: Path | str) -> PosedPhotos:
    """Cameras and poses of a `cameras.xml`, of its chunk with most of them, in the coordinates of its transform.

    Raises
    ------
    FileError, FormatError
        When there is none; when a lens is none that a camera of ours follows.
    """
    path = Path(path)
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
    labels: list[str] = []
    of_sensor, matrices, unposed = [], [], []
    shutter: dict[int, ShutterTerms] = {}
    for camera in chunk.iter("camera"):
        label, pose = camera.attrib["label"], camera.find("transform")
        if camera.attrib.get("enabled", "true").lower() in ("false", "0") or pose is None:
            unposed.append(label)
            continue
        matrix = _numbers(pose, 16, f"{where}: transform of {label}").reshape(4, 4)
        transform = chunk.find("transform")
        if transform is None:
            transform = components.get(camera.attrib.get("component_id", ""))
        to_world, scale = _to_world(transform, where)
        terms = camera.find("rolling_shutter")
        if terms is not None:
            shutter[len(labels)] = _shutter_terms(terms, scale, f"{where}: rolling_shutter of {label}")
        labels.append(label)
        of_sensor.append(camera.attrib["sensor_id"])
        matrices.append(to_world @ matrix)
    used = sorted(set(of_sensor), key=int)
    described = [_sensor(sensors[key], f"{where}: sensor {key}") for key in used]
    cameras = tuple(_camera(*each, f"{where}: sensor {key}") for key, each in zip(used, described, strict=True))
    poses = np.array(matrices, np.float64).reshape(-1, 4, 4)
    length = np.cbrt(np.linalg.det(poses[:, :3, :3]))
    if not (np.isfinite(poses).all() and (length > 0).all()):
        raise FormatError(f"{where}: a transform is no pose")
    R_cw = (poses[:, :3, :3] / length[:, None, None]).transpose(0, 2, 1)
    return PosedPhotos(
        tuple(labels), cameras, tuple(int(key) + 1 for key in used), np.array([used.index(k) for k in of_sensor], int),
        check_rotations(R_cw, len(labels), "the rotations"), _near(poses[:, :3, 3], where), tuple(unposed),
        tuple(sensor for sensor, _, _ in described), shutter,
    )  # fmt: skip


def _shutter_terms(element: ElementTree.Element, scale: float, where: str) -> ShutterTerms:
    """The terms of a photo, its translation in the units of the transformed centres."""
    rotation, translation = element.find("rotation"), element.find("translation")
    return ShutterTerms(
        np.eye(3) if rotation is None else _numbers(rotation, 9, f"{where}: rotation").reshape(3, 3),
        np.zeros(3) if translation is None else scale * _numbers(translation, 3, f"{where}: translation"),
    )


def _near(center_w: Array, where: str) -> Array:
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


def _to_world(transform: ElementTree.Element | None, where: str) -> tuple[Array, float]:
    """The (4, 4) similarity of a chunk's coordinates, and its scale; none where there is no scale."""
    matrix, scale = np.eye(4), 1.0
    if transform is None or not len(transform):
        return matrix, scale
    rotation, translation, factor = (transform.find(tag) for tag in ("rotation", "translation", "scale"))
    if rotation is not None:
        matrix[:3, :3] = _numbers(rotation, 9, f"{where}: rotation of the chunk").reshape(3, 3)
    if factor is not None:
        scale = float(_numbers(factor, 1, f"{where}: scale of the chunk")[0])
        matrix[:3, :3] *= scale
    if translation is not None:
        matrix[:3, 3] = _numbers(translation, 3, f"{where}: translation of the chunk")
    return matrix, scale


def _numbers(element: ElementTree.Element, count: int, where: str) -> Array:
    with format_errors(where, ValueError):
        found = np.array((element.text or "").split(), np.float64)
    if len(found) != count or not np.isfinite(found).all():
        raise FormatError(f"{where}: expected {count} numbers, got {len(found)}")
    return found


def _sensor(sensor: ElementTree.Element, where: str) -> tuple[Sensor, int, int]:
    """A sensor, and width and height of its photos."""
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
    values = {name: calibration.find(name) for name in _PARAMETERS}
    p = {key: float(_numbers(each, 1, f"{where}: {key}")[0]) for key, each in values.items() if each is not None}
    if p.get("f", 0.0) <= 0:
        raise FormatError(f"{where} has the focal length {p.get('f', 0.0):g}, expected a positive one in pixels")
    properties = {each.attrib.get("name", ""): each.attrib.get("value", "") for each in sensor.findall("property")}
    shutter = {key: value for key, value in properties.items() if key.startswith("rolling_shutter")}
    return Sensor(kind, p, shutter), width, height


def _camera(sensor: Sensor, width: int, height: int, where: str) -> Camera:
    p = {name: sensor.parameters.get(name, 0.0) for name in _PARAMETERS}
    cx, cy = width / 2 - 0.5 + p["cx"], height / 2 - 0.5 + p["cy"]
    K = np.array([[p["f"] + p["b1"], 0, cx], [0, p["f"], cy], [0, 0, 1]])
    fisheye = sensor.kind != "frame"
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


def _pixels(p: Mapping[str, float], fisheye: bool, width: int, height: int, rays: Array) -> Array:
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


def _rays_and_pixels(p: Mapping[str, float], fisheye: bool, width: int, height: int) -> tuple[Array, Array]:
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


def write_metashape(folder: Path, scene: ExportScene) -> str:
    """Write `cameras.xml` of the rectified photos, which Import Cameras takes into a chunk that holds them.

    Metashape knows a photo by its name without the ending. Nothing is left over: the text is empty.
    """
    images = scene.images
    used = list(dict.fromkeys(image.camera_id for image in images))
    cameras = tuple(scene.solution.rectified_cameras[key] for key in used)
    files = [scene.names[image.name] for image in images]
    stems = [PurePosixPath(file).stem for file in files]
    labels = tuple(stem if stems.count(stem) == 1 else file for file, stem in zip(files, stems, strict=True))
    posed = PosedPhotos(
        labels, cameras, tuple(range(1, 1 + len(used))),
        np.array([used.index(image.camera_id) for image in images], np.int64),
        np.array([image.R_cw for image in images], np.float64).reshape(-1, 3, 3),
        np.array([image.center_w for image in images], np.float64).reshape(-1, 3),
        sensors=tuple(map(_rectified_sensor, cameras)),
    )  # fmt: skip
    write_posed_photos(folder / "cameras.xml", posed, [f"rectified camera {key}" for key in used])
    return ""


def write_posed_photos(path: Path | str, posed: PosedPhotos, sensor_labels: Sequence[str] = ()) -> None:
    """Write a `cameras.xml` of what `read_metashape` gives: labels, poses, sensors, `rolling_shutter`.

    Read again, all numbers are the same; those of rotations to rounding. There is no transform of the chunk any more,
    since it was applied when the file was read. Photos without a pose are left out.

    Parameters
    ----------
    posed : PosedPhotos
        With the sensors of all its cameras.
    sensor_labels : sequence of str, optional
        Names of the sensors; "camera" and a number when left out.
    """
    if len(posed.sensors) != len(posed.cameras):
        raise InputError(f"posed has {len(posed.sensors)} sensors and {len(posed.cameras)} cameras, expected one each")
    document = ElementTree.Element("document", version=_VERSION)
    chunk = ElementTree.SubElement(document, "chunk", label="rsundistort", enabled="true")
    sensors = ElementTree.SubElement(chunk, "sensors", next_id=str(max(posed.camera_ids, default=0)))
    labels = sensor_labels or [f"camera {key}" for key in posed.camera_ids]
    for key, label, sensor, camera in zip(posed.camera_ids, labels, posed.sensors, posed.cameras, strict=True):
        _add_sensor(sensors, key - 1, label, sensor, camera)
    cameras = ElementTree.SubElement(chunk, "cameras", next_id=str(len(posed.labels)), next_group_id="0")
    for key, label in enumerate(posed.labels):
        sensor_id = str(posed.camera_ids[posed.camera_idx[key]] - 1)
        photo = ElementTree.SubElement(cameras, "camera", id=str(key), sensor_id=sensor_id, label=label, enabled="true")
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = posed.R_cw[key].T, posed.center_w[key]
        ElementTree.SubElement(photo, "transform").text = _text(pose)
        terms = posed.shutter.get(key)
        if terms is not None:
            element = ElementTree.SubElement(photo, "rolling_shutter")
            ElementTree.SubElement(element, "rotation").text = _text(terms.rotation)
            ElementTree.SubElement(element, "translation").text = _text(terms.translation)
        ElementTree.SubElement(photo, "orientation").text = "1"
    ElementTree.indent(document)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    ElementTree.ElementTree(document).write(path, encoding="UTF-8", xml_declaration=True)


def _text(numbers: Array) -> str:
    return " ".join(map(repr, numbers.ravel().tolist()))


def _rectified_sensor(camera: Camera) -> Sensor:
    """The sensor of a camera without distortion."""
    K = camera.K
    values = {
        "f": K[1, 1],
        "cx": K[0, 2] + 0.5 - camera.width / 2,
        "cy": K[1, 2] + 0.5 - camera.height / 2,
        "b1": K[0, 0] - K[1, 1],
    }
    return Sensor("frame", {name: float(value) for name, value in values.items() if value})


def _add_sensor(sensors: ElementTree.Element, key: int, label: str, described: Sensor, camera: Camera) -> None:
    size = {"width": str(camera.width), "height": str(camera.height)}
    sensor = ElementTree.SubElement(sensors, "sensor", id=str(key), label=label, type=described.kind)
    ElementTree.SubElement(sensor, "resolution", size)
    for name, value in described.shutter.items():
        ElementTree.SubElement(sensor, "property", name=name, value=value)
    calibration = ElementTree.SubElement(sensor, "calibration", {"type": described.kind, "class": "adjusted"})
    ElementTree.SubElement(calibration, "resolution", size)
    for name, number in described.parameters.items():
        ElementTree.SubElement(calibration, name).text = repr(number)


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
