"""Runs that are resumed: their state until they end, and its key."""

from __future__ import annotations

import errno
import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..batch.one_photo import feed
from ..batch.progress import StageLog
from ..errors import FileError
from ..io.kept import Kept
from ..io.outputs import check_begins_or_goes_on, has_content, only_writer
from ..io.record import Record
from ..versions import versions

__all__ = ["RunFolder", "key_of", "run_folder"]

_BEGUN, _OUTPUTS = "begun", "outputs"
# What the system says of writing alone.
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def key_of(inputs: Sequence[Path], *options: Any) -> str:
    """Key of a run's outputs: versions, options, and size and modification time of all files."""
    digest = hashlib.sha256(repr(versions()).encode())
    with suppress(OSError):  # a missing file is reported where it is read
        for each in options:
            feed(digest, each)
    for path in inputs:
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            if file.is_file():
                feed(digest, (file.name, file))
    return digest.hexdigest()


class RunFolder:
    """The outputs of a run, and its state.

    Parameters
    ----------
    out : Path
        Folder of the outputs.
    key : str
        See `key_of`.
    resume : bool
        Whether an earlier run is resumed.
    """

    def __init__(self, out: Path, key: str, resume: bool) -> None:
        self.kept = Kept(out, key)
        #: Whether the run before was complete.
        self.finished = resume and Record(out).is_finished(key)
        #: Whether it can be resumed.
        self.goes_on = resume and not self.finished and self.kept.holds()
        #: Whether all is written except what depends on the rectified photos.
        self.begun = self.goes_on and self.kept.get(_BEGUN) is True and self.kept.get(_OUTPUTS) is not None

    def outputs(self, log: StageLog) -> Any:
        """The solution, with its times in the log; None if there is none."""
        found = self.kept.get(_OUTPUTS) if self.goes_on else None
        if found is not None:
            log.stages[:] = found[1]
        return None if found is None else found[0]

    def solved(self, outputs: Any, log: StageLog) -> None:
        """Keep the solution."""
        self.kept.put(_OUTPUTS, (outputs, log.stages))

    def begin(self) -> None:
        """Note that all is written except what depends on the rectified photos."""
        self.kept.put(_BEGUN, True)


@contextmanager
def run_folder(
    out: Path, key: str, log: StageLog, *, overwrite: bool = False, resume: bool = False
) -> Iterator[RunFolder]:
    """The locked folder of a run; its state is removed at the end, or if there is no solution.

    An interruption says where it was, and how to continue. So does a disk that is full after the solution is found.

    Raises
    ------
    FileError
        There are outputs, but no run that `resume` could continue.
    """
    check_begins_or_goes_on(overwrite, resume)
    with only_writer(out):
        run = RunFolder(out, key, resume)
        if resume and not (run.finished or run.goes_on) and has_content(out):
            if changed := Record(out).changed(key):
                raise FileError(
                    f"{out} holds this run, complete, but {len(changed)} of its files changed since or are gone, such "
                    f"as {changed[0]}; give another folder, or --overwrite to make all again"
                )
            raise FileError(
                f"{out} is not empty, and holds no run with these photos and options that --resume could continue; "
                "give another folder, or --overwrite to replace its outputs"
            )
        try:
            yield run
        except KeyboardInterrupt as stop:
            where = str(stop) or f"{log.stage or 'nothing'} was under way, the same command with --resume continues"
            raise KeyboardInterrupt(where) from stop
        except Exception as error:
            cannot_write = isinstance(error, FileError) and getattr(error.__cause__, "errno", None) in _FULL
            stays = run.goes_on or bool(run.kept.get(_BEGUN)) or (cannot_write and run.kept.get(_OUTPUTS) is not None)
            if not stays:
                run.kept.drop()
            if cannot_write and ";" not in str(error):
                mend = "the same command with --resume continues" if stays else "correct that, or give another folder"
                raise FileError(f"{error}; {mend}") from error.__cause__
            raise
        if not run.finished:
            Record(out).finish(key)
        run.kept.drop()
