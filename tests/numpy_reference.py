"""The row models once more, in plain NumPy: the source of synthetic measurements.

Shares no function with the kernels, and no derivation where that could be avoided: implicit rows are found by bisection
or as fixed points, column readout is written out instead of exchanging x and y, rotations are SciPy's, the lens is
OpenCV's. The exact model is `synthetic.measurements`, the generator that users and experiments have too. `phi` is per
unit of the clock, as everywhere.
"""

from __future__ import annotations

import cv2
import numpy as np

from rsundistort.model import Camera, RowMotion
from rsundistort.synthetic import project_rows

MODELS = ("global", "two-step", "linearized", "rotation", "constant-motion")
DIRECTIONS = ("top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left")


def clock(readout, xy):
    """The clock of normalised image coordinates (n, 2): it runs along the readout."""
    return {
        "top-to-bottom": xy[:, 1],
        "bottom-to-top": -xy[:, 1],
        "left-to-right": xy[:, 0],
        "right-to-left": -xy[:, 0],
    }[readout]


class Fisheye(tuple):
    """Coefficients k1 k2 k3 k4 of a fisheye, where else those of the pinhole lens model stand."""


def lens_of(dist):
    """The lens model that coefficients belong to."""
    return "fisheye" if isinstance(dist, Fisheye) else "pinhole"


def make_camera(width, height, K, dist=(), readout="top-to-bottom"):
    """A camera of the lens model that its coefficients belong to."""
    return Camera(width, height, K, dist, readout, lens_of(dist))


def lens(dist, xy):
    """OpenCV's lens on normalised coordinates (n, 2)."""
    if isinstance(dist, Fisheye):
        return cv2.fisheye.distortPoints(xy[:, None], np.eye(3), np.array(dist or np.zeros(4)))[:, 0]
    rays = np.column_stack([xy, np.ones(len(xy))])
    coefficients = np.asarray(dist, float) if len(dist) else None
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), coefficients)[0][:, 0]


def undistort_with_opencv(pixels, K, dist, R=None, P=None):
    """`cv2.undistortPoints` of pixels (n, 2), iterated to the end; the two majors of OpenCV name it differently."""
    tight = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    R, P = np.eye(3) if R is None else R, np.eye(3) if P is None else P
    if isinstance(dist, Fisheye):
        return cv2.fisheye.undistortPoints(pixels[:, None], K, np.array(dist), R=R, P=P, criteria=tight)[:, 0]
    dist = np.array(dist, float) if len(dist) else None
    if hasattr(cv2, "undistortPointsIter"):
        return cv2.undistortPointsIter(pixels[:, None], K, dist, R, P, tight)[:, 0]
    return cv2.undistortPoints(pixels[:, None], K, dist, R=R, P=P, criteria=tight)[:, 0]


def two_step(xy, phi, readout):
    """Paper Eqs. 8-9; for columns the same with x and y exchanged, written out."""
    x, y = xy.T
    p1, p2, p3 = phi if readout in ("top-to-bottom", "left-to-right") else -np.asarray(phi)
    if readout in ("top-to-bottom", "bottom-to-top"):
        x2, y2 = x - p3 * y**2, y + p3 * x * y
        return np.column_stack([x2 + p2 * y2, (1 - p1) * y2])
    # dx = p2 x - p3 x y and dy = -p1 x + p3 x^2 are what the rotation does to first order
    x2, y2 = x - p3 * x * y, y + p3 * x**2
    return np.column_stack([(1 + p2) * x2, y2 - p1 * x2])


def linearized(xy, phi, readout):
    """Paper Eq. 5: the pixel at (I + t [phi]x) x', whose own clock is t; bisection on t."""
    rays = np.column_stack([xy, np.ones(len(xy))])

    def turned(t):
        q = rays + t[:, None] * np.cross(phi, rays)
        return q[:, :2] / q[:, 2:]

    low, high = clock(readout, xy) - 0.5, clock(readout, xy) + 0.5
    assert (clock(readout, turned(low)) > low).all()
    assert (clock(readout, turned(high)) < high).all()
    for _ in range(60):
        middle = (low + high) / 2
        late = clock(readout, turned(middle)) > middle
        low, high = np.where(late, middle, low), np.where(late, high, middle)
    return turned((low + high) / 2)


def exact(points_c, phi, velocity_c, dist, readout):
    """Paper Eq. 2 by the generator of measurements; in units of a camera with K = 1."""
    unit = Camera(1, 1, np.eye(3), dist, readout, lens_of(dist))
    return project_rows(points_c, np.eye(3), np.zeros(3), RowMotion(phi, velocity_c), unit)[0]


def project_normalised(points_c, phi, model, readout, dist=(), velocity_c=(0, 0, 0)):
    """Distorted normalised coordinates (n, 2) where a rolling-shutter photo shows camera-frame points."""
    points_c = np.asarray(points_c, float)
    if model == "rotation":
        return exact(points_c, phi, (0, 0, 0), dist, readout)
    if model == "constant-motion":
        return exact(points_c, phi, velocity_c, dist, readout)
    xy = points_c[:, :2] / points_c[:, 2:]
    if model == "two-step":
        xy = two_step(xy, phi, readout)
    elif model == "linearized":
        xy = linearized(xy, phi, readout)
    return lens(dist, xy)


def project(points_w, R_cw, center_w, phi, model, readout, K, dist=(), velocity_w=(0, 0, 0)):
    """Pixels (n, 2) of world points."""
    velocity_c = R_cw @ np.asarray(velocity_w, float)
    normalised = project_normalised((points_w - center_w) @ R_cw.T, phi, model, readout, dist, velocity_c)
    return normalised * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]


def measure(points_w, R_cw, center_w, motions, cameras, frame_idx, point_idx):
    """Exact pixels (o, 2) of points (n, 3) that photos are known to see, by the exact model."""
    exact = np.empty((len(frame_idx), 2))
    for i, view in enumerate(zip(R_cw, center_w, motions, cameras, strict=True)):
        mine = np.flatnonzero(frame_idx == i)
        exact[mine], valid = project_rows(points_w[point_idx[mine]], *view)
        assert valid.all(), f"photo {i} cannot see all of its points"
    return exact
