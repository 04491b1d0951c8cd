"""Control points among the points of a reconstruction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..model import ControlPoint, Observations, Reconstruction
from ..model.array_types import Array, Index
from ..model.reprojection import reprojection_residuals
from .triangulate import retriangulated

__all__ = ["CONTROL_SIGMA_PX", "PlacedControl", "place_control", "with_control"]


#: How exactly a person points at a target, pixels.
CONTROL_SIGMA_PX = 0.5
_STEPS = 10


@dataclass(frozen=True)
class PlacedControl:
    """Where a reconstruction has control points.

    Attributes
    ----------
    points : tuple of ControlPoint
        Those that two of its photos see.
    points_w : (k, 3) array
        Where they are.
    covariance : (k, 3, 3) array
        As far as pointing at them, and poses, make it.
    rms_px : (k,) array
        Root mean square of the x and y parts of their residuals.
    num_photos : (k,) int array
        Photos that see them.
    """

    points: tuple[ControlPoint, ...]
    points_w: Array
    covariance: Array
    rms_px: Array
    num_photos: Index


def with_control(reconstruction: Reconstruction, points: Sequence[ControlPoint], sigma: float) -> Reconstruction:
    """The reconstruction with control points behind its points, each that two of its photos see, where their rays meet.

    `sigma` is their standard deviation in the image relative to the best measurements.
    """
    rec, index = reconstruction, {name: i for i, name in enumerate(reconstruction.image_names)}
    seen = [[(index[name], *xy) for name, xy in each.seen.items() if name in index] for each in points]
    seen = [each for each in seen if len(each) > 1]
    if not seen:
        return rec
    obs, rows = rec.observations, np.array([row for each in seen for row in each])
    number = np.repeat(np.arange(len(seen)), [len(each) for each in seen])
    far = rec.center_w.mean(0) + np.array([0.0, 0.0, 1e6 * rec.size])
    joined = replace(
        rec,
        points_w=np.concatenate([rec.points_w, np.tile(far, (len(seen), 1))]),
        observations=Observations(
            np.concatenate([obs.frame_idx, rows[:, 0].astype(np.int64)]),
            np.concatenate([obs.point_idx, rec.num_points + number]),
            np.concatenate([obs.xy_raw, rows[:, 1:]]),
            np.concatenate([obs.sigma, np.full(len(rows), sigma)]),
        ),
    )
    found = retriangulated(joined, rec.shutter_model, from_afar=True).points_w
    return replace(joined, points_w=np.concatenate([rec.points_w, found[rec.num_points :]]))


def place_control(
    reconstruction: Reconstruction, points: Sequence[ControlPoint], covariances: Array | None = None
) -> PlacedControl:
    """Where poses and motions of a reconstruction put control points, by Gauss-Newton steps on their pixels.

    With covariances of the photos' unknowns, as of `BundleResult`, those of the points hold what these make of them, as
    if photos were independent; else pointing at the points alone.
    """
    names = set(reconstruction.image_names)
    known = tuple(each for each in points if len(names & set(each.seen)) > 1)
    if not known:
        return PlacedControl((), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0, np.int64))
    rec = with_control(reconstruction, known, 1.0)
    rec = rec.take_points(np.arange(rec.num_points) >= reconstruction.num_points)
    of, k = rec.observations.point_idx, len(known)
    step_w = 1e-6 * reconstruction.size
    for _ in range(_STEPS):
        J, inverse = _by_points(rec, step_w)
        g = np.zeros((k, 3))
        np.add.at(g, of, np.einsum("oia,oi->oa", J, _residuals(rec)))
        rec = _moved(rec, -np.einsum("kab,kb->ka", inverse, g))
    J, inverse = _by_points(rec, step_w)
    noise = np.tile(CONTROL_SIGMA_PX**2 * np.eye(2), (len(of), 1, 1))
    if covariances is not None:
        A = _by_photos(rec, covariances.shape[1], step_w)
        noise += np.einsum("oia,oab,ojb->oij", A, covariances[rec.observations.frame_idx], A)
    spread = np.zeros((k, 3, 3))
    np.add.at(spread, of, np.einsum("oia,oij,ojb->oab", J, noise, J))
    square, count = np.bincount(of, (_residuals(rec) ** 2).mean(1), k), np.bincount(of, minlength=k)
    return PlacedControl(known, rec.points_w, inverse @ spread @ inverse, np.sqrt(square / count), count)


def _by_points(rec: Reconstruction, step_w: float) -> tuple[Array, Array]:
    """Derivatives (o, 2, 3) of the residuals by the points, and the inverse (k, 3, 3) of each point's J'J."""
    res = _residuals(rec)
    J = np.stack([(_residuals(_moved(rec, step_w * unit)) - res) / step_w for unit in np.eye(3)], axis=2)
    H = np.zeros((rec.num_points, 3, 3))
    np.add.at(H, rec.observations.point_idx, np.einsum("oia,oib->oab", J, J))
    # a ridge keeps parallel rays finite
    return J, np.linalg.inv(H + (1e-9 * np.trace(H, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(3))


def _by_photos(rec: Reconstruction, num_unknowns: int, step_w: float) -> Array:
    """Derivatives (o, 2, nb) of the residuals by rotation, centre, phi and velocity of the photos."""
    res, columns = _residuals(rec), []
    for a in range(num_unknowns):
        unit = np.eye(3)[a % 3]
        if a < 3:
            step, other = 1e-6, replace(rec, R_cw=Rotation.from_rotvec(1e-6 * unit).as_matrix() @ rec.R_cw)
        elif a < 6:
            step, other = step_w, replace(rec, center_w=rec.center_w + step_w * unit)
        elif a < 9:
            step, other = 1e-6, replace(rec, phi=rec.phi + 1e-6 * unit)
        else:
            step, other = step_w, replace(rec, velocity=rec.velocity + step_w * unit)
        columns.append((_residuals(other) - res) / step)
    return np.stack(columns, axis=2)


def _residuals(rec: Reconstruction) -> Array:
    """(o, 2) residuals in pixels; 0 of what no photo could see."""
    res, valid = reprojection_residuals(rec)
    return np.where(valid[:, None], res, 0.0)


def _moved(rec: Reconstruction, by: Array) -> Reconstruction:
    return replace(rec, points_w=rec.points_w + by)
