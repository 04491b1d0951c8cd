"""The robust loss that follows the tails of the noise: against closed forms, densities and the plain gradient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import make_scene, noisy_problem, perturbed
from scipy.optimize import minimize

from rsundistort import BundleOptions, bundle_adjust
from rsundistort.bundle.loss import LOSSES, Loss
from rsundistort.bundle.noise import _most_likely_scale, noise_and_loss
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.errors import InputError

NOISE_PX = 0.4

# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


def hyperbolic(c, k, rng, num):
    """Squared lengths of residuals with the density of `noise_and_loss`."""
    # by the lengths' own distribution: u = sqrt(1 + r^2 / c^2) has the density u exp(-q (u - 1)) from 1 on
    q = k**2
    u = np.linspace(1.0, 1.0 + 60.0 / q, 400_001)
    cumulative = np.cumsum(u * np.exp(-q * (u - 1.0)))
    drawn = np.interp(rng.random(num), cumulative / cumulative[-1], u)
    return c**2 * (drawn**2 - 1.0)


@pytest.mark.parametrize(("c", "k"), [(1.4, 1.5), (2.5, 1.0), (4.0, 3.0)])
def test_the_scale_is_the_most_likely_one(c, k, rng):
    square = hyperbolic(c, k, rng, 40_000)

    def cost(x):
        c, q = np.exp(x)
        return q * np.mean(np.sqrt(1 + square / c**2) - 1) - np.log(q**2 / (1 + q)) + 2 * np.log(c)

    best = float(np.exp(minimize(cost, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-6}).x[0]))
    # scales are compared in steps of 7 %, and residuals stand for themselves by their quantiles
    assert _most_likely_scale(square) == pytest.approx(best, rel=0.1)
    # as it was drawn, as far as 40,000 tell
    assert best == pytest.approx(c, rel=0.15)


def test_normal_noise_has_squares(rng):
    assert _most_likely_scale((rng.normal(size=(20_000, 2)) ** 2).sum(1)) > 8.0


@pytest.mark.parametrize("kind", sorted(LOSSES))
def test_pull_and_curvature_are_derivatives_of_the_cost_that_is_minimised(kind, rng):
    loss = Loss(kind, 0.7, 2.5)
    problem, state = noisy_problem(rng, "rotation", loss=kind, sigma_px=20.0)
    start, options = problem._given, problem._options
    robust = BundleProblem(start, "rotation", options, 20.0, PriorSigmas(0.03, 0.1), loss=loss)
    square, h = (robust.with_squares().blocks(state)[0] ** 2).sum(1), 1e-5

    def cost(factor):
        # residuals that are longer by a factor: the same with a noise that is smaller
        sigmas = replace(start, observations=replace(start.observations, sigma=start.observations.sigma / factor))
        return BundleProblem(sigmas, "rotation", options, 20.0, PriorSigmas(0.03, 0.1), loss=loss).costs(state)

    before, here, after = cost(1 - h), cost(1.0), cost(1 + h)
    first, second = (after - before) / (2 * h), (after - 2 * here + before) / h**2
    pull, curvature = loss.pull(square), loss.curvature(square)
    np.testing.assert_allclose(first, loss.weight * pull * square, rtol=1e-5, atol=1e-7)
    if kind != "huber":  # whose curvature jumps
        # along the residual rho'' acts, and across it rho' alone
        np.testing.assert_allclose(second, loss.weight * (2 * curvature - pull) * square, rtol=1e-3, atol=1e-3)


def test_equations_for_covariances_have_the_gradient_of_the_robust_ones(rng):
    problem, state = noisy_problem(rng, "rotation", sigma_px=5.0)
    loss = Loss("soft-l1", 1.2, 1.9)
    robust = BundleProblem(
        problem._given, "rotation", BundleOptions(), 5.0, PriorSigmas(0.03, 0.1), noise=2.5, loss=loss
    )
    one, other = robust.linearize(state), robust.with_squares(influence=True).linearize(state)
    np.testing.assert_allclose(other._g_frame, one._g_frame, rtol=1e-9, atol=1e-7 * np.abs(one._g_frame).max())
    np.testing.assert_allclose(other._g_point, one._g_point, rtol=1e-9, atol=1e-7 * np.abs(one._g_point).max())


def test_more_noise_changes_what_measurements_weigh_and_not_which_of_them_are_far_off(rng):
    problem, state = noisy_problem(rng, "rotation", sigma_px=5.0)
    costs = [
        BundleProblem(
            problem._given, "rotation", BundleOptions(), 5.0, PriorSigmas(0.03, 0.1), noise=noise,
            loss=Loss("soft-l1", 1.2),
        ).costs(state)
        for noise in (1.0, 6.0)
    ]  # fmt: skip
    np.testing.assert_allclose(costs[1] * 36, costs[0], rtol=1e-9)


@pytest.mark.parametrize("tails", ["normal", "heavy"])
def test_the_loss_follows_the_noise_and_its_mean_curvature_is_that_of_squares(tails, rng):
    truth = make_scene(rng, "rotation", num_images=8, num_points=400)
    noise = rng.normal(size=(len(truth.observations), 2))
    if tails == "heavy":
        noise *= np.sqrt(3.0 / rng.chisquare(3.0, size=(len(noise), 1)))
    measured = replace(truth.observations, xy_raw=truth.observations.xy_raw + NOISE_PX * noise)
    result = bundle_adjust(
        perturbed(replace(truth, observations=measured), rng, 0.005, 0.01), "rotation", simpler_first=True
    )
    assert result.loss.kind == "soft-l1"
    assert (result.loss.scale > 4.0) == (tails == "normal")
    sigma_px, loss = noise_and_loss(result.reconstruction, "rotation", BundleOptions())
    assert loss.scale == pytest.approx(result.loss.scale, rel=0.3)
    if tails == "normal":
        assert sigma_px == pytest.approx(NOISE_PX, rel=0.05)
        assert loss.weight == pytest.approx(1.0, abs=0.1)
    else:
        assert loss.weight > 1.2


def test_a_given_scale_is_kept(rng):
    rec = make_scene(rng, "rotation", noise_px=NOISE_PX)
    assert bundle_adjust(rec, "rotation", BundleOptions(loss_scale=2.0)).loss.scale == 2.0
    with pytest.raises(InputError, match="loss_scale"):
        BundleOptions(loss_scale=0.0)


def test_the_scale_is_in_units_of_the_noise_that_is_given(rng):
    truth = make_scene(rng, "rotation", num_images=6, num_points=200)
    noise = NOISE_PX * rng.normal(size=(len(truth.observations), 2)) * np.sqrt(3.0 / rng.chisquare(3.0, size=(1200, 1)))
    rec = replace(truth, observations=replace(truth.observations, xy_raw=truth.observations.xy_raw + noise))
    sigma_px, loss = noise_and_loss(rec, "rotation", BundleOptions())
    given, other = noise_and_loss(rec, "rotation", BundleOptions(sigma_px=sigma_px / 3.0))
    assert given == sigma_px / 3.0
    # the same length in pixels, and so the same curvature, as far as scales are compared in steps
    assert other.scale * given == pytest.approx(loss.scale * sigma_px, rel=0.1)
    assert other.weight == pytest.approx(loss.weight, rel=0.1)
