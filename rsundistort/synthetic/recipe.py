"""Recipes of synthetic scenes: a JSON file that names textures, surfaces, light, cameras, path and motion.

`sample_scenes/README.md` describes the format for people.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FormatError, InputError
from ..io.json_text import read_json
from ..model.array_types import Array
from ..model.camera import Camera
from ..model.checks import check_finite, check_rotations, check_whole, frozen
from ..model.motion import RowMotion
from .clip import Clip, clip_of, is_clip
from .entries import count, number, take
from .flight import Pose, motions_of, poses_and_motions, poses_of
from .lens import undistort_to_rays
from .scene import Light, Patch, Scene
from .surfaces import surface_patches
from .textures import Texture

__all__ = ["Noise", "Recipe", "View", "load_recipe"]

_FORMAT, _VERSION = "rsundistort-recipe", 1
_FOOTPRINT_PX = 5.0


@dataclass(frozen=True)
class View:
    """Where a photo is taken from, and how the camera moves meanwhile.

    Parameters
    ----------
    name : str
        File name of the photo.
    R_cw : (3, 3) array
        World to camera at the line of the principal point; of a motion with a bend the pose of the nearest steady one.
    center_w : (3,) array
        Centre of the camera then, world units.
    camera_id : str
        Which of the recipe's cameras took it.
    exposure : float
        How long a line is exposed, in units of the clock, around the moment of its pose.
    """

    name: str
    R_cw: Array
    center_w: Array
    motion: RowMotion
    camera_id: str = "1"
    exposure: float = 0.0

    def at_once(self) -> View:
        """The view of the global-shutter reference: the same pose, without motion."""
        return View(self.name, self.R_cw, self.center_w, RowMotion(), self.camera_id)

    def __post_init__(self) -> None:
        object.__setattr__(self, "R_cw", frozen(check_rotations([self.R_cw], 1, "R_cw")[0]))
        object.__setattr__(self, "center_w", frozen(check_finite(self.center_w, (3,), "center_w")))


@dataclass(frozen=True)
class Noise:
    """Noise of the sensor, in grey levels of the developed photo.

    Parameters
    ----------
    read_grey : float
        Standard deviation that is there without light.
    shot_grey : float
        Standard deviation that full white adds; its variance grows with the grey level.
    """

    read_grey: float = 0.0
    shot_grey: float = 0.0

    def __post_init__(self) -> None:
        if not (self.read_grey >= 0 and self.shot_grey >= 0):
            raise InputError(f"noise of {self.read_grey}, {self.shot_grey} grey levels; both must be 0 or more")


@dataclass(frozen=True)
class Recipe:
    """A scene, the cameras, the photos to take of it, and how to render them.

    Parameters
    ----------
    render_options : dict
        Keyword arguments of `render_view`.
    jpeg_quality : int
        Of the files, 0-100.
    noise : Noise
        Of the rolling-shutter photos; the global-shutter references have none.
    readout_ms : float or None
        Time over which a frame is read, where the recipe says it.
    clip : Clip or None
        The video whose frames the views are, where the recipe's path is that of one.
    num_points : int
        True points to give away with the photos.
    owners : tuple of str
        Which entry of the recipe each patch of the scene comes from.
    files : tuple of str
        Meshes, pictures, tables and logs that the recipe names, relative to it.
    """

    name: str
    scene: Scene
    cameras: dict[str, Camera]
    views: tuple[View, ...]
    render_options: dict[str, Any]
    jpeg_quality: int
    noise: Noise = Noise()
    readout_ms: float | None = None
    clip: Clip | None = None
    num_points: int = 1000
    owners: tuple[str, ...] = ()
    files: tuple[str, ...] = ()

    def camera(self, view: View) -> Camera:
        """The camera that took a view."""
        return self.cameras[view.camera_id]

    @property
    def references(self) -> tuple[View, ...]:
        """The views that have a global-shutter reference: all photos, and some frames of a clip."""
        return self.views if self.clip is None else self.views[:: self.clip.references_every]


def _texture(entry: Any, where: str, folder: Path) -> Texture:
    if not isinstance(entry, dict) or "kind" not in entry or "size_m" not in entry:
        raise FormatError(f"{where}: expected an object with kind and size_m")
    options = {k: v for k, v in entry.items() if k not in ("kind", "size_m", "texels_per_m")}
    if entry["kind"] == "picture" and "path" in options:
        options["path"] = str(folder / options["path"])
    return Texture(entry["kind"], tuple(entry["size_m"]), entry.get("texels_per_m", 128.0), options)


def _files(data: dict[str, Any]) -> tuple[str, ...]:
    """Files beside the recipe that it names; none may lie outside its folder, since they are copied with it."""
    named = [each["path"] for each in (*data["surfaces"], *data["textures"].values()) if "path" in each]
    motion = data.get("motion", {})
    named += [each for key in ("tables", "log") if isinstance(each := motion.get(key), str)]
    for name in named:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise FormatError(f"file {name!r}: expected a path below the recipe's own folder")
    return tuple(sorted(set(named)))


def _cameras(data: dict[str, Any]) -> dict[str, Camera]:
    if ("camera" in data) == ("cameras" in data):
        raise FormatError("recipe: expected either camera or cameras")
    entries = {"1": data["camera"]} if "camera" in data else data["cameras"]
    if not entries:
        raise FormatError("recipe: cameras is empty")
    keys = ("width", "height", "K", "dist", "readout")
    where = {id_: "camera" if "camera" in data else f"cameras.{id_}" for id_ in entries}
    cameras = {id_: Camera(**take(entry, where[id_], keys, ("lens",))) for id_, entry in entries.items()}
    for id_, camera in cameras.items():
        # the footprints of the outermost pixels reach beyond the photo
        reach = [(-_FOOTPRINT_PX, side - 1 + _FOOTPRINT_PX) for side in (camera.width, camera.height)]
        if not np.isfinite(undistort_to_rays(list(product(*reach)), camera)).all():
            raise FormatError(
                f"{where[id_]}: no rays within 90 degrees of the axis belong to the corners of a photo by this "
                f"{camera.lens} lens; give a longer focal length or a smaller photo"
            )
    return cameras


def _shutter(entry: Any, clip: Clip | None) -> tuple[float | None, float]:
    """Readout time in ms, which the path of a clip says, and the share of it for which a line is exposed."""
    known = None if clip is None else 1e3 * clip.readout_s
    if entry is None:
        return known, 0.0
    take(entry, "shutter", ("readout_ms",) if clip is None else (), ("exposure_ms",))
    readout = number(entry["readout_ms"], "shutter.readout_ms") if known is None else known
    exposure = number(entry.get("exposure_ms", 0.0), "shutter.exposure_ms")
    if readout <= 0 or exposure < 0:
        raise FormatError(f"shutter: readout_ms={readout:g}, exposure_ms={exposure:g}; expected times")
    return readout, exposure / readout


def _views(
    data: dict[str, Any], cameras: dict[str, Camera], readout_ms: float | None, exposed: float, folder: Path
) -> tuple[View, ...]:
    poses: list[Pose] = poses_of(data["path"], next(iter(cameras)))
    for k, pose in enumerate(poses):
        if pose.camera_id not in cameras:
            raise FormatError(f"path[{k}]: camera {pose.camera_id!r}, expected one of {', '.join(cameras)}")
    spans = [cameras[pose.camera_id].frame_span for pose in poses]
    names = [f"{k:04d}.jpg" for k in range(len(poses))]
    motions = motions_of(data["motion"], poses, spans, data["seed"])
    poses, motions = poses_and_motions(
        data["motion"], names, [cameras[pose.camera_id] for pose in poses], poses, motions, data["seed"], readout_ms,
        folder,
    )  # fmt: skip
    return tuple(
        View(name, pose.R_cw, pose.center_w, motion, pose.camera_id, exposed * span)
        for name, pose, motion, span in zip(names, poses, motions, spans, strict=True)
    )


def _frames(clip: Clip, cameras: dict[str, Camera], exposed: float) -> tuple[View, ...]:
    """The views of a clip."""
    if len(cameras) > 1:
        raise FormatError(f"cameras: a clip is taken by one camera, got {len(cameras)}")
    ((id_, camera),) = cameras.items()
    if camera.width % 2 or camera.height % 2:
        raise FormatError(f"camera: {camera.width}x{camera.height} pixels; a clip needs an even width and height")
    return tuple(
        View(name, *clip.frame(number, camera), id_, exposed * camera.frame_span)
        for number, name in enumerate(clip.names)
    )


def _parse(data: Any, folder: Path) -> Recipe:
    keys = ("format", "version", "name", "seed", "render", "light", "textures", "surfaces", "path")
    optional = ("camera", "cameras", "shutter", "noise", "points")
    filmed = isinstance(data, dict) and is_clip(data.get("path"))
    if filmed:  # along its path, which is its motion
        take(data, "recipe", keys, (*optional, "twins"))
    else:
        take(data, "recipe", (*keys, "motion"), optional)
    if data["format"] != _FORMAT or data["version"] != _VERSION:
        raise FormatError(f"format {data['format']!r} version {data['version']!r}, expected {_FORMAT} {_VERSION}")
    seed = data["seed"]
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise FormatError(f"seed={seed!r}, expected a whole number of 0 or more")
    files = _files(data)
    cameras = _cameras(data)
    textures = {name: _texture(entry, f"textures.{name}", folder) for name, entry in data["textures"].items()}
    patches: list[Patch] = []
    owners: list[str] = []
    for k, entry in enumerate(data["surfaces"]):
        where = f"surfaces[{k}]"
        added = surface_patches(entry, where, textures, folder, np.random.default_rng([seed, 3, k]))
        patches += added
        owners += [f"{where} ({entry['kind']})"] * len(added)
    light = Light(**take(data["light"], "light", (), tuple(f.name for f in fields(Light))))
    noises = take(data.get("noise", {}), "noise", (), ("read_grey", "shot_grey"))
    noise = Noise(**{name: number(value, f"noise: {name}") for name, value in noises.items()})
    clip = clip_of(data["path"], data.get("twins", {}), seed) if filmed else None
    readout_ms, exposed = _shutter(data.get("shutter"), clip)
    views = _views(data, cameras, readout_ms, exposed, folder) if clip is None else _frames(clip, cameras, exposed)
    options = dict(take(data["render"], "render", ("jpeg_quality",), ("samples", "spread_px", "exposure")))
    check_whole(options["jpeg_quality"], "render: jpeg_quality", 0, 100)
    count(options.get("samples", 1), "render: samples", 1024)
    for key in {"spread_px", "exposure"} & options.keys():
        number(options[key], f"render: {key}")
    if not isinstance(data["name"], str):
        raise FormatError(f"name={data['name']!r}, expected a text")
    num_points = data.get("points", 1000)
    if isinstance(num_points, bool) or not isinstance(num_points, int) or not 0 <= num_points <= 10**7:
        raise FormatError(f"points={num_points!r}, expected a whole number")
    return Recipe(
        name=data["name"],
        scene=Scene(tuple(patches), textures, light, seed),
        cameras=cameras,
        views=views,
        render_options=options,
        jpeg_quality=options.pop("jpeg_quality"),
        noise=noise,
        readout_ms=readout_ms,
        clip=clip,
        num_points=num_points,
        owners=tuple(owners),
        files=files,
    )


def load_recipe(path: str | Path) -> Recipe:
    """The recipe in a JSON file, checked; unknown keys are refused.

    Parameters
    ----------
    path : path
        File of format rsundistort-recipe. Meshes, pictures, tables and logs are looked for beside it.

    Returns
    -------
    recipe : Recipe
        Ready to render. A FormatError names the entry that is wrong.
    """
    path = Path(path)
    data = read_json(path)
    try:
        return _parse(data, path.parent)
    except InputError as error:
        raise FormatError(f"{path}: {error}") from error
    except (TypeError, KeyError, IndexError, AttributeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path}: an entry has the wrong type ({error})") from error
