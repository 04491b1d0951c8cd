"""Files that are whole or not there, and names that stay in their folder."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["remove_partial", "write_aside", "written_aside"]


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


def remove_partial(folder: Path) -> None:
    """Delete what a killed process left half-written in a folder and its sub-folders."""
    for path in folder.rglob(".*.partial*"):
        path.unlink(missing_ok=True)
