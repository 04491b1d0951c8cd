"""How pycolmap counts pixels, holds poses and logs, against how we do: each once, here."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from ..model.array_types import Array

__all__ = ["HALF", "import_pycolmap", "kept_log_level", "poses_of", "quiet_pycolmap", "rigid_of"]

#: COLMAP's pixel centres are at 0.5, ours at 0.
HALF = 0.5

_level_lock = threading.Lock()
_level: dict[str, int] = {"users": 0, "before": 0}


@contextmanager
def kept_log_level() -> Iterator[None]:
    """Keep the log level of pycolmap: after the last of these blocks in any thread it is that before the first."""
    pycolmap = import_pycolmap()
    with _level_lock:
        if not _level["users"]:
            _level["before"] = pycolmap.logging.minloglevel
        _level["users"] += 1
    try:
        yield
    finally:
        with _level_lock:
            _level["users"] -= 1
            if not _level["users"]:
                pycolmap.logging.minloglevel = _level["before"]


def import_pycolmap() -> Any:
    """Pycolmap as it is. What its import makes of SIGTERM, the stack of its C++ code, is undone."""
    is_new = "pycolmap" not in sys.modules
    import pycolmap

    before = signal.getsignal(signal.SIGTERM)  # Python has not noticed
    if is_new and before is not None:
        with suppress(ValueError):  # signals are the main thread's
            signal.signal(signal.SIGTERM, before)
    return pycolmap


def quiet_pycolmap() -> Any:
    """Pycolmap, quiet, and imported late: it takes half a second, and cv2 must come first (see `io.photos.images`).

    For what logs; what only makes its objects imports it as it is, and leaves to users what it logs for them.
    """
    pycolmap = import_pycolmap()
    pycolmap.logging.minloglevel = 3
    return pycolmap


def poses_of(images: Sequence[Any]) -> tuple[Array, Array]:
    """Rotations R_cw (m, 3, 3) and centres (m, 3) of pycolmap's images."""
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    R_cw = poses[:, :, :3]
    return R_cw, -np.einsum("mji,mj->mi", R_cw, poses[:, :, 3])


def rigid_of(R_cw: Array, center_w: Array) -> Any:
    """Pycolmap's pose of a rotation (3, 3) and a centre (3,)."""
    return import_pycolmap().Rigid3d(np.column_stack([R_cw, -R_cw @ center_w]))
