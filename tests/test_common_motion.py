"""Motions that all photos share: what hides them, what a solution knows of them, and photos that did not move."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from critical_scenes import named_scene
from numpy_reference import project
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, bundle_adjust
from rsundistort.bundle import Posterior
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.critical import advise, clock_contrast, common_motion, heal, shape_cost, still_probability
from rsundistort.errors import InputError
from rsundistort.model.orientation import orient_reconstruction

MODEL = "constant-motion"
NOISE_PX = 0.5
PHI, WAY = 0.02, 0.15  # prior standard deviations: radians a frame, baselines a frame, about as much in the photos
KNOWN = BundleOptions(loss="squared", outlier_rounds=0, sigma_px=NOISE_PX, phi_sigma=PHI, velocity_sigma=WAY)

# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


def pixels(scene):
    """Where the photos show the points, by the NumPy version."""
    obs = scene.observations
    xy = np.zeros((len(obs), 2))
    for i in range(scene.num_images):
        mine = obs.frame_idx == i
        camera = scene.camera(i)
        xy[mine] = project(
            scene.points_w[obs.point_idx[mine]], scene.R_cw[i], scene.center_w[i], scene.phi[i], MODEL, camera.readout,
            camera.K, [], scene.velocity[i],
        )  # fmt: skip
    return xy


def measured(scene, rng=None, noise_px=NOISE_PX):
    """The scene with its measurements, and their noise."""
    xy = pixels(scene)
    xy += 0.0 if rng is None else rng.normal(0, noise_px, xy.shape)
    observations = replace(scene.observations, xy_raw=xy)
    return replace(scene, observations=observations, shutter_model=MODEL)


def moving(scene, rng, still=None, phi=PHI, way=WAY):
    """Random rotations and travels, as the priors have it."""
    span = scene.frame_span()[:, None]
    turn = rng.normal(0, phi, (scene.num_images, 3)) / span
    travel = rng.normal(0, way * scene.baseline, (scene.num_images, 3)) / span
    if still is not None:
        turn[still] = travel[still] = 0.0
    return replace(scene, phi=turn, velocity=travel)


def row_motion(rec):
    """(m, 6) rotations, radians a frame, and travels in the camera's frame, baselines a frame; photos of rows."""
    span = rec.frame_span()[:, None]
    travel = np.einsum("mij,mj->mi", rec.R_cw, rec.velocity) / rec.baseline
    return np.hstack([rec.phi, travel]) * span


# ---------------------------------------------------------------- what hides them


def arranged(how, rng, m=6, num_points=60):
    """Level cameras that look ahead, side by side, one above the other, or one behind the other."""
    points = np.column_stack([rng.uniform(-2, 2, num_points), rng.uniform(-1.5, 1.5, num_points), np.zeros(num_points)])
    if how == "sideways, any relief":
        points[:, 2] = rng.uniform(-2, 2, num_points)
    centers = np.zeros((m, 3))
    centers[:, 2] = -7.0
    axis = {"sideways, any relief": 0, "upwards, a wall": 1, "ahead, a wall": 2}[how]
    centers[:, axis] += np.linspace(-1, 1, m)
    scene = named_scene("pure translation", m, num_points)
    return replace(scene, R_cw=np.stack([np.eye(3)] * m), center_w=centers, points_w=points)


HIDING = ["sideways, any relief", "upwards, a wall", "ahead, a wall"]


@pytest.mark.parametrize("how", HIDING)
def test_photos_that_time_points_alike_have_no_contrast(how, rng):
    scene = measured(arranged(how, rng))
    assert clock_contrast(scene) < 1e-6
    # a wall that the cameras also rotate to, or things at other depths, are distinguished
    relief = replace(scene, points_w=scene.points_w + rng.uniform(-1, 1, scene.points_w.shape) * [0, 0, 2])
    if how != "sideways, any relief":
        assert clock_contrast(measured(relief)) > 0.01


@pytest.mark.parametrize("how", HIDING)
@pytest.mark.parametrize("kind", range(7))
def test_a_motion_of_the_world_by_the_clock_leaves_no_trace_without_contrast(how, kind, rng):
    """Rotations, ways and a growth of the world, the same per unit of the clock in all photos, change its shape."""
    scene = measured(arranged(how, rng))
    turn, way, growth = np.zeros(3), np.zeros(3), 0.0
    if kind < 3:
        turn[kind] = 1.0
    elif kind < 6:
        way[kind - 3] = 1.0
    else:
        growth = 1.0
    x, obs = scene.points_w, scene.observations
    # the clock at which a photo shows a point, r = a rho + b: `rho` that of the first
    r = (obs.xy_raw[:, 1] - 360.0) / 900.0
    rho = np.zeros(len(x))
    rho[obs.point_idx[obs.frame_idx == 0]] = r[obs.frame_idx == 0]
    h = 1e-5
    change = np.cross(turn, x) + way + growth * x
    phi, velocity = np.zeros((2, scene.num_images, 3))
    R_cw, centers = scene.R_cw.copy(), scene.center_w.copy()
    for i in range(scene.num_images):
        mine = obs.frame_idx == i
        a, b = np.linalg.lstsq(
            np.column_stack([rho[obs.point_idx[mine]], np.ones(mine.sum())]), r[mine], rcond=None
        )[0]  # fmt: skip
        # the world moves by h r / a: what it does to a camera, and what it has done at the middle row
        phi[i] = h / a * turn
        velocity[i] = -h / a * (np.cross(turn, scene.center_w[i]) + way + growth * scene.center_w[i])
        R_cw[i] = Rotation.from_rotvec(-h * b / a * turn).as_matrix() @ R_cw[i]
        centers[i] -= b * velocity[i]
    moved = replace(
        scene, phi=phi, velocity=velocity, R_cw=R_cw, center_w=centers, points_w=x - h * rho[:, None] * change
    )
    trace = np.abs(pixels(moved) - scene.observations.xy_raw).max()
    own = np.abs(pixels(replace(moved, points_w=x, R_cw=scene.R_cw, center_w=scene.center_w)) - obs.xy_raw).max()
    assert trace < 1e-3 * max(own, 900 * h)


@pytest.mark.parametrize(
    ("name", "low"), [("parallel", True), ("10 degrees", False), ("20 degrees", False), ("one portrait", False)]
)  # fmt: skip
def test_contrast_grows_as_cameras_are_rotated(name, low):
    found = clock_contrast(measured(named_scene(name, num_points=300)))
    assert 0.05 < found < 1
    assert (found < 0.15) == low


def test_contrast_does_not_change_with_the_world_nor_with_the_direction_of_the_readout(rng):
    scene = measured(named_scene("10 degrees"))
    turn = Rotation.random(random_state=2).as_matrix()
    moved = replace(
        scene,
        R_cw=scene.R_cw @ turn.T,
        center_w=2 * scene.center_w @ turn.T + 1,
        points_w=2 * scene.points_w @ turn.T + 1,
    )
    reversed_ = replace(scene, cameras=[replace(camera, readout="bottom-to-top") for camera in scene.cameras])
    for other in (moved, reversed_):
        assert clock_contrast(other) == pytest.approx(clock_contrast(scene), rel=1e-9)


# ---------------------------------------------------------------- what a solution knows of them


def test_sigmas_of_the_common_motion_cover_its_errors(rng):
    """Motions and noise drawn anew: errors of the mean motion in the metric of its covariance."""
    squares, alone = [], []
    for _ in range(24):
        truth = measured(moving(named_scene("parallel", num_points=120), rng), rng)
        result = bundle_adjust(truth, MODEL, KNOWN)
        error = (row_motion(result.reconstruction) - row_motion(truth)).mean(0)
        common = common_motion(result, KNOWN)
        squares.append(error @ np.linalg.solve(common.covariance, error) / 6)
        alone.append(error / common.sigma)
    # 144 squares of normal variables: within 12 % (one sigma)
    assert 0.7 < np.mean(squares) < 1.4
    assert (np.sqrt(np.mean(np.square(alone), axis=0)) > 0.5).all()
    assert (np.sqrt(np.mean(np.square(alone), axis=0)) < 1.6).all()


def test_the_weakest_change_displaces_the_photos_by_what_is_said(rng):
    truth = measured(moving(named_scene("parallel", num_points=120), rng), rng)
    result = bundle_adjust(truth, MODEL, KNOWN)
    common = common_motion(result, KNOWN)
    rec = result.reconstruction
    span = rec.frame_span()[:, None]
    small = 1e-3
    travel = np.einsum("mji,mj->mi", rec.R_cw, common.weakest[:, 3:]) * rec.baseline
    moved = replace(
        rec, phi=rec.phi + small * common.weakest[:, :3] / span, velocity=rec.velocity + small * travel / span
    )
    shift = (pixels(moved) - pixels(rec)) / small
    counts = np.bincount(rec.observations.frame_idx)
    by_photo = np.bincount(rec.observations.frame_idx, (shift**2).sum(1)) / counts
    assert np.sqrt(by_photo.mean()) == pytest.approx(common.shift_px, rel=1e-3)
    # and nothing that the photos know as badly displaces them more
    A = Posterior(result, KNOWN).squared_shifts()
    whole = np.einsum("mij,mij->", A, result.covariances[:, 6:, 6:]) / rec.num_images
    assert common.shift_px < np.sqrt(whole) < 3 * common.shift_px


def test_common_motion_of_cameras_that_read_columns_is_that_of_rows_rotated(rng):
    rows = measured(moving(named_scene("parallel", num_points=80), rng), rng)
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    cameras = [
        replace(camera, width=camera.height, height=camera.width, K=[[900.0, 0, 360], [0, 900.0, 480], [0, 0, 1]],
                readout="right-to-left") for camera in rows.cameras
    ]  # fmt: skip
    xy = rows.observations.xy_raw
    turned = np.column_stack([719 - xy[:, 1] + 1, xy[:, 0]])
    columns = replace(
        rows, cameras=cameras, R_cw=quarter @ rows.R_cw, phi=rows.phi @ quarter.T,
        observations=replace(rows.observations, xy_raw=turned),
    )  # fmt: skip
    # with independent noise: corners of a photo are others in one that is rotated
    model = replace(KNOWN, deviations="model")
    found = [common_motion(bundle_adjust(scene, MODEL, model), model) for scene in (rows, columns)]
    np.testing.assert_allclose(found[1].sigma, found[0].sigma, rtol=1e-3)
    assert found[1].shift_px == pytest.approx(found[0].shift_px, rel=1e-3)
    assert found[1].by_column
    assert "nodding" in found[0].sentence or "panning" in found[0].sentence


def of_neighbours(rng, each=20):
    """Heaps of points, 8 across and 4 up; truth, and measurements off by little each and much by heap and photo."""
    scene = named_scene("5 degrees", num_points=32 * each)
    heap = np.repeat(np.arange(32), each)
    middle = np.column_stack([(heap % 8 - 3.5) * 0.6, (heap // 8 - 1.5) * 0.7, rng.uniform(-2, 2, 32)[heap]])
    scene = moving(replace(scene, points_w=middle + rng.uniform(-0.1, 0.1, middle.shape)), rng)
    truth = measured(scene, rng, 0.2)
    obs = truth.observations
    off = rng.normal(0, 0.5, (scene.num_images, 32, 2))[obs.frame_idx, heap[obs.point_idx]]
    return truth, replace(truth, observations=replace(obs, xy_raw=obs.xy_raw + off))


@pytest.mark.slow
def test_noise_that_neighbours_share_is_noticed(rng):
    """Errors of the mean motion in the metric of its covariance, where all points of a heap are off together."""
    plain, honest, factors = [], [], []
    for _ in range(8):
        truth, spoiled = of_neighbours(rng)
        for options, into in ((replace(KNOWN, deviations="model"), plain), (KNOWN, honest)):
            found = bundle_adjust(spoiled, MODEL, options)
            error = (row_motion(found.reconstruction) - row_motion(truth)).mean(0)
            common = common_motion(found, options)
            into.append(error @ np.linalg.solve(common.covariance, error) / 6)
        factors.append(found.noise_factor)
    # 48 squares of normal variables if nothing was off: within 20 % (one sigma)
    assert np.mean(plain) > 5
    assert 0.5 < np.mean(honest) < 2.5
    # twenty points that are off together by 0.5 px and each by 0.2 are as good as one: sqrt(1 + 20 (0.5 / 0.2)^2)
    assert 2 < np.mean(factors) < 11
    assert bundle_adjust(measured(truth, rng), MODEL, KNOWN).noise_factor < 1.5


def test_what_is_said_is_json_and_only_where_it_costs_something(rng):
    level, turned = (
        shape_cost(bundle_adjust(measured(moving(named_scene(name, num_points=120), rng), rng), MODEL, KNOWN), KNOWN)
        for name in ("parallel", "one portrait")
    )
    assert level.common.is_weak
    assert "can hardly be distinguished" in level.sentence
    assert "in all photos together phi" in level.sentence
    assert not turned.common.is_weak
    assert "distinguished" not in turned.sentence
    said = json.loads(json.dumps(level.common.as_json()))
    assert len(said["sigma_phi_rad_per_frame"]) == len(said["sigma_velocity_baselines_per_frame"]) == 3
    assert np.shape(said["correlation"]) == (6, 6)
    # a model without travel has nothing to take a nod for
    rotation = bundle_adjust(measured(named_scene("parallel"), rng), "rotation", KNOWN)
    cost = shape_cost(rotation, KNOWN)
    assert not cost.common.is_weak
    assert cost.common.as_json()["sigma_velocity_baselines_per_frame"] == []


# ---------------------------------------------------------------- photos that did not move


def test_a_still_photo_holds_its_whole_motion_or_phi1_of_a_model_without_travel(rng):
    truth = measured(moving(named_scene("parallel"), rng, still=3), rng)
    hard = replace(KNOWN, still={"03.jpg": 0.0})
    found = bundle_adjust(truth, MODEL, hard).reconstruction
    assert not found.phi[3].any()
    assert not found.velocity[3].any()
    assert np.abs(np.delete(found.velocity, 3, axis=0)).min() > 0
    turned = bundle_adjust(truth, "rotation", hard).reconstruction
    np.testing.assert_array_equal(turned.phi[3] == 0, [True, False, False])
    columns = replace(truth, cameras=[replace(camera, readout="left-to-right") for camera in truth.cameras])
    by_column = bundle_adjust(columns, "rotation", hard).reconstruction
    np.testing.assert_array_equal(by_column.phi[3] == 0, [False, True, False])
    bundle_adjust(truth, "global", hard)


def test_the_velocity_of_a_softly_still_photo_counts_as_the_angle_that_displaces_as_much():
    scene = measured(named_scene("parallel"))
    still = 0.5e-3
    options = replace(KNOWN, still={"03.jpg": still}, phi_sigma=1e6, velocity_sigma=1e6)
    depth = np.median((scene.points_w - scene.center_w[3]) @ scene.R_cw[3, 2])
    span = scene.frame_span()[3]

    def cost(phi, velocity):
        turn, travel = np.zeros((2, scene.num_images, 3))
        turn[3], travel[3] = phi, velocity
        moved = measured(replace(scene, phi=turn, velocity=travel))
        problem = BundleProblem(moved, MODEL, options, NOISE_PX, PriorSigmas(1e6, 1e6))
        return problem.cost(problem.initial_state())

    nothing = np.zeros(3)
    for axis in np.eye(3):
        assert cost(still / span * axis, nothing) == pytest.approx(0.5, rel=1e-6)
        assert cost(nothing, still * depth / span * axis) == pytest.approx(0.5, rel=1e-6)


@pytest.mark.parametrize("still", [-1.0, np.inf, np.nan])
def test_still_photos_that_make_no_sense_are_refused(still, rng):
    with pytest.raises(InputError, match="expected 0 or a positive number"):
        BundleOptions(still={"a": still})


def test_still_photos_that_are_known_to_have_moved_are_refused():
    with pytest.raises(InputError, match="give one of them"):
        BundleOptions(still={"a": 0.0}, known_phi={"a": (np.zeros(3), 1.0)})
    with pytest.raises(InputError, match="give one of them"):
        BundleOptions(still={"a": 0.0}, held_phi={"a": (0,)})
    with pytest.raises(InputError, match="'nobody' is not a photo"):
        bundle_adjust(measured(named_scene("parallel")), MODEL, BundleOptions(still={"nobody": 0.0}))


ESTIMATED = BundleOptions(loss="squared", outlier_rounds=0, sigma_px=NOISE_PX)


def test_auto_finds_the_photo_that_neither_rotated_nor_travelled(rng):
    better = 0
    for _ in range(4):
        truth = measured(moving(named_scene("parallel", num_points=150), rng, still=5), rng)
        result = bundle_adjust(truth, MODEL, ESTIMATED)
        probability = still_probability(result, ESTIMATED)
        assert np.argmax(probability) == 5
        assert np.delete(probability, 5).max() < 0.5
        healed, remedy = heal(result, ESTIMATED)
        assert remedy.name == "anchor"
        assert list(remedy.anchors) == ["05.jpg"]
        assert 0.0005 < remedy.anchors["05.jpg"] < 0.01
        assert "holds what the motions of all photos have in common" in remedy.sentence
        assert remedy.after.common.shift_px < remedy.before.common.shift_px
        # what would come on top of that photo, not in its place
        further = advise(healed, remedy.added_to(ESTIMATED))
        assert further
        assert all(each.shift_px < remedy.after.common.shift_px for each in further)
        errors = [np.linalg.norm((row_motion(r.reconstruction) - row_motion(truth)).mean(0)) for r in (result, healed)]
        better += errors[1] < errors[0]
    assert better >= 3


def test_a_photo_that_did_not_rotate_but_travelled_is_no_still_one(rng):
    scene = moving(named_scene("parallel", num_points=150), rng)
    phi = scene.phi.copy()
    phi[5] = 0.0
    truth = measured(replace(scene, phi=phi), rng)
    assert still_probability(bundle_adjust(truth, MODEL, ESTIMATED), ESTIMATED).max() < 0.5


def test_a_photo_wrongly_said_to_be_still_is_noticed(rng):
    scene = moving(named_scene("parallel", num_points=150), rng, still=5)
    velocity = scene.velocity.copy()
    velocity[2] = 2 * WAY * scene.baseline / scene.frame_span()[2]
    truth = measured(replace(scene, velocity=velocity), rng)
    for name, warned in (("02.jpg", True), ("05.jpg", False)):
        options = replace(ESTIMATED, still={name: 0.0})
        healed, remedy = heal(bundle_adjust(truth, MODEL, options), options)
        assert remedy.name == "given"
        assert not healed.reconstruction.velocity[int(name[:2])].any()
        assert any("was specified as still" in text for text in remedy.warnings) == warned


def test_a_photo_rotated_by_90_degrees_is_advised_for_what_it_tells_of_the_common_motion(rng):
    result = bundle_adjust(measured(moving(named_scene("parallel", num_points=150), rng), rng), MODEL, KNOWN)
    before = shape_cost(result, KNOWN).common.shift_px
    advice = advise(result, KNOWN)
    assert advice
    assert min(each.shift_px for each in advice) < 0.9 * before
    assert "px" in advice[0].sentence


def from_above(rng, R_cw, center_w, phi, velocity):
    """Photos of hills of 1.2 m that move so, per unit of the clock, and what they measure."""
    camera, m = Camera(800, 600, [[700, 0, 400], [0, 700, 300], [0, 0, 1]], [], "top-to-bottom"), len(R_cw)
    points_w = rng.uniform(-1, 1, (150, 3)) * [6.0, 6.0, 1.2]
    point_idx, frame_idx = (a.ravel() for a in np.mgrid[: len(points_w), :m])
    scene = Reconstruction(
        [camera], [f"{i}.jpg" for i in range(m)], np.zeros(m, np.int64), R_cw, center_w, points_w,
        Observations(frame_idx, point_idx, np.zeros((len(point_idx), 2))), phi, velocity, MODEL,
    )  # fmt: skip
    xy = pixels(scene)
    inside = ((xy > 0) & (xy < [800, 600])).all(axis=1)
    observations = replace(scene.observations, xy_raw=xy + 0.1 * rng.normal(size=xy.shape)).select(inside)
    return replace(scene, observations=observations)


def straight_down(rng, m):
    """Rotations (m, 3, 3) of photos that look down, but for 0.03 rad."""
    return Rotation.from_rotvec(0.03 * rng.normal(size=(m, 3))).as_matrix() @ np.diag([1.0, -1.0, -1.0])


def flight(rng, travel, m=10):
    """Photos straight down from 6 m above hills, that travel alike but for 0.03 m a unit of the clock."""
    above = np.stack(np.meshgrid([-1.0, 1.0], np.arange(-2.0, 3.0)), axis=2).reshape(-1, 2)
    center_w = np.column_stack([above, np.full(m, 6.0)]) + 0.1 * rng.normal(size=(m, 3))
    R_cw = straight_down(rng, m)
    velocity = np.einsum("mji,mj->mi", R_cw, travel + 0.03 * rng.normal(size=(m, 3)))
    return from_above(rng, R_cw, center_w, 0.012 * rng.normal(size=(m, 3)), velocity)


@pytest.mark.parametrize("seed", [20, 21])
def test_a_velocity_that_all_photos_share_is_not_taken_for_their_nodding(seed):
    truth = flight(np.random.default_rng(seed), np.array([0.0, -0.3, 0.0]))
    start = replace(truth, phi=0 * truth.phi, velocity=0 * truth.velocity)
    result = bundle_adjust(start, MODEL)
    # under a prior of zero mean: 9 to 16 mrad
    assert abs((result.reconstruction.phi - truth.phi).mean(0)[0]) < 5e-3
    _, ahead, _ = truth.baseline * result.common.of_photos[:, 3:].mean(0)
    assert -0.35 < ahead < -0.2


def on_its_way(rng, rotates, share=0.05, m=9):
    """Photos straight down along a bend, turned against each other: on their way when read, and rotating, or not."""
    yaw, along = -np.cumsum(rng.uniform(0.2, 0.6, m)), np.cumsum(rng.uniform(0.2, 0.4, m))
    R_cw = Rotation.from_rotvec(yaw[:, None] * [0.0, 0.0, 1.0]).as_matrix() @ straight_down(rng, m)
    center_w = np.column_stack([2.5 * np.cos(along), 2.5 * np.sin(along), 6.0 + 0.1 * rng.normal(size=m)])
    heading = np.column_stack([-np.sin(along), np.cos(along), 0 * along])
    speed = share * np.linalg.norm(np.diff(center_w, axis=0), axis=1).mean()
    steps = Rotation.from_matrix(R_cw[1:] @ R_cw[:-1].transpose(0, 2, 1)).as_rotvec()
    turns = share * rotates * (np.vstack([steps[:1], steps]) + np.vstack([steps, steps[-1:]])) / 2
    phi, velocity = turns + 2e-3 * rng.normal(size=(m, 3)), speed * heading + 0.1 * speed * rng.normal(size=(m, 3))
    return from_above(rng, R_cw, center_w, phi, velocity)


@pytest.mark.parametrize(("rotates", "most"), [(False, 0.7), (True, 0.25)])
def test_photos_taken_on_the_way_from_one_to_the_next_travel_along_it(rotates, most):
    errors = []
    for seed in (20, 21, 22, 23):
        truth = on_its_way(np.random.default_rng(seed), rotates)
        result = bundle_adjust(replace(truth, phi=0 * truth.phi, velocity=0 * truth.velocity), MODEL)
        error, speed = (
            np.linalg.norm(each, axis=1).mean()
            for each in (result.reconstruction.velocity - truth.velocity, truth.velocity)
        )
        errors.append(error / speed)
    # 0.97 where the prior knows only motions that are the same in the frames of all photos
    assert np.mean(errors) < most


def test_velocities_without_a_common_direction_have_no_mean(rng):
    truth = flight(rng, np.zeros(3))
    result = bundle_adjust(truth, MODEL)
    assert (np.abs(result.common.of_photos) <= 2.5 * result.common.deviations)[:, 3:].all()


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_what_is_in_common_does_not_depend_on_how_photos_are_stored(orientation, rng):
    scene = moving(named_scene("5 degrees", m=8, num_points=150), rng, way=0.0)
    scene = replace(scene, cameras=[scene.cameras[0]], camera_idx=np.zeros(8, int))
    scene = replace(measured(scene, rng), shutter_model="rotation")
    turned = orient_reconstruction(scene, dict.fromkeys(scene.image_names[::2], orientation))
    sigma, of_turned = (common_motion(bundle_adjust(each, "rotation", KNOWN), KNOWN).sigma for each in (scene, turned))
    # photos stored otherwise are a camera of their own, with a mean of its own
    np.testing.assert_allclose(of_turned[:3], sigma[:3], rtol=0.1)


def test_a_camera_of_two_photos_says_nothing_of_how_they_move(rng):
    scene = moving(named_scene("parallel", m=9, num_points=150), rng)
    travels = scene.velocity + 0.3 * scene.baseline / scene.frame_span()[:, None] * [1.0, 0.0, 0.4]
    first, other = scene.cameras[0], replace(scene.cameras[0], K=scene.cameras[0].K * [[1.001], [1.001], [1.0]])
    scene = replace(scene, cameras=[first, other], camera_idx=np.array([0] * 7 + [1] * 2), velocity=travels)
    truth = measured(scene, rng)
    result = bundle_adjust(truth, MODEL, ESTIMATED)
    shares = Posterior(result, ESTIMATED).shares
    assert shares[:7].all()
    assert not shares[7:].any()
    assert still_probability(result, ESTIMATED)[7:].max() < 0.5
