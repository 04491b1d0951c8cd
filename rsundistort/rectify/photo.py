"""Rectifying a photo strip by strip."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .._kernels import maps as kernels
from ..errors import InputError
from ..model import AtInfinity, Camera, Depth, DepthMap, RowMotion, check_shutter_model
from ..model.array_types import Array
from ..model.checks import check_kind, check_one_of, check_whole
from ..model.depth import check_depth
from ..model.projection import motion_of
from .coarse_grid import coarse_grid
from .maps import check_rectified, fill_rows, rectified_rays, seen_by
from .pixel_depths import DepthRows

__all__ = ["INTERPOLATIONS", "MAX_SIDE", "rectify"]

#: Interpolations of `rectify` by name.
INTERPOLATIONS: dict[str, int] = {
    "nearest": cv2.INTER_NEAREST,
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos": cv2.INTER_LANCZOS4,
}

# So few pixels OpenCV remaps on the thread that asks, whatever `cv2.setNumThreads` says; the map stays in the cache.
_STRIP_PIXELS = 1 << 16
# Raw pixels from one rectified pixel to the next, up to which single samples do.
_MAX_STEP = 1.25
#: Largest side in pixels, since cv2.remap counts in 16 bits.
MAX_SIDE = 32766


def check_photo(photo: NDArray[Any], width: int, height: int) -> NDArray[Any]:
    """The photo, refused if it is of a kind that cannot be remapped or of another size."""
    check_kind(photo, np.ndarray, "photo")
    if photo.dtype not in (np.uint8, np.uint16, np.float32) or photo.ndim not in (2, 3):
        raise InputError(f"photo is {photo.dtype} {photo.shape}, expected uint8, uint16 or float32 (h, w[, channels])")
    if photo.shape[:2] != (height, width):
        raise InputError(f"photo has {photo.shape[1]}x{photo.shape[0]} pixels, its camera {width}x{height}")
    if not photo.size:
        raise InputError(f"photo is {photo.dtype} {photo.shape}, which holds nothing")
    if max(photo.shape[:2]) > MAX_SIDE:
        raise InputError(f"photo has {width}x{height} pixels, and OpenCV rectifies sides up to {MAX_SIDE}")
    return photo


def check_interpolation(name: str) -> int:
    """OpenCV's flag of an interpolation."""
    check_one_of(name, INTERPOLATIONS, "interpolation")
    return INTERPOLATIONS[name]


def rectify(
    photo: NDArray[Any],
    camera: Camera,
    motion: RowMotion | None = None,
    shutter_model: str = "rotation",
    new_camera: Camera | None = None,
    interpolation: str = "cubic",
    jobs: int = 1,
    mask: NDArray[np.uint8] | None = None,
    depth: Depth | None = None,
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """A photo as a global shutter without lens distortion would have taken it, and which pixels were seen.

    The grid is made and used in strips, so that no full-size float map is held.

    Parameters
    ----------
    photo : (h, w) or (h, w, channels) array
        uint8, uint16 or float32, in the stored pixel frame.
    camera, motion, shutter_model
        As in `init_rectify_map`.
    new_camera : Camera, optional
        Pinhole camera of the result (its distortion must be empty); the photo's size and K when left out.
    interpolation : {"cubic", "linear", "lanczos", "nearest"}
        Photos that get smaller are averaged over the area of each new pixel (not with nearest). OpenCV positions cubic
        and lanczos to 1/32 pixel, and linear of uint8 photos, as in `cv2.undistort`.
    jobs : int
        Threads; the result does not depend on them.
    mask : (h, w) uint8 array, optional
        0 where pixels of the photo do not count: they are rectified, but not in the mask of the result.
    depth : AtInfinity, Plane or DepthMap, optional
        As in `init_rectify_map`.

    Returns
    -------
    rectified : array
        As `photo`, of the new camera's size; 0 where nothing was seen.
    valid : (h, w) uint8 array
        255 where a raw pixel (that counts) answers, else 0: outside of the photo, and where something nearer hid what
        the pixel would show.
    """
    motion = motion_of(camera, motion)
    photo = check_photo(photo, camera.width, camera.height)
    if mask is not None:
        check_kind(mask, np.ndarray, "mask")
        if mask.dtype != np.uint8 or mask.shape != photo.shape[:2]:
            raise InputError(f"mask is {mask.dtype} {mask.shape}, expected uint8 {photo.shape[:2]}")
    check_depth(depth)
    check_shutter_model(shutter_model)
    jobs = check_whole(jobs, "jobs", 1)
    flag = check_interpolation(interpolation)
    target = camera.pinhole() if new_camera is None else check_rectified(new_camera)
    if max(target.width, target.height) > MAX_SIDE:
        raise InputError(f"new_camera has {target.width}x{target.height} pixels, OpenCV fills sides up to {MAX_SIDE}")
    rays = rectified_rays(target.K, None, camera)
    size = (target.width, target.height)

    def fill(factor: int) -> FillRows:
        # of a photo of so many times the pixels, whose corner is the same
        finer = np.array([[1, 0, 0.5 - 0.5 * factor], [0, 1, 0.5 - 0.5 * factor], [0, 0, factor]]) / factor
        finer_size = (factor * size[0], factor * size[1])
        at = replace(depth, size=finer_size) if isinstance(depth, DepthMap) and depth.size == size else depth
        return _fill_rows(camera, motion, shutter_model, rays @ finer, finer_size, at or AtInfinity())

    samples = 1 if flag == cv2.INTER_NEAREST else _samples(camera, target)
    return remap_strips(photo, fill(1), size, flag, jobs, mask, samples, fill(samples) if samples > 1 else None)


def _fixed_point(map_x: NDArray[np.float32], map_y: NDArray[np.float32]) -> tuple[NDArray[Any], NDArray[Any]]:
    """OpenCV's CV_16SC2 map."""
    xy, fraction = np.empty((*map_x.shape, 2), np.int16), np.empty(map_x.shape, np.uint16)
    kernels.fixed_point(map_x, map_y, xy.view(np.int32)[..., 0], fraction)
    return xy, fraction


def _samples(camera: Camera, target: Camera) -> int:
    """Samples across a rectified pixel: as many as it covers raw pixels, going by the focal lengths."""
    shrink = max(float(camera.K[k, k] / target.K[k, k]) for k in (0, 1))
    return 1 if shrink <= _MAX_STEP else max(1, min(math.ceil(shrink), MAX_SIDE // target.width))


#: Fills rows of a map, from a first one on, and of the mask of what is seen; says whether all of it is.
FillRows = Callable[[int, NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]], bool]


def _fill_rows(
    camera: Camera, motion: RowMotion, shutter_model: str, rays: Array, size: tuple[int, int], depth: Depth
) -> FillRows:
    """What fills the rows of the map of a photo of `size`: interpolated, but exact where depths make it rough."""
    depth_rows = DepthRows(depth, camera, motion, rays, size)
    if not depth_rows.matters(shutter_model):
        return coarse_grid(camera, motion, shutter_model, rays, size).fill

    def fill(row0: int, map_x: NDArray[np.float32], map_y: NDArray[np.float32], seen: NDArray[np.uint8]) -> bool:
        fill_rows(camera, motion, shutter_model, rays, row0, map_x, map_y, depth_rows)
        seen[:] = seen_by(map_x, map_y, camera.width, camera.height)
        return bool(seen.all())

    return fill


def remap_strips(
    photo: NDArray[Any],
    fill: FillRows,
    size: tuple[int, int],
    flag: int,
    jobs: int,
    mask: NDArray[np.uint8] | None = None,
    samples: int = 1,
    fill_samples: FillRows | None = None,
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """A photo through a map of `size` that is made strip by strip, and its mask; see `rectify`.

    With `samples` a pixel is the mean of samples x samples points, whose map `fill_samples` makes.
    """
    if photo.ndim == 3 and photo.shape[2] not in (1, 3, 4):
        # OpenCV moves pixels of other numbers of channels less exactly, those of some not at all
        alone = [
            remap_strips(np.ascontiguousarray(photo[..., k]), fill, size, flag, jobs, mask, samples, fill_samples)
            for k in range(photo.shape[2])
        ]
        return np.dstack([values for values, _ in alone]), alone[0][1]
    width, height = size
    rectified = np.empty((height, width, *photo.shape[2:]), photo.dtype)
    valid = np.empty((height, width), np.uint8)
    # OpenCV 5 is exact with float maps, and takes half as long again
    fixed = photo.dtype == np.uint8 and flag == cv2.INTER_LINEAR
    strip_rows = max(1, _STRIP_PIXELS // (width * samples**2))

    def interpolate(map_x: NDArray[np.float32], map_y: NDArray[np.float32], values: NDArray[Any]) -> None:
        map1, map2 = _fixed_point(map_x, map_y) if fixed else (map_x, map_y)
        # taps beyond the border repeat it, so that seen pixels at the edge keep their brightness
        cv2.remap(photo, map1, map2, flag, dst=values, borderMode=cv2.BORDER_REPLICATE)

    def strip(row0: int) -> None:
        rows = slice(row0, min(row0 + strip_rows, height))
        map_x = np.empty((rows.stop - row0, width), np.float32)
        map_y = np.empty_like(map_x)
        values, seen = rectified[rows], valid[rows]
        all_seen = fill(row0, map_x, map_y, seen)
        if fill_samples is None:
            interpolate(map_x, map_y, values)
        else:
            fine_x = np.empty((samples * len(map_x), samples * width), np.float32)
            fine_y, fine_seen = np.empty_like(fine_x), np.empty(fine_x.shape, np.uint8)
            fine = np.empty((*fine_x.shape, *photo.shape[2:]), photo.dtype)
            if not fill_samples(samples * row0, fine_x, fine_y, fine_seen) and fine_x.min() < -1e5:
                nowhere = (fine_x < -1e5).reshape(len(map_x), samples, width, samples).any((1, 3))
                seen[nowhere] = 0
                all_seen = False
            interpolate(fine_x, fine_y, fine)
            cv2.resize(fine, (width, len(map_x)), dst=values, interpolation=cv2.INTER_AREA)
        if not all_seen:
            kernels.clear_unseen(seen, values.reshape(*seen.shape, -1).view(np.uint8))
        if mask is not None:
            counts = cv2.remap(mask, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
            seen[counts == 0] = 0

    starts = range(0, height, strip_rows)
    if jobs == 1:
        for row0 in starts:
            strip(row0)
    else:
        with ThreadPoolExecutor(jobs) as pool:
            list(pool.map(strip, starts))
    return rectified, valid
