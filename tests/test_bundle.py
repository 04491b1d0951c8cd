"""Bundle adjustment: what it recovers of the plain NumPy model, which model it chooses, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from bundle_scenes import FISHEYE, LENS, make_scene, noisy_problem, perturbed
from numpy_reference import DIRECTIONS, MODELS
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, Camera, Observations, RowMotion, bundle_adjust
from rsundistort.bundle import (
    MODEL_SEQUENCE,
    GuessedCameras,
    adjust_sequence,
    choose_model,
    choose_readouts,
    objective,
)
from rsundistort.bundle.held_out import enough_points, hold_out
from rsundistort.bundle.intrinsics import moved_camera
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.errors import InputError
from rsundistort.model import READOUTS
from rsundistort.model.projection import unproject_points
from rsundistort.model.reprojection import reprojection_residuals
from rsundistort.synthetic import project_rows

SHUTTERS = ("two-step", "linearized", "rotation", "constant-motion")


# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


def relative_poses(rec):
    """Orientations and centres in the frame of photo 0, photo 1 at distance 1: free of the gauge."""
    centers = (rec.center_w - rec.center_w[0]) @ rec.R_cw[0].T
    return rec.R_cw @ rec.R_cw[0].T, centers / np.linalg.norm(centers[1])


def sigma_of_variation(result, options):
    """(m, 3) standard deviations of f, cx and cy of each photo against their means, which are the camera's."""
    spreads = PriorSigmas(1.0, 1.0, result.focal_sigma, result.centre_sigma)
    problem = BundleProblem(result.reconstruction, result.reconstruction.shutter_model, options, 0.2, spreads)
    equations = problem.linearize(problem.initial_state())
    m, nb = problem._free.shape
    sigma = np.empty((m, 3))
    for i, k in np.ndindex(m, 3):
        function = np.zeros((1, m, nb))
        function[0, :, nb - 3 + k] = (np.arange(m) == i) - 1 / m
        sigma[i, k] = np.sqrt(np.sum(function * equations.covariance(function)))
    return sigma


@pytest.mark.parametrize("dist", [[], LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
@pytest.mark.parametrize("model", MODELS)
def test_residuals_and_gradient_vanish_at_the_truth_of_the_numpy_model(model, dist, rng):
    rec = make_scene(rng, model, dist=dist)
    res, valid = reprojection_residuals(rec)
    assert valid.all()
    assert np.abs(res).max() < 1e-9  # px: 1e-12 times the focal length
    options = BundleOptions(loss="squared")
    problem = BundleProblem(rec, model, options, 1.0, PriorSigmas(1e9, 1e9))  # else the priors pull
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


def test_a_calibration_that_is_plainly_wrong_is_given_up_and_found_out(rng):
    # three photos of each camera: two may leave it where it was said to be
    rec = make_scene(rng, "rotation", num_images=12, num_points=200, noise_px=0.1, dist=LENS)
    sigma = {"f": 1e-3, "cx": 4e-4, "cy": 4e-4, "k1": 3e-3}
    wrong = [moved_camera(camera, ("cx",), np.array([0.02])) for camera in rec.cameras]
    guessed = GuessedCameras(wrong, sigma)
    options = BundleOptions(refine=tuple(sigma), guessed=guessed, outlier_rounds=0, sigma_px=0.1)
    found = bundle_adjust(replace(rec, cameras=wrong), "rotation", options).reconstruction
    for camera, true in zip(found.cameras, rec.cameras, strict=True):
        assert abs(camera.K[0, 2] - true.K[0, 2]) < 0.1 * 0.02 * true.K[0, 0]
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
    options = replace(options, varying=True)
    result = bundle_adjust(rec, "global", options)
    error = result.reconstruction.variation - varied.variation
    sigma = sigma_of_variation(result, replace(options, loss="squared", sigma_px=0.2))
    assert sigma.max() < 0.5 * 0.01  # of what varies
    # 36 values, but what f and centre are off by goes together in poses like these: 0.4 to 1.3 in one scene
    assert 0.2 < np.sqrt(np.mean(((error - error.mean(0)) / sigma) ** 2)) < 2
    assert 0.005 < result.focal_sigma < 0.02
    assert 0.005 < result.centre_sigma < 0.02


def choice_of_varied(rng, num_points, variation, **motions):
    """What is chosen where photos rotate and their lens varies, relative to f, by this standard deviation."""
    scene = make_scene(rng, "rotation", num_images=12, num_points=num_points, dist=LENS, **motions)
    varied = replace(scene, variation=rng.normal(0, variation, (12, 3)))
    predicted, _ = reprojection_residuals(
        replace(varied, observations=replace(scene.observations, xy_raw=0 * scene.observations.xy_raw))
    )
    measured = replace(scene.observations, xy_raw=predicted + 0.2 * rng.normal(size=predicted.shape))
    start = replace(scene, observations=measured, phi=0 * scene.phi, shutter_model="global")
    options = BundleOptions(
        refine=("f", "cx", "cy"), guessed=GuessedCameras(start.cameras, {"f": 0.02, "cx": 0.01, "cy": 0.01})
    )
    return choose_model(start, options=options, sigma_px=0.2)


def test_a_lens_that_varies_beside_a_shutter_is_no_velocity(rng):
    choice = choice_of_varied(rng, 150, 0.01)
    assert (choice.shutter_model, choice.varying, choice.shutter) == ("rotation", True, "found")


def test_a_lens_that_varies_a_little_beside_a_strong_shutter_is_no_change_of_the_rate():
    choice = choice_of_varied(np.random.default_rng(7), 300, 0.006, phi_size=0.03)
    assert "rotation, accelerating" in choice.kept  # before the lens is allowed to vary
    assert (choice.shutter_model, choice.varying, choice.bends) == ("rotation", True, 0)


def test_the_model_sequence_ends_at_the_truth_and_runs_in_order(rng):
    truth = make_scene(rng, "constant-motion")
    seen = []
    results = adjust_sequence(perturbed(truth, rng), progress=lambda model, cost: seen.append(model))
    assert list(results) == ["global", "two-step", "rotation", "constant-motion"]
    assert list(dict.fromkeys(seen)) == list(results)
    # one that holds another fits better; of two-step and rotation neither holds the other
    rms = {model: result.rms_px for model, result in results.items()}
    assert rms["global"] > max(rms["two-step"], rms["rotation"])
    assert rms["rotation"] > rms["constant-motion"]
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


def test_estimated_scale_is_the_one_that_makes_the_motions_found_likeliest(rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=60, noise_px=0.5)
    # of one noise for all: else the last step is weighed by another than the prior standard deviation was
    options = BundleOptions(prior_sigma_tolerance=1e-6, prior_sigma_rounds=40, deviations="model")
    result = bundle_adjust(perturbed(truth, rng), "rotation", options)
    square = (result.reconstruction.phi**2 + result.sigma_phi**2) * truth.frame_span()[:, None] ** 2
    # of Student's t, three components and four degrees of freedom
    weight = 7 / (4 + square.sum(1) / result.phi_sigma**2)
    assert np.mean(weight[:, None] * square) == pytest.approx(result.phi_sigma**2, rel=1e-4)


@pytest.mark.parametrize("noise_px", [0.1, 0.5, 2.0])
def test_residuals_and_errors_scale_with_the_noise(noise_px, rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=80, noise_px=noise_px)
    result = bundle_adjust(perturbed(truth, rng), "rotation")
    # 1280 measurements, 8 * 9 + 3 * 80 - 7 unknowns: residuals are 0.87 of the noise, within 2 % (one sigma)
    assert 0.6 * noise_px < result.rms_px < 1.1 * noise_px
    # the median of 1280 residuals knows sigma to 3 %
    assert result.sigma_px == pytest.approx(noise_px, rel=0.15)
    # the prior is estimated from 24 values of a true standard deviation of 0.05 / sqrt(3) a unit
    spread = np.sqrt(np.mean((truth.phi * truth.frame_span()[:, None]) ** 2))
    assert result.phi_sigma == pytest.approx(spread, rel=0.25)


def test_normalised_errors_of_motions_are_one(rng):
    squares = []
    for noise_px in (0.1, 0.5, 2.0) * 4:
        truth = make_scene(rng, "rotation", num_images=8, num_points=80, noise_px=noise_px)
        result = bundle_adjust(perturbed(truth, rng), "rotation")
        squares.append(np.mean(((result.reconstruction.phi - truth.phi) / result.sigma_phi) ** 2))
    # the 24 of one scene go together, and its mean is known to 40 %: that of twelve to 11 %, its root to 6 %
    assert np.sqrt(np.mean(squares)) == pytest.approx(1.0, abs=0.25)


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
    options = BundleOptions(prior_sigma_rounds=0, sigma_px=0.5, phi_sigma=0.03, deviations="model")
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
    once = BundleOptions(outlier_rounds=0, prior_sigma_rounds=0)
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
    at_rest = replace(once, step_tolerance=1e3, deviations="model")  # one solve
    assert bundle_adjust(start, "rotation", at_rest).stop_reason == "step"


@pytest.mark.parametrize("model", ["global", "two-step", "rotation", "constant-motion"])
def test_the_model_that_made_the_measurements_is_chosen(model, rng):
    # strong motion, so that every model's mistake shows against the noise
    truth = make_scene(rng, model, num_images=10, num_points=150, noise_px=0.3, phi_size=0.15)
    models = MODEL_SEQUENCE[: max(MODEL_SEQUENCE.index(model) + 1, 3)]
    start = adjust_sequence(perturbed(truth, rng), models)["rotation"].reconstruction
    choice = choose_model(start, sigma_px=0.3)
    assert choice.shutter_model == model
    assert list(choice.held_out_rms_px) == list(choice.held_out_error)
    assert [label for label in choice.held_out_error if label in MODEL_SEQUENCE] == list(MODEL_SEQUENCE)
    assert choice.kept[0] == "global"
    assert choice.kept[-1] == choice.label == model
    assert choice.shutter == ("not-found" if model == "global" else "found")
    assert choice.agreement is None or choice.agreement > 0.9
    # what it was made from predicts to the noise, and to what the point's own uncertainty adds
    assert 0.25 < choice.held_out_rms_px[model] < 0.5
    assert 140 <= choice.num_held_out <= 150  # a tenth of them, one a track; the model sequence dropped a few
    assert choose_model(start, sigma_px=0.3) == choice


def test_no_stage_is_worse_than_the_one_inside_it_wherever_the_choice_starts(rng):
    # phi is per focal length: rotations of a quarter radian a frame, found under a lens four times too long, are of a
    # whole one under the lens that the first model then finds, and few points are where such photos could see them
    truth = make_scene(rng, "global", num_images=12, num_points=120, noise_px=0.3, dist=[-0.2, 0.05, 0, 0])
    long = [replace(c, K=c.K * [[4, 1, 1], [1, 4, 1], [1, 1, 1]], dist=()) for c in truth.cameras]
    astray = replace(truth, cameras=long, shutter_model="rotation")
    astray = replace(astray, phi=0.25 / astray.frame_span()[:, None] * rng.normal(size=truth.phi.shape))
    options = BundleOptions(refine=("f", "k1", "k2"))
    choice = choose_model(astray, options=options, sigma_px=0.3)
    assert choice.shutter_model == "global"
    rms = list(choice.held_out_rms_px.values())
    assert 0.25 < rms[0] < 0.4
    # what a model fits to noise: 36 unknowns more on 1300 measurements, 72 for the last
    np.testing.assert_allclose(rms, rms[0], rtol=0.03)


def test_what_one_kernel_sees_another_does(rng):
    # rotations so strong, under a lens so curved, that the search from a still camera's row ends elsewhere or nowhere
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
    assert valid[seen].mean() > 0.7  # the others are seen by no row, or by several
    np.testing.assert_allclose(res[valid], 0, atol=1e-6)
    rec = rec.with_points(valid, min_track=1)
    options = BundleOptions(loss="squared", refine=("f", "k1"))
    fresh, other = (BundleProblem(rec, "rotation", options, 1.0, PriorSigmas(1.0, 1.0)) for _ in range(2))
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
    assert choice.changed == wrong
    for found, true in zip(choice.reconstruction.cameras, rec.cameras, strict=True):
        assert READOUTS[found.readout][0] == READOUTS[true.readout][0]


def test_without_motion_the_guess_of_the_readout_stays(rng):
    rec = make_scene(rng, "global", num_images=12, num_points=100, noise_px=0.3)
    choice = choose_readouts(perturbed(rec, rng), range(4))
    assert choice.changed == ()
    assert choice.reconstruction.cameras == rec.cameras


def test_a_camera_whose_readout_was_specified_is_left_alone(rng):
    rec = make_scene(rng, "rotation", num_images=8, num_points=100, noise_px=0.3)
    assert list(choose_readouts(rec, [2]).gain) == [2]
    assert choose_readouts(rec, []).gain == {}


def test_a_sample_of_points_has_enough_of_each_photo_and_all_of_small_ones(rng):
    rec = make_scene(rng, "rotation", num_images=4, num_points=300)
    seen = rng.random(len(rec.observations)) < np.where(rec.observations.frame_idx == 2, 0.1, 1.0)
    rec = rec.with_points(seen)
    taken = enough_points(rec, per_photo=60, seed=3)
    counts, left = (np.bincount(each.observations.frame_idx) for each in (rec, rec.take_points(taken)))
    assert (left >= np.minimum(counts, 60)).all()
    assert left[2] == counts[2] < 60
    assert taken.sum() < 120
    assert enough_points(rec, per_photo=300).all()


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


def test_objective_of_the_truth_is_above_that_of_the_estimate(rng):
    truth = make_scene(rng, "rotation", noise_px=0.5)
    # of the first solve: where measurements seem to hang together by chance, a second one takes more noise
    options = BundleOptions(outlier_rounds=0, loss="squared", sigma_px=0.5, phi_sigma=0.03, deviations="model")
    result = bundle_adjust(perturbed(truth, rng), "rotation", options)
    assert objective(result.reconstruction, "rotation", options) == pytest.approx(result.cost_history[-1], rel=1e-6)
    assert objective(result.reconstruction, "rotation", options) < objective(truth, "rotation", options)
    with pytest.raises(InputError, match="needs sigma_px"):
        objective(truth, "rotation", BundleOptions())


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


def test_of_points_that_two_photos_see_nothing_is_held_out(rng):
    rec = make_scene(rng, "rotation", num_images=5, num_points=600, noise_px=0.1)
    obs = rec.observations
    pairs = np.array([(a, b) for a in range(5) for b in range(a)])
    seen = pairs[rng.integers(0, len(pairs), rec.num_points)]
    rec = rec.with_points((obs.frame_idx[:, None] == seen[obs.point_idx]).any(1))
    fitted, held = hold_out(rec)
    assert fitted.all()
    assert not held.any()
