"""What lens models leave: the field of a camera, everywhere a camera counts, and its estimate."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import make_scene, perturbed
from rsundistort_cli.closing import _lens
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from solved_scene import cameras_of

from rsundistort import (
    BundleOptions,
    Camera,
    RectifyOptions,
    RowMotion,
    Solution,
    SolveOptions,
    bundle_adjust,
    init_rectify_map,
)
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import choose_model
from rsundistort.bundle.intrinsics import GuessedCameras, moved_camera
from rsundistort.bundle.lens_field import LensFields
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.errors import FormatError, InputError
from rsundistort.io import read_solution, write_solution
from rsundistort.io.cameras import camera_from_json, camera_to_json
from rsundistort.model.field import field_basis, field_over_frame, field_slope, lens_pixels, raw_pixels, steepest
from rsundistort.model.orientation import MATRICES, orient_camera, orient_points
from rsundistort.model.projection import project_points, project_points_with_jacobians, unproject_points
from rsundistort.model.reprojection import reprojection_residuals
from rsundistort.rectify import rectify
from rsundistort.report import content
from rsundistort.solve.model_sequence import solve_tracks
from rsundistort.solve.outcome import solution_of
from rsundistort.synthetic.lens import distort_rays
from rsundistort.verdict import judge

INTRINSICS = ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2")
MOTION = RowMotion([0.03, -0.02, 0.04], [0.1, 0.05, -0.02])


def camera_with_field(rng, size_px=2.0, lens="pinhole", shape=(4, 5), **changes):
    dist = [-0.1, 0.02, 1e-3, -5e-4] if lens == "pinhole" else [0.02, -0.01, 0.003, 0.0]
    K = [[500.0, 0, 310], [0, 510.0, 250], [0, 0, 1]]
    field = size_px * rng.normal(size=(*shape, 2))
    return replace(Camera(640, 480, K, np.array(dist), "top-to-bottom", lens, field), **changes)


def pixels(rng, camera, num=200):
    return rng.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5], (num, 2))


def splines(count, u):
    """(n, count) cubic splines of even spans that are 1 at one of `count` even places and 0 at the others, by SciPy."""
    knots = (np.arange(count + 4) - 3.0) / (count - 3)
    return make_interp_spline(np.linspace(0, 1, count), np.eye(count), 3, knots)(u)


def test_a_field_is_of_cubic_splines(rng):
    camera = camera_with_field(rng, shape=(5, 7))
    xy = pixels(rng, camera)
    x, y = ((xy + 0.5) / [camera.width, camera.height]).T
    expected = np.einsum("nj,ni,jia->na", splines(5, y), splines(7, x), camera.field)
    np.testing.assert_allclose(xy - lens_pixels(camera, xy), expected, atol=1e-8)
    basis = field_basis(camera, (5, 7), xy)
    np.testing.assert_allclose(basis @ camera.field.reshape(-1, 2), expected, atol=1e-12)


def test_a_camera_whose_photos_were_all_left_out_has_a_field_without_weights(rng):
    assert field_basis(camera_with_field(rng), (5, 7), np.empty((0, 2))).shape == (0, 35)


def test_a_field_ends_at_the_border_of_the_photo(rng):
    camera = camera_with_field(rng)
    inside, beyond = np.array([[100.0, -0.5], [639.5, 200]]), np.array([[100.0, -90.0], [800.0, 200]])
    np.testing.assert_allclose(beyond - lens_pixels(camera, beyond), inside - lens_pixels(camera, inside), atol=1e-12)


def test_there_and_back(rng):
    camera = camera_with_field(rng)
    xy = pixels(rng, camera)
    np.testing.assert_allclose(raw_pixels(camera, lens_pixels(camera, xy)), xy, atol=1e-9)
    assert np.isnan(raw_pixels(camera, np.full((1, 2), np.nan))).all()


def test_slopes_are_differences(rng):
    camera = camera_with_field(rng)
    xy, h = pixels(rng, camera), 1e-4
    for axis in (0, 1):
        step = h * np.eye(2)[axis]
        change = lens_pixels(camera, xy + step) - lens_pixels(camera, xy - step)
        np.testing.assert_allclose(step / h - field_slope(camera, xy)[:, :, axis], change / (2 * h), atol=1e-8)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
@pytest.mark.parametrize("model", ["global", "two-step", "rotation"])
def test_points_go_both_ways(lens, model, rng):
    camera = camera_with_field(rng, lens=lens)
    xy = pixels(rng, camera)
    ideal, valid = unproject_points(xy, camera, MOTION, model)
    assert valid.all()
    back, _ = project_points(np.column_stack([ideal, np.ones(len(xy))]), camera, MOTION, model)
    np.testing.assert_allclose(back, xy, atol=1e-8)


def test_a_photo_without_motion_is_the_lens_models_by_the_field(rng):
    camera = camera_with_field(rng)
    rays = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)])
    found, _ = project_points(rays, camera, None, "global")
    np.testing.assert_allclose(lens_pixels(camera, found), distort_rays(rays, camera.without_field()), atol=1e-8)


@pytest.mark.parametrize("model", ["rotation", "constant-motion"])
def test_derivatives_are_exact(model, rng):
    camera = camera_with_field(rng)
    points = np.column_stack([rng.uniform(-1, 1, (40, 2)), rng.uniform(2, 4, 40)])
    _, valid, J = project_points_with_jacobians(points, camera, MOTION, model)
    assert valid.all()
    h = 1e-6
    for axis in range(3):
        step = h * np.eye(3)[axis]
        ends = [project_points(points + sign * step, camera, MOTION, model)[0] for sign in (1, -1)]
        np.testing.assert_allclose(J.point[:, :, axis], (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-4)
        turned = [RowMotion(MOTION.phi + sign * step, MOTION.velocity) for sign in (1, -1)]
        ends = [project_points(points, camera, each, model)[0] for each in turned]
        np.testing.assert_allclose(J.phi[:, :, axis], (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-4)


def test_maps_and_rectified_photos_are_without_it(rng):
    camera = camera_with_field(rng)
    map_x, map_y = init_rectify_map(camera, MOTION, "rotation")
    v, u = np.indices(map_x.shape)
    rays = np.stack([u, v, np.ones(u.shape)], axis=2).reshape(-1, 3) @ np.linalg.inv(camera.K).T
    raw, valid = project_points(rays, camera, MOTION, "rotation")
    # float32 of numbers up to 1,000
    np.testing.assert_allclose(np.stack([map_x, map_y], 2).reshape(-1, 2)[valid], raw[valid], atol=2e-4)
    # a ramp shows where each pixel came from
    ramp = np.tile(np.arange(camera.width, dtype=np.float32), (camera.height, 1))
    rectified, mask = rectify(ramp, camera, MOTION, "rotation")
    inside = (raw >= 0).all(1) & (raw <= [camera.width - 1, camera.height - 1]).all(1)
    sure = (np.abs(raw) > 0.01).all(1) & (np.abs(raw - [camera.width - 1, camera.height - 1]) > 0.01).all(1)
    np.testing.assert_array_equal((mask.ravel() == 255)[sure], inside[sure])
    well = inside & (raw > 2).all(1) & (raw < [camera.width - 3, camera.height - 3]).all(1)
    # the coarse grid may be off by a hundredth, and the interpolation by a thirty-second of a pixel
    np.testing.assert_allclose(rectified.ravel()[well], raw[well, 0], atol=0.05)


@pytest.mark.parametrize("orientation", list(MATRICES))
def test_rotated_photos_have_a_rotated_field(orientation, rng):
    camera = camera_with_field(rng)
    xy = pixels(rng, camera)
    turned = orient_camera(camera, orientation)
    expected = orient_points(lens_pixels(camera, xy), camera.width, camera.height, orientation)
    found = lens_pixels(turned, orient_points(xy, camera.width, camera.height, orientation))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_cameras_differ_by_their_field(rng):
    camera = camera_with_field(rng)
    assert camera != camera.without_field()
    assert hash(camera) == hash(replace(camera, field=np.array(camera.field)))
    assert replace(camera, K=camera.K) == camera
    assert not camera.without_field().field.size
    assert replace(camera, dist=np.zeros(0)).is_pinhole is False
    assert not camera.pinhole().field.size


@pytest.mark.parametrize("field", [np.zeros((3, 5, 2)), np.zeros((4, 5)), np.full((4, 5, 2), np.nan)])
def test_what_is_no_field_is_refused(field):
    with pytest.raises(InputError, match="field"):
        Camera(640, 480, np.diag([500.0, 500, 1]), field=field)


def test_a_field_that_folds_the_photo_is_refused(rng):
    with pytest.raises(InputError, match="would fold"):
        camera_with_field(rng, size_px=300.0)


def test_files_have_a_field_only_where_there_is_one(rng):
    camera = camera_with_field(rng)
    text = json.dumps(camera_to_json(camera))
    assert camera_from_json(json.loads(text), "here") == camera
    assert "field" not in camera_to_json(camera.without_field())
    with pytest.raises(FormatError, match="field"):
        camera_from_json({**camera_to_json(camera), "field": [[1.0]]}, "here")


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_intrinsics_cannot_say_what_fields_can(lens, rng):
    K = [[500.0, 0, 319.5], [0, 510.0, 239.5], [0, 0, 1]]
    camera = replace(camera_with_field(rng, lens=lens).pinhole(), K=K, lens=lens)
    names = INTRINSICS if lens == "pinhole" else (*INTRINSICS[:6], "k4")
    fields = LensFields([camera], names, "global")
    (started,) = fields.started([camera])
    found = field_over_frame(fields.moved(0, started, 0.05 * rng.normal(size=fields.num_unknowns)))
    xy, values = (each.reshape(-1, 2) for each in found)
    size = np.linalg.norm(values)
    assert np.abs(values.mean(0)).max() < 1e-9 * size
    rays = np.column_stack([unproject_points(xy, camera, None, "global")[0], np.ones(len(xy))])
    for name in names:
        change = project_points(rays, moved_camera(camera, [name], np.array([1e-4])), None, "global")[0] - xy
        # differences of a finite step, which a lens bends
        assert abs((values * change).sum()) < 1e-3 * size * np.linalg.norm(change), name


def scene_with_field(rng, pattern, model="rotation", noise_px=0.1, num_images=12, num_points=500):
    """Measurements by a camera whose photos are displaced by a pattern of places in the frame, -1 to 1."""
    rec = make_scene(rng, model, num_images=num_images, num_points=num_points, noise_px=noise_px)
    # the cloud fills the frame
    camera = replace(
        rec.cameras[0], K=np.diag([1.7, 1.7, 1]) @ rec.cameras[0].K - [[0, 0, 281], [0, 0, 208], [0, 0, 0]]
    )
    rec = replace(rec, cameras=[camera], camera_idx=np.zeros(num_images, int))
    obs = rec.observations
    still = replace(rec, observations=replace(obs, xy_raw=np.zeros_like(obs.xy_raw)))
    exact = reprojection_residuals(still)[0]
    place = 2 * (exact + 0.5) / [camera.width, camera.height] - 1
    xy = exact + pattern(*place.T) + noise_px * rng.normal(size=exact.shape)
    seen = (np.abs(place) < 1).all(1)
    return replace(rec, observations=replace(obs, xy_raw=xy)).with_points(seen)


def waves(x, y):
    """0.3 px rms that no lens does: neither radial nor of few terms, and no splines either."""
    return 0.3 * np.stack([np.sin(2.2 * x + 1.0 * y), np.cos(1.3 * x - 2.1 * y)], axis=-1)


def nothing(x, y):
    return np.zeros((*np.shape(x), 2))


def left_of(camera, pattern, model):
    """Pattern over a frame, less what intrinsics, rotations and motions explain, and a camera's field: (n, 2)."""
    xy, found = (each.reshape(-1, 2) for each in field_over_frame(camera))
    bare = replace(camera.pinhole(), K=[[camera.K[0, 0], 0, 399.5], [0, camera.K[1, 1], 299.5], [0, 0, 1]])
    rays = np.column_stack([unproject_points(xy, bare, None, "global")[0], np.ones(len(xy))])
    still = RowMotion()
    moved = [(rays, moved_camera(bare, [name], np.array([1e-4])), still) for name in INTRINSICS]
    moved += [(Rotation.from_rotvec(1e-4 * axis).apply(rays), bare, still) for axis in np.eye(3)]
    moved += [(rays, bare, RowMotion(1e-4 * axis)) for axis in np.eye(3) if model == "rotation"]
    changes = np.stack([(project_points(*each, model)[0] - xy).ravel() for each in moved], axis=1)
    true = pattern(*(2 * (xy + 0.5) / [camera.width, camera.height] - 1).T).ravel()
    return (true - changes @ np.linalg.lstsq(changes, true, rcond=None)[0]).reshape(-1, 2), found


def options_of(rec):
    sigma = {"f": 1e-2, "cx": 3e-3, "cy": 3e-3, "k1": 0.03, "k2": 0.1, "k3": 0.1, "p1": 3e-4, "p2": 3e-4}
    known = GuessedCameras(rec.cameras, sigma)
    return BundleOptions(refine=INTRINSICS, residual_field=True, deviations="model", guessed=known)


def test_steps_that_would_fold_the_photo_are_cut_short(rng):
    camera = Camera(64, 48, [[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]])
    fields = LensFields([camera], INTRINSICS, "rotation")
    (camera,) = fields.started([camera])
    step = 0.9 * np.sign(rng.normal(size=fields.num_unknowns))
    for _ in range(40):
        camera = fields.moved(0, camera, step)  # a camera that folds is refused where it is made
    assert 0.5 * 0.5 < steepest(camera.field, 64, 48) <= 0.5


def test_the_gradient_is_that_of_the_cost(rng):
    rec = scene_with_field(rng, waves, num_images=5, num_points=30)
    camera = replace(rec.cameras[0], field=0.3 * rng.normal(size=(4, 5, 2)))
    turn = Rotation.from_rotvec(0.002 * rng.normal(size=(5, 3))).as_matrix()
    rec = replace(rec, cameras=[camera], R_cw=turn @ rec.R_cw)
    options = replace(options_of(rec), loss="soft-l1")
    problem = BundleProblem(rec, "rotation", options, 0.5, PriorSigmas(0.03, 0.1, field=0.2))
    state = problem.initial_state()
    equations = problem.linearize(state)
    gradient = equations._g_camera
    num = len(gradient)
    for k in range(num):
        ends = []
        for sign in (1, -1):
            step = np.zeros((1, num))
            step[0, k] = sign * 1e-6
            ends.append(problem.cost(problem.retract(state, (np.zeros((5, 9)), np.zeros_like(rec.points_w), step))))
        assert gradient[k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-4, abs=1e-3 * np.abs(gradient).max())


@pytest.mark.parametrize("model", ["global", "rotation"])
def test_what_no_lens_says_is_found(model, rng):
    rec = scene_with_field(rng, waves, model)
    start = perturbed(rec, rng, 0.002, 0.005)
    result = bundle_adjust(start, model, options_of(rec))
    true, found = left_of(result.reconstruction.cameras[0], waves, model)
    error, size = (float(np.sqrt((each**2).sum(1).mean())) for each in (found - true, true))
    # splines of two spans by one leave a fifth of these waves
    assert error < 0.25 * size
    without = bundle_adjust(start, model, replace(options_of(rec), residual_field=False))
    assert result.rms_px < 0.95 * without.rms_px
    # motions that photos share stay what they were
    errors = [each.reconstruction.phi - rec.phi for each in (result, without)]
    assert model == "global" or (errors[0].std(0) < errors[1].std(0)).all()


def test_a_field_is_found_within_its_sigma(rng):
    rec = scene_with_field(rng, nothing)
    fields = LensFields(rec.cameras, INTRINSICS, "rotation")
    step = 0.05 * rng.normal(size=fields.num_unknowns)
    camera = fields.moved(0, fields.started(rec.cameras)[0], step)
    obs = rec.observations
    rec = replace(rec, observations=replace(obs, xy_raw=raw_pixels(camera, obs.xy_raw)))
    result = bundle_adjust(perturbed(rec, rng, 0.002, 0.005), "rotation", options_of(rec))
    true, found = (field_over_frame(each)[1] for each in (camera, result.reconstruction.cameras[0]))
    error = float(np.sqrt(((found - true) ** 2).sum(2).mean()))
    (sigma,) = result.sigma_fields_px
    # of two dozen unknowns a ratio has a deviation of a seventh
    assert 0.6 < error / sigma < 1.4
    assert sigma < 0.1 * np.sqrt((true**2).sum(2).mean())


def test_where_there_is_nothing_nothing_is_found(rng):
    rec = scene_with_field(rng, nothing)
    result = bundle_adjust(perturbed(rec, rng, 0.002, 0.005), "rotation", options_of(rec))
    found = field_over_frame(result.reconstruction.cameras[0])[1]
    assert np.sqrt((found**2).sum(2).mean()) < 0.03
    assert result.field_sigma_px < 0.005
    assert len(result.sigma_intrinsics[0]) == len(INTRINSICS)


def test_adjustments_that_do_not_ask_keep_a_given_field(rng):
    rec = scene_with_field(rng, nothing, num_images=5, num_points=60)
    camera = replace(rec.cameras[0], field=0.3 * rng.normal(size=(5, 6, 2)))
    obs = rec.observations
    rec = replace(rec, cameras=[camera], observations=replace(obs, xy_raw=raw_pixels(camera, obs.xy_raw)))
    result = bundle_adjust(rec, "rotation", BundleOptions())
    np.testing.assert_array_equal(result.reconstruction.cameras[0].field, camera.field)
    assert result.rms_px < 0.13
    assert result.field_sigma_px == 0.0
    assert result.sigma_fields_px == (0.0,)


@pytest.mark.parametrize(("pattern", "kept"), [(waves, True), (nothing, False)])
def test_a_field_is_kept_where_it_foretells_measurements(pattern, kept, rng):
    rec = scene_with_field(rng, pattern, "global")
    options = replace(options_of(rec), residual_field=False)
    choice = choose_model(rec, ["global"], options, sigma_px=0.1)
    assert choice.residual_field is kept
    assert choice.label == "global" + kept * ", residual field"
    assert kept or choice.held_out_error.keys() == {"global"}


def test_a_lens_that_its_model_says_badly_is_reported(rng):
    camera = camera_with_field(rng, size_px=0.02)
    rec = replace(scene_with_field(rng, nothing, "global", num_images=5, num_points=60))
    result = bundle_adjust(rec, "global", BundleOptions())
    reasons = [
        judge(replace(result, reconstruction=replace(rec, cameras=[replace(rec.cameras[0], field=field)]))).reasons
        for field in (camera.field, camera.field + 2.0)
    ]
    assert ["not the model of this lens" in " ".join(each) for each in reasons] == [False, True]


def test_what_was_found_is_stored_and_read_back(rng, tmp_path):
    rec = scene_with_field(rng, waves, "global", num_images=8, num_points=300)
    options = replace(options_of(rec), residual_field=False)
    solved = solve_tracks(rec, cameras_of(rec), "auto", 0, lambda _: options, StageLog(None))
    solution = solution_of(solved, SolveOptions(), RectifyOptions())
    field = solution.cameras["1"].field
    assert field.shape == (4, 5, 2)
    stated = solution.quality["lens_fields"]["1"]
    lengths = np.linalg.norm(field_over_frame(solution.cameras["1"])[1], axis=2)
    assert stated["largest_px"] == lengths.max()
    assert stated["rms_px"] > 5 * stated["sigma_px"] > 0
    write_solution(tmp_path / "solution.json", solution)
    again = read_solution(tmp_path / "solution.json")
    assert again.cameras == solution.cameras
    assert not again.rectified_cameras["1"].field.size
    (row,) = content.cameras(again)
    assert row["field"]["rms"] == stated["rms_px"]
    # arrows are about as long as their cells; the field is larger between them
    assert 0.5 < row["field"]["times"] * lengths.max() * 13 / 800 < 1.2
    assert len(row["field"]["dots"]) == 13 * 9
    assert f"{stated['rms_px']:.2f} px in the mean" in dict(_lens(again))["more than a lens"]


def test_without_a_field_nothing_is_said(rng):
    rec = scene_with_field(rng, nothing, "global", num_images=5, num_points=60)
    camera = rec.cameras[0]
    solution = Solution("global", {"1": camera}, {"1": camera.pinhole()}, ())
    assert content.cameras(solution)[0]["field"] is None
    assert not [*_lens(replace(solution, quality={"sigma_intrinsics": {}}))]
