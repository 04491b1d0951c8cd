"""Textures of the synthetic scenes, procedural but for pictures: seeded, band-limited, never twice the same block.

Every maker returns colours (rows, cols, 3), float32, RGB, gamma-encoded 0-1; row 0 is the bottom of the
surface. Its finest grain is several texels, so that the ray caster's mip pyramid filters it without aliasing.
"""

from __future__ import annotations

import inspect
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_type_hints

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..io.photos.images import read_plain
from ..model.checks import check_annotated, check_finite, check_number

__all__ = ["TEXTURE_KINDS", "Texture"]

_Image = NDArray[np.float32]
_Colour = Sequence[float]

# Finest grain in texels: at 1 texel a pixel it is well above the 3 px that bicubic interpolation keeps.
_GRAIN_TEXELS = 5.0
# Along one side; of all together a quarter of its square.
_MOST_TEXELS = 32766


@dataclass(frozen=True)
class _Canvas:
    """Size of a texture, its resolution and its random numbers."""

    rows: int
    cols: int
    texels_per_m: float
    rng: np.random.Generator

    def noise(self, wavelength_m: float, stretch: tuple[float, float] = (1.0, 1.0)) -> _Image:
        """Smooth noise of unit standard deviation (rows, cols); `stretch` lengthens its grain along x and y."""
        step = [max(wavelength_m * self.texels_per_m, _GRAIN_TEXELS) / 2 * s for s in stretch]
        size = [int(np.ceil(n / s)) + 3 for n, s in zip((self.cols, self.rows), step, strict=True)]
        grid = self.rng.standard_normal((size[1], size[0])).astype(np.float32)
        shift = self.rng.uniform(1.0, 2.0, 2)
        scale = np.array([[1 / step[0], 0, shift[0]], [0, 1 / step[1], shift[1]]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        field_ = cv2.warpAffine(grid, scale, (self.cols, self.rows), flags=flags, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(field_ / 0.72, np.float32)  # 0.72: what interpolation leaves of the unit standard deviation

    def fractal(self, coarse_m: float, fine_m: float, gain: float = 0.8) -> _Image:
        """Sum of octaves of noise from coarse to fine, of unit standard deviation."""
        total = np.zeros((self.rows, self.cols), np.float32)
        power, weight, wavelength = 0.0, 1.0, coarse_m
        while wavelength >= fine_m * 0.99:
            total += weight * self.noise(wavelength)
            power += weight * weight
            weight *= gain
            wavelength /= 2.0
        return np.asarray(total / np.sqrt(power), np.float32)

    def metres(self) -> tuple[_Image, _Image]:
        """Coordinates x, y (rows, cols) in metres from the lower left corner."""
        x = np.asarray((np.arange(self.cols, dtype=np.float32) + 0.5) / self.texels_per_m, np.float32)
        y = np.asarray((np.arange(self.rows, dtype=np.float32) + 0.5) / self.texels_per_m, np.float32)
        ones: _Image = np.ones((self.rows, self.cols), np.float32)
        return ones * x, ones * y[:, None]


def _smoothstep(x: _Image, low: float, high: float) -> _Image:
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t), np.float32)


def _mix(a: Any, b: Any, share: _Image) -> _Image:
    return np.asarray(a + (b - a) * share[..., None], np.float32)


def _rgb(colour: _Colour) -> NDArray[np.float32]:
    return np.asarray(np.asarray(colour, np.float32) / 255, np.float32)


def _weather(canvas: _Canvas, image: _Image, amount: float) -> _Image:
    """Dirt: broad darkening, streaks that run down, and a damp foot."""
    if amount == 0:
        return image
    _, y = canvas.metres()
    streaks = canvas.noise(0.25, (1.0, 9.0)) + 0.7 * canvas.noise(0.1, (1.0, 14.0))
    dirt = 0.5 * canvas.fractal(4.0, 0.5) + 0.6 * _smoothstep(streaks, 0.3, 2.2) - 0.2
    foot = np.exp(-np.maximum(y + 0.25 * canvas.noise(0.8), 0) / 0.45)
    shade = amount * (0.30 * np.clip(dirt, 0, 1.5) + 0.45 * foot)
    return np.asarray(image * (1 - np.clip(shade, 0, 0.8))[..., None], np.float32)


def blocks(
    canvas: _Canvas,
    *,
    colour: _Colour,
    joint_colour: _Colour,
    course_m: float,
    length_m: float,
    joint_m: float,
    variation: float = 0.12,
    relief: float = 0.12,
    grain: float = 0.08,
    weather: float = 0.4,
) -> _Image:
    """Courses of blocks: masonry, bricks, paving, roof tiles; each has its own size, tint and surface."""
    rng = canvas.rng
    x, y = canvas.metres()
    wobble = 0.35 * joint_m
    x = x + wobble * canvas.noise(0.3) + 0.6 * wobble * canvas.noise(0.08)
    y = y + wobble * canvas.noise(0.3) + 0.6 * wobble * canvas.noise(0.08)
    num_courses = int(canvas.rows / canvas.texels_per_m / course_m * 1.3) + 4
    tops = np.cumsum(course_m * rng.uniform(0.88, 1.12, num_courses)) - 1.5 * course_m
    course = np.searchsorted(tops, y.ravel())
    # one sorted list for all courses: course number times a stride plus the position along it
    width_m = canvas.cols / canvas.texels_per_m
    stride = width_m + 8 * length_m
    num_blocks = int(width_m / length_m * 1.6) + 6
    ends = np.cumsum(length_m * rng.uniform(0.65, 1.35, (num_courses + 1, num_blocks)), axis=1)
    ends -= rng.uniform(1.0, 2.0, (num_courses + 1, 1)) * length_m
    ends = np.minimum(ends, stride - 2 * length_m) + stride * np.arange(num_courses + 1)[:, None]
    flat = ends.ravel()
    position = x.ravel() + stride * course
    block = np.clip(np.searchsorted(flat, position), 1, len(flat) - 1)
    dx = np.minimum(position - flat[block - 1], flat[block] - position)
    above = tops[np.minimum(course, num_courses - 1)] - y.ravel()
    below = y.ravel() - tops[np.maximum(course, 1) - 1]
    edge = np.minimum(dx, np.minimum(above, below)).reshape(x.shape).astype(np.float32)
    above, below = (a.reshape(x.shape).astype(np.float32) for a in (above, below))

    tint = rng.normal(0, variation, (len(flat), 1)) + rng.normal(0, variation / 10, (len(flat), 3))
    face = (_rgb(colour) * (1 + tint.astype(np.float32)))[block].reshape(*x.shape, 3)
    soft = max(0.5 * joint_m, 1.5 / canvas.texels_per_m)
    # light from above: the upper edge of a block shines, the lower one is in shade
    bevel = np.exp(-np.maximum(above, 0) / (1.5 * soft)) - np.exp(-np.maximum(below, 0) / (1.5 * soft))
    pits = _smoothstep(canvas.fractal(0.12, 0.03), 1.1, 2.0)
    surface = 1 + relief * bevel + grain * canvas.fractal(0.6, 0.03, 0.8) - 2.5 * grain * pits
    joints = _rgb(joint_colour) * (1 + 0.12 * canvas.fractal(0.2, 0.04))[..., None]
    image = _mix(joints, face * surface[..., None], _smoothstep(edge, 0.5 * joint_m - 0.5 * soft, 0.5 * joint_m + soft))
    return _weather(canvas, image, weather)


def plaster(
    canvas: _Canvas,
    *,
    colour: _Colour,
    brick_colour: _Colour = (150, 92, 70),
    fallen: float = 0.12,
    grain: float = 0.05,
    weather: float = 0.6,
) -> _Image:
    """Old plaster: patchy paint, cracks, and places where it has fallen off the bricks."""
    paint = _rgb(colour) * (1 + 0.07 * canvas.fractal(3.0, 0.25))[..., None]
    patch = _smoothstep(canvas.fractal(1.6, 0.1, 0.6), 0.5, 0.7)
    paint = _mix(paint, paint * np.array([0.90, 0.89, 0.88], np.float32), patch)
    spots = _smoothstep(canvas.fractal(0.16, 0.04), 1.3, 2.1) - 0.7 * _smoothstep(canvas.fractal(0.2, 0.05), 1.4, 2.2)
    paint *= (1 + grain * canvas.fractal(0.5, 0.035, 0.8) - 3.0 * grain * spots)[..., None]
    crack = np.abs(canvas.fractal(1.8, 0.1, 0.55))
    cracked = (1 - _smoothstep(crack, 0.006, 0.03)) * _smoothstep(canvas.noise(2.5), 0.2, 0.8)
    paint = _mix(paint, 0.55 * paint, cracked)
    if fallen > 0:
        bricks = blocks(
            canvas, colour=brick_colour, joint_colour=(176, 164, 148), course_m=0.085, length_m=0.25,
            joint_m=0.015, variation=0.15, weather=0,
        )  # fmt: skip
        hole = canvas.fractal(2.4, 0.12, 0.55)
        threshold = float(np.quantile(hole[::8, ::8], 1 - fallen))
        rim = _smoothstep(hole, threshold - 0.10, threshold - 0.03)
        paint = _mix(paint, 1.06 * paint, rim)
        paint = _mix(paint, 0.55 * bricks, _smoothstep(hole, threshold - 0.02, threshold))
        paint = _mix(paint, bricks, _smoothstep(hole, threshold + 0.02, threshold + 0.12))
    return _weather(canvas, paint, weather)


def planks(
    canvas: _Canvas,
    *,
    colour: _Colour,
    plank_m: float = 0.16,
    upright: bool = True,
    variation: float = 0.12,
    grain: float = 0.12,
    weather: float = 0.3,
) -> _Image:
    """Boards with grain, knots and gaps; upright, or lying."""
    turned = canvas if upright else _Canvas(canvas.cols, canvas.rows, canvas.texels_per_m, canvas.rng)
    rng = canvas.rng
    x, _ = turned.metres()
    x = x + 0.004 * turned.noise(0.8, (1.0, 2.0))
    num = int(turned.cols / turned.texels_per_m / plank_m * 1.5) + 3
    ends = np.cumsum(plank_m * rng.uniform(0.8, 1.2, num)) - 0.5 * plank_m
    board = np.searchsorted(ends, x.ravel())
    left = np.concatenate([[-1.0], ends])[board]
    right = np.concatenate([ends, [ends[-1] + 1]])[board]
    gap = np.minimum(x.ravel() - left, right - x.ravel()).reshape(x.shape).astype(np.float32)
    tint = rng.normal(0, variation, (num + 1, 1)) + rng.normal(0, variation / 10, (num + 1, 3))
    fibre = turned.noise(0.035, (1.0, 10.0)) + 0.8 * turned.noise(0.08, (1.0, 8.0)) + 0.6 * turned.fractal(0.4, 0.04)
    knots = _smoothstep(turned.noise(0.10, (1.0, 1.6)), 1.9, 2.4)
    face = (_rgb(colour) * (1 + tint.astype(np.float32)))[board].reshape(*x.shape, 3) * (
        1 + 0.7 * grain * fibre - 0.5 * knots
    )[..., None]
    image = _mix(0.28 * _rgb(colour), face, _smoothstep(gap, 0.002, 0.012))
    if not upright:
        image = np.ascontiguousarray(image.transpose(1, 0, 2))
    return _weather(canvas, np.asarray(image, np.float32), weather)


def crate(canvas: _Canvas, *, colour: _Colour, side_m: float = 0.8, weather: float = 0.3) -> _Image:
    """Sides of wooden crates, one every side_m in both directions: boards in a frame with nails."""
    image = planks(canvas, colour=colour, plank_m=0.13, upright=False, weather=0)
    frame = 0.85 * planks(canvas, colour=colour, plank_m=0.30, upright=True, grain=0.16, weather=0)
    x, y = canvas.metres()
    to_edge = np.minimum(*(np.minimum(np.mod(a, side_m), side_m - np.mod(a, side_m)) for a in (x, y)))
    across = np.abs(np.mod(x, side_m) - np.mod(y, side_m)) / np.sqrt(2)
    rim = np.minimum(to_edge - 0.09, across - 0.05)
    image = _mix(frame, image, _smoothstep(rim, -0.004, 0.006))
    image = _mix(image, 0.6 * image, (1 - _smoothstep(np.abs(rim - 0.008), 0.0, 0.016)))  # shadow of the frame
    return _weather(canvas, image, weather)


def windows(canvas: _Canvas, *, frame_colour: _Colour, pane_m: Sequence[float], panes: Sequence[int]) -> _Image:
    """Sashes of panes (across, up) that mirror a dull sky, one every panes*pane_m; some have curtains."""
    rng = canvas.rng
    x, y = canvas.metres()
    i, j = (x / pane_m[0]).astype(int), (y / pane_m[1]).astype(int)
    glass = rng.uniform(0.24, 0.46, (j.max() + 1, i.max() + 1, 1)) * np.array([0.85, 0.98, 1.15])
    slope = rng.normal(0.10, 0.12, (j.max() + 1, i.max() + 1))
    fx, fy = x / pane_m[0] - i, y / pane_m[1] - j
    image = glass[j, i] * (1 + 0.25 * canvas.fractal(0.7, 0.1))[..., None] + (slope[j, i] * (fy - 0.3 * fx))[..., None]
    a, b = i // panes[0], j // panes[1]
    drawn = rng.uniform(-0.6, 0.45, (2, b.max() + 1, a.max() + 1))
    sx = x / (pane_m[0] * panes[0]) - a
    folds = 0.55 + 0.10 * np.sin(2 * np.pi * (sx * 9 + 0.4 * canvas.noise(0.5, (1.0, 4.0))))
    curtain = _smoothstep(np.maximum(drawn[0, b, a] - sx, drawn[1, b, a] - (1 - sx)).astype(np.float32), -0.01, 0.02)
    image = _mix(image, folds[..., None] * np.array([0.95, 0.92, 0.84]), 0.75 * curtain)
    near = np.minimum(np.minimum(fx, 1 - fx) * pane_m[0], np.minimum(fy, 1 - fy) * pane_m[1])
    sash = np.minimum(np.minimum(sx, 1 - sx) * pane_m[0] * panes[0], near + 0.03)
    sy = y / (pane_m[1] * panes[1]) - b
    sash = np.minimum(sash, np.minimum(sy, 1 - sy) * pane_m[1] * panes[1])
    wood = _rgb(frame_colour) * (1 + 0.10 * canvas.fractal(0.3, 0.04))[..., None]
    image = _mix(wood, image, _smoothstep(np.minimum(near - 0.018, sash - 0.045).astype(np.float32), 0.0, 0.010))
    return np.asarray(image, np.float32)


def foliage(canvas: _Canvas, *, colour: _Colour, leaf_m: float = 0.07) -> _Image:
    """Leaves in front of leaves: light ones over dark gaps."""
    depth = canvas.fractal(4 * leaf_m, leaf_m, 1.0)
    hue = canvas.noise(2 * leaf_m)[..., None] * np.array([0.10, 0.05, 0.0], np.float32)
    light = 0.30 + 0.75 * _smoothstep(depth, -1.2, 1.4) + 0.10 * canvas.fractal(1.2, 0.3)
    return np.asarray(_rgb(colour) * (light[..., None] + hue), np.float32)


def ground(canvas: _Canvas, *, colour: _Colour, contrast: float = 0.12) -> _Image:
    """Noise at all scales: earth, gravel, still water."""
    tone = 1 + contrast * canvas.fractal(2.0, 0.03, 0.9)
    return np.asarray(_rgb(colour) * tone[..., None] + 0.02 * canvas.noise(0.5)[..., None], np.float32)


def picture(canvas: _Canvas, *, path: str) -> _Image:
    """A picture, stretched over the texture; what is finer than a texel is averaged away."""
    found = read_plain(Path(path), "texture", cv2.IMREAD_COLOR)
    shrinks = found.shape[0] > canvas.rows or found.shape[1] > canvas.cols
    resized = cv2.resize(
        found, (canvas.cols, canvas.rows), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
    )
    return np.asarray(resized[::-1, :, ::-1] / np.float32(255), np.float32)  # row 0 is the bottom


#: Makers of textures by the name that recipes use; their keywords are the keys of a recipe's texture.
TEXTURE_KINDS: dict[str, Callable[..., _Image]] = {
    maker.__name__: maker for maker in (blocks, plaster, planks, crate, windows, foliage, ground, picture)
}


@dataclass(frozen=True)
class Texture:
    """A texture, described.

    Parameters
    ----------
    kind : str
        One of `TEXTURE_KINDS`.
    size_m : (float, float)
        Width and height in metres; on larger surfaces it repeats.
    texels_per_m : float
        Resolution. About the pixels per metre at the typical distance, or a little less.
    options : dict
        Keyword arguments of the maker; colours are sRGB 0-255, lengths metres.
    """

    kind: str
    size_m: tuple[float, float]
    texels_per_m: float = 128.0
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.kind not in TEXTURE_KINDS:
            raise InputError(f"texture kind {self.kind!r}, expected one of {', '.join(TEXTURE_KINDS)}")
        known = inspect.signature(TEXTURE_KINDS[self.kind]).parameters
        wanted = {name for name, p in known.items() if p.kind is p.KEYWORD_ONLY and p.default is p.empty}
        unknown, missing = sorted(set(self.options) - set(known)), sorted(wanted - set(self.options))
        if unknown or missing:
            raise InputError(f"texture of kind {self.kind!r}: unknown keys {unknown}, missing keys {missing}")
        hints = get_type_hints(TEXTURE_KINDS[self.kind])
        for name, value in self.options.items():
            check_annotated(value, hints[name], f"texture: {name}")
            if name.endswith("colour"):
                check_finite(value, (3,), f"texture: {name}")
        size = check_finite(self.size_m, (2,), "texture: size_m")
        density = check_number(self.texels_per_m, "texture: texels_per_m")
        if size.min() <= 0 or density <= 0:
            raise InputError(f"texture: size_m={self.size_m}, texels_per_m={self.texels_per_m}, expected positive")
        if (size * density).max() > _MOST_TEXELS or (size * density).prod() > _MOST_TEXELS**2 / 4:
            raise InputError(
                f"texture: size_m={self.size_m} at {density:g} texels per metre is larger than any picture"
            )

    def pyramid(self, seed: int, name: str) -> list[NDArray[np.uint8]]:
        """Mip levels (rows, cols, 3), RGB, gamma-encoded, each half as large as the one before.

        Its random numbers depend on the seed and the name alone: a new texture does not change the others.
        """
        cols, rows = (max(round(s * self.texels_per_m), 4) for s in self.size_m)
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        canvas = _Canvas(rows, cols, self.texels_per_m, rng)
        image = TEXTURE_KINDS[self.kind](canvas, **self.options)
        # 1 texel: edges of joints and frames lose what would alias, the grain above stays
        image = np.clip(cv2.GaussianBlur(image, (0, 0), 1.0), 0, 1)
        levels = [np.round(255 * image).astype(np.uint8)]
        while min(image.shape[:2]) >= 4:
            image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
            levels.append(np.round(255 * image).astype(np.uint8))
        return levels
