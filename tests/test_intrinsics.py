"""Intrinsics as unknowns of the adjustment: recovered, varying, guessed, and refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import FISHEYE, LENS, RATIONAL, gradients, make_scene, perturbed, scaled, unit_steps
from numpy_reference import Fisheye
from solved_scene import cameras_of

from rsundistort import BundleOptions, RsUndistortWarning, bundle_adjust
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import GuessedCameras, Posterior, choose_model
from rsundistort.bundle.held_out import ModelFits
from rsundistort.bundle.intrinsics import moved_camera
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.errors import InputError
from rsundistort.model.reprojection import reprojection_residuals
from rsundistort.solve import model_sequence

# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


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
    problem = BundleProblem(rec, "rotation", options, 1.0, PriorSigmas(0.03, 0.1))
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


def decentred(camera, error, axis):
    names = (("cx", "p2"), ("cy", "p1"))[axis]
    return moved_camera(camera, names, np.array([3.0, 1.0]) * error)


@pytest.mark.parametrize("model", ["rotation", "constant-motion"])
def test_deviations_allow_for_as_much_as_a_decentred_calibration_moves_the_estimate(model, rng):
    rec = make_scene(rng, model, num_images=8, num_points=80, noise_px=0.01, dist=LENS)
    sigma, error = {"f": 1e-3, "cx": 4e-4, "cy": 4e-4, "k1": 3e-3, "p1": 3e-4, "p2": 3e-4}, 1e-4
    options = BundleOptions(
        loss="squared", sigma_px=0.3, phi_sigma=0.02, velocity_sigma=0.05, outlier_rounds=0, cost_tolerance=1e-15,
        step_tolerance=1e-14, refine=tuple(sigma), deviations="model", max_iterations=30,
    )  # fmt: skip

    def guessed(camera, *decentring):
        others = rec.cameras[1:]
        return GuessedCameras([camera, *others], sigma, [*decentring, *[(0.0, 0.0)] * len(others)])

    def adjusted(*guess):
        return bundle_adjust(rec, model, replace(options, guessed=guessed(*guess)))

    right, errors = rec.cameras[0], (error, 2 * error)
    given, without = adjusted(right, errors), adjusted(right, (0.0, 0.0))
    off = [adjusted(decentred(right, size, axis), (0.0, 0.0)) for axis, size in enumerate(errors)]
    moved = np.array([each.reconstruction.phi - without.reconstruction.phi for each in off])
    expected = np.einsum("rma,rmb->mab", moved, moved)
    vectors = np.zeros((3, *without.covariances.shape[:2]))
    vectors[:, :, 6:9] = np.eye(3)[:, None]
    both = [Posterior(without, replace(options, guessed=guessed(right, each))) for each in (errors, (0.0, 0.0))]
    of_sum = np.subtract(*(np.einsum("kma,lma->kl", each.of_photos(vectors), vectors) for each in both))
    np.testing.assert_allclose(of_sum, np.einsum("ra,rb->ab", moved.sum(1), moved.sum(1)), atol=0.02 * of_sum.max())
    assert given.reconstruction.phi == pytest.approx(without.reconstruction.phi, abs=1e-12)  # it is no prior
    added = (given.covariances - without.covariances)[:, 6:9, 6:9]
    np.testing.assert_allclose(added, expected, atol=0.02 * expected.max())


def test_a_decentring_that_is_no_deviation_is_refused(rng):
    cameras = make_scene(rng, "rotation").cameras
    with pytest.raises(InputError, match=f"{len(cameras)} guessed cameras and the decentring of 1"):
        GuessedCameras(cameras, GUESS_SIGMA, [(1e-3, 1e-3)])
    with pytest.raises(InputError, match="guessed decentring: sigma -1"):
        GuessedCameras(cameras, GUESS_SIGMA, [(1e-3, -1.0)] * len(cameras))


def test_the_other_axis_does_no_worse_than_the_lens_alone(rng):
    # a lens that varies imitates part of the shutter: without what varied, its poses would be a bad start
    scene = make_scene(rng, "rotation", num_images=12, num_points=400, noise_px=0.1, phi_size=0.05)
    still = replace(scene, phi=np.zeros_like(scene.phi), shutter_model="global")
    guessed = GuessedCameras(tuple(scene.cameras), {"f": 1e-3, "cx": 1e-3, "cy": 1e-3})
    options = BundleOptions(refine=("f", "cx", "cy"), guessed=guessed)
    choice = choose_model(still, options=options, sigma_px=0.1)
    assert (choice.shutter, choice.label) == ("found", "rotation")
    assert "global, varying lens" in choice.kept
    error = choice.held_out_error
    assert error["rotation, read along the other axis"] <= error["global"]


def test_a_lens_that_would_vary_as_no_lens_does_is_not_taken_out_where_a_shutter_is_not_determined(rng):
    scene = make_scene(rng, "rotation", num_images=12, num_points=400, noise_px=0.1, phi_size=0.05)
    still = replace(scene, phi=np.zeros_like(scene.phi), shutter_model="global")
    guessed = GuessedCameras(tuple(scene.cameras), {"f": 1e-3, "cx": 1e-3, "cy": 1e-3})
    options = BundleOptions(refine=("f", "cx", "cy"), guessed=guessed, phi_sigma_most=0.02)
    choice = choose_model(still, options=options, sigma_px=0.1)
    assert choice.against == ("the exposure times allow less motion than they would need",)
    # predicts better, by a principal point that wanders by a fiftieth of the focal length
    assert choice.held_out_error["global, varying lens"] < choice.held_out_error["global"]
    assert (choice.shutter, choice.label, choice.varying) == ("not-determined", "global", False)


def test_a_principal_point_that_makes_up_for_a_shutter_is_not_taken_out(rng, monkeypatch):
    """Where the shutter is not determined, the lens is then that of the model which has one."""
    scene = make_scene(rng, "rotation", num_images=8, num_points=200, noise_px=0.1, phi_size=0.05)
    guessed = GuessedCameras(tuple(scene.cameras), {"cx": 1e-3, "cy": 1e-3})
    options = BundleOptions(refine=("cx", "cy"), guessed=guessed, phi_sigma_most=0.02)
    wanders = 0.2 * scene.cameras[0].height

    def adjusted(rec, model, options, *args):
        result = bundle_adjust(rec, model, options, *args)
        found = result.reconstruction
        moved = [replace(each, K=each.K + np.outer([0, wanders, 0], [0, 0, 1])) for each in found.cameras]
        makes_up = model == "global" and "cy" in options.refine
        return replace(result, reconstruction=replace(found, cameras=moved)) if makes_up else result

    monkeypatch.setattr(model_sequence, "bundle_adjust", adjusted)
    still = replace(scene, phi=np.zeros_like(scene.phi), shutter_model="global")
    with pytest.warns(RsUndistortWarning, match="corrected for the lens that the model with a shutter found"):
        solved = model_sequence.solve_tracks(
            still, cameras_of(scene), "auto", 0, lambda _: options, StageLog(None), "none"
        )
    assert (solved.verdict.shutter, solved.shared.shutter_model) == ("not-determined", "global")
    np.testing.assert_allclose(solved.shared.cameras[0].K, scene.cameras[0].K, rtol=0, atol=3.0)


def test_a_fit_that_ended_early_is_whole_where_it_counts(rng):
    scene = make_scene(rng, "rotation", num_images=8, num_points=300, noise_px=0.1, phi_size=0.05)
    fits = ModelFits(replace(scene, shutter_model="global"), BundleOptions(), 0.1, 0, None)
    right = fits.fit("rotation", False, [fits.given])
    ended = fits.fit("global", False, [fits.given], against=right)
    assert ended.errors.mean() > 2 * right.errors.mean()
    assert fits.fit("global", False, [fits.given], against=right) is ended
    whole = fits.fit("global", False, [fits.given])
    assert whole is not ended
    assert fits.fit("global", False, [fits.given]) is whole


def choice_with_known_motions(rng, off_by):
    """What is chosen where exposures forbid a shutter that a gyroscope measured, times this, to a milliradian."""
    scene = make_scene(rng, "rotation", num_images=12, num_points=400, noise_px=0.1, phi_size=0.05)
    still = replace(scene, phi=np.zeros_like(scene.phi), shutter_model="global")
    true = off_by * scene.phi * scene.frame_span()[:, None]
    known = {name: (each, np.full(3, 1e-3)) for name, each in zip(scene.image_names, true, strict=True)}
    return choose_model(still, options=BundleOptions(phi_sigma_most=0.02, known_phi=known), sigma_px=0.1)


def test_motions_known_from_elsewhere_that_predict_better_than_none_are_a_shutter(rng):
    choice = choice_with_known_motions(rng, 1.0)
    assert choice.known_motions.gain > 5
    assert (choice.shutter, choice.label, choice.against) == ("found", "rotation", ())


def test_motions_known_from_elsewhere_that_predict_worse_than_none_are_none(rng):
    choice = choice_with_known_motions(rng, -1.0)
    assert choice.known_motions.gain < -2
    assert choice.shutter != "found"


def test_a_calibration_whose_tangential_terms_are_plainly_wrong_may_be_decentred_by_more(rng):
    camera = replace(make_scene(rng, "rotation").cameras[0], dist=np.array([-0.1, 0.05, 0.0, 0.0]))
    sigma = {"f": 1e-3, "cx": 4e-4, "cy": 4e-4, "k1": 3e-3, "p1": 3e-4, "p2": 3e-4}
    guessed, names = GuessedCameras([camera], sigma, [(1e-3, 1e-3)]), tuple(sigma)
    off = replace(camera, dist=np.array([-0.1, 0.05, 0.0, 8 * sigma["p2"]]))
    # as of a camera whose lens nobody gave
    without = replace(camera, dist=np.array([-0.1 + 80 * sigma["k1"], 0.05, 0.0, 0.0]))
    as_given, contradicted, before, other = (
        guessed.pulls_of_decentring([each], names, heavy)[0, 0, names.index("cx")]
        for each, heavy in ((camera, True), (off, True), (off, False), (without, True))
    )
    assert as_given == before == other
    assert contradicted / as_given == pytest.approx(np.sqrt((9 + 8**2) / (9 + 2)))


def test_motions_may_be_known_of_some_photos_and_others_still(rng):
    scene = make_scene(rng, "rotation", num_images=12, num_points=300, noise_px=0.1, phi_size=0.05)
    phi = scene.phi * scene.frame_span()[:, None]
    known = {name: (each, np.full(3, 1e-3)) for name, each in zip(scene.image_names[1:], phi[1:], strict=True)}
    still = {scene.image_names[0]: 1e-3}
    rec = replace(scene, phi=np.zeros_like(scene.phi), shutter_model="global")
    for options in (
        BundleOptions(known_phi=known, still=still),
        BundleOptions(known_phi=known, held_phi={"0.jpg": (0,)}),
    ):
        choice = choose_model(rec, options=options, sigma_px=0.1)
        assert choice.known_motions.is_better
        assert choice.shutter == "found"


def test_deviations_are_those_of_each_lens(rng):
    scene = make_scene(rng, "rotation", num_images=8, num_points=100, noise_px=0.3)
    pinhole = scene.cameras[0]
    fisheye = replace(pinhole, lens="fisheye", dist=np.zeros(4))
    both = replace(scene, cameras=[pinhole, fisheye], camera_idx=np.arange(8) % 2)
    options = BundleOptions(refine=("f", "k1", "k2", "p1", "p2", "k3", "k4"), outlier_rounds=0, loss="squared")
    of_pinhole, of_fisheye = bundle_adjust(both, "global", options).sigma_intrinsics
    assert list(of_pinhole) == ["f", "k1", "k2", "p1", "p2", "k3"]
    assert list(of_fisheye) == ["f", "k1", "k2", "k3", "k4"]
