"""Which shutter model the measurements support: the one that foretells measurements it was not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..model import Observations, Reconstruction
from .adjust import LADDER, bundle_adjust, objective
from .options import BundleOptions
from .problem import reprojection_residuals

__all__ = ["ModelChoice", "choose_model", "clipped_errors", "hold_out", "standard_errors"]

# A track gives one measurement away if this many are left: two fix the point, the third checks them.
_LEFT_OVER = 3
# Longer residuals, in standard deviations, count as this: a wrong match tells nothing about the shutter.
_CLIP = 5.0
# Parts of a photo, across and down, whose measurements count once.
_PARTS = 4
# A rung is kept if the held-out error falls by this many standard errors: of rungs that explain nothing, one in six
# would pass with one, one in forty does with two.
_MIN_GAIN = 2.0
# And by this share, and by more than what it leaves unexplained: where lens, focus and focal length leave residuals of
# some size, a motion that takes away less than that much may be one more guise of them. (The error is about 1 where
# noise is all there is. Warped herz-jesus-8: 23.6 global, 7.5 two-step, 2.4 rotation; but 2.4 to 2.4 with translation,
# which there was none of. A camera without rolling shutter: 3.05 global, 2.83 at best.)
_MIN_FALL = 0.02


@dataclass(frozen=True)
class ModelChoice:
    """Outcome of `choose_model`.

    Attributes
    ----------
    shutter_model : str
        The last rung that explained the held-out measurements better than the one kept before it.
    held_out_error : dict of model to float
        Mean over the held-out measurements of half the squared residual in units of the noise, clipped: 1 for noise
        alone. This decides.
    held_out_rms_px : dict of model to float
        Root mean square of the held-out residuals' parts, long ones clipped.
    gain : dict of model to float
        How much the held-out error fell against the rung kept before, in units of the standard error of that fall. The
        first rung has none.
    num_held_out : int
        Measurements held out.
    """

    shutter_model: str
    held_out_error: dict[str, float]
    held_out_rms_px: dict[str, float]
    gain: dict[str, float]
    num_held_out: int

    @property
    def kept(self) -> tuple[str, ...]:
        """Rungs that were kept: the first, and those whose gain was large enough."""
        return tuple(model for model in self.held_out_error if self.gain.get(model, np.inf) > _MIN_GAIN)


def hold_out(
    reconstruction: Reconstruction, share: float = 0.1, seed: int = 0
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks (o,) of the measurements to fit and of those to hold out.

    At most one measurement of a track is held out, and only of tracks of at least four photos; of three where none is
    longer.
    """
    obs = reconstruction.observations
    rng = np.random.default_rng([seed, 7])
    lengths = np.bincount(obs.point_idx, minlength=reconstruction.num_points)
    spare = np.flatnonzero(lengths > min(_LEFT_OVER, lengths.max(initial=0) - 1))
    wanted = min(round(share * len(obs)), len(spare))
    chosen = rng.permutation(spare)[:wanted]
    # a random measurement of each chosen point: the first of its own in a random order
    order = rng.permutation(len(obs))
    first = np.full(reconstruction.num_points, -1)
    first[obs.point_idx[order[::-1]]] = order[::-1]
    held = np.zeros(len(obs), bool)
    held[first[chosen]] = True
    return ~held, held


def clipped_errors(rec: Reconstruction, measured: Observations, sigma_px: float) -> tuple[NDArray[np.float64], float]:
    """Half the clipped squared residual of each measurement in units of the noise, and their rms in pixels."""
    res, valid = reprojection_residuals(replace(rec, observations=measured))
    noise = sigma_px * measured.sigma
    square = np.where(valid, (res**2).sum(1) / noise**2, np.inf)
    clipped = np.minimum(square, 2 * _CLIP**2)
    return clipped / 2, float(np.sqrt(np.mean(clipped * noise**2) / 2))


def standard_errors(fall: NDArray[np.float64], group: NDArray[np.int64] | None = None) -> float:
    """Mean fall of errors in units of its standard error; 0 if nothing fell.

    Measurements of a group (n,) go up and down together, and count once: what the lens does in a corner of a photo, it
    does to all measurements there (the cluster-robust variance of a mean).
    """
    rest = fall - fall.mean() if len(fall) else fall
    sums = rest if group is None else np.bincount(np.unique(group, return_inverse=True)[1], rest)
    if len(sums) < 2:
        return 0.0
    spread = float(np.sqrt((sums**2).sum() * len(sums) / (len(sums) - 1))) / len(fall)
    return float(fall.mean() / spread) if spread > 0 else 0.0


def corners(rec: Reconstruction, measured: Observations) -> NDArray[np.int64]:
    """(n,) groups of measurements: those in one of 4 x 4 parts of one photo."""
    size = np.array([(camera.width, camera.height) for camera in rec.cameras])[rec.camera_idx][measured.frame_idx]
    x, y = np.clip(_PARTS * (measured.xy_raw + 0.5) / size, 0, _PARTS - 1).astype(np.int64).T
    return np.asarray((measured.frame_idx * _PARTS + y) * _PARTS + x)


def choose_model(
    reconstruction: Reconstruction,
    rungs: Sequence[str] = LADDER,
    options: BundleOptions | None = None,
    *,
    sigma_px: float,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> ModelChoice:
    """Fit each rung to nine tenths of the measurements, and keep it only if it foretells the rest better.

    Better means: the mean held-out error falls by more than two standard errors, measurements in the same part of the
    same photo counted once, by more than two hundredths, and by more than it stays above what noise alone would give.

    Parameters
    ----------
    reconstruction : Reconstruction
        Measurements without gross outliers, and a start.
    rungs : sequence of str
        Models in the order of the ladder.
    options : BundleOptions, optional
        Of the fits, which are rough and of plain squares.
    sigma_px : float
        Noise of the measurements, as the last adjustment found it.
    seed : int
        Of the choice of measurements.
    progress : callable, optional
        Called as (model, cost).
    """
    fitted, held = hold_out(reconstruction, seed=seed)
    base = options or BundleOptions()
    # the gross outliers are gone: squares, and no closer than tells one rung from the next
    rough = replace(
        base, outlier_rounds=0, spread_rounds=4, spread_tolerance=0.05, loss="squared", sigma_px=sigma_px,
        cost_tolerance=1e-5, lengths=(), deviations="model",
    )  # fmt: skip
    given = replace(reconstruction, observations=reconstruction.observations.select(fitted))
    held_out = reconstruction.observations.select(held)
    group = corners(reconstruction, held_out)
    starts = [given]
    chosen, best = rungs[0], np.zeros(0)
    error: dict[str, float] = {}
    rms: dict[str, float] = {}
    gain: dict[str, float] = {}
    for model in rungs:
        step = None if progress is None else (lambda cost, model=model: progress(model, cost))
        # the motions given belong to the poses and the lens given: with those of another rung they fit nothing. A rung
        # that starts at the cheaper of the two never ends above the simpler one, which it holds as a case
        cost = [objective(start, model, rough) for start in starts]
        found = bundle_adjust(starts[int(np.argmin(cost))], model, rough, step).reconstruction
        starts = [found, given]
        errors, rms[model] = clipped_errors(found, held_out, sigma_px)
        error[model] = float(errors.mean())
        if model == rungs[0]:
            best = errors
            continue
        fall = best - errors
        gain[model] = standard_errors(fall, group)
        if gain[model] > _MIN_GAIN and fall.mean() > max(_MIN_FALL * best.mean(), errors.mean() - 1.0):
            chosen, best = model, errors
    return ModelChoice(chosen, error, rms, gain, int(held.sum()))
