"""Photos of a plane of grey noise."""

from __future__ import annotations

import cv2
import numpy as np

SIZE = 960, 720
CAMERA = "1000,1000,479.5,359.5"


def texture(seed, coarseness=2.0):
    """Grey noise of blobs of one size, larger than a photo."""
    noise = np.random.default_rng(seed).normal(size=(SIZE[1] + 200, SIZE[0] + 200))
    smooth = cv2.GaussianBlur(noise, (0, 0), coarseness)
    return np.clip(128 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def write(folder, photos):
    folder.mkdir()
    for number, photo in enumerate(photos):
        cv2.imwrite(str(folder / f"{number}.png"), photo)
    return folder


def views(of, count=3, shift=40):
    """Photos of a plane, each shifted against the one before."""
    return [of[k * shift : k * shift + SIZE[1], k * shift : k * shift + SIZE[0]] for k in range(count)]
