"""The prior of what each photo's motion has of its own: Student's t, which one photo that jerked does not bend."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import make_scene
from critical_scenes import named_scene
from numpy_reference import project
from scipy.stats import multivariate_t

from rsundistort import BundleOptions, Observations, bundle_adjust
from rsundistort.bundle import choose_model
from rsundistort.bundle.motion_prior import SIGMA_OF_SCALE, MotionPrior, tail_weight

# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")

PHI_SIGMA, VELOCITY_SIGMA = 0.02, 0.1


def prior_of(rng, options=None, num=6):
    scene = make_scene(rng, "constant-motion")
    return scene, MotionPrior.of(scene, options or BundleOptions(), PHI_SIGMA, VELOCITY_SIGMA, num)


def test_cost_is_that_of_students_t_and_the_weights_are_its_slope(rng):
    scene, prior = prior_of(rng)
    span = scene.frame_span()[:, None]
    per_frame = np.repeat([PHI_SIGMA, VELOCITY_SIGMA], 3)
    one, other = (scale * rng.normal(size=(scene.num_images, 6)) * per_frame / span for scale in (1.0, 5.0))
    densities = [multivariate_t(np.zeros(3), sigma**2 * np.eye(3), df=4) for sigma in (PHI_SIGMA, VELOCITY_SIGMA)]

    def minus_log(own):
        return -sum(density.logpdf(span * own[:, 3 * k : 3 * k + 3]).sum() for k, density in enumerate(densities))

    assert prior.cost(other) - prior.cost(one) == pytest.approx(minus_log(other) - minus_log(one), rel=1e-10)
    slope = prior.weight(other) * other
    for i, k in ((0, 1), (3, 5)):
        step = np.zeros_like(other)
        step[i, k] = 1e-6 * abs(other[i, k])
        ahead, behind = prior.cost(other + step), prior.cost(other - step)
        assert slope[i, k] == pytest.approx((ahead - behind) / (2 * step[i, k]), rel=1e-5)


def test_a_deviation_that_is_given_is_that_of_a_normal_prior(rng):
    scene, prior = prior_of(rng, BundleOptions(phi_sigma=PHI_SIGMA))
    own = rng.normal(size=(scene.num_images, 6))
    square = (prior.precision[:, :3] * own[:, :3] ** 2).sum()
    of_phi = prior.cost(np.hstack([own[:, :3], np.zeros_like(own[:, :3])]))
    assert of_phi == pytest.approx(0.5 * square, rel=1e-12)
    for found in (prior.weight(own), prior.information(own)):
        np.testing.assert_allclose(found[:, :3], prior.precision[:, :3], rtol=1e-15)
        assert (found[:, 3:] < prior.precision[:, 3:]).all()


def test_a_limit_has_no_tails(rng):
    limit = 1e-3
    scene, prior = prior_of(rng, BundleOptions(phi_limits={"2.jpg": limit}))
    own = np.zeros((scene.num_images, 6))
    span = scene.frame_span()[2]
    own[2, 0], own[2, 4] = 20 * limit / span, 20 * limit * scene.median_depth(2) / span
    assert prior.cost(own) > 2 * 0.5 * 20**2
    weight = prior.weight(own)[2] * (limit / span) ** 2
    assert (weight[:3] >= 1).all()
    assert (weight[3:] * scene.median_depth(2) ** 2 >= 1).all()
    others = prior.weight(np.zeros_like(own))[[0, 1, 3, 4, 5]]
    np.testing.assert_allclose(others, 7 / 4 * prior.precision[[0, 1, 3, 4, 5]], rtol=1e-14)


def measured(scene, phi, rng, noise_px=0.3):
    """The scene as photos show it that rotated by phi (m, 3), radians per frame; without motions or poses known."""
    obs = scene.observations
    xy = np.empty_like(obs.xy_raw)
    for i, span in enumerate(scene.frame_span()):
        mine, camera = obs.frame_idx == i, scene.camera(i)
        xy[mine] = project(
            scene.points_w[obs.point_idx[mine]], scene.R_cw[i], scene.center_w[i], phi[i] / span, "rotation",
            camera.readout, camera.K, [], np.zeros(3),
        )  # fmt: skip
    xy += rng.normal(0, noise_px, xy.shape)
    return replace(scene, observations=Observations(obs.frame_idx, obs.point_idx, xy))


def test_a_photo_that_jerked_does_not_draw_the_others_the_other_way(rng):
    # level cameras hardly show a rotation about x that all share, so it is the prior that draws it to zero
    scene = named_scene("parallel", num_points=200)
    span, phi = scene.frame_span()[:, None], rng.normal(0, 3e-4, (scene.num_images, 3))
    phi[2] = 0.08, 0.02, -0.03
    start, options = measured(scene, phi, rng), BundleOptions(loss="squared", outlier_rounds=0, sigma_px=0.3)
    off = bundle_adjust(start, "rotation", options).reconstruction.phi * span - phi
    assert np.abs(off).max() < 1e-3
    # with a normal prior all photos take part of the rotation of the one
    normal = replace(options, phi_sigma=float(np.sqrt((phi**2).mean())))
    drawn = bundle_adjust(start, "rotation", normal).reconstruction.phi * span - phi
    assert np.abs(drawn[:, 0].mean()) > 5 * np.abs(off[:, 0].mean())


def test_a_shutter_that_one_photo_shows_is_found(rng):
    scene = named_scene("random", num_points=300)
    phi = rng.normal(0, 3e-4, (scene.num_images, 3))
    phi[4] = 0.03, -0.04, 0.05
    choice = choose_model(measured(scene, phi, rng), options=BundleOptions(), sigma_px=0.3)
    assert (choice.shutter, choice.shutter_model) == ("found", "rotation")
    assert choice.rival == 0.0


def mean_by_the_prior(phi, weights_of):
    """Length of the mean of motions (m, 3) that their prior alone tells, of an estimated scale; it should be 0."""
    mean, scale = np.zeros(3), 0.02
    for _ in range(300):
        own = phi - mean
        weight = weights_of((own**2).sum(1) / scale**2)[:, None]
        # not below what no photo shows
        scale = max(float(np.sqrt((weight * own**2).mean())), 5e-5)
        mean = (weight * phi).sum(0) / weight.sum()
    return float(np.linalg.norm(mean))


def test_what_heavy_tails_cost_and_what_they_save(rng):
    bumped = rng.normal(0, 3e-4, (40, 8, 3))
    bumped[:, 0] = rng.normal(0, 0.05, (40, 3))
    uneven = rng.normal(0, 0.01, (40, 8, 3)) * np.exp(rng.normal(0, 1, (40, 8, 1)))
    normal = rng.normal(0, 0.02, (200, 8, 3))

    def ratio(sets):
        tails, none = (
            np.sqrt(np.mean([mean_by_the_prior(phi, of) ** 2 for phi in sets])) for of in (tail_weight, np.ones_like)
        )
        return tails / none

    assert 1.0 < ratio(normal) < 1.1
    assert ratio(uneven) < 0.6
    assert ratio(bumped) < 0.1


def test_scale_of_normal_motions(rng):
    square = (rng.normal(size=(400_000, 3)) ** 2).sum(1)
    scale = 1.0
    for _ in range(100):
        scale = np.sqrt((tail_weight(square / scale**2) * square).mean() / 3)
    assert 1.0 / scale == pytest.approx(SIGMA_OF_SCALE, abs=0.005)
