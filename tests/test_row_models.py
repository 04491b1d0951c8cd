"""The row models against the NumPy version, OpenCV and themselves."""

from __future__ import annotations

from functools import partial

import numpy as np
import numpy_reference
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy_reference import DIRECTIONS, MODELS, Fisheye, lens, project_normalised, undistort_with_opencv

from rsundistort import Camera, RowMotion, project_points, unproject_points
from rsundistort.errors import InputError
from rsundistort.model.projection import project_points_with_jacobians

K = np.array([[410.0, 0, 201.0], [0, 400.0, 148.5], [0, 0, 1]])
make_camera = partial(numpy_reference.make_camera, 400, 300, K)
FOCAL = np.array([410.0, 400.0])
RATIONAL = [0.1, -0.05, 0.001, -0.002, 0.01, 0.25, 0.02, 0.005]
LENSES = {
    "pinhole": [],
    "k1-k2-p1-p2": [-0.12, 0.03, 0.001, -0.002],
    "8-parameters": RATIONAL,
    "12-parameters": [*RATIONAL, 0.002, -0.001, 0.001, 0.0015],
    "fisheye": Fisheye([0.03, -0.01, 0.004, -0.001]),
}
all_models = pytest.mark.parametrize("model", MODELS)
all_directions = pytest.mark.parametrize("readout", DIRECTIONS)
all_lenses = pytest.mark.parametrize("dist", LENSES.values(), ids=LENSES)


def draw_points(rng, n=60, field=0.6):
    """Camera-frame points at depths 1 to 10; the field is somewhat more than the photo shows."""
    depth = rng.uniform(1, 10, (n, 1))
    return np.hstack([rng.uniform(-field, field, (n, 2)), np.ones((n, 1))]) * depth


def draw_motions(rng, n=6):
    """Motions up to 0.1 rad a unit, small ones too, and one along each axis."""
    random = rng.uniform(-0.1, 0.1, (n, 3)) * np.array([1, 1, 1, 0.1, 1e-3, 1e-6])[:n, None]
    return [RowMotion(phi, rng.uniform(-0.3, 0.3, 3)) for phi in np.vstack([random, 0.1 * np.eye(3)])]


@all_lenses
@all_directions
@all_models
def test_forward_equals_the_numpy_model(model, readout, dist, rng):
    camera, points = make_camera(dist, readout), draw_points(rng)
    for motion in draw_motions(rng):
        xy, valid = project_points(points, camera, motion, model)
        assert valid.all()
        reference = project_normalised(points, motion.phi, model, readout, dist, motion.velocity)
        # both solve the row to 1e-14 or better and then round a few dozen times
        assert np.abs((xy - K[:2, 2]) / FOCAL - reference).max() <= 1e-12


@all_lenses
@all_directions
@all_models
def test_unproject_inverts_project(model, readout, dist, rng):
    camera, points = make_camera(dist, readout), draw_points(rng)
    for motion in draw_motions(rng):
        # without depth, translation cannot be undone
        motion = RowMotion(motion.phi)
        xy, _ = project_points(points, camera, motion, model)
        ideal, valid = unproject_points(xy, camera, motion, model)
        assert valid.all()
        # Newton of the lens ends at 1e-14; its slope, above 0.5 here, hardly amplifies that
        assert np.abs(ideal - points[:, :2] / points[:, 2:]).max() <= 1e-10


@all_lenses
@all_directions
@all_models
def test_jacobians_equal_central_differences(model, readout, dist, rng):
    camera, points = make_camera(dist, readout), draw_points(rng, n=20)
    points /= points[:, 2:]  # one scale of lengths, one step for the differences
    points *= rng.uniform(1, 2, (20, 1))
    h = 1e-5
    for motion in draw_motions(rng):
        xy, valid, J = project_points_with_jacobians(points, camera, motion, model)
        assert valid.all()
        # the same formulas, compiled once with and once without derivatives: rounding of pixels up to 400
        np.testing.assert_allclose(xy, project_points(points, camera, motion, model)[0], atol=1e-11)

        def difference(step, d_point, d_phi, d_velocity, motion=motion):
            ends = [
                project_points(
                    points + s * d_point * step,
                    camera,
                    RowMotion(motion.phi + s * d_phi * step, motion.velocity + s * d_velocity * step),
                    model,
                )[0]
                for s in (1, -1)
            ]
            return (ends[0] - ends[1]) / (2 * h)

        for j, step in enumerate(h * np.eye(3)):
            by_point, by_phi, by_velocity = (difference(step, *which) for which in np.eye(3))
            # derivatives are of the size of the focal length, 400; differences are good to h^2 + 1e-13/h = 1e-8
            assert np.abs(J.point[:, :, j] - by_point).max() <= 1e-6 * 400
            assert np.abs(J.phi[:, :, j] - by_phi).max() <= 1e-6 * 400
            assert np.abs(J.velocity[:, :, j] - by_velocity).max() <= 1e-6 * 400


@all_lenses
@all_models
def test_without_motion_points_lie_where_opencv_puts_them(model, dist, rng):
    camera, points = make_camera(dist), draw_points(rng)
    expected = lens(dist, points[:, :2] / points[:, 2:]) * FOCAL + K[:2, 2]
    xy, valid = project_points(points, camera, shutter_model=model)
    assert valid.all()
    np.testing.assert_allclose(xy, expected, rtol=0, atol=1e-9)  # px; rounding of the same formula
    ideal = undistort_with_opencv(expected, K, dist)
    back, valid = unproject_points(expected, camera, shutter_model=model)
    assert valid.all()
    # px; OpenCV's iteration shrinks its error by 0.1-0.2 a step at these lenses and takes up to 100
    np.testing.assert_allclose(back * FOCAL, ideal * FOCAL, rtol=0, atol=1e-9)


@all_directions
@pytest.mark.parametrize(("model", "field"), [("linearized", 0.6), ("two-step", 1e-3)])
def test_models_agree_with_rotation_to_first_order_in_phi(model, field, readout, rng):
    # the two-step model drops terms of third order in the field: there it agrees only near the principal point
    camera, points = make_camera((), readout), draw_points(rng, field=field)
    phi = rng.uniform(0.05, 0.1, 3) * rng.choice([-1, 1], 3)
    gaps, shifts = [], []
    for scale in (1.0, 0.1):
        exact = project_points(points, camera, RowMotion(scale * phi))[0]
        gaps.append(np.abs(project_points(points, camera, RowMotion(scale * phi), model)[0] - exact).max())
        shifts.append(np.abs(project_points(points, camera)[0] - exact).max())
    assert gaps[0] > 0.01 * shifts[0] > 0  # there is something to compare
    # quadratic: 0.01, and 0.002 for the cubic term; a first-order mistake would give 0.1
    assert gaps[1] < 0.015 * gaps[0]


@all_directions
def test_two_step_drops_only_third_order_of_the_field(readout, rng):
    camera, points = make_camera((), readout), draw_points(rng, field=0.3)
    motion = RowMotion(1e-6 * rng.uniform(0.5, 1, 3))  # so small that phi^2 does not show
    gaps = []
    for scale in (1.0, 0.1):
        near = points * [scale, scale, 1]
        gaps.append(project_points(near, camera, motion, "two-step")[0] - project_points(near, camera, motion)[0])
    # cubic: 0.001; rounding of pixels is 1e-13, the smaller gap 1e-9
    assert 0 < np.abs(gaps[1]).max() < 1.1e-3 * np.abs(gaps[0]).max()


@pytest.mark.parametrize("reverse", [DIRECTIONS[:2], DIRECTIONS[2:]], ids=["rows", "columns"])
@all_lenses
@all_models
def test_reversing_the_readout_negates_phi(model, dist, reverse, rng):
    points, phi = draw_points(rng), rng.uniform(-0.1, 0.1, 3)
    there = project_points_with_jacobians(points, make_camera(dist, reverse[0]), RowMotion(phi), model)
    back = project_points_with_jacobians(points, make_camera(dist, reverse[1]), RowMotion(-phi), model)
    # the sign enters by exact multiplication, yet the compiler may join products and sums differently
    np.testing.assert_allclose(there[0], back[0], rtol=0, atol=1e-11)
    np.testing.assert_allclose(there[2].point, back[2].point, rtol=0, atol=1e-9)
    np.testing.assert_allclose(there[2].phi, -back[2].phi, rtol=0, atol=1e-9)


@all_models
def test_scale_of_the_points_does_not_matter(model, rng):
    points, motion = draw_points(rng), RowMotion(rng.uniform(-0.1, 0.1, 3))
    camera = make_camera(LENSES["12-parameters"], "right-to-left")
    near, far = (project_points(s * points, camera, motion, model)[0] for s in (1e-6, 1e6))
    np.testing.assert_allclose(near, far, rtol=0, atol=1e-10)  # px; rounding of the division by z


@all_directions
@all_models
def test_points_behind_the_camera_and_beyond_the_fold_are_nan(model, readout):
    camera = Camera(400, 300, K, [-0.3, 0, 0, 0], readout)  # r (1 - 0.3 r^2) turns back at r = 1.054, to 0.703
    motion = RowMotion([0.05, -0.03, 0.04])
    points = [[0.1, 0.2, 1], [0.1, 0.2, -1], [0.1, 0.2, 0], [1.4, 0.1, 1], [-0.2, -1.3, 1], [0.3, 0.1, 1]]
    expected = [True, False, False, False, False, True]
    xy, valid = project_points(points, camera, motion, model)
    assert valid.tolist() == expected
    assert (np.isfinite(xy).all(1) == valid).all()
    with_jacobians, also_valid, J = project_points_with_jacobians(points, camera, motion, model)
    assert also_valid.tolist() == expected
    for values in (with_jacobians, J.point, J.phi):
        assert (np.isfinite(values).all(axis=tuple(range(1, values.ndim))) == valid).all()
        assert np.isnan(values[~valid]).all()

    pixels = np.array([[0.2, 0.3], [0.9, 0.0], [-0.1, -0.8], [0.6, 0.2]]) * FOCAL + K[:2, 2]
    ideal, valid = unproject_points(pixels, camera, motion, model)
    assert valid.tolist() == [True, False, False, True]
    assert np.isnan(ideal[~valid]).all()


def test_point_that_no_row_sees_is_nan():
    # rows follow the point: at 3 rad a unit the line of sight outruns it and rows fold over
    camera = make_camera()
    xy, valid = project_points([[0.0, 0.4, 1.0]], camera, RowMotion([-3.0, 0, 0]))
    assert not valid[0]
    assert np.isnan(xy).all()
    xy, valid = project_points([[0.0, 0.4, 1.0]], camera, RowMotion([-3.0, 0, 0]), "linearized")
    assert not valid[0]
    assert np.isnan(xy).all()


@all_directions
@pytest.mark.parametrize("model", ["global", "rotation", "constant-motion"])
def test_fisheye_up_to_the_side(model, readout, rng):
    dist = LENSES["fisheye"]
    camera = make_camera(dist, readout)
    angle, around = rng.uniform(0, np.deg2rad(84), 40), rng.uniform(0, 2 * np.pi, 40)
    rays = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
    h = 1e-6
    for phi in 0.05 * rng.uniform(-1, 1, (5, 3)):
        motion = RowMotion(phi, 0.05 * rng.uniform(-1, 1, 3))
        points = rays * rng.uniform(1, 2, (40, 1))
        xy, valid, J = project_points_with_jacobians(points, camera, motion, model)
        assert valid.all()
        reference = project_normalised(points, phi, model, readout, dist, motion.velocity)
        # at 84 degrees x/z is 10, and its rounding ten times that of the tests above
        assert np.abs((xy - K[:2, 2]) / FOCAL - reference).max() <= 1e-12
        for j, step in enumerate(h * np.eye(3)):
            ends = [project_points(points + s * step, camera, motion, model)[0] for s in (1, -1)]
            # z is down to 0.1: the third derivative over h^2 leaves 1e-9 of the focal length, rounding 1e-7
            assert np.abs(J.point[:, :, j] - (ends[0] - ends[1]) / (2 * h)).max() <= 1e-6 * 400
        if model != "constant-motion":
            ideal, valid = unproject_points(xy, camera, motion, model)
            assert valid.all()
            back = np.column_stack([ideal, np.ones(40)])
            assert np.abs(np.cross(rays, back / np.linalg.norm(back, axis=1, keepdims=True))).max() <= 1e-12


def test_fisheye_is_that_of_colmap(rng):
    import pycolmap  # after cv2

    dist, c = LENSES["fisheye"], K[:2, 2] + 0.5  # COLMAP's pixel centres
    theirs = pycolmap.Camera(model="OPENCV_FISHEYE", width=400, height=300, params=[*FOCAL, *c, *dist])
    points = draw_points(rng, field=5)
    xy, valid = project_points(points, make_camera(dist), shutter_model="global")
    assert valid.all()
    np.testing.assert_allclose(xy, [theirs.img_from_cam(point) - 0.5 for point in points], rtol=0, atol=1e-9)


@all_directions
@pytest.mark.parametrize("model", ["global", "rotation", "constant-motion"])
def test_fisheye_ends_at_the_side_and_at_its_fold(model, readout):
    motion = RowMotion([0.05, -0.03, 0.04])
    unbent = make_camera(Fisheye(np.zeros(4)), readout)
    folding = make_camera(Fisheye([-0.3, 0, 0, 0]), readout)  # a (1 - 0.3 a^2) turns back at a = 1.054, to 0.703
    points = [[0, 0, 1], [-1, 0.1, 0.1], [0.1, 0.2, -1], [0.1, 0.2, 0]]
    for camera, expected in ((unbent, [True, True, False, False]), (folding, [True, False, False, False])):
        xy, valid = project_points(points, camera, motion, model)
        assert valid.tolist() == expected
        assert (np.isfinite(xy).all(1) == valid).all()
    np.testing.assert_array_equal(project_points(points, unbent)[0][0], K[:2, 2])
    pixels = np.array([[0, 0], [0.3, 0.4], [0.6, 0.6], [-1.5, 0.1], [0.1, 1.6]]) * FOCAL + K[:2, 2]
    for camera, expected in ((unbent, [True] * 4 + [False]), (folding, [True] * 2 + [False] * 3)):
        ideal, valid = unproject_points(pixels, camera, motion, model)
        assert valid.tolist() == expected
        assert np.isnan(ideal[~valid]).all()


def test_no_points_give_no_points():
    for function, width in ((project_points, 3), (unproject_points, 2)):
        xy, valid = function(np.zeros((0, width)), make_camera())
        assert xy.shape == (0, 2)
        assert valid.shape == (0,)


def test_wrong_arguments_are_refused_by_name():
    with pytest.raises(InputError, match=r"points_c\.shape=\(3,\), expected \(N, 3\)"):
        project_points(np.zeros(3), make_camera())
    with pytest.raises(InputError, match=r"xy_raw\.shape=\(2, 3\), expected \(N, 2\)"):
        unproject_points(np.zeros((2, 3)), make_camera())
    with pytest.raises(InputError, match="shutter model 'rolling', expected one of global, two-step"):
        project_points(np.zeros((1, 3)), make_camera(), shutter_model="rolling")


# near identity on purpose: zeros, denormals and tiny angles are where series and closed forms meet
angles = st.one_of(st.floats(-0.15, 0.15), st.floats(-1e-3, 1e-3), st.floats(-1e-9, 1e-9))
motions = st.tuples(angles, angles, angles)
coordinates = st.floats(-0.6, 0.6)


@given(motions, coordinates, coordinates, st.sampled_from(MODELS), st.sampled_from(DIRECTIONS))
def test_any_direction_survives_the_round_trip(phi, x, y, model, readout):
    camera, motion = make_camera(LENSES["k1-k2-p1-p2"], readout), RowMotion(phi)
    xy, valid = project_points([[x, y, 1.0]], camera, motion, model)
    assert valid[0]
    ideal, valid = unproject_points(xy, camera, motion, model)
    assert valid[0]
    assert np.abs(ideal - [x, y]).max() <= 1e-10  # as in the round trip above


@given(motions, coordinates, coordinates, st.sampled_from(DIRECTIONS))
def test_any_direction_is_seen_by_the_row_that_it_lands_on(phi, x, y, readout):
    assume(any(phi))
    camera = make_camera(LENSES["8-parameters"], readout)
    xy, _ = project_points([[x, y, 1.0]], camera, RowMotion(phi))
    reference = project_normalised([[x, y, 1.0]], phi, "rotation", readout, LENSES["8-parameters"])
    assert np.abs((xy - K[:2, 2]) / FOCAL - reference).max() <= 1e-12  # as in the comparison above
