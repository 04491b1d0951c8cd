"""Systematic residuals: those that are the same in all photos, along the readout or over the frame."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from ..model import Reconstruction
from ..model.array_types import Index
from ..model.projection import clock_of
from ..model.reprojection import reprojection_residuals

__all__ = ["left_along_readout", "left_over_frame"]

# Parts along the readout, and of the frame across and down.
_ROWS, _CELLS = 16, np.array([8, 6])
# Photos that must see a part: the variance of fewer is not known.
_LEAST_PHOTOS = 5
# Probability that noise alone passes for more.
_CHANCE = 0.001


def left_along_readout(reconstruction: Reconstruction) -> float:
    """Residual at the same time of the readout of all photos, as `left_over_frame`.

    A shutter that the model does not describe causes it.
    """
    rec, obs = reconstruction, reconstruction.observations
    share = np.empty(len(obs))
    for i, mine in enumerate(obs.by_photo(rec.num_images)):
        camera = rec.camera(i)
        ends = clock_of(camera, np.array([[0, 0], [camera.width - 1, camera.height - 1]], float))
        share[mine] = (clock_of(camera, obs.xy_raw[mine]) - ends.min()) / np.ptp(ends)
    return _systematic(rec, np.clip(_ROWS * share, 0, _ROWS - 1).astype(np.int64))


def left_over_frame(reconstruction: Reconstruction) -> float:
    """Residual in the same place of all photos of a camera, in pixels; 0 if it may be noise.

    Root mean square over the parts of the frame of the mean residual there, without the part of noise. A wrong lens
    model causes it.
    """
    rec, obs = reconstruction, reconstruction.observations
    sizes = np.array([(each.width, each.height) for each in rec.cameras], float)
    camera = rec.camera_idx[obs.frame_idx]
    across, down = np.clip((obs.xy_raw + 0.5) / sizes[camera] * _CELLS, 0, _CELLS - 1).astype(np.int64).T
    return _systematic(rec, (camera * _CELLS[1] + down) * _CELLS[0] + across)


def _systematic(rec: Reconstruction, part: Index) -> float:
    """Root mean square of the mean residuals of parts (o,), without noise; 0 if they are no more than noise.

    Measurements of a photo in a part are correlated and count once: the cluster-robust variance of a mean. The variance
    of few photos is itself uncertain: it is not taken as less than the mean over all parts makes it.
    """
    residual, valid = reprojection_residuals(rec)
    m, num = rec.num_images, int(part.max(initial=-1)) + 1
    where = (part * m + rec.observations.frame_idx)[valid]
    count = np.bincount(where, minlength=num * m).reshape(num, m).astype(float)
    seen = (count > 0).sum(1) >= _LEAST_PHOTOS
    if not seen.any():
        return 0.0
    total = np.stack([np.bincount(where, each, minlength=num * m).reshape(num, m) for each in residual[valid].T], -1)
    count, total, photos = count[seen, :, None], total[seen], (count[seen] > 0).sum(1)[:, None]
    number = count.sum(1)
    mean = total.sum(1) / number
    variance = ((total - count * mean[:, None]) ** 2).sum(1) * photos / (photos - 1) / number
    variance = np.maximum(variance, (variance * number).sum(0) / number.sum()) / number
    if chdtrc(mean.size, (mean**2 / np.maximum(variance, 1e-24)).sum()) > _CHANCE:
        return 0.0
    return float(np.sqrt(max((mean**2 - variance).sum(1).mean(), 0.0)))
