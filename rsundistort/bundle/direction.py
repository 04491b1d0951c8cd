"""Along which axis of its photos a camera is read out: the one whose fit foretells held-out measurements better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..model import READOUTS, Reconstruction
from .adjust import climb
from .choice import held_out_errors, hold_out, standard_errors
from .options import BundleOptions

__all__ = ["ReadoutChoice", "choose_readouts"]

# The first guess is right far more often than not: it is given up for a gain of this many standard errors.
_MIN_GAIN = 3.0
# Reversing the readout negates the motion and changes nothing else, so one direction of each axis is tried.
_OTHER_AXIS = ("top-to-bottom", "left-to-right")


@dataclass(frozen=True)
class ReadoutChoice:
    """Outcome of `choose_readouts`.

    Attributes
    ----------
    reconstruction : Reconstruction
        As given, its cameras read out along the better axis.
    gain : dict of int to float
        For each camera that was open, how much the held-out error would fall (if negative: rise) along the other axis
        than the one given, in units of the standard error of that fall.
    """

    reconstruction: Reconstruction
    gain: dict[int, float]

    @property
    def turned(self) -> tuple[int, ...]:
        """Cameras whose axis is not the one given."""
        return tuple(camera for camera, gain in self.gain.items() if gain > _MIN_GAIN)


def choose_readouts(
    reconstruction: Reconstruction,
    open_cameras: Sequence[int],
    options: BundleOptions | None = None,
    *,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> ReadoutChoice:
    """Fit the rotation model with each open camera read out along either axis, and keep what foretells better.

    Parameters
    ----------
    reconstruction : Reconstruction
        Poses, points and measurements; its motions are not used.
    open_cameras : sequence of int
        Cameras whose direction is a guess.
    options : BundleOptions, optional
        Of the fits.
    seed : int
        Of the choice of measurements.
    progress : callable, optional
        Called as (model, cost).
    """
    fitted, held = hold_out(reconstruction, seed=seed)
    obs = reconstruction.observations
    held_out = obs.select(held)
    # anchors are meant for one axis; neither they nor a lens decide between two
    rough = replace(
        options or BundleOptions(), outlier_rounds=0, spread_rounds=2, spread_tolerance=0.1, cost_tolerance=1e-4,
        held_phi={}, known_phi={}, lengths=(), refine=(),
    )  # fmt: skip

    def fit(rec: Reconstruction) -> tuple[Reconstruction, float]:
        start = replace(rec, observations=obs.select(fitted))
        result = climb(start, ("two-step", "rotation"), rough, progress)["rotation"]
        return result.reconstruction, result.sigma_px

    photos = np.bincount(reconstruction.camera_idx, minlength=len(reconstruction.cameras))
    undecided = [camera for camera in open_cameras if photos[camera]]
    best, gains = reconstruction, dict[int, float]()
    if not undecided or not held.any():
        return ReadoutChoice(best, gains)
    found, sigma_px = fit(best)
    errors = held_out_errors(found, held_out, sigma_px)[0]
    while undecided:
        # the clearest case first: while one camera is wrong, the others' evidence is drowned in its residuals
        others = {camera: _turned(best, camera) for camera in undecided}
        other_errors = {camera: held_out_errors(fit(rec)[0], held_out, sigma_px)[0] for camera, rec in others.items()}
        gains.update({camera: standard_errors(errors - each) for camera, each in other_errors.items()})
        clearest = max(undecided, key=lambda camera: gains[camera])
        if not gains[clearest] > _MIN_GAIN:
            break
        best, errors = others[clearest], other_errors[clearest]
        undecided.remove(clearest)
    return ReadoutChoice(best, gains)


def _turned(reconstruction: Reconstruction, camera: int) -> Reconstruction:
    """The reconstruction with one camera read out along the other axis."""
    cameras = list(reconstruction.cameras)
    cameras[camera] = replace(cameras[camera], readout=_OTHER_AXIS[READOUTS[cameras[camera].readout][0]])
    return replace(reconstruction, cameras=tuple(cameras))
