"""Recipes of synthetic scenes: a JSON file that names textures, surfaces, light, camera, path and motion."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FormatError, InputError
from ..model.camera import Camera
from ..model.checks import check_finite, check_rotations, frozen
from ..model.motion import RowMotion
from .scene import Light, Opening, Patch, Scene, box, wall
from .textures import Texture

__all__ = ["Recipe", "View", "load_recipe", "look_at"]

_FORMAT, _VERSION = "rsundistort-recipe", 1


@dataclass(frozen=True)
class View:
    """Where a photo is taken from, and how the camera moves meanwhile.

    Parameters
    ----------
    name : str
        File name of the photo.
    R_cw : (3, 3) array
        World to camera at the line of the principal point.
    center_w : (3,) array
        Centre of the camera then, world units.
    motion : RowMotion
        Motion during the readout.
    """

    name: str
    R_cw: NDArray[np.float64]
    center_w: NDArray[np.float64]
    motion: RowMotion

    def __post_init__(self) -> None:
        object.__setattr__(self, "R_cw", frozen(check_rotations([self.R_cw], 1, "R_cw")[0]))
        object.__setattr__(self, "center_w", frozen(check_finite(self.center_w, (3,), "center_w")))


@dataclass(frozen=True)
class Recipe:
    """A scene, the camera, the photos to take of it, and how to render them.

    Parameters
    ----------
    name : str
        Name of the recipe.
    scene : Scene
        What is there.
    camera : Camera
        What takes the photos.
    views : tuple of View
        The photos.
    render_options : dict
        Keyword arguments of `render_view`.
    jpeg_quality : int
        Of the files, 0-100.
    """

    name: str
    scene: Scene
    camera: Camera
    views: tuple[View, ...]
    render_options: dict[str, Any]
    jpeg_quality: int


def look_at(center_w: NDArray[np.float64], target_w: NDArray[np.float64], roll_deg: float = 0.0) -> NDArray[np.float64]:
    """R_cw (3, 3) of a camera at center_w that looks at target_w.

    Parameters
    ----------
    center_w, target_w : (3,) array
        World frame, z up.
    roll_deg : float
        Turn of the camera about the viewing direction, clockwise as the photographer sees it; at 0 the x axis
        is level.

    Examples
    --------
    >>> look_at(np.zeros(3), np.array([0.0, 2.0, 0.0])).round().astype(int).tolist()
    [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    """
    forward = np.asarray(target_w, float) - center_w
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:
        raise InputError("a camera that looks straight up or down needs another description than look_at")
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cos, sin = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    return np.array([cos * right + sin * down, cos * down - sin * right, forward])


def _take(entry: Any, where: str, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    """The entry, which must be an object with these keys and no others."""
    if not isinstance(entry, dict):
        raise FormatError(f"{where}: expected an object, got {entry!r}")
    unknown, missing = sorted(set(entry) - set(required) - set(optional)), sorted(set(required) - set(entry))
    if unknown or missing:
        problem = [f"unknown key {key!r}" for key in unknown] + [f"missing key {key!r}" for key in missing]
        raise FormatError(f"{where}: {', '.join(problem)}")
    return entry


def _kind(entry: Any, where: str, kinds: tuple[str, ...]) -> str:
    kind = entry.get("kind") if isinstance(entry, dict) else None
    if kind not in kinds:
        raise FormatError(f"{where}: kind {kind!r}, expected one of {', '.join(kinds)}")
    return str(kind)


def _texture(entry: Any, where: str) -> Texture:
    if not isinstance(entry, dict) or "kind" not in entry or "size_m" not in entry:
        raise FormatError(f"{where}: expected an object with kind and size_m")
    options = {k: v for k, v in entry.items() if k not in ("kind", "size_m", "texels_per_m")}
    return Texture(entry["kind"], tuple(entry["size_m"]), entry.get("texels_per_m", 128.0), options)


def _surface(entry: Any, where: str, textures: dict[str, Texture], rng: np.random.Generator) -> list[Patch]:
    kind = _kind(entry, where, ("rectangle", "triangle", "box"))
    if kind == "box":
        _take(entry, where, ("kind", "center_w", "size_m", "texture"), ("yaw_deg", "top", "tile_m"))
        size = check_finite(entry["size_m"], (3,), f"{where}: size_m")
        # each face shows another part of the texture, or another of its tiles (the sides of crates)
        offsets = np.zeros((6, 2))
        for face, (i, j) in enumerate(((0, 2), (1, 2), (0, 2), (1, 2), (0, 1), (1, 0))):
            texture = textures.get(entry["texture"] if face < 4 else entry.get("top", entry["texture"]))
            room = np.subtract(texture.size_m if texture else (0, 0), (size[i], size[j]))
            offsets[face] = rng.uniform(0, 1, 2) * np.maximum(room, 0)
        if "tile_m" in entry:
            offsets = np.round(offsets / entry["tile_m"]) * entry["tile_m"]
        return box(
            entry["center_w"],
            size,
            entry["texture"],
            entry.get("yaw_deg", 0.0),
            entry.get("top", ""),
            offsets,
        )
    optional = ("offset_m", "openings") if kind == "rectangle" else ("offset_m",)
    _take(entry, where, ("kind", "origin_w", "edge_a", "edge_b", "texture"), optional)
    offset = tuple(entry.get("offset_m", (0.0, 0.0)))
    patch = Patch(entry["origin_w"], entry["edge_a"], entry["edge_b"], entry["texture"], offset, kind == "triangle")
    if "openings" not in entry:
        return [patch]
    openings = []
    for k, each in enumerate(entry["openings"]):
        _take(each, f"{where}.openings[{k}]", ("at_m", "size_m", "depth_m"), ("back", "reveal", "offset_m"))
        options: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in each.items()}
        openings.append(Opening(**options))
    return wall(patch, openings)


def _motions(entry: Any, camera: Camera, num: int, seed: int) -> list[RowMotion]:
    _kind(entry, "motion", ("rotation",))
    _take(entry, "motion", ("kind", "sigma_rad_per_frame"), ("still",))
    rng = np.random.default_rng([seed, 1])
    motions = []
    for k in range(num):
        axis = rng.normal(size=3)
        angle = entry["sigma_rad_per_frame"] * rng.normal() / camera.frame_span
        still = k in entry.get("still", ())
        motions.append(RowMotion() if still else RowMotion(angle * axis / np.linalg.norm(axis)))
    return motions


def _parse(data: Any) -> Recipe:
    keys = (
        "format",
        "version",
        "name",
        "seed",
        "camera",
        "render",
        "light",
        "textures",
        "surfaces",
        "path",
        "motion",
    )
    _take(data, "recipe", keys)
    if data["format"] != _FORMAT or data["version"] != _VERSION:
        raise FormatError(f"format {data['format']!r} version {data['version']!r}, expected {_FORMAT} {_VERSION}")
    seed = data["seed"]
    camera = Camera(**_take(data["camera"], "camera", ("width", "height", "K", "dist", "readout")))
    textures = {name: _texture(entry, f"textures.{name}") for name, entry in data["textures"].items()}
    patches: list[Patch] = []
    for k, entry in enumerate(data["surfaces"]):
        patches += _surface(entry, f"surfaces[{k}]", textures, np.random.default_rng([seed, 3, k]))
    light = Light(**_take(data["light"], "light", (), tuple(f.name for f in fields(Light))))
    motions = _motions(data["motion"], camera, len(data["path"]), seed)
    views = []
    for k, entry in enumerate(data["path"]):
        _take(entry, f"path[{k}]", ("center_w", "look_at_w"), ("roll_deg",))
        center = check_finite(entry["center_w"], (3,), f"path[{k}]: center_w")
        R_cw = look_at(center, entry["look_at_w"], entry.get("roll_deg", 0.0))
        views.append(View(f"{k:04d}.jpg", R_cw, center, motions[k]))
    options = dict(_take(data["render"], "render", ("jpeg_quality",), ("samples", "spread_px", "exposure")))
    quality = options.pop("jpeg_quality")
    return Recipe(data["name"], Scene(tuple(patches), textures, light, seed), camera, tuple(views), options, quality)


def load_recipe(path: str | Path) -> Recipe:
    """The recipe in a JSON file, checked; unknown keys are refused.

    Parameters
    ----------
    path : path
        File of format rsundistort-recipe.

    Returns
    -------
    recipe : Recipe
        Ready to render. A FormatError names the entry that is wrong.
    """
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise FormatError(f"{path} is not JSON: {error}") from error
    try:
        return _parse(data)
    except InputError as error:
        raise FormatError(f"{path}: {error}") from error
    except (TypeError, KeyError, AttributeError) as error:
        raise FormatError(f"{path}: an entry has the wrong type ({error})") from error
