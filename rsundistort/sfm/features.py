"""SIFT features of a photo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Features", "detect_features", "size_sigma"]

# Residuals by size of the feature, in the adjusted herz-jesus-8: 0.117 px below 2.3 px, 0.122 to 3.5, 0.143 to 7,
# 0.264 above; and large blobs are biased by perspective besides.
_COARSE_PX = 3.0


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
    """The strongest SIFT features of a photo.

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
    keypoints, raw = sift.detectAndCompute(_gray_u8(photo), mask)
    if not keypoints:
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.uint8))
    xy = np.asarray(cv2.KeyPoint.convert(keypoints), np.float64)
    response, angle, size = np.array([(k.response, k.angle, k.size) for k in keypoints]).T
    # ties by place: the order in which OpenCV's threads found them must not matter
    order = np.lexsort((angle, xy[:, 0], xy[:, 1], -response))[:max_features]
    xy, raw, size = xy[order], raw[order], size[order]
    root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-12))
    descriptors = np.clip(np.rint(512.0 * root), 0, 255).astype(np.uint8)
    return Features(xy, size_sigma(size), descriptors)


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
