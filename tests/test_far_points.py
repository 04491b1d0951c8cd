"""Points where no photo can see them, or so far that no parallax shows how far: they come back, or stay far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import make_scene
from critical_scenes import named_scene
from numpy_reference import project

from rsundistort import BundleOptions, Observations, bundle_adjust

# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


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
