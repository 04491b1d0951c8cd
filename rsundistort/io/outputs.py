"""A folder of outputs that appears whole or not at all."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..errors import FileError

__all__ = ["output_folder"]


# a full disk, a read-only one, a limit: anything else is not OUT's fault
_CANNOT_WRITE = (errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EPERM, errno.EDQUOT)


@contextmanager
def output_folder(folder: Path, *, overwrite: bool = False, apart_from: Sequence[Path] = ()) -> Iterator[Path]:
    """A scratch folder whose content moves into `folder` when the block ends well, and is deleted otherwise.

    Parameters
    ----------
    folder : Path
        Made if missing. Must be empty unless `overwrite`; then entries of the same names are replaced, and
        everything else in it stays.
    overwrite : bool
        See `folder`.
    apart_from : sequence of Path
        Inputs that `folder` must not be.

    Raises
    ------
    FileError
        Before the block is entered, when the folder is in use or cannot be written.
    """
    folder = Path(folder)
    for other in apart_from:
        if folder.resolve() == Path(other).resolve():
            raise FileError(f"{folder} holds the photos; give another folder for the outputs")
    if folder.exists() and not folder.is_dir():
        raise FileError(f"{folder} is a file; give a folder for the outputs")
    made = _first_missing(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()) and not overwrite:
            raise FileError(f"{folder} is not empty; give another folder, or --overwrite to replace its outputs")
        scratch = Path(tempfile.mkdtemp(prefix=".rsundistort-", dir=folder))
    except OSError as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{folder} cannot be written: {error.strerror}; give another folder") from error
    try:
        yield scratch
        for entry in sorted(scratch.iterdir()):
            target = folder / entry.name
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)
            entry.replace(target)
        made = None
    except OSError as error:
        if isinstance(error, FileError) or error.errno not in _CANNOT_WRITE:
            raise
        raise FileError(f"{folder} cannot be written: {error.strerror}") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)


def _first_missing(folder: Path) -> Path | None:
    """The topmost folder that has to be made for `folder` to exist: what a failure removes again."""
    missing = None
    for path in (folder, *folder.parents):
        if path.exists():
            break
        missing = path
    return missing
