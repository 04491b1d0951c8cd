"""Scenes that the adjustment solves, and its linear system written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy_reference import DIRECTIONS, Fisheye, lens_of, project
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, Camera, Observations, Reconstruction
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem

# Of Student's t, four degrees of freedom and three components, by its weights.
INFORMATION = 7 / 9
LENS = [-0.12, 0.03, 0.001, -0.002]
FISHEYE = Fisheye([0.05, -0.02, 0.01, -0.004])
RATIONAL = [*LENS, 0.01, 0.05, -0.02, 0.01]


def make_cameras(dist=()):
    """One camera for each readout direction, of different focal lengths."""
    return [
        Camera(800, 600, [[700 + 10 * i, 0, 402], [0, 690 + 5 * i, 297], [0, 0, 1]], dist, readout, lens_of(dist))
        for i, readout in enumerate(DIRECTIONS)
    ]


def make_scene(rng, model, num_images=6, num_points=60, noise_px=0.0, phi_size=0.05, dist=()):
    """A cloud seen from all around, rolled and pitched at will: far from every critical motion."""
    cameras = make_cameras(dist)
    points_w = rng.uniform(-1, 1, (num_points, 3))
    center_w = rng.normal(size=(num_images, 3))
    center_w *= 3.5 / np.linalg.norm(center_w, axis=1, keepdims=True)
    ahead = -center_w / np.linalg.norm(center_w, axis=1, keepdims=True)
    right = np.cross(ahead, rng.normal(size=(num_images, 3)))  # any roll
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R_cw = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    phi = rng.uniform(-phi_size, phi_size, (num_images, 3)) * (model != "global")
    # photos are about 4 apart
    velocity = rng.uniform(-0.2, 0.2, (num_images, 3)) * (model == "constant-motion")
    camera_idx = np.arange(num_images) % len(cameras)
    point_idx, frame_idx = (a.ravel() for a in np.mgrid[:num_points, :num_images])
    xy = np.empty((num_points, num_images, 2))
    for i in range(num_images):
        camera = cameras[camera_idx[i]]
        xy[:, i] = project(points_w, R_cw[i], center_w[i], phi[i], model, camera.readout, camera.K, dist, velocity[i])
    xy += noise_px * rng.normal(size=xy.shape)
    return Reconstruction(
        cameras=cameras,
        image_names=[f"{i}.jpg" for i in range(num_images)],
        camera_idx=camera_idx,
        R_cw=R_cw,
        center_w=center_w,
        points_w=points_w,
        observations=Observations(frame_idx, point_idx, xy.reshape(-1, 2)),
        phi=phi,
        velocity=velocity,
        shutter_model=model,
    )


def perturbed(rec, rng, angle=0.02, length=0.05):
    """A start near the truth, without any knowledge of the shutter."""
    turn = Rotation.from_rotvec(angle * rng.normal(size=(rec.num_images, 3))).as_matrix()
    return replace(
        rec,
        R_cw=turn @ rec.R_cw,
        center_w=rec.center_w + length * rng.normal(size=rec.center_w.shape),
        points_w=rec.points_w + length * rng.normal(size=rec.points_w.shape),
        phi=np.zeros_like(rec.phi),
        velocity=np.zeros_like(rec.velocity),
    )


def noisy_problem(rng, model, loss="squared", factor_limit=1e10, sigma_px=0.5, refine=(), dist=LENS, varying=False):
    """A small problem at a state that is nowhere near a minimum: residuals of tens of pixels."""
    num_images = 5 if refine else 4  # of four cameras: two photos share one
    rec = make_scene(rng, model, num_images=num_images, num_points=30, noise_px=1.0, dist=dist)
    start = replace(perturbed(rec, rng, 0.01, 0.02), phi=rec.phi + 0.02 * rng.normal(size=rec.phi.shape))
    sigma = rng.uniform(1, 3, len(rec.observations))
    start = replace(start, observations=replace(rec.observations, sigma=sigma))
    if varying:
        start = replace(start, variation=rng.normal(size=(num_images, 3)) * [0.05, 0.02, 0.02])
    options = BundleOptions(loss=loss, factor_limit=factor_limit, cg_tolerance=1e-13, refine=refine, varying=varying)
    problem = BundleProblem(start, model, options, sigma_px, PriorSigmas(0.03, 0.1, 0.02, 0.01))
    return problem, problem.initial_state()


def gradients(equations):
    """Gradients of photos (m, nb), points (n, 3) and cameras (c, nc)."""
    border = equations._border
    return equations._g_frame, equations._g_point, equations._g_camera.reshape(border.num_cameras, border.J.shape[2])


def unit_steps(problem, state):
    """A step along each unknown of the photos (kind 0), points (1) and cameras (2)."""
    arrays = [np.zeros_like(gradient) for gradient in gradients(problem.linearize(state))]
    for kind, array in enumerate(arrays):
        for index in np.ndindex(array.shape):
            array[index] = 1.0
            yield kind, index, tuple(arrays)
            array[index] = 0.0


def common_steps(problem, state, rng):
    """A step along each unknown of a photo (kind 0), a point (1) and a camera (2), of all of them at once.

    Each goes its own way, forth or back: whose measurements follow another's step shows.
    """
    arrays = [np.zeros_like(gradient) for gradient in gradients(problem.linearize(state))]
    for kind, array in enumerate(arrays):
        for k in range(array.shape[1]):
            array[:, k] = rng.choice([-1.0, 1.0], len(array)) * rng.uniform(1.0, 2.0, len(array))
            yield kind, k, tuple(arrays)
            array[:, k] = 0.0


def scaled(step, h):
    return tuple(h * part for part in step)


def weights_of_motions(problem, own):
    """Weights (m, k) of the priors of rotations by 0.03 and travels by 0.1 a frame, Student's t with 4 degrees."""
    weight = np.empty_like(own)
    for i, span in enumerate(problem._start.frame_span()):
        for k, sigma in zip(range(0, own.shape[1], 3), (0.03, 0.1), strict=False):
            square = sum((own[i, k + a] * span / sigma) ** 2 for a in range(3))
            weight[i, k : k + 3] = 7 / (4 + square) * (span / sigma) ** 2
    return weight


def dense_system(problem, state):
    """Hessian and gradient of all unknowns, photos, points, cameras, written out; with the mask of the free ones."""
    res, J_frame = problem.blocks(state)
    J_camera = problem._camera_jacobians(state)
    nc = J_camera.shape[2]
    obs = problem._start.observations.select(problem.structure.order)
    m, nb = problem._free.shape
    others = 3 * problem._start.num_points, nc * len(state.cameras)
    J = np.zeros((len(obs), 2, m * nb + sum(others)))
    for k in range(len(obs)):
        f, p = nb * obs.frame_idx[k], m * nb + 3 * obs.point_idx[k]
        c = m * nb + others[0] + nc * problem._start.camera_idx[obs.frame_idx[k]]
        J[k, :, f : f + nb] = J_frame[k]
        J[k, :, p : p + 3] = -J_frame[k, :, 3:6]
        J[k, :, c : c + nc] = J_camera[k]
    J = J.reshape(-1, J.shape[2])
    H, g = J.T @ J, J.T @ res.ravel()
    if nb > 6:
        motion = np.hstack([state.phi, state.velocity[:, : nb - 9]])
        weight = np.hstack([np.zeros((m, 6)), weights_of_motions(problem, motion)])
        H[: m * nb, : m * nb] += np.diag(INFORMATION * weight.ravel())
        g[: m * nb] += (weight * np.hstack([np.zeros((m, 6)), motion])).ravel()
    return H, g, np.concatenate([problem._free.ravel(), np.ones(sum(others), bool)])
