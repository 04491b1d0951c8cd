"""What FFmpeg says of a file, for people."""

from __future__ import annotations

__all__ = ["reason_of"]


def reason_of(error: OSError) -> str:
    """Why FFmpeg, or the system, does not read a file.

    FFmpeg calls it a lack of memory when a damaged file claims more than it ever makes room for.
    """
    return "it claims more than FFmpeg makes room for" if isinstance(error, MemoryError) else str(error.strerror)
