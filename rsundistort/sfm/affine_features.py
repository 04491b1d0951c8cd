"""SIFT features whose descriptors stay the same where a strong shutter shears the photos.

A descriptor is of the shape that the surroundings of its feature have (Mikolajczyk and Schmid, "Scale and affine
invariant interest point detectors", IJCV 2004), and of several sizes together (Dong and Soatto, "Domain-size pooling in
local descriptors: DSP-SIFT", CVPR 2015). It takes six times as long as one of a circle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..colmap.conventions import quiet_pycolmap
from .features import Features, ReducedPhoto, features_of

__all__ = ["detect_affine_features"]


def detect_affine_features(
    photos: Sequence[ReducedPhoto], max_features: int, num_threads: int, folder: Path
) -> Iterator[Features]:
    """The largest features of photos, by pycolmap.

    Parameters
    ----------
    max_features : int
        As in `detect_features`.
    num_threads : int
        How many photos are worked on at once.
    folder : path
        Where they are written for that; it is empty.
    """
    pycolmap = quiet_pycolmap()
    database, images = folder / "features.db", folder / "images"
    images.mkdir()
    names = [f"{k}.png" for k in range(len(photos))]
    for name, photo in zip(names, photos, strict=True):
        cv2.imwrite(str(images / name), photo.gray)
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, num_threads
    options.max_image_size = max(side for photo in photos for side in photo.gray.shape)
    options.sift.estimate_affine_shape = options.sift.domain_size_pooling = True
    # of no enlarged photo: as many matches of dslr, in 0.65 of the time
    options.sift.first_octave = 0
    # masks leave some out
    most = max_features if all(photo.mask is None for photo in photos) else max(photo.gray.size for photo in photos)
    options.sift.max_num_features = most
    pycolmap.extract_features(database, images, extraction_options=options, device=pycolmap.Device.cpu)
    with pycolmap.Database.open(database) as db:
        image_ids = {image.name: image.image_id for image in db.read_all_images()}
        for name, photo in zip(names, photos, strict=True):
            image_id = image_ids[name]
            yield _largest(photo, db.read_keypoints(image_id), db.read_descriptors(image_id), max_features)


def _largest(photo: ReducedPhoto, keypoints: Any, descriptors: Any, max_features: int) -> Features:
    """The largest of pycolmap's features that a mask leaves; the diameter is that of a circle of the same area."""
    found = np.asarray(keypoints, np.float64).reshape(-1, 6)
    x, y, a11, a12, a21, a22 = found.T
    size = 2.0 * np.sqrt(np.abs(a11 * a22 - a12 * a21))
    order = np.lexsort((a12, a11, x, y, -size))
    if photo.mask is not None:
        height, width = photo.mask.shape
        row, column = np.clip(y.astype(int), 0, height - 1), np.clip(x.astype(int), 0, width - 1)
        order = order[photo.mask[row, column][order] != 0]
    order = order[:max_features]
    # the middle of the first pixel is (0.5, 0.5) there
    return features_of(photo, found[order, :2] - 0.5, size[order], np.asarray(descriptors.data, np.uint8)[order])
