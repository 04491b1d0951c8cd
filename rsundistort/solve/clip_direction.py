"""Along which lines the frames of a video may have been read."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from ..input.photo_cameras import PhotoCameras
from ..model import Reconstruction, other_axis
from ..sfm import MatchedPhotos

__all__ = ["likely_directions", "read_along"]

_WithCameras = TypeVar("_WithCameras", Reconstruction, MatchedPhotos, PhotoCameras)


def likely_directions(cameras: PhotoCameras) -> tuple[str, ...]:
    """Along which to read the frames, the likeliest first.

    Sensors lie on their long side: frames that are stored upright were rotated since, or are a part of others.
    """
    camera = cameras.of(0)
    if cameras.readout_specified[0] or camera.height <= camera.width:
        return (camera.readout,)
    return other_axis(camera.readout), camera.readout


def read_along(direction: str, of: _WithCameras) -> _WithCameras:
    """The same with cameras that are read in another direction."""
    return replace(of, cameras=tuple(replace(camera, readout=direction) for camera in of.cameras))
