"""The meter of critical motions for poses in files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..critical import advise_poses, critical_motion
from ..errors import FileError, InputError
from ..io import read_colmap_poses, read_solution, read_transforms
from ..model import READOUTS
from ..model.orientation import in_stored_frame

__all__ = ["analyze"]


def analyze(path: Path | str, readout: str | None = None) -> dict[str, Any]:
    """Whether poses let the shutter be told from the shape of the scene.

    Parameters
    ----------
    path : path
        `solution.json`, or a folder that holds one (a run's output); a COLMAP model; a `transforms.json`.
    readout : str, optional
        Readout direction of all photos; else the solution's, else top-to-bottom.

    Returns
    -------
    dict
        photos, readout, singular_values, null_vector, y_axis_spread_deg, meaning, critical (whether the meter is low);
        sentence (what the shape of a solution is worth, None of bare poses); advice for the next shoot, if critical.
    """
    path = Path(path)
    if readout is not None and readout not in READOUTS:
        raise InputError(f"readout={readout!r}, expected one of {', '.join(READOUTS)}")
    if not path.exists():
        raise FileError(f"{path} does not exist")
    sentence, advice = None, None
    if path.is_dir() and (path / "solution.json").is_file():
        path = path / "solution.json"
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
        raise InputError(f"{path} holds {len(R_cw)} poses; the meter compares at least two")
    meter = critical_motion(R_cw, center_w, directions)
    if advice is None and meter.is_low:
        advice = [each.sentence for each in advise_poses(R_cw, center_w, directions)]
    return {
        "photos": len(R_cw),
        "readout": sorted(set(directions)),
        "singular_values": meter.singular_values.tolist(),
        "null_vector": meter.null_vector.tolist(),
        "y_axis_spread_deg": meter.y_axis_spread_deg,
        "meaning": meter.meaning,
        "critical": meter.is_low,
        "sentence": sentence,
        "advice": advice or [],
    }
