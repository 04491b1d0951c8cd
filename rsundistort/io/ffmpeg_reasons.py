"""What FFmpeg says of a file, for people."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ..errors import FileError, RsUndistortError

__all__ = ["ffmpeg_errors"]


@contextmanager
def ffmpeg_errors(what: str, mend: str = "", *, reading: bool = True) -> Iterator[None]:
    """Errors of FFmpeg, or of the system, as those of the file: `what` cannot be done, with the reason.

    FFmpeg calls it a lack of memory when a damaged file that is read claims more than it ever makes room for.
    """
    import av

    try:
        yield
    except RsUndistortError:
        raise
    except (OSError, av.error.FFmpegError) as error:
        too_much = reading and isinstance(error, MemoryError)
        reason = "it claims more than FFmpeg makes room for" if too_much else error.strerror
        raise FileError(f"{what} ({reason}){mend}") from error
