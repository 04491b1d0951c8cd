"""The verdict on a solution in three sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..critical import CriticalMotion, advise_poses, critical_motion
from ..model import Solution
from ..model.array_types import Array
from ..model.orientation import in_stored_frame

__all__ = ["Verdict", "advice_of", "degeneracy_of", "verdict_of"]

# Displacements below this are lost in the interpolation of a photo.
_UNSEEN_PX = 1.0
# A shutter that lowers the error of held-out measurements by less than this share may be noise.
_LEAST_GAIN = 0.01
# Of the scene's height: up to the first it is as good as photos measure, beyond the second it is no measurement. No
# standard deviation includes errors that all photos share (docs/found.md).
_SMALL_PERCENT, _LARGE_PERCENT = 0.5, 2.0

_HEADLINES = {"doubt": "Do not trust the height", "care": "Take the height with care"}
_NOT_EXAMINED = "How far the shape of the scene can be trusted was not examined."


@dataclass(frozen=True)
class Verdict:
    """How far a solution can be trusted.

    Attributes
    ----------
    level : str
        "trust", "care" (with a reservation), "doubt" (do not trust the shape of the scene) or "still" (there was
        nothing to correct).
    headline : str
        A few words.
    sentences : tuple of three str
        Number of photos, strength of the shutter, and whether the shape of the scene can be trusted and why.
    """

    level: str
    headline: str
    sentences: tuple[str, str, str]


def degeneracy_of(solution: Solution) -> CriticalMotion | None:
    """The degeneracy measure in the solution; None if it has none."""
    said = solution.critical_motion or {}
    try:
        values = np.array(said["singular_values"], float).reshape(5)
        null = np.array(said["null_vector"], float).reshape(5)
        spread = float(said["y_axis_spread_deg"])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    return CriticalMotion(values, null, spread, sum(image.posed for image in solution.registered))


def advice_of(solution: Solution) -> list[str]:
    """What to photograph at the next shoot, if the poses are critical: from the solution, else from the poses."""
    degeneracy = degeneracy_of(solution)
    said = (solution.critical_motion or {}).get("advice")
    if said or degeneracy is None or not degeneracy.is_low or degeneracy.num_photos < 2:
        return [str(each) for each in said or ()]
    return [each.sentence for each in advise_poses(*_poses(solution))]


def _poses(solution: Solution) -> tuple[Array, Array, list[str]]:
    """Rotations (m, 3, 3) and centres (m, 3) of the photos as they are stored, and how they were read."""
    stored = in_stored_frame(solution)
    images = [image for image in stored.registered if image.posed]
    R, centers = np.array([image.R_cw for image in images]), np.array([image.center_w for image in images])
    return R, centers, [stored.cameras[image.camera_id].readout for image in images]


def verdict_of(solution: Solution) -> Verdict:
    """The verdict on a solution, in the words of the report and of the command's closing lines.

    It is the one in the solution. Solutions of earlier versions have none: theirs follows from the height of the scene
    and the strength of the shutter alone.
    """
    taken_out = [image for image in solution.registered if not image.lens_only]
    shifts = [image.rs_shift_px for image in taken_out if image.rs_shift_px is not None]
    largest = max(shifts, default=None)
    level, headline, shape = _shape(solution, solution.verdict or _by_height(solution, largest), largest)
    return Verdict(level, headline, (_photos(solution), _strength(solution, shifts), shape))


def _photos(solution: Solution) -> str:
    count, registered = len(solution.images), len(solution.registered)
    where = "by their directions" if _only_rotated(solution) else "in one scene"
    if registered == count:
        return f"All {count} photos were registered {where}." if count > 1 else "The only photo has a motion."
    left = "1 was" if count - registered == 1 else f"{count - registered} were"
    return f"{registered} of {count} photos were registered {where}; {left} left out."


def _not_asked(solution: Solution) -> bool:
    """Whether no shutter was looked for: in a video the lines of the frames are, whatever was asked."""
    return (
        not _is_video(solution)
        and solution.shutter_model == "global"
        and solution.options.get("shutter_model") == "global"
    )


def _only_rotated(solution: Solution) -> bool:
    """Whether the camera of a video stayed in one place: there are directions, but no positions and no scene."""
    centers = [image.center_w for image in solution.registered if image.center_w is not None]
    return _is_video(solution) and len(centers) > 1 and not np.ptp(centers, axis=0).any()


def _stands(solution: Solution) -> bool:
    """Whether the camera of a video hardly moved at all."""
    return bool((solution.quality.get("readout_time") or {}).get("stands"))


def _is_video(solution: Solution) -> bool:
    return "readout_time" in solution.quality


def _strength(solution: Solution, shifts: list[float]) -> str:
    if solution.registered and all(image.lens_only for image in solution.registered):
        return "The photos were corrected for the lens only."
    if not shifts:
        return "The displacement by the shutter is not known."
    if _not_asked(solution):
        return "The shutter was not modelled, as you asked (--model global)."
    if solution.shutter_model == "global":
        if _is_video(solution):
            return "The lines of the frames do not rotate as the frames do: they were read at once."
        return "No rolling-shutter model predicted measurements better than a global shutter."
    largest, median = max(shifts), float(np.median(shifts))
    said = f"The rolling shutter displaced pixels by up to {_px(largest)}"
    if len(shifts) > 1:
        said += f", in half of the photos by more than {_px(median)}"
    before, after = solution.quality.get("global_rms_px"), solution.quality.get("rms_px")
    if before is None or after is None:
        return f"{said}."
    return f"{said}; modelling it reduced the residuals from {before:.2f} px to {after:.2f} px."


def _by_height(solution: Solution, largest: float | None) -> dict[str, Any]:
    """The verdict on a solution that has none."""
    if _not_asked(solution):
        return {"shutter": "not-determined", "shape": "doubtful", "reasons": []}
    if _unneeded(solution, largest):
        return {"shutter": "not-found", "shape": "trusted", "reasons": []}
    level, sentence = _height(solution)
    if degeneracy_of(solution) is None or "flagged" not in (solution.critical_motion or {}):
        level, sentence = "care", _NOT_EXAMINED
    return {"shutter": "found", "shape": "doubtful" if level else "trusted", "reasons": [sentence] if level else []}


def _shape(solution: Solution, said: Mapping[str, Any], largest: float | None) -> tuple[str, str, str]:
    """Level, headline and third sentence of a verdict."""
    shutter, trusted, reasons = said["shutter"], said["shape"] == "trusted", said["reasons"]
    if _not_asked(solution):
        text = "Whether the shape of the scene can be trusted is not known either: --model auto would say."
        return "care", "The shutter was not examined", text
    if trusted and shutter == "not-found":
        reason = _unneeded(solution, largest) or "no shutter can be seen"
        shape = "the shape of the scene is as good as that of a global shutter"
        if _only_rotated(solution):
            moves = "hardly moved" if _stands(solution) else "only rotated"
            shape = f"the camera {moves}, so that there is no scene"
        text = f"No correction is needed: {reason}, and {shape}."
        return "still", "No correction needed", text + _unseen(solution)
    level, sentence = _height(solution)
    if trusted and _only_rotated(solution):
        text = (
            "The camera only rotated: there are directions, but no positions and no scene whose shape could be wrong."
        )
        return "trust", "The rotations can be trusted", text
    if trusted:
        degeneracy = degeneracy_of(solution)
        why = "the cameras were rotated enough against each other to separate the shutter from the shape"
        if degeneracy is not None and degeneracy.is_low:
            why = f"although {_level(degeneracy)}, its height is determined"
        return "trust", "The shape can be trusted", f"The shape of the scene can be trusted: {why}. {sentence}"
    text = " ".join(reasons)
    if shutter == "not-determined":
        return "care" if solution.shutter_model == "global" else "doubt", "The shutter is not determined", text
    if reasons == [_NOT_EXAMINED]:
        return "care", "The shape was not examined", text
    if level and len(reasons) == 1:
        return level, _HEADLINES[level], sentence
    if _only_rotated(solution):
        return "doubt", "The rotations are doubtful", f"Do not trust the rotations. {text}"
    return "doubt", "The shape is doubtful", f"Do not trust the shape of the scene. {text}"


def _unseen(solution: Solution) -> str:
    """What would have stayed hidden in photos that show no shutter. Frames of a video show how they all move."""
    if _is_video(solution) or sum(image.posed for image in solution.registered) < 2:
        return ""
    degeneracy = critical_motion(*_poses(solution))
    if not degeneracy.is_low:
        return ""
    return f" Only a motion that all photos share would hardly show, because {_level(degeneracy)}."


def _height(solution: Solution) -> tuple[str, str]:
    """Level of doubt about the height of the scene ("doubt", "care" or ""), and a sentence on it."""
    said, degeneracy = solution.critical_motion or {}, degeneracy_of(solution)
    if degeneracy is None:
        return "", ""
    sigma = said.get("sigma_log_k")
    percent = float("inf") if sigma is None else 100 * float(sigma)  # undetermined
    sentence = _sentence(str(said.get("sentence") or ""))
    if degeneracy.is_low and said.get("remedy") == "none":
        known = f"to +-{percent:.2g} %" if np.isfinite(percent) else "and they leave it undetermined"
        return "doubt", (
            f"Do not trust the height of the scene: {_level(degeneracy)}, so it is undetermined to first order, and "
            f"with the remedy switched off only the model's second-order terms determine it ({known})."
        )
    if said.get("flagged") and percent > _LARGE_PERCENT:
        return "doubt", f"Do not trust the height of the scene. {sentence}"
    if percent > _SMALL_PERCENT:
        return "care", f"Take the height of the scene with care. {sentence}"
    return "", sentence


def _unneeded(solution: Solution, largest: float | None) -> str:
    """Why no correction is needed; empty if it is needed."""
    if solution.shutter_model == "global":
        return f"a global shutter explains the {'frames' if _is_video(solution) else 'photos'} as well"
    if largest is not None and largest < _UNSEEN_PX:
        return "the shutter displaced no pixel by as much as one"
    held_out = solution.quality.get("held_out_rms_px") or {}
    plain, ours = held_out.get("global"), held_out.get(solution.shutter_model)
    if plain and ours and ours > (1 - _LEAST_GAIN) * plain:
        return "without the shutter, held-out measurements are predicted as well"
    if _is_video(solution):
        return "the shutter displaced hardly anything by as much as a pixel"
    return ""


def _level(degeneracy: CriticalMotion) -> str:
    if degeneracy.num_photos < 3:
        return "there are too few photos"
    if degeneracy.y_axis_spread_deg < 1:
        return "all cameras were held level"
    if degeneracy.y_axis_spread_deg < 15:
        return "the cameras were held nearly level"
    return "the cameras were hardly rotated against each other"


def _sentence(text: str) -> str:
    """The text with a capital and a full stop; names of photos keep their letters."""
    text = text.strip()
    if text.split(" ")[0] in ("the", "no", "with"):
        text = text[0].upper() + text[1:]
    return f"{text}." if text and not text.endswith(".") else text


def _px(value: float) -> str:
    return f"{value:.0f} px" if value >= 10 else f"{value:.1f} px"
