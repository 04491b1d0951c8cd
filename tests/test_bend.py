"""Motions that are not steady: the functions they bend by, projection, adjustment, choice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rsundistort import (
    BundleOptions,
    Camera,
    Observations,
    Reconstruction,
    RowMotion,
    bundle_adjust,
    distort_points,
    init_rectify_map,
    project_points,
    undistort_points,
    unproject_points,
)
from rsundistort.bundle import choose_model
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.bundle.remains import agreement_of_waves, half_across_readout
from rsundistort.critical import still_probability
from rsundistort.errors import InputError
from rsundistort.model import BEND_GROUPS, Bend
from rsundistort.model.bend import bend_functions, splines_at
from rsundistort.model.projection import at_depth, clock_of, project_points_with_jacobians
from rsundistort.model.reprojection import reprojection_residuals
from rsundistort.rectify import largest_shift_px
from rsundistort.rectify.coarse_grid import TOLERANCE_PX, coarse_grid
from rsundistort.rectify.maps import rectified_rays
from rsundistort.verdict import judge

DIRECTIONS = ("top-to-bottom", "bottom-to-top", "left-to-right", "right-to-left")
GROUPS = len(BEND_GROUPS)
NOISE_PX = 0.2
all_directions = pytest.mark.parametrize("readout", DIRECTIONS)
exact_models = pytest.mark.parametrize("model", ["rotation", "constant-motion"])


def make_camera(readout="top-to-bottom"):
    return Camera(800, 600, [[720, 0, 402], [0, 700, 297], [0, 0, 1]], [-0.1, 0.03, 0.001, -0.002], readout)


def bend_along(rotation, camera, sites=65):
    """The bend nearest to rotation vectors, a function of the place in the frame, 0 to 1."""
    place = np.linspace(0, 1, 4 * (sites - 1) + 1)
    start, end = camera.clock_range
    return Bend.of(start + (end - start) * place, rotation(place), sites=sites)[0]


def random_bend(rng, camera, groups=GROUPS, turn=3e-4, way=0.002):
    functions, _ = bend_functions(groups)
    k = functions.shape[1]
    return Bend(*camera.clock_range, functions @ rng.normal(0, turn, (k, 3)), functions @ rng.normal(0, way, (k, 3)))


def random_motion(rng, camera, **options):
    return RowMotion(rng.normal(0, 0.05, 3), rng.normal(0, 0.1, 3), random_bend(rng, camera, **options))


def random_points(rng, n=150):
    return np.hstack([rng.uniform(-0.4, 0.4, (n, 2)), np.ones((n, 1))]) * rng.uniform(2, 8, (n, 1))


def mean(values):
    """Mean over the frame of products of splines (n, j) and (n, k), by a fine trapezium."""
    place = np.linspace(0, 1, 20001)
    fine = splines_at(len(values), place) @ values
    return np.trapezoid(fine[:, :, None] * fine[:, None], place, axis=0)


@pytest.mark.parametrize("groups", range(1, GROUPS + 1))
def test_functions_are_orthonormal_and_say_nothing_that_pose_and_phi_say(groups):
    functions, group = bend_functions(groups)
    n, k = functions.shape
    assert k == list(BEND_GROUPS.values())[groups - 1][1] == len(group)
    products = mean(np.column_stack([functions, np.ones(n), np.linspace(-1, 1, n)]))
    np.testing.assert_allclose(products[:k, :k], np.eye(k), atol=1e-5)
    np.testing.assert_allclose(products[:k, k:], 0, atol=1e-5)


def test_groups_of_fewer_intervals_are_among_those_of_more():
    place = np.linspace(0, 1, 101)
    (few, _), (more, _) = bend_functions(3), bend_functions(GROUPS)
    fine, coarse = splines_at(len(more), place) @ more, splines_at(len(few), place) @ few
    np.testing.assert_allclose(
        fine[:, : few.shape[1]] @ np.linalg.lstsq(fine, coarse, rcond=None)[0][: few.shape[1]], coarse, atol=1e-9
    )


def test_a_bend_is_the_spline_that_scipy_draws_through_it(rng):
    bend = random_bend(rng, make_camera())
    inside = np.linspace(bend.start, bend.end, 77)
    for found, values in zip(bend.at(inside), (bend.rotation, bend.position), strict=True):
        np.testing.assert_allclose(found, CubicSpline(bend.clock, values)(inside), atol=1e-14)
    slope = CubicSpline(bend.clock, bend.rotation)(bend.end, 1)
    np.testing.assert_allclose(bend.at(bend.end + 0.1)[0], bend.rotation[-1] + 0.1 * slope, atol=1e-14)


def test_what_is_constant_or_linear_is_not_of_the_bend(rng):
    clock = np.linspace(-0.3, 0.4, 200)
    constant, rate, travel = rng.normal(size=(3, 3))
    shake = 0.01 * np.sin(2 * np.pi * 3 * (clock - clock[0]) / 0.7)[:, None] * [1, 0, 2]
    steady = constant + clock[:, None] * rate
    bend, found, grown = Bend.of(clock, steady + shake, clock[:, None] * travel)
    of_shake, its_constant, its_rate = Bend.of(clock, shake)
    np.testing.assert_allclose(found[0], constant + its_constant[0], atol=1e-12)
    np.testing.assert_allclose(grown, [rate + its_rate[0], travel], atol=1e-12)
    np.testing.assert_allclose(bend.rotation, of_shake.rotation, atol=1e-12)
    np.testing.assert_allclose(bend.at(clock)[0] + found[0] + clock[:, None] * grown[0], steady + shake, atol=5e-6)


@all_directions
@exact_models
def test_a_pixel_shows_the_point_from_where_the_camera_was_at_its_row(rng, readout, model):
    camera = make_camera(readout)
    motion, points = random_motion(rng, camera), random_points(rng)
    xy, valid = project_points(points, camera, motion, model)
    assert valid.all()
    clock = clock_of(camera, xy)
    turn, way = motion.at(clock)
    seen = Rotation.from_rotvec(turn).apply(points - (way if model == "constant-motion" else 0))
    np.testing.assert_allclose(project_points(seen, camera, None, "global")[0], xy, atol=1e-9)
    ideal, _ = unproject_points(xy, camera, motion, model)
    if model == "constant-motion":
        ideal = at_depth(ideal, xy, camera, motion, points[:, 2])
    np.testing.assert_allclose(ideal, points[:, :2] / points[:, 2:], atol=1e-12)
    R, center = motion.pose_at(clock[0], np.eye(3), np.zeros(3))
    np.testing.assert_allclose(R @ (points[0] - center), Rotation.from_rotvec(turn[0]).apply(points[0] - way[0]))


@all_directions
@exact_models
def test_derivatives_are_those_of_differences(rng, readout, model):
    camera = make_camera(readout)
    motion, points, h = random_motion(rng, camera), random_points(rng, 20), 1e-6
    _, _, J = project_points_with_jacobians(points, camera, motion, model)

    def pixels(at=0, phi=0, velocity=0):
        moved = RowMotion(motion.phi + phi, motion.velocity + velocity, motion.bend)
        return project_points(points + at, camera, moved, model)[0]

    for name, found in (("at", J.point), ("phi", J.phi), ("velocity", J.velocity)):
        for axis, step in enumerate(h * np.eye(3)):
            difference = (pixels(**{name: step}) - pixels(**{name: -step})) / (2 * h)
            np.testing.assert_allclose(found[:, :, axis], difference, atol=1e-5)


@all_directions
def test_grids_and_points_follow(rng, readout):
    camera = make_camera(readout)
    motion = random_motion(rng, camera)
    map_x, map_y = init_rectify_map(camera, motion)
    u, v = (a.ravel() for a in np.meshgrid(np.arange(100, 700, 60), np.arange(80, 520, 40)))
    raw = distort_points(np.column_stack([u, v]), camera, motion, P=camera.K)
    np.testing.assert_allclose(np.column_stack([map_x[v, u], map_y[v, u]]), raw, atol=1e-4)
    np.testing.assert_allclose(undistort_points(raw, camera, motion, P=camera.K), np.column_stack([u, v]), atol=1e-9)
    depth = rng.uniform(3, 9, len(u))
    moved = distort_points(np.column_stack([u, v]), camera, motion, "constant-motion", P=camera.K, depth=depth)
    back = undistort_points(moved, camera, motion, "constant-motion", P=camera.K, depth=depth)
    np.testing.assert_allclose(back, np.column_stack([u, v]), atol=1e-9)


def test_the_bound_of_a_coarse_grid_holds_for_bends(rng):
    camera = make_camera()
    motion = random_motion(rng, camera)
    rays = rectified_rays(None, None, camera)
    grid = coarse_grid(camera, motion, "rotation", rays, (800, 600))
    assert grid.error_px <= TOLERANCE_PX
    x, y = (np.empty((600, 800), np.float32) for _ in range(2))
    grid.fill(0, x, y, np.empty((600, 800), np.uint8))
    exact_x, exact_y = init_rectify_map(camera, motion)
    seen = (exact_x > 0) & (exact_x < 799) & (exact_y > 0) & (exact_y < 599)
    assert np.abs(x - exact_x)[seen].max() < grid.error_px + 1e-3
    assert np.abs(y - exact_y)[seen].max() < grid.error_px + 1e-3


def test_rows_that_fold_over_are_not_seen(rng):
    camera = make_camera()
    fast = Bend(*camera.clock_range, 0.5 * np.sin(np.arange(25))[:, None] * [1, 0, 0])
    _, valid = project_points(random_points(rng), camera, RowMotion(bend=fast))
    assert not valid.all()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((0.5, 0.2, np.zeros((5, 3))), "start before the end"),
        ((0, 1, np.zeros((3, 3))), "3 readings"),
        ((0, 1, np.full((5, 3), np.nan)), "NaN"),
        ((0, 1, np.zeros((5, 3)), np.zeros((4, 3))), "position"),
    ],
)
def test_bends_that_make_no_sense_are_refused(arguments, said):
    with pytest.raises(InputError, match=said):
        Bend(*arguments)


def make_scene(
    rng, model="rotation", groups=GROUPS, turn=6e-4, way=0.0, steady=0.03, num_points=700, noise_px=NOISE_PX
):
    """Six photos from all around, rolled at will, of a cloud; the truth, with its measurements.

    Rotations and bends may be of each photo.
    """
    camera, m = make_camera(), 6
    points_w = rng.uniform(-1, 1, (num_points, 3))
    center_w = rng.normal(size=(m, 3))
    center_w *= 3.2 / np.linalg.norm(center_w, axis=1, keepdims=True)
    ahead = -center_w / np.linalg.norm(center_w, axis=1, keepdims=True)
    right = np.cross(ahead, rng.normal(size=(m, 3)))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R_cw = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    moves = model == "constant-motion"
    motions = [
        RowMotion(
            rng.normal(0, rotates, 3), rng.normal(0, 0.1, 3) * moves,
            random_bend(rng, camera, groups, trembles, way) if groups else None,
        )
        for rotates, trembles in zip(np.broadcast_to(steady, m), np.broadcast_to(turn, m), strict=True)
    ]  # fmt: skip
    found = []
    for i, (R, center, motion) in enumerate(zip(R_cw, center_w, motions, strict=True)):
        xy, valid = project_points((points_w - center) @ R.T, camera, motion.in_camera(R), model)
        inside = valid & ((xy > 0) & (xy < [799, 599])).all(1)
        found.append((np.full(inside.sum(), i), np.flatnonzero(inside), xy[inside]))
    frame_idx, point_idx, xy = (np.concatenate(each) for each in zip(*found, strict=True))
    observations = Observations(frame_idx, point_idx, xy + noise_px * rng.normal(size=xy.shape))
    rec = Reconstruction(
        [camera], [f"{i}.jpg" for i in range(m)], np.zeros(m, int), R_cw, center_w, points_w, observations,
        shutter_model=model,
    )  # fmt: skip
    return rec.with_motions(motions)


def still(rec):
    return rec.with_motions([RowMotion()] * rec.num_images)


@pytest.mark.parametrize(("model", "way"), [("rotation", 0.0), ("constant-motion", 0.004)])
def test_derivatives_of_the_adjustment(rng, model, way):
    truth = make_scene(rng, model, way=way, num_points=60, noise_px=2.0)
    options = BundleOptions(bends=GROUPS, loss="squared")
    problem = BundleProblem(
        truth, model, options, 0.5, PriorSigmas(0.03, 0.1, bends=(1e-3,) * GROUPS, ways=(0.01,) * 2)
    )
    state = problem.initial_state()
    residuals, J = problem.blocks(state)
    residuals, J, h = residuals.copy(), J.copy(), 1e-6
    nothing = np.zeros_like(state.points_w), np.zeros((1, 0))
    for column in range(J.shape[2]):
        step = np.zeros((truth.num_images, J.shape[2]))
        step[:, column] = h
        ahead, behind = (problem.blocks(problem.retract(state, (s * step, *nothing)))[0].copy() for s in (1, -1))
        np.testing.assert_allclose(
            J[:, :, column], (ahead - behind) / (2 * h), atol=1e-6 * np.abs(J[:, :, column]).max()
        )


@pytest.mark.parametrize(("model", "way"), [("rotation", 0.0), ("constant-motion", 0.01)])
def test_bends_are_recovered_and_the_spreads_of_their_groups(rng, model, way):
    truth = make_scene(rng, model, groups=2, turn=3e-3, way=way)
    result = bundle_adjust(still(truth), model, BundleOptions(bends=GROUPS, phi_sigma=0.05, velocity_sigma=0.05))
    assert result.rms_px < 1.1 * NOISE_PX
    quadratic, cubic, *finer = result.bend_sigmas
    assert 1.5e-3 < quadratic < 6e-3
    assert 1.5e-3 < cubic < 6e-3
    assert max(finer) < 3e-4  # what is not there vanishes
    rec = result.reconstruction
    wrong = [
        np.sqrt(np.mean((rec.motion(i).at(r)[0] - truth.motion(i).at(r)[0]) ** 2))
        for i in range(6)
        for r in [rec.motion(i).bend.clock]
    ]
    assert np.median(wrong) < 4e-4
    error = (rec.phi - truth.phi) / result.sigma_phi
    assert np.sqrt(np.mean(error**2)) < 1.6
    if way:
        assert 0.3 * way < result.way_sigmas[0] * rec.baseline < 3 * way


def test_a_known_bend_is_taken_and_the_rest_is_found(rng):
    truth = make_scene(rng, groups=2, turn=3e-3)
    known = {name: truth.motion(i).bend for i, name in enumerate(truth.image_names)}
    stated = bundle_adjust(still(truth), "rotation", BundleOptions(known_bends=known))
    assert stated.rms_px < 1.05 * NOISE_PX
    np.testing.assert_allclose(
        stated.reconstruction.motion(2).at(0.3)[0] - 0.3 * stated.reconstruction.phi[2],
        known["2.jpg"].at(0.3)[0],
        atol=1e-9,
    )
    half = dict(list(known.items())[:3])
    rest = bundle_adjust(still(truth), "rotation", BundleOptions(known_bends=half, bends=2))
    assert rest.rms_px < 1.1 * NOISE_PX


def test_a_photo_that_trembles_did_not_stand_still(rng):
    truth = make_scene(rng, groups=1, steady=[0.03, 0.03, 0.03, 0.03, 0.0, 0.0], turn=[2e-3] * 5 + [0.0])
    options = BundleOptions(bends=1)
    probability = still_probability(bundle_adjust(still(truth), "rotation", options), options)
    assert probability[5] > 0.9
    assert probability[:5].max() < 0.1


@pytest.mark.parametrize(
    ("groups", "turn", "label"),
    [(0, 0.0, "rotation"), (2, 3e-3, "rotation, bent"), (GROUPS, 8e-4, "rotation, vibrating")],
)
def test_the_choice_takes_bends_where_they_are(rng, groups, turn, label):
    truth = make_scene(rng, groups=groups, turn=turn, num_points=900)
    start = bundle_adjust(still(truth), "rotation").reconstruction
    choice = choose_model(start, sigma_px=NOISE_PX)
    assert choice.label == label
    assert choice.shutter == "found"
    assert not choice.restless
    assert choice.bends == {"rotation": 0, "rotation, bent": 2, "rotation, vibrating": 5}[label]


def sheared_by_line(truth, rng, same):
    """The scene with lines that moved along themselves as they liked: both halves alike, or each its own way."""
    obs, camera = truth.observations, truth.cameras[0]
    place, side = (obs.xy_raw[:, 1] + 0.5) / camera.height, half_across_readout(truth)[obs.point_idx]
    phase = rng.uniform(0, 2 * np.pi, truth.num_images)[obs.frame_idx]
    # a quarter of a period apart, which has nothing in common
    shift = np.sin(8 * np.pi * place + phase + (0.0 if same else np.pi / 2 * side))
    return replace(truth, observations=replace(obs, xy_raw=obs.xy_raw + shift[:, None] * [1.0, 0.0]))


@pytest.mark.parametrize(("same", "least", "most"), [(True, 0.8, 1.0), (False, -0.3, 0.3)])
def test_only_rotations_of_whole_lines_agree_between_halves(rng, same, least, most):
    truth = make_scene(rng, groups=0, num_points=900)
    assert least < agreement_of_waves(sheared_by_line(truth, rng, same), NOISE_PX) <= most


def test_no_vibration_is_tried_where_halves_tell_different_ones(rng):
    truth = make_scene(rng, groups=0, num_points=900)
    start = bundle_adjust(still(sheared_by_line(truth, rng, same=False)), "rotation")
    choice = choose_model(start.reconstruction, sigma_px=NOISE_PX)
    assert not any("vibrating" in label for label in choice.held_out_error)


def test_a_vibration_is_found_that_bends_photos_by_many_pixels(rng):
    """Other models leave so much of it that points of either half of the scene take up a part, each their own."""
    truth = make_scene(rng, groups=0, num_points=1200)
    camera, obs = truth.cameras[0], truth.observations
    periods = rng.uniform(1.2, 1.5, truth.num_images)
    shakes = [
        bend_along(lambda p, k=k, n=n: 8e-3 * np.sin(2 * np.pi * n * p + k)[:, None] * [1, 0.7, 0.2], camera, 65)
        for k, n in enumerate(periods)
    ]
    shaken = truth.with_motions([RowMotion(phi, bend=bend) for phi, bend in zip(truth.phi, shakes, strict=True)])
    off, valid = reprojection_residuals(shaken)
    measured = replace(
        obs, xy_raw=obs.xy_raw + np.where(valid[:, None], off, 0) + NOISE_PX * rng.normal(size=off.shape)
    )
    start = bundle_adjust(still(replace(truth, observations=measured)), "rotation")
    choice = choose_model(start.reconstruction, sigma_px=start.sigma_px)
    assert choice.label == "rotation, vibrating"
    assert choice.shutter == "found"


def test_lines_that_move_faster_than_any_model_are_noticed(rng):
    truth = make_scene(rng, groups=0, num_points=1200)
    camera, obs = truth.cameras[0], truth.observations
    shakes = [
        bend_along(lambda p, k=k: 2e-3 * np.sin(28 * np.pi * p + k)[:, None] * [1, 0.7, 0.2], camera, 129)
        for k in range(truth.num_images)
    ]
    shaken = truth.with_motions([RowMotion(phi, bend=bend) for phi, bend in zip(truth.phi, shakes, strict=True)])
    off, valid = reprojection_residuals(shaken)
    measured = replace(
        obs, xy_raw=obs.xy_raw + np.where(valid[:, None], off, 0) + NOISE_PX * rng.normal(size=off.shape)
    )
    result = bundle_adjust(replace(still(truth), observations=measured.select(valid)), "rotation")
    choice = choose_model(result.reconstruction, sigma_px=result.sigma_px)
    assert choice.restless
    verdict = judge(result, None, choice)
    assert verdict.shape == "doubtful"
    assert "move faster" in " ".join(verdict.reasons)


def test_a_reconstruction_rotated_or_thinned_keeps_its_bends(rng):
    truth = make_scene(rng, "constant-motion", way=0.01, num_points=50)
    other = truth.normalized()
    for i in range(truth.num_images):
        (turn, way), (same, scaled) = (each.motion(i).at(0.2) for each in (truth, other))
        np.testing.assert_allclose(turn, same, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(way) / truth.baseline, np.linalg.norm(scaled), rtol=1e-9)
    few = replace(truth, observations=truth.observations.select(truth.observations.frame_idx > 0)).without_photos(1)
    np.testing.assert_array_equal(few.bend, truth.bend[1:])


def test_the_largest_shift_counts_bends(rng):
    camera = make_camera()
    bend = bend_along(lambda p: 0.004 * np.sin(6 * np.pi * p)[:, None] * [1, 0, 0], camera)
    assert 2.0 < largest_shift_px(camera, RowMotion(bend=bend)) < 4.0


@pytest.mark.parametrize(
    "options", [{"bends": 6}, {"bends": -1}, {"bend_sigma_start": 0.0}, {"bends": 2, "bend_sigma_start": (1e-3,) * 3}]
)
def test_options_that_make_no_sense_are_refused(options):
    with pytest.raises(InputError, match="bend"):
        BundleOptions(**options)


@pytest.mark.parametrize("still_rad", [0.0, 1e-4])
def test_a_photo_that_is_known_to_be_still_does_not_tremble(rng, still_rad):
    truth = make_scene(rng, groups=2, steady=[0.03, 0.03, 0.03, 0.03, 0.0, 0.0], turn=[2e-3] * 5 + [0.0])
    options = BundleOptions(bends=2, still={"5.jpg": still_rad}, phi_sigma=0.05)
    bend = bundle_adjust(still(truth), "rotation", options).reconstruction.bend
    assert np.sqrt(np.mean(bend[5, :, :3] ** 2)) < 1e-4 / np.sqrt(12)
    assert np.sqrt(np.mean(bend[:5, :, :3] ** 2)) > 5e-4
