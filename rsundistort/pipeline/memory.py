"""How much memory is free here."""

from __future__ import annotations

from pathlib import Path

import psutil

__all__ = ["free_memory"]


def free_memory(root: Path = Path("/")) -> int:
    """Bytes that this process may still take, without what others would have to swap.

    On Linux, containers and batch systems limit it by control groups, which the machine's own figures do not show.
    `root` is where the system's files are.
    """
    free = int(psutil.virtual_memory().available)
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return free
    group = next((line[3:].strip("/") for line in lines if line.startswith("0::")), "")
    top = root / "sys/fs/cgroup"
    for folder in (top / group, *(top / group).parents):
        if folder.is_relative_to(top):
            free = min(free, _free_in_group(folder))
    return max(free, 0)


def _free_in_group(folder: Path) -> int:
    """Of one control group (version 2), with the files' pages that the system would give up."""
    try:
        limit = int((folder / "memory.max").read_text())
        used = int((folder / "memory.current").read_text())
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
        return limit - used + int(stat.get("inactive_file", 0))
    except (OSError, ValueError):  # no such file, or no limit ("max")
        return 1 << 62
