"""Steps of points: in direction and inverse distance from the nearest photo."""

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import make_scene

from rsundistort import BundleOptions
from rsundistort.bundle.point_terms import moved_points, nearest_photos
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.bundle.solver import minimize
from rsundistort.bundle.structure import Structure


def test_steps_are_those_of_the_normal_equations_to_first_order(rng):
    points, centres, steps = rng.normal(size=(3, 50, 3)) + np.array([[[0, 0, 6.0]], [[0, 0, 0.0]], [[0, 0, 0.0]]])
    for small in (1e-3, 1e-4):
        moved = moved_points(points, small * steps, centres)
        np.testing.assert_allclose(moved, points + small * steps, atol=10 * small**2)


@pytest.mark.parametrize("along", [-1e3, -3.0, -1.0, -0.5, 0.5, 0.99, 3.0, 1e3])
def test_no_step_takes_a_point_through_its_centre_or_through_infinity(along):
    centre, away = np.array([[1.0, 2.0, 3.0]]), np.array([[0.0, 0.6, 0.8]])
    moved = moved_points(centre + away, along * away, centre) - centre
    np.testing.assert_allclose(np.cross(moved, away), 0.0, atol=1e-9)
    # the inverse distance changes by the step, as far as a tenth
    assert 1.0 / (moved @ away[0])[0] == pytest.approx(max(1.0 - along, 0.1))


def test_a_step_across_the_ray_changes_the_direction_alone():
    centre, away, across = np.zeros((1, 3)), np.array([[0.0, 0.0, 2.0]]), np.array([[0.1, 0.0, 0.0]])
    np.testing.assert_allclose(moved_points(away, across, centre), away + across, atol=1e-15)


def test_nearest_photos_are_those_that_measured_the_point(rng):
    truth = make_scene(rng, "rotation", num_images=6, num_points=40)
    seen = truth.observations
    structure = Structure.from_observations(seen.frame_idx, seen.point_idx, truth.num_images, truth.num_points)
    points_w = truth.points_w[structure.points]
    for k, found in enumerate(nearest_photos(points_w, truth.center_w, structure)):
        of_point = seen.frame_idx[seen.point_idx == structure.points[k]]
        away = np.linalg.norm(truth.center_w[of_point] - points_w[k], axis=1)
        assert found == of_point[np.argmin(away)]


@pytest.mark.parametrize("factor", [0.3, 5.0])
def test_points_that_start_at_a_wrong_distance_come_back(factor, rng):
    # from five times their distance a step of the depth itself ends behind the photos, where nothing leads back
    truth = make_scene(rng, "rotation", num_images=6, num_points=80, noise_px=0.1)
    middle, wrong = truth.center_w.mean(0), np.arange(truth.num_points) % 8 == 0
    points_w = np.where(wrong[:, None], middle + factor * (truth.points_w - middle), truth.points_w)
    ends = []
    for start in (truth, replace(truth, points_w=points_w)):
        problem = BundleProblem(start, "rotation", BundleOptions(loss="squared"), 0.1, PriorSigmas(0.03, 0.03))
        found = minimize(
            problem, problem.initial_state(), max_iterations=30, cost_tolerance=1e-9, step_tolerance=0.0,
            initial_damping=1e-4, max_damping=1e8,
        )  # fmt: skip
        ends.append(found.cost_history[-1])
    assert ends[1] == pytest.approx(ends[0], rel=1e-6)


def test_settling_moves_points_alone_and_never_to_a_higher_cost(rng):
    truth = make_scene(rng, "rotation", noise_px=0.5)
    start = replace(truth, points_w=truth.points_w + 0.02 * rng.normal(size=truth.points_w.shape))
    problem = BundleProblem(start, "rotation", BundleOptions(loss="squared"), 0.5, PriorSigmas(0.03, 0.03))
    state = problem.initial_state()
    points, settled = problem.measurements[1], problem.settle(state)
    assert (np.bincount(points, problem.costs(settled)) <= np.bincount(points, problem.costs(state))).all()
    # with the true photos one step ends at the noise: half the number of values, less three for each point
    assert problem.cost(state) > 10 * len(truth.observations)
    assert problem.cost(settled) == pytest.approx(len(truth.observations) - 1.5 * truth.num_points, rel=0.25)
    for name in ("R_cw", "center_w", "phi", "velocity"):
        assert getattr(settled, name) is getattr(state, name)


def test_settling_returns_points_from_behind_the_camera(rng):
    truth = make_scene(rng, "rotation", noise_px=0.5)
    problem = BundleProblem(truth, "rotation", BundleOptions(loss="squared"), 0.5, PriorSigmas(0.03, 0.03))
    before = problem.initial_state()
    points_w = before.points_w.copy()
    points_w[:3] = 2 * before.center_w.mean(0) - points_w[:3]
    settled = problem.settle(replace(before, points_w=points_w), before)
    assert problem.cost(settled) <= problem.cost(before)
    assert ((settled.points_w[:3] - truth.center_w[0]) @ truth.R_cw[0][2] > 0).all()
    # a point behind all cameras does not see the way back by itself
    assert problem.cost(problem.settle(replace(before, points_w=points_w))) > 2 * problem.cost(before)
