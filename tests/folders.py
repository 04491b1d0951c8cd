"""What folders hold, for tests of what jobs write and leave alone."""

from __future__ import annotations


def tree(folder):
    """Content of the files of a folder by name, None for folders in it."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def seen_files(folder):
    """Content of its files that are not hidden."""
    return {
        name: content
        for name, content in tree(folder).items()
        if content is not None and not name.rpartition("/")[2].startswith(".")
    }
