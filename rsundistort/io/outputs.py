"""Folders of outputs: one that appears whole or not at all, and one that fills file by file."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..errors import FileError
from .aside import remove_partial
from .journal import Journal

__all__ = ["CANNOT_WRITE", "batch_folder", "make_inside", "output_folder"]

#: What a full disk, a read-only one, a limit say: anything else is not OUT's fault.
CANNOT_WRITE = (errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EPERM, errno.EDQUOT, errno.EIO)


@contextmanager
def output_folder(
    folder: Path, *, overwrite: bool = False, apart_from: Sequence[Path] = (), replaced: Sequence[str] = ()
) -> Iterator[Path]:
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
    replaced : sequence of str
        Folders in it that must not hold the inputs either.

    Raises
    ------
    FileError
        Before the block is entered, when the folder is in use or cannot be written.
    """
    folder = Path(folder)
    made = _prepare(folder, apart_from, replaced)
    scratch = None
    try:
        with _errors_of(folder, "; give another folder"):
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()) and not overwrite:
                raise FileError(f"{folder} is not empty; give another folder, or --overwrite to replace its outputs")
            scratch = Path(tempfile.mkdtemp(prefix=".rsundistort-", dir=folder))
        with _errors_of(folder):
            yield scratch
            for entry in sorted(scratch.iterdir()):
                target = folder / entry.name
                if target.is_dir() and not target.is_symlink():
                    shutil.rmtree(target)
                else:
                    target.unlink(missing_ok=True)
                entry.replace(target)
        made = None
    finally:
        if scratch is not None:
            shutil.rmtree(scratch, ignore_errors=True)
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)


@contextmanager
def batch_folder(
    folder: Path, *, overwrite: bool = False, resume: bool = False, apart_from: Sequence[Path] = ()
) -> Iterator[Journal]:
    """The journal of a folder of outputs that fills file by file, and keeps what it has if the block ends badly.

    Parameters
    ----------
    folder : Path
        Made if missing, and removed again if nothing was done. Must be empty unless `overwrite` or `resume`.
    overwrite, resume : bool
        See `folder`; `resume` only if the journal of a batch is in it. What a killed process left half-written is
        deleted.
    apart_from : sequence of Path
        Inputs that `folder` must not be, nor hold among its rectified photos and masks.

    Raises
    ------
    FileError
        When the folder is in use or cannot be written.
    """
    folder = Path(folder)
    made = _prepare(folder, apart_from, ("images", "masks", "maps", "also"))
    new: list[Path] = []
    with Journal(folder) as journal:
        try:
            with _errors_of(folder, "; give another folder"):
                folder.mkdir(parents=True, exist_ok=True)
                going_on = journal.path.is_file()
                if any(folder.iterdir()) and not overwrite and not (resume and going_on):
                    mend = "; give another folder, or --overwrite to replace its outputs"
                    if going_on:
                        mend += ", or --resume to go on with them"
                    elif resume:
                        mend = ", and holds no batch that --resume could go on with" + mend
                    raise FileError(f"{folder} is not empty{mend}")
                new = [path for path in (folder / "images", folder / "masks", journal.path) if not path.exists()]
                for name in ("images", "masks"):
                    make_inside(folder, name)
                for name in ("images", "masks", "maps", "also"):
                    remove_partial(folder / name)
                for aside in folder.glob(".*.partial"):
                    aside.unlink()
                # a last line cut short must not run into the next
                journal.write(journal.read().values())
            with _errors_of(folder):
                yield journal
        except BaseException:
            if not journal.read():
                for path in new:
                    shutil.rmtree(path, ignore_errors=True)  # of folders only
                if journal.path in new:
                    journal.path.unlink(missing_ok=True)
                if made is not None:
                    shutil.rmtree(made, ignore_errors=True)
            raise


def make_inside(folder: Path, name: str) -> Path:
    """The folder `name` in `folder`, made if missing; refused if a link would lead it elsewhere."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FileError(f"{path} leads out of {folder}; remove that link")
    path.mkdir(parents=True, exist_ok=True)
    return path


def _prepare(folder: Path, apart_from: Sequence[Path], replaced: Sequence[str]) -> Path | None:
    """Refuse a folder that is in the way of the inputs; the topmost folder that has to be made for it to exist."""
    place = folder.resolve()
    for other in apart_from:
        inside = Path(other).resolve()
        if place == inside:
            raise FileError(f"{folder} holds the photos; give another folder for the outputs")
        if any(inside.is_relative_to((folder / name).resolve()) for name in replaced):
            raise FileError(f"{other} would be replaced by the outputs; give another folder for them")
    if folder.exists() and not folder.is_dir():
        raise FileError(f"{folder} is a file; give a folder for the outputs")
    return _first_missing(folder)


@contextmanager
def _errors_of(folder: Path, mend: str = "") -> Iterator[None]:
    """What the system says of a folder that cannot be written, in one line."""
    try:
        yield
    except OSError as error:
        # before the block any trouble is the folder's
        if isinstance(error, FileError) or (not mend and error.errno not in CANNOT_WRITE):
            raise
        raise FileError(f"{folder} cannot be written: {error.strerror}{mend}") from error


def _first_missing(folder: Path) -> Path | None:
    """The topmost folder that has to be made for `folder` to exist: what a failure removes again."""
    missing = None
    for path in (folder, *folder.parents):
        if path.exists():
            break
        missing = path
    return missing
