"""The cameras of rectified photos, for all photos of each physical camera."""

from __future__ import annotations

from dataclasses import replace

from ..errors import InputError
from ..model import RowMotion, Solution
from ..rectify import ViewOptions, rectified_roi, rectified_view

__all__ = ["with_view"]


def with_view(solution: Solution, view: ViewOptions) -> Solution:
    """The solution with the rectified cameras that were asked for, and each photo's rectangle without empty pixels.

    A rectified camera serves all photos of its physical camera: with alpha 0 none of them has an empty pixel, with
    alpha 1 none loses one. That goes by lens and rotation: what depth and translation move besides is a matter of each
    photo.
    """
    cameras = {}
    for key, old in solution.rectified_cameras.items():
        motions = [each.taken_out or RowMotion() for each in solution.registered if each.camera_id == key]
        try:
            cameras[key] = rectified_view(solution.cameras[key], motions, solution.shutter_model, view, old)
        except InputError as error:
            raise InputError(f"camera {key} and alpha {view.alpha}: {error}") from error
    images = [
        replace(
            image,
            roi=rectified_roi(
                solution.cameras[image.camera_id], image.taken_out, solution.shutter_model, cameras[image.camera_id]
            ),
        )
        if image.registered
        else image
        for image in solution.images
    ]
    return replace(solution, rectified_cameras=cameras, images=tuple(images))
