"""What a run answers: every photo's pose and motion, with how well it fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import InputError
from .array_types import Array
from .camera import Camera
from .checks import check_array, check_fields, check_finite, check_photo_name, check_rotation, frozen
from .former_fields import former_fields
from .motion import RowMotion, check_shutter_model
from .values import ComparedByFields

__all__ = ["Solution", "SolvedImage"]


@former_fields(turned="applied_orientation")
@dataclass(frozen=True, eq=False)
class SolvedImage(ComparedByFields):
    """One photo of a solution.

    Attributes
    ----------
    name, camera_id : str
        Photo, a file below its folder, and its camera.
    R_cw, center_w : (3, 3), (3,) array or None
        Pose at the principal row; None for a photo that did not register.
    motion : RowMotion or None
        Motion during the readout.
    sigma_phi : (3,) array or None
        Standard deviations of phi, if known.
    num_observations : int
        Measurements in this photo.
    rms_px : float or None
        Root mean square of the residuals' x and y parts.
    rs_shift_px : float or None
        Largest displacement that the shutter caused in this photo.
    depth : str or None
        What the photo was rectified with, of a camera that moved: "infinity", "plane", "points" or "map".
    translation_shift_px : float or None
        Largest displacement that the translation alone caused, by that depth.
    reason : str or None
        Why the photo did not register; of one that did, why it could not be rectified.
    applied_orientation : int
        EXIF orientation by which the photo was rotated after it was rectified: pose, motion and cameras are those of
        the rotated frame. 1 in the stored frame.
    roi : (x, y, width, height) or None
        Rectangle of the rectified photo without empty pixels, if there is one.
    doubtful : str or None
        Why its motion is to be checked.
    lens_only : bool
        Whether the rectified photo has the lens taken out only, since the measurements do not support the motion that
        was found: `motion` stays what was found, `taken_out` is none.
    sigma_rotation : (3,) array or None
        Standard deviations of the rotation about the axes of the camera, radians, if known: after the common rotation
        that fits the true ones of all photos best.
    sigma_center : (3,) array or None
        Standard deviations of the centre along the axes of the world, in its units, if known: after the similarity that
        fits the true ones of all photos best. Of a georeferenced solution both are those on the map.
    """

    name: str
    camera_id: str
    R_cw: Array | None = None
    center_w: Array | None = None
    motion: RowMotion | None = None
    sigma_phi: Array | None = None
    num_observations: int = 0
    rms_px: float | None = None
    rs_shift_px: float | None = None
    depth: str | None = None
    translation_shift_px: float | None = None
    reason: str | None = None
    applied_orientation: int = 1
    roi: tuple[int, int, int, int] | None = None
    doubtful: str | None = None
    lens_only: bool = False
    sigma_rotation: Array | None = None
    sigma_center: Array | None = None

    def __post_init__(self) -> None:
        check_photo_name(self.name)
        check_fields(self)
        if self.R_cw is not None:
            object.__setattr__(self, "R_cw", frozen(check_rotation(self.R_cw, f"R_cw of {self.name}")))
        if self.motion is not None:
            object.__setattr__(self, "motion", self.motion.as_in("world"))
        if self.center_w is not None:
            center = check_finite(self.center_w, (3,), f"center_w of {self.name}")
            object.__setattr__(self, "center_w", frozen(center))
        for name in ("sigma_phi", "sigma_rotation", "sigma_center"):
            if (sigma := getattr(self, name)) is not None:
                object.__setattr__(self, name, frozen(check_array(sigma, (3,), f"{name} of {self.name}")))

    @property
    def registered(self) -> bool:
        """Whether the photo has a motion, and can be rectified."""
        return self.motion is not None

    @property
    def taken_out(self) -> RowMotion | None:
        """The motion that the rectified photo is without; None of a photo that has none."""
        return RowMotion() if self.lens_only and self.motion is not None else self.motion

    @property
    def posed(self) -> bool:
        """Whether the photo has a pose; the truth of a warped photo has a motion only."""
        return self.R_cw is not None and self.center_w is not None


@dataclass(frozen=True, eq=False)
class Solution(ComparedByFields):
    """Poses and motions of a folder of photos; what `solution.json` holds.

    Attributes
    ----------
    shutter_model : str
        Model under which phi was solved.
    cameras, rectified_cameras : mapping of id to Camera
        Of the photos, and of the rectified ones (no distortion).
    images : sequence of SolvedImage
        All photos, also those that did not register.
    critical_motion, quality : mapping
        See the file format.
    stages : sequence of mapping
        Name and seconds of each stage, with what it counted.
    options, generator : mapping
        What it was made with.
    georeference : mapping or None
        Where on the map its frame is, and how well that is known; None of a frame of its own.
    verdict : mapping or None
        What to believe of it: `shutter`, `shape` and `reasons`, as in `verdict.Verdict`; None where nobody judged.
    """

    shutter_model: str
    cameras: Mapping[str, Camera]
    rectified_cameras: Mapping[str, Camera]
    images: Sequence[SolvedImage]
    critical_motion: Mapping[str, Any] | None = None
    quality: Mapping[str, Any] = field(default_factory=dict)
    stages: Sequence[Mapping[str, Any]] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    generator: Mapping[str, str] = field(default_factory=dict)
    verdict: Mapping[str, Any] | None = None
    georeference: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        check_shutter_model(self.shutter_model)
        check_fields(self)
        names = [image.name for image in self.images]
        if len(set(names)) != len(names):
            raise InputError("the solution names a photo twice")
        for image in self.images:
            if image.camera_id not in self.cameras:
                raise InputError(f"photo {image.name} has camera {image.camera_id!r}, which the solution lacks")

    @property
    def lens_varied(self) -> bool:
        """Whether f and the principal point differ from photo to photo, each of which then has a camera of its own."""
        return bool(self.quality.get("focal_sigma") or self.quality.get("centre_sigma_focal_lengths"))

    @property
    def shared_cameras(self) -> dict[tuple[str, ...], Camera]:
        """Cameras by their ids: those of photos whose lens varied together, with the median of each number of K."""
        groups: dict[Any, list[str]] = {}
        for key, camera in self.cameras.items():
            shared = (
                camera.width,
                camera.height,
                camera.readout,
                camera.lens,
                *camera.dist.tolist(),
                camera.field.tobytes(),
            )
            groups.setdefault(shared if self.lens_varied else key, []).append(key)
        return {
            tuple(keys): replace(self.cameras[keys[0]], K=np.median([self.cameras[key].K for key in keys], axis=0))
            for keys in groups.values()
        }

    def image(self, name: str) -> SolvedImage:
        """The photo of a name."""
        try:
            return self._by_name[name]
        except KeyError:
            raise InputError(f"the solution has no photo {name!r}") from None

    @cached_property
    def _by_name(self) -> dict[str, SolvedImage]:
        return {image.name: image for image in self.images}

    @property
    def registered(self) -> list[SolvedImage]:
        """Photos that have a motion."""
        return [image for image in self.images if image.registered]
