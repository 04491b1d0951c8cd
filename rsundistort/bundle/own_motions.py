"""What each frame of a path says of its own turn, were it not on the path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .options import BundleOptions, BundleResult
from .problem import BundleProblem
from .spreads import Spreads

__all__ = ["phi_of_frames"]

Array = NDArray[np.float64]

# Of a frame: rotation, centre, phi.
_UNKNOWNS = 9
# A prior that says nothing.
_LOOSE = 1e6


def phi_of_frames(result: BundleResult) -> tuple[Array, Array]:
    """Phi (m, 3) of frames by their own measurements of the points, and its standard deviations; NaN where these fail.

    One Gauss-Newton step of each frame's pose and phi from the solution, whose points and velocities are held: many
    frames made the points, so that hardly any of them is that of a frame's own phi.
    """
    rec = result.reconstruction
    problem = BundleProblem(
        rec, rec.shutter_model, BundleOptions(loss="squared"), result.sigma_px * result.noise_factor,
        Spreads(_LOOSE, _LOOSE),
    )  # fmt: skip
    residuals, J = problem.linearize(problem.initial_state()).blocks
    frame = problem.measurements[0]
    H, g = np.zeros((rec.num_images, _UNKNOWNS, _UNKNOWNS)), np.zeros((rec.num_images, _UNKNOWNS))
    np.add.at(H, frame, np.einsum("oia,oib->oab", J[:, :, :_UNKNOWNS], J[:, :, :_UNKNOWNS]))
    np.add.at(g, frame, np.einsum("oia,oi->oa", J[:, :, :_UNKNOWNS], residuals))
    phi, sigma = np.full((2, rec.num_images, 3), np.nan)
    for i in range(rec.num_images):
        # unknowns of one size
        scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H[i]), 1e-300))
        scaled = scale[:, None] * H[i] * scale
        if np.linalg.cond(scaled) < 1e12:
            inverse = scale[:, None] * np.linalg.inv(scaled) * scale
            phi[i] = rec.phi[i] - (inverse @ g[i])[6:]
            sigma[i] = np.sqrt(np.diagonal(inverse)[6:])
    return phi, sigma
