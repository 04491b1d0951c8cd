"""Deprecated: what was here is in `input`, `solve`, `batch`, `simulate` and `analysis`. Gone in the next version."""

from typing import TYPE_CHECKING, Any

from .._former import FORMER_NAMES, by_former_name

__all__ = [name.removeprefix("pipeline.") for name in FORMER_NAMES if name.startswith("pipeline.")]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        return by_former_name(__name__, name)
