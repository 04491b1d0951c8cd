"""Measurements and what they were explained by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .array_types import Array, Index, Mask
from .bend import Bend
from .camera import Camera
from .checks import check_fields, check_finite, check_index, check_numbers, check_rotations, frozen
from .motion import RowMotion, check_shutter_model
from .values import ComparedByFields

__all__ = ["Observations", "Reconstruction"]

# Fields of a reconstruction that have a row for each photo.
_OF_PHOTOS = ("camera_idx", "R_cw", "center_w", "phi", "velocity", "variation", "bend", "bend_clock")


def _or(value: Any, default: Array, name: str) -> Array:
    """The value, or what stands for one that was left out."""
    array = check_numbers(value, name)
    return array if array.size else default


@dataclass(frozen=True, eq=False)
class Observations(ComparedByFields):
    """Where photos see points: `xy_raw[k]` is point `point_idx[k]` in photo `frame_idx[k]`.

    Parameters
    ----------
    frame_idx, point_idx : (o,) int array
        Indices of the photo and of the point.
    xy_raw : (o, 2) array
        Pixels of the stored photo, integer centres.
    sigma : (o,) array, optional
        Standard deviation of each measurement relative to the best ones; 1 when left out.
    """

    frame_idx: Index
    point_idx: Index
    xy_raw: Array
    sigma: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        xy = check_finite(self.xy_raw, (None, 2), "xy_raw")
        big = np.iinfo(np.int64).max
        object.__setattr__(self, "frame_idx", frozen(check_index(self.frame_idx, len(xy), big, "frame_idx")))
        object.__setattr__(self, "point_idx", frozen(check_index(self.point_idx, len(xy), big, "point_idx")))
        object.__setattr__(self, "xy_raw", frozen(xy))
        sigma = check_finite(_or(self.sigma, np.ones(len(xy)), "sigma"), (len(xy),), "sigma")
        if (sigma <= 0).any():
            raise InputError("sigma must be positive")
        object.__setattr__(self, "sigma", frozen(sigma))

    def __len__(self) -> int:
        return len(self.xy_raw)

    def by_photo(self, num_images: int) -> list[Index]:
        """Indices of the measurements of each photo."""
        order = np.argsort(self.frame_idx, kind="stable")
        return np.split(order, np.searchsorted(self.frame_idx[order], np.arange(1, num_images)))[:num_images]

    def select(self, keep: NDArray[Any]) -> Observations:
        """The observations that a mask or an index array names."""
        return Observations(self.frame_idx[keep], self.point_idx[keep], self.xy_raw[keep], self.sigma[keep])


@dataclass(frozen=True, eq=False)
class Reconstruction(ComparedByFields):
    """Cameras, poses, shutter motions and points; all poses at the principal row.

    Parameters
    ----------
    cameras : sequence of Camera
        Physical cameras.
    image_names : sequence of str, length m
        Photos.
    camera_idx : (m,) int array
        Camera of each photo.
    R_cw, center_w : (m, 3, 3), (m, 3) array
        `x_c = R_cw (X_w - center_w)`.
    points_w : (n, 3) array
        Scene points.
    observations : Observations
        Measurements of the points.
    phi, velocity : (m, 3) array
        Motion during readout per unit of the clock (`RowMotion`); zero when left out.
    shutter_model : str
        Model under which phi and velocity were solved.
    variation : (m, 3) array
        How the intrinsics of each photo differ from its camera's, where focusing or a stabiliser moved the lens: log f,
        and the principal point in focal lengths (`Camera.varied`); zero when left out.
    bend : (m, n, 6) array
        How the motions depart from steady ones, n readings of each: rotation and position, as of `Bend.values`; n is 0
        when left out.
    bend_clock : (m, 2) array
        The clock at the first and the last of these readings.
    """

    cameras: Sequence[Camera]
    image_names: Sequence[str]
    camera_idx: Index
    R_cw: Array
    center_w: Array
    points_w: Array
    observations: Observations
    phi: Array = field(default_factory=lambda: np.zeros(0))
    velocity: Array = field(default_factory=lambda: np.zeros(0))
    shutter_model: str = "global"
    variation: Array = field(default_factory=lambda: np.zeros(0))
    bend: Array = field(default_factory=lambda: np.zeros(0))
    bend_clock: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        check_fields(self)
        m = len(self.image_names)
        if len(set(self.image_names)) != m:
            raise InputError("image_names holds a name twice")
        if not len(self.cameras):
            raise InputError("a reconstruction needs at least one camera")
        check_shutter_model(self.shutter_model)
        points_w = check_finite(self.points_w, (None, 3), "points_w")
        fields: dict[str, Any] = {
            "camera_idx": check_index(self.camera_idx, m, len(self.cameras), "camera_idx"),
            "R_cw": check_rotations(self.R_cw, m, "R_cw"),
            "center_w": check_finite(self.center_w, (m, 3), "center_w"),
            "points_w": points_w,
        }
        for name in ("phi", "velocity", "variation"):
            value = getattr(self, name)
            fields[name] = check_finite(_or(value, np.zeros((m, 3)), name), (m, 3), name)
        bent = check_numbers(self.bend, "bend").size > 0
        fields["bend"] = check_finite(self.bend if bent else np.zeros((m, 0, 6)), (m, None, 6), "bend")
        fields["bend_clock"] = check_finite(self.bend_clock if bent else np.zeros((m, 2)), (m, 2), "bend_clock")
        for name, value in fields.items():
            object.__setattr__(self, name, frozen(value))
        object.__setattr__(self, "cameras", tuple(self.cameras))
        object.__setattr__(self, "image_names", tuple(self.image_names))
        obs = self.observations
        check_index(obs.frame_idx, len(obs), m, "frame_idx")
        check_index(obs.point_idx, len(obs), len(points_w), "point_idx")

    @property
    def num_images(self) -> int:
        """Number of photos."""
        return len(self.image_names)

    @property
    def num_points(self) -> int:
        """Number of points."""
        return len(self.points_w)

    def camera(self, image: int) -> Camera:
        """The camera of a photo, as it was when that was taken."""
        camera = self.cameras[int(self.camera_idx[image])]
        return camera.varied(*self.variation[image].tolist()) if self.variation[image].any() else camera

    @property
    def varies(self) -> bool:
        """Whether photos of one camera differ in their intrinsics."""
        return bool(self.variation.any())

    def with_own_cameras(self) -> Reconstruction:
        """The reconstruction with a camera for each photo, if they vary."""
        if not self.varies:
            return self
        own = tuple(self.camera(i) for i in range(self.num_images))
        return replace(self, cameras=own, camera_idx=np.arange(self.num_images), variation=np.zeros(0))

    def motion(self, image: int) -> RowMotion:
        """The motion of a photo during its readout, in the world."""
        bend = None
        if self.bends:
            start, end = self.bend_clock[image].tolist()
            bend = Bend(start, end, self.bend[image, :, :3], self.bend[image, :, 3:])
        return RowMotion(self.phi[image], self.velocity[image], bend, "world")

    def with_motions(self, motions: Sequence[RowMotion]) -> Reconstruction:
        """The reconstruction with other motions of its photos, bends of as many readings or none."""
        bends = [each.bend for each in motions]
        none = np.zeros((max((len(bend.values) for bend in bends if bend is not None), default=0), 6))
        values = np.array([none if bend is None else bend.values for bend in bends]).reshape(len(bends), *none.shape)
        # where there is none, any range of the clock will do
        clock = np.array([(-1.0, 1.0) if bend is None else (bend.start, bend.end) for bend in bends]).reshape(-1, 2)
        return replace(
            self, phi=np.array([each.phi for each in motions]), velocity=np.array([each.velocity for each in motions]),
            bend=values, bend_clock=clock,
        )  # fmt: skip

    @property
    def bends(self) -> bool:
        """Whether motions depart from steady ones."""
        return self.bend.shape[1] > 0

    def frame_span(self) -> Array:
        """(m,) how far each photo's clock runs over its frame: converts phi into radians per frame."""
        return np.array([each.frame_span for each in self.cameras])[self.camera_idx] * np.exp(-self.variation[:, 0])

    @property
    def baseline(self) -> float:
        """Mean distance of consecutive centres, the paper's t-bar; 1 where they coincide."""
        step = np.linalg.norm(np.diff(self.center_w, axis=0), axis=1)
        return float(step.mean()) if step.any() else 1.0

    @property
    def size(self) -> float:
        """Median distance of the points from the middle of the cameras, world units; there must be points."""
        return float(np.median(np.linalg.norm(self.points_w - self.center_w.mean(0), axis=1)))

    def median_depth(self, image: int) -> float:
        """Median distance, along the optical axis, of the points that a photo measured; of all where it saw none."""
        mine = self.observations.point_idx[self.observations.frame_idx == image]
        points = self.points_w[mine] if len(mine) else self.points_w
        return float(np.median(np.abs((points - self.center_w[image]) @ self.R_cw[image, 2])))

    @property
    def typical_depth(self) -> float:
        """Median distance, along the optical axis, of measured points, over the measurements of all photos."""
        obs = self.observations
        away = self.points_w[obs.point_idx] - self.center_w[obs.frame_idx]
        return float(np.median(np.abs((away * self.R_cw[obs.frame_idx, 2]).sum(axis=1))))

    def normalized(self) -> Reconstruction:
        """The reconstruction in its own frame: the first photo at the origin, consecutive centres 1 apart in the mean.

        Which similarity a mapping ends in is chance; results of two runs must compare without aligning them.
        """
        return self.moved(self.R_cw[0], self.center_w[0], 1.0 / self.baseline)

    def moved(self, R: Array, origin: Array, scale: float) -> Reconstruction:
        """The reconstruction in a world where x is scale R (x - origin)."""
        return replace(
            self,
            R_cw=self.R_cw @ R.T,
            center_w=scale * (self.center_w - origin) @ R.T,
            points_w=scale * (self.points_w - origin) @ R.T,
            velocity=scale * self.velocity @ R.T,
            bend=np.concatenate([self.bend[..., :3], scale * self.bend[..., 3:] @ R.T], axis=2),
        )

    def track_lengths(self, keep_obs: Mask) -> Index:
        """(n,) number of photos that see each point among some observations; a photo counts once."""
        obs = self.observations
        # np.unique by hashes takes many times as long
        key = np.sort((obs.point_idx * self.num_images + obs.frame_idx)[keep_obs])
        first = np.ones(len(key), bool)
        first[1:] = key[1:] != key[:-1]
        return np.bincount(key[first] // self.num_images, minlength=self.num_points)

    def take_points(self, keep_point: Mask) -> Reconstruction:
        """The reconstruction with some points only, and all their observations."""
        obs = self.observations
        new_idx = np.cumsum(keep_point) - 1
        kept = obs.select(keep_point[obs.point_idx])
        kept = replace(kept, point_idx=new_idx[kept.point_idx])
        return replace(self, points_w=self.points_w[keep_point], observations=kept)

    def with_points(self, keep_obs: Mask, min_track: int = 2) -> Reconstruction:
        """The reconstruction with some observations only, without points left with under `min_track` photos."""
        alive = self.track_lengths(keep_obs) >= min_track
        return replace(self, observations=self.observations.select(keep_obs)).take_points(alive)

    def without_photos(self, least: int) -> Reconstruction:
        """The reconstruction without photos of fewer than `least` measurements, and what only they showed."""
        rec = self
        while True:
            keep = np.bincount(rec.observations.frame_idx, minlength=rec.num_images) >= least
            if keep.all():
                return rec
            rec = rec.take_photos(keep)

    def rows(self, of: Any) -> dict[str, Any]:
        """The fields that have a row for each photo, with the rows that an index, a mask or a slice takes."""
        return {name: getattr(self, name)[of] for name in _OF_PHOTOS}

    def with_photos(
        self, names: Sequence[str], camera_idx: Index, R_cw: Array, center_w: Array, phi: Array
    ) -> Reconstruction:
        """The reconstruction with more photos at its end, that rotate steadily and have no measurements yet."""
        clock = np.tile([-1.0, 1.0], (len(names), 1))  # of a bend that is none
        given = {"camera_idx": camera_idx, "R_cw": R_cw, "center_w": center_w, "phi": phi, "bend_clock": clock}
        rows: dict[str, Any] = {
            name: np.concatenate([own, given.get(name, np.zeros((len(names), *own.shape[1:])))])
            for name, own in self.rows(slice(None)).items()
        }
        return replace(self, image_names=[*self.image_names, *names], **rows)

    def take_photos(self, keep: Mask) -> Reconstruction:
        """The reconstruction with some photos (m,) only, and the points that two of them show."""
        obs = self.observations.select(keep[self.observations.frame_idx])
        taken = replace(
            self,
            image_names=[self.image_names[i] for i in np.flatnonzero(keep).tolist()],
            observations=replace(obs, frame_idx=(np.cumsum(keep) - 1)[obs.frame_idx]),
            **self.rows(keep),
        )
        return taken.with_points(np.ones(len(obs), bool))
