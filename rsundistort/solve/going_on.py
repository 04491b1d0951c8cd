"""Runs that are gone on with: what is kept of one until it ends, and of what."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..batch.one_photo import feed
from ..batch.progress import StageLog
from ..errors import FileError
from ..io.kept import Kept
from ..io.outputs import has_content, only_writer
from ..io.record import Record
from ..versions import versions

__all__ = ["RunFolder", "key_of", "run_folder"]

_BEGUN, _OUTPUTS = "begun", "outputs"


def key_of(inputs: Sequence[Path], *options: Any) -> str:
    """What the outputs of a run depend on: versions, options, and size and time of change of all files."""
    digest = hashlib.sha256(repr(versions()).encode())
    with suppress(OSError):  # what is missing is told where it is read
        for each in options:
            feed(digest, each)
    for path in inputs:
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            if file.is_file():
                feed(digest, (file.name, file))
    return digest.hexdigest()


class RunFolder:
    """The outputs of a run, and what is kept of it.

    Parameters
    ----------
    out : Path
        Folder of the outputs.
    key : str
        See `key_of`.
    resume : bool
        Whether an earlier run is to be gone on with.
    """

    def __init__(self, out: Path, key: str, resume: bool) -> None:
        self.kept = Kept(out, key)
        #: Whether the run before came to its end.
        self.finished = resume and Record(out).is_finished(key)
        #: Whether there is something of it to go on with.
        self.goes_on = resume and not self.finished and self.kept.holds()
        #: Whether all is written but what the photos tell.
        self.begun = self.goes_on and self.kept.get(_BEGUN) is True and self.kept.get(_OUTPUTS) is not None

    def outputs(self, log: StageLog) -> Any:
        """What was solved, with its times in the log; None if nothing was."""
        found = self.kept.get(_OUTPUTS) if self.goes_on else None
        if found is not None:
            log.stages[:] = found[1]
        return None if found is None else found[0]

    def solved(self, outputs: Any, log: StageLog) -> None:
        """Keep what was solved."""
        self.kept.put(_OUTPUTS, (outputs, log.stages))

    def begin(self) -> None:
        """Note that all is written but what the photos tell."""
        self.kept.put(_BEGUN, True)


@contextmanager
def run_folder(
    out: Path, key: str, log: StageLog, *, overwrite: bool = False, resume: bool = False
) -> Iterator[RunFolder]:
    """The folder of a run, which nobody else writes; what is kept is dropped at the end, or if there is no solution.

    An interruption says where it was, and how to go on. So does a disk that is full once all is solved, which stays.

    Raises
    ------
    FileError
        When there are outputs, but no run that `resume` could go on with.
    """
    with only_writer(out):
        run = RunFolder(out, key, resume)
        if resume and not overwrite and not (run.finished or run.goes_on) and has_content(out):
            raise FileError(
                f"{out} is not empty, and holds no run with these photos and options that --resume could go on with; "
                "give another folder, or --overwrite to replace its outputs"
            )
        try:
            yield run
        except KeyboardInterrupt as stop:
            where = str(stop) or f"{log.stage or 'nothing'} was under way, the same command with --resume goes on"
            raise KeyboardInterrupt(where) from stop
        except Exception as error:
            of_the_machine = isinstance(error, FileError) and isinstance(error.__cause__, OSError)
            stays = run.goes_on or bool(run.kept.get(_BEGUN)) or (of_the_machine and run.kept.get(_OUTPUTS) is not None)
            if not stays:
                run.kept.drop()
            if of_the_machine and ";" not in str(error):
                mend = "the same command with --resume goes on" if stays else "mend that, or give another folder"
                raise FileError(f"{error}; {mend}") from error.__cause__
            raise
        if not run.finished:
            Record(out).finish(key)
        run.kept.drop()
