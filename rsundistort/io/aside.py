"""Files that are whole or not there, and names that stay in their folder."""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["is_partial", "remove_partial", "write_aside", "written_aside"]


@contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """A hidden name beside `path`, for what becomes `path` when the block ends well, and is deleted otherwise.

    The name is new: neither a link that somebody laid there is followed, nor do two processes write one file.
    """
    aside = path.with_name(f".{secrets.token_hex(8)}.partial")
    try:
        yield aside
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def write_aside(path: Path, *parts: bytes | memoryview) -> None:
    """Write a file of these parts, whole or not at all."""
    with written_aside(path) as aside, aside.open("wb") as file:
        file.writelines(parts)


def is_partial(name: str) -> bool:
    """Whether a name is one of those that files have here while they are written; others' may look alike."""
    return re.fullmatch(r"\.[0-9a-f]{16}\.partial(\.\w+)?", name) is not None


def remove_partial(folder: Path, *, deep: bool = True) -> None:
    """Delete what a killed process left half-written in a folder, and in its sub-folders if `deep`."""
    for path in (folder.rglob if deep else folder.glob)(".*.partial*"):
        if is_partial(path.name):
            path.unlink(missing_ok=True)
