"""Real photos as if a rotating camera had taken them.

The truth of the round trip: plain NumPy and SciPy, closed form per row, and no function of the kernels it judges.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..model import Camera, RowMotion
from ..model.array_types import Array, Mask
from .lens import clock_at, distort_rays, undistort_to_rays

__all__ = ["crop_camera", "largest_rectangle", "random_phi", "warp_mask", "warp_photo"]

# Pixels whose rays are held at a time: of 12 megapixels at once they take 7 GB.
_TOGETHER = 500_000


def random_phi(
    names: Sequence[str], frame_spans: Sequence[float], sigma_rad: float, seed: int, still: Iterable[str] = ()
) -> dict[str, Array]:
    """Random shutter rotations as in the paper's Experiment I: axis uniform, angle over the frame normal.

    Parameters
    ----------
    names, frame_spans : sequences of length m
        Photos, and `Camera.frame_span` of each.
    sigma_rad : float
        Standard deviation of the angle over the whole frame.
    seed : int
        The same seed gives the same motions; a still photo does not change the others.
    still : names
        Photos that do not move.

    Returns
    -------
    dict of (3,) array
        Radians per unit of the clock.
    """
    still = set(still)
    unknown = still - set(names)
    if unknown:
        raise InputError(f"still photo {sorted(unknown)[0]!r} is not among the photos")
    if not sigma_rad >= 0:
        raise InputError(f"sigma={sigma_rad}, expected 0 or more radians per frame")
    rng = np.random.default_rng(seed)
    result = {}
    for name, span in zip(names, frame_spans, strict=True):
        axis = rng.normal(size=3)
        angle = rng.normal(0.0, sigma_rad)
        result[name] = np.zeros(3) if name in still else axis / np.linalg.norm(axis) * angle / span
    return result


def warp_photo(
    photo: NDArray[Any], camera: Camera, motion: RowMotion | ArrayLike
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """The photo that a rotating camera would have taken in place of this global-shutter one.

    A pixel of the result was read when the clock stood at its own (distorted) row, so the direction it saw is known:
    `Exp(-theta(t))` of its ray. That direction is looked up, bicubically, in the photo.

    Parameters
    ----------
    photo : (h, w) or (h, w, channels) array
        Taken without motion.
    camera : Camera
        Of the photo; its readout direction is the one simulated.
    motion : RowMotion or (3,) array
        The rotation theta of `RowMotion.at`, with its bend; or phi alone, radians per unit of the clock.

    Returns
    -------
    warped : array
        As `photo`; its border is repeated where the photo ends.
    mask : (h, w) uint8 array
        255 where the photo had the direction, else 0.
    """
    h, w = photo.shape[:2]
    if (w, h) != (camera.width, camera.height):
        raise InputError(f"photo has {w}x{h} pixels, its camera {camera.width}x{camera.height}")
    source, inside = _lookup(camera, motion)
    warped = cv2.remap(photo, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return warped.reshape(photo.shape), np.where(inside, 255, 0).astype(np.uint8)


def warp_mask(camera: Camera, motion: RowMotion | ArrayLike) -> NDArray[np.uint8]:
    """The mask that `warp_photo` gives with the photo: (h, w) uint8, 255 where the photo has the direction."""
    return np.where(_lookup(camera, motion)[1], 255, 0).astype(np.uint8)


def _lookup(camera: Camera, motion: RowMotion | ArrayLike) -> tuple[NDArray[np.float32], Mask]:
    """Pixel (h, w, 2) of the photo without motion whose direction each warped pixel saw, and whether it has it."""
    motion = motion if isinstance(motion, RowMotion) else RowMotion(np.asarray(motion, np.float64))
    w, h = camera.width, camera.height
    # one rotation a row (or column): rotate its rays by it
    R = Rotation.from_rotvec(-motion.at(clock_at(camera, np.arange(camera.num_lines)))[0]).as_matrix()
    source, inside = np.empty((h, w, 2), np.float32), np.empty((h, w), bool)
    some = max(1, _TOGETHER // w)
    for rows in (slice(top, min(top + some, h)) for top in range(0, h, some)):
        ideal = undistort_to_rays(np.dstack(np.meshgrid(np.arange(w), np.arange(h)[rows])), camera)
        rays = np.dstack([ideal, np.ones(ideal.shape[:2])])
        if camera.clock_axis == 1:
            rotated = np.einsum("vij,vuj->vui", R[rows], rays)
        else:
            rotated = np.einsum("uij,vuj->vui", R, rays)
        found = distort_rays(rotated, camera).reshape(*ideal.shape[:2], 2)
        ahead = rotated[..., 2] > 0  # not where the lens sees nothing
        inside[rows] = ahead & (found >= 0).all(-1) & (found[..., 0] <= w - 1) & (found[..., 1] <= h - 1)
        source[rows] = np.where(ahead[..., None], found, -1e6)
    return source, inside


def largest_rectangle(valid: Mask) -> tuple[int, int, int, int]:
    """The largest rectangle along the axes that holds valid pixels only.

    The maximal-rectangle problem in linear time: row by row each pixel knows how many valid pixels stand above it, and
    between which columns all of the row's runs under these reach; its rectangle is that wide and that high, and the
    largest rectangle is that of one of its pixels. Rows are handled whole, in NumPy.

    Parameters
    ----------
    valid : (h, w) bool array
        Pixels that may lie in it.

    Returns
    -------
    x, y, width, height : int
        Its upper left pixel and its size; of several the one that ends first from the top; zeros if nothing is valid.
    """
    w = valid.shape[1]
    columns = np.arange(w)
    above, left, right = np.zeros(w, int), np.zeros(w, int), np.full(w, w)
    best, found = 0, (0, 0, 0, 0)
    for y, row in enumerate(valid):
        # the run of valid pixels around each pixel of the row: its first column and the one behind its last
        first = np.maximum.accumulate(np.where(row, 0, columns + 1))
        behind = np.minimum.accumulate(np.where(row, w, columns)[::-1])[::-1]
        above = np.where(row, above + 1, 0)
        left = np.where(row, np.maximum(left, first), 0)
        right = np.where(row, np.minimum(right, behind), w)
        area = (right - left) * above
        x = int(area.argmax())
        if area[x] > best:
            best = int(area[x])
            found = (int(left[x]), y + 1 - int(above[x]), int(right[x] - left[x]), int(above[x]))
    return found


def crop_camera(camera: Camera, rectangle: tuple[int, int, int, int]) -> Camera:
    """The camera of photos cut to a rectangle (x, y, width, height) of pixels.

    The principal point moves with the corner, and the clock with it: a line keeps its moment, so that a motion per unit
    of the clock stays what it was. The span of the frame shrinks.
    """
    x, y, width, height = rectangle
    K = np.array(camera.K)
    K[:2, 2] -= x, y
    return replace(camera, width=width, height=height, K=K)
