"""Standard deviations of poses, against Monte Carlo, the whole covariance, and other frames of the world."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import make_scene, perturbed
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, RowMotion, Solution, SolvedImage, bundle_adjust
from rsundistort.bundle import KnownPlaces, Posterior, gauge_directions, pose_covariances
from rsundistort.evaluation import pose_errors
from rsundistort.io import read_solution, write_solution
from rsundistort.model.orientation import orient_image

PLAIN = BundleOptions(
    refine=(), deviations="model", outlier_rounds=0, loss="squared", sigma_px=0.4, phi_sigma=0.03, velocity_sigma=0.03,
    prior_sigma_rounds=0,
)  # fmt: skip


def solution_of(rec):
    images = [
        SolvedImage(name, "1", R_cw=rec.R_cw[i], center_w=rec.center_w[i], motion=RowMotion())
        for i, name in enumerate(rec.image_names)
    ]
    return Solution(rec.shutter_model, {"1": rec.cameras[0]}, {"1": rec.cameras[0]}, tuple(images))


@pytest.mark.parametrize("model", ["global", "rotation", "constant-motion"])
def test_they_are_those_of_the_errors_that_are_left_after_an_alignment(model, rng):
    true = make_scene(rng, model, num_points=40)
    noise_px, rotations, centers, seen = 0.4, [], [], []
    baseline = np.linalg.norm(np.diff(true.center_w, axis=0), axis=1).mean()
    for _ in range(25):
        xy = true.observations.xy_raw + noise_px * rng.normal(size=(len(true.observations), 2))
        start = replace(perturbed(true, rng, 0.005, 0.01), observations=replace(true.observations, xy_raw=xy))
        result = bundle_adjust(start, model, PLAIN)
        found = pose_covariances(result, PLAIN)
        rec = result.reconstruction
        error = pose_errors(solution_of(rec), solution_of(true))
        rotations.append(np.radians(error.rotation_deg))
        centers.append(error.center * baseline)
        scale = baseline / np.linalg.norm(np.diff(rec.center_w, axis=0), axis=1).mean()
        sigmas = found.sigma_rotation, scale * found.sigma_center(rec.R_cw, rec.baseline)
        seen.append([np.linalg.norm(each, axis=1) for each in sigmas])
    rms, expected = np.sqrt(np.mean(np.square([rotations, centers]), axis=1)), np.mean(seen, axis=0)
    # 25 draws of three components, which go together
    np.testing.assert_allclose(rms / expected, 1.0, atol=0.45)
    np.testing.assert_allclose((rms / expected).mean(1), 1.0, atol=0.2)


def test_they_are_those_of_the_whole_covariance_projected(rng):
    true = make_scene(rng, "rotation", num_points=40, noise_px=0.4)
    result = bundle_adjust(perturbed(true, rng, 0.005, 0.01), "rotation", PLAIN)
    rec, (m, nb) = result.reconstruction, result.covariances.shape[:2]
    units = np.eye(m * nb).reshape(m * nb, m, nb)
    whole = Posterior(result, PLAIN).of_photos(units).reshape(m, nb, m, nb)
    found = pose_covariances(result, PLAIN)
    for own, count, blocks in ((np.s_[:3], 3, found.rotation), (np.s_[3:6], 7, found.center * rec.baseline**2)):
        moves = gauge_directions(result)[:count, :, own].reshape(count, -1)
        free = np.eye(3 * m) - np.linalg.pinv(moves) @ moves
        projected = (free @ whole[:, own, :, own].reshape(3 * m, 3 * m) @ free).reshape(m, 3, m, 3)
        expected = np.array([projected[i, :, i] for i in range(m)])
        if count == 7:
            expected = rec.R_cw @ expected @ rec.R_cw.transpose(0, 2, 1)
        np.testing.assert_allclose(blocks, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_the_photo_that_holds_the_frame_is_no_more_certain_than_others(rng):
    true = make_scene(rng, "rotation", num_points=40, noise_px=0.4)
    result = bundle_adjust(perturbed(true, rng, 0.005, 0.01), "rotation", PLAIN)
    assert (result.covariances[:, 0, 0] == 0).sum() == 1
    found = pose_covariances(result, PLAIN)
    for sigma in (found.sigma_rotation, found.sigma_center(result.reconstruction.R_cw, 1.0)):
        assert sigma.min() > 0.2 * sigma.max()


def test_a_similarity_of_the_world_moves_centres_and_their_deviations_alike(rng):
    true = make_scene(rng, "rotation", num_points=40, noise_px=0.4)
    result = bundle_adjust(perturbed(true, rng, 0.005, 0.01), "rotation", PLAIN)
    rec, found = result.reconstruction, pose_covariances(result, PLAIN)
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    moved = rec.moved(quarter, np.array([5.0, 6.0, 7.0]), 3.0)
    here, there = (found.sigma_center(each.R_cw, each.baseline) for each in (rec, moved))
    np.testing.assert_allclose(there, 3.0 * here @ np.abs(quarter).T)
    some = np.arange(rec.num_images) < 4
    np.testing.assert_allclose(found.take(some, 0.5).sigma_center(rec.R_cw[some], 0.5 * rec.baseline), here[some])


def test_known_places_hold_the_frame(rng):
    true = make_scene(rng, "rotation", num_points=40, noise_px=0.4)
    places = KnownPlaces({name: (true.center_w[i], np.full(3, 0.2)) for i, name in enumerate(true.image_names)})
    options = replace(PLAIN, places=places)
    result = bundle_adjust(perturbed(true, rng, 0.005, 0.01), "rotation", options)
    rec, on_map = result.reconstruction, pose_covariances(result, options)
    np.testing.assert_allclose(on_map.sigma_rotation**2, np.diagonal(result.covariances[:, :3, :3], 0, 1, 2))
    # six places of 0.2 hold the mean to 0.08, a hundred times worse than photos are known against each other
    center = on_map.sigma_center(rec.R_cw, rec.baseline)
    assert center.min() > 0.06


def test_two_photos_have_none(rng):
    true = make_scene(rng, "global", num_images=2, num_points=60, noise_px=0.1)
    result = bundle_adjust(true, "global", PLAIN)
    assert pose_covariances(result, PLAIN) is None


def test_they_survive_the_file_and_a_rotation_of_the_photo(tmp_path, rng):
    rec = make_scene(rng, "global")
    first = replace(
        solution_of(rec).images[0],
        sigma_rotation=np.array([1e-3, 2e-3, np.nan]),
        sigma_center=np.array([0.1, 0.2, 0.3]),
    )
    solution = replace(solution_of(rec), images=(first,))
    write_solution(tmp_path / "solution.json", solution)
    image = read_solution(tmp_path / "solution.json").images[0]
    np.testing.assert_array_equal(image.sigma_rotation, first.sigma_rotation)
    np.testing.assert_array_equal(image.sigma_center, first.sigma_center)
    upright = orient_image(replace(first, sigma_rotation=np.array([1e-3, 2e-3, 3e-3])), 6, "1")
    np.testing.assert_allclose(upright.sigma_rotation, [2e-3, 1e-3, 3e-3])
    np.testing.assert_array_equal(upright.sigma_center, first.sigma_center)
