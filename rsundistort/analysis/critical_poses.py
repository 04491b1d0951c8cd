"""The degeneracy measure of poses in files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..critical import advise_poses, critical_motion
from ..errors import FileError, InputError
from ..io import read_colmap_poses, read_solution, read_transforms
from ..io.places import local_place
from ..io.record import Record
from ..model import check_readout
from ..model.orientation import in_stored_frame
from .results import PoseAnalysis

__all__ = ["analyze"]

# Poses that a run writes beside its solution.
_OF_RUN = "sparse", "transforms.json"


def analyze(path: Path | str, readout: str | None = None) -> PoseAnalysis:
    """Whether poses let the shutter be distinguished from the shape of the scene.

    Parameters
    ----------
    path : path
        `solution.json`, or a folder that holds one (a run's output); a COLMAP model; a `transforms.json`. Of those that
        a run wrote its solution is taken, which says how photos were read.
    readout : str, optional
        Readout direction of all photos; else the solution's, else top-to-bottom.

    Returns
    -------
    PoseAnalysis
        The degeneracy measure of the poses; what the shape of a solution is worth; advice for the next shoot, if they
        are critical.
    """
    path = local_place(path)
    if readout is not None:
        check_readout(readout)
    if not path.exists():
        raise FileError(f"{path} does not exist")
    sentence, advice = None, None
    if path.is_dir() and (path / "solution.json").is_file():
        path = path / "solution.json"
    elif path.name in _OF_RUN and (path.parent / Record.NAME).is_file() and (path.parent / "solution.json").is_file():
        path = path.parent / "solution.json"
    if path.is_dir():
        _, names, _, R_cw, center_w, *_ = read_colmap_poses(path, any_lens=True)
        directions = [readout or "top-to-bottom"] * len(names)
    elif path.name.endswith("transforms.json"):
        R_cw, center_w = read_transforms(path)
        directions = [readout or "top-to-bottom"] * len(R_cw)
    else:
        solution = in_stored_frame(read_solution(path))
        posed = [image for image in solution.registered if image.posed]
        R_cw = np.array([image.R_cw for image in posed]).reshape(-1, 3, 3)
        center_w = np.array([image.center_w for image in posed]).reshape(-1, 3)
        directions = [readout or solution.cameras[image.camera_id].readout for image in posed]
        if solution.critical_motion is not None:
            sentence = solution.critical_motion.get("sentence")
            advice = solution.critical_motion.get("advice")
    if len(R_cw) < 2:
        raise InputError(f"{path} holds {len(R_cw)} poses; the degeneracy measure compares at least two")
    degeneracy = critical_motion(R_cw, center_w, directions)
    if advice is None and degeneracy.is_low:
        advice = [each.sentence for each in advise_poses(R_cw, center_w, directions)]
    return PoseAnalysis(len(R_cw), tuple(sorted(set(directions))), degeneracy, sentence, tuple(advice or ()))
