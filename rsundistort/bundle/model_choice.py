"""Which shutter model was kept, and what spoke for the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ..model import Reconstruction
from .held_out import BENDS
from .known_motions import KnownMotions
from .rivals import LEAST_RIVAL, Rival, largest_steps, moved_otherwise

__all__ = ["ModelChoice"]


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
        velocity does as well, and where that is less than half a pixel.
    others : mapping of str to Rival
        Of a shutter: the models beside it that may be right.
    names : tuple of str
        The photos, in the order of what the others move.
    known_motions : KnownMotions or None
        What the photos say of motions that are known from elsewhere; None if none are.
    is_shared : bool
        Whether a velocity was kept since photos share it, which held-out measurements do not show.
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
    others: Mapping[str, Rival] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    known_motions: KnownMotions | None = None
    is_shared: bool = False

    @property
    def has_rival(self) -> bool:
        """Whether a velocity explains the photos as well, and displaces them otherwise."""
        return self.rival >= LEAST_RIVAL

    @property
    def steps(self) -> dict[str, tuple[float, ...]]:
        """How far the other model that moves its motions most would move each photo, as `BundleOptions.rival`."""
        return largest_steps(self.others, self.names)

    def with_rival(self, rotating: Reconstruction, travelling: Reconstruction) -> ModelChoice:
        """The choice of rotations, with a velocity beside them as both were adjusted to all measurements.

        What it was in the fits that held measurements out took noise as independent, and photos as sharing more of a
        motion than they do.
        """
        label = self.with_velocity().label
        velocity = Rival.of(travelling, rotating, self.others[label].probability)
        others = {key: each for key, each in self.others.items() if each.model != velocity.model} | {label: velocity}
        return replace(self, rival=moved_otherwise(rotating, travelling), others=others)

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
            others={},
            is_shared=True,
        )
