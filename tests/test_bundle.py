"""Bundle adjustment: derivatives through the step, elimination, and what it recovers from the twin's photos."""

from __future__ import annotations

from dataclasses import replace

import covariance
import numba
import numpy as np
import pytest
from critical_scenes import named_scene
from numpy_twin import DIRECTIONS, MODELS, Fisheye, lens_of, project
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, RowMotion, bundle_adjust
from rsundistort.bundle import (
    LADDER,
    GuessedCameras,
    adjust_sequence,
    choose_model,
    choose_readouts,
    objective,
)
from rsundistort.bundle.choice import hold_out
from rsundistort.bundle.intrinsics import moved_camera
from rsundistort.bundle.problem import BundleProblem
from rsundistort.bundle.spreads import Spreads
from rsundistort.errors import InputError
from rsundistort.model import READOUTS, KnownLength
from rsundistort.model.projection import unproject_points
from rsundistort.model.reprojection import reprojection_residuals
from rsundistort.synthetic import project_rows

LENS = [-0.12, 0.03, 0.001, -0.002]
FISHEYE = Fisheye([0.05, -0.02, 0.01, -0.004])
SHUTTERS = ("two-step", "linearized", "rotation", "constant-motion")


# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


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


def relative_poses(rec):
    """Orientations and centres in the frame of photo 0, photo 1 at distance 1: free of the gauge."""
    centers = (rec.center_w - rec.center_w[0]) @ rec.R_cw[0].T
    return rec.R_cw @ rec.R_cw[0].T, centers / np.linalg.norm(centers[1])


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
    problem = BundleProblem(start, model, options, sigma_px, Spreads(0.03, 0.1, 0.02, 0.01))
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


def scaled(step, h):
    return tuple(h * part for part in step)


REFINE = ("f", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
RATIONAL = [*LENS, 0.01, 0.05, -0.02, 0.01]


@pytest.mark.parametrize(
    ("refine", "dist"),
    [
        ((), LENS), (REFINE, LENS), (("fx", "fy", "k1"), []), (REFINE, RATIONAL),
        (("f", "cx", "cy", "k1", "k2", "k3", "k4"), FISHEYE), (("fx", "k1"), Fisheye()),
    ],
    ids=["calibrated", "refined", "pinhole", "rational", "fisheye", "bare fisheye"],
)  # fmt: skip
@pytest.mark.parametrize("varying", [False, True], ids=["shared", "varying"])
@pytest.mark.parametrize("model", MODELS)
def test_jacobian_equals_central_differences_through_the_step(model, varying, refine, dist, rng):
    problem, state = noisy_problem(rng, model, refine=refine, dist=dist, varying=varying)
    order = problem._structure.order
    obs = problem._start.observations.select(order)
    _, J_frame, _ = problem._jacobians(state)
    jacobians = J_frame, -J_frame[:, :, 3:6], problem._camera_jacobians(state)
    owners_of = obs.frame_idx, obs.point_idx, problem._start.camera_idx[obs.frame_idx]
    h = 1e-6

    def residuals(step):
        moved = problem.reconstruction(problem.retract(state, step))
        res, valid = reprojection_residuals(moved)
        assert valid.all()
        return res[order] / (0.5 * obs.sigma[:, None])

    for kind, (owner, k), step in unit_steps(problem, state):
        difference = (residuals(scaled(step, h)) - residuals(scaled(step, -h))) / (2 * h)
        expected = np.where((owners_of[kind] == owner)[:, None], jacobians[kind][:, :, k], 0.0)
        # entries are of the size of the focal length over sigma; rounding of 400 px over h is 1e-7 of them
        assert np.abs(difference - expected).max() <= 1e-6 * np.abs(J_frame[:, :, :3]).max()


@pytest.mark.parametrize("refine", [(), REFINE], ids=["calibrated", "refined"])
@pytest.mark.parametrize(
    ("model", "loss"),
    [*((m, "squared") for m in MODELS), *(("rotation", loss) for loss in ("soft-l1", "huber", "cauchy"))],
)
def test_gradient_equals_central_differences_of_the_cost(model, loss, refine, rng):
    # with sigma 10 px the residuals lie on both sides of where the losses bend
    problem, state = noisy_problem(rng, model, loss, sigma_px=0.5 if loss == "squared" else 10.0, refine=refine)
    equations = problem.linearize(state)
    assert equations.cost == pytest.approx(problem.cost(state), rel=1e-13)  # sums of the same numbers
    h = 1e-5
    for kind, index, step in unit_steps(problem, state):
        ahead, behind = (problem.cost(problem.retract(state, scaled(step, s))) for s in (h, -h))
        gradient = gradients(equations)[kind]
        # third derivatives give h^2 (f/sigma)^2 = 1e-4 of some 1e4; rounding of the cost over h as little
        assert abs((ahead - behind) / (2 * h) - gradient[index]) <= 1e-6 * np.abs(gradient).max()


def dense_system(problem, state):
    """Hessian and gradient of all unknowns, photos, points, cameras, written out; with the mask of the free ones."""
    res, J_frame, _ = problem._jacobians(state)
    J_camera = problem._camera_jacobians(state)
    nc = J_camera.shape[2]
    obs = problem._start.observations.select(problem._structure.order)
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
    if nb > 6:  # priors: (phi * span / spread)^2 / 2, and the same for the velocity
        weight = np.zeros((m, nb))
        weight[:, 6:9] = (problem._start.frame_span() / 0.03)[:, None] ** 2
        weight[:, 9:] = (problem._start.frame_span() / 0.1)[:, None] ** 2
        gradient = np.zeros((m, nb))
        gradient[:, 6:9] = weight[:, 6:9] * state.phi
        gradient[:, 9:] = weight[:, 9:] * state.velocity[:, : nb - 9]
        H[: m * nb, : m * nb] += np.diag(weight.ravel())
        g[: m * nb] += gradient.ravel()
    return H, g, np.concatenate([problem._free.ravel(), np.ones(sum(others), bool)])


@pytest.mark.parametrize("refine", [(), ("f", "k1", "k2")], ids=["calibrated", "refined"])
@pytest.mark.parametrize("damping", [1e-6, 1e-2, 10.0])
@pytest.mark.parametrize("factor_limit", [1e10, -1], ids=["factored", "conjugate gradients"])
@pytest.mark.parametrize(
    ("model", "loss"),
    [("global", "squared"), ("rotation", "squared"), ("two-step", "cauchy"), ("constant-motion", "squared")],
)
def test_elimination_gives_the_step_of_the_whole_system(model, loss, factor_limit, damping, refine, rng):
    problem, state = noisy_problem(rng, model, loss, factor_limit, refine=refine)
    H, g, free = dense_system(problem, state)
    expected = np.zeros(len(g))
    damped = H + damping * np.diag(np.diag(H))
    # unit diagonal, as any reference solution needs: unknowns differ by orders of magnitude
    scale = 1 / np.sqrt(np.diag(damped)[free])
    expected[free] = scale * np.linalg.solve(scale[:, None] * damped[np.ix_(free, free)] * scale, -scale * g[free])
    parts, predicted = problem.linearize(state).solve(damping)
    step = np.concatenate([part.ravel() for part in parts])
    assert (step[~free] == 0).all()
    # condition numbers up to 1e6 times rounding
    np.testing.assert_allclose(step, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert predicted == pytest.approx(-(g @ expected + 0.5 * expected @ H @ expected), rel=1e-8)


@pytest.mark.parametrize("refine", [(), ("f", "k1")], ids=["calibrated", "refined"])
@pytest.mark.parametrize("factor_limit", [1e10, -1], ids=["factored", "conjugate gradients"])
def test_covariances_are_those_of_the_whole_inverse(factor_limit, refine, rng):
    problem, state = noisy_problem(rng, "rotation", factor_limit=factor_limit, refine=refine)
    H, _, free = dense_system(problem, state)
    scale = 1 / np.sqrt(np.diag(H)[free])
    inverse = scale[:, None] * np.linalg.inv(scale[:, None] * H[np.ix_(free, free)] * scale) * scale
    whole = np.zeros((len(free), len(free)))
    whole[np.ix_(free, free)] = inverse
    m, nb = problem._free.shape
    expected = np.array([whole[nb * i : nb * i + nb, nb * i : nb * i + nb] for i in range(m)])
    size = np.sqrt(np.einsum("iaa,ibb->iab", expected, expected))
    # of linear functions: of one photo's unknowns, and of all points (which the problem keeps in another order)
    vector = rng.normal(size=(1, m, nb))
    found = problem.linearize(state).covariance()(vector)[0]
    reference = (whole[: m * nb, : m * nb] @ vector.ravel()).reshape(m, nb)
    np.testing.assert_allclose(found, reference, rtol=0, atol=1e-8 * np.abs(reference).max())
    weights = rng.normal(size=(problem._start.num_points, 3))
    found = problem.linearize(state).function_of_points(problem.in_order(weights))
    variance, with_photos = found.variance, found.with_photos
    start, stop = m * nb, m * nb + weights.size
    b = weights[problem._points].ravel()
    assert variance == pytest.approx(b @ whole[start:stop, start:stop] @ b, rel=1e-7)
    reference = (whole[: m * nb, start:stop] @ b).reshape(m, nb)
    np.testing.assert_allclose(with_photos, reference, rtol=0, atol=1e-7 * np.abs(reference).max())
    photos, cameras, *_ = problem.covariances(state)
    np.testing.assert_array_less(np.abs(photos - expected), 1e-8 * size + 1e-300)  # as the step
    expected = whole[len(whole) - len(cameras) :, len(whole) - len(cameras) :]
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_array_less(np.abs(cameras - expected), 1e-8 * size + 1e-300)


@pytest.mark.parametrize("refine", [(), ("f",)], ids=["calibrated", "refined"])
@pytest.mark.parametrize("model", ["global", "rotation", "constant-motion"])
def test_conjugate_gradients_of_several_clusters_give_the_factored_step(model, refine, rng):
    # 75 photos are three clusters, whose borders do not lie between bands of four unknowns: some are held
    rec = make_scene(rng, model, num_images=75, num_points=40, noise_px=1.0)
    start = replace(perturbed(rec, rng, 0.001, 0.002), phi=rec.phi)
    steps = []
    for factor_limit in (1e10, -1):
        options = BundleOptions(loss="squared", factor_limit=factor_limit, cg_tolerance=1e-13, refine=refine)
        problem = BundleProblem(start, model, options, 0.5, Spreads(0.03, 0.1))
        assert (problem._elimination.space is not None) == (factor_limit < 0)
        steps.append(problem.linearize(problem.initial_state()).solve(1e-4)[0])
    for factored, iterated in zip(*steps, strict=True):
        np.testing.assert_allclose(iterated, factored, rtol=0, atol=1e-7 * np.abs(factored).max(initial=0))


@pytest.mark.parametrize("refine", [(), ("f", "k1")], ids=["calibrated", "refined"])
@pytest.mark.parametrize("damping", [0.0, 1e-2])
def test_known_lengths_join_the_system(damping, refine, rng):
    problem, state = noisy_problem(rng, "rotation", refine=refine)
    given = problem._given
    obs = given.observations

    def end(point):
        k = int(np.flatnonzero(obs.point_idx == point)[0])
        return (given.image_names[obs.frame_idx[k]], *obs.xy_raw[k])

    lengths = [KnownLength(end(0), end(1), 1.0, 0.01), KnownLength(end(2), end(3), 2.0, 0.03)]
    lengths.append(KnownLength(end(1), end(4), 1.5, 0.02))
    joined = BundleProblem(given, "rotation", replace(problem._options, lengths=lengths), 0.5, Spreads(0.03, 0.1))
    H, g, free = dense_system(joined, state)
    m, nb = joined._free.shape
    points = slice(m * nb, m * nb + 3 * given.num_points)
    residuals, J = joined._lengths.residuals(state.points_w), joined._lengths.jacobian(state.points_w)
    h = 1e-6
    for point, axis in [(int(p), a) for p in np.unique(joined._lengths._ends) for a in range(3)]:
        step = np.zeros_like(state.points_w)
        step[point, axis] = h
        ahead, behind = (joined._lengths.residuals(state.points_w + s * step) for s in (1, -1))
        np.testing.assert_allclose((ahead - behind) / (2 * h), J[:, point, axis], atol=1e-5 * np.abs(J).max())
    J = J.reshape(len(lengths), -1)
    damped = H + damping * np.diag(np.diag(H))
    for A in (H, damped):
        A[points, points] += J.T @ J
    g[points] += J.T @ residuals
    scale = 1 / np.sqrt(np.diag(damped)[free])
    inverse = scale[:, None] * np.linalg.inv(scale[:, None] * damped[np.ix_(free, free)] * scale) * scale
    expected = np.zeros(len(g))
    expected[free] = -inverse @ g[free]
    equations = joined.linearize(state)
    assert equations.cost == pytest.approx(joined.cost(state), rel=1e-12)
    assert equations.cost == pytest.approx(problem.cost(state) + 0.5 * residuals @ residuals, rel=1e-12)
    parts, predicted = equations.solve(damping)
    step = np.concatenate([part.ravel() for part in parts])
    np.testing.assert_allclose(step, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
    assert predicted == pytest.approx(-(g @ expected + 0.5 * expected @ H @ expected), rel=1e-7)
    if damping == 0:
        whole = np.zeros((len(free), len(free)))
        whole[np.ix_(free, free)] = inverse
        vector = rng.normal(size=(1, m, nb))
        reference = (whole[: m * nb, : m * nb] @ vector.ravel()).reshape(m, nb)
        found = equations.covariance()(vector)[0]
        np.testing.assert_allclose(found, reference, rtol=0, atol=1e-7 * np.abs(reference).max())
        photos, cameras, *_ = equations.marginal_covariances()
        for i in range(m):
            block = whole[nb * i : nb * i + nb, nb * i : nb * i + nb]
            np.testing.assert_allclose(photos[i], block, rtol=0, atol=1e-7 * np.abs(block).max())
        block = whole[len(whole) - len(cameras) :, len(whole) - len(cameras) :]
        np.testing.assert_allclose(cameras, block, rtol=0, atol=1e-7 * np.abs(block).max(initial=0))
        weights = rng.normal(size=(given.num_points, 3))
        variance = joined.linearize(state).function_of_points(joined.in_order(weights)).variance
        b = weights[joined._points].ravel()
        assert variance == pytest.approx(b @ whole[points, points] @ b, rel=1e-6)


@pytest.mark.parametrize("dist", [[], LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
@pytest.mark.parametrize("model", MODELS)
def test_residuals_and_gradient_vanish_at_the_truth_of_the_twin(model, dist, rng):
    rec = make_scene(rng, model, dist=dist)
    res, valid = reprojection_residuals(rec)
    assert valid.all()
    assert np.abs(res).max() < 1e-9  # px: 1e-12 times the focal length
    options = BundleOptions(loss="squared")
    problem = BundleProblem(rec, model, options, 1.0, Spreads(1e9, 1e9))  # else the priors pull
    equations = problem.linearize(problem.initial_state())
    # Jacobians of 1000 px times residuals of 1e-12 to 1e-10 px, summed over 60 points or 6 photos
    assert np.abs(equations._g_frame).max() < 1e-5
    assert np.abs(equations._g_point).max() < 1e-5
    assert equations.cost < 1e-15


@pytest.mark.parametrize("model", SHUTTERS)
def test_truth_is_recovered_without_noise(model, rng):
    truth = make_scene(rng, model, dist=LENS)
    # priors of 10 rad and 10 baselines weigh nothing against thousands of pixels a radian
    options = BundleOptions(
        loss="squared", sigma_px=0.5, phi_sigma=10.0, velocity_sigma=10.0, outlier_rounds=0, cost_tolerance=1e-12
    )  # fmt: skip
    result = bundle_adjust(perturbed(truth, rng), model, options)
    assert result.converged
    assert result.reconstruction.shutter_model == model
    # the prior's pull on phi: 0.05 / 100 against (700 / 0.5)^2, and what it does to the rest
    # (rotation and translation differ by depth alone, so the pull reaches further with both)
    np.testing.assert_allclose(
        result.reconstruction.phi, truth.phi, atol=1e-7 if model == "constant-motion" else 1e-8
    )  # fmt: skip
    for found, true in zip(relative_poses(result.reconstruction), relative_poses(truth), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-6 if model == "constant-motion" else 1e-7)
    assert result.rms_px < 1e-5
    assert result.num_outliers == 0


def spoilt_cameras(rec, refine):
    """Cameras of which some intrinsics are only guessed: 3 % off in f, 1 % in the centre, no lens."""
    off = {"f": 0.03, "fx": 0.03, "fy": -0.02, "cx": 0.01, "cy": -0.01}
    step = np.array([off.get(name, 0.0) for name in refine])
    lens = any(name.startswith(("k", "p")) for name in refine)
    moved = [moved_camera(camera, refine, step) for camera in rec.cameras]
    return replace(rec, cameras=[replace(c, dist=np.zeros(0)) if lens else c for c in moved])


@pytest.mark.parametrize(
    ("refine", "dist"),
    [
        (("f", "k1", "k2", "p1", "p2"), LENS), (("fx", "fy", "cx", "cy"), LENS),
        (("f", "k1", "k2"), Fisheye([0.05, -0.02, 0.0, 0.0])),
    ],
    ids=["f-k1-k2-p1-p2", "fx-fy-cx-cy", "fisheye"],
)  # fmt: skip
@pytest.mark.parametrize("model", ["global", "two-step", "rotation", "constant-motion"])
def test_intrinsics_are_recovered_without_noise(model, refine, dist, rng):
    truth = make_scene(rng, model, num_images=12, num_points=120, dist=dist)
    options = BundleOptions(
        loss="squared", sigma_px=0.5, phi_sigma=10.0, velocity_sigma=10.0, outlier_rounds=0, cost_tolerance=1e-12,
        refine=refine,
    )  # fmt: skip
    start = spoilt_cameras(replace(perturbed(truth, rng, 0.01, 0.02), phi=truth.phi, velocity=truth.velocity), refine)
    result = bundle_adjust(start, model, options)
    for found, true in zip(result.reconstruction.cameras, truth.cameras, strict=True):
        np.testing.assert_allclose(found.K, true.K, atol=1e-2)
        np.testing.assert_allclose(found.dist, true.dist, atol=1e-4)
    assert result.rms_px < 1e-4


def test_normalised_errors_of_refined_intrinsics_are_one(rng):
    refine = ("f", "k1", "k2")
    errors = []
    for _ in range(6):
        truth = make_scene(rng, "rotation", num_images=12, num_points=80, noise_px=0.5, dist=[-0.12, 0.03, 0, 0])
        start = replace(perturbed(truth, rng, 0.01, 0.02), phi=truth.phi)
        result = bundle_adjust(spoilt_cameras(start, refine), "rotation", BundleOptions(refine=refine))
        for found, true, sigma in zip(
            result.reconstruction.cameras, truth.cameras, result.sigma_intrinsics, strict=True
        ):  # fmt: skip
            errors.append((found.K[0, 0] - true.K[0, 0]) / sigma["f"])
            errors.extend((found.dist[:2] - true.dist[:2]) / [sigma["k1"], sigma["k2"]])
    assert 0.75 < np.sqrt(np.mean(np.square(errors))) < 1.3  # 72 values, a third of them independent


@pytest.mark.parametrize(
    ("refine", "message"),
    [(("f", "fx"), "either f"), (("k9",), "'k9'"), (("k1", "k1"), "twice")],
    ids=["f and fx", "unknown", "twice"],
)
def test_intrinsics_that_contradict_each_other_are_refused(refine, message):
    with pytest.raises(InputError, match=message):
        BundleOptions(refine=refine)


GUESS_SIGMA = {"f": 0.01, "cx": 0.002, "k1": 0.03, "p1": 1e-3}


def guessing_problem(rng, used=4):
    """A problem whose intrinsics are pulled at guesses elsewhere; the last of `used` + 0 cameras may have no photo."""
    rec = make_scene(rng, "rotation", num_images=6, num_points=30, noise_px=1.0, dist=LENS)
    rec = replace(rec, camera_idx=np.arange(6) % used)
    refine = tuple(GUESS_SIGMA)
    guesses = [moved_camera(camera, refine, rng.normal(size=4) * [0.01, 0.002, 0.03, 1e-3]) for camera in rec.cameras]
    options = BundleOptions(
        loss="squared", sigma_px=1.0, refine=refine, guessed=GuessedCameras(guesses, GUESS_SIGMA), outlier_rounds=0
    )
    return rec, options


def test_gradient_of_the_prior_on_intrinsics_equals_central_differences(rng):
    rec, options = guessing_problem(rng)
    problem = BundleProblem(rec, "rotation", options, 1.0, Spreads(0.03, 0.1))
    state = problem.initial_state()
    equations = problem.linearize(state)
    expected = gradients(equations)[2]
    h = 3e-6
    for kind, index, step in unit_steps(problem, state):
        if kind == 2:
            ahead, behind = (problem.cost(problem.retract(state, scaled(step, s))) for s in (h, -h))
            assert abs((ahead - behind) / (2 * h) - expected[index]) <= 1e-6 * np.abs(expected).max()


def test_weak_photos_leave_intrinsics_at_their_guess_and_strong_ones_do_not(rng):
    rec, options = guessing_problem(rng)
    tight = replace(options, guessed=GuessedCameras(options.guessed.cameras, dict.fromkeys(GUESS_SIGMA, 1e-9)))
    # from the guess: far from it a prior lets go
    held = bundle_adjust(replace(rec, cameras=tight.guessed.cameras), "rotation", tight)
    for camera, guess in zip(held.reconstruction.cameras, tight.guessed.cameras, strict=True):
        np.testing.assert_allclose(camera.K, guess.K, rtol=1e-6)
        assert camera.dist == pytest.approx(guess.dist, abs=1e-6)
    assert all(sigma["k1"] == pytest.approx(1e-9, rel=0.01) for sigma in held.sigma_intrinsics)
    loose = replace(options, guessed=GuessedCameras(options.guessed.cameras, dict.fromkeys(GUESS_SIGMA, 1e6)))
    free, without = (bundle_adjust(rec, "rotation", each) for each in (loose, replace(options, guessed=None)))
    K, K_without = (each.reconstruction.cameras[0].K for each in (free, without))
    np.testing.assert_allclose(K, K_without, rtol=1e-5)


def test_a_calibration_that_is_plainly_wrong_is_given_up_and_found_out(rng):
    rec = make_scene(rng, "rotation", num_images=8, num_points=300, noise_px=0.1, dist=LENS)
    sigma = {"f": 1e-3, "cx": 4e-4, "cy": 4e-4, "k1": 3e-3}
    wrong = [moved_camera(camera, ("cx",), np.array([0.02])) for camera in rec.cameras]
    guessed = GuessedCameras(wrong, sigma)
    options = BundleOptions(refine=tuple(sigma), guessed=guessed, outlier_rounds=0, sigma_px=0.1)
    found = bundle_adjust(replace(rec, cameras=wrong), "rotation", options).reconstruction
    for camera, true in zip(found.cameras, rec.cameras, strict=True):
        assert abs(camera.K[0, 2] - true.K[0, 2]) < 0.3 * 0.02 * true.K[0, 0]
    assert {name for _, name, _ in guessed.surprises(found.cameras)} == {"cx"}
    assert not guessed.surprises(wrong)


def test_a_lens_that_varies_from_photo_to_photo_is_found_and_no_shutter_is(rng):
    still = make_scene(rng, "global", num_images=12, num_points=150, noise_px=0.2, dist=LENS, phi_size=0.0)
    camera = replace(still.cameras[0], readout="top-to-bottom")
    still = replace(still, cameras=(camera,), camera_idx=np.zeros(12, np.int64))
    varied = replace(still, variation=rng.normal(size=(12, 3)) * [0.01, 0.01, 0.01])
    predicted, _ = reprojection_residuals(
        replace(varied, observations=replace(still.observations, xy_raw=0 * still.observations.xy_raw))
    )
    xy = predicted + 0.2 * rng.normal(size=predicted.shape)
    rec = replace(still, observations=replace(still.observations, xy_raw=xy))
    options = BundleOptions(
        refine=("f", "cx", "cy"), guessed=GuessedCameras(rec.cameras, {"f": 0.02, "cx": 0.01, "cy": 0.01})
    )
    choice = choose_model(rec, options=options, sigma_px=0.2)
    assert choice.varying
    assert (choice.shutter_model, choice.shutter) == ("global", "not-found")
    result = bundle_adjust(rec, "global", replace(options, varying=True))
    error = result.reconstruction.variation - varied.variation
    error -= error.mean(0)  # what they have in common is the camera's
    assert np.sqrt(np.mean(error**2, 0)) == pytest.approx([0.0] * 3, abs=2e-3)
    assert 0.005 < result.focal_sigma < 0.02
    assert 0.005 < result.centre_sigma < 0.02


def test_what_the_other_axis_explains_as_well_is_no_shutter(rng):
    # read by columns, and believed to be read by rows: bent photos, but not by such a shutter
    scene = make_scene(rng, "rotation", num_images=10, num_points=150, noise_px=0.3, phi_size=0.03)
    by_rows = [replace(camera, readout="top-to-bottom") for camera in scene.cameras]
    by_columns = replace(scene, cameras=[replace(camera, readout="left-to-right") for camera in scene.cameras])
    xy, _ = reprojection_residuals(
        replace(by_columns, observations=replace(scene.observations, xy_raw=np.zeros_like(scene.observations.xy_raw)))
    )
    seen = replace(scene.observations, xy_raw=xy + 0.3 * rng.normal(size=xy.shape))
    still = replace(scene, cameras=by_rows, phi=np.zeros_like(scene.phi), shutter_model="global", observations=seen)
    choice = choose_model(still, sigma_px=0.3)
    assert (choice.shutter, choice.shutter_model) == ("not-determined", "global")
    assert "other axis" in choice.against[0]
    assert choice.kept[-1] == choice.label == "global"
    right = choose_model(replace(still, cameras=by_columns.cameras), sigma_px=0.3)
    assert (right.shutter, right.shutter_model) == ("found", "rotation")


def test_photos_that_do_not_vary_have_no_variation(rng):
    rec = make_scene(rng, "rotation", num_images=8, num_points=150, noise_px=0.3)
    result = bundle_adjust(rec, "rotation", BundleOptions(varying=True, outlier_rounds=0))
    assert result.focal_sigma < 1e-3
    assert result.centre_sigma < 2e-3
    assert result.covariances.shape == (8, 9, 9)


@pytest.mark.parametrize("guess", [False, True])
def test_a_camera_that_took_no_photo_stays_as_it_was(guess, rng):
    rec, options = guessing_problem(rng, used=3)
    options = options if guess else replace(options, guessed=None)
    before = rec.cameras[3] if not guess else options.guessed.cameras[3]
    result = bundle_adjust(rec, "rotation", options)
    assert result.converged
    np.testing.assert_allclose(result.reconstruction.cameras[3].K, before.K, rtol=1e-6)
    np.testing.assert_allclose(result.reconstruction.cameras[3].dist, before.dist, atol=1e-6)


@pytest.mark.parametrize(("sigma", "named"), [({"f": -1.0}, "f"), ({"zoom": 1.0}, "zoom")])
def test_impossible_priors_on_intrinsics_are_refused(sigma, named):
    with pytest.raises(InputError, match=named):
        GuessedCameras((), sigma)


@pytest.mark.parametrize(
    ("name", "dist", "message"),
    [
        ("p1", FISHEYE, "p1 of a fisheye lens, expected some of k1, k2, k3, k4"),
        ("k4", RATIONAL, "k4 of a pinhole lens"),
    ],
    ids=["fisheye", "pinhole"],
)
def test_intrinsics_that_a_lens_lacks_are_refused(name, dist, message, rng):
    with pytest.raises(InputError, match=message):
        bundle_adjust(make_scene(rng, "global", dist=dist), "global", BundleOptions(refine=(name,)))


def test_a_pinhole_lens_among_fisheyes_stays_what_it_is(rng):
    rec = make_scene(rng, "rotation", dist=FISHEYE)
    both = make_scene(rng, "rotation", dist=LENS)
    mixed = replace(both, cameras=[*both.cameras[:3], rec.cameras[3]])
    res, valid = reprojection_residuals(mixed)
    assert valid.all()
    fisheye = both.camera_idx[both.observations.frame_idx] == 3
    assert np.abs(res[~fisheye]).max() < 1e-9  # px, as above
    assert np.abs(res[fisheye]).max() > 1


def test_ladder_ends_at_the_truth_and_climbs_in_order(rng):
    truth = make_scene(rng, "constant-motion")
    seen = []
    results = adjust_sequence(perturbed(truth, rng), progress=lambda model, cost: seen.append(model))
    assert list(results) == ["global", "two-step", "rotation", "constant-motion"]
    assert list(dict.fromkeys(seen)) == list(results)
    rms = [result.rms_px for result in results.values()]
    assert rms == sorted(rms, reverse=True)
    assert (results["global"].reconstruction.phi == 0).all()
    assert (results["rotation"].reconstruction.velocity == 0).all()
    # noise is taken for 0.02 px at least, so phi's deviation for 1e-4; the prior pulls by a small part of that
    np.testing.assert_allclose(results["constant-motion"].reconstruction.phi, truth.phi, atol=1e-4)


def test_motions_of_a_wide_fisheye_are_recovered(rng):
    """From amid the scene, up to 80 degrees from the axis, in all four directions; a global shutter leaves 2 px."""
    base = make_scene(rng, "global", num_images=8, num_points=1)
    cameras = [Camera(800, 600, [[260, 0, 402], [0, 262, 297], [0, 0, 1]], FISHEYE, r, "fisheye") for r in DIRECTIONS]
    points_w = rng.normal(size=(400, 3))
    points_w *= rng.uniform(2, 5, (400, 1)) / np.linalg.norm(points_w, axis=1, keepdims=True)
    center_w, phi = rng.uniform(-1, 1, (8, 3)), rng.uniform(-0.05, 0.05, (8, 3))
    frame_idx, point_idx, xy = [], [], []
    for i in range(8):
        in_camera = (points_w - center_w[i]) @ base.R_cw[i].T
        some = np.flatnonzero(in_camera[:, 2] > np.cos(np.deg2rad(80)) * np.linalg.norm(in_camera, axis=1))
        uv, valid = project_rows(points_w[some], base.R_cw[i], center_w[i], RowMotion(phi[i]), cameras[i % 4])
        inside = valid & ((uv >= 0) & (uv <= [799, 599])).all(1)
        frame_idx += [i] * inside.sum()
        point_idx += some[inside].tolist()
        xy += (uv[inside] + 0.5 * rng.normal(size=(inside.sum(), 2))).tolist()
    truth = replace(
        base, cameras=cameras, center_w=center_w, points_w=points_w, phi=phi,
        observations=Observations(frame_idx, point_idx, xy),
    )  # fmt: skip
    truth = truth.take_points(truth.track_lengths(np.ones(len(xy), bool)) >= 2)
    results = adjust_sequence(perturbed(truth, rng), ("global", "two-step", "rotation"))
    result = results["rotation"]
    assert results["global"].rms_px > 1.5
    assert 0.25 < result.rms_px < 0.5  # 0.5 px but for what the unknowns take up, a third
    assert 0.6 < np.sqrt(np.mean(((result.reconstruction.phi - phi) / result.sigma_phi) ** 2)) < 1.6  # 24 values
    assert np.abs(result.reconstruction.phi - phi).max() < 0.005


def test_spreads_of_the_priors_do_not_depend_on_their_start(rng):
    truth = make_scene(rng, "constant-motion", num_images=8, num_points=60, noise_px=0.5)
    ends = []
    for factor in (1 / 3, 1.0, 3.0):
        options = BundleOptions(phi_sigma_start=0.03 * factor, velocity_sigma_start=0.03 * factor)
        start = perturbed(truth, np.random.default_rng(1))
        ends.append(bundle_adjust(start, "constant-motion", options, simpler_first=True))
    span = truth.frame_span()[:, None]
    for result in ends:
        assert result.phi_sigma == pytest.approx(ends[1].phi_sigma, rel=0.02)
        assert result.velocity_sigma == pytest.approx(ends[1].velocity_sigma, rel=0.02)
        # 24 values of each
        assert result.phi_sigma == pytest.approx(np.sqrt(np.mean((truth.phi * span) ** 2)), rel=0.3)
        true_velocity = np.sqrt(np.mean((truth.velocity * span) ** 2)) / truth.baseline
        assert result.velocity_sigma == pytest.approx(true_velocity, rel=0.3)


def test_estimated_spread_is_the_mean_square_of_what_is_found_and_what_is_left_open(rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=60, noise_px=0.5)
    result = bundle_adjust(perturbed(truth, rng), "rotation", BundleOptions(spread_tolerance=1e-6, spread_rounds=40))
    square = (result.reconstruction.phi**2 + result.sigma_phi**2) * truth.frame_span()[:, None] ** 2
    assert np.abs(result.reconstruction.phi).max() < 3 * np.sqrt(np.median(square) / 0.455)  # none is cut
    assert result.phi_sigma == pytest.approx(np.sqrt(square.mean()), rel=1e-4)


def test_settling_moves_points_alone_and_never_to_a_higher_cost(rng):
    truth = make_scene(rng, "rotation", noise_px=0.5)
    start = replace(truth, points_w=truth.points_w + 0.02 * rng.normal(size=truth.points_w.shape))
    problem = BundleProblem(start, "rotation", BundleOptions(loss="squared"), 0.5, Spreads(0.03, 0.03))
    state = problem.initial_state()
    before = problem._track_costs(state)
    settled = problem.settle(state)
    assert (problem._track_costs(settled) <= before).all()
    # with the true photos one step ends at the noise: half the number of values, less three for each point
    assert problem.cost(state) > 10 * len(truth.observations)
    assert problem.cost(settled) == pytest.approx(len(truth.observations) - 1.5 * truth.num_points, rel=0.25)
    for name in ("R_cw", "center_w", "phi", "velocity"):
        assert getattr(settled, name) is getattr(state, name)


@pytest.mark.parametrize("noise_px", [0.1, 0.5, 2.0])
def test_residuals_and_errors_scale_with_the_noise(noise_px, rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=80, noise_px=noise_px)
    result = bundle_adjust(perturbed(truth, rng), "rotation")
    # 1280 measurements, 8 * 9 + 3 * 80 - 7 unknowns: residuals are 0.87 of the noise, within 2 % (one sigma)
    assert 0.6 * noise_px < result.rms_px < 1.1 * noise_px
    # the median of 1280 residuals knows sigma to 3 %
    assert result.sigma_px == pytest.approx(noise_px, rel=0.15)
    # normalised errors have a spread of 1 if the deviations are honest; 24 of them, not independent
    normalised = (result.reconstruction.phi - truth.phi) / result.sigma_phi
    assert 0.5 < np.sqrt(np.mean(normalised**2)) < 1.6
    # the prior is estimated from 24 values of a true spread of 0.05 / sqrt(3) a unit
    spread = np.sqrt(np.mean((truth.phi * truth.frame_span()[:, None]) ** 2))
    assert result.phi_sigma == pytest.approx(spread, rel=0.25)


def test_gross_outliers_are_dropped_and_the_estimate_stays(rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=80, noise_px=0.5)
    obs = truth.observations
    gross = rng.random(len(obs)) < 0.05
    direction = rng.normal(size=(len(obs), 2))
    direction *= rng.uniform(20, 200, (len(obs), 1)) / np.linalg.norm(direction, axis=1, keepdims=True)
    spoiled = replace(obs, xy_raw=obs.xy_raw + gross[:, None] * direction)
    start = replace(perturbed(truth, rng), observations=spoiled)
    result = bundle_adjust(start, "rotation")
    kept = {tuple(xy) for xy in result.reconstruction.observations.xy_raw}
    assert not kept & {tuple(xy) for xy in spoiled.xy_raw[gross]}
    # good ones go with them where an outlier still bends its point in the first round: seen up to one each
    assert gross.sum() <= result.num_outliers <= 3 * gross.sum()
    assert 0.3 < result.rms_px < 0.55
    clean = bundle_adjust(perturbed(truth, rng), "rotation")
    # losing 5 % of the measurements moves the estimate by less than its own uncertainty
    assert (np.abs(result.reconstruction.phi - clean.reconstruction.phi) < 2 * clean.sigma_phi).all()
    assert np.sqrt(np.mean(((result.reconstruction.phi - truth.phi) / result.sigma_phi) ** 2)) < 1.6


def test_estimate_from_gross_outliers_does_not_depend_on_the_loss(rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=80, noise_px=0.5)
    obs = truth.observations
    gross = rng.random(len(obs)) < 0.05
    spoiled = replace(obs, xy_raw=obs.xy_raw + gross[:, None] * rng.uniform(20, 200, (len(obs), 2)))
    start = replace(perturbed(truth, rng), observations=spoiled)
    losses = ("soft-l1", "cauchy")
    results = [bundle_adjust(start, "rotation", BundleOptions(loss=loss)) for loss in losses]
    # the last rounds are squares; which good ones went with the outliers differs, and moves phi by less than its noise
    for result in results[1:]:
        assert (np.abs(result.reconstruction.phi - results[0].reconstruction.phi) < results[0].sigma_phi).all()


def test_rays_that_miss_each_other_do_not_hold_up_the_rest(rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=300, noise_px=0.5)
    obs = truth.observations
    # many points that two photos alone show, some of them wrongly: along no direction does such a point fit
    first = np.argsort(np.argsort(obs.frame_idx + 100 * obs.point_idx)) - np.searchsorted(obs.point_idx, obs.point_idx)
    obs = obs.select((first < 2) | (obs.point_idx % 2 == 0))
    gross = (rng.random(len(obs)) < 0.1)[:, None]
    spoiled = replace(obs, xy_raw=obs.xy_raw + gross * rng.uniform(5, 60, (len(obs), 2)))
    start = replace(perturbed(truth, rng), observations=spoiled)
    options = BundleOptions(spread_rounds=0, sigma_px=0.5, phi_sigma=0.03, deviations="model")
    result = bundle_adjust(start, "rotation", options)
    assert result.converged
    # over four solves: points that are sent far off damp the step of all others, and it takes 80 to 120
    assert result.num_iterations < 40


def test_kernels_meet_one_kind_of_array(rng):
    """They are compiled for each kind that they meet: what is read only, and views, as well."""
    problem, state = noisy_problem(rng, "rotation")
    step, _ = problem.linearize(state).solve(1e-4)
    views = np.asfortranarray(state.points_w), np.hstack([state.center_w] * 2)[:, :3]
    seen = replace(state, points_w=views[0], center_w=views[1])
    for each in (state, problem.retract(state, step), seen):
        arrays = [value for value in problem._kernel_args(each) if isinstance(value, np.ndarray)]
        assert len(arrays) > 10
        assert all(array.flags.c_contiguous and array.flags.writeable for array in arrays)


def test_anchored_components_stay_exactly_zero(rng):
    truth = make_scene(rng, "rotation", noise_px=0.5)
    options = BundleOptions(held_phi={"2.jpg": (0,), "4.jpg": (0, 1, 2)})
    result = bundle_adjust(replace(perturbed(truth, rng), phi=truth.phi), "rotation", options)
    held = np.zeros((6, 3), bool)
    held[2, 0] = held[4] = True
    assert (result.reconstruction.phi[held] == 0).all()
    assert (result.reconstruction.phi[~held] != 0).all()
    assert (result.sigma_phi[held] == 0).all()
    assert (result.sigma_phi[~held] > 0).all()


def test_unknown_anchors_are_refused_by_name(rng):
    rec = make_scene(rng, "rotation")
    with pytest.raises(InputError, match=r"anchor 'x\.jpg' is not a photo"):
        bundle_adjust(rec, "rotation", BundleOptions(held_phi={"x.jpg": (0,)}))
    with pytest.raises(InputError, match=r"anchor '1\.jpg': components \(3,\)"):
        bundle_adjust(rec, "rotation", BundleOptions(held_phi={"1.jpg": (3,)}))


def test_too_little_to_adjust_is_refused(rng):
    rec = make_scene(rng, "rotation")
    nothing = rec.observations.select(np.zeros(0, int))
    with pytest.raises(InputError, match="two photos and measurements"):
        bundle_adjust(replace(rec, observations=nothing), "rotation", BundleOptions(sigma_px=1.0))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"loss": "l2"}, "loss='l2', expected one of squared, huber"),
        ({"sigma_px": 0.0}, "sigma_px=0.0, expected a positive number or None"),
        ({"phi_sigma": -1.0}, "phi_sigma=-1.0, expected a positive number or None"),
        ({"cost_tolerance": float("nan")}, "cost_tolerance=nan, expected a positive number"),
        ({"max_iterations": 0}, "max_iterations must be at least 1"),
    ],
)
def test_wrong_options_are_refused_by_name(options, message):
    with pytest.raises(InputError, match=message):
        BundleOptions(**options)


@pytest.mark.parametrize("model", MODELS)
def test_similarity_of_the_world_leaves_residuals_unchanged(model, rng):
    rec = make_scene(rng, model, noise_px=0.5, dist=LENS)
    A, scale, shift = Rotation.random(rng=rng).as_matrix(), 3.7, np.array([10.0, -20.0, 5.0])
    moved = replace(
        rec,
        R_cw=rec.R_cw @ A.T,
        center_w=scale * rec.center_w @ A.T + shift,
        points_w=scale * rec.points_w @ A.T + shift,
        velocity=scale * rec.velocity @ A.T,
    )
    # rounding of coordinates of 20 scene sizes
    np.testing.assert_allclose(reprojection_residuals(moved)[0], reprojection_residuals(rec)[0], atol=1e-9)


def test_same_input_gives_the_same_result_on_any_number_of_threads(rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=200, noise_px=0.5)
    start = perturbed(truth, rng)

    def solve(n):
        numba.set_num_threads(min(n, numba.config.NUMBA_NUM_THREADS))
        rec = bundle_adjust(start, "rotation").reconstruction
        return np.concatenate([rec.phi.ravel(), rec.center_w.ravel(), rec.R_cw.ravel(), rec.points_w.ravel()])

    one, again, two = solve(1), solve(1), solve(2)
    np.testing.assert_array_equal(one, again)
    # every loop in parallel owns what it writes, so sums are the same; so is the factor
    np.testing.assert_allclose(two, one, rtol=1e-9, atol=1e-12)


def test_order_of_the_measurements_does_not_matter(rng):
    truth = make_scene(rng, "rotation", noise_px=0.5)
    start = perturbed(truth, rng)
    shuffled = replace(start, observations=start.observations.select(rng.permutation(len(start.observations))))
    one, two = (bundle_adjust(rec, "rotation").reconstruction for rec in (start, shuffled))
    np.testing.assert_allclose(two.phi, one.phi, rtol=0, atol=1e-12)  # sorted before the sums
    np.testing.assert_allclose(two.points_w, one.points_w, rtol=0, atol=1e-12)


def test_cost_falls_with_each_accepted_step_and_the_reason_is_said(rng):
    start = perturbed(make_scene(rng, "rotation", noise_px=0.5), rng)
    once = BundleOptions(outlier_rounds=0, spread_rounds=0)
    result = bundle_adjust(start, "rotation", once)
    assert result.stop_reason == "cost"
    assert result.converged
    assert len(result.cost_history) > 3
    assert (np.diff(result.cost_history) < 0).all()
    assert result.num_iterations >= len(result.cost_history) - 1
    costs = []
    short = bundle_adjust(start, "rotation", replace(once, max_iterations=1), costs.append)
    assert short.stop_reason == "iterations"
    assert not short.converged
    assert short.num_iterations == 1
    assert costs == short.cost_history[1:].tolist()
    at_rest = BundleOptions(outlier_rounds=0, step_tolerance=1e3)
    assert bundle_adjust(start, "rotation", at_rest).stop_reason == "step"


@pytest.mark.parametrize("model", ["global", "two-step", "rotation", "constant-motion"])
def test_the_model_that_made_the_measurements_is_chosen(model, rng):
    # strong motion, so that every rung's mistake shows against the noise
    truth = make_scene(rng, model, num_images=10, num_points=150, noise_px=0.3, phi_size=0.15)
    models = LADDER[: max(LADDER.index(model) + 1, 3)]
    start = adjust_sequence(perturbed(truth, rng), models)["rotation"].reconstruction
    choice = choose_model(start, sigma_px=0.3)
    assert choice.shutter_model == model
    assert list(choice.held_out_rms_px) == list(choice.held_out_error)
    assert [label for label in choice.held_out_error if label in LADDER] == list(LADDER)
    assert choice.kept[0] == "global"
    assert choice.kept[-1] == choice.label == model
    assert choice.shutter == ("not-found" if model == "global" else "found")
    assert choice.agreement is None or choice.agreement > 0.9
    # what it was made from foretells to the noise, and to what the point's own uncertainty adds
    assert 0.25 < choice.held_out_rms_px[model] < 0.5
    assert 140 <= choice.num_held_out <= 150  # a tenth of them, one a track; the ladder dropped a few
    assert choose_model(start, sigma_px=0.3) == choice


def test_no_rung_is_worse_than_the_one_inside_it_wherever_the_choice_starts(rng):
    # phi is per focal length: turns of a quarter radian a frame, found under a lens four times too long, are of a
    # whole one under the lens that the first rung then finds, and few points are where such photos could see them
    truth = make_scene(rng, "global", num_images=12, num_points=120, noise_px=0.3, dist=[-0.2, 0.05, 0, 0])
    long = [replace(c, K=c.K * [[4, 1, 1], [1, 4, 1], [1, 1, 1]], dist=()) for c in truth.cameras]
    astray = replace(truth, cameras=long, shutter_model="rotation")
    astray = replace(astray, phi=0.25 / astray.frame_span()[:, None] * rng.normal(size=truth.phi.shape))
    options = BundleOptions(refine=("f", "k1", "k2"))
    choice = choose_model(astray, options=options, sigma_px=0.3)
    assert choice.shutter_model == "global"
    rms = list(choice.held_out_rms_px.values())
    assert 0.25 < rms[0] < 0.4
    # what a rung fits to noise: 36 unknowns more on 1300 measurements, 72 for the last
    np.testing.assert_allclose(rms, rms[0], rtol=0.03)


def test_what_one_kernel_sees_another_does(rng):
    # turns so strong, under a lens so curved, that from the row of a still camera the search ends elsewhere or nowhere
    rec = make_scene(rng, "global", num_images=12, num_points=100)
    rec = replace(rec, phi=rng.uniform(-1.2, 1.2, rec.phi.shape), shutter_model="rotation")
    cameras = [replace(camera, dist=[-0.25, 0.1, 0, 0]) for camera in rec.cameras]
    frame_idx = rec.observations.frame_idx
    xy = rng.uniform(0, (799, 599), (len(frame_idx), 2))
    points_w, seen = np.empty((len(xy), 3)), np.empty(len(xy), bool)
    for i in range(rec.num_images):
        mine = frame_idx == i
        ideal, seen[mine] = unproject_points(xy[mine], cameras[rec.camera_idx[i]], rec.motion(i), "rotation")
        rays = np.column_stack([ideal, np.ones(len(ideal))]) * rng.uniform(3, 4, (len(ideal), 1))
        points_w[mine] = rec.center_w[i] + rays @ rec.R_cw[i]
    rec = replace(rec, cameras=cameras, points_w=points_w, observations=Observations(frame_idx, np.arange(len(xy)), xy))
    res, valid = reprojection_residuals(rec)
    assert valid[seen].mean() > 0.8
    np.testing.assert_allclose(res[valid], 0, atol=1e-6)
    rec = rec.with_points(valid, min_track=1)
    options = BundleOptions(loss="squared", refine=("f", "k1"))
    fresh, other = (BundleProblem(rec, "rotation", options, 1.0, Spreads(1.0, 1.0)) for _ in range(2))
    state = fresh.initial_state()
    np.testing.assert_allclose(fresh.linearize(state).cost, other.cost(state), rtol=1e-12)
    of_lens = fresh._camera_jacobians(state)
    assert (np.abs(of_lens).sum((1, 2)) > 0).all()


@pytest.mark.parametrize("wrong", [(), (1,), (0, 2), (0, 1, 2, 3)])
def test_the_axis_of_the_readout_is_found_whatever_was_guessed(wrong, rng):
    rec = make_scene(rng, "rotation", num_images=12, num_points=150, noise_px=0.3, phi_size=0.05)
    cameras = list(rec.cameras)
    for k in wrong:
        other = "left-to-right" if cameras[k].readout.endswith(("top", "bottom")) else "top-to-bottom"
        cameras[k] = replace(cameras[k], readout=other)
    guessed = replace(perturbed(rec, rng), cameras=cameras, shutter_model="global")
    choice = choose_readouts(guessed, range(4))
    assert choice.turned == wrong
    for found, true in zip(choice.reconstruction.cameras, rec.cameras, strict=True):
        assert READOUTS[found.readout][0] == READOUTS[true.readout][0]


def test_without_motion_the_guess_of_the_readout_stays(rng):
    rec = make_scene(rng, "global", num_images=12, num_points=100, noise_px=0.3)
    choice = choose_readouts(perturbed(rec, rng), range(4))
    assert choice.turned == ()
    assert choice.reconstruction.cameras == rec.cameras


def test_a_camera_whose_readout_was_told_is_left_alone(rng):
    rec = make_scene(rng, "rotation", num_images=8, num_points=100, noise_px=0.3)
    assert list(choose_readouts(rec, [2]).gain) == [2]
    assert choose_readouts(rec, []).gain == {}


def test_held_out_measurements_leave_their_tracks_three(rng):
    rec = make_scene(rng, "rotation", num_images=6, num_points=40)
    some = rng.random(len(rec.observations)) < 0.7
    rec = rec.with_points(some)
    fitted, held = hold_out(rec, share=0.2, seed=3)
    assert (fitted ^ held).all()
    points = rec.observations.point_idx[held]
    assert len(np.unique(points)) == len(points)
    left = np.bincount(rec.observations.point_idx[fitted], minlength=rec.num_points)
    assert (left[points] >= 3).all()
    assert (hold_out(rec, share=0.2, seed=4)[1] != held).any()


def test_points_that_no_photo_can_see_come_back(rng):
    truth = make_scene(rng, "rotation", noise_px=0.3)
    points = truth.points_w.copy()
    points[3] = truth.center_w[0] - 5 * truth.R_cw[0, 2]  # behind photo 0
    points[17] *= 100
    result = bundle_adjust(replace(truth, points_w=points), "rotation", BundleOptions(outlier_rounds=0))
    assert result.reconstruction.num_points == truth.num_points
    found, true = ((rec.points_w[[3, 17]] - rec.center_w[0]) @ rec.R_cw[0].T for rec in (result.reconstruction, truth))
    np.testing.assert_allclose(found, true, atol=0.05)
    assert result.rms_px < 0.4


def test_points_that_ran_off_to_infinity_come_back(rng):
    truth = make_scene(rng, "rotation", noise_px=0.3)
    points = truth.points_w.copy()
    points[[2, 9, 31]] *= 1e9
    options = BundleOptions(outlier_rounds=0, loss="squared", sigma_px=0.3)
    result = bundle_adjust(replace(truth, points_w=points), "rotation", options)
    found, true = ((rec.points_w - rec.center_w[0]) @ rec.R_cw[0].T for rec in (result.reconstruction, truth))
    np.testing.assert_allclose(found[[2, 9, 31]], true[[2, 9, 31]], atol=0.05)
    assert result.rms_px < 0.4


def test_points_at_infinity_stay_far(rng):
    scene = named_scene("10 degrees")
    points = scene.points_w.copy()
    points[:5] = 1e7 * (np.array([0.0, 0.0, 1.0]) + 0.1 * rng.normal(size=(5, 3)))
    phi = rng.uniform(-0.05, 0.05, (scene.num_images, 3))
    obs = scene.observations
    xy = np.empty((len(obs), 2))
    for i in range(scene.num_images):
        mine = obs.frame_idx == i
        K = scene.camera(i).K
        xy[mine] = project(
            points[obs.point_idx[mine]], scene.R_cw[i], scene.center_w[i], phi[i], "rotation", "top-to-bottom", K, []
        )
    xy += 0.3 * rng.normal(size=xy.shape)
    inside = ((xy > -200) & (xy < 1200)).all(1)
    start = replace(
        scene, points_w=points, observations=Observations(obs.frame_idx, obs.point_idx, xy).select(inside),
        shutter_model="rotation",
    )  # fmt: skip
    assert start.track_lengths(np.ones(int(inside.sum()), bool)).min() >= 3
    options = BundleOptions(outlier_rounds=0, loss="squared", sigma_px=0.3)
    result = bundle_adjust(start, "rotation", options)
    assert result.converged
    assert result.rms_px < 0.35
    # 0.3 px over 900 are 2 mm at 7 m: what is so far has no measurable parallax
    assert np.linalg.norm(result.reconstruction.points_w[:5], axis=1).min() > 200
    assert np.linalg.norm(result.reconstruction.points_w[5:], axis=1).max() < 20


def test_objective_of_the_truth_is_above_that_of_the_estimate(rng):
    truth = make_scene(rng, "rotation", noise_px=0.5)
    options = BundleOptions(outlier_rounds=0, loss="squared", sigma_px=0.5, phi_sigma=0.03)
    result = bundle_adjust(perturbed(truth, rng), "rotation", options)
    assert objective(result.reconstruction, "rotation", options) == pytest.approx(result.cost_history[-1], rel=1e-6)
    assert objective(result.reconstruction, "rotation", options) < objective(truth, "rotation", options)
    with pytest.raises(InputError, match="needs sigma_px"):
        objective(truth, "rotation", BundleOptions())


@pytest.mark.slow
@pytest.mark.parametrize("model", ["rotation", "constant-motion"])
def test_predicted_deviations_are_those_of_monte_carlo(model):
    # of 200 trials each of 50 ratios has a standard error of 5 %
    for found in covariance.ratios(model, 200).values():
        assert found.min() > 0.85
        assert found.max() < 1.15


def test_predicted_deviations_are_those_of_few_trials():
    for found in covariance.ratios("rotation", 30).values():
        # 13 % each, and the components of a photo go together
        assert 0.85 < np.sqrt(np.mean(found**2)) < 1.15


def test_two_photos_are_too_few_for_a_shutter(rng):
    rec = make_scene(rng, "global", num_images=2)
    with pytest.raises(InputError, match="at least three"):
        bundle_adjust(rec, "rotation")
    assert bundle_adjust(rec, "global").converged


def test_photos_without_parallax_are_refused(rng):
    rec = make_scene(rng, "global")
    with pytest.raises(InputError, match="without parallax"):
        bundle_adjust(replace(rec, center_w=np.tile(rec.center_w[:1], (6, 1))), "rotation")


def test_a_photo_with_fewer_measurements_than_unknowns_keeps_its_motion_at_the_prior(rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=80, noise_px=0.3)
    obs = truth.observations
    poor = (obs.frame_idx != 5) | (obs.point_idx < 4)  # 8 numbers for 9 unknowns
    start = perturbed(replace(truth, observations=obs.select(poor)), rng, 0.002, 0.005)
    result = bundle_adjust(start, "rotation")
    prior = result.phi_sigma / truth.frame_span()[5]
    # its pose takes six of the eight numbers; two are left for phi, whose third direction stays at the prior
    assert result.sigma_phi[5].max() > 0.8 * prior
    assert (np.abs(result.reconstruction.phi[5] - truth.phi[5]) < 3 * result.sigma_phi[5]).all()
    others = np.delete(np.arange(8), 5)
    assert result.sigma_phi[others].max() < 0.2 * prior
    np.testing.assert_allclose(result.reconstruction.phi[others], truth.phi[others], atol=0.01)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_measurements_that_are_no_numbers_are_refused(value, rng):
    obs = make_scene(rng, "rotation").observations
    xy = obs.xy_raw.copy()
    xy[3, 1] = value
    with pytest.raises(InputError, match="xy_raw holds NaN or infinity"):
        replace(obs, xy_raw=xy)
