"""Folders of outputs: one that appears whole or not at all, and one that fills file by file."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import FileError
from .aside import remove_partial
from .journal import Journal, RemoteJournal
from .places import Place, RemoteFolder

__all__ = ["BATCH_FOLDERS", "CANNOT_WRITE", "batch_folder", "make_inside", "output_folder"]

#: What a batch fills.
BATCH_FOLDERS = ("images", "masks", "maps", "also")

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
    folder: Place, *, overwrite: bool = False, resume: bool = False, apart_from: Sequence[Place] = ()
) -> Iterator[Journal]:
    """The journal of a folder of outputs that fills file by file, and keeps what it has if the block ends badly.

    Parameters
    ----------
    folder : Path or RemoteFolder
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
    if isinstance(folder, RemoteFolder):
        with _remote_batch(folder, overwrite, resume, apart_from) as journal:
            yield journal
        return
    folder = Path(folder)
    made = _prepare(folder, [other for other in apart_from if isinstance(other, Path)], BATCH_FOLDERS)
    new: list[Path] = []
    with Journal(folder) as journal:
        try:
            with _errors_of(folder, "; give another folder"):
                folder.mkdir(parents=True, exist_ok=True)
                going_on = journal.path.is_file()
                if any(folder.iterdir()) and not overwrite:
                    _check_goes_on(folder, going_on, resume)
                new = [path for path in (folder / "images", folder / "masks", journal.path) if not path.exists()]
                for name in ("images", "masks"):
                    make_inside(folder, name)
                for name in BATCH_FOLDERS:
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


@contextmanager
def _remote_batch(
    folder: RemoteFolder, overwrite: bool, resume: bool, apart_from: Sequence[Place]
) -> Iterator[Journal]:
    """As `batch_folder`; remote folders are there when something is in them."""
    for other in apart_from:
        if isinstance(other, RemoteFolder):
            _check_apart(
                folder, other, folder.holds(other) and other.holds(folder),
                any(RemoteFolder(f"{folder}/{name}").holds(other) for name in BATCH_FOLDERS),
            )  # fmt: skip
    held = folder.listing() or {}
    going_on = Journal.NAME in held
    if held and not overwrite:
        _check_goes_on(folder, going_on, resume)
    partial = (path for path in folder.sizes_under(BATCH_FOLDERS) if path.endswith(".partial"))
    folder.delete([*partial, *(name for name in held if name.endswith(".partial"))])
    here = Path(tempfile.gettempdir())
    with _errors_of(here, "; set TMPDIR to another folder"):
        journal = RemoteJournal(folder)
    with _errors_of(here), journal:
        if going_on:
            journal.fetch()
        try:
            # a folder that cannot be written shows itself now
            journal.write(journal.read().values())
            yield journal
        except BaseException:
            if not going_on and not journal.read():
                with suppress(FileError):
                    journal.drop()
                    folder.delete(() if held else folder.sizes_under(BATCH_FOLDERS))
            raise


def _check_goes_on(folder: Place, going_on: bool, resume: bool) -> None:
    """Refuse a folder that is not empty, unless an earlier batch in it is to be gone on with."""
    if resume and going_on:
        return
    mend = "; give another folder, or --overwrite to replace its outputs"
    if going_on:
        mend += ", or --resume to go on with them"
    elif resume:
        mend = ", and holds no batch that --resume could go on with" + mend
    raise FileError(f"{folder} is not empty{mend}")


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
        among = any(inside.is_relative_to((folder / name).resolve()) for name in replaced)
        _check_apart(folder, other, place == inside, among)
    if folder.exists() and not folder.is_dir():
        raise FileError(f"{folder} is a file; give a folder for the outputs")
    return _first_missing(folder)


def _check_apart(folder: Place, other: Place, same: bool, among: bool) -> None:
    if same:
        raise FileError(f"{folder} holds the photos; give another folder for the outputs")
    if among:
        raise FileError(f"{other} would be replaced by the outputs; give another folder for them")


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
