"""What to photograph at the next shoot, and its gain for the given cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..bundle import BundleOptions, BundleResult
from ..model import Observations, Reconstruction
from ..model.array_types import Array
from ..model.projection import project_points
from .cost import ShapeCost, shape_cost
from .degeneracy import critical_motion

__all__ = ["Advice", "advise", "advise_poses"]

_TILT_DEG = 20.0
# An advised photo sees what a given photo sees, if at least this many points stay in it.
_MIN_POINTS = 20
# What leaves this share of an uncertainty, or more, is no advice.
_GAIN = 0.9


@dataclass(frozen=True)
class Advice:
    """Photos to add, and their gain.

    Attributes
    ----------
    what : str
        In words.
    degeneracy : float
        Smallest singular value of the degeneracy measure with them.
    sigma_log_k : float or None
        Standard deviation of the height of the scene with them; None if only poses are known.
    shift_px : float or None
        Remaining displacement of the rectified photos with them, as of `CommonMotion`; None if the model has no
        velocity.
    """

    what: str
    degeneracy: float
    sigma_log_k: float | None = None
    shift_px: float | None = None

    @property
    def sentence(self) -> str:
        """For people."""
        if self.sigma_log_k is None:
            return f"{self.what}: the degeneracy measure would be {self.degeneracy:.2f}"
        said = f"{self.what}: the height would be uncertain by +-{100 * self.sigma_log_k:.2g} %"
        return said if self.shift_px is None else f"{said}, the rectified photos by {self.shift_px:.2g} px"


def _candidates(R_cw: Array, center_w: Array, pivots: Array) -> list[tuple[str, list[tuple[int, Array, Array]]]]:
    """Photos that could be added: words, and the photos as (photo that it repeats, R_cw, center_w).

    Tilted photos are taken from above or below, rotated about the `pivots` (m, 3), what the photos look at.
    """
    m = len(R_cw)
    middle = int(np.argmin(np.linalg.norm(center_w - center_w.mean(0), axis=1)))
    rolled = Rotation.from_euler("z", 90, degrees=True).as_matrix() @ R_cw[middle]
    tilted = []
    for number, i in enumerate(dict.fromkeys((m // 4, m // 2, 3 * m // 4))):
        tilt = Rotation.from_euler("x", _TILT_DEG * (-1) ** number, degrees=True).as_matrix()
        R = tilt @ R_cw[i]
        ahead = R_cw[i] @ (pivots[i] - center_w[i])
        tilted.append((i, R, pivots[i] - R.T @ ahead))
    count = {1: "one photo", 2: "two photos", 3: "three photos"}[len(tilted)]
    return [
        ("one photo more, rotated by 90 degrees", [(middle, rolled, center_w[middle])]),
        (f"{count} more, tilted up or down by {_TILT_DEG:.0f} degrees", tilted),
    ]


def advise_poses(R_cw: Array, center_w: Array, readout: Sequence[str]) -> list[Advice]:
    """Advice from poses alone, (m, 3, 3) and (m, 3), with the readout of each; see `advise`."""
    # the distance of the scene is taken as that of the cameras
    distance = np.linalg.norm(center_w - center_w.mean(0), axis=1).max(initial=0.0) or 1.0
    pivots = center_w + distance * R_cw[:, 2]
    found = []
    for what, photos in _candidates(R_cw, center_w, pivots):
        R = np.concatenate([R_cw, [photo[1] for photo in photos]])
        centers = np.concatenate([center_w, [photo[2] for photo in photos]])
        directions = [*readout, *(readout[photo[0]] for photo in photos)]
        found.append(Advice(what, critical_motion(R, centers, directions).value))
    return found


def advise(result: BundleResult, options: BundleOptions | None = None) -> list[Advice]:
    """The gain of a photo rotated by 90 degrees, or of a few tilted by 20, for the given cameras; of what gains.

    The views are added to the solution: each repeats a photo, rotated, with those of its points that stay in it,
    measured as well as the others, and with an equally unknown motion.
    """
    rec = result.reconstruction
    obs = rec.observations
    pivots = np.array(
        [
            np.median(rec.points_w[obs.point_idx[mine]], axis=0) if len(mine) else rec.points_w.mean(0)
            for mine in obs.by_photo(rec.num_images)
        ]
    )
    # added views have no residuals: their correlation is taken as that of the given ones
    plain = replace(options or BundleOptions(), deviations="model")
    now = shape_cost(result, plain)
    worse = shape_cost(result, options).sigma_log_k / now.sigma_log_k
    found = []
    for what, photos in _candidates(rec.R_cw, rec.center_w, pivots):
        more = rec
        for photo in photos:
            more = _with_view(more, *photo)
        if more.num_images == rec.num_images + len(photos):
            m, nb = result.covariances.shape[:2]
            imagined = replace(result, reconstruction=more, covariances=np.zeros((m + len(photos), nb, nb)))
            cost: ShapeCost = shape_cost(imagined, plain)
            shift = cost.common.shift_px if cost.common.of_travel else None
            gains = [cost.sigma_log_k < _GAIN * now.sigma_log_k]
            gains += [cost.common.shift_px < _GAIN * now.common.shift_px] * (shift is not None)
            if not any(gains):
                continue
            found.append(Advice(what, cost.degeneracy.value, worse * cost.sigma_log_k, shift))
    return found


def _with_view(rec: Reconstruction, like: int, R_cw: Array, center_w: Array) -> Reconstruction:
    """The reconstruction with one more photo of points that another photo sees; unchanged if it sees too few."""
    obs = rec.observations
    camera = rec.camera(like)
    mine = np.flatnonzero(obs.frame_idx == like)
    points = rec.points_w[obs.point_idx[mine]]
    xy, seen = project_points((points - center_w) @ R_cw.T, camera, None, "global")
    with np.errstate(invalid="ignore"):
        seen &= ((xy >= 0) & (xy <= [camera.width - 1, camera.height - 1])).all(1)
    if seen.sum() < _MIN_POINTS:
        return rec
    mine = mine[seen]
    name = f"advice {rec.num_images}"
    return replace(
        rec.with_photos([name], rec.camera_idx[[like]], R_cw[None], center_w[None], np.zeros((1, 3))),
        bend_clock=np.concatenate([rec.bend_clock, rec.bend_clock[[like]]]),
        variation=np.concatenate([rec.variation, rec.variation[[like]]]),
        observations=Observations(
            np.concatenate([obs.frame_idx, np.full(len(mine), rec.num_images)]),
            np.concatenate([obs.point_idx, obs.point_idx[mine]]),
            np.concatenate([obs.xy_raw, xy[seen]]),
            np.concatenate([obs.sigma, obs.sigma[mine]]),
        ),
    )
