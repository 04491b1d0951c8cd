"""Depth maps of users."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FormatError, InputError
from ..model.arrays import read_arrays
from .masks import check_one_photo_each, find_masks
from .photos.images import read_plain

__all__ = ["find_depth_maps", "read_depth_map"]

_SUFFIXES = (".npy", ".npz", ".tif", ".tiff")


def find_depth_maps(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Depth maps of photos, found as `find_masks` does: `a.tif` or `a.jpg.npy` for `a.jpg`, in the same sub-folder.

    Parameters
    ----------
    folder : Path
        Of NumPy arrays (.npy, .npz) or float TIFFs. A photo need not have one.

    Raises
    ------
    FileError, InputError
        When the folder is missing, no map in it is of one of the photos, a photo has several, or two photos share one.
    """
    found = find_masks(folder, names, "depth map", _SUFFIXES)
    check_one_photo_each(found, "depth map")
    return found


def read_depth_map(path: Path) -> NDArray[np.float32]:
    """A depth map (h, w) as it is in its file.

    Raises
    ------
    FileError, InputError
        When it cannot be read, or is no map of numbers.
    """
    if path.suffix.lower() in (".npy", ".npz"):
        try:
            arrays = read_arrays(path)
        except (FileError, FormatError) as error:
            raise FileError(f"depth map {error}") from error
        if len(arrays) != 1 and "depth" not in arrays:
            raise InputError(f"{path} holds several arrays, none of them named depth")
        loaded = arrays["depth"] if "depth" in arrays else next(iter(arrays.values()))
    else:
        loaded = read_plain(path, "depth map", cv2.IMREAD_UNCHANGED)
    if loaded.ndim != 2 or loaded.dtype.kind not in "fiu":
        raise InputError(f"depth map {path} is {loaded.dtype} {loaded.shape}, expected one number per pixel")
    return np.asarray(loaded, np.float32)
