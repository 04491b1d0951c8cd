"""The degeneracy measure: which camera motions leave the shutter undetermined, from poses alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..model import check_readout
from ..model.array_types import Array, Mask
from ..model.checks import check_finite, check_rotations, frozen

__all__ = ["CriticalMotion", "critical_motion", "readout_axes"]

# Singular values below this are rounding; below `_LOW` the shutter is poorly determined.
_ZERO = 1e-6
_LOW = 0.15

# Exchanges the axes of the photo: column readout is row readout of the exchanged photo.
_EXCHANGE = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])


@dataclass(frozen=True)
class CriticalMotion:
    """How well a set of poses determines the shutter's first-order effect, skew and aspect ratio: degeneracy measure.

    Attributes
    ----------
    singular_values : (5,) array
        Of the linearised equations of self-calibration, descending, divided by sqrt(m - 1); root mean square over the
        choice of the reference photo. As many zeros as there are changes of the scene's shape that skew and aspect
        ratio of the photos can hide.
    null_vector : (5,) array
        The change that is hidden best: skew `ds` and aspect ratio `da` of the reference photo (where the smallest value
        is lowest), and the plane at infinity `p (3,)` in units of one over the extent of the centres. Length 1, the
        largest entry positive.
    y_axis_spread_deg : float
        Root mean square angle between the axes along which the photos were read out (y for rows, x for columns), taken
        as lines, and their mean line.
    """

    singular_values: Array
    null_vector: Array
    y_axis_spread_deg: float
    num_photos: int

    @property
    def value(self) -> float:
        """Smallest singular value: 0 where something is hidden entirely, 0.5 and more for photos rotated freely."""
        return float(self.singular_values[-1])

    @property
    def num_hidden(self) -> int:
        """Number of changes of shape that leave no trace in the photos."""
        return int((self.singular_values < _ZERO).sum())

    @property
    def is_low(self) -> bool:
        """Whether the poses determine the shutter badly, or not at all."""
        return self.value < _LOW

    @property
    def meaning(self) -> str:
        """Unknowns that are confounded, in words."""
        if self.num_photos < 3:
            return "too few photos: two never separate the shutter from the shape of the scene"
        if not self.is_low:
            return "nothing: the photos are rotated enough against each other"
        ds, da = np.abs(self.null_vector[:2])
        affine = float(np.hypot(ds, da))
        second, first = self.singular_values[3:]
        if affine > 0.9 and second < max(2 * first, _ZERO):
            return "the scene's skew and aspect ratio: the photos are not rotated against each other"
        if da > 0.9:
            return "the scene's vertical scale: the y axes of the photos are nearly parallel"
        if affine > 0.9:
            return "the scene's skew and aspect ratio, mixed"
        return "the scene's shape, by a projective change that skew and aspect ratio hide"


def readout_axes(R_cw: Array, readout: Sequence[str]) -> Array:
    """(m, 3) world directions along which the photos were read out: y axes of rows, x axes of columns, no sign."""
    return np.array([R[check_readout(direction)[0]] for R, direction in zip(R_cw, readout, strict=True)])


def _equations(R_cw: Array, center_w: Array, by_column: Mask, reference: int) -> Array:
    """(3 (m - 1), 5) linearised self-calibration with one photo's skew, aspect ratio and plane at infinity unknown."""
    others = np.delete(np.arange(len(R_cw)), reference)
    # every photo as one that was read by rows
    rotation = np.where(by_column[:, None, None], _EXCHANGE, np.eye(3)) @ R_cw
    R = rotation[others] @ rotation[reference].T
    t = np.einsum("mij,mj->mi", rotation[others], center_w[reference] - center_w[others])
    changes = np.zeros((5, len(others), 3, 3))
    for k, W in enumerate(([[0, 1, 0], [1, 0, 0], [0, 0, 0]], [[0, 0, 0], [0, 2, 0], [0, 0, 0]])):
        changes[k] = R @ np.array(W, float) @ R.transpose(0, 2, 1)
    for k in range(3):  # the plane at infinity
        outer = t[:, :, None] * R[:, None, :, k]
        changes[2 + k] = -outer - outer.transpose(0, 2, 1)
    # known of each photo: its focal length, up to the scale of its equation, and its principal point
    rows = [changes[..., 0, 0] - changes[..., 2, 2], changes[..., 0, 2], changes[..., 1, 2]]
    return np.stack(rows, axis=-1).reshape(5, -1).T


def critical_motion(
    R_cw: ArrayLike, center_w: ArrayLike, readout: str | Sequence[str] = "top-to-bottom"
) -> CriticalMotion:
    """How well poses determine the shutter: the singular values of the linearised self-calibration.

    To first order a rotating rolling-shutter camera is one whose skew and aspect ratio are unknown in every photo (Ito
    and Okatani, Eq. 9). What is then known of each photo, focal length and principal point, gives three equations for
    the reference photo's skew and aspect ratio and the plane at infinity (their Eqs. 15 and 18, linearised at a camera
    without motion); `docs/critical-motions.md` derives them.

    Parameters
    ----------
    R_cw, center_w : (m, 3, 3), (m, 3) array
        Poses in the stored pixel frame, `x_c = R_cw (X_w - center_w)`; m of at least 2.
    readout : str or sequence of m str
        Readout direction, of all photos or of each.

    Returns
    -------
    CriticalMotion
        Unchanged by a similarity of the world, and by the order of the photos.

    Raises
    ------
    InputError
        Fewer than two photos, no rotation matrices, or an unknown direction.
    """
    centers = check_finite(center_w, (None, 3), "center_w")
    m = len(centers)
    rotation = check_rotations(R_cw, m, "R_cw")
    if m < 2:
        raise InputError("the degeneracy measure compares photos; it needs at least two poses")
    if not isinstance(readout, (str, Sequence)):
        raise InputError(f"readout={readout!r}, expected a direction, or one for each photo")
    directions = [readout] * m if isinstance(readout, str) else list(readout)
    if len(directions) != m:
        raise InputError(f"readout names {len(directions)} directions for {m} photos")
    by_column = np.array([check_readout(direction)[0] == 0 for direction in directions])
    spread = float(np.sqrt(2 * np.mean(np.sum((centers - centers.mean(0)) ** 2, axis=1)))) or 1.0
    values = np.zeros((m, 5))
    vectors = np.zeros((m, 5))
    for reference in range(m):
        rows = _equations(rotation, centers / spread, by_column, reference) / np.sqrt(m - 1)
        # of the triangle: with all rows it would grow with the cube of the number of photos
        _, found, Vt = np.linalg.svd(np.linalg.qr(rows, mode="r"), full_matrices=True)
        values[reference, : len(found)] = found
        vectors[reference] = Vt[-1]
    # rounding must not choose among references that hide the same
    lowest = values[:, -1] <= values[:, -1].min() + 1e-12
    null = vectors[int(np.argmax(lowest))]
    null = null * np.sign(null[np.argmax(np.abs(null))])
    axes = readout_axes(rotation, directions)
    along = np.linalg.eigvalsh(axes.T @ axes / m)[-1]
    return CriticalMotion(
        singular_values=frozen(np.sqrt(np.mean(values**2, axis=0))),
        null_vector=frozen(null),
        y_axis_spread_deg=float(np.degrees(np.arcsin(np.sqrt(np.clip(1.0 - along, 0.0, 1.0))))),
        num_photos=m,
    )
