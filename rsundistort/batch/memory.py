"""How much memory is free here, and memory given back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psutil

__all__ = ["free_memory", "return_memory"]

# Files that say limit and use, and lines of memory.stat with pages of files, which the system gives up: of version 2
# of control groups, and of version 1.
_NAMES = {
    "": ("memory.max", "memory.current", ("inactive_file", "active_file")),
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", ("total_inactive_file", "total_active_file")),
}


def free_memory(root: Path = Path("/")) -> int:
    """Bytes that this process may still take, without what others would have to swap.

    On Linux, containers and batch systems limit it by control groups, which the machine's own figures do not show.
    `root` is where the system's files are.
    """
    return max(0, min([int(psutil.virtual_memory().available), *_left_in_groups(root)]))


def return_memory() -> None:
    """Give back to the system what C libraries have freed.

    Allocators keep it for the thread that took it; of a matching of hundreds of photos that is as much as an adjustment
    of them takes.
    """
    trim = getattr(psutil, "heap_trim", None)  # from psutil 7.2 on
    if trim is not None:
        trim()


def _left_in_groups(root: Path) -> Iterator[int]:
    """Free memory of each control group of this process that has a limit."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, group = line.split(":", 2)
        kind = "memory" if "memory" in controllers.split(",") else controllers
        if kind not in _NAMES:
            continue
        limit_name, used_name, files = _NAMES[kind]
        top = root / "sys/fs/cgroup" / kind
        # within a container the group's own folder may be missing, and the top is its own
        for folder in (top / group.strip("/"), *(top / group.strip("/")).parents):
            if not folder.is_relative_to(top):
                break
            try:
                limit, used = (int((folder / name).read_text()) for name in (limit_name, used_name))
                stat = dict(each.split() for each in (folder / "memory.stat").read_text().splitlines())
            except (OSError, ValueError):  # no such file, or no limit ("max")
                continue
            yield limit - used + sum(int(stat.get(name, 0)) for name in files)
