"""The other scene that photos of a long lens show as well: its depths reversed.

Rays of a long lens are nearly parallel, and of parallel rays a scene and its mirror image, seen by cameras that are
rotated accordingly, make the same photos (Necker's reversal; Szeliski and Kang, "Shape ambiguities in structure from
motion", 1997). What little perspective distinguishes the two a strong shutter hides, until it is known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..bundle import BundleOptions, BundleResult, bundle_adjust
from ..model import Reconstruction
from .solutions import num_explained

__all__ = ["DepthChoice", "choose_depths", "with_depths_reversed"]


def with_depths_reversed(reconstruction: Reconstruction) -> Reconstruction:
    """The points mirrored in a plane across a view, and the cameras that parallel rays would show them to alike.

    Each camera sees the middle of the scene where it saw it, and all else as far behind it as it was before. Mirrored
    in another plane it would be the same scene in another frame.
    """
    rec = reconstruction
    middle = np.median(rec.points_w, axis=0)
    ahead = rec.R_cw[0, 2]
    mirror = np.eye(3) - 2.0 * np.outer(ahead, ahead)
    R_cw = np.diag([1.0, 1.0, -1.0]) @ rec.R_cw @ mirror
    middle_c = np.einsum("mij,mj->mi", rec.R_cw, middle - rec.center_w)
    center_w = middle - np.einsum("mji,mj->mi", R_cw, middle_c)
    return replace(rec, R_cw=R_cw, center_w=center_w, points_w=middle + (rec.points_w - middle) @ mirror)


@dataclass(frozen=True)
class DepthChoice:
    """Outcome of `choose_depths`.

    Attributes
    ----------
    result : BundleResult
        The solution that explains more measurements.
    explained, explained_reversed : int
        How many those are as it was, and with its depths reversed.
    """

    result: BundleResult
    explained: int
    explained_reversed: int

    @property
    def is_reversed(self) -> bool:
        """Whether the depths are the other way."""
        return self.explained_reversed > self.explained


def choose_depths(
    result: BundleResult, options: BundleOptions, progress: Callable[[float], None] | None = None
) -> DepthChoice:
    """The solution, or the one in which its depths are reversed, whichever explains more measurements.

    Parameters
    ----------
    result : BundleResult
        Of a model with a shutter.
    progress : callable, optional
        Called with the cost after each step.
    """
    rec = result.reconstruction
    options = replace(options, phi_sigma_start=result.phi_rms)
    other = bundle_adjust(with_depths_reversed(rec), rec.shutter_model, options, progress)
    explained, otherwise = num_explained(rec), num_explained(other.reconstruction)
    return DepthChoice(other if otherwise > explained else result, explained, otherwise)
