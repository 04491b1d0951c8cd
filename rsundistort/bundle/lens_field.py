"""What the lens models leave as unknowns of an adjustment: a field of each camera that its intrinsics cannot say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..model import Camera, RowMotion
from ..model.array_types import Array, Index
from ..model.field import field_basis, field_over_frame, folds
from ..model.projection import project_points, unproject_points
from .intrinsics import moved_camera

__all__ = ["LensFields"]


# Places along the longer and the shorter side of a photo: two spans by one.
_SHAPE = (5, 4)
# By how much intrinsics and rays are moved to see what that does.
_STEP = 1e-4
# A step that far is astray.
_MOST_PX = 1.0
# One that is cut shorter is none.
_LEAST_PX = 1e-3


class LensFields:
    """Fields of cameras in a basis of those that have no mean, and that nothing else expresses.

    Orthogonal over the frame to what a change of the intrinsics of a plain lens does to first order, to what a rotation
    of the camera does, which poses express, and to what motions that all photos share do, of a scene at one depth: a
    field would be taken for them, and they for it. The basis is orthonormal over the frame: the sum of squares of a
    camera's unknowns (nz,) is the mean square of its field, pixels squared. Their number is the same for all cameras.

    Parameters
    ----------
    cameras : sequence of Camera
        Of what size, focal length and kind of lens.
    names : sequence of str
        Intrinsics that are solved for, of `INTRINSICS`.
    shutter_model : str
        Whose motions are solved for.
    """

    def __init__(self, cameras: Sequence[Camera], names: Sequence[str], shutter_model: str) -> None:
        names = list(dict.fromkeys([*names, "cx", "cy"]))
        parts = [_basis(camera, names, shutter_model) for camera in cameras]
        self._bases = [basis for basis, _ in parts]
        self._readings = [reading for _, reading in parts]

    @property
    def num_unknowns(self) -> int:
        """Number of unknowns of a camera."""
        return self._bases[0].shape[1]

    def started(self, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """The cameras with what of their fields is one of these."""
        return tuple(
            replace(camera, field=(basis @ value).reshape(*_shape(camera), 2))
            for camera, basis, value in zip(cameras, self._bases, self.values(cameras), strict=True)
        )

    def values(self, cameras: Sequence[Camera]) -> Array:
        """(cameras, nz) unknowns of the cameras."""
        pairs = zip(self._readings, cameras, strict=True)
        return np.stack([reading @ field_over_frame(camera)[1].ravel() for reading, camera in pairs])

    def moved(self, index: int, camera: Camera, step: Array) -> Camera:
        """The camera of an index after a step (nz,) of its unknowns; one that would fold the photo is cut short."""
        change = (self._bases[index] @ np.clip(step, -_MOST_PX, _MOST_PX)).reshape(camera.field.shape)
        while folds(camera.field + change, camera.width, camera.height):
            change = change / 2
            if np.abs(change).max() < _LEAST_PX:
                return camera
        return replace(camera, field=camera.field + change)

    def jacobian(self, cameras: Sequence[Camera], camera_of_obs: Index, xy_raw: Array) -> Array:
        """(o, 2, nz) derivatives of the field at pixels (o, 2)."""
        J = np.empty((len(xy_raw), 2, self.num_unknowns))
        for k, (camera, basis) in enumerate(zip(cameras, self._bases, strict=True)):
            mine = camera_of_obs == k
            weights = field_basis(camera, _shape(camera), xy_raw[mine])
            for axis in (0, 1):
                J[mine, axis] = weights @ basis[axis::2]
        return J


def _shape(camera: Camera) -> tuple[int, int]:
    """Rows and columns of a camera's field."""
    return _SHAPE[::-1] if camera.width >= camera.height else _SHAPE


def _basis(camera: Camera, names: Sequence[str], shutter_model: str) -> tuple[Array, Array]:
    """Values (2 rows cols, nz) of fields that are orthonormal over the frame, and what reads them (nz, 2 n) off it."""
    xy = field_over_frame(camera)[0].reshape(-1, 2)
    # of a lens that does not bend, on the middle of the frame: what is a field must not change with what is found
    K = np.array(camera.K)
    K[:2, 2] = (camera.width - 1) / 2, (camera.height - 1) / 2
    camera = replace(camera.pinhole(), K=K, lens=camera.lens)
    ideal, seen = unproject_points(xy, camera, None, "global")
    rays = np.column_stack([ideal, np.ones(len(xy))])[seen]
    still = project_points(rays, camera, None, "global")[0]
    steps = _STEP * np.eye(3)
    weights = np.kron(field_basis(camera, _shape(camera), xy), np.eye(2))
    moved = [(rays, moved_camera(camera, [name], np.array([_STEP])), RowMotion()) for name in names]
    moved += [(rays + np.cross(step, rays), camera, RowMotion()) for step in steps]
    moved += [(rays, camera, RowMotion(step)) for step in steps if shutter_model != "global"]
    moved += [(rays, camera, RowMotion(velocity=step)) for step in steps if shutter_model == "constant-motion"]
    changes = np.zeros((len(xy), 2, len(moved)))
    for k, each in enumerate(moved):
        changes[seen, :, k] = project_points(*each, shutter_model)[0] - still
    # the span, whatever the units; polynomials of a lens are nearly one another
    span = np.linalg.qr(changes.reshape(-1, len(moved)))[0]
    basis = np.linalg.svd(span.T @ weights)[2][len(moved) :].T
    square, rotation = np.linalg.eigh(basis.T @ (weights.T @ weights / len(xy)) @ basis)
    basis = basis @ rotation / np.sqrt(square)
    return basis, basis.T @ weights.T / len(xy)
