"""The content of a report as plain values: for the template, and for the scripts in the page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import quote

import numpy as np

from ..critical.degeneracy import readout_axes
from ..io import output_name
from ..model import SHUTTER_MODELS, Camera, Solution, SolvedImage
from ..model.array_types import Array, Mask
from ..model.field import field_over_frame
from ..model.orientation import MATRICES, in_stored_frame, orient_points, split_mirror
from .displacement import displacement_field
from .pictures import Picture
from .source import Source, relative_folder

__all__ = [
    "arrows_of",
    "cameras",
    "longer",
    "models",
    "motions",
    "photos",
    "residuals",
    "scene",
    "settings",
    "view_frame",
    "view_of",
]

# Size of the picture of a motion, and the number of its places along the readout.
_CURVE, _CURVE_PLACES = (240, 120), 97
# Factors by which arrows may be drawn longer than they are, and the part of a cell that a long one should fill.
_LONGER = (1, 2, 3, 4, 6, 8, 10, 15, 20, 30, 50)
_ACROSS = 14
# Arrows across and down in the picture of a residual field.
_FIELD_ARROWS = 13, 9


def photos(source: Source) -> list[dict[str, Any]]:
    """A row of each photo, in the order of the solution; angles in degrees per frame."""
    solution, stored = source.solution, source.diagnostics
    place = {} if stored is None else {name: i for i, name in enumerate(stored.names)}
    raw_as = str(solution.options.get("raw_as") or "tif")
    raw_folder = "" if source.photos is None else relative_folder(source.photos, source.out)
    rows = []
    for number, image in enumerate(solution.images):
        span = np.degrees(solution.cameras[image.camera_id].frame_span)
        i = place.get(image.name)
        phi = None if image.motion is None else image.motion.phi * span
        written = f"images/{output_name(image.name, raw_as)}"
        rows.append(
            {
                "number": number,
                "name": image.name,
                "registered": image.registered,
                "reason": image.reason or "",
                "doubtful": image.doubtful or "",
                "lens_only": image.lens_only,
                "camera": image.camera_id,
                "phi": None if phi is None else phi.tolist(),
                "sigma": None if image.sigma_phi is None else (image.sigma_phi * span).tolist(),
                "rotation": None if phi is None else float(np.linalg.norm(phi)),
                "shift": image.rs_shift_px,
                "measurements": image.num_observations,
                "rms_before": None if i is None or stored is None else float(stored.rms_px[0, i]),
                "rms_after": image.rms_px,
                "after": quote(written) if image.registered and source.after(image.name) else "",
                "before": quote(f"{raw_folder}/{image.name}") if raw_folder and source.before(image.name) else "",
            }
        )
    return rows


def pose_sigma_deg(solution: Solution) -> float | None:
    """Median over the photos of the standard deviation of their rotations, degrees; None where it is not known."""
    sigmas = [image.sigma_rotation for image in solution.registered if image.sigma_rotation is not None]
    median = float(np.median(np.linalg.norm(sigmas, axis=1))) if sigmas else np.nan
    return float(np.degrees(median)) if np.isfinite(median) else None


def motions(solution: Solution) -> list[dict[str, Any]]:
    """Rotation over the readout of photos that did not rotate steadily: SVG paths for the three axes.

    From the first line on the left to the last on the right, with the nearest steady motions.
    """
    width, height = _CURVE
    found = []
    for image in solution.images:
        if image.motion is None or image.motion.bend is None:
            continue
        camera = solution.cameras[image.camera_id]
        clock = np.linspace(*camera.clock_range, _CURVE_PLACES)
        rotation = np.degrees(image.motion.at(clock)[0])
        steady = np.degrees(clock[[0, -1], None] * image.motion.phi)
        low, high = min(rotation.min(), steady.min()), max(rotation.max(), steady.max())
        room = max(float(high - low), 1e-9)

        def paths(values: Array, high: float = high, room: float = room) -> list[str]:
            x, y = np.linspace(0, width, len(values)), 4 + (height - 8) * (high - values) / room
            return ["M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, each, strict=True)) for each in y.T]

        found.append(
            {
                "name": image.name,
                "curves": paths(rotation),
                "steady": paths(steady),
                "low": float(low),
                "high": float(high),
                "zero": round(4 + (height - 8) * float(high) / room, 1) if low < 0 < high else None,
                "most": float(np.linalg.norm(rotation - np.degrees(clock[:, None] * image.motion.phi), axis=1).max()),
                "lines": ("columns", "rows")[camera.clock_axis],
            }
        )
    return found


def view_of(source: Source, pictures: Mapping[str, Picture]) -> list[dict[str, Any]]:
    """The registered photos with their pictures as data addresses and their arrows, thousandths of the width."""
    solution, stored = source.solution, source.diagnostics
    depths = {} if stored is None else dict(zip(stored.names, stored.depth.tolist(), strict=True))
    found = []
    for number, image in enumerate(solution.images):
        picture = pictures.get(image.name)
        if not image.registered or picture is None:
            continue
        raw, still, (width, height) = arrows_of(solution, image, depths.get(image.name), picture.orientation)
        ends = np.concatenate([raw, still], axis=1) * 1000 / width
        found.append(
            {
                "number": number,
                "name": image.name,
                "size": [width, height],
                "shift": image.rs_shift_px,
                "before": _address(picture.before),
                "after": _address(picture.after),
                "arrows": np.round(ends, 1).tolist(),
                "longest": float(np.linalg.norm(still - raw, axis=1).max(initial=0.0)) / width,
            }
        )
    return found


def longer(largest: Sequence[float]) -> int:
    """The factor by which all arrows are drawn longer, by the longest of each photo in photo widths."""
    long = float(np.quantile(largest, 0.9)) if len(largest) else 0.0
    return max((factor for factor in _LONGER if factor * long <= 1.2 / _ACROSS), default=1) if long > 0 else 1


def arrows_of(
    solution: Solution, image: SolvedImage, depth: float | None, orientation: int
) -> tuple[Array, Array, tuple[int, int]]:
    """A photo's displacement field in the pixels of its upright picture, whose size comes with it."""
    # to the stored frame, then upright: `orientation` goes all the way
    stored = in_stored_frame(Solution(
        solution.shutter_model, {image.camera_id: solution.cameras[image.camera_id]},
        {image.camera_id: solution.rectified_cameras[image.camera_id]}, (image,),
    ))  # fmt: skip
    camera = stored.cameras[stored.images[0].camera_id]
    ends = displacement_field(stored, stored.images[0], depth, _ACROSS)
    raw, still = (orient_points(each, camera.width, camera.height, orientation) for each in ends)
    swaps = MATRICES[orientation][0, 0] == 0
    return raw, still, (camera.height, camera.width) if swaps else (camera.width, camera.height)


def scene(source: Source, upright: Mapping[str, int]) -> dict[str, Any] | None:
    """Cameras and points, the z axis up by the photos' orientations; None without poses."""
    stored = source.diagnostics
    solution = in_stored_frame(source.solution)
    images = [image for image in solution.registered if image.posed]
    if not images:
        return None
    R = np.array([image.R_cw for image in images])
    centers = np.array([image.center_w for image in images])
    lenses = [solution.cameras[image.camera_id] for image in images]
    rotation = np.tile(np.eye(3), (len(images), 1, 1))
    rotation[:, :2, :2] = [MATRICES[split_mirror(upright.get(image.name, 1))[0]] for image in images]
    # on the map z is up, whatever the cameras look at
    V = view_frame(rotation @ R) if solution.georeference is None else np.eye(3)
    points = np.zeros((0, 3)) if stored is None else stored.points_w
    reach = _size(centers, points)
    near = _is_near(points, centers, reach)
    side = min(0.5 * _spacing(centers), 0.12 * reach) or 0.12 * reach
    value: dict[str, Any] = {
        "names": [image.name for image in images],
        "centers": _packed(centers @ V.T),
        "frusta": _packed(_frusta(R, centers, lenses, side) @ V.T),
        "axes": _packed(readout_axes(R, [lens.readout for lens in lenses]) @ V.T),
        "box": _box(points[near] @ V.T, centers @ V.T),
    }
    if stored is not None:
        place = {name: i for i, name in enumerate(stored.names)}
        rows = [place[image.name] for image in images]
        value["shown"] = int(near.sum())
        value["points"] = _packed(points[near] @ V.T)
        rgb = stored.rgb[near] if len(stored.rgb) else stored.rgb
        value["colors"] = [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in rgb.tolist()]
        others = stored.global_points_w
        value["global"] = {
            "points": _packed(others[_is_near(others, centers, reach)] @ V.T),
            "centers": _packed(stored.global_center_w[rows] @ V.T),
            "frusta": _packed(_frusta(stored.global_R_cw[rows], stored.global_center_w[rows], lenses, side) @ V.T),
        }
    return value


def residuals(source: Source) -> dict[str, Any] | None:
    """The statistics of residuals, for the plots."""
    stored = source.diagnostics
    if stored is None:
        return None
    cameras = source.solution.cameras
    return {
        "names": list(stored.names),
        "edges": _numbers(stored.histogram_px),
        "histogram": stored.histogram.tolist(),
        "rows": _numbers(stored.row_rms_px),
        "photo_rows": _numbers(stored.row_mean_px),
        "cells": _numbers(stored.cell_mean_px),
        "cameras": list(stored.camera_ids),
        "sizes": [
            [cameras[key].width, cameras[key].height] if key in cameras else [4, 3] for key in stored.camera_ids
        ],
    }  # fmt: skip


def models(solution: Solution) -> list[dict[str, Any]]:
    """A row of each shutter model that was tried: residuals of its first fit, errors of held-out measurements."""
    quality = solution.quality
    held_out, errors = quality.get("held_out_rms_px") or {}, quality.get("held_out_error") or {}
    gains, kept = quality.get("held_out_gain") or {}, quality.get("held_out_kept") or ()
    bars = errors or held_out  # solutions of earlier versions have no errors
    fits = {
        str(fit.get("model")): fit
        for stage in solution.stages
        if stage.get("name") in ("model sequence", "ladder")  # the latter of version 0.1
        for fit in stage.get("models") or stage.get("rungs") or ()
    }
    names = [*bars, *(name for name in SHUTTER_MODELS if name in fits and name not in bars)]
    largest = max((float(value) for value in bars.values() if value is not None), default=0.0)
    return [
        {
            "name": name,
            "rms": fits.get(name, {}).get("rms_px"),
            "held_out": held_out.get(name),
            "error": errors.get(name),
            "gain": gains.get(name),
            "kept": name in kept,
            "share": 100 * float(bars.get(name) or 0) / largest if largest else 0,
            "chosen": name == (quality.get("held_out_chosen") or solution.shutter_model),
        }
        for name in names
    ]


def cameras(solution: Solution) -> list[dict[str, Any]]:
    """A row of each camera, with the standard deviations of its estimated intrinsics."""
    sigmas = solution.quality.get("sigma_intrinsics") or {}
    times = solution.quality.get("readout_times") or {}
    rows = []
    for keys, camera in solution.shared_cameras.items():
        K = camera.K
        sigma = sigmas.get(keys[0]) or {}
        lens = {name: value for name, value in camera.coefficients.items() if value or name in sigma}
        of_focal = {"f": K[0, 0]} if "f" in sigma and K[0, 0] == K[1, 1] else {"fx": K[0, 0], "fy": K[1, 1]}
        values = of_focal | {"cx": K[0, 2], "cy": K[1, 2]}
        rows.append(
            {
                "id": keys[0] if len(keys) == 1 else f"{keys[0]} to {keys[-1]}",
                "size": f"{camera.width} x {camera.height}",
                "intrinsics": [
                    _value(name, value, sigma.get(name, sigma.get("f") if name[0] == "f" else None), 1)
                    for name, value in values.items()
                ],
                "lens": [_value(name, value, sigma.get(name), 4) for name, value in lens.items()],
                "model": camera.lens,
                "readout": camera.readout,
                "time": times.get(keys[0]),
                "photos": sum(image.camera_id in keys for image in solution.images),
                "field": _field(camera, (solution.quality.get("lens_fields") or {}).get(keys[0]) or {}),
            }
        )
    return rows


def _field(camera: Camera, facts: Mapping[str, float]) -> dict[str, Any] | None:
    """A picture of a camera's residual field, in thousandths of its width, and its size; None if it has none."""
    if not camera.field.size:
        return None
    xy, field = (each.reshape(-1, 2) for each in field_over_frame(camera, *_FIELD_ARROWS))
    lengths = np.linalg.norm(field, axis=1)
    unit = 1000 / camera.width
    times = max(1, round(0.9 * camera.width / _FIELD_ARROWS[0] / max(float(lengths.max()), 1e-6)))
    shafts = zip((unit * xy).round(1).tolist(), (unit * times * field).round(1).tolist(), strict=True)
    return {
        "height": round(unit * camera.height),
        "path": "".join(f"M{x:g} {y:g}l{dx:g} {dy:g}" for (x, y), (dx, dy) in shafts),
        "dots": (unit * xy).round(1).tolist(),
        "times": times,
        **{key: facts.get(f"{key}_px") for key in ("rms", "largest", "sigma")},
    }


def settings(solution: Solution) -> list[tuple[str, str]]:
    """Options by name; empty where none was given."""
    return [(name.replace("_", " "), _setting(value)) for name, value in solution.options.items()]


def _setting(value: Any) -> str:
    """An option's value, without what is empty in it."""
    if isinstance(value, Mapping):
        parts = ((name.replace("_", " "), _setting(each)) for name, each in value.items())
        return ", ".join(f"{name}: {text}" for name, text in parts if text)
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_setting, value))
    if isinstance(value, float):
        return f"{value:.6g}"
    return "" if value is None else str(value)


def _value(name: str, value: float, sigma: float | None, digits: int) -> str:
    text = f"{name} {value:.{digits}f}"
    return text if sigma is None else f"{text} ± {sigma:.{digits}f}"


def _address(data: bytes | None) -> str | None:
    return None if data is None else f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def _packed(values: Array) -> dict[str, str]:
    """Points (n, 3) as three arrays for plotly.js."""
    return {
        axis: base64.b64encode(np.ascontiguousarray(values[:, k], "<f4").tobytes()).decode()
        for k, axis in enumerate("xyz")
    }


def _numbers(values: Array) -> Any:
    """Nested lists of rounded numbers, None where there is none."""
    rounded = np.round(values, 4).astype(object)
    rounded[~np.isfinite(values)] = None
    return rounded.tolist()


def view_frame(R_cw: Array) -> Array:
    """Rotation from the world to a frame with z up, x to the right of the first photos, by upright cameras."""
    up = -R_cw[:, 1].mean(0)
    if np.linalg.norm(up) < 0.3:  # cameras look at all sides, or down in all directions
        up = -R_cw[0, 1]
    up /= np.linalg.norm(up)
    right = R_cw[:, 0].mean(0)
    right -= up * (up @ right)
    if np.linalg.norm(right) < 0.3:
        right = R_cw[0, 0] - up * (up @ R_cw[0, 0])
    right /= max(float(np.linalg.norm(right)), 1e-12)
    return np.stack([right, np.cross(up, right), up])


def _size(centers: Array, points: Array) -> float:
    """Extent of the scene from the middle of the cameras, without its farthest points."""
    middle = np.median(centers, axis=0)
    every = centers if not len(points) else points
    distance = np.linalg.norm(every - middle, axis=1)
    return max(float(np.quantile(distance, 0.9)), float(np.linalg.norm(centers - middle, axis=1).max()), 1e-9)


def _spacing(centers: Array) -> float:
    """Median distance of a camera from the nearest other; of some, where they are many."""
    some = centers[np.unique(np.linspace(0, len(centers) - 1, 200).astype(int))]
    distance = np.linalg.norm(some[:, None] - centers[None], axis=2)
    distance[distance < 1e-9] = np.inf
    nearest = distance.min(1, initial=np.inf)
    return float(np.median(nearest[np.isfinite(nearest)])) if np.isfinite(nearest).any() else 0.0


def _is_near(points: Array, centers: Array, reach: float) -> Mask:
    near: Mask = np.linalg.norm(points - np.median(centers, axis=0), axis=1) < 2 * reach
    return near


def _box(points: Array, centers: Array) -> list[list[float]]:
    """Ranges of the three axes that contain the cameras, and all but the farthest points."""
    low, high = centers.min(0), centers.max(0)
    if len(points):
        nearest, farthest = np.quantile(points, [0.02, 0.98], axis=0)
        low, high = np.minimum(low, nearest), np.maximum(high, farthest)
    pad = 0.05 * float((high - low).max()) + 1e-9
    return np.round(np.stack([low - pad, high + pad], axis=1), 5).tolist()


def _frusta(R_cw: Array, centers: Array, lenses: Sequence[Camera], side: float) -> Array:
    """(k, 3) polylines with NaN between them: a pyramid for each camera."""
    half = np.array([[lens.width / lens.K[0, 0] / 2, lens.height / lens.K[1, 1] / 2] for lens in lenses])
    half = np.minimum(half, 1.5)
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = np.concatenate([half[:, None] * signs, np.ones((len(lenses), 4, 1))], axis=2)
    world = centers[:, None] + side * corners @ R_cw
    apex, gap = centers[:, None], np.full((len(lenses), 1, 3), np.nan)
    a, b, c, d = (world[:, k : k + 1] for k in range(4))
    line = [apex, a, b, apex, c, d, apex, gap, b, c, gap, d, a, gap]
    return np.concatenate(line, axis=1).reshape(-1, 3)
