"""Refuses recipes whose photos would not mean anything, with the reason."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .fold import check_no_fold
from .recipe import Recipe, View
from .render import line_poses, render_depth

__all__ = ["check_recipe"]

_NUM_LOOKS = 200


def check_recipe(recipe: Recipe) -> None:
    """Refuse a camera inside a wall or moving through one, rows that fold over, and surfaces behind every camera.

    Raises
    ------
    InputError
        Names the photo or the entry of the recipe, and the reason.
    """
    for view in recipe.views:
        _check_outside(recipe, view)
        camera = recipe.camera(view)
        depth = render_depth(recipe.scene, camera, view)
        if not np.isfinite(depth).any():
            raise InputError(f"photo {view.name} shows nothing but sky; look_at_w is away from every surface")
        check_no_fold(view.name, camera, view.motion.in_camera(view.R_cw), depth)
    _check_in_front(recipe)


def _check_outside(recipe: Recipe, view: View) -> None:
    """A camera in a solid sees the backs of surfaces wherever it looks."""
    k = np.arange(_NUM_LOOKS) + 0.5
    z, angle = 1 - 2 * k / _NUM_LOOKS, k * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - z * z)
    looks = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
    centers = line_poses(recipe.camera(view), view)[1]
    patch = recipe.scene.cast(np.tile(view.center_w, (_NUM_LOOKS, 1)), looks)[0]
    normals = recipe.scene.geometry[0][:, :3]
    back = (patch >= 0) & ((normals[patch] * looks).sum(1) > 0)
    if back.mean() > 0.9:
        raise InputError(f"photo {view.name} is taken from inside a surface: all around it are the backs of things")
    # a steady camera moves along one line, others along as many as their bends can need
    bend = view.motion.bend
    stops = centers[np.unique(np.linspace(0, len(centers) - 1, 2 if bend is None else 257).round().astype(int))]
    way = np.diff(stops, axis=0)
    moves = np.linalg.norm(way, axis=1) > 0
    if moves.any() and (recipe.scene.cast(stops[:-1][moves], way[moves])[1] < 1).any():
        raise InputError(f"photo {view.name}: the camera moves through a surface while it is read")


def _check_in_front(recipe: Recipe) -> None:
    """Each entry of the surfaces has a part before some camera."""
    ahead: dict[str, bool] = {}
    for owner, patch in zip(recipe.owners, recipe.scene.patches, strict=True):
        if ahead.get(owner):
            continue
        tips = patch.origin_w + np.array(
            [s * patch.edge_a_w + t * patch.edge_b_w for s in (0, 1) for t in (0, 1) if s + t < 2 or not patch.triangle]
        )
        depth = [((tips - view.center_w) @ view.R_cw[2]).max() for view in recipe.views]
        ahead[owner] = max(depth) > 0
    behind = [owner for owner, seen in ahead.items() if not seen]
    if behind:
        raise InputError(f"{behind[0]} lies behind every camera")
