"""What is written for other programs: the same for all of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..model import Camera, Reconstruction, RowMotion, Solution, SolvedImage
from ..model.array_types import Array
from ..model.projection import project_points, unproject_points
from ..model.track import CameraTrack

__all__ = ["ExportScene", "euler_deg", "lens_left_px", "rotation_left_px"]

# Places on each side of a photo where errors are looked at.
_LOOKED_AT = 17


@dataclass(frozen=True)
class ExportScene:
    """A solution, and where its photos and points are.

    Attributes
    ----------
    solution : Solution
        Poses and rectified cameras, rotated as the rectified photos are.
    reconstruction : Reconstruction
        Points and measurements, rotated too.
    names : mapping of photo name to file name
        Of the rectified photos in `OUT/images`.
    rgb : (n, 3) uint8 array or None
        Colours of the points.
    stored : Solution
        Poses, motions and raw cameras in the stored frame.
    source : Path or None
        Folder of the original photos.
    originals : mapping of photo name to path
        Of the original photos, as seen from a folder in OUT.
    track : CameraTrack or None
        Camera of a video whose frames share a path.
    """

    solution: Solution
    reconstruction: Reconstruction
    names: Mapping[str, str]
    rgb: NDArray[np.uint8] | None
    stored: Solution
    source: Path | None = None
    originals: Mapping[str, str] = field(default_factory=dict)
    track: CameraTrack | None = None

    @property
    def images(self) -> list[SolvedImage]:
        """The photos that are written."""
        return [image for image in self.solution.registered if image.posed and image.name in self.names]

    def camera(self, image: SolvedImage) -> Camera:
        """The camera of a rectified photo."""
        return self.solution.rectified_cameras[image.camera_id]

    @property
    def rectified_cameras(self) -> list[Camera]:
        """The new camera of each camera of the reconstruction."""
        rec, new = self.reconstruction, self.solution.rectified_cameras
        first = [rec.image_names[int(np.argmax(rec.camera_idx == k))] for k in range(len(rec.cameras))]
        return [new[self.solution.image(name).camera_id] for name in first]

    def colors(self) -> NDArray[np.uint8]:
        """(n, 3) colours of the points; black where they are unknown."""
        return np.zeros((self.reconstruction.num_points, 3), np.uint8) if self.rgb is None else self.rgb


def euler_deg(rotations: Array, order: Literal["XYZ", "zxy"]) -> Array:
    """(..., 3) Euler angles of matrices (..., 3, 3), degrees; where two axes fall together, the third angle is zero."""
    with warnings.catch_warnings():  # gimbal lock: the angles given stand for the matrix all the same, to 1e-9
        warnings.simplefilter("ignore", UserWarning)
        return np.asarray(np.degrees(Rotation.from_matrix(rotations).as_euler(order)))


def _places(camera: Camera) -> Array:
    """Pixels all over a photo, border to border."""
    across, down = (np.linspace(-0.5, side - 0.5, _LOOKED_AT) for side in (camera.width, camera.height))
    return np.stack(np.meshgrid(across, down), axis=2).reshape(-1, 2)


def rotation_left_px(camera: Camera, motion: RowMotion) -> float:
    """How far the worst pixel of a photo is off where a format has no room for its rotation during the readout."""
    rotating = RowMotion(motion.phi)
    (with_it, seen), (without, _) = (
        unproject_points(_places(camera), camera, each, "rotation") for each in (rotating, RowMotion())
    )
    off = (with_it - without)[seen] * camera.K[[0, 1], [0, 1]]
    return float(np.linalg.norm(off, axis=1).max(initial=0.0))


def lens_left_px(camera: Camera, carried: Camera) -> float:
    """How far the worst pixel of a photo is off where a format carries another lens."""
    ideal, seen = unproject_points(_places(camera), camera, RowMotion(), "global")
    rays = np.column_stack([ideal, np.ones(len(ideal))])[seen]
    (there, valid), (here, still) = (project_points(rays, each, None, "global") for each in (camera, carried))
    return float(np.linalg.norm((there - here)[valid & still], axis=1).max(initial=0.0))
