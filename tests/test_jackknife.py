"""Deviations by residuals that go together: against the whole inverse, and against Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import dense_system, make_scene, noisy_problem

from rsundistort import BundleOptions, KnownLength, bundle_adjust
from rsundistort.bundle import Posterior
from rsundistort.bundle.common_motion import MeansPrior
from rsundistort.bundle.jackknife import Inflation, by_corner, by_place, inflated, inflation, sketch
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.bundle.solver import minimize
from rsundistort.critical.cost import _log_scale
from rsundistort.errors import InputError


def whole_jacobian(problem, state):
    """Weighted residuals (o, 2), Jacobian (o, 2, all unknowns), and Hessian and its inverse with 0 where held."""
    res, J_frame = problem.blocks(state)
    J_camera = problem._camera_jacobians(state)
    H, _, free = dense_system(problem, state)
    s, camera_idx = problem.structure, problem._start.camera_idx
    (m, nb), n, nc = problem._free.shape, len(state.points_w), J_camera.shape[2]
    J = np.zeros((len(res), 2, len(free)))
    for k, (f, p) in enumerate(zip(s.frame_idx, s.point_idx, strict=True)):
        for first, block in (
            (nb * f, J_frame[k]),
            (m * nb + 3 * p, -J_frame[k, :, 3:6]),
            (m * nb + 3 * n + nc * camera_idx[f], J_camera[k]),
        ):
            J[k, :, first : first + block.shape[1]] = block
    scale = 1 / np.sqrt(np.diag(H)[free])
    inverse = np.zeros_like(H)
    inverse[np.ix_(free, free)] = scale[:, None] * np.linalg.inv(scale[:, None] * H[np.ix_(free, free)] * scale) * scale
    return res, J, H, inverse


def assert_near(found, expected, tolerance=1e-7):
    # condition numbers up to 1e6 times rounding
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * np.abs(expected).max(initial=0))


@pytest.mark.parametrize("refine", [(), ("f", "k1")], ids=["calibrated", "refined"])
@pytest.mark.parametrize("model", ["global", "rotation", "constant-motion"])
def test_pulls_of_groups_are_those_of_the_whole_system(model, refine, rng):
    problem, state = noisy_problem(rng, model, refine=refine)
    res, J, _, inverse = whole_jacobian(problem, state)
    (m, nb), k = problem._free.shape, len(refine) * len(state.cameras)
    group = rng.integers(0, 3, len(res))
    photos, cameras = problem.linearize(state).group_pulls(res, group, 3)
    for g in range(3):
        expected = inverse @ np.einsum("oij,oi->j", J[group == g], res[group == g])
        assert_near(photos[g], expected[: m * nb].reshape(m, nb))
        assert_near(cameras[g], expected[len(expected) - k :])


def test_residuals_that_a_fit_leaves_are_those_of_the_whole_system(rng):
    problem, state = noisy_problem(rng, "rotation", refine=("f", "k1"))
    res, J, H, inverse = whole_jacobian(problem, state)
    m, nb = problem._free.shape
    prior = (np.diag(H) - np.einsum("oij,oij->j", J, J))[: m * nb].reshape(m, nb)
    noise, of_photos = rng.normal(size=res.shape), rng.normal(size=(m, nb))
    gradient = np.einsum("oij,oi->j", J, noise)
    gradient[: m * nb] += (np.sqrt(np.maximum(prior, 0)) * of_photos * (prior > 1e-6 * prior.max())).ravel()
    found = problem.linearize(state).residuals_of(noise, of_photos, np.zeros(2 * len(state.cameras)), rng)
    np.testing.assert_allclose(found, noise - J @ (inverse @ gradient), atol=1e-6)  # of some 1


def test_shares_of_the_priors_and_inflated_covariances_are_those_of_the_whole_inverse(rng):
    problem, state = noisy_problem(rng, "constant-motion", refine=("f", "k1"))
    _, J, H, inverse = whole_jacobian(problem, state)
    (m, nb), k = problem._free.shape, 2 * len(state.cameras)
    prior = np.diag(H) - np.einsum("oij,oij->j", J, J)
    prior[np.abs(prior) < 1e-9 * np.diag(H)] = 0.0
    of_priors = inverse @ (prior[:, None] * inverse)
    equations = problem.linearize(state)
    marginals = equations.marginal_covariances()
    last = slice(len(inverse) - k, None)
    assert_near(marginals.cameras, inverse[last, last])
    # a difference quotient, off by at most the square of its steps of 1/256
    quotient = 2.0**-16
    assert_near(marginals.cameras_of_priors, of_priors[last, last], quotient)
    enlarged = of_priors + 4 * (inverse - of_priors)
    photos, cameras = inflated(marginals, Inflation(2.0, 3.0), len(state.cameras))
    assert_near(cameras, (of_priors + 9 * (inverse - of_priors))[last, last], 8 * quotient)
    # the last unknown of each camera is one of the motions
    by = np.tile([3.0, 2.0], len(state.cameras))
    _, cameras = inflated(marginals, Inflation(2.0, 3.0, has_pace=True), len(state.cameras))
    assert_near(cameras, (of_priors[last, last] + by[:, None] * (inverse - of_priors)[last, last] * by), 8 * quotient)
    for i in range(m):
        own = slice(nb * i, nb * (i + 1))
        assert_near(marginals.photos_of_priors[i], of_priors[own, own], quotient)
        assert_near(photos[i], enlarged[own, own], 3 * quotient)
    vectors = rng.normal(size=(2, m, nb))
    assert_near(
        equations.covariance(vectors, 2.0).reshape(2, -1), vectors.reshape(2, -1) @ enlarged[: m * nb, : m * nb]
    )
    # a function of the points
    weights = rng.normal(size=state.points_w.shape)
    found = equations.function_of_points(weights)
    w = np.zeros(len(inverse))
    w[m * nb : m * nb + weights.size] = weights.ravel()
    variance, with_photos = found.inflated(2.0)
    assert variance == pytest.approx(w @ enlarged @ w, rel=1e-6)
    assert_near(with_photos.ravel(), (enlarged @ w)[: m * nb])


def test_pulls_of_known_lengths_are_those_of_the_whole_system(rng):
    problem, state = noisy_problem(rng, "rotation", refine=("f",))
    given, obs = problem._given, problem._given.observations

    def end(point):
        k = int(np.flatnonzero(obs.point_idx == point)[0])
        return (given.image_names[obs.frame_idx[k]], *obs.xy_raw[k])

    lengths = [KnownLength(end(0), end(1), 1.0, 0.01), KnownLength(end(2), end(3), 2.0, 0.03)]
    joined = BundleProblem(given, "rotation", replace(problem._options, lengths=lengths), 0.5, PriorSigmas(0.03, 0.1))
    _, _, H, _ = whole_jacobian(joined, state)
    (m, nb), free = joined._free.shape, dense_system(joined, state)[2]
    J = np.zeros((2, len(H)))
    J[:, m * nb : m * nb + state.points_w.size] = joined._lengths.jacobian(state.points_w).reshape(2, -1)
    H = (H + J.T @ J)[np.ix_(free, free)]
    scale = 1 / np.sqrt(np.diag(H))
    expected = np.zeros_like(J)
    expected[:, free] = J[:, free] @ (scale[:, None] * np.linalg.inv(scale[:, None] * H * scale) * scale)
    photos, cameras = joined.linearize(state).length_pulls()
    assert_near(photos.reshape(2, -1), expected[:, : m * nb])
    assert_near(cameras, expected[:, len(H[0]) + (~free).sum() - cameras.shape[1] :])


def test_tracks_stay_whole_and_near_points_go_together(rng):
    points = rng.normal(size=(1000, 3))
    point_idx = np.repeat(np.arange(1000), 5)
    partition = by_place(points, point_idx, num_frames=8)
    assert partition.max() // 4 + 1 == 64  # 32 a photo, which sees five eighths of the points
    of_point = partition[::5]
    np.testing.assert_array_equal(partition, np.repeat(of_point, 5))
    assert set(np.bincount(of_point)) <= {3, 4}
    spread = np.mean([points[of_point // 4 == family].std(0).mean() for family in range(64)])
    assert spread < 0.5 * points.std(0).mean()  # a cell of 1 / 64 of a normal cloud, its tails too


@pytest.mark.parametrize("n", [0, 1, 3, 9])
def test_few_points_are_few_families(n, rng):
    partition = by_place(rng.normal(size=(n, 3)), np.arange(n), num_frames=2)
    assert partition.max(initial=0) // 4 + 1 <= max(1, n // 4)


def test_corners_of_a_lens_are_those_of_all_its_photos():
    size = np.tile([800, 400], (4, 1))
    xy = np.array([[0, 0], [210, 0], [799, 399], [0, 0]])
    group = by_corner(xy, size, np.array([0, 0, 0, 1]))
    np.testing.assert_array_equal(group, [0, 4, 63, 64])  # families are corners of 200 x 100 px


def test_families_that_share_groups_keep_their_sums_of_squares(rng):
    assert sketch(np.arange(4000), 1000)[2] == 4000
    group, sign, count = sketch(np.arange(4000), 32)
    assert count == 128
    assert set(sign) == {-1.0, 1.0}
    sums = np.zeros((count, 50))
    values = rng.normal(1.0, 1.0, size=(4000, 50))
    np.add.at(sums, group, sign[:, None] * values)
    # without the signs the mean would make it sixteen times as much
    assert (sums**2).sum() == pytest.approx((values**2).sum(), rel=0.5)


def bent(rec, rng, by_lens, size_px=0.5):
    """The scene, its measurements off by smooth fields: over the photos of each camera, or in each over the points."""
    obs = rec.observations
    width = np.array([camera.width for camera in rec.cameras])[rec.camera_idx][obs.frame_idx]
    places = 6 * obs.xy_raw / width[:, None] if by_lens else 2 * rec.points_w[obs.point_idx]
    owner = rec.camera_idx[obs.frame_idx] if by_lens else obs.frame_idx
    xy = obs.xy_raw.copy()
    for each in np.unique(owner):
        mine = owner == each
        k, phase = rng.normal(size=(40, places.shape[1])), rng.uniform(0, 2 * np.pi, (2, 40))
        waves = np.cos(places[mine] @ k.T + phase[:, None])  # (2, measurements, 40) of wavelengths of some 2 pi
        xy[mine] += size_px * np.einsum("aoi,ai->oa", waves, rng.normal(0, np.sqrt(2 / 40), (2, 40)))
    return replace(rec, observations=replace(obs, xy_raw=xy))


CASES = ("independent", "larger than said", "of the lens", "of the scene")


@pytest.mark.parametrize("case", CASES)
def test_deviations_are_those_of_the_errors(case, rng):
    # noise of 0.5 px is what the adjustment is given
    errors, of_model, of_means = [], [], []
    for _ in range(6):
        noise_px = 0.75 if case == "larger than said" else 0.5
        truth = make_scene(rng, "rotation", num_images=8, num_points=200, noise_px=noise_px)
        if case.startswith("of"):
            truth = bent(truth, rng, by_lens=case == "of the lens")
        options = BundleOptions(sigma_px=0.5, outlier_rounds=0, loss="squared")
        result = bundle_adjust(truth, "rotation", options)
        rec, posterior = result.reconstruction, Posterior(result, options)
        found = rec.phi - truth.phi
        errors.append(found / result.sigma_phi)
        mean = np.zeros((3, *result.covariances.shape[:2]))
        mean[:, :, 6:9] = np.eye(3)[:, None] / rec.num_images
        of_means.append(found.mean(0) / np.sqrt((mean * posterior.of_photos(mean)).sum((1, 2))))
        height = _log_scale(truth)
        of_means.append([(height * (rec.points_w - truth.points_w)).sum() / np.sqrt(posterior.of_points(height)[0])])
        if case == "independent":
            assert result.inflation < 2.0
            continue
        independent = bundle_adjust(truth, "rotation", replace(options, deviations="model"))
        of_model.append((independent.reconstruction.phi - truth.phi) / independent.sigma_phi)
        assert result.noise_factor > 1.2
    # 144 values that go together in sixes or so; 24 of the means and heights
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) < 1.4
    assert 0.5 < np.sqrt(np.mean(np.concatenate(of_means) ** 2)) < 1.6
    if of_model:
        assert np.sqrt(np.mean(np.square(of_model))) > {"larger than said": 1.3}.get(case, 2.0)


def test_independent_noise_keeps_the_deviations_of_the_model(rng):
    truth = make_scene(rng, "constant-motion", num_images=10, num_points=300, noise_px=0.5)
    options = BundleOptions(refine=("f", "k1"), outlier_rounds=0, loss="squared")
    model, jackknife = (
        bundle_adjust(truth, "constant-motion", replace(options, deviations=each)) for each in ("model", "jackknife")
    )
    assert model.inflation == model.noise_factor == 1.0
    for name in ("sigma_phi", "sigma_velocity"):
        ratio = getattr(jackknife, name) / getattr(model, name)
        assert 0.99 < np.median(ratio) < 1.3
    for one, other in zip(jackknife.sigma_intrinsics, model.sigma_intrinsics, strict=True):
        # a camera has two or three photos to estimate it from
        assert all(0.95 < one[name] / other[name] < 2.5 for name in ("f", "k1"))


def test_what_a_lens_leaves_is_no_motion(rng):
    # none of the photos moved; the lens bends them by a third of a pixel, the noise is a tenth
    square = {"model": 0.0, "jackknife": 0.0}
    for _ in range(3):
        truth = make_scene(rng, "rotation", num_images=8, num_points=300, noise_px=0.1, phi_size=0.0)
        truth = bent(truth, rng, by_lens=True, size_px=0.3)
        for each in square:
            result = bundle_adjust(truth, "rotation", BundleOptions(deviations=each))
            square[each] += (result.reconstruction.phi**2).sum()
            wrong = np.abs(result.reconstruction.phi) > 3 * result.sigma_phi
            assert wrong.mean() > 0.3 if each == "model" else wrong.mean() < 0.05
    assert square["jackknife"] < 0.6**2 * square["model"]


@pytest.mark.parametrize("means", [None, MeansPrior.of_ways(0.14, 4.0)], ids=["each its own", "with means"])
def test_released_residuals_are_those_of_a_solve_without_the_photos_priors(means, rng):
    scene = make_scene(rng, "constant-motion", num_images=12, num_points=60, noise_px=0.3, phi_size=0.01)
    scale, options = 0.01, BundleOptions(loss="squared", phi_sigma=0.001, velocity_sigma=0.005)
    blocks = []
    for sigmas in (PriorSigmas(0.001, 0.005, means=means), PriorSigmas(0.01, 0.05, means=means)):
        problem = BundleProblem(scene, "constant-motion", options, 1.0, sigmas)
        tolerances = {"cost_tolerance": 1e-15, "step_tolerance": 1e-12, "initial_damping": 1e-4, "max_damping": 1e8}
        state = minimize(problem, problem.initial_state(), max_iterations=100, **tolerances).state
        blocks.append(problem.linearize(state))
    held, free = blocks
    released, found = held.released(scale)
    assert np.linalg.norm(held.blocks[0] - free.blocks[0]) > 0.05 * np.linalg.norm(free.blocks[0])
    # but for what is not linear
    assert np.linalg.norm(found - free.blocks[0]) < 0.03 * np.linalg.norm(held.blocks[0] - free.blocks[0])
    for one, other in zip(released.marginal_covariances(False)[:2], free.marginal_covariances(False)[:2], strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=0.05 * np.abs(other).max(initial=0))


def test_motions_of_few_points_do_not_drown_in_noise():
    # where noise narrows priors, and what these leave of motions counted as noise, two of three lost all of them
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth = make_scene(rng, "constant-motion", num_images=5, num_points=50, noise_px=1.0, phi_size=0.04)
        start = replace(truth, phi=0 * truth.phi, velocity=0 * truth.velocity)
        result = bundle_adjust(start, "constant-motion", simpler_first=True)
        assert result.noise_factor < 2.0
        span = truth.frame_span()[:, None]
        assert np.std(span * result.reconstruction.phi) > 0.5 * np.std(span * truth.phi)


def test_photos_at_the_prior_keep_its_deviation(rng):
    # where the noise is unknown it is not enlarged either
    truth = bent(make_scene(rng, "rotation", num_images=6, num_points=100, noise_px=0.5), rng, by_lens=False)
    obs = truth.observations
    few = truth.with_points((obs.frame_idx != 2) | (obs.point_idx < 5))
    result = bundle_adjust(
        few, "rotation", BundleOptions(sigma_px=0.5, phi_sigma=0.005, outlier_rounds=0, loss="squared")
    )
    prior = 0.005 / truth.frame_span()[2]
    assert result.noise_factor > 1.2
    assert (result.sigma_phi[2] <= 1.05 * prior).all()
    assert result.sigma_phi[2].max() > 0.8 * prior


def test_an_inflation_needs_a_system_that_can_be_solved(rng):
    problem, state = noisy_problem(rng, "rotation")
    equations = problem.linearize(state)
    equations.__dict__["inverse"] = None
    marginals = equations.marginal_covariances()
    assert np.isnan(marginals.photos).any()
    assert inflation(equations, problem.partitions(state), marginals) == Inflation(1.0, 1.0)


def test_a_lens_that_is_held_inflates_nothing(rng):
    truth = make_scene(rng, "rotation", num_images=6, num_points=100, noise_px=1.0)
    found = bundle_adjust(truth, "global", BundleOptions(sigma_px=0.5, outlier_rounds=0, loss="squared"))
    assert found.noise_factor == 1.0
    assert found.inflation > 1.2


def test_unknown_deviations_are_refused():
    with pytest.raises(InputError, match="deviations='bootstrap', expected one of jackknife, model"):
        BundleOptions(deviations="bootstrap")
