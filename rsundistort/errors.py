"""Errors and warnings: one root, each leaf also of the builtin class that a caller expects."""

__all__ = [
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
]


class RsUndistortError(Exception):
    """Root of every error that rsundistort raises on purpose; its text is one line for a person."""


class InputError(RsUndistortError, ValueError):
    """An argument or a file holds something that cannot be used."""


class FileError(RsUndistortError, OSError):
    """A file or folder is missing, unreadable, unwritable or in the way."""


class FormatError(InputError):
    """A file is not of the format, or of a version of it, that can be read."""


class ReconstructionError(RsUndistortError, RuntimeError):
    """The photos could not be joined into one reconstruction."""


class RsUndistortWarning(UserWarning):
    """Root of every warning."""


class SkippedPhotoWarning(RsUndistortWarning):
    """A photo was left out; the others go on."""


class MetadataWarning(RsUndistortWarning):
    """A photo's metadata could not be kept."""


class MissingOutputWarning(RsUndistortWarning):
    """An output that was asked for could not be written, and the others are done; `file` is its name."""

    def __init__(self, text: str, file: str) -> None:
        super().__init__(text)
        self.file = file


class FileKindWarning(RsUndistortWarning):
    """A file's content is of another kind than its ending says."""
