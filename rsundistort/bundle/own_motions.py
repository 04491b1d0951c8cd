"""Pose and rotation of each frame of a video from its own measurements, without a path."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..model import Reconstruction
from ..model.array_types import Array, Index
from .bundle_options import BundleOptions
from .prior_sigmas import PriorSigmas
from .problem import BundleProblem, State

__all__ = ["OwnMotions", "own_motions"]


# Of a frame: rotation, centre, phi.
_UNKNOWNS = 9
# Radians and depths a frame: no hand does as much, so that the prior says nothing.
_LOOSE = 1.0
# Rounds of frames by points and points by frames, and steps of the frames in each.
_ROUNDS, _STEPS = 3, 6
_LEAST_NOISE_PX = 0.02


@dataclass(frozen=True)
class OwnMotions:
    """Poses and rotations of frames, each by its own measurements; NaN where these do not determine them.

    Attributes
    ----------
    R_cw, center_w : (m, 3, 3), (m, 3) array
        `x_c = R_cw (X_w - center_w)`.
    phi : (m, 3) array
        Radians per unit of the clock.
    sigma_rotation, sigma_phi : (m, 3) array
        Standard deviations of both, by the residuals of the fits.
    """

    R_cw: Array
    center_w: Array
    phi: Array
    sigma_rotation: Array
    sigma_phi: Array


def own_motions(reconstruction: Reconstruction, *, rotation_only: bool = False) -> OwnMotions:
    """The rotation of each frame during its readout, and its pose, from points that all frames determine.

    Frames are fitted to the points, and the points to the frames, alternately and with a robust loss. Only their points
    connect the frames, and no prior constrains their motion, so that frames whose shutters and poses contradict each
    other are fitted as well as any others. The velocities of the reconstruction are fixed, and its bends: frames that
    turn while they are read would be fitted by another pose, whose error goes with their rotation. So are their focal
    lengths, where these vary.

    Parameters
    ----------
    reconstruction : Reconstruction
        Start; of all frames.
    rotation_only : bool
        Whether the centres, and the points, stay where they are.
    """
    bends = {name: reconstruction.motion(i).bend for i, name in enumerate(reconstruction.image_names)}
    options = BundleOptions(
        loss="cauchy", known_bends={name: bend for name, bend in bends.items() if bend is not None},
        varying=reconstruction.varies,
    )  # fmt: skip
    problem = BundleProblem(reconstruction, "constant-motion", options, 1.0, PriorSigmas(_LOOSE, _LOOSE))
    own = np.array([0, 1, 2, 6, 7, 8] if rotation_only else range(_UNKNOWNS))
    state = problem.initial_state()
    for last in range(1 if rotation_only else _ROUNDS):
        if last:
            state = problem.settle(state)
        state = _fitted(problem, state, own)
    residuals, J = problem.with_squares().blocks(state)
    frame = problem.measurements[0]
    # heavy tails count as those of normal noise do, and each frame has its own unknowns
    size, m = np.median(np.abs(residuals)) / 0.6745, reconstruction.num_images
    share = max(1.0 - len(own) * m / residuals.size, 0.1)
    noise = max(size / np.sqrt(share), _LEAST_NOISE_PX)
    believed = np.linalg.norm(residuals, axis=1) < 4.5 * noise
    J *= believed[:, None, None]
    H = _gradients(problem.by_photo, residuals, J, own)[0]
    sigma = np.full((m, _UNKNOWNS), np.nan)
    scale, scaled = _scaled(H)
    known = np.linalg.cond(scaled) < 1e12
    inverse = scale[known, :, None] * np.linalg.inv(scaled[known]) * scale[known, None]
    variance = noise**2 * np.diagonal(inverse, axis1=1, axis2=2)
    # neighbours in a frame go wrong together, by lens, waves and leaves: one factor for each kind of unknown
    corner = problem.partitions(state)[1]
    count = int(corner.max(initial=0)) + 1
    pulls = np.zeros((m * count, len(own)))
    np.add.at(pulls, frame * count + corner, np.einsum("oia,oi->oa", J, residuals)[:, own])
    moved = np.einsum("fab,fcb->fca", inverse, pulls.reshape(m, count, -1)[known])
    together = np.median((moved**2).sum(1) / variance, axis=0) if known.any() else np.ones(len(own))
    sigma[np.ix_(known, own)] = np.sqrt(np.maximum(together, 1.0) * variance)
    found = state.R_cw.copy(), state.center_w.copy(), state.phi.copy()
    for each in found:
        each[~known] = np.nan
    return OwnMotions(*found, sigma[:, :3], sigma[:, 6:])


def _scaled(H: Array) -> tuple[Array, Array]:
    """Scales (m, n) of unknowns, and matrices (m, n, n) of unknowns of one size."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-300))
    return scale, scale[:, :, None] * H * scale[:, None]


def _gradients(by_frame: list[Index], residuals: Array, J: Array, own: Index) -> tuple[Array, Array]:
    """J'J (m, n, n) and J'residuals (m, n) of each frame, for the unknowns `own` (n,) of Jacobians (o, 2, nb)."""
    n, m = len(own), len(by_frame)
    H, g = np.empty((m, n, n)), np.empty((m, n))
    for f, mine in enumerate(by_frame):
        A, b = J[mine][:, :, own].reshape(-1, n), residuals[mine].ravel()
        H[f], g[f] = A.T @ A, A.T @ b
    return H, g


def _fitted(problem: BundleProblem, state: State, own: Index) -> State:
    """Some steps of Levenberg and Marquardt of every frame on its own."""
    frame, m = problem.measurements[0], len(state.phi)
    by_frame = problem.by_photo
    damping = np.full(m, 1e-3)
    cost = np.bincount(frame, problem.costs(state), m)
    for _ in range(_STEPS):
        residuals, J = problem.blocks(state)
        H, g = _gradients(by_frame, residuals, J, own)
        scale, scaled = _scaled(H)
        scaled += np.maximum(damping, 1e-9)[:, None, None] * np.eye(len(own))
        step = np.zeros((m, problem.layout.size))
        step[:, own] = -scale * np.linalg.solve(scaled, (scale * g)[:, :, None])[:, :, 0]
        still = np.zeros_like(state.points_w), np.zeros((len(state.cameras), 0))
        moved = problem.retract(state, (step, *still))
        after = np.bincount(frame, problem.costs(moved), m)
        better = after < cost
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        cost = np.where(better, after, cost)
        state = replace(
            state,
            R_cw=np.where(better[:, None, None], moved.R_cw, state.R_cw),
            center_w=np.where(better[:, None], moved.center_w, state.center_w),
            phi=np.where(better[:, None], moved.phi, state.phi),
        )
    return state
