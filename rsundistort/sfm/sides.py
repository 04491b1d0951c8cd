"""Sides of a scene that lost their place, carried along by a photo of theirs that was placed again."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array
from .connected import LEAST_TIES, connected_parts

__all__ = ["carried_along"]


def carried_along(scene: Reconstruction, former: Reconstruction, taken: Collection[str]) -> Reconstruction:
    """A scene with photos that lost their places, if a photo of their side has one again.

    The photos of a side agree with each other, wherever it is: their poses relative to the one that was placed again
    stay as they were. The scale of the side is that of the points that this photo shows in both (the median of the
    ratios of their depths); neighbours along a street may show too few of them to be registered one by one.

    Parameters
    ----------
    scene : Reconstruction
        The photos that have a place.
    former : Reconstruction
        Where the photos were before some of them lost their places.
    taken : collection of photo names
        Those.

    Returns
    -------
    Reconstruction
        The scene with more photos, which have no measurements yet; or itself.
    """
    at = {name: i for i, name in enumerate(scene.image_names)}
    lost = former.take_photos(np.isin(former.image_names, [*taken]))
    part = connected_parts(lost)
    for k in range(part.max(initial=-1) + 1):
        side = lost.take_photos(part == k)
        missing = np.array([name not in at for name in side.image_names])
        ratios = {
            i: _depth_ratios(side, i, scene, at[name]) for i, name in enumerate(side.image_names) if not missing[i]
        }
        guide = max(ratios, key=lambda i: len(ratios[i]), default=None)
        if guide is None or not missing.any() or len(ratios[guide]) < LEAST_TIES:
            continue
        i, scale = at[side.image_names[guide]], float(np.median(ratios[guide]))
        # from the world of the side to that of the scene
        turn = scene.R_cw[i].T @ side.R_cw[guide]
        center_w = scene.center_w[i] + scale * (side.center_w - side.center_w[guide]) @ turn.T
        scene = scene.with_photos(
            [name for name, new in zip(side.image_names, missing, strict=True) if new],
            side.camera_idx[missing],
            (side.R_cw @ turn.T)[missing],
            center_w[missing],
            side.phi[missing],
        )
    return scene


def _depth_ratios(side: Reconstruction, i: int, scene: Reconstruction, j: int) -> Array:
    """Depths of the points that a photo shows in a scene, over those of the same keypoints in its side."""
    here, there = _depths(side, i), _depths(scene, j)
    return np.array([there[place] / here[place] for place in here.keys() & there.keys()])


def _depths(rec: Reconstruction, i: int) -> dict[tuple[float, ...], float]:
    """Depth of the point at each keypoint of a photo, in front of it."""
    obs = rec.observations
    mine = obs.by_photo(rec.num_images)[i]
    depth = (rec.points_w[obs.point_idx[mine]] - rec.center_w[i]) @ rec.R_cw[i, 2]
    return {tuple(xy): z for xy, z in zip(obs.xy_raw[mine].tolist(), depth.tolist(), strict=True) if z > 0}
