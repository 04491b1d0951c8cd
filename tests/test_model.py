"""The frozen dataclasses: what they refuse, and how they say it."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import (
    Camera,
    DepthMap,
    Observations,
    Plane,
    Reconstruction,
    RemapGrid,
    RowMotion,
    RsUndistortError,
    Solution,
    SolvedImage,
    distort_points,
    project_points,
    undistort_points,
)
from rsundistort.errors import InputError
from rsundistort.model import Bend, other_axis
from rsundistort.model.projection import clock_of

K = [[500.0, 0, 320], [0, 400, 240], [0, 0, 1]]
NAN = float("nan")


def make_camera(**changes):
    return Camera(**{"width": 640, "height": 480, "K": K, **changes})


def make_observations(**changes):
    return Observations(**{"frame_idx": [0, 1, 0, 2], "point_idx": [0, 0, 1, 1], "xy_raw": np.ones((4, 2)), **changes})


def make_reconstruction(**changes):
    return Reconstruction(
        **{
            "cameras": [make_camera()],
            "image_names": ["a", "b", "c"],
            "camera_idx": [0, 0, 0],
            "R_cw": np.tile(np.eye(3), (3, 1, 1)),
            "center_w": np.zeros((3, 3)),
            "points_w": np.arange(6.0).reshape(2, 3),
            "observations": make_observations(),
            **changes,
        }
    )


def make_solution(**changes):
    cameras = {"1": make_camera()}
    images = [SolvedImage("a.jpg", "1", motion=RowMotion()), SolvedImage("b.jpg", "1")]
    return Solution(
        **{
            "shutter_model": "rotation",
            "cameras": cameras,
            "rectified_cameras": cameras,
            "images": images,
            **changes,
        }
    )


def scaled(i, j, value):
    changed = np.array(K)
    changed[i, j] = value
    return changed


@pytest.mark.parametrize(
    ("make", "changes", "message"),
    [
        (make_camera, {"width": 0}, "width=0, expected a positive whole number"),
        (make_camera, {"height": 1.5}, "height=1.5, expected a positive whole number"),
        (make_camera, {"width": True}, "width=True, expected a positive whole number"),
        (make_camera, {"K": np.eye(2)}, r"K\.shape=\(2, 2\), expected \(3, 3\)"),
        (make_camera, {"K": "wide"}, r"K: expected numbers of shape \(3, 3\), got 'wide'"),
        (make_camera, {"K": scaled(0, 0, NAN)}, "K holds NaN or infinity"),
        (make_camera, {"K": scaled(1, 1, -400)}, "K has focal lengths 500, -400; both must be positive"),
        (make_camera, {"K": scaled(0, 1, 0.1)}, "K must be .* without skew"),
        (make_camera, {"K": scaled(2, 2, 2)}, r"K must be \[\[fx, 0, cx\], \[0, fy, cy\], \[0, 0, 1\]\]"),
        (make_camera, {"dist": [0.1, 0.2]}, r"dist has 2 numbers, a pinhole lens has one of \(0, 4, 5, 8, 12\)"),
        (make_camera, {"dist": [0.1] * 5, "lens": "fisheye"}, r"dist has 5 numbers, a fisheye lens has one of"),
        (make_camera, {"lens": "omni"}, "lens='omni', expected one of pinhole, fisheye"),
        (make_camera, {"dist": [0.1, 0, NAN, 0]}, "dist holds NaN or infinity"),
        (make_camera, {"readout": "down"}, "readout='down', expected one of top-to-bottom, bottom-to-top"),
        (RowMotion, {"phi": [0.1, 0.2]}, r"phi\.shape=\(2,\), expected \(3,\)"),
        (RowMotion, {"phi": [0.1, 0.2, np.inf]}, "phi holds NaN or infinity"),
        (RowMotion, {"velocity": np.zeros((1, 3))}, r"velocity\.shape=\(1, 3\), expected \(3,\)"),
        (make_observations, {"xy_raw": np.ones(4)}, r"xy_raw\.shape=\(4,\), expected \(N, 2\)"),
        (make_observations, {"xy_raw": np.full((4, 2), NAN)}, "xy_raw holds NaN or infinity"),
        (make_observations, {"frame_idx": [0, 1]}, r"frame_idx\.shape=\(2,\), expected \(4,\)"),
        (make_observations, {"point_idx": [0, 0, -1, 1]}, "point_idx goes from -1 to 1"),
        (make_observations, {"sigma": [1.0, 1.0]}, r"sigma\.shape=\(2,\), expected \(4,\)"),
        (make_observations, {"sigma": [1.0, 1.0, 0.0, 1.0]}, "sigma must be positive"),
        (make_reconstruction, {"image_names": ["a", "b", "a"]}, "image_names holds a name twice"),
        (make_reconstruction, {"cameras": []}, "needs at least one camera"),
        (make_reconstruction, {"camera_idx": [0, 0, 1]}, "camera_idx goes from 0 to 1, expected 0 to 0"),
        (make_reconstruction, {"camera_idx": [0, 0]}, r"camera_idx\.shape=\(2,\), expected \(3,\)"),
        (make_reconstruction, {"R_cw": np.tile(2 * np.eye(3), (3, 1, 1))}, "R_cw holds a matrix that is no rotation"),
        (make_reconstruction, {"R_cw": np.tile(-np.eye(3), (3, 1, 1))}, "R_cw holds a matrix that mirrors"),
        (make_reconstruction, {"R_cw": np.eye(3)}, r"R_cw\.shape=\(3, 3\), expected \(3, 3, 3\)"),
        (make_reconstruction, {"center_w": np.zeros((2, 3))}, r"center_w\.shape=\(2, 3\), expected \(3, 3\)"),
        (make_reconstruction, {"points_w": np.full((2, 3), NAN)}, "points_w holds NaN or infinity"),
        (make_reconstruction, {"points_w": np.zeros((1, 3))}, "point_idx goes from 0 to 1, expected 0 to 0"),
        (
            make_reconstruction,
            {"observations": make_observations(frame_idx=[0, 1, 0, 3])},
            "frame_idx goes from 0 to 3",
        ),
        (make_reconstruction, {"phi": np.zeros(3)}, r"phi\.shape=\(3,\), expected \(3, 3\)"),
        (make_reconstruction, {"shutter_model": "rolling"}, "shutter model 'rolling', expected one of global"),
        (make_solution, {"shutter_model": "rolling"}, "shutter model 'rolling'"),
        (make_solution, {"images": [SolvedImage("a", "1"), SolvedImage("a", "1")]}, "names a photo twice"),
        (make_solution, {"images": [SolvedImage("a", "2")]}, "photo a has camera '2', which the solution lacks"),
        (SolvedImage, {"name": "a", "camera_id": "1", "R_cw": np.ones((3, 3))}, "R_cw of a holds a matrix that is no"),
        (SolvedImage, {"name": "a", "camera_id": "1", "center_w": [0, 0]}, r"center_w of a\.shape=\(2,\)"),
    ],
)
def test_wrong_values_are_refused_by_name(make, changes, message):
    with pytest.raises(InputError, match=message) as caught:
        make(**changes)
    assert isinstance(caught.value, ValueError)
    assert isinstance(caught.value, RsUndistortError)
    assert "\n" not in str(caught.value)


def test_fields_are_read_only_copies():
    phi = np.array([0.1, 0.2, 0.3])
    motion = RowMotion(phi)
    phi[0] = 9
    assert motion.phi[0] == 0.1
    rec, camera, obs = make_reconstruction(), make_camera(dist=[0.1, 0, 0, 0]), make_observations()
    image = SolvedImage("a", "1", np.eye(3), np.zeros(3))
    arrays = [
        *(motion.phi, motion.velocity, camera.K, camera.dist, image.R_cw, image.center_w),
        *(obs.frame_idx, obs.point_idx, obs.xy_raw, obs.sigma),
        *(rec.camera_idx, rec.R_cw, rec.center_w, rec.points_w, rec.phi, rec.velocity),
    ]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    for thing, name in ((motion, "phi"), (camera, "K"), (obs, "sigma"), (rec, "phi"), (image, "R_cw")):
        with pytest.raises(FrozenInstanceError):
            setattr(thing, name, None)


def test_camera_is_a_value():
    camera = make_camera(dist=[0.1, 0, 0, 0])
    same = make_camera(width=640.0, K=np.array(K), dist=np.array([[0.1, 0, 0, 0]]))
    assert camera == same
    assert hash(camera) == hash(same)
    assert isinstance(same.width, int)
    others = {"width": 641}, {"readout": "bottom-to-top"}, {"K": scaled(0, 0, 501)}, {"dist": []}, {"lens": "fisheye"}
    for changes in others:
        assert camera != make_camera(**{"dist": [0.1, 0, 0, 0], **changes})
    assert camera != "camera"
    assert camera.pinhole() == make_camera()


@pytest.mark.parametrize(
    ("readout", "span"),
    [("top-to-bottom", 1.2), ("bottom-to-top", 1.2), ("left-to-right", 1.28), ("right-to-left", 1.28)],
)
def test_frame_span_is_how_far_the_clock_runs(readout, span):
    assert make_camera(readout=readout).frame_span == pytest.approx(span, rel=1e-15)  # one division


@pytest.mark.parametrize(
    ("readout", "axis", "sign", "lines", "other"),
    [
        ("top-to-bottom", 1, 1.0, 480, "left-to-right"),
        ("bottom-to-top", 1, -1.0, 480, "left-to-right"),
        ("left-to-right", 0, 1.0, 640, "top-to-bottom"),
        ("right-to-left", 0, -1.0, 640, "top-to-bottom"),
    ],
)
def test_a_camera_says_which_way_its_clock_runs(readout, axis, sign, lines, other):
    camera = make_camera(readout=readout)
    assert (camera.clock_axis, camera.clock_sign, camera.num_lines) == (axis, sign, lines)
    assert other_axis(readout) == other
    step = sign * np.eye(2)[axis]
    # the kernels' clock: it is zero at the principal point, and shows 1/f more a line later
    clock = clock_of(camera, np.stack([camera.K[:2, 2], camera.K[:2, 2] + step]))
    np.testing.assert_allclose(clock, [0.0, 1.0 / camera.K[axis, axis]], rtol=1e-12)


def test_motion_has_the_aspect_and_skew_of_the_papers_camera():
    motion = RowMotion([0.1, 0.02, 0.3])
    assert motion.imaginary_camera() == (0.9, 0.02)
    assert motion.imaginary_camera("bottom-to-top") == (1.1, -0.02)
    # x grows by 1 + phi2 where columns are read, y leans by -phi1
    assert motion.imaginary_camera("left-to-right") == (1.02, -0.1)
    assert RowMotion().imaginary_camera() == (1, 0)
    assert not RowMotion().velocity.any()


def test_observations_can_be_selected_by_mask_and_by_index():
    obs = make_observations(xy_raw=np.arange(8.0).reshape(4, 2), sigma=[1, 2, 3, 4])
    by_mask, by_index = obs.select(np.array([False, True, False, True])), obs.select(np.array([3, 1]))
    assert (len(obs), len(by_mask), len(by_index)) == (4, 2, 2)
    np.testing.assert_array_equal(by_mask.sigma, [2, 4])
    np.testing.assert_array_equal(by_index.sigma, [4, 2])
    np.testing.assert_array_equal(by_index.xy_raw, [[6, 7], [2, 3]])
    np.testing.assert_array_equal(by_mask.frame_idx, [1, 2])
    assert (make_observations().sigma == 1).all()


def test_reconstruction_gives_each_photo_its_camera_and_motion():
    other = make_camera(readout="left-to-right")
    rec = make_reconstruction(cameras=[make_camera(), other], camera_idx=[0, 1, 0], phi=np.eye(3))
    assert (rec.num_images, rec.num_points) == (3, 2)
    assert rec.camera(1) == other
    np.testing.assert_array_equal(rec.motion(2).phi, [0, 0, 1])
    np.testing.assert_allclose(rec.frame_span(), [1.2, 1.28, 1.2], rtol=1e-15)  # one division


def test_points_with_under_two_photos_are_dropped_and_double_sightings_count_once():
    # point 0: photos 0, 1; point 1: photo 0 twice; point 2: photos 0 twice and 2; point 3: none; point 4: 1, 2
    obs = Observations(
        [0, 1, 0, 0, 0, 0, 2, 1, 2],
        [0, 0, 1, 1, 2, 2, 2, 4, 4],
        np.arange(18.0).reshape(9, 2),
        np.arange(1.0, 10.0),
    )
    rec = make_reconstruction(points_w=np.arange(15.0).reshape(5, 3), observations=obs)
    kept = rec.with_points(np.ones(9, bool))
    np.testing.assert_array_equal(kept.points_w, rec.points_w[[0, 2, 4]])
    np.testing.assert_array_equal(kept.observations.point_idx, [0, 0, 1, 1, 1, 2, 2])  # both sightings stay
    np.testing.assert_array_equal(kept.observations.sigma, [1, 2, 5, 6, 7, 8, 9])
    np.testing.assert_array_equal(kept.observations.xy_raw, obs.xy_raw[[0, 1, 4, 5, 6, 7, 8]])
    # a point lives by the measurements that are kept, and takes the others of them with it
    mask = np.array([1, 0, 1, 1, 0, 1, 1, 1, 1], bool)
    fewer = rec.with_points(mask)
    np.testing.assert_array_equal(fewer.points_w, rec.points_w[[2, 4]])
    np.testing.assert_array_equal(fewer.observations.sigma, [6, 7, 8, 9])
    assert rec.with_points(np.ones(9, bool), min_track=3).num_points == 0
    assert len(rec.with_points(np.zeros(9, bool)).observations) == 0


def test_solution_knows_registered_and_posed_photos():
    pose = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.ones(3)
    images = [
        SolvedImage("both.jpg", "1", *pose, RowMotion()),
        SolvedImage("motion.jpg", "1", motion=RowMotion()),
        SolvedImage("none.jpg", "1", reason="too few matches"),
    ]
    solution = make_solution(images=images)
    assert [image.name for image in solution.registered] == ["both.jpg", "motion.jpg"]
    assert [image.posed for image in images] == [True, False, False]
    assert solution.image("none.jpg").reason == "too few matches"
    with pytest.raises(InputError, match=r"the solution has no photo 'x\.jpg'"):
        solution.image("x.jpg")


# ---------------------------------------------------------------- frames of motions


def test_a_motion_in_the_other_frame_is_refused_where_it_matters():
    camera = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    R_cw = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    image = SolvedImage("a.jpg", "1", R_cw, np.zeros(3), RowMotion([0.01, 0, 0], [0.1, 0.2, 0]))
    point = [[0.1, 0.2, 5.0]]
    assert image.motion.frame == "world"
    with pytest.raises(InputError, match=r"is in the world frame, expected the camera frame; call motion.in_camera"):
        project_points(point, camera, image.motion, "constant-motion")
    for depth in ([5.0], Plane([0, 0, 1], 5.0)):
        for undistorts in (undistort_points, distort_points):
            with pytest.raises(InputError, match="expected the camera frame"):
                undistorts([[300.0, 200.0]], camera, image.motion, "constant-motion", P=camera.K, depth=depth)
    ours = image.motion.in_camera(R_cw)
    unsaid = RowMotion(image.motion.phi, R_cw @ image.motion.velocity)
    for model in ("rotation", "constant-motion"):
        found, expected = (project_points(point, camera, each, model)[0] for each in (ours, unsaid))
        np.testing.assert_array_equal(found, expected)
    with pytest.raises(InputError, match="is in the camera frame, expected the world frame"):
        ours.in_camera(R_cw)
    with pytest.raises(InputError, match="is in the camera frame"):
        ours.pose_at(0.1, R_cw, np.zeros(3))
    with pytest.raises(InputError, match="is in the camera frame"):
        replace(image, motion=ours)
    # which frame a motion without velocity is given in makes no difference
    turning = replace(image, motion=RowMotion([0.01, 0, 0])).motion
    project_points(point, camera, turning, "constant-motion")
    with pytest.raises(InputError, match="frame='body', expected one of world, camera"):
        RowMotion(frame="body")


# ---------------------------------------------------------------- equality


@pytest.mark.parametrize(
    ("make", "other"),
    [
        (lambda: RowMotion([0.1, 0, 0], bend=Bend(-1, 1, np.full((4, 3), 0.1))), RowMotion([0.1, 0, 0])),
        (lambda: Plane([0, 0, 1], 2.0), Plane([0, 0, 1], 3.0)),
        (lambda: DepthMap([[1.0, np.nan]]), DepthMap([[1.0, 2.0]])),
        (lambda: Camera(64, 48, [[50, 0, 32], [0, 50, 24], [0, 0, 1]], [0.1, 0, 0, 0]), 3),
        (lambda: SolvedImage("a.jpg", "1", np.eye(3), np.zeros(3), RowMotion()), SolvedImage("a.jpg", "1")),
        (lambda: make_solution(images=[SolvedImage("a.jpg", "1")]), make_solution(images=[])),
        (lambda: RemapGrid(np.ones((2, 2)), np.ones((2, 2)), 4, 4), RemapGrid(np.zeros((2, 2)), np.ones((2, 2)), 4, 4)),
    ],
)
def test_values_that_hold_arrays_are_equal_if_all_of_it_is(make, other):
    one, same = make(), make()
    assert one == same
    assert same in [other, one]
    assert one != other
    if not isinstance(one, Solution):  # it holds mappings
        assert len({one, same, other}) == 2


def test_zeros_of_either_sign_are_one_key():
    assert len({RowMotion([0.0, 0.1, 0]), RowMotion([-0.0, 0.1, 0])}) == 1
