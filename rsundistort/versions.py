"""Versions of what a result depends on."""

from __future__ import annotations

import platform
from importlib.metadata import version

__all__ = ["versions"]


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    names = ("rsundistort", "opencv-contrib-python-headless", "numpy", "scipy", "numba", "pycolmap")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}
