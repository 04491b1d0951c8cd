"""Depth maps of users."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError

__all__ = ["find_depth_maps", "read_depth_map"]

_SUFFIXES = (".npy", ".npz", ".tif", ".tiff")


def find_depth_maps(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Depth maps of photos: files of the same stem (`a.tif` for `a.jpg`), or of the whole name (`a.jpg.npy`).

    Parameters
    ----------
    folder : Path
        Of NumPy arrays (.npy, .npz) or float TIFFs. A photo need not have one.
    names : sequence of str
        Photos.

    Raises
    ------
    FileError, InputError
        When the folder is missing, or no map in it is of one of the photos.
    """
    if not folder.is_dir():
        raise FileError(f"{folder} is no folder; give the folder that holds the depth maps")
    by_stem = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix.lower() in _SUFFIXES}
    found = {name: by_stem.get(name) or by_stem.get(Path(name).stem) for name in names}
    maps = {name: path for name, path in found.items() if path is not None}
    if not maps:
        raise InputError(
            f"{folder} holds no depth map of any photo; it should hold {Path(names[0]).stem}.npy and so on"
        )
    return maps


def read_depth_map(path: Path) -> NDArray[np.float32]:
    """A depth map (h, w) as it is in its file.

    Raises
    ------
    FileError, InputError
        When it cannot be read, or is no map of numbers.
    """
    try:
        if path.suffix.lower() in (".npy", ".npz"):
            loaded = np.load(path, allow_pickle=False)
            if path.suffix.lower() == ".npz":
                if len(loaded.files) != 1 and "depth" not in loaded.files:
                    raise InputError(f"{path} holds several arrays, none of them named depth")
                loaded = loaded["depth" if "depth" in loaded.files else loaded.files[0]]
        else:
            loaded = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    except InputError:
        raise
    except OSError as error:
        raise FileError(f"depth map {path} cannot be read: {error.strerror or error}") from error
    except (ValueError, EOFError, KeyError, cv2.error) as error:
        raise FileError(f"depth map {path} cannot be decoded: {' '.join(str(error).split())[:100]}") from error
    if loaded is None or np.ndim(loaded) != 2 or loaded.dtype.kind not in "fiu":
        got = "no picture" if loaded is None else f"{loaded.dtype} {loaded.shape}"
        raise InputError(f"depth map {path} is {got}, expected one number per pixel")
    return np.asarray(loaded, np.float32)
