"""Critical motions: the degeneracy measure against its equations and Hessians, costs, and remedies."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from critical_scenes import HIDDEN, named_scene
from numpy_reference import project
from scipy.spatial.transform import Rotation
from solved_scene import cameras_of

from rsundistort import (
    BundleOptions,
    KnownLength,
    Observations,
    RsUndistortError,
    RsUndistortWarning,
    bundle_adjust,
    critical_motion,
)
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import measured_lengths
from rsundistort.bundle.prior_sigmas import PriorSigmas
from rsundistort.bundle.problem import BundleProblem
from rsundistort.critical import advise, heal, shape_cost, still_probability, with_remedy
from rsundistort.errors import InputError
from rsundistort.io import read_known_lengths, read_known_motions
from rsundistort.solve.model_sequence import solve_tracks

SIGMA_RAD = 0.05
NOISE_PX = 0.5


# thousands of calls on problems this small wait for threads longer than they compute
pytestmark = pytest.mark.usefixtures("one_thread")


def readout_of(scene):
    return [scene.camera(i).readout for i in range(scene.num_images)]


def degeneracy_of(scene):
    return critical_motion(scene.R_cw, scene.center_w, readout_of(scene))


def with_measurements(scene, phi, model, rng=None):
    """The scene seen by the model of the NumPy version, with or without noise."""
    obs = scene.observations
    xy = np.zeros((len(obs), 2))
    for i in range(scene.num_images):
        mine = obs.frame_idx == i
        camera = scene.camera(i)
        xy[mine] = project(
            scene.points_w[obs.point_idx[mine]], scene.R_cw[i], scene.center_w[i], phi[i], model, camera.readout,
            camera.K, [], np.zeros(3),
        )  # fmt: skip
    if rng is not None:
        xy += rng.normal(0, NOISE_PX, xy.shape)
    observations = Observations(obs.frame_idx, obs.point_idx, xy)
    return replace(scene, observations=observations, phi=phi, shutter_model=model)


def moving(scene, rng, still=None):
    """Random motions, per unit of the clock."""
    phi = rng.normal(0, SIGMA_RAD / np.sqrt(3), (scene.num_images, 3)) / scene.frame_span()[:, None]
    if still is not None:
        phi[still] = 0.0
    return phi


def adjusted(scene, rng, still=None, model="rotation", options=None):
    """Truth and solution of noisy measurements of a moving scene."""
    truth = with_measurements(scene, moving(scene, rng, still), model, rng)
    options = options or BundleOptions(loss="squared", outlier_rounds=0, sigma_px=NOISE_PX)
    start = replace(truth, phi=np.zeros_like(truth.phi), shutter_model="global")
    return truth, bundle_adjust(start, model, options, simpler_first=True), options


# ---------------------------------------------------------------- the degeneracy measure


@pytest.mark.parametrize("name", HIDDEN)
def test_degeneracy_measure_is_zero_where_the_shape_is_hidden_and_only_there(name):
    degeneracy = degeneracy_of(named_scene(name))
    values = degeneracy.singular_values
    assert values.shape == (5,)
    assert (np.diff(values) <= 0).all()
    assert (values[5 - HIDDEN[name] :] < 1e-9).all()
    assert (values[: 5 - HIDDEN[name]] > 0.1).all()
    assert degeneracy.num_hidden == HIDDEN[name]


@pytest.mark.parametrize("name", ["parallel", "parallel, some upside down", "one portrait, read by columns"])
def test_parallel_axes_hide_the_vertical_scale(name):
    degeneracy = degeneracy_of(named_scene(name))
    np.testing.assert_allclose(degeneracy.null_vector, [0, 1, 0, 0, 0], atol=1e-9)
    assert "vertical scale" in degeneracy.meaning
    assert degeneracy.y_axis_spread_deg < 1e-5
    assert degeneracy.is_low


def test_meanings():
    assert "too few photos" in degeneracy_of(named_scene("two views")).meaning
    assert "skew and aspect ratio:" in degeneracy_of(named_scene("pure translation")).meaning
    assert degeneracy_of(named_scene("random")).meaning.startswith("nothing")
    assert degeneracy_of(named_scene("20 degrees")).y_axis_spread_deg == pytest.approx(20, rel=0.5)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("mixed", [False, True], ids=["rows", "mixed"])
def test_meter_equals_finite_differences_of_the_equations_of_self_calibration(seed, mixed):
    rng = np.random.default_rng(seed)
    m = 6
    R = Rotation.random(m, random_state=seed).as_matrix()
    C = rng.normal(size=(m, 3))
    spread = np.sqrt(2 * np.mean(np.sum((C - C.mean(0)) ** 2, axis=1)))
    directions = ["left-to-right" if mixed and i % 2 else "top-to-bottom" for i in range(m)]
    exchange = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
    turn = [exchange if "left" in d else np.eye(3) for d in directions]
    squares = np.zeros(5)
    for reference in range(m):
        rows = []

        def equations(x, reference=reference):
            """Eqs. 15 and 18 of the paper, f = 1, omega of the others scaled to omega_33 = 1."""
            K = np.array([[1, x[0], 0], [0, 1 + x[1], 0], [0, 0, 1]])
            # their skew is s f and their aspect ratio alpha f with alpha = 1 + da: omega = K K'
            omega = K @ K.T
            found = []
            for i in range(m):
                if i == reference:
                    continue
                A = turn[i] @ R[i] @ R[reference].T @ turn[reference].T
                a = turn[i] @ R[i] @ (C[reference] - C[i]) / spread
                B = A - np.outer(a, x[2:])
                w = B @ omega @ B.T
                w = w / w[2, 2]
                found += [w[0, 0] * w[1, 1] - w[1, 1] - w[0, 1] ** 2, w[0, 2], w[1, 2]]
            return np.array(found)

        h = 1e-5
        J = np.column_stack([(equations(h * e) - equations(-h * e)) / (2 * h) for e in np.eye(5)])
        rows = np.linalg.svd(J / np.sqrt(m - 1), compute_uv=False)
        squares += rows**2
    found = critical_motion(R, C, directions).singular_values
    np.testing.assert_allclose(found, np.sqrt(squares / m), atol=1e-6)


def test_meter_does_not_change_with_the_world_or_the_order_of_the_photos(rng):
    scene = named_scene("10 degrees")
    expected = degeneracy_of(scene)
    turn = Rotation.random(random_state=1).as_matrix()
    order = rng.permutation(scene.num_images)
    R_cw = (scene.R_cw @ turn.T)[order]
    centers = (3.0 * scene.center_w @ turn.T + [1.0, -2.0, 5.0])[order]
    found = critical_motion(R_cw, centers)
    np.testing.assert_allclose(found.singular_values, expected.singular_values, atol=1e-12)
    np.testing.assert_allclose(np.abs(found.null_vector), np.abs(expected.null_vector), atol=1e-9)
    assert found.y_axis_spread_deg == pytest.approx(expected.y_axis_spread_deg, abs=1e-9)


@pytest.mark.parametrize("name", HIDDEN)
def test_hessian_without_a_gauge_has_as_many_zeros_as_the_measure_says(name):
    scene = named_scene(name, num_points=80)
    scene = with_measurements(scene, np.zeros((scene.num_images, 3)), "two-step")
    options = BundleOptions(loss="squared", outlier_rounds=0)
    problem = BundleProblem(scene, "two-step", options, 1.0, PriorSigmas(1e9, 1e9))
    state = problem.initial_state()
    _, J_frame = problem.blocks(state)
    obs = problem._start.observations.select(problem.structure.order)
    m, n, nb = scene.num_images, scene.num_points, 9
    J = np.zeros((len(obs), 2, nb * m + 3 * n))
    for k in range(len(obs)):
        J[k, :, nb * obs.frame_idx[k] : nb * obs.frame_idx[k] + nb] = J_frame[k]
        J[k, :, nb * m + 3 * obs.point_idx[k] : nb * m + 3 * obs.point_idx[k] + 3] = -J_frame[k, :, 3:6]
    J = J.reshape(-1, J.shape[2])
    values = np.linalg.svd(J / np.linalg.norm(J, axis=0), compute_uv=False)
    # squares of these are the eigenvalues; seven are the similarity of the world
    assert (values < 1e-7).sum() == 7 + HIDDEN[name]
    assert (values < 1e-4).sum() == 7 + HIDDEN[name]


@pytest.mark.parametrize("k", [0.8, 1.3])
def test_stretching_the_height_leaves_no_trace_in_level_photos(k, rng):
    """The paper's proposition 3: Y times k, skew and aspect ratio divided by k."""
    scene = named_scene("parallel")
    phi = moving(scene, rng)
    phi[:, 2] = 0.0
    before = with_measurements(scene, phi, "two-step").observations.xy_raw
    stretch = np.array([1.0, k, 1.0])
    stretched = replace(scene, points_w=scene.points_w * stretch, center_w=scene.center_w * stretch)
    divided = np.column_stack([1 - (1 - phi[:, 0]) / k, phi[:, 1] / k, phi[:, 2]])
    after = with_measurements(stretched, divided, "two-step").observations.xy_raw
    assert np.abs(after - before).max() < 1e-12 * 960


@pytest.mark.parametrize(
    ("args", "says"),
    [
        ((np.eye(3)[None], np.zeros((1, 3))), "two poses"),
        ((np.ones((2, 3, 3)), np.zeros((2, 3))), "R_cw"),
        ((np.stack([np.eye(3)] * 2), np.full((2, 3), np.nan)), "center_w"),
        ((np.stack([np.eye(3)] * 2), np.zeros((2, 3)), "diagonal"), "diagonal"),
        ((np.stack([np.eye(3)] * 2), np.zeros((2, 3)), ["top-to-bottom"]), "1 directions for 2 photos"),
    ],
)
def test_meter_refuses_what_are_no_poses(args, says):
    with pytest.raises(InputError, match=says):
        critical_motion(*args)


# ---------------------------------------------------------------- what it costs


def test_level_cameras_leave_the_height_uncertain_and_tilted_ones_do_not(rng):
    level, tilted = (
        shape_cost(result, options)
        for _, result, options in (adjusted(named_scene(n), rng, model="two-step") for n in ("parallel", "20 degrees"))
    )
    assert level.is_flagged
    assert not tilted.is_flagged
    assert level.sigma_log_k > 4 * tilted.sigma_log_k
    # the prior's mean over ten photos: its standard deviation / sqrt(m), about
    assert level.sigma_log_k == pytest.approx(SIGMA_RAD / np.sqrt(3) / np.sqrt(10) / 0.8, rel=0.6)
    assert "because all cameras were held level" in level.sentence
    assert "because" not in tilted.sentence
    # the weakest mode of the whole system is that scale
    assert level.weakest_share > 0.9
    assert level.weakest_sigma > tilted.weakest_sigma


def test_sigma_of_the_height_covers_its_error(rng):
    normalised = []
    for _ in range(12):
        truth, result, options = adjusted(named_scene("parallel", num_points=120), rng, model="two-step")
        x = truth.points_w - truth.points_w.mean(0)
        y = result.reconstruction.points_w - result.reconstruction.points_w.mean(0)
        B = np.linalg.lstsq(x, y, rcond=None)[0].T
        along = np.linalg.norm(B[:, 1])
        error = np.log(along / np.sqrt(abs(np.linalg.det(B)) / along))
        normalised.append(error / shape_cost(result, options).sigma_log_k)
    assert 0.5 < np.sqrt(np.mean(np.square(normalised))) < 1.6  # twelve values: within 20 % (one sigma)


def test_shape_of_a_global_shutter_is_not_in_question(rng):
    truth, result, options = adjusted(named_scene("random"), rng)
    with pytest.raises(InputError, match="global shutter"):
        shape_cost(replace(result, reconstruction=replace(truth, shutter_model="global")), options)


# ---------------------------------------------------------------- remedies


@pytest.mark.parametrize("name", ["parallel", "one portrait, read by columns"])
def test_auto_finds_the_photo_that_did_not_move(name, rng):
    still = 5  # the portrait photo itself in the second set
    # of 300 points this draw of noise leaves one chance in nine that it moved
    _, result, options = adjusted(named_scene(name, num_points=600), rng, still, model="two-step")
    probability = still_probability(result)
    assert probability[still] > 0.9
    assert np.delete(probability, still).max() < 0.5
    healed, remedy = heal(result, options)
    assert remedy.name == "anchor"
    assert list(remedy.anchors) == ["05.jpg"]
    assert 0.0005 < remedy.anchors["05.jpg"] < 0.01
    assert remedy.after.sigma_log_k < 0.7 * remedy.before.sigma_log_k
    assert "05.jpg most likely did not move" in remedy.sentence
    component = 0 if name == "parallel" else 1
    assert abs(healed.reconstruction.phi[still, component]) < abs(result.reconstruction.phi[still, component]) + 1e-9
    assert abs(healed.reconstruction.phi[still, component]) * 0.8 < 2 * remedy.anchors["05.jpg"]


def test_auto_leaves_photos_that_all_moved_to_the_prior(rng):
    scene = named_scene("parallel")
    phi = rng.choice([-1, 1], (10, 3)) * rng.uniform(0.02, 0.05, (10, 3)) / scene.frame_span()[:, None]
    truth = with_measurements(scene, phi, "two-step", rng)
    options = BundleOptions(loss="squared", outlier_rounds=0, sigma_px=NOISE_PX)
    start = replace(truth, phi=0 * phi, shutter_model="global")
    result = bundle_adjust(start, "two-step", options, simpler_first=True)
    healed, remedy = heal(result, options)
    assert remedy.name == "prior"
    assert healed is result
    assert "no photo is taken to be still" in remedy.sentence


def test_auto_changes_nothing_where_the_poses_are_not_critical(rng):
    _, result, options = adjusted(named_scene("random"), rng, still=3)
    healed, remedy = heal(result, options)
    assert remedy.name == "none needed"
    assert healed is result


def test_wrong_anchor_is_obeyed_and_noticed(rng):
    options = BundleOptions(loss="squared", outlier_rounds=0, sigma_px=NOISE_PX, held_phi={"02.jpg": (0,)})
    scene = named_scene("parallel")
    phi = moving(scene, rng, still=5)
    phi[2] = [0.02, 0.05, -0.04]
    truth = with_measurements(scene, phi, "two-step", rng)
    start = replace(truth, phi=0 * phi, shutter_model="global")
    result = bundle_adjust(start, "two-step", options, simpler_first=True)
    healed, remedy = heal(result, options)
    assert healed.reconstruction.phi[2, 0] == 0.0
    assert remedy.name == "given"
    assert "02.jpg was specified as still" in remedy.warnings[0]
    right = replace(options, held_phi={"05.jpg": (0,)})
    result = bundle_adjust(start, "two-step", right, simpler_first=True)
    assert heal(result, right)[1].warnings == ()


def test_known_motions_are_residuals(rng):
    scene = named_scene("parallel")
    truth, result, options = adjusted(scene, rng, model="two-step")
    span = scene.frame_span()
    sigma = np.full(3, 1e-3)
    known = {f"{i:02d}.jpg": (truth.phi[i] * span[i], sigma) for i in range(4)}
    informed = replace(options, known_phi=known)
    after = bundle_adjust(result.reconstruction, "two-step", informed)
    assert np.abs((after.reconstruction.phi - truth.phi) * span[:, None])[:, 0].max() < 5e-3
    assert shape_cost(after, informed).sigma_log_k < 0.2 * shape_cost(result, options).sigma_log_k
    # components of infinite sigma are not known
    nothing = replace(options, known_phi={"00.jpg": (np.ones(3), np.full(3, np.inf))})
    same = bundle_adjust(result.reconstruction, "two-step", nothing)
    np.testing.assert_allclose(same.reconstruction.phi, result.reconstruction.phi, atol=1e-4)


def seen_at(truth, point, photo=0):
    """Where a photo sees a point."""
    obs = truth.observations
    k = np.flatnonzero((obs.point_idx == point) & (obs.frame_idx == photo))[0]
    return (truth.image_names[photo], *obs.xy_raw[k])


def test_a_known_height_and_width_fix_the_scale(rng):
    scene = named_scene("parallel")
    x = scene.points_w.copy()
    x[:4] = [[-1, -1, 0.2], [-1, 1, 0.2], [-1, 0.3, 0], [1, 0.3, 0]]
    truth, result, options = adjusted(replace(scene, points_w=x), rng, model="two-step")
    lengths = [
        KnownLength(seen_at(truth, 0), seen_at(truth, 1), 200.0, 0.2),  # centimetres
        KnownLength(seen_at(truth, 2), seen_at(truth, 3), 200.0, 0.2),
    ]
    informed = replace(options, lengths=lengths)
    after = bundle_adjust(result.reconstruction, "two-step", informed)
    height, width = (
        np.linalg.norm(after.reconstruction.points_w[i] - after.reconstruction.points_w[i + 1]) for i in (0, 2)
    )
    assert height / width == pytest.approx(1.0, abs=4e-3)
    before = shape_cost(result, options).sigma_log_k
    healed, remedy = heal(after, informed)
    assert healed is after
    assert remedy.name == "given"
    # not below that of the ratio, above it by the noise of four points
    assert 1e-3 * np.sqrt(2) < remedy.after.sigma_log_k < 0.4 * before
    assert "lengths in the scene" in remedy.sentence


@pytest.mark.parametrize(
    ("end", "length", "sigma", "says"),
    [
        (("nobody", 0.0, 0.0), 1.0, 0.1, "'nobody' is not a photo"),
        (None, 1.0, 0.0, "sigma"),
        (None, -1.0, 0.1, "length"),
        (("00.jpg", np.nan, 0.0), 1.0, 0.1, "finite"),
    ],
)
def test_bad_lengths_are_refused(end, length, sigma, says, rng):
    truth = with_measurements(named_scene("random"), np.zeros((10, 3)), "rotation")
    good = KnownLength(seen_at(truth, 0), seen_at(truth, 1), 1.0, 0.1)

    def solve(start, end, *numbers):
        bundle_adjust(truth, "rotation", BundleOptions(lengths=[good, KnownLength(start, end, *numbers)]))

    with pytest.raises(InputError, match=says):
        solve(end or seen_at(truth, 2), seen_at(truth, 3), length, sigma)
    with pytest.raises(InputError, match="scale of the world"):
        BundleOptions(lengths=[good])


@pytest.mark.parametrize("what", ["far from any point", "the same point", "a wrong match"])
def test_lengths_without_two_points_are_left_out_and_named(what, rng):
    truth = with_measurements(named_scene("random"), np.zeros((10, 3)), "rotation")
    good = [KnownLength(seen_at(truth, k), seen_at(truth, k + 1), 1.0, 0.1) for k in range(2)]
    start, end = seen_at(truth, 4), seen_at(truth, 5)
    if what == "far from any point":
        end, says = ("00.jpg", 5000.0, 0.0), r"no point is measured within 5 px of \(5000, 0\) in 00.jpg"
    elif what == "the same point":
        end, says = start, "the same point"
    else:  # it was measured where the user pointed, and is an outlier
        xy, says = truth.observations.xy_raw.copy(), "no point is measured"
        xy[np.flatnonzero((xy == start[1:]).all(1))] += [300, 0]
        start = (start[0], start[1] + 300, start[2])
        truth = replace(truth, observations=replace(truth.observations, xy_raw=xy))
    lengths = [*good, KnownLength(start, end, 1.0, 0.1)]
    with pytest.warns(RsUndistortWarning, match=f"a known length is not used: .*{says}"):
        found = bundle_adjust(truth, "rotation", BundleOptions(lengths=lengths, loss="huber")).reconstruction
    without = bundle_adjust(truth, "rotation", BundleOptions(lengths=good, loss="huber")).reconstruction
    np.testing.assert_allclose(found.center_w, without.center_w, atol=1e-4)


def test_a_length_that_is_left_alone_is_not_used_and_named(rng):
    truth = with_measurements(named_scene("random"), np.zeros((10, 3)), "rotation")
    good = KnownLength(seen_at(truth, 0), seen_at(truth, 1), 1.0, 0.1)
    kept, lost = measured_lengths(truth, [good, KnownLength(seen_at(truth, 2), ("00.jpg", 5000.0, 0.0), 1.0, 0.1)])
    assert kept == ()
    assert "no point is measured" in lost[0]
    assert "only one left" in lost[1]


def test_lengths_of_photos_that_are_not_registered_are_left_out_and_named(rng):
    truth = with_measurements(named_scene("random"), np.zeros((10, 3)), "rotation")
    good = [KnownLength(seen_at(truth, k), seen_at(truth, k + 1), 1.0, 0.1) for k in range(2)]
    lost = KnownLength(seen_at(truth, 4), ("lost.jpg", 3.0, 4.0), 1.0, 0.1)
    for lengths, says in (
        ([*good, lost], "not registered, so no known length: lost.jpg; those of the others are used"),
        ([good[0], lost], "not registered, so no known length: lost.jpg; none is used, since ratios need two"),
    ):
        options = BundleOptions(lengths=lengths)
        with pytest.warns(RsUndistortWarning, match=says):
            solve_tracks(truth, cameras_of(truth), "global", 0, lambda _, options=options: options, StageLog(None))


def test_known_lengths_are_read(tmp_path):
    path = tmp_path / "lengths.csv"
    path.write_text("photo1,x1,y1,photo2,x2,y2,length,sigma\na.jpg,1,2,,3,4,2.1,0.01\na.jpg,1,2,b.jpg,3,4,0.9,0.01\n")
    first, second = read_known_lengths(path)
    assert first == KnownLength(("a.jpg", 1, 2), ("a.jpg", 3, 4), 2.1, 0.01)
    assert second.end == ("b.jpg", 3, 4)
    for text, says in (
        ("photo1,x1\n", "no column"),
        ("photo1,x1,y1,photo2,x2,y2,length,sigma\na,1,2,b,3,4,x,1\n", "line 2"),
        ("photo1,x1,y1,photo2,x2,y2,length,sigma\na,1,2,b,3,4,1,0\n", "sigma"),
        ("photo1,x1,y1,photo2,x2,y2,length,sigma\na,1,2,b,3,4,1,1\n", "need two"),
    ):
        path.write_text(text)
        with pytest.raises(RsUndistortError, match=says):
            read_known_lengths(path)


def test_without_a_remedy_there_is_no_prior(rng):
    options = with_remedy(BundleOptions(loss="squared", outlier_rounds=0, sigma_px=NOISE_PX), "none")
    _, loose, options = adjusted(named_scene("10 degrees"), rng, options=options)
    healed, remedy = heal(loose, options, "none")
    assert healed is loose
    assert remedy.name == "none"
    with pytest.raises(InputError, match="'hope'"):
        with_remedy(options, "hope")
    with pytest.raises(InputError, match="'hope'"):
        heal(loose, options, "hope")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"known_phi": {"a": (np.zeros(3), 0.0)}}, "sigma"),
        ({"known_phi": {"a": (np.zeros(3), [1.0, -1.0, np.inf])}}, "sigma"),
        ({"known_phi": {"a": ([np.nan, 0, 0], 1.0)}}, "finite"),
        ({"known_phi": {"a": (np.zeros(3), 1.0)}, "held_phi": {"a": (0,)}}, "give one of them"),
        ({"held_phi": {"a": (3,)}}, "expected some of 0, 1, 2"),
    ],
)
def test_anchors_that_make_no_sense_are_refused(options, says):
    with pytest.raises(InputError, match=says):
        BundleOptions(**options)


@pytest.mark.parametrize("anchors", [{"held_phi": {"nobody": (0,)}}, {"known_phi": {"nobody": (np.zeros(3), 1.0)}}])
@pytest.mark.parametrize("model", ["global", "rotation"])
def test_anchors_of_nobody_are_refused(anchors, model):
    scene = named_scene("random")
    scene = with_measurements(scene, np.zeros((10, 3)), "rotation")
    with pytest.raises(InputError, match="'nobody' is not a photo"):
        bundle_adjust(scene, model, BundleOptions(**anchors))


# ---------------------------------------------------------------- advice


def test_advice_raises_the_meter_and_lowers_the_uncertainty(rng):
    _, result, options = adjusted(named_scene("parallel"), rng, model="two-step")
    before = shape_cost(result, options)
    advice = advise(result, options)
    assert [each.what.split(" more")[0] for each in advice] == ["one photo", "three photos"]
    for each in advice:
        assert each.degeneracy > before.degeneracy.value + 0.1
        assert each.sigma_log_k < 0.5 * before.sigma_log_k
        assert "the height would be uncertain by" in each.sentence


# ---------------------------------------------------------------- files of known motions


def test_known_motions_are_read(tmp_path):
    path = tmp_path / "gyro.csv"
    path.write_text("name, phi1, phi2, phi3, sigma\na.jpg, 0.01, , -0.02, 0.001\nb.jpg,0,0,0,0.002\n")
    known = read_known_motions(path)
    np.testing.assert_allclose(known["a.jpg"][0], [0.01, 0, -0.02])
    np.testing.assert_allclose(known["a.jpg"][1], [0.001, np.inf, 0.001])
    np.testing.assert_allclose(known["b.jpg"][1], 0.002)
    path.write_text("name,omega1,omega2,omega3,sigma1,sigma2,sigma3\na.jpg,1,2,3,0.1,0.2,0.3\n")
    known = read_known_motions(path, 0.03)
    np.testing.assert_allclose(known["a.jpg"], [[0.03, 0.06, 0.09], [0.003, 0.006, 0.009]])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name,phi1,omega2,sigma\na,1,2,3\n", "mixes"),
        ("name,omega1,omega2,omega3,sigma\na,1,2,3,1\n", "readout"),
        ("photo,phi1,sigma\na,1,2\n", "columns"),
        ("name,phi1,phi2,phi3,sigma\na,1,2,3,0\n", "positive"),
        ("name,phi1,phi2,phi3,sigma\na,1,2,3,-1\n", "positive"),
        ("name,phi1,phi2,phi3,sigma\na,one,2,3,1\n", "numbers"),
        ("name,phi1,phi2,phi3,sigma\na,1,2,3,\n", "numbers"),
        ("name,phi1,phi2,phi3,sigma\na,0,1,0,1\na,0,1,0,1\n", "each once"),
        ("", "columns"),
    ],
)
def test_bad_files_of_known_motions_are_refused(text, says, tmp_path):
    path = tmp_path / "gyro.csv"
    path.write_text(text)
    with pytest.raises(RsUndistortError, match=says):
        read_known_motions(path)
    with pytest.raises(RsUndistortError, match="readable"):
        read_known_motions(tmp_path / "nothing.csv")


def test_what_is_said_of_a_critical_motion_is_json(rng):
    _, result, options = adjusted(named_scene("parallel"), rng, still=5, model="two-step")
    _, remedy = heal(result, options)
    json.dumps({"sentence": remedy.sentence, "anchors": dict(remedy.anchors)})


def test_a_photo_that_stands_twice_in_the_folder_does_not_ruin_the_uncertainty(rng):
    scene, result, options = adjusted(named_scene("20 degrees", num_points=120), rng)
    obs = scene.observations
    mine = np.flatnonzero(obs.frame_idx == 0)
    # the copy is measured as its original; points that only these two show have no depth
    lone = rng.permutation(mine)[: len(mine) // 4]
    others = (obs.frame_idx != 0) & np.isin(obs.point_idx, obs.point_idx[lone])
    twice = replace(
        scene,
        image_names=[*scene.image_names, "copy.jpg"],
        camera_idx=np.append(scene.camera_idx, scene.camera_idx[0]),
        R_cw=np.concatenate([scene.R_cw, scene.R_cw[:1]]),
        center_w=np.concatenate([scene.center_w, scene.center_w[:1] + 1e-4]),
        phi=np.zeros(0), velocity=np.zeros(0), variation=np.zeros(0), shutter_model="global",
        observations=Observations(
            np.append(obs.frame_idx, np.full(len(mine), scene.num_images)),
            np.append(obs.point_idx, obs.point_idx[mine]),
            np.concatenate([obs.xy_raw, obs.xy_raw[mine]]),
        ).select(np.append(~others, np.ones(len(mine), bool))),
    )  # fmt: skip
    # few steps: depths that nothing holds have not run away yet, where they would not count
    options = replace(options, deviations="model")
    few = replace(options, max_iterations=1, prior_sigma_rounds=0)
    alone = replace(result.reconstruction, observations=scene.observations)
    found = [bundle_adjust(each, "rotation", few) for each in (alone, twice)]
    sigma, with_copy = (shape_cost(each, options).sigma_log_k for each in found)
    assert with_copy < 2.0 * sigma
