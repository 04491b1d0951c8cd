"""The readout time of a camera, from a video of it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..batch.progress import ProgressCallback, StageLog
from ..batch.workers import Workers, use_threads
from ..errors import InputError, RsUndistortWarning
from ..input.frames import find_photos
from ..input.load import load_photos
from ..input.unknown_focal import with_focal_lengths
from ..io import is_video
from ..io.outputs import work_folder
from ..io.places import local_place
from ..verdict.judge_path import problem_of
from .run import check_of_video, solve_frames
from .run_options import RunOptions

__all__ = ["MeasuredReadout", "measure_readout"]


@dataclass(frozen=True)
class MeasuredReadout:
    """The readout time of a camera by a video.

    Attributes
    ----------
    seconds, sigma : float
        From the first line to the last, negative if the lines are read in the opposite direction; and its standard
        deviation.
    of_frame : float
        Share of the time from frame to frame.
    problem : str
        Why the video does not determine it; empty if it does.
    evidence : mapping
        `quality.readout_time` of a solution: the same by halves, by images and gyroscope alone, whether the video was
        stabilised, and the number of frames.
    """

    seconds: float
    sigma: float
    of_frame: float
    problem: str
    evidence: Mapping[str, Any]

    @property
    def measured(self) -> bool:
        """Whether the video determines it."""
        return not self.problem

    def to_json(self) -> dict[str, Any]:
        """The result as plain values."""
        return {"measured": self.measured, "problem": self.problem, **self.evidence}


def measure_readout(
    video: Path | str, options: RunOptions | None = None, progress: ProgressCallback | None = None, *, jobs: int = 0
) -> MeasuredReadout:
    """Measure the readout time of a camera from a video that it took; nothing is written.

    The camera must have shaken or rotated, and must not have stabilised the video. The scene may be anything that stood
    still.

    Parameters
    ----------
    video : path
        Any file that FFmpeg decodes.
    options : RunOptions, optional
        `solve.readout_s` is a first guess, known to 2 %: a value that the video does not improve is not measured.
    jobs : int
        Threads; 0 for all cores.

    Returns
    -------
    MeasuredReadout
        With a `problem` if the video does not determine it.
    """
    options = options or RunOptions()
    video = local_place(video)
    if not is_video(video):
        raise InputError(f"{video} is no video; a readout time is measured from one")
    check_of_video(options)
    log, workers = StageLog(progress), Workers(use_threads(jobs))
    with work_folder() as work, warnings.catch_warnings():
        # no frame is rectified
        warnings.filterwarnings("ignore", "the frames are corrected for the lens only", RsUndistortWarning)
        gyro_log = None if options.gyro is None else options.gyro.log()
        source = find_photos(video, work, options.camera, None, None, log)
        assert source.clip is not None
        assert source.frames is not None
        loaded = load_photos(
            source.folder, source.camera, options.solve.readout, options.most_features(True), workers, log,
            megapixels=options.feature_megapixels, again=True, least=2,
        )  # fmt: skip
        loaded = with_focal_lengths(loaded, options.solve.seed, log)
        bodies = [source.frames] * len(loaded.names)
        solved = solve_frames(options, source.clip, loaded, bodies, gyro_log, log)
    evidence = dict(solved.evidence)
    return MeasuredReadout(evidence["seconds"], evidence["sigma"], evidence["of_frame"], problem_of(evidence), evidence)
