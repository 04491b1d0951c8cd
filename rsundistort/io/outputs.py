"""Folders of outputs: one that appears whole or not at all, and one that fills file by file."""

from __future__ import annotations

import errno
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import psutil

from ..errors import FileError, InputError, file_errors
from .aside import is_partial, remove_partial
from .journal import Journal, RemoteJournal
from .lock import check_still_there, locked
from .photos.images import check_compression
from .places import Place, RemoteFolder
from .record import Record, is_inside

__all__ = [
    "BATCH_FOLDERS", "CANNOT_WRITE", "batch_folder", "check_begins_or_goes_on", "has_content", "held_inside",
    "make_inside", "only_writer", "output_folder", "work_folder",
]  # fmt: skip

#: What a batch fills.
BATCH_FOLDERS = ("images", "masks", "maps", "also")

#: What a full disk, a read-only one, a limit, a folder that is gone say: anything else is not OUT's fault.
CANNOT_WRITE = (
    errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EPERM, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.ENOENT,
    errno.ENOTDIR, errno.ESTALE, errno.EMFILE, errno.ENFILE, errno.ELOOP,
)  # fmt: skip

# What SQLite says of these: anything else is our fault.
_DISK = "disk", "unable to open", "readonly", "read-only"

# Hidden names in OUT that are no outputs: scratch folders, with machine and process, the lock, what a run keeps, and
# the record.
_HIDDEN = ".rsundistort-"
_SCRATCH = f"{_HIDDEN}{re.sub(r'[^0-9A-Za-z]', '_', platform.node())}-"

# The same in the folder of temporary files.
_WORK = _SCRATCH.lstrip(".")

# Where an open folder has a name that no link changes, by its number.
_OPEN_FOLDERS = Path("/proc/self/fd")


def check_begins_or_goes_on(overwrite: bool, resume: bool) -> None:
    """Refuse to begin anew and to go on at once."""
    if overwrite and resume:
        raise InputError("overwrite begins anew and resume continues; give one of them")


@contextmanager
def output_folder(
    folder: Path, *, overwrite: bool = False, apart_from: Sequence[Path] = (), replaced: Sequence[str] = ()
) -> Iterator[Path]:
    """A scratch folder whose content moves into `folder` when the block ends well, and is deleted otherwise.

    Parameters
    ----------
    folder : Path
        Made if missing. Must be empty unless `overwrite`.
    overwrite : bool
        Replace what was written here before: files of the same names, and in the folders that are written again all
        the others that were. What rsundistort did not write, or somebody changed since, stays; where such a file is in
        the way, nothing is touched.
    apart_from : sequence of Path
        Inputs, files or folders of them: `folder` must not be one of them, and none of them is replaced or removed.
    replaced : sequence of str
        Folders in it that must not hold the inputs either.

    Raises
    ------
    FileError
        Before the block is entered, when the folder is in use or cannot be written; at its end, when a file that is not
        ours is in the way. `Record.check` reports that earlier, of names that are known.
    """
    folder = Path(folder)
    _prepare(folder, apart_from, replaced)
    with only_writer(folder), ExitStack() as stack:
        with _errors_of(folder, "; give another folder"):
            if has_content(folder) and not overwrite:
                raise FileError(f"{folder} is not empty; give another folder, or --overwrite to replace its outputs")
            prefix = f"{_SCRATCH}{os.getpid()}-"
            scratch = tempfile.TemporaryDirectory(prefix=prefix, dir=folder, ignore_cleanup_errors=True)
            stack.enter_context(scratch)
        with _errors_of(folder):
            yield Path(scratch.name)
            check_still_there(folder)
            _move(Path(scratch.name), folder, apart_from)


@contextmanager
def work_folder() -> Iterator[Path]:
    """A temporary folder for a block; those of killed processes of this machine are deleted.

    Raises
    ------
    FileError
        When it cannot be made, or what is written in it does not fit, SQLite's files too.
    """
    try:
        here = Path(tempfile.gettempdir())
    except OSError as error:
        raise FileError(f"{' '.join(str(error).split())}; set TMPDIR to a folder that can be written") from error
    mend = "; set TMPDIR to another folder"
    _remove_scratch(here, _WORK)
    with ExitStack() as stack:
        with _errors_of(here, mend):
            prefix = f"{_WORK}{os.getpid()}-"
            work = stack.enter_context(tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True))
        try:
            yield Path(work)
        except RuntimeError as error:  # pycolmap's
            said = str(error).partition("SQLite error: ")[2]
            if not any(words in said for words in _DISK):
                raise
            raise FileError(f"{here} cannot be written: {said}{mend}") from error


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """A folder that nobody else writes for a block, cleared of what killed processes left half-done.

    It is made if missing; folders that were made are removed again if nothing came into them.

    Raises
    ------
    FileError
        When another process is writing there, or the folder cannot be written.
    """
    made = None
    try:
        with ExitStack() as stack:
            with _errors_of(folder, "; give another folder"):
                # the topmost folder that has to be made: what a failure removes again
                made = next((path for path in (*reversed(folder.parents), folder) if not path.exists()), None)
                if folder.exists() and not folder.is_dir():
                    raise FileError(f"{folder} is a file; give a folder for the outputs")
                folder.mkdir(parents=True, exist_ok=True)
                if stack.enter_context(locked(folder)):
                    _remove_stale(folder)
            yield
    finally:
        if made is not None:
            for path in (folder, *folder.parents):
                if not path.is_relative_to(made):
                    break
                with suppress(OSError):  # what holds something stays
                    path.rmdir()


def _move(scratch: Path, folder: Path, inputs: Sequence[Path]) -> None:
    """Move everything into a folder, in the place of what was written there before."""
    record = Record(folder)
    entries = sorted(scratch.rglob("*"))
    new = {path.relative_to(scratch).as_posix(): path for path in entries if not path.is_dir()}
    folders = [path.relative_to(scratch).as_posix() for path in entries if path.is_dir()]
    old = record.ours({path.name for path in scratch.iterdir()}) - new.keys()
    record.check({*new, *old}, inputs, folders=folders)
    with record.writing(new):
        record.remove(old)
        for name in folders:
            (folder / name).mkdir(exist_ok=True)
        for name, path in new.items():
            path.replace(folder / name)


def has_content(folder: Path) -> bool:
    """Whether there is more in a folder than what a killed process left behind."""
    return any(not path.name.startswith(_HIDDEN) for path in folder.iterdir())


def _remove_stale(folder: Path) -> None:
    """Delete what killed processes left: files half-written, and the scratch folders of those of this machine."""
    remove_partial(folder, deep=False)
    for name in BATCH_FOLDERS:
        if is_inside(folder / name, folder):
            remove_partial(folder / name)
    _remove_scratch(folder, _SCRATCH, own=True)


def _remove_scratch(folder: Path, prefix: str, own: bool = False) -> None:
    """Delete the folders of processes that are gone; `own`, also those of former ones of this process's number."""
    for path in folder.glob(f"{prefix}*"):
        process = re.fullmatch(r"(\d+)-\w+", path.name.removeprefix(prefix))
        gone = process and ((own and int(process[1]) == os.getpid()) or not psutil.pid_exists(int(process[1])))
        if gone and path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)


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
        deleted. Which files may be written is for `Record.check` to say.
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
    _prepare(folder, [other for other in apart_from if isinstance(other, Path)], BATCH_FOLDERS)
    new: list[Path] = []
    with only_writer(folder), Journal(folder) as journal:
        try:
            with _errors_of(folder, "; give another folder"):
                going_on = journal.path.is_file()
                if has_content(folder) and not overwrite:
                    _check_goes_on(folder, going_on, resume)
                paths = (*(folder / name for name in BATCH_FOLDERS), journal.path)
                new = [path for path in paths if not path.exists()]
                # a last line cut short must not run into the next; and what is there without it cannot be gone on with
                journal.write(journal.read().values())
                for name in ("images", "masks"):
                    make_inside(folder, name)
            with _errors_of(folder):
                yield journal
        except BaseException:
            if not journal.read():
                for path in new:
                    shutil.rmtree(path, ignore_errors=True)  # of folders only
                if journal.path in new:
                    journal.path.unlink(missing_ok=True)
                with suppress(OSError):
                    Record(folder).settle()
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
    held = {name: entry for name, entry in (folder.listing() or {}).items() if not name.startswith(_HIDDEN)}
    going_on = Journal.NAME in held
    if held and not overwrite:
        _check_goes_on(folder, going_on, resume)
    folder.delete(path for path in (*folder.sizes_under(BATCH_FOLDERS), *held) if is_partial(path.rpartition("/")[2]))
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
                    Record(folder).settle()
            raise


def _check_goes_on(folder: Place, going_on: bool, resume: bool) -> None:
    """Refuse a folder that is not empty, unless an earlier batch in it is to be gone on with."""
    if resume and going_on:
        return
    mend = "; give another folder, or --overwrite to replace its outputs"
    if going_on:
        mend += ", or --resume to continue with them"
    elif resume:
        mend = ", and holds no batch that --resume could continue" + mend
    raise FileError(f"{folder} is not empty{mend}")


def make_inside(folder: Path, name: str) -> Path:
    """The folder `name` in `folder`, made if missing; refused if a link would lead it elsewhere."""
    path = folder / name
    _check_inside(path, path, folder)
    path.mkdir(parents=True, exist_ok=True)
    return path


@contextmanager
def held_inside(folder: Path, name: str) -> Iterator[Path]:
    """A path to write the output `name` at, which links that are laid meanwhile lead nowhere else.

    Where the system lets open folders be named (Linux), it leads through the folder that was opened and looked at;
    elsewhere it is the path as it was looked at.

    Raises
    ------
    FileError
        When links lead out of the folder, before or when the block has ended; its cause has the number ELOOP.
    """
    path = folder / name
    within = path.parent
    if not _OPEN_FOLDERS.is_dir():
        _check_inside(within, within, folder)
        yield path
        _check_inside(within, within, folder)
        return
    with file_errors(path, "written"):
        held = os.open(within, os.O_RDONLY | os.O_DIRECTORY)
    through = _OPEN_FOLDERS / str(held)
    try:
        _check_inside(within, through, folder)
        yield through / path.name
        _check_inside(within, within, folder)
        if not os.path.samestat(within.stat(), os.fstat(held)):
            raise FileNotFoundError(errno.ENOENT, "its folder was exchanged")
    except FileError as error:
        raise FileError(str(error).replace(str(through), str(within))) from error.__cause__
    except OSError as error:
        raise FileError(f"{path} cannot be written: {error.strerror}") from error
    finally:
        os.close(held)


def _check_inside(name: Path, path: Path, folder: Path) -> None:
    """Refuse what leads out of the folder; `name` is for the message."""
    if not is_inside(path, folder):
        raise FileError(f"{name} leads out of {folder}; remove that link") from OSError(errno.ELOOP, "a link")


def _prepare(folder: Path, apart_from: Sequence[Path], replaced: Sequence[str]) -> None:
    """Refuse a folder that is in the way of the inputs."""
    check_compression()  # outputs hold PNG: rather now than after hours
    with _errors_of(folder, "; give another folder"):
        place = folder.resolve()
    for other in apart_from:
        inside = other.resolve()
        among = any(inside.is_relative_to((folder / name).resolve()) for name in replaced)
        _check_apart(folder, other, place == inside, among)


def _check_apart(folder: Place, other: Place, same: bool, among: bool) -> None:
    if same:
        raise FileError(f"{folder} holds the photos; give another folder for the outputs")
    if among:
        raise FileError(f"{other} would be replaced by the outputs; give another folder for them")


@contextmanager
def _errors_of(folder: Path, mend: str = "") -> Iterator[None]:
    """Error messages of a folder that cannot be written, in one line."""
    try:
        yield
    except OSError as error:
        # before the block any trouble is the folder's
        if isinstance(error, FileError) or (not mend and error.errno not in CANNOT_WRITE):
            raise
        raise FileError(f"{folder} cannot be written: {error.strerror}{mend}") from error
