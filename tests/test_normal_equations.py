"""The linear system of the adjustment: derivatives through the step, elimination, covariances."""

from __future__ import annotations

from dataclasses import replace

import covariance
import numpy as np
import pytest
from bundle_scenes import (
    FISHEYE,
    LENS,
    RATIONAL,
    common_steps,
    dense_system,
    gradients,
    make_scene,
    noisy_problem,
    perturbed,
    scaled,
    unit_steps,
)
from numpy_reference import MODELS, Fisheye

from rsundistort import BundleOptions
from rsundistort._kernels import schur
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.model import KnownLength
from rsundistort.model.reprojection import reprojection_residuals

# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


REFINE = ("f", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


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
    order = problem.structure.order
    obs = problem._start.observations.select(order)
    _, J_frame = problem.blocks(state)
    jacobians = J_frame, -J_frame[:, :, 3:6], problem._camera_jacobians(state)
    owners_of = obs.frame_idx, obs.point_idx, problem._start.camera_idx[obs.frame_idx]
    h = 1e-6

    def residuals(step):
        moved = problem.reconstruction(problem.retract(state, step))
        res, valid = reprojection_residuals(moved)
        assert valid.all()
        return res[order] / (0.5 * obs.sigma[:, None])

    for kind, k, step in common_steps(problem, state, rng):
        difference = (residuals(scaled(step, h)) - residuals(scaled(step, -h))) / (2 * h)
        expected = step[kind][owners_of[kind], k, None] * jacobians[kind][:, :, k]
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
        if refine and kind < 2 and index[0] > 0:
            continue  # with cameras that stay the others do as one does
        ahead, behind = (problem.cost(problem.retract(state, scaled(step, s))) for s in (h, -h))
        gradient = gradients(equations)[kind]
        # third derivatives give h^2 (f/sigma)^2 = 1e-4 of some 1e4; rounding of the cost over h as little
        assert abs((ahead - behind) / (2 * h) - gradient[index]) <= 1e-6 * np.abs(gradient).max()


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
    found = problem.linearize(state).covariance(vector)[0]
    reference = (whole[: m * nb, : m * nb] @ vector.ravel()).reshape(m, nb)
    np.testing.assert_allclose(found, reference, rtol=0, atol=1e-8 * np.abs(reference).max())
    weights = rng.normal(size=(problem._start.num_points, 3))
    found = problem.linearize(state).function_of_points(problem.in_order(weights))
    variance, with_photos = found.variance, found.with_photos
    start, stop = m * nb, m * nb + weights.size
    b = weights[problem.structure.points].ravel()
    assert variance == pytest.approx(b @ whole[start:stop, start:stop] @ b, rel=1e-7)
    reference = (whole[: m * nb, start:stop] @ b).reshape(m, nb)
    np.testing.assert_allclose(with_photos, reference, rtol=0, atol=1e-7 * np.abs(reference).max())
    photos, cameras, *_ = problem.linearize(state).marginal_covariances()
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
        problem = BundleProblem(start, model, options, 0.5, PriorSigmas(0.03, 0.1))
        assert (problem._elimination.space is not None) == (factor_limit < 0)
        steps.append(problem.linearize(problem.initial_state()).solve(1e-4)[0])
    for factored, iterated in zip(*steps, strict=True):
        np.testing.assert_allclose(iterated, factored, rtol=0, atol=1e-7 * np.abs(factored).max(initial=0))


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
    joined = BundleProblem(given, "rotation", replace(problem._options, lengths=lengths), 0.5, PriorSigmas(0.03, 0.1))
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
        found = equations.covariance(vector)[0]
        np.testing.assert_allclose(found, reference, rtol=0, atol=1e-7 * np.abs(reference).max())
        photos, cameras, *_ = equations.marginal_covariances()
        for i in range(m):
            block = whole[nb * i : nb * i + nb, nb * i : nb * i + nb]
            np.testing.assert_allclose(photos[i], block, rtol=0, atol=1e-7 * np.abs(block).max())
        block = whole[len(whole) - len(cameras) :, len(whole) - len(cameras) :]
        np.testing.assert_allclose(cameras, block, rtol=0, atol=1e-7 * np.abs(block).max(initial=0))
        weights = rng.normal(size=(given.num_points, 3))
        variance = joined.linearize(state).function_of_points(joined.in_order(weights)).variance
        b = weights[joined.structure.points].ravel()
        assert variance == pytest.approx(b @ whole[points, points] @ b, rel=1e-6)


def test_points_without_parallax_keep_what_their_measurements_say_across_them(rng):
    rays = rng.normal(size=(50, 2, 3))
    flat = np.einsum("nki,nkj->nij", rays, rays)  # of rank two
    full = flat + np.eye(3)
    V = np.concatenate([flat, full, np.zeros((1, 3, 3))])
    V_inv = np.empty_like(V)
    schur.invert_points(V, 0.0, V_inv)
    np.testing.assert_allclose(V @ V_inv @ V, V, atol=1e-9 * np.abs(V).max())
    np.testing.assert_allclose(V_inv[50:100], np.linalg.inv(full), atol=1e-9)
    # what elimination takes from a photo that sees the points along these rays is the same for any such inverse
    kept = np.einsum("nki,nij,nlj->nkl", rays, V_inv[:50], rays)
    np.testing.assert_allclose(kept, np.broadcast_to(np.eye(2), kept.shape), atol=1e-6)


def test_a_point_at_the_lens_neither_moves_nor_says_anything(rng):
    problem, state = noisy_problem(rng, "rotation", refine=("f", "k1"))
    point, photo = 7, problem.structure.frame_idx[problem.structure.track_start[7]]
    at_lens = state.points_w.copy()
    at_lens[point] = state.center_w[photo] + 1e-7 * state.R_cw[photo][2]
    moved = replace(state, points_w=at_lens)
    mine = np.arange(*problem.structure.track_start[point : point + 2])
    singular = mine[problem.structure.frame_idx[mine] == photo]
    res, J_frame = problem.blocks(moved)
    assert not res[singular].any()
    assert not J_frame[singular].any()
    equations = problem.linearize(moved)
    assert not equations._border.J[singular].any()
    photos = equations.marginal_covariances().photos
    assert np.isfinite(photos).all()
    # without one of a hundred measurements, at the same state
    other = problem.linearize(state).marginal_covariances()
    sigma, before = (np.sqrt(np.einsum("maa->ma", each)) for each in (photos, other.photos))
    np.testing.assert_allclose(sigma, before, rtol=0.5)


def test_near_points_count_where_most_of_the_scene_is_far(rng):
    problem, state = noisy_problem(rng, "rotation")
    given = problem.reconstruction(state)
    far = given.points_w.copy()
    far[: int(0.8 * len(far))] *= 1e4
    mountains = BundleProblem(
        replace(given, points_w=far), "rotation", BundleOptions(), 0.5, PriorSigmas(0.03, 0.1, 0.02, 0.01)
    )
    _, J_frame = mountains.blocks(mountains.initial_state())
    _, valid = reprojection_residuals(replace(given, points_w=far))
    assert (J_frame.any(axis=(1, 2)) == valid[mountains.structure.order]).all()
