"""Cameras that shake faster than the frames of a video show, whose path says nothing about their readout time."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from ..bundle import BundleResult
from ..bundle.own_motions import OwnMotions
from ..bundle.path_prior import FramePath
from ..errors import RsUndistortWarning
from ..input.key_frames import Clip
from ..model import Reconstruction
from ..verdict.judge_path import SIGMAS
from ..verdict.speeds import BySpeed, readouts_by_speed

__all__ = ["held_by_slow_rotations", "speeds_of", "tell_if_held", "with_slow_rotations"]

# Share of what lines show that may not be in the frames: 0.01 at most where a path follows its camera, 0.3 and more
# where it does not.
_UNFOLLOWED = 0.1
# A smaller displacement by what is not in the frames, in pixels, is what lens and scene leave.
_UNFOLLOWED_PX = 0.1
# The readout time of slow rotations is one if it is known to this share of itself.
_KNOWN = 0.5
# Standard deviation that holds a readout time, by its own: it must not move where a path pulls it.
_HELD = 0.02
# Slow rotations alone count at the end, unless what else was known made the readout time more exact by this.
_AS_EXACT = 1.5


def speeds_of(
    clip: Clip, rec: Reconstruction, found: OwnMotions, readout_s: float, *, fills: bool = True
) -> BySpeed | None:
    """What slow and fast rotations of frames say, each having its own motion; about a readout time.

    Frames that are missing are filled in, if wanted.
    """
    place, span = clip.places(rec.image_names), rec.frame_span()[:, None]
    return readouts_by_speed(
        clip.time_s[place], clip.part[place], found.R_cw, found.sigma_rotation, found.phi * span,
        found.sigma_phi * span, readout_s, fills=fills,
    )  # fmt: skip


def held_by_slow_rotations(
    clip: Clip, rec: Reconstruction, path: FramePath, found: OwnMotions, *, fills: bool = True
) -> FramePath:
    """The path, its readout time held where the camera shakes faster than its frames show.

    A path through such frames is too smooth: lines rotate faster than it does, which looks like a longer readout.
    Slow rotations are the same in lines and frames, and what is known of the readout counts beside them; if it
    contradicts them, something else bends the lines, and nothing is held. Motions that were found before any path are
    too rough to fill in frames that are missing.
    """
    about = path.readout_prior[0] * path.frame_s
    for _ in range(2):  # lines average over the readout, so that it counts a little
        speeds = speeds_of(clip, rec, found, about, fills=fills)
        if speeds is None or speeds.slow is None or not speeds.unfollowed > _UNFOLLOWED:
            return path
        if speeds.unfollowed_rad * rec.cameras[0].K[0, 0] < _UNFOLLOWED_PX:
            return path
        seconds, sigma = speeds.slow
        about = seconds
    if path.readout is not None:
        if abs(seconds - path.readout[0]) > SIGMAS * np.hypot(sigma, path.readout[1]):
            return path  # something else bends the lines
        weights = sigma**-2.0, path.readout[1] ** -2.0
        seconds = (weights[0] * seconds + weights[1] * path.readout[0]) / sum(weights)
        sigma = sum(weights) ** -0.5
    if not 0 < sigma < _KNOWN * abs(seconds):
        return path
    return replace(path, readout=(seconds, _HELD * sigma), held_sigma=sigma)


def with_slow_rotations(result: BundleResult, path: FramePath, speeds: BySpeed | None) -> BundleResult:
    """The readout time of slow rotations in place of the one at which the path was held, if it was.

    `speeds` are those about the path that was found, whose bends make them more exact than they were before it. The
    difference from the time that was held counts as a part of the standard deviation. Where they are less exact, so is
    the time that was held: it is that of a path that is no better known.
    """
    found, slow = result.path, None if speeds is None else speeds.slow
    if not path.held_sigma or slow is None or found is None:
        return result
    if not slow.sigma < _AS_EXACT * path.held_sigma:
        return replace(result, path=replace(found, sigma_readout_s=np.maximum(found.sigma_readout_s, slow.sigma)))
    sigma = np.hypot(slow.sigma, slow.seconds - found.readout_s)
    return replace(result, path=replace(found, readout_s=np.full_like(sigma, slow.seconds), sigma_readout_s=sigma))


def tell_if_held(path: FramePath) -> None:
    """Warn if the readout time is that of slow rotations."""
    if path.held_sigma:
        warnings.warn(
            "the camera shakes faster than half of the frame rate: lines show rotations that are not in the frames; "
            "the readout time is that of slow rotations",
            RsUndistortWarning, stacklevel=4,
        )  # fmt: skip
