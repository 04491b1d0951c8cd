"""The readout time of a video and its evidence, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..verdict.clip import problem_of

__all__ = ["readout_facts"]


def _time(told: Mapping[str, Any]) -> str:
    return f"{1e3 * told['seconds']:.1f} +- {1e3 * told['sigma']:.1f} ms"


def readout_facts(told: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Label and text of all that is known of a readout time.

    Parameters
    ----------
    told : mapping
        `quality.readout_time` of a solution.
    """
    source = told["source"]
    origin = source if source.startswith("what") else f"measured from {source}"
    share = f" ({told['of_frame']:.2f} of the frame)" if "of_frame" in told else ""  # the truth of a clip has none
    # a time that was known before need not follow from the video
    problem = "" if source.startswith("what") else problem_of(told)
    facts = [("readout time", f"not measured: {problem}" if problem else f"{_time(told)}{share}, {origin}")]
    halves = told.get("halves") or ()
    if halves:
        facts.append(("its halves say", " and ".join(_time(half) for half in halves)))
    for key, label in (("by_pictures", "pictures alone"), ("by_gyroscope", "by the gyroscope")):
        if told.get(key):
            facts.append((label, _time(told[key])))
    gyro = told.get("gyroscope")
    if gyro:
        offset, sigma = 1e3 * gyro["offset_s"], 1e3 * gyro["offset_sigma_s"]
        facts.append(
            (
                "gyroscope",
                f"axes {gyro['axes']}, offset {offset:.1f} +- {sigma:.1f} ms, correlation {gyro['correlation']:.3f}",
            )
        )
    facts.append(("stabilisation", (told.get("stabilisation") or {}).get("reason") or "not examined"))
    return facts
