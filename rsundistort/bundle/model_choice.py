"""Which shutter model was kept, and what spoke for the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from .held_out import BENDS
from .known_motions import KnownMotions

__all__ = ["LEAST_RIVAL", "LEAST_SEEN_PX", "ModelChoice"]

#: Photos are displaced this much otherwise by a velocity that explains them as well, as a share of what is corrected.
LEAST_RIVAL = 1 / 3
#: Displacements below this, root mean square or mean over the photos, are not taken out of photos nor spoken of.
LEAST_SEEN_PX = 0.5
# Mean error of held-out measurements, 1 for noise alone, and pixels beyond it, that noise does not explain.
_NOT_NOISE, _HELD_OUT_PX = 2.0, 0.5


@dataclass(frozen=True)
class ModelChoice:
    """Outcome of `choose_model`. Keys are models, or say in words how a fit differs from the model alone.

    Attributes
    ----------
    shutter_model : str
        The last model that explained the held-out measurements better than the one kept before it.
    label : str
        Its key in what follows.
    varying : bool
        Whether the intrinsics vary from photo to photo, as `BundleOptions.varying`.
    shutter : {"found", "not-found", "not-determined"}
        Whether there is a rolling shutter: "not-determined" if something bends the photos that a shutter model explains
        in part, or no better than one that is read along the other axis.
    held_out_error : dict of str to float
        Mean over the held-out measurements of half the squared residual in units of the noise, clipped: 1 for noise
        alone. The choice depends on it.
    held_out_rms_px : dict of str to float
        Root mean square of the components of the held-out residuals, long ones clipped.
    gain : dict of str to float
        Fall of the held-out error against the one kept before, in units of the standard error of that fall. The first
        has none.
    left : dict of str to float
        Part of the held-out error that a smooth warp of each photo would still remove.
    kept : tuple of str
        Models that were kept, in order.
    agreement : float or None
        Correlation of the motions that two halves of the scene show, each alone; None if it was not computed.
    against : tuple of str
        Reasons against a shutter that explained something and was not kept, for people.
    num_held_out : int
        Measurements held out.
    residual_field : bool
        Whether cameras have fields beside their lens models, as `BundleOptions.residual_field`.
    bends : int
        Groups of bends of the motions, as `BundleOptions.bends`.
    restless : bool
        Whether the lines of the photos move faster than any of these models follows; not tested if a shutter is not
        determined.
    rival : float
        Of rotations: by how much a velocity that predicts the held-out measurements as well displaces the photos
        otherwise (the mean over the photos of their medians) over what the rotations displace them by. 0 where no
        velocity does as well, and where that is less than a tenth of a pixel.
    rival_px : float
        By how much, in pixels.
    steps : mapping of photo to 12 floats
        Of a shutter: how far the other model that moves its motions most would move them, as `BundleOptions.rival`.
    known_motions : KnownMotions or None
        What the photos say of motions that are known from elsewhere; None if none are.
    is_shared : bool
        Whether a velocity was kept since photos share it, which held-out measurements do not show.
    focal_px : mapping of photo to float
        Focal lengths of the photos where the lens varies; also where that explains much, but no shutter was found, and
        it is not kept. {} where it does not.
    """

    shutter_model: str
    label: str
    varying: bool
    shutter: str
    held_out_error: dict[str, float]
    held_out_rms_px: dict[str, float]
    gain: dict[str, float]
    left: dict[str, float]
    kept: tuple[str, ...]
    agreement: float | None
    against: tuple[str, ...]
    num_held_out: int
    residual_field: bool = False
    bends: int = 0
    restless: bool = False
    rival: float = 0.0
    steps: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    known_motions: KnownMotions | None = None
    is_shared: bool = False
    rival_px: float = 0.0
    focal_px: Mapping[str, float] = field(default_factory=dict)

    @property
    def has_rival(self) -> bool:
        """Whether a velocity explains the photos as well, and displaces them otherwise."""
        return self.rival >= LEAST_RIVAL

    @property
    def shows_rival(self) -> bool:
        """Whether that can be seen."""
        return self.has_rival and self.rival_px >= LEAST_SEEN_PX

    def unexplained_px(self, sigma_px: float) -> float:
        """How far held-out measurements are off beyond their noise; 0 if by little more than noise, or half a pixel."""
        error = self.held_out_error[self.label]
        beyond_px = sigma_px * float(np.sqrt(max(error - 1.0, 0.0)))
        return beyond_px if error > _NOT_NOISE and beyond_px > _HELD_OUT_PX else 0.0

    def with_velocity(self) -> ModelChoice:
        """The choice of a velocity beside steady rotations, if it was tried with the same lens; else this one."""
        # what a velocity explains as well as a rotation that changes is the one or the other
        label = "constant-motion" + self.label.removeprefix("rotation" + BENDS[self.bends])
        if label not in self.held_out_error:
            return self
        return replace(
            self,
            shutter_model="constant-motion",
            label=label,
            bends=0,
            kept=(*self.kept, label),
            rival=0.0,
            rival_px=0.0,
            steps={},
            is_shared=True,
        )
