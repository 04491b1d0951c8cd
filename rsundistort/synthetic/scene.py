"""A synthetic scene: textured patches under a sun and a sky, made ready for the ray caster."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from .._kernels import raycast
from ..errors import InputError
from ..model.array_types import Array, Index
from ..model.checks import check_fields, check_finite, check_number, frozen
from .textures import Texture

__all__ = ["Light", "Opening", "Patch", "Scene", "box", "wall"]

# Spacing of the baked light on a patch (metres) and the most cells along one edge.
_LIGHT_SPACING_M = 0.35
_MAX_LIGHT_CELLS = 64
_NUM_LIGHT_RAYS = 96
_LEAF = 4  # patches in a leaf of the tree


@dataclass(frozen=True)
class Patch:
    """A textured parallelogram, or the half of it that is a triangle; its front is the side of a x b.

    Parameters
    ----------
    origin_w, edge_a_w, edge_b_w : (3,) array
        Corner, and the edges from it, in world metres.
    offset_m : (float, float)
        Where on the texture the origin lies, metres along a and b.
    triangle : bool
        Only the half next to the origin: s + t <= 1.
    axes_m : (4,) floats, optional
        How far one goes on the texture along edge a (x, y) and along edge b (x, y), metres. Default: a runs along the
        texture's x axis and b along its y axis, both at their true length.
    """

    origin_w: Array
    edge_a_w: Array
    edge_b_w: Array
    texture: str
    offset_m: tuple[float, float] = (0.0, 0.0)
    triangle: bool = False
    axes_m: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        for name in ("origin_w", "edge_a_w", "edge_b_w"):
            object.__setattr__(self, name, frozen(check_finite(getattr(self, name), (3,), name)))
        if np.linalg.norm(np.cross(self.edge_a_w, self.edge_b_w)) < 1e-9:
            raise InputError(f"patch at {self.origin_w.tolist()}: its edges are parallel or zero")


@dataclass(frozen=True)
class Opening:
    """A recess in a wall: a window, a door, a niche.

    Parameters
    ----------
    at_m, size_m : (float, float)
        Lower left corner and size on the wall, metres along its edges.
    depth_m : float
        How far the back lies behind the wall; 0: nothing behind it, a hole.
    back, reveal : str
        Textures of the back and of the four sides.
    offset_m : (float, float)
        Where on its texture the back begins.
    """

    at_m: tuple[float, float]
    size_m: tuple[float, float]
    depth_m: float
    back: str = ""
    reveal: str = ""
    offset_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        check_fields(self)


def wall(patch: Patch, openings: list[Opening]) -> list[Patch]:
    """The patches of a rectangular wall with openings, their sides and backs.

    The wall is cut along the edges of its openings; the texture runs on across the cuts.
    """
    length = [float(np.linalg.norm(e)) for e in (patch.edge_a_w, patch.edge_b_w)]
    a, b = patch.edge_a_w / length[0], patch.edge_b_w / length[1]
    inward = -np.cross(a, b)
    boxes = []
    for o in openings:
        low, high = np.array(o.at_m), np.add(o.at_m, o.size_m)
        if (low < 0).any() or (high > length).any() or (high <= low).any():
            raise InputError(f"opening at {o.at_m} of size {o.size_m} does not fit a wall of {length}")
        boxes.append((low, high))

    def part(low: ArrayLike, high: ArrayLike) -> Patch:
        (a0, b0), (a1, b1) = np.asarray(low, float), np.asarray(high, float)
        offset = (patch.offset_m[0] + a0, patch.offset_m[1] + b0)
        return Patch(patch.origin_w + a0 * a + b0 * b, (a1 - a0) * a, (b1 - b0) * b, patch.texture, offset)

    patches = []
    levels = sorted({0.0, length[1], *(float(x[1]) for box_ in boxes for x in box_)})
    for b0, b1 in pairwise(levels):
        holes = sorted((low[0], high[0]) for low, high in boxes if low[1] < b1 and high[1] > b0)
        start = 0.0
        for hole in [*holes, (length[0], length[0])]:
            if hole[0] < start:
                raise InputError(f"openings of the wall at {patch.origin_w.tolist()} overlap")
            if hole[0] > start:
                patches.append(part((start, b0), (hole[0], b1)))
            start = hole[1]

    for o, (low, high) in zip(openings, boxes, strict=True):
        if o.depth_m <= 0:
            continue
        corner = patch.origin_w + low[0] * a + low[1] * b
        wide, tall, deep = o.size_m[0] * a, o.size_m[1] * b, o.depth_m * inward
        patches.append(Patch(corner + deep, wide, tall, o.back, o.offset_m))
        # seen along a, the sides look at each other: their fronts face into the recess
        patches.append(Patch(corner, wide, deep, o.reveal, (low[0], low[1])))
        patches.append(Patch(corner + tall, deep, wide, o.reveal, (low[0], high[1])))
        patches.append(Patch(corner, deep, tall, o.reveal, (low[0], low[1])))
        patches.append(Patch(corner + wide + deep, -deep, tall, o.reveal, (high[0], low[1])))
    return patches


def box(
    center_w: ArrayLike, size_m: ArrayLike, texture: str, yaw_deg: float = 0.0, top: str = "", offset_m: Any = None
) -> list[Patch]:
    """The six sides of a box that stands at center_w (of its foot), rotated about the vertical.

    Parameters
    ----------
    center_w, size_m : (3,) array
        Centre of the foot and lengths along the rotated x, the rotated y and z; metres.
    texture, top : str
        Texture of the sides, and of top and bottom (that of the sides if empty).
    yaw_deg : float
        Rotation about z, counter-clockwise from above.
    offset_m : (6, 2) array, optional
        Where each face begins on its texture.
    """
    foot, size = check_finite(center_w, (3,), "center_w"), check_finite(size_m, (3,), "size_m")
    offsets = np.zeros((6, 2)) if offset_m is None else check_finite(offset_m, (6, 2), "offset_m")
    x, y, z = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix().T * size[:, None]
    low = foot - (x + y) / 2
    faces = [
        (low, x, z, texture),
        (low + x, y, z, texture),
        (low + x + y, -x, z, texture),
        (low + y, -y, z, texture),
        (low + z, x, y, top or texture),
        (low, y, x, top or texture),
    ]
    return [
        Patch(origin, a, b, name, (float(at[0]), float(at[1])))
        for (origin, a, b, name), at in zip(faces, offsets, strict=True)
    ]


@dataclass(frozen=True)
class Light:
    """Sun and sky.

    Parameters
    ----------
    sun_azimuth_deg, sun_elevation_deg : float
        Where the sun stands: counter-clockwise from the world's x axis, and above its x-y plane.
    sun_radius_deg : float
        Radius of its disc, which softens the edges of shadows.
    sun, sky, bounce : (3,) array
        Radiance, RGB, of a white surface in full sun, under the whole sky, and among sunlit surfaces only.
    clouds : float
        Cover, 0-1.
    """

    sun_azimuth_deg: float = 230.0
    sun_elevation_deg: float = 40.0
    sun_radius_deg: float = 0.4
    sun: Sequence[float] = (1.0, 0.93, 0.80)
    sky: Sequence[float] = (0.30, 0.36, 0.45)
    bounce: Sequence[float] = (0.50, 0.45, 0.38)
    clouds: float = 0.5

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("sun", "sky", "bounce"):
            colour = check_finite(getattr(self, name), (3,), f"light: {name}")
            object.__setattr__(self, name, tuple(colour.tolist()))  # a light is a key
        for name in ("sun_azimuth_deg", "sun_elevation_deg", "sun_radius_deg", "clouds"):
            check_number(getattr(self, name), f"light: {name}")

    def sun_directions(self, num: int) -> Array:
        """Unit vectors (num, 3), world frame, towards points spread over the sun's disc."""
        k = np.arange(num)
        # sunflower spiral, its order mixed so that neighbouring samples of a pixel look at different points
        order = (k * 7) % num if num % 7 else k
        radius = np.sqrt((order + 0.5) / num) if num > 1 else np.zeros(1)
        angle = order * np.pi * (3 - np.sqrt(5))
        spread = np.tan(np.radians(self.sun_radius_deg)) * radius
        local = np.stack([np.ones(num), spread * np.cos(angle), spread * np.sin(angle)], 1)
        rotation = Rotation.from_euler("yz", [-self.sun_elevation_deg, self.sun_azimuth_deg], degrees=True)
        return np.asarray(rotation.apply(local / np.linalg.norm(local, axis=1, keepdims=True)))


def _sky_image(light: Light, seed: int) -> NDArray[np.float32]:
    """Radiance of the sky (rows: zenith to horizon, columns: once round, 3): a gradient with soft clouds."""
    rows, cols = 384, 1536
    rng = np.random.default_rng([seed, 2])
    polar = (np.arange(rows) + 0.5)[:, None] / rows * np.pi / 2
    azimuth = ((np.arange(cols) + 0.5)[None, :] / cols - 0.5) * 2 * np.pi
    direction = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)), -1
    )
    low = (1 - direction[..., 2]) ** 2.2
    blue, pale = np.array([0.24, 0.42, 0.82]), np.array([0.78, 0.86, 0.95])
    image = blue + (pale - blue) * low[..., None]
    toward = np.clip(direction @ light.sun_directions(1)[0], 0, 1)
    image = image + 0.35 * (toward**6)[..., None] * np.array([1.0, 0.95, 0.85])
    # clouds in a plane above: perspective makes them smaller towards the horizon, where they fade
    plane = direction[..., :2] / (direction[..., 2:] + 0.18)
    plane_xy = plane.astype(np.float32)
    density: NDArray[Any] = np.zeros((rows, cols), np.float32)
    for octave in range(6):
        scale, weight = 0.8 * 1.9**octave, 0.6**octave
        for wave in rng.normal(0, scale, (10, 2)):
            bend = np.float32(0.7) * density  # warped by what is there already: billows, not ripples
            density = density + np.float32(weight / 10) * np.sin(
                plane_xy @ np.float32(2.2 * wave) + np.float32(rng.uniform(0, 2 * np.pi)) + bend
            )
    cover = np.clip((density / density.std() - 1.0 + 2.0 * light.clouds) / 1.6, 0, 1)
    cover = cover * cover * (3 - 2 * cover) * np.clip(direction[..., 2] * 7, 0, 1)
    white = np.array([1.15, 1.13, 1.10]) * (1 - 0.25 * cover[..., None])
    return np.asarray(image + (white - image) * 0.85 * cover[..., None], np.float32)


def _tree(low: Array, high: Array) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Order of the patches, and bounds (n, 6) and links (n, 3) of a tree of boxes, split at the median."""
    center = (low + high) / 2
    order: list[int] = []
    bounds: list[Array] = []
    links: list[list[int]] = []

    def grow(members: NDArray[Any]) -> None:
        node = len(bounds)
        bounds.append(np.concatenate([low[members].min(0) - 1e-6, high[members].max(0) + 1e-6]))
        links.append([len(order), len(members), 0])
        if len(members) <= _LEAF:
            order.extend(members.tolist())
            return
        axis = int(np.argmax(np.ptp(center[members], axis=0)))
        members = members[np.argsort(center[members, axis], kind="stable")]
        half = len(members) // 2
        links[node][1] = 0
        grow(members[:half])
        links[node][2] = len(bounds)
        grow(members[half:])

    grow(np.arange(len(low)))
    return np.array(order), np.array(bounds), np.array(links, np.int64)


@dataclass(frozen=True)
class Scene:
    """Patches with their textures and the light on them.

    Parameters
    ----------
    patches : tuple of Patch
        World metres, z up.
    textures : dict of str to Texture
        By the names that the patches use.
    seed : int
        Of the textures and the clouds.
    """

    patches: tuple[Patch, ...]
    textures: dict[str, Texture]
    light: Light = field(default_factory=Light)
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.patches:
            raise InputError("a scene needs at least one surface")
        missing = sorted({p.texture for p in self.patches} - set(self.textures))
        if missing:
            raise InputError(f"surfaces use textures that are not described: {', '.join(map(repr, missing))}")

    @cached_property
    def _ordered(self) -> tuple[tuple[Patch, ...], tuple[Any, ...]]:
        corners = np.array([[p.origin_w, p.edge_a_w, p.edge_b_w] for p in self.patches])
        o, a, b = corners[:, 0], corners[:, 1], corners[:, 2]
        tips = np.stack([o, o + a, o + b, o + a + b])
        order, bounds, links = _tree(tips.min(0), tips.max(0))
        patches = tuple(self.patches[k] for k in order)
        o, a, b = o[order], a[order], b[order]
        normal = np.cross(a, b)
        area2 = (normal**2).sum(1, keepdims=True)
        planes = np.empty((len(o), 12))
        # the dual vectors: s = dual_a . (x - o) is 1 at the tip of a and 0 along b
        for at, vector in (
            (0, normal / np.sqrt(area2)),
            (4, np.cross(b, normal) / area2),
            (8, np.cross(normal, a) / area2),
        ):
            planes[:, at : at + 3] = vector
            planes[:, at + 3] = (vector * o).sum(1)
        return patches, (planes, np.array([p.triangle for p in patches]), bounds, links)

    @property
    def geometry(self) -> tuple[Any, ...]:
        """Arguments of the kernels that intersect rays; see `_kernels.raycast`."""
        return self._ordered[1]

    @property
    def ordered_patches(self) -> tuple[Patch, ...]:
        """The patches in the order of the indices that `cast` returns."""
        return self._ordered[0]

    @cached_property
    def look(self) -> tuple[Any, ...]:
        """Arguments of the kernels that colour a hit: textures, baked light, sky; seconds of work, done once."""
        patches = self.ordered_patches
        names = sorted(self.textures)
        levels, first_level, texels, start = [], [0], [], 0
        with ThreadPoolExecutor() as pool:  # NumPy and OpenCV release the interpreter lock
            pyramids = pool.map(lambda name: self.textures[name].pyramid(self.seed, name), names)
        for pyramid in pyramids:
            for level in pyramid:
                levels.append((start, *level.shape[:2]))
                texels.append(level.reshape(-1, 3))
                start += len(texels[-1])
            first_level.append(len(levels))
        extent_m = np.array([[np.linalg.norm(p.edge_a_w), np.linalg.norm(p.edge_b_w)] for p in patches])

        cells = np.clip(np.ceil(extent_m / _LIGHT_SPACING_M), 1, _MAX_LIGHT_CELLS).astype(np.int64)
        vertices = (cells + 1).prod(1)
        grid = np.column_stack([np.cumsum(vertices) - vertices, cells])
        k = np.arange(_NUM_LIGHT_RAYS) + 0.5
        radius, angle = np.sqrt(k / _NUM_LIGHT_RAYS), k * np.pi * (3 - np.sqrt(5))
        around = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], 1)
        light = np.empty((int(vertices.sum()), 2))
        corners = np.array([[p.origin_w, p.edge_a_w, p.edge_b_w] for p in patches])
        raycast.bake_light(self.geometry, grid, corners, around, self.light.sun_directions(1)[0], light)
        return (
            np.array([names.index(p.texture) for p in patches]),
            np.array([p.offset_m for p in patches]),
            np.array([p.axes_m or (a, 0.0, 0.0, b) for p, (a, b) in zip(patches, extent_m, strict=True)]),
            np.concatenate(texels),
            (np.arange(256) / 255.0) ** 2.2,
            np.array(levels, np.int64),
            np.array(first_level, np.int64),
            np.array([self.textures[name].size_m for name in names], float),
            light,
            grid,
            _sky_image(self.light, self.seed),
            np.array([self.light.sun, self.light.sky, self.light.bounce], float),
        )

    def cast(self, origins_w: ArrayLike, directions_w: ArrayLike) -> tuple[Index, Array]:
        """Nearest surface along rays.

        Parameters
        ----------
        origins_w, directions_w : (n, 3) array
            World frame; the directions need no unit length.

        Returns
        -------
        patch : (n,) int64 array
            Index into `ordered_patches`, -1 where the ray meets nothing.
        distance : (n,) float64 array
            Multiple of the direction at which it is met, inf where nothing is.

        Examples
        --------
        >>> grey = Texture("ground", (1.0, 1.0), 16.0, {"colour": [128, 128, 128]})
        >>> scene = Scene(tuple(box([0, 5, -1], [2, 2, 2], "grey")), {"grey": grey})
        >>> scene.cast([[0, 0, 0], [0, 0, 0]], [[0, 1, 0], [1, 0, 0]])[1].tolist()
        [4.0, inf]
        """
        origins = np.ascontiguousarray(check_finite(origins_w, (None, 3), "origins_w"))
        directions = np.ascontiguousarray(check_finite(directions_w, (len(origins), 3), "directions_w"))
        patch, distance = np.empty(len(origins), np.int64), np.empty(len(origins))
        raycast.cast_rays(self.geometry, origins, directions, patch, distance)
        return patch, distance
