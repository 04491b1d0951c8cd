"""One writer for each folder of outputs: a lock that dies with its process."""

from __future__ import annotations

import errno
import os
import platform
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from ..errors import FileError, RsUndistortWarning

__all__ = ["LOCK_NAME", "check_still_there", "locked"]

#: The file in the folder that is locked; hidden, and removed when the lock is given back.
LOCK_NAME = ".rsundistort-lock"

# File systems without locks say one of these, and another writer is there that has one says one of those.
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL)
_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES, errno.EDEADLK)
# On Windows a byte is locked that nobody reads: the file says who holds it.
_FAR = 1 << 30


@dataclass
class _Held:
    """A lock of this process: who holds it, how many times over, and by which file."""

    thread: int
    file: int
    count: int = 1


_held: dict[str, _Held] = {}
_guard = threading.Lock()


@contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Be the only writer of a folder, which exists, for a block; a thread may enter it again. Whether it is the first.

    The lock is the system's, on an open file: whatever ends the process ends it. Where the file system has no locks
    (some network ones), a warning says so and the block is entered without.

    Raises
    ------
    FileError
        Another process or thread is writing there; or the file of the lock cannot be made.
    """
    key, me = str(folder.resolve()), threading.get_ident()
    with _guard:
        held = _held.get(key)
        first = held is None
        if held is None:
            held = _held[key] = _Held(me, _acquire(folder))
        elif held.thread == me:
            held.count += 1
        else:
            raise FileError(_taken(folder, "this process"))
    try:
        yield first
    finally:
        with _guard:
            held.count -= 1
            if not held.count:
                del _held[key]
                _release(folder / LOCK_NAME, held.file)


def check_still_there(folder: Path) -> None:
    """Refuse to go on writing into a folder that is locked, and was moved or removed, or another put in its place."""
    with _guard:
        held = _held.get(str(folder.resolve()))
    if held is None or not _is_same(folder / LOCK_NAME, held.file):
        raise FileError(f"{folder} was moved, removed or cleared while it was written")


def _taken(folder: Path, who: str) -> str:
    return f"{folder} is being written by {who}; wait for it, or give another folder"


def _acquire(folder: Path) -> int:
    path = folder / LOCK_NAME
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            _lock(file)
        except OSError as error:
            if error.errno in _NO_LOCKS:
                warnings.warn(
                    f"{folder} cannot be locked ({error.strerror}); let no other process write into it meanwhile",
                    RsUndistortWarning, stacklevel=4,
                )  # fmt: skip
                return file
            said = os.read(file, 100).decode(errors="replace").strip()
            os.close(file)
            if error.errno not in _TAKEN:
                raise
            raise FileError(_taken(folder, said or "another process")) from error
        if _is_same(path, file):
            break
        os.close(file)  # its last holder removed it in between
    os.ftruncate(file, 0)
    os.write(file, f"process {os.getpid()} of {platform.node()}".encode())
    return file


def _release(path: Path, file: int) -> None:
    """Remove the file while it is still ours, and give the lock back."""
    if os.name != "nt":
        with suppress(OSError):
            if _is_same(path, file):
                path.unlink()
    os.close(file)
    if os.name == "nt":  # what is open cannot be removed there; what another one opened stays
        with suppress(OSError):
            path.unlink()


def _is_same(path: Path, file: int) -> bool:
    """Whether a path still leads to an open file."""
    try:
        there, ours = os.lstat(path), os.fstat(file)
    except OSError:
        return False
    return (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)


if os.name == "nt":
    import msvcrt

    def _lock(file: int) -> None:
        os.lseek(file, _FAR, os.SEEK_SET)
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined,unused-ignore]
        finally:
            os.lseek(file, 0, os.SEEK_SET)
else:
    import fcntl

    def _lock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
