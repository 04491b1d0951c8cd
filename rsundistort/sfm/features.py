"""SIFT features of a photo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Features", "detect_features", "detection_bytes", "size_sigma"]

# Residuals by size of the feature, in the adjusted herz-jesus-8: 0.117 px below 2.3 px, 0.122 to 3.5, 0.143 to 7,
# 0.264 above; and large blobs are biased by perspective besides.
_COARSE_PX = 3.0
# What OpenCV's SIFT holds for each pixel (measured), and what it gets to see of larger photos: 6 GB.
_BYTES_PER_PIXEL, _MOST_PIXELS = 245, 25_000_000


@dataclass(frozen=True)
class Features:
    """Keypoints of one photo, the strongest first.

    Attributes
    ----------
    xy_raw : (n, 2) float64 array
        Pixels of the stored photo, integer centres.
    sigma : (n,) float64 array
        Standard deviation of the position relative to the finest features.
    descriptors : (n, 128) uint8 array
        RootSIFT, scaled by 512 as COLMAP stores it.
    """

    xy_raw: NDArray[np.float64]
    sigma: NDArray[np.float64]
    descriptors: NDArray[np.uint8]


def size_sigma(size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviations of the positions of features of these diameters, relative to the finest ones."""
    return np.asarray(np.hypot(1.0, size / _COARSE_PX))


def detect_features(
    photo: NDArray[Any], max_features: int = 16384, mask: NDArray[np.uint8] | None = None
) -> Features:  # fmt: skip
    """The strongest SIFT features of a photo; photos of more than 25 megapixels are shrunk to that before.

    Parameters
    ----------
    photo : (h, w) or (h, w, 3 | 4) array
        8-bit, 16-bit or float (0 to 1) pixels in OpenCV's channel order.
    max_features : int
        Keep this many, the strongest first.
    mask : (h, w) uint8 array, optional
        No features where it is 0.
    """
    # the upscaled first octave is off by a quarter of a pixel unless it is asked to be precise (measured on blobs)
    sift = cv2.SIFT.create(
        nfeatures=max_features, nOctaveLayers=3, contrastThreshold=0.02, edgeThreshold=10, sigma=1.6,
        enable_precise_upscale=True,
    )  # fmt: skip
    gray = _gray_u8(photo)
    shrink = math.sqrt(max(1.0, gray.size / _MOST_PIXELS))
    if shrink > 1.0:
        gray, mask = _shrunk(gray, mask, shrink)
    keypoints, raw = sift.detectAndCompute(gray, mask)
    if not keypoints:
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))
    xy = np.asarray(cv2.KeyPoint.convert(keypoints), np.float64)
    response, angle, size = np.array([(k.response, k.angle, k.size) for k in keypoints]).T
    # ties by place: the order in which OpenCV's threads found them must not matter
    order = np.lexsort((angle, xy[:, 0], xy[:, 1], -response))[:max_features]
    xy, raw, size = xy[order], raw[order], size[order]
    root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-12))
    descriptors = np.clip(np.rint(512.0 * root), 0, 255).astype(np.uint8)
    step = np.array(photo.shape[1::-1]) / gray.shape[::-1]
    return Features(step * (xy + 0.5) - 0.5, shrink * size_sigma(size), descriptors)


def detection_bytes(width: int, height: int) -> float:
    """What `detect_features` takes for a photo of this size, about."""
    return float(_BYTES_PER_PIXEL * min(width * height, _MOST_PIXELS))


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


def _gray_u8(photo: NDArray[Any]) -> NDArray[np.uint8]:
    """8-bit grey version of a photo of any depth and number of channels."""
    gray = photo
    if photo.ndim == 3:
        gray = cv2.cvtColor(photo, cv2.COLOR_BGRA2GRAY if photo.shape[2] == 4 else cv2.COLOR_BGR2GRAY)
    if gray.dtype == np.uint16:
        return (gray >> 8).astype(np.uint8)
    if gray.dtype != np.uint8:
        return np.clip(np.nan_to_num(gray) * 255.0, 0, 255).astype(np.uint8)
    return gray
