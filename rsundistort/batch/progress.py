"""How stages report their progress."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from .memory import return_memory

__all__ = ["ProgressCallback", "StageLog"]

#: Called as (stage, done, total); total is 0 where it is not known.
#: The first call of a stage reports what was done before.
ProgressCallback = Callable[[str, int, int], None]


class StageLog:
    """Times stages and passes their progress on."""

    def __init__(self, callback: ProgressCallback | None) -> None:
        self._callback = callback
        self._began = time.perf_counter()
        self.stages: list[dict[str, Any]] = []
        #: The one that is under way.
        self.stage = ""

    def tell(self, stage: str, done: int, total: int = 0) -> None:
        """Pass progress on."""
        if self._callback is not None:
            self._callback(stage, done, total)

    def begin(self, stage: str, total: int = 0, done: int = 0) -> None:
        """Start the clock of a stage, of which some may be done already."""
        self._began, self.stage = time.perf_counter(), stage
        self.tell(stage, done, total)

    def end(self, stage: str, **counts: Any) -> None:
        """Note what a stage took and counted, and give back the memory that it freed."""
        return_memory()
        self.stages.append({"name": stage, "seconds": round(time.perf_counter() - self._began, 3), **counts})
