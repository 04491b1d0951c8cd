"""The lens of a video: held, of one focal length or of one that varies, and whether a path settled on it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from ..batch.progress import StageLog
from ..bundle import BundleOptions, BundleResult, bundle_adjust
from ..bundle.held_out import MIN_FALL
from ..model import Camera, Reconstruction
from ..verdict.judge_path import SIGMAS
from .clip_gyroscope import readout_of
from .tracks import rough_options, tell

__all__ = ["at_first", "if_it_focuses", "is_other_lens", "unsettled", "with_known_lens", "with_unknown_lens"]

# Relative fall of the cost that ends an adjustment of a path that another one follows.
_ROUGH_COST = 1e-4
# A focal length changes from frame to frame, by focusing or zooming, if a first adjustment finds it to vary by more
# (relative standard deviation). That one does not know the path well yet: where the lens stays it finds up to 2.4e-4.
_FOCUSES = 5e-4
# A path is found again if it moved the focal length by this share.
_SOLVED_BY = 0.03
# So it is if its readout time moved by this share of the time between frames.
_SETTLED_BY = 0.01


def at_first(options: BundleOptions) -> BundleOptions:
    """Options of an adjustment of a path that is followed by another one."""
    return replace(
        rough_options(options), outlier_rounds=2, prior_sigma_rounds=1, cost_tolerance=_ROUGH_COST, deviations="model",
        varying=True,
    )  # fmt: skip


def if_it_focuses(options: BundleOptions, first: BundleResult) -> BundleOptions:
    """Options with a focal length that varies from frame to frame, if a first adjustment shows that."""
    if first.focal_sigma < _FOCUSES:
        return options
    return replace(options, varying=True, focal_sigma_start=first.focal_sigma)


def with_unknown_lens(whole: Reconstruction, options: BundleOptions, log: StageLog) -> BundleResult:
    """A path by a focal length of all frames; then by one that varies, if that explains them better.

    One that varies at once makes up for a wrong one, frame by frame. The rest of the lens is mapping's as yet: it would
    take the lines' rotations for itself.
    """
    options = replace(options, refine=("f",))
    steady = bundle_adjust(whole, "constant-motion", replace(options, varying=False), partial(tell, log, "path"))
    assert options.path is not None
    # both at once run away: a scene that zooms in may as well come nearer
    options = replace(options, refine=(), path=replace(options.path, start=steady.path_start()))
    varying = bundle_adjust(steady.reconstruction, "constant-motion", options, partial(tell, log, "path"))
    return varying if _explains_more(varying, steady) else steady


def with_known_lens(whole: Reconstruction, options: BundleOptions, log: StageLog) -> BundleResult:
    """A path by a focal length that varies; by one of all frames, if that one varies and explains them no better.

    A focal length that varies takes travel for zoom.
    """
    varying = bundle_adjust(whole, "constant-motion", options, partial(tell, log, "path"))
    if varying.focal_sigma < _FOCUSES:
        return varying
    steady = bundle_adjust(whole, "constant-motion", replace(options, varying=False), partial(tell, log, "path"))
    return varying if _explains_more(varying, steady) else steady


def _explains_more(varying: BundleResult, steady: BundleResult) -> bool:
    """Whether a lens that varies explains the frames better."""
    return bool(varying.sigma_px**2 < (1 - MIN_FALL) * steady.sigma_px**2)


def is_other_lens(found: BundleResult, assumed: Camera, tolerance: float) -> bool:
    """Whether a scene would be another one by the focal length that its path found."""
    return bool(abs(np.log(found.reconstruction.cameras[0].K[0, 0] / assumed.K[0, 0])) > tolerance)


def unsettled(found: BundleResult, before: BundleResult, frame_s: float, *, by_lens: bool) -> float:
    """How far a path moved, in what would have changed its points: focal lengths, and the readout time.

    The readout time counts if it has moved beyond its deviations.
    """
    now, then = readout_of(found), readout_of(before)
    apart = abs(now.seconds - then.seconds)
    of_readout = apart / (_SETTLED_BY * frame_s) if apart > SIGMAS * now.sigma else 0.0
    lens = before.reconstruction.cameras[0]
    of_lens = abs(np.log(found.reconstruction.cameras[0].K[0, 0] / lens.K[0, 0])) / _SOLVED_BY if by_lens else 0.0
    return float(max(of_lens, of_readout))
