"""The readout time of a video and its evidence, for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..verdict.judge_path import problem_of

__all__ = ["readout_facts"]


def _time(evidence: Mapping[str, Any]) -> str:
    return f"{1e3 * evidence['seconds']:.1f} +- {1e3 * evidence['sigma']:.1f} ms"


def readout_facts(evidence: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Label and text of all that is known of a readout time.

    Parameters
    ----------
    evidence : mapping
        `quality.readout_time` of a solution.
    """
    source = evidence["source"]
    origin = source if source.startswith("what") else f"measured from {source}"
    # the ground truth of a clip has no share
    share = f" ({evidence['of_frame']:.2f} of the frame)" if "of_frame" in evidence else ""
    # a time that was known before need not follow from the video
    problem = "" if source.startswith("what") else problem_of(evidence)
    facts = [("readout time", f"not measured: {problem}" if problem else f"{_time(evidence)}{share}, {origin}")]
    halves = evidence.get("halves") or ()
    if halves:
        facts.append(("its halves say", " and ".join(_time(half) for half in halves)))
    for key, label in (("by_pictures", "pictures alone"), ("by_gyroscope", "by the gyroscope")):
        if evidence.get(key):
            facts.append((label, _time(evidence[key])))
    gyro = evidence.get("gyroscope")
    if gyro:
        offset, sigma = 1e3 * gyro["offset_s"], 1e3 * gyro["offset_sigma_s"]
        text = f"axes {gyro['axes']}, offset {offset:.1f} +- {sigma:.1f} ms, correlation {gyro['correlation']:.3f}"
        facts.append(("gyroscope", text))
    facts.append(("stabilisation", (evidence.get("stabilisation") or {}).get("reason") or "not examined"))
    return facts
