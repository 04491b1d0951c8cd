"""Photos whose pixels are not square: stretched by an editor, or squeezed by an anamorphic lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..bundle import BundleOptions, BundleResult, bundle_adjust
from ..errors import ReconstructionError
from ..input.photo_cameras import GUESS_SIGMA, PhotoCameras
from .outcome import Solved
from .run_options import SolveOptions
from .solutions import explains_most, explains_variation, leaves_less, needs_other_lens
from .tracks import rough_options

__all__ = ["cameras_if_stretched"]


def cameras_if_stretched(
    cameras: PhotoCameras, solved: Solved, options: SolveOptions, *, is_unexplained: bool
) -> tuple[PhotoCameras, list[str]] | None:
    """The cameras of photos with another fx than fy, if one stretch of all photos explains what was found, or left.

    Square pixels bend stretched photos by what each shows, so that motions and a lens that varies take it up. One
    adjustment with the measurements at hand tells: it has one unknown in place of these. Photos whose pixels are square
    leave as much with it, but for what noise may.

    Parameters
    ----------
    is_unexplained : bool
        Whether what was found leaves more of the photos than noise, or no shutter is determined. Of such photos, and
        those that need a lens that varies or a residual field, a stretch has to explain most, or the variation: it may
        take up a part of anything. Others must leave less by it.

    Returns
    -------
    cameras : PhotoCameras
        With fx and fy as that adjustment finds them.
    notes : list of str
        Which cameras, for people; None if pixels are square, or the cameras are given.
    """
    rec, given = solved.shared, cameras.sigma or [{}] * len(cameras.cameras)
    is_odd = is_unexplained or needs_other_lens(rec)
    if cameras.calibrated or any("fx" in each for each in given):
        return None
    usual = GUESS_SIGMA["f"]
    sigma = [{**each, "fx": each.get("f", usual), "fy": each.get("f", usual)} for each in given]
    stretched = replace(cameras, sigma=sigma)
    try:
        square, other = (_steady(solved, options.options_for(each)) for each in (cameras, stretched))
    except ReconstructionError:
        return None
    explained = explains_most(other, solved.result) or explains_variation(other, solved.result)
    explained = explained or (not is_odd and leaves_less(other, solved.result))
    if not explained or not leaves_less(other, square):
        return None
    found, notes = [], list[str]()
    for camera, estimate, label in zip(cameras.cameras, other.reconstruction.cameras, cameras.labels, strict=True):
        found.append(replace(camera, K=estimate.K))
        width = f"{estimate.K[1, 1] / estimate.K[0, 0]:.4f}"
        if float(width) != 1.0:
            notes.append(
                f"pixels of {label} are {width} times as wide as they are high by these photos (stretched, or by an "
                "anamorphic lens): solved with fx and fy"
            )
    return (replace(stretched, cameras=tuple(found)), notes) if notes else None


def _steady(solved: Solved, options: BundleOptions) -> BundleResult:
    """What was found, adjusted by a lens that does not vary."""
    rec, choice = solved.shared, solved.choice
    bends = 0 if choice is None else choice.bends
    how = replace(rough_options(options), varying=False, residual_field=False, bends=bends)
    lens = [camera.without_field() for camera in rec.cameras]
    return bundle_adjust(replace(rec, cameras=lens, variation=np.zeros(0)), rec.shutter_model, how)
