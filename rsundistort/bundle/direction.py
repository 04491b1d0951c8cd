"""Along which axis of its photos a camera is read out: the one that fits the measurements better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..model import Reconstruction, other_axis
from ..model.former_fields import former_fields
from .adjust import adjust_sequence
from .bundle_options import BundleOptions, BundleResult
from .held_out import clipped_errors, standard_errors

__all__ = ["ReadoutChoice", "choose_readouts"]

# The first guess is right far more often than not: it is given up for a gain of this many standard errors.
_MIN_GAIN = 5.0


@former_fields(turned="changed")
@dataclass(frozen=True)
class ReadoutChoice:
    """Outcome of `choose_readouts`.

    Attributes
    ----------
    reconstruction : Reconstruction
        As given, its cameras read out along the better axis.
    gain : dict of int to float
        For each camera that was open, how much the error would fall (if negative: rise) along the other axis than the
        one given, in units of the standard error of that fall over the points.
    """

    reconstruction: Reconstruction
    gain: dict[int, float]

    @property
    def changed(self) -> tuple[int, ...]:
        """Cameras whose axis is not the one given."""
        return tuple(camera for camera, gain in self.gain.items() if gain > _MIN_GAIN)


def choose_readouts(
    reconstruction: Reconstruction,
    open_cameras: Sequence[int],
    options: BundleOptions | None = None,
    *,
    progress: Callable[[str, float], None] | None = None,
) -> ReadoutChoice:
    """Fit the rotation model with each open camera read out along either axis, and keep what fits better.

    Both fits have the same unknowns and priors, so that nothing has to be held out to compare them.

    Parameters
    ----------
    reconstruction : Reconstruction
        Poses, points and measurements; its motions are not used.
    open_cameras : sequence of int
        Cameras whose direction is a guess.
    progress : callable, optional
        Called as (model, cost).
    """
    # constraints are meant for one axis; they do not decide between two
    rough = replace(
        options or BundleOptions(), outlier_rounds=0, prior_sigma_rounds=1, prior_sigma_tolerance=0.1,
        cost_tolerance=1e-3, held_phi={}, known_phi={}, still={}, lengths=(), deviations="model",
    )  # fmt: skip

    def fit(rec: Reconstruction) -> BundleResult:
        return adjust_sequence(rec, ("two-step", "rotation"), rough, progress)["rotation"]

    def errors_of(result: BundleResult) -> NDArray[Any]:
        errors = clipped_errors(result.reconstruction, reconstruction.observations, sigma_px)[0]
        return np.bincount(reconstruction.observations.point_idx, errors)

    photos = np.bincount(reconstruction.camera_idx, minlength=len(reconstruction.cameras))
    undecided = [camera for camera in open_cameras if photos[camera]]
    best, gains = reconstruction, dict[int, float]()
    if not undecided:
        return ReadoutChoice(best, gains)
    found = fit(best)
    best, sigma_px = found.reconstruction, found.sigma_px
    errors = errors_of(found)
    while undecided:
        # the clearest case first: while one camera is wrong, the others' evidence is drowned in its residuals
        others = {camera: _rotated(best, camera) for camera in undecided}
        other_errors = {camera: errors_of(fit(rec)) for camera, rec in others.items()}
        gains.update({camera: standard_errors(errors - each) for camera, each in other_errors.items()})
        clearest = max(undecided, key=lambda camera: gains[camera])
        if not gains[clearest] > _MIN_GAIN:
            break
        best, errors = others[clearest], other_errors[clearest]
        undecided = [camera for camera in undecided if camera != clearest and gains[camera] > -_MIN_GAIN]
    return ReadoutChoice(replace(reconstruction, cameras=best.cameras), gains)


def _rotated(reconstruction: Reconstruction, camera: int) -> Reconstruction:
    """The reconstruction with one camera read out along the other axis."""
    cameras = list(reconstruction.cameras)
    cameras[camera] = replace(cameras[camera], readout=other_axis(cameras[camera].readout))
    return replace(reconstruction, cameras=tuple(cameras))
