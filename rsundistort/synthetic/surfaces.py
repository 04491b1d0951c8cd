"""The surfaces that a recipe can name, as patches for the ray caster."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import FileError, FormatError, InputError
from ..model.array_types import Array, Index
from ..model.checks import check_array, check_finite
from .entries import count, kind_of, number, take
from .scene import Opening, Patch, box, wall
from .textures import Texture

__all__ = ["height_field", "mesh", "surface_patches"]


def surface_patches(
    entry: Any, where: str, textures: dict[str, Texture], folder: Path, rng: np.random.Generator
) -> list[Patch]:
    """Patches of one entry of a recipe's surfaces; files are looked for in `folder`."""
    kind = kind_of(entry, where, ("rectangle", "triangle", "box", "height-field", "mesh"))
    if kind == "box":
        return _box(entry, where, textures, rng)
    if kind == "height-field":
        return _height_field(entry, where, rng)
    if kind == "mesh":
        return _mesh(entry, where, textures, folder)
    return _flat(entry, where, kind)


def _box(entry: Any, where: str, textures: dict[str, Texture], rng: np.random.Generator) -> list[Patch]:
    take(entry, where, ("kind", "center_w", "size_m", "texture"), ("yaw_deg", "top", "tile_m"))
    size = check_finite(entry["size_m"], (3,), f"{where}: size_m")
    # each face shows another part of the texture, or another of its tiles (the sides of crates)
    offsets = np.zeros((6, 2))
    for face, (i, j) in enumerate(((0, 2), (1, 2), (0, 2), (1, 2), (0, 1), (1, 0))):
        texture = textures.get(entry["texture"] if face < 4 else entry.get("top", entry["texture"]))
        room = np.subtract(texture.size_m if texture else (0, 0), (size[i], size[j]))
        offsets[face] = rng.uniform(0, 1, 2) * np.maximum(room, 0)
    if "tile_m" in entry:
        offsets = np.round(offsets / entry["tile_m"]) * entry["tile_m"]
    return box(entry["center_w"], size, entry["texture"], entry.get("yaw_deg", 0.0), entry.get("top", ""), offsets)


def _flat(entry: Any, where: str, kind: str) -> list[Patch]:
    optional = ("offset_m", "openings") if kind == "rectangle" else ("offset_m",)
    take(entry, where, ("kind", "origin_w", "edge_a", "edge_b", "texture"), optional)
    across, along = check_finite(entry.get("offset_m", (0.0, 0.0)), (2,), f"{where}: offset_m").tolist()
    patch = Patch(
        entry["origin_w"], entry["edge_a"], entry["edge_b"], entry["texture"], (across, along), kind == "triangle"
    )
    if "openings" not in entry:
        return [patch]
    openings = []
    for k, each in enumerate(entry["openings"]):
        take(each, f"{where}.openings[{k}]", ("at_m", "size_m", "depth_m"), ("back", "reveal", "offset_m"))
        options: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in each.items()}
        openings.append(Opening(**options))
    return wall(patch, openings)


def height_field(origin_w: Array, size_m: Array, heights_m: Array, texture: str) -> list[Patch]:
    """Triangles of a ground of uneven height, its texture laid on from above.

    Parameters
    ----------
    origin_w : (3,) array
        Corner at which height 0 lies.
    size_m : (2,) array
        Extent along the world's x and y.
    heights_m : (rows, cols) array
        At the vertices of a regular grid, rows along y; at least 2 by 2.
    """
    rows, cols = heights_m.shape
    if rows < 2 or cols < 2 or min(size_m) <= 0:
        raise InputError(f"a height field of {rows} x {cols} heights and size {list(size_m)} has no area")
    y, x = np.mgrid[0:rows, 0:cols]
    dx, dy = size_m[0] / (cols - 1), size_m[1] / (rows - 1)
    at = origin_w + np.stack([x * dx, y * dy, heights_m], -1)
    patches = []
    for j in range(rows - 1):
        for i in range(cols - 1):
            a, b, c, d = at[j, i], at[j, i + 1], at[j + 1, i + 1], at[j + 1, i]
            near, far = (float(i * dx), float(j * dy)), (float((i + 1) * dx), float((j + 1) * dy))
            patches.append(Patch(a, b - a, d - a, texture, near, True, (dx, 0.0, 0.0, dy)))
            patches.append(Patch(c, d - c, b - c, texture, far, True, (-dx, 0.0, 0.0, -dy)))
    return patches


def _height_field(entry: Any, where: str, rng: np.random.Generator) -> list[Patch]:
    take(entry, where, ("kind", "origin_w", "size_m", "texture"), ("heights_m", "relief"))
    if ("heights_m" in entry) == ("relief" in entry):
        raise FormatError(f"{where}: expected either heights_m or relief")
    size = check_finite(entry["size_m"], (2,), f"{where}: size_m")
    if "heights_m" in entry:
        heights = check_finite(entry["heights_m"], (None, None), f"{where}: heights_m")
    else:
        relief = take(entry["relief"], f"{where}.relief", ("amplitude_m", "wavelength_m", "cells"))
        check_array(relief["cells"], (2,), f"{where}.relief: cells")
        cols, rows = (count(n, f"{where}.relief: cells") + 1 for n in relief["cells"])
        count(cols * rows, f"{where}.relief: cells, across times along")
        wavelength = number(relief["wavelength_m"], f"{where}.relief: wavelength_m")
        # smooth hills: noise on a grid of half a wavelength, interpolated
        if not wavelength > 1e-3 * size.max():
            raise FormatError(f"{where}.relief: wavelength_m={wavelength:g}, expected a thousandth of size_m or more")
        coarse = [max(int(np.ceil(2 * s / wavelength)), 1) + 3 for s in size]
        noise = rng.standard_normal((coarse[1], coarse[0])).astype(np.float32)
        heights = cv2.resize(noise, (cols, rows), interpolation=cv2.INTER_CUBIC).astype(np.float64)
        heights *= number(relief["amplitude_m"], f"{where}.relief: amplitude_m")
    origin = check_finite(entry["origin_w"], (3,), f"{where}: origin_w")
    return height_field(origin, size, heights, entry["texture"])


def mesh(vertices_w: Array, faces: Index, texture: str, uv_m: Array | None = None) -> list[Patch]:
    """Patches of a triangle mesh.

    Parameters
    ----------
    vertices_w : (n, 3) array
        World frame.
    faces : (k, 3) int array
        Counter-clockwise from the front. Triangles without area are left out.
    uv_m : (n, 2) array, optional
        Where on the texture each vertex lies, metres. Without it the texture is laid on along the axis that each
        triangle faces most.
    """
    patches = []
    for corner in np.asarray(faces):
        o, a, b = vertices_w[corner]
        normal = np.cross(a - o, b - o)
        if np.linalg.norm(normal) < 1e-9:
            continue
        if uv_m is None:
            plane = ((1, 2), (0, 2), (0, 1))[int(np.argmax(np.abs(normal)))]
            at = np.array([o, a, b])[:, plane]
        else:
            at = uv_m[corner]
        (ax, ay), (bx, by) = (at[1] - at[0]).tolist(), (at[2] - at[0]).tolist()
        patches.append(Patch(o, a - o, b - o, texture, (float(at[0, 0]), float(at[0, 1])), True, (ax, ay, bx, by)))
    return patches


def _mesh(entry: Any, where: str, textures: dict[str, Texture], folder: Path) -> list[Patch]:
    take(entry, where, ("kind", "path", "texture"), ("origin_w", "scale", "yaw_deg"))
    path = folder / entry["path"]
    if path.suffix.lower() not in (".ply", ".obj"):
        raise FormatError(f"{where}: {path.name} is neither .ply nor .obj")
    try:
        import trimesh
    except ImportError as error:
        raise InputError(f"{where}: meshes need trimesh; pip install 'rsundistort[mesh]'") from error
    if not path.is_file():
        raise FileError(f"{where}: {path} does not exist")
    try:
        loaded = trimesh.load_mesh(path, process=False)
        vertices, faces = np.asarray(loaded.vertices, float), np.asarray(loaded.faces, np.int64)
    except Exception as error:  # trimesh's readers raise whatever goes wrong inside
        raise FormatError(f"{where}: {path} cannot be read as a mesh: {error}") from error
    if not len(faces):
        raise FormatError(f"{where}: {path} has no triangles")
    vertices = check_finite(vertices, (None, 3), f"{where}: vertices of {path.name}")
    uv = getattr(loaded.visual, "uv", None)
    texture = textures.get(entry["texture"])
    uv_m = None
    if uv is not None and len(uv) == len(vertices) and texture is not None:
        uv_m = np.asarray(uv, float) * texture.size_m
    rotation = Rotation.from_euler("z", number(entry.get("yaw_deg", 0.0), f"{where}: yaw_deg"), degrees=True)
    scale = number(entry.get("scale", 1.0), f"{where}: scale")
    if scale <= 0:
        raise FormatError(f"{where}: scale={scale:g}, expected a positive number")
    origin = check_finite(entry.get("origin_w", (0.0, 0.0, 0.0)), (3,), f"{where}: origin_w")
    patches = mesh(rotation.apply(scale * vertices) + origin, faces, entry["texture"], uv_m)
    if not patches:
        raise FormatError(f"{where}: every triangle of {path} is without area")
    return patches
