"""How near to a camera a point of the scene may be."""

from __future__ import annotations

import numpy as np

from ..model import Reconstruction

__all__ = ["least_distance"]

# Of the extent of the cameras' places, or of the distances at which they see the scene, whichever is smaller. A match
# between photos that are taken from one place ends nearer, since noise drives a depth that nothing determines.
_SHARE = 1e-2
# Share of the measurements whose distances count: a scene may be far for the most part.
_NEAR = 0.1


def least_distance(reconstruction: Reconstruction) -> float:
    """Distance from a camera, world units, within which nothing is a point of the scene; 0 where nothing says so."""
    rec, obs = reconstruction, reconstruction.observations
    if not len(obs):
        return 0.0
    away = np.linalg.norm(rec.points_w[obs.point_idx] - rec.center_w[obs.frame_idx], axis=1)
    extent = float(np.linalg.norm(np.ptp(rec.center_w, axis=0)))
    return _SHARE * min(extent, float(np.quantile(away, _NEAR)))
