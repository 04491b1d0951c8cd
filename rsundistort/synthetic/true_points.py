"""True points of a scene and where its photos show them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model.array_types import Array, Index
from .measurements import project_rows
from .recipe import Recipe, View
from .render import pixel_rays

__all__ = ["TruePoints", "true_points"]

# A point is seen where the nearest surface along its ray lies within this share of its distance.
_SAME = 1e-6


@dataclass(frozen=True)
class TruePoints:
    """Points on the surfaces, and where each photo shows them.

    Attributes
    ----------
    points_w : (n, 3) array
        World frame.
    frame_idx, point_idx : (o,) int64 array
        Photo and point of each measurement.
    xy_raw, xy_global : (o, 2) array
        Exact pixel in the rolling-shutter photo, and in its global-shutter reference (nan where that does not show
        the point).
    """

    points_w: Array
    frame_idx: Index
    point_idx: Index
    xy_raw: Array
    xy_global: Array


def _seen(recipe: Recipe, view: View, points_w: Array) -> Array:
    """Pixels (n, 2) where a photo shows points; nan where it does not."""
    camera = recipe.camera(view)
    uv, valid = project_rows(points_w, view.R_cw, view.center_w, view.motion, camera)
    valid &= ((uv >= 0) & (uv <= [camera.width - 1, camera.height - 1])).all(1)
    if valid.any():
        origins, directions = pixel_rays(camera, view, uv[valid])
        distance = recipe.scene.cast(origins, directions)[1]
        there = np.linalg.norm(points_w[valid] - origins, axis=1) / np.linalg.norm(directions, axis=1)
        valid[valid] = distance >= there * (1 - _SAME)
    return np.where(valid[:, None], uv, np.nan)


def true_points(recipe: Recipe) -> TruePoints:
    """Points drawn evenly over the pixels of all photos, with their tracks; those that only one sees are left out.

    Deterministic: the recipe's seed draws them.
    """
    rng = np.random.default_rng([recipe.scene.seed, 6])
    share = np.bincount(np.arange(recipe.num_points) % len(recipe.views), minlength=len(recipe.views))
    drawn = []
    for view, number in zip(recipe.views, share, strict=True):
        camera = recipe.camera(view)
        uv = rng.uniform(0, 1, (int(number), 2)) * [camera.width - 1, camera.height - 1]
        if not number:
            continue
        origins, directions = pixel_rays(camera, view, uv)
        distance = recipe.scene.cast(origins, directions)[1]
        met = np.isfinite(distance)
        drawn.append(origins[met] + distance[met, None] * directions[met])
    points = np.concatenate(drawn) if drawn else np.zeros((0, 3))
    raw = np.array([_seen(recipe, view, points) for view in recipe.views])
    shown = np.isfinite(raw[..., 0])
    kept = shown.sum(0) >= 2
    points, raw, shown = points[kept], raw[:, kept], shown[:, kept]
    reference = np.array([_seen(recipe, view.at_once(), points) for view in recipe.views])
    frame, point = np.nonzero(shown)
    return TruePoints(points, frame, point, raw[frame, point], reference[frame, point])
