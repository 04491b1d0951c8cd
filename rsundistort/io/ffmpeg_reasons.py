"""Files that FFmpeg reads and writes, and what it says of them, for people."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import FileError, InputError, RsUndistortError

__all__ = ["ffmpeg_errors", "open_video"]


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


def open_video(path: Path, mend: str = "") -> Any:
    """PyAV's container of a video that is read.

    Raises
    ------
    InputError
        PyAV is missing.
    FileError
        It cannot be read; `mend` is what to do about it.
    """
    try:
        import av
    except ImportError:
        raise InputError(f'{path.name} is a video, which needs PyAV: pip install "rsundistort[video]"') from None
    with ffmpeg_errors(f"{path} cannot be read as a video", mend):
        # a name with a colon is no protocol, a file that refers to others must not fetch them, and tags in another
        # encoding are nothing to fail at
        return av.open(f"file:{path}", options={"protocol_whitelist": "file"}, metadata_errors="replace")
