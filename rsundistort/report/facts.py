"""What is known of the map and of the readout time, for people: labels and texts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..verdict.judge_path import in_ms, problem_of

__all__ = ["map_facts", "map_rows", "readout_facts"]


def map_facts(georeference: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Label and text of all that is known of the frame, GPS, control points and speeds.

    Parameters
    ----------
    georeference : mapping or None
        `Solution.georeference`.
    """
    if georeference is None:
        return []
    facts = [("map", _frame(georeference))]
    if gps := georeference.get("gps"):
        text = f"{len(gps['photos'])} photos, {gps['median_m']:.2f} m off in the median"
        if gps["outliers"]:
            text += f"; rejected: {', '.join(gps['outliers'])}"
        if np.abs(gps["offset_m"]).max() > 0.005:
            east, north, up = gps["offset_m"]
            text += f"; moved by {east:+.2f}, {north:+.2f}, {up:+.2f} m to the control points"
        facts.append(("GPS", text))
    for use in ("control", "check"):
        off = np.array([each["residual_m"] for each in georeference.get("control", {}).values() if each["use"] == use])
        if len(off):
            across, up = np.sqrt(np.mean(off[:, 0] ** 2 + off[:, 1] ** 2)), np.sqrt(np.mean(off[:, 2] ** 2))
            facts.append((f"{use} points", f"{len(off)}, {across:.3f} m off across, {up:.3f} m in height (rms)"))
    facts += _speeds(list(georeference.get("speeds", {}).values()))
    if lengths := georeference.get("lengths"):
        facts.append(("known lengths", f"{lengths['ratio']:.4f} +- {lengths['sigma']:.4f} times as long on the map"))
    return facts + [("", note) for note in georeference.get("notes", ())]


def _frame(georeference: Mapping[str, Any]) -> str:
    crs, origin = georeference["crs"], georeference["origin"]
    where = {
        "local": f"east, north, up in metres at {origin[0]:.6f}, {origin[1]:.6f}, {origin[2]:.1f} m",
        "control": "that of the control points",
    }.get(crs, f"{crs}, less {origin[0]:.0f}, {origin[1]:.0f} m")
    if "sigma" not in georeference:
        return f"{where}, as in the model"
    place, rotation = georeference["sigma"]["place_m"], georeference["sigma"]["rotation_deg"]
    return (
        f"{where}; known to {max(place[:2]):.2g} m across, {place[2]:.2g} m in height, {max(rotation):.2g} deg, scale "
        f"{100 * georeference['sigma']['scale']:.2g} %"
    )


def _speeds(speeds: list[Mapping[str, Any]]) -> list[tuple[str, str]]:
    if not speeds:
        return []
    middle = np.median([each["speed_m_s"] for each in speeds])
    text = f"{middle:.1f} +- {np.median([each['sigma_m_s'] for each in speeds]):.1f} m/s in the median"
    by_gps = [each["gps_m_s"] for each in speeds if each["gps_m_s"] is not None]
    if by_gps:
        text += f", {np.median(by_gps):.1f} m/s by GPS"
    if any(each.get("held_by_gps") for each in speeds):
        text += ", whose velocity was used"
    return [("speed", text)]


def map_rows(georeference: Mapping[str, Any] | None) -> dict[str, list[dict[str, Any]]]:
    """Rows of the tables: control points, and photos with GPS, the one that is farthest off first."""
    if georeference is None:
        return {"control": [], "gps": []}
    control = [{"name": name, **each} for name, each in georeference.get("control", {}).items()]
    speeds = georeference.get("speeds", {})
    gps = [
        {"name": name, "speed": speeds.get(name), "off": float(np.linalg.norm(each["residual_m"])), **each}
        for name, each in georeference.get("gps", {}).get("photos", {}).items()
    ]
    return {"control": control, "gps": sorted(gps, key=lambda row: -row["off"])}


def _time(evidence: Mapping[str, Any]) -> str:
    return in_ms(evidence["seconds"], evidence["sigma"])


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
    problem = "" if source.startswith("what was") else problem_of(evidence)
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
