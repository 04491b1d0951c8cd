"""SIFT features of a photo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["Features", "detect_features"]


@dataclass(frozen=True)
class Features:
    """Keypoints of one photo.

    Attributes
    ----------
    xy_raw : (n, 2) float64 array
        Pixels of the stored photo, integer centres.
    descriptors : (n, 128) uint8 array
        RootSIFT, scaled by 512 as COLMAP stores it.
    """

    xy_raw: NDArray[np.float64]
    descriptors: NDArray[np.uint8]


def detect_features(photo: NDArray[Any], max_features: int = 8192) -> Features:
    """The strongest SIFT features of a photo.

    Parameters
    ----------
    photo : (h, w) or (h, w, 3 | 4) array
        8-bit, 16-bit or float (0 to 1) pixels in OpenCV's channel order.
    max_features : int
        Keep this many, the strongest first.
    """
    # the upscaled first octave is off by a quarter of a pixel unless it is asked to be precise (measured on blobs)
    sift = cv2.SIFT_create(
        nfeatures=max_features, nOctaveLayers=3, contrastThreshold=0.02, edgeThreshold=10, sigma=1.6,
        enable_precise_upscale=True,
    )  # fmt: skip
    keypoints, raw = sift.detectAndCompute(_gray_u8(photo), None)
    if not keypoints:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8))
    xy = np.array([k.pt for k in keypoints], np.float64)
    # order by place, not by response: where OpenCV breaks ties must not matter
    order = np.lexsort((np.array([k.angle for k in keypoints]), xy[:, 0], xy[:, 1]))[:max_features]
    root = np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-12))
    return Features(xy[order], np.clip(np.rint(512.0 * root), 0, 255).astype(np.uint8)[order])


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
