"""Whether the frames of a clip are as the sensor read them, or were rotated since."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..bundle.own_motions import OwnMotions
from ..bundle.path_prior import FramePath
from ..input.key_frames import Clip
from ..input.stabilisation import Stabilisation, calmer_than_felt, judge_stabilisation
from ..io.gyro import GyroLog
from ..model import Reconstruction
from ..model.array_types import Array, Index
from .clip_gyroscope import Felt, rotations_between

__all__ = ["against_telemetry", "as_filmed", "stabilisation_of", "was_stabilised"]


def as_filmed(
    clip: Clip, start: Reconstruction, path: FramePath, telemetry: GyroLog | None, found: OwnMotions
) -> tuple[FramePath, Stabilisation]:
    """Whether frames are as the sensor read them, and the path of those that can share one.

    The shutter of frames that were rotated since is not that of their path, and any readout time would be wrong. The
    telemetry is the video's own.
    """
    filmed = stabilisation_of(clip, start, found)
    if not filmed.shows_shaking:  # poses without a path say little else
        filmed = replace(filmed, verdict="unknown" if filmed.verdict == "stabilised" else filmed.verdict)
    if telemetry is not None:
        filmed = against_telemetry(clip, start, found.R_cw, found, telemetry, filmed)
    return (path.at_once if was_stabilised(filmed) else path), filmed


def against_telemetry(
    clip: Clip, rec: Reconstruction, R_cw: Array, own: OwnMotions, telemetry: GyroLog,
    filmed: Stabilisation,
) -> Stabilisation:  # fmt: skip
    """The verdict on frames that rotate by less than the video's own telemetry, unless their lines rotate as they do.

    Lines agree with frames if a lens moves against the shaking.
    """
    if filmed.verdict == "none":
        return filmed
    place = clip.places(rec.image_names)
    pairs, rotations = rotations_between(clip.part[place], R_cw)
    reason = calmer_than_felt(clip.time_s[place], pairs, rotations, _rotation_sigma(own, pairs), telemetry)
    return replace(filmed, verdict="stabilised", reason=reason) if reason else filmed


def was_stabilised(filmed: Stabilisation | None) -> bool:
    """Whether the frames were rotated since they were read."""
    return filmed is not None and filmed.verdict == "stabilised"


def stabilisation_of(clip: Clip, rec: Reconstruction, found: OwnMotions, felt: Felt | None = None) -> Stabilisation:
    """Whether the lines of the frames move as the frames do, each frame having its own motion."""
    place = clip.places(rec.image_names)
    pairs, rotations = rotations_between(clip.part[place], found.R_cw)
    span = rec.frame_span()[:, None]
    log, offset_s = (None, 0.0) if felt is None else (felt.log, felt.alignment.offset_s)
    return judge_stabilisation(
        clip.time_s[place], pairs, rotations, found.phi * span, found.sigma_phi * span, log=log, offset_s=offset_s,
        rotation_sigma=_rotation_sigma(found, pairs),
    )  # fmt: skip


def _rotation_sigma(found: OwnMotions, pairs: Index) -> Array:
    """(n, 3) standard deviations of the rotations between pairs of frames."""
    sigma: Array = np.linalg.norm(found.sigma_rotation[pairs], axis=1)
    return sigma
