"""Errors and warnings: one root, each leaf also of the builtin class that a caller expects."""

from collections.abc import Iterator
from contextlib import contextmanager

__all__ = [
    "DamagedPhotoWarning",
    "FileError",
    "FileKindWarning",
    "FormatError",
    "InputError",
    "MetadataWarning",
    "MissingOutputWarning",
    "ReconstructionError",
    "RsUndistortError",
    "RsUndistortWarning",
    "SkippedPhotoWarning",
    "file_errors",
    "format_errors",
    "one_line",
]


# Longer than any of ours; a damaged file would have a value of it echoed that fills the screen.
_LONGEST = 480


def one_line(text: str) -> str:
    """A text without line breaks and other control characters, its middle left out where it is too long."""
    line = "".join(c if c.isprintable() else repr(c)[1:-1] for c in " ".join(text.split()))
    if len(line) <= _LONGEST:
        return line
    # what it is about stands first, how to mend it last
    return f"{line[: _LONGEST * 2 // 3]} ... {line[-(_LONGEST // 3 - 5) :]}"


class RsUndistortError(Exception):
    """Root of every error that rsundistort raises on purpose; its text is one line for a person."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class InputError(RsUndistortError, ValueError):
    """An argument or a file holds something that cannot be used."""


class FileError(RsUndistortError, OSError):
    """A file or folder is missing, unreadable, unwritable or in the way."""


@contextmanager
def file_errors(what: object, deed: str = "read", mend: str = "") -> Iterator[None]:
    """What the system says of a file in the block becomes a FileError: `what` cannot be read, or written."""
    try:
        yield
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"{what} cannot be {deed}: {error.strerror}{mend}") from error


class FormatError(InputError):
    """A file is not of the format, or of a version of it, that can be read."""


@contextmanager
def format_errors(where: object, kinds: type[Exception] | tuple[type[Exception], ...] = InputError) -> Iterator[None]:
    """Errors of these kinds in the block become a FormatError, which names the place."""
    try:
        yield
    except kinds as error:
        raise FormatError(f"{where}: {error}") from error


class ReconstructionError(RsUndistortError, RuntimeError):
    """The photos could not be registered in one reconstruction."""


class RsUndistortWarning(UserWarning):
    """Root of every warning; its text is one line for a person."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class SkippedPhotoWarning(RsUndistortWarning):
    """A photo was left out; the others go on."""


class MetadataWarning(RsUndistortWarning):
    """A photo's metadata could not be kept."""


class MissingOutputWarning(RsUndistortWarning):
    """An output that was asked for could not be written, and the others are done; `file` is its name."""

    def __init__(self, text: str, file: str) -> None:
        super().__init__(text)
        self.file = file


class DamagedPhotoWarning(RsUndistortWarning):
    """A photo's decoder, or a checksum in its file, says that pixels of it are not what they were."""


class FileKindWarning(RsUndistortWarning):
    """A file's content is of another kind than its ending says."""
