"""What people are told where photos contradict motions that are known from elsewhere."""

from __future__ import annotations

from collections.abc import Mapping

from numpy.typing import ArrayLike

from ..bundle import FAR, KnownMotions, misses_of
from ..model import Reconstruction

__all__ = ["known_contradiction"]


def known_contradiction(
    rec: Reconstruction,
    from_gyro: Mapping[str, tuple[ArrayLike, ArrayLike]],
    specified: Mapping[str, tuple[ArrayLike, ArrayLike]],
    evidence: KnownMotions | None = None,
) -> str | None:
    """A warning, if a solution contradicts the motions that are known, by a gyroscope or as the user specified them.

    Motions that `evidence` contradicts were left out of the solution; others are compared with its own motions.
    """
    if not from_gyro and not specified:
        return None
    sources, checks = [], []
    if from_gyro:
        sources.append("the gyroscope")
        checks.append(
            "the offset of its clock (--gyro-offset), its axes (--gyro-axes) and the time of the readout (--readout-ms)"
        )
    if specified:
        sources.append("the known motions (--known)")
        checks.append("to which photos they belong, their signs, and their unit, radians")
    source, check = " and ".join(sources), f"check {', and '.join(checks)}"
    if evidence is not None and evidence.is_contradicted:
        than = f"{'worse' if evidence.gain < 0 else 'no better'} than none (by {evidence.gain:+.1f} standard errors)"
        return (
            f"the photos contradict {source}, whose motions were left out: they predict the photos {than}; {check}, or "
            "the camera has no rolling shutter, or stabilises its photos"
        )
    if rec.shutter_model == "global":
        return None
    far = misses_of(rec, dict(specified) | dict(from_gyro))
    if far <= FAR:
        return None
    return f"the photos contradict {source}, by {far:.0f} times the uncertainty of these motions; {check}"
