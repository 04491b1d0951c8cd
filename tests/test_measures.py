"""Normalised errors of `benchmarks/measures.py`: about one where the noise is the one that is reported."""

from __future__ import annotations

import json

import numpy as np
import pytest
from measures import alike, from_elsewhere, library_sigmas, log_k_error, normalised_errors, pooled
from solved_scene import SCENES

from rsundistort import BundleOptions, Observations, Reconstruction, Solution, SolvedImage, bundle_adjust, read_solution
from rsundistort.bundle import pose_covariances
from rsundistort.critical import heal


def test_errors_of_measurements_with_known_noise_are_one_deviation(rng):
    scene = SCENES / "courtyard"
    truth = read_solution(scene / "ground_truth.json")
    camera = truth.cameras["1"]
    with np.load(scene / "tracks.npz") as tracks:
        names = [str(name) for name in tracks["image_names"]]
        frame, point, xy = tracks["frame_idx"], tracks["point_idx"], tracks["xy_raw"]
        start_at = tracks["R_cw"], tracks["center_w"], tracks["points_w"]
    phi = np.array([truth.image(name).motion.phi for name in names])
    errors = []
    for _ in range(8):
        seen = Observations(frame, point, xy + rng.normal(0, 0.3, xy.shape))
        start = Reconstruction(
            [camera], names, np.zeros(len(names), int), *start_at, seen, phi, shutter_model="rotation"
        )  # fmt: skip
        options = BundleOptions()
        result, remedy = heal(bundle_adjust(start, "rotation", options), options)
        rec, poses = result.reconstruction, pose_covariances(result, remedy.added_to(options))
        images = [
            SolvedImage(
                name,
                "1",
                rec.R_cw[i],
                rec.center_w[i],
                rec.motion(i),
                result.sigma_phi[i],
                sigma_rotation=poses.sigma_rotation[i],
                sigma_center=poses.sigma_center(rec.R_cw, rec.baseline)[i],
            )
            for i, name in enumerate(names)
        ]
        critical = {"sigma_log_k": remedy.after.sigma_log_k}
        solution = Solution("rotation", truth.cameras, truth.rectified_cameras, images, critical)
        sigmas = library_sigmas(result, remedy, options)
        errors.append(normalised_errors(solution, truth, sigmas, log_k_error(rec, truth)))
    # eight draws of a few modes: their mean square is right to about a third
    rms = pooled(errors)
    assert all(0.6 < value < 1.5 for value in rms.values()), rms


def test_what_has_no_deviation_is_missing():
    truth = read_solution(SCENES / "courtyard" / "ground_truth.json")
    found = normalised_errors(truth, truth, {"mean_phi": np.ones(3)}, log_k=0.0)
    assert pooled([found]) == dict.fromkeys(("phi", "mean_phi", "log_k", "rotation", "center")) | {"mean_phi": 0.0}


def test_sets_that_err_as_one_are_alike(rng):
    phi, center = rng.normal(size=(2, 5, 3))
    one = {"phi": phi, "mean_phi": phi.mean(0), "log_k": None, "rotation": None, "center": None}
    assert alike([one, one | {"phi": -2 * phi}]) == {"phi": -1.0}
    assert alike([one | {"center": center}] * 3) == {"phi": 1.0, "center": 1.0}
    assert alike([one]) == {}


@pytest.mark.parametrize("scene", ["courtyard", "colonnade", "handheld", "flyover"])
def test_another_visit_sees_the_same_from_elsewhere(scene):
    path = json.loads((SCENES / scene / "recipe.json").read_text())["path"]
    one, other = (from_elsewhere(path, seed) for seed in (1, 2))
    assert one == from_elsewhere(path, 1) != other
    centers, moved, looks, aims = (
        np.array([each[key] for each in views]) for key in ("center_w", "look_at_w") for views in (path, one)
    )
    apart = np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1))
    assert 0.2 * apart < np.abs(moved - centers).max() <= 0.4 * apart
    # it looks at what it did, as much up or down: level cameras stay level
    np.testing.assert_array_equal(aims[:, :2], looks[:, :2])
    np.testing.assert_allclose((aims - moved)[:, 2], (looks - centers)[:, 2], atol=1e-12)
    assert [{**each, "center_w": 0, "look_at_w": 0} for each in one] == [
        {**each, "center_w": 0, "look_at_w": 0} for each in path
    ]
