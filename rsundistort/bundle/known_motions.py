"""Motions that are known from elsewhere, such as a gyroscope's, held against those that photos show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..model import Reconstruction
from ..model.array_types import Array
from .bundle_options import BundleOptions
from .held_out import ModelFit, ModelFits

__all__ = ["FAR", "KnownMotions", "compare_known_motions", "judge_known_motions", "misses_of"]

#: Motions contradict photos by this many standard errors, or of their own standard deviations.
FAR = 3.0


@dataclass(frozen=True)
class KnownMotions:
    """What photos say of motions that are known from elsewhere.

    Attributes
    ----------
    gain : float
        Fall of the held-out error by these motions, none of them fitted, against no motions, in standard errors.
    is_better : bool
        Whether that fall counts as better.
    free_gain : float
        Fall of the held-out error if motions are fitted that the photos alone show, against those that keep to what is
        known of them, in standard errors.
    miss : float
        By how many of their standard deviations those differ from the fitted ones; root mean square.
    size : float
        The known motions themselves in units of their standard deviations; root mean square.
    """

    gain: float
    is_better: bool
    free_gain: float
    miss: float
    size: float

    @property
    def is_contradicted(self) -> bool:
        """Whether they are large motions that are not those of the photos.

        They predict the photos worse than none does, or no better while the photos show others. Small ones are never
        contradicted: photos that seem to move while a gyroscope rests show an error of the lens.
        """
        if self.is_better or self.size <= FAR:
            return False
        return self.gain <= -FAR or max(self.free_gain, self.miss) >= FAR


def misses_of(reconstruction: Reconstruction, known: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> float:
    """Root mean square of differences from known motions in units of their standard deviations; 0 without any."""
    rec, span = reconstruction, reconstruction.frame_span()
    places = [i for i, name in enumerate(rec.image_names) if name in known]
    motions, sigmas = zip(*(known[rec.image_names[i]] for i in places), strict=True) if places else ((), ())
    return _in_sigmas(rec.phi[places] * span[places, None] - np.reshape(motions, (-1, 3)), np.reshape(sigmas, (-1, 3)))


def _in_sigmas(values: Array, sigmas: Array) -> float:
    """Root mean square of (n, 3) values in units of their standard deviations; infinite ones are of unknown values."""
    known = np.isfinite(sigmas)
    return float(np.sqrt(np.mean((values[known] / sigmas[known]) ** 2))) if known.any() else 0.0


def compare_known_motions(fits: ModelFits, plain: ModelFit, best: ModelFit) -> KnownMotions | None:
    """The known motions against the best model with a shutter, or rotations, and against `plain`, without one.

    None if no motions are known, or no measurements are held out to judge by.
    """
    exactly = fits.by_known_motions(plain)
    if exactly is None:
        return None
    if best.model == "global":
        best = fits.fit("rotation", best.varying, [plain.reconstruction, fits.given])
    known = fits.known_phi
    motions, sigmas = (np.array(each, float) for each in zip(*known.values(), strict=True))
    return KnownMotions(
        gain=fits.gain(plain, exactly),
        is_better=fits.is_better(plain, exactly),
        free_gain=fits.gain(best, fits.without_known_motions(best)),
        miss=misses_of(best.reconstruction, known),
        size=_in_sigmas(motions, sigmas),
    )


def judge_known_motions(
    reconstruction: Reconstruction, model: str, options: BundleOptions, *, sigma_px: float, seed: int = 0
) -> KnownMotions | None:
    """As `choose_model` does, of a model that was specified: the arguments are those of `choose_model`."""
    fits = ModelFits(reconstruction, options, sigma_px, seed, None)
    plain = fits.fit("global", options.varying, [fits.given])
    best = fits.fit(model, options.varying, [plain.reconstruction, fits.given], bends=options.bends)
    return compare_known_motions(fits, plain, best)
