"""What `evaluate` and `analyze` find, as values; `to_json` is what their commands print."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from ..critical import CriticalMotion
from ..model.former_fields import former_fields

__all__ = ["ErrorSummary", "Evaluation", "PhiErrorSummary", "PoseAnalysis", "PsnrSummary"]


class _FormerlyDict:
    """Results were dicts: their entries answer until the next version."""

    def to_json(self) -> dict[str, Any]:
        raise NotImplementedError

    def __getitem__(self, key: str) -> Any:
        self._warn()
        return self.to_json()[key]

    def __contains__(self, key: str) -> bool:
        self._warn()
        return key in self.to_json()

    def _warn(self) -> None:
        name = type(self).__name__
        warnings.warn(f"{name} is no dict: use its fields, or {name}.to_json()", DeprecationWarning, stacklevel=3)


@dataclass(frozen=True)
class ErrorSummary:
    """Errors of all photos in three figures, in the unit of the field that holds them."""

    mean: float
    median: float
    max: float


@dataclass(frozen=True)
class PhiErrorSummary(ErrorSummary):
    """Absolute errors of the components of phi; `mean_per_component` has those of x, y and z apart."""

    mean_per_component: tuple[float, float, float]


@dataclass(frozen=True)
class PsnrSummary:
    """Peak signal-to-noise ratios, dB: median and least of the photos, and each photo's by its name."""

    median: float
    min: float
    photos: Mapping[str, float]


@dataclass(frozen=True)
class Evaluation(_FormerlyDict):
    """Outcome of `evaluate`. None where there is nothing to compare with.

    Attributes
    ----------
    photos, registered : int
        Photos of the solution, and those that it has a pose of.
    rotation_deg : ErrorSummary or None
        Angles left after the common rotation that best aligns all orientations, degrees.
    center : ErrorSummary or None
        Distances left after the similarity that best aligns the camera centres, in mean distances of consecutive ones.
    phi_mrad_per_frame : PhiErrorSummary
        Errors of the rotation during the readout, milliradians per frame.
    psnr_db : PsnrSummary or None
        Rectified photos against their global-shutter references.
    psnr_before_db : PsnrSummary or None
        Photos as they were taken against the same.
    """

    photos: int
    registered: int
    rotation_deg: ErrorSummary | None
    center: ErrorSummary | None
    phi_mrad_per_frame: PhiErrorSummary
    psnr_db: PsnrSummary | None = None
    psnr_before_db: PsnrSummary | None = None

    def to_json(self) -> dict[str, Any]:
        """The JSON object of `rsundistort evaluate --json`, without fields that are None."""
        return {name: value for name, value in asdict(self).items() if value is not None}


@former_fields(meter="degeneracy")
@dataclass(frozen=True)
class PoseAnalysis(_FormerlyDict):
    """Outcome of `analyze`.

    Attributes
    ----------
    photos : int
        Poses that were analysed.
    readout : tuple of str
        Directions of readout among them.
    degeneracy : CriticalMotion
        How well the poses determine the shutter.
    sentence : str or None
        What the shape of the solution is worth; None of bare poses.
    advice : tuple of str
        For the next shoot, in sentences; empty unless the motion is critical.
    """

    photos: int
    readout: tuple[str, ...]
    degeneracy: CriticalMotion
    sentence: str | None = None
    advice: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The JSON object of `rsundistort analyze --json`."""
        return {
            "photos": self.photos,
            "readout": list(self.readout),
            "singular_values": self.degeneracy.singular_values.tolist(),
            "null_vector": self.degeneracy.null_vector.tolist(),
            "y_axis_spread_deg": self.degeneracy.y_axis_spread_deg,
            "meaning": self.degeneracy.meaning,
            "critical": self.degeneracy.is_low,
            "sentence": self.sentence,
            "advice": list(self.advice),
        }
