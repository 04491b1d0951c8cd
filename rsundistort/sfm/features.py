"""SIFT features of a photo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..model.array_types import Array, Index
from ..model.brightness import white_level

__all__ = [
    "DETECTION_MEGAPIXELS",
    "SIFT_PX",
    "Features",
    "ReducedPhoto",
    "detect_features",
    "detection_bytes",
    "features_of",
    "features_of_both",
    "grey_8_bit",
    "reduce_photo",
    "size_of_sigma",
    "size_sigma",
]

#: Default size in megapixels at which features are detected.
DETECTION_MEGAPIXELS = 1.0

#: Standard deviation of the position of the finest features, whose relative one is 1, in pixels.
SIFT_PX = 0.12

# Residuals by size of the feature, in the adjusted herz-jesus-8: 0.117 px below 2.3 px, 0.122 to 3.5, 0.143 to 7,
# 0.264 above; and large blobs are biased by perspective besides.
_COARSE_PX = 3.0
# A photo full of texture shows a feature for about so many pixels (herz-jesus-8: 82 to 97).
_PIXELS_PER_FEATURE = 80
# With fewer than one feature for so many pixels a photo is searched again, as if its contrast filled the range: these
# percentiles of its pixels, but for a tenth of it at least, where noise is all that there is.
_FEW_FEATURES, _CONTRAST, _LEAST_CONTRAST = 2000, (1.0, 99.0), 0.1
# What OpenCV's SIFT holds for each pixel (measured).
_BYTES_PER_PIXEL = 245


@dataclass(frozen=True)
class Features:
    """Keypoints of one photo, the largest first.

    Attributes
    ----------
    xy_raw : (n, 2) float64 array
        Pixels of the stored photo, integer centres.
    sigma : (n,) float64 array
        Standard deviation of the position relative to the finest features.
    descriptors : (n, 128) uint8 array
        RootSIFT, scaled by 512 as COLMAP stores it.
    step_px : float
        Pixels of the stored photo per pixel of the image that the features were detected in: the unit of their errors.
    kind : (n,) uint8 array, optional
        Descriptors of different kinds are not compared; by default all are of the kind 0.
    """

    xy_raw: Array
    sigma: Array
    descriptors: NDArray[np.uint8]
    step_px: float = 1.0
    kind: NDArray[np.uint8] | None = None

    def largest(self, count: int) -> Features:
        """The largest of them, of this number."""
        return self.take(np.arange(min(count, len(self.xy_raw))))

    def take(self, indices: Index) -> Features:
        """Some of them."""
        kind = None if self.kind is None else self.kind[indices]
        return Features(self.xy_raw[indices], self.sigma[indices], self.descriptors[indices], self.step_px, kind)

    def of_kind(self, kind: int) -> Index:
        """Indices of those of a kind."""
        kinds = np.zeros(len(self.xy_raw), np.uint8) if self.kind is None else self.kind
        return np.flatnonzero(kinds == kind)


@dataclass(frozen=True)
class ReducedPhoto:
    """What features are detected in.

    Attributes
    ----------
    gray : (h, w) uint8 array
        Of 8 bits, averaged over areas.
    mask : (h, w) uint8 array or None
        No features where it is 0.
    size : (width, height) of the photo
    step_px : float
        As of `Features`.
    """

    gray: NDArray[np.uint8]
    mask: NDArray[np.uint8] | None
    size: tuple[int, int]
    step_px: float


def size_sigma(size: Array) -> Array:
    """Standard deviations of the positions of features of these diameters, relative to the finest ones."""
    return np.asarray(np.hypot(1.0, size / _COARSE_PX))


def size_of_sigma(sigma: Array, step_px: Array) -> Array:
    """Diameters of features in pixels of the photo, from `Features.sigma` and `Features.step_px`."""
    return np.asarray(_COARSE_PX * np.sqrt(np.maximum(sigma**2 - step_px**2, (0.5 * step_px) ** 2)))


def detect_features(
    photo: NDArray[Any],
    max_features: int = 8192,
    mask: NDArray[np.uint8] | None = None,
    megapixels: float = DETECTION_MEGAPIXELS,
) -> Features:
    """The largest SIFT features of a photo.

    The strongest responses of a large photo are its smallest blobs (leaves, grains), which no other photo shows again:
    of equally many, the largest give three to twenty times the verified matches at 9 megapixels.

    Parameters
    ----------
    photo : (h, w) or (h, w, 3 | 4) array
        8-bit, 16-bit or float pixels in OpenCV's channel order, of which `white_level` is white.
    max_features : int
        Number that is kept, the largest first; features with several orientations count several times.
    mask : (h, w) uint8 array, optional
        No features where it is 0.
    megapixels : float
        Larger photos are reduced to this size.
    """
    reduced = reduce_photo(photo, mask, megapixels)
    gray = reduced.gray
    # descriptors that are not kept cost more than a second pyramid, except where few are left out
    at_once = gray.size < _PIXELS_PER_FEATURE * max_features
    sift = _sift(1.0)
    keypoints, raw = sift.detectAndCompute(gray, reduced.mask) if at_once else (sift.detect(gray, reduced.mask), None)
    shown = gray.size if reduced.mask is None else np.count_nonzero(reduced.mask)
    if _FEW_FEATURES * len(keypoints) < shown:
        range_of = np.diff(np.percentile(gray, _CONTRAST))[0] / 255
        sift = _sift(float(np.clip(range_of, _LEAST_CONTRAST, 1.0)))
        keypoints, raw = sift.detectAndCompute(gray, reduced.mask)
    if not keypoints:
        return features_of(reduced, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))
    x, y, size, angle, response = np.array([(*k.pt, k.size, k.angle, k.response) for k in keypoints]).T
    # ties by strength and place: the result must not depend on the order of OpenCV's threads
    order = np.lexsort((angle, x, y, -response, -size))[:max_features]
    kept: Sequence[cv2.KeyPoint] = [keypoints[k] for k in order]
    if raw is None:
        kept, raw = sift.compute(gray, kept)
    else:
        raw = raw[order]
    root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-12))
    descriptors = np.clip(np.rint(512.0 * root), 0, 255).astype(np.uint8)
    xy, size = np.asarray(cv2.KeyPoint.convert(kept), np.float64), np.array([k.size for k in kept])
    return features_of(reduced, xy, size, descriptors)


def _sift(contrast: float) -> Any:
    """OpenCV's detector, for photos whose contrast is this share of the range."""
    # the upscaled first octave is off by a quarter of a pixel without the precise option (measured on blobs)
    return cv2.SIFT.create(
        nfeatures=0, nOctaveLayers=3, contrastThreshold=0.02 * contrast, edgeThreshold=10, sigma=1.6,
        enable_precise_upscale=True,
    )  # fmt: skip


def reduce_photo(
    photo: NDArray[Any], mask: NDArray[np.uint8] | None = None, megapixels: float = DETECTION_MEGAPIXELS
) -> ReducedPhoto:
    """A photo as features are detected in it, by what `detect_features` takes."""
    gray, size = grey_8_bit(photo), (photo.shape[1], photo.shape[0])
    # the factor by which the sides are divided
    shrink = math.sqrt(max(1.0, gray.size / (1e6 * megapixels)))
    if shrink > 1.0:
        gray, mask = _shrunk(gray, mask, shrink)
    return ReducedPhoto(gray, mask, size, shrink)


def features_of(reduced: ReducedPhoto, xy: Array, size: Array, descriptors: NDArray[np.uint8]) -> Features:
    """Features at places (n, 2) of a reduced photo, integer centres, and of these diameters (n,) there."""
    step = np.array(reduced.size) / reduced.gray.shape[::-1]
    return Features(step * (xy + 0.5) - 0.5, reduced.step_px * size_sigma(size), descriptors, reduced.step_px)


def features_of_both(one: Features, other: Features) -> Features:
    """Features of two kinds, detected in the same photo at the same size."""
    sigma = np.concatenate([one.sigma, other.sigma])
    order = np.argsort(-sigma, kind="stable")
    return Features(
        np.concatenate([one.xy_raw, other.xy_raw])[order],
        sigma[order],
        np.concatenate([one.descriptors, other.descriptors])[order],
        one.step_px,
        np.repeat(np.array([0, 1], np.uint8), [len(one.sigma), len(other.sigma)])[order],
    )


def detection_bytes(width: int, height: int, megapixels: float = DETECTION_MEGAPIXELS) -> float:
    """Memory that the detection of features takes for a photo of this size, besides the photo."""
    return float(_BYTES_PER_PIXEL * min(width * height, 1e6 * megapixels))


def _shrunk(
    gray: NDArray[np.uint8], mask: NDArray[np.uint8] | None, shrink: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """A photo averaged over areas, and its mask: 0 wherever one of the pixels is."""
    height, width = (max(1, int(length / shrink)) for length in gray.shape)

    def resize(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)

    if mask is None:
        return resize(gray), None
    everywhere = resize(np.where(mask == 0, np.uint8(0), np.uint8(255))) == 255
    return resize(gray), np.where(everywhere, np.uint8(255), np.uint8(0))


def grey_8_bit(photo: NDArray[Any]) -> NDArray[np.uint8]:
    """8-bit grey version of a photo of any depth and number of channels, in which its `white_level` is white."""
    gray = photo
    if photo.ndim == 3:
        gray = cv2.cvtColor(photo, cv2.COLOR_BGRA2GRAY if photo.shape[2] == 4 else cv2.COLOR_BGR2GRAY)
    if gray.dtype == np.uint8:
        return gray
    white = white_level(photo)
    if gray.dtype == np.uint16:
        return np.minimum(gray >> (int(white).bit_length() - 8), 255).astype(np.uint8)
    return np.clip(np.nan_to_num(gray) * (255.0 / white), 0, 255).astype(np.uint8)
