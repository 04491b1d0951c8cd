"""Translation and depth in grids, photos and points: against plain NumPy, closed forms and ray casting by hand."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy_reference
import pytest
from numpy_reference import DIRECTIONS
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial.transform import Rotation

from rsundistort import (
    AtInfinity,
    DepthMap,
    Plane,
    RowMotion,
    distort_points,
    evaluate,
    init_rectify_map,
    largest_shift_px,
    read_solution,
    rectify,
    rectify_folder,
    run,
    undistort_points,
)
from rsundistort.errors import InputError
from rsundistort.evaluation import psnr
from rsundistort.rectify import depth_from_points, fit_plane, plane_in_camera, prefers_plane, translation_shift_px
from rsundistort.synthetic import project_rows

W, H = 200, 160
K = np.array([[210.0, 0, 97.3], [0, 205.0, 81.6], [0, 0, 1]])
make_camera = partial(numpy_reference.make_camera, W, H, K)
LENS = [-0.12, 0.03, 0.001, -0.002]
VELOCITY = np.array([0.6, -0.3, 0.4])  # m per unit of the clock; the frame is 0.8 of it
MOTION = RowMotion([0.04, -0.03, 0.05], VELOCITY)
R = Rotation.from_rotvec([0.02, -0.05, 0.1]).as_matrix()
MODEL = "constant-motion"

all_directions = pytest.mark.parametrize("readout", DIRECTIONS)
FISHEYE = numpy_reference.Fisheye((0.02, -0.01, 0.003, -0.001))
with_and_without_lens = pytest.mark.parametrize("dist", [[], LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])
depths = pytest.mark.parametrize("kind", ["plane", "map", "points"])


def pixel_grid(width=W, height=H):
    return np.dstack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))).reshape(-1, 2)


def smooth_depth():
    u, v = pixel_grid().T.reshape(2, H, W)
    return 5.0 + np.sin(u / 40) + np.cos(v / 30)


def rectified_points(xy, depth):
    """Camera-frame points that pixels of the rectified photo (rotated by R, of matrix K) show at depths."""
    rays = np.column_stack([(xy - K[:2, 2]) / np.diag(K)[:2], np.ones(len(xy))])
    return (depth[:, None] * rays) @ R


def seen_at(points_c, camera, motion=MOTION):
    """Raw pixels by the plain-NumPy row model."""
    return project_rows(points_c, np.eye(3), np.zeros(3), motion, camera)[0]


def plane_depth(plane, xy):
    """Rectified depths at which the rays of pixels meet a plane, by hand."""
    rays = np.column_stack([(xy - K[:2, 2]) / np.diag(K)[:2], np.ones(len(xy))]) @ R
    return plane.distance / (rays @ plane.normal)


def given(kind, xy):
    """A depth of some kind, and its values at pixels."""
    if kind == "plane":
        plane = Plane([0.1, 0.3, 1.0], 5.0)
        return plane, plane_depth(plane, xy)
    depth_map = DepthMap(smooth_depth())
    if kind == "map":
        at = np.float32(xy)
        inverse = cv2.remap(1 / depth_map.depth, at[:, 0], at[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        inverse = inverse.ravel()
        return depth_map, 1 / inverse.astype(float)
    values = 5.0 + np.sin(xy[:, 0] / 40)
    return values, values


# ---------------------------------------------------------------- grids


@with_and_without_lens
@all_directions
@pytest.mark.parametrize("kind", ["plane", "map"])
def test_grid_is_where_the_row_model_sees_the_points(kind, readout, dist):
    camera, some = make_camera(dist, readout), np.s_[::7]
    xy = pixel_grid()[some]
    depth, values = given(kind, xy)
    map_x, map_y = init_rectify_map(camera, MOTION, MODEL, R, depth=depth)
    seen = map_x.ravel()[some] > -1e5
    assert seen.mean() > 0.99
    expected = seen_at(rectified_points(xy, values), camera)
    found = np.column_stack([map_x.ravel(), map_y.ravel()])[some]
    np.testing.assert_allclose(found[seen], expected[seen], rtol=0, atol=1e-4)  # px; float32 of pixels and depths


def test_without_velocity_any_depth_is_infinity():
    camera, turning = make_camera(LENS), RowMotion(MOTION.phi)
    expected = init_rectify_map(camera, turning, "rotation", R)
    for depth in (None, AtInfinity(), Plane([0, 0, 1], 0.1), DepthMap(smooth_depth())):
        np.testing.assert_array_equal(init_rectify_map(camera, turning, MODEL, R, depth=depth), expected)


def test_at_infinity_the_velocity_does_nothing():
    camera = make_camera(LENS)
    expected = init_rectify_map(camera, MOTION, "rotation", R)
    far = DepthMap(np.full((H, W), np.inf, np.float32))
    for depth in (None, AtInfinity(), far):
        np.testing.assert_array_equal(init_rectify_map(camera, MOTION, MODEL, R, depth=depth), expected)
    for model in ("rotation", "two-step", "linearized", "global"):
        plain = init_rectify_map(camera, MOTION, model, R)
        np.testing.assert_array_equal(init_rectify_map(camera, MOTION, model, R, depth=Plane([0, 0, 1], 1.0)), plain)


def test_shift_falls_as_one_over_the_depth():
    camera = make_camera(LENS)
    far = np.array(init_rectify_map(camera, MOTION, "rotation"))
    shifts = [
        np.abs(np.array(init_rectify_map(camera, MOTION, MODEL, depth=Plane([0, 0, 1], z))) - far).max()
        for z in (1e2, 1e3)
    ]
    assert shifts[0] > 0.1
    assert shifts[0] / shifts[1] == pytest.approx(10, rel=0.02)  # float32 of maps


def test_scale_of_scene_and_velocity_does_not_show():
    camera = make_camera(LENS)
    one = init_rectify_map(camera, MOTION, MODEL, depth=Plane([0.1, 0.2, 1], 4.0))
    tenfold = RowMotion(MOTION.phi, 10 * MOTION.velocity)
    np.testing.assert_allclose(
        init_rectify_map(camera, tenfold, MODEL, depth=Plane([0.1, 0.2, 1], 40.0)), one, atol=1e-4
    )


def test_plane_is_at_infinity_beyond_its_horizon():
    camera = make_camera()
    ground = Plane([0, 1, 0], 1.5)  # everything above the principal row is sky
    found = np.array(init_rectify_map(camera, MOTION, MODEL, depth=ground))
    far = np.array(init_rectify_map(camera, MOTION, "rotation"))
    np.testing.assert_array_equal(found[:, :81], far[:, :81])
    assert np.abs(found - far)[:, 100:].max() > 1


def test_coarse_map_is_stretched_as_opencv_resizes(rng):
    inverse = rng.uniform(0.1, 0.3, (16, 20)).astype(np.float32)
    coarse, fine = DepthMap(1 / inverse, (W, H)), DepthMap(1 / cv2.resize(inverse, (W, H)))
    still = RowMotion(MOTION.phi, [0, 0, 0.5])  # hides nothing
    found, expected = (init_rectify_map(make_camera(), still, MODEL, depth=d) for d in (coarse, fine))
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3)  # px; OpenCV's weights are float32


def test_unknown_depths_are_those_of_the_nearest_known():
    depth = np.full((H, W), 5.0, np.float32)
    depth[:, 120:] = 9.0
    gaps = depth.copy()
    gaps[10:20, 30:40], gaps[50:60, 117:123], gaps[70:80, 150:160] = np.nan, -1.0, 0.0
    filled = 1 / DepthMap(gaps).inverse
    np.testing.assert_allclose(filled, depth, rtol=1e-6)
    with pytest.raises(InputError, match="no positive depth"):
        DepthMap(np.zeros((H, W)))


def test_hidden_pixels_of_two_walls_are_those_that_rays_do_not_reach():
    """A square before a wall: a pixel of the wall is hidden if the ray to it from where its row was read hits it."""
    camera = make_camera()
    motion = RowMotion([0.01, 0.02, -0.01], [1.5, 0.8, 0.3])
    near, far, box = 3.0, 8.0, (60.0, 130.0, 30.0, 140.0)
    xy = pixel_grid()
    in_front = (xy[:, 0] > box[0]) & (xy[:, 0] < box[1]) & (xy[:, 1] > box[2]) & (xy[:, 1] < box[3])
    depth = np.where(in_front, near, far)
    rays = np.column_stack([(xy - K[:2, 2]) / np.diag(K)[:2], np.ones(len(xy))])
    points = depth[:, None] * rays
    raw = seen_at(points, camera, motion)
    centre = ((raw[:, 1] - K[1, 2]) / K[1, 1])[:, None] * motion.velocity
    # where the line of sight passes the depth of the square
    share = (near - centre[:, 2]) / (points[:, 2] - centre[:, 2])
    passed = centre + share[:, None] * (points - centre)
    at = passed[:, :2] / passed[:, 2:] * np.diag(K)[:2] + K[:2, 2]
    inside = np.minimum.reduce([at[:, 0] - box[0], box[1] - at[:, 0], at[:, 1] - box[2], box[3] - at[:, 1]])
    hidden = ~in_front & (inside > 0)
    map_x, _ = init_rectify_map(camera, motion, MODEL, depth=DepthMap(depth.reshape(H, W)))
    found = map_x.ravel() < -1e5
    assert hidden.sum() > 300
    # the edge of the square is blurred over a pixel of the map, and a displacement below a pixel hides nothing
    sure = (np.abs(inside) > 1.5) | in_front
    # lines that graze a corner of it are not distinguished
    assert (found[sure] != hidden[sure]).sum() <= 5
    assert sure[hidden].mean() > 0.6
    photo = np.full((H, W), 200, np.uint8)
    rectified, mask = rectify(photo, camera, motion, MODEL, depth=DepthMap(depth.reshape(H, W)))
    assert (mask.ravel()[found] == 0).all()
    assert (rectified.ravel()[found] == 0).all()


def test_a_thin_pole_hides_its_own_width_only():
    """Where lines of sight pass behind it and come out on the other side, the wall is seen."""
    motion = RowMotion(velocity=[2.0, 0, 0])
    depth = np.full((H, W), 8.0)
    depth[:, 100:104] = 2.0
    map_x, _ = init_rectify_map(make_camera(), motion, MODEL, depth=DepthMap(depth))
    hidden = map_x[5] < -1e5
    # r v (1/2 - 1/8) f: what lies this far beside the pole is seen where the pole is
    shift = (K[1, 2] - 5) / K[1, 1] * 2.0 * (1 / 2 - 1 / 8) * K[0, 0]
    assert shift > 50
    found = np.flatnonzero(hidden)
    expected = np.arange(100, 104) + shift  # this row was read before the principal one
    assert 3 <= len(found) <= 6
    assert abs(found.mean() - expected.mean()) < 1


def test_result_does_not_depend_on_strips_and_threads(rng):
    camera = make_camera(LENS, "left-to-right")
    photo = rng.integers(0, 256, (H, W, 3), dtype=np.uint8)
    depth = np.where(pixel_grid()[:, 0].reshape(H, W) > 90, 3.0, 8.0)
    for each in (DepthMap(depth), DepthMap(depth[::8, ::8], (W, H)), Plane([0.2, 0.1, 1], 4)):
        one, mask = rectify(photo, camera, MOTION, MODEL, depth=each, jobs=1)
        three, its_mask = rectify(photo, camera, MOTION, MODEL, depth=each, jobs=3)
        np.testing.assert_array_equal(one, three)
        np.testing.assert_array_equal(mask, its_mask)
        map_x, map_y = init_rectify_map(camera, MOTION, MODEL, depth=each)
        whole = cv2.remap(photo, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        np.testing.assert_array_equal(one[mask > 0], whole[mask > 0])


def test_a_moved_textured_plane_comes_back(rng):
    """A photo of a plane, made by the inverse of the NumPy row model alone, against its global-shutter reference."""
    camera, motion = make_camera(), RowMotion([0.02, -0.01, 0.03], [0.5, 0.3, -0.2])
    plane = Plane([0.1, -0.2, 1.0], 5.0)
    texture = cv2.GaussianBlur(rng.uniform(size=(400, 400)).astype(np.float32), (0, 0), 4)
    texture = (texture - texture.min()) / (texture.max() - texture.min())

    def shade(points_c):
        return cv2.remap(texture, *(points_c[:, :2] * 60 + 200).T.astype(np.float32), cv2.INTER_LINEAR).reshape(H, W)

    rays = np.column_stack([(pixel_grid() - K[:2, 2]) / np.diag(K)[:2], np.ones(W * H)])
    clock = rays[:, 1:2]
    turned = Rotation.from_rotvec(clock * motion.phi).inv().apply(rays)
    centre = clock * motion.velocity
    raw = shade(centre + ((plane.distance - centre @ plane.normal) / (turned @ plane.normal))[:, None] * turned)
    reference = shade((plane.distance / (rays @ plane.normal))[:, None] * rays)
    rectified, mask = rectify(raw, camera, motion, MODEL, depth=plane)
    error = np.abs(rectified - reference)[cv2.erode(mask, np.ones((5, 5))) > 0]
    assert error.max() < 0.01  # of 1; interpolation
    without, _ = rectify(raw, camera, motion, MODEL)
    assert np.abs(without - reference)[cv2.erode(mask, np.ones((5, 5))) > 0].max() > 0.2


# ---------------------------------------------------------------- points


@with_and_without_lens
@all_directions
@depths
def test_points_go_where_the_row_model_sees_them_and_back(kind, readout, dist, rng):
    camera = make_camera(dist, readout)
    xy = rng.uniform([20, 20], [W - 20, H - 20], (60, 2))
    depth, values = given(kind, xy)
    raw = distort_points(xy, camera, MOTION, MODEL, R, K, depth=depth)
    atol = 2e-3 if kind == "map" else 1e-8  # px; OpenCV 4 interpolates the expected depths on 1/32 px
    np.testing.assert_allclose(raw, seen_at(rectified_points(xy, values), camera), rtol=0, atol=atol)
    back = undistort_points(raw, camera, MOTION, MODEL, R, K, depth=depth)
    np.testing.assert_allclose(back, xy, rtol=0, atol=1e-8)
    if kind != "map":
        ideal = distort_points((xy - K[:2, 2]) / np.diag(K)[:2], camera, MOTION, MODEL, R, depth=depth)
        np.testing.assert_allclose(ideal, raw, rtol=0, atol=1e-8)


def test_raw_pixels_show_the_nearer_of_two_walls(rng):
    camera = make_camera()
    depth = np.full((H, W), 8.0)
    depth[30:140, 60:130] = 3.0
    motion = RowMotion([0.01, 0.02, -0.01], [1.5, 0.8, 0.3])
    raw = rng.uniform([10, 10], [W - 10, H - 10], (500, 2))
    xy = undistort_points(raw, camera, motion, MODEL, P=K, depth=DepthMap(depth))
    again = distort_points(xy, camera, motion, MODEL, P=K, depth=DepthMap(depth))
    np.testing.assert_allclose(again, raw, rtol=0, atol=1e-6)
    # as the map at the same pixels has it: nothing that is hidden is found
    hidden = init_rectify_map(camera, motion, MODEL, depth=DepthMap(depth))[0] < -1e5
    assert not cv2.erode(hidden.astype(np.uint8), np.ones((3, 3)))[tuple(np.rint(xy.T[::-1]).astype(int))].any()


def test_raw_pixels_beside_a_pole_show_the_wall():
    motion = RowMotion(velocity=[2.0, 0, 0])
    depth = np.full((H, W), 8.0)
    depth[:, 100:104] = 2.0
    beside = np.column_stack([np.arange(104.0, 158.0), np.full(54, 5.0)])  # up to where the pole hides the wall
    raw = distort_points(beside, make_camera(), motion, MODEL, P=K, depth=np.full(54, 8.0))
    back = undistort_points(raw, make_camera(), motion, MODEL, P=K, depth=DepthMap(depth))
    wrong = np.abs(back - beside).max(1) > 1e-6
    assert not wrong[2:].any()  # two pixels from the pole


def test_depths_that_make_no_sense_are_refused():
    camera, xy = make_camera(), np.zeros((3, 2))
    with pytest.raises(InputError, match=r"depth.shape=\(2,\), expected \(3,\)"):
        distort_points(xy, camera, MOTION, MODEL, depth=[1.0, 2.0])
    with pytest.raises(InputError, match="not positive"):
        undistort_points(xy, camera, MOTION, MODEL, depth=[1.0, 2.0, 0.0])
    for depth in ("near", [1.0, 2.0], -5.0):  # also where the model needs none
        with pytest.raises(InputError, match="depth"):
            undistort_points(xy, camera, MOTION, "rotation", depth=depth)
    with pytest.raises(InputError, match="P is needed"):
        undistort_points(xy, camera, MOTION, MODEL, depth=DepthMap(smooth_depth()))
    with pytest.raises(InputError, match="depth map is one of 20x16 pixels, the rectified photo has 200x160"):
        init_rectify_map(camera, MOTION, MODEL, depth=DepthMap(np.ones((16, 20))))
    with pytest.raises(InputError, match="normal is zero"):
        Plane([0, 0, 0], 1)
    with pytest.raises(InputError, match="distance is -1"):
        Plane([0, 0, 1], -1)


def test_largest_shift_counts_the_translation():
    camera = make_camera()
    sideways = RowMotion(velocity=[0.5, 0, 0])
    # r v / z, at the first row
    expected = 81.6 / 205 * 0.5 / 4 * 210
    wall = Plane([0, 0, 1], 4.0)
    assert largest_shift_px(camera, sideways, MODEL, wall) == pytest.approx(expected, rel=1e-6)
    assert translation_shift_px(camera, sideways, wall) == pytest.approx(expected, rel=1e-6)
    assert largest_shift_px(camera, sideways, MODEL) == pytest.approx(0, abs=1e-9)
    both = RowMotion(MOTION.phi, sideways.velocity)
    assert translation_shift_px(camera, both, wall) == pytest.approx(expected, rel=0.1)
    assert translation_shift_px(camera, both, AtInfinity()) == 0


# ---------------------------------------------------------------- depths from points


def test_map_of_points_reproduces_a_slope_and_is_constant_beyond(rng):
    xy = rng.uniform([50, 40], [150, 120], (400, 2))
    inverse = 0.1 + 0.0005 * xy[:, 0] + 0.0003 * xy[:, 1]
    made = depth_from_points(xy, 1 / inverse, (W, H))
    rows, cols = made.depth.shape
    centres = np.dstack(np.meshgrid((np.arange(cols) + 0.5) * W / cols - 0.5, (np.arange(rows) + 0.5) * H / rows - 0.5))
    within = (np.abs(centres - [100, 80]) < [40, 30]).all(2)
    expected = 0.1 + centres @ [0.0005, 0.0003]
    np.testing.assert_allclose(made.inverse[within], expected[within], rtol=1e-5)
    assert made.inverse.min() >= inverse.min() * (1 - 1e-6)
    assert made.inverse.max() <= inverse.max() * (1 + 1e-6)


def test_map_of_points_is_scipys_linear_interpolation(rng):
    xy, inverse = rng.uniform([-20, -20], [W + 20, H + 20], (300, 2)), rng.uniform(0.1, 0.104, 300)
    made = depth_from_points(xy, 1 / inverse, (W, H)).inverse
    rows, cols = made.shape
    centres = np.dstack(np.meshgrid((np.arange(cols) + 0.5) * W / cols - 0.5, (np.arange(rows) + 0.5) * H / rows - 0.5))
    # triangles of Delaunay do not change with the unit, but with the scale of one axis they do
    unit = [cols / W, rows / H]
    np.testing.assert_allclose(made, LinearNDInterpolator(xy * unit, inverse)(centres * unit), rtol=1e-6)


def test_stray_points_are_not_believed_and_edges_are(rng):
    xy = rng.uniform([0, 0], [W, H], (600, 2))
    depth = np.where(xy[:, 0] < 100, 4.0, 10.0)
    stray = rng.permutation(600)[:20]
    wild = depth.copy()
    wild[stray] = rng.uniform(0.5, 2.0, 20)
    made = depth_from_points(xy, wild, (W, H))
    cols = made.depth.shape[1]
    u = (np.arange(cols) + 0.5) * W / cols - 0.5
    np.testing.assert_allclose(made.depth[2:-2, u < 75], 4.0, rtol=1e-5)
    np.testing.assert_allclose(made.depth[2:-2, u > 125], 10.0, rtol=1e-5)


def test_false_points_of_two_photos_that_agree_with_each_other_are_not_believed(rng):
    # matches off by one period of a wall's tiles: near, all alike, and side by side
    xy = rng.uniform([0, 0], [W, H], (600, 2))
    depth = 10.0 + 0.01 * xy[:, 0]
    falsely = np.argsort(np.hypot(*(xy - [60, 80]).T))[:6]
    seen = depth.copy()
    seen[falsely] = 2.0
    num_photos = np.where(rng.random(600) < 0.2, 2, 5)
    num_photos[falsely] = 2
    assert depth_from_points(xy, seen, (W, H)).depth.min() < 3
    assert depth_from_points(xy, seen, (W, H), num_photos).depth.min() > 9.5
    # a near thing that three photos saw stays, and where hardly a point is seen in three, two have to do
    near = np.where(np.isin(np.arange(600), falsely), 3, num_photos)
    assert depth_from_points(xy, seen, (W, H), near).depth.min() < 3
    assert depth_from_points(xy, seen, (W, H), np.full(600, 2)).depth.min() < 3


@pytest.mark.parametrize("num", [1, 2, 3, 5])
def test_few_points_and_points_on_a_line_still_make_a_map(num):
    xy = np.column_stack([np.linspace(20, 150, num), np.full(num, 70.0)])
    made = depth_from_points(xy, np.full(num, 6.0), (W, H))
    np.testing.assert_allclose(made.depth, 6.0, rtol=1e-6)


def test_ground_is_found_among_roofs_and_strays(rng):
    normal = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    points = rng.uniform(-50, 50, (1000, 3))
    points -= ((points @ normal) - 3.0)[:, None] * normal
    points += rng.normal(0, 0.02, (1000, 1)) * normal
    points[:300] += rng.uniform(3, 9, (300, 1)) * normal
    points[300:330] += rng.uniform(-60, 60, (30, 3))
    found, offset = fit_plane(points)
    sign = np.sign(found @ normal)
    assert np.degrees(np.arccos(sign * found @ normal)) < 0.01
    assert sign * offset == pytest.approx(3.0, abs=0.01)  # a hundredth of a degree, and the mean of 670 distances
    with pytest.raises(InputError, match="one line"):
        fit_plane(np.outer(np.arange(10.0), [1, 2, 3]))


def test_plane_of_the_world_in_the_camera(rng):
    normal, offset = np.array([0, 0.6, 0.8]), 2.0
    for center in ([0, 0, 10.0], [0, 0, -10.0]):
        plane = plane_in_camera(normal, offset, R, np.array(center))
        X_w = rng.normal(size=(20, 3))
        X_w += (offset - X_w @ normal)[:, None] * normal
        np.testing.assert_allclose((X_w - center) @ R.T @ plane.normal, plane.distance, rtol=1e-12)
    assert plane_in_camera(normal, offset, R, np.array([0, 2.0, 1.0])) is None


def test_plane_is_preferred_where_all_is_flat_only(rng):
    xy = rng.uniform([0, 0], [W, H], (500, 2))
    rays = np.column_stack([(xy - K[:2, 2]) / np.diag(K)[:2], np.ones(500)])
    plane = Plane([0.1, 0.2, 1.0], 10.0)
    flat = 1 / plane.inverse_depth(rays)
    noise = rng.normal(1, 0.003, 500)
    assert prefers_plane(plane, xy, rays, flat * noise, (W, H))
    hills = flat * (1 + 0.08 * np.sin(xy[:, 0] / 15))
    assert not prefers_plane(plane, xy, rays, hills * noise, (W, H))


# ---------------------------------------------------------------- rendered scenes

FLYOVER = Path(__file__).parent.parent / "sample_scenes" / "flyover"


def test_flight_with_true_motion_and_points_comes_near_its_reference():
    """The renderer knows nothing of the row models; the points are 300 or so that a photo shows."""
    truth, tracks = read_solution(FLYOVER / "ground_truth.json"), np.load(FLYOVER / "tracks.npz")
    image = truth.images[1]
    camera, motion = truth.cameras["1"], image.motion.in_camera(image.R_cw)
    X_c = (tracks["points_w"][tracks["point_idx"][tracks["frame_idx"] == 1]] - image.center_w) @ image.R_cw.T
    xy = X_c[:, :2] / X_c[:, 2:] * np.diag(camera.K)[:2] + camera.K[:2, 2]
    depth = depth_from_points(xy, X_c[:, 2], (camera.width, camera.height))
    raw, reference = (cv2.imread(str(FLYOVER / kind / image.name)) for kind in ("photos", "global"))
    far, seen = rectify(raw, camera, motion, MODEL)
    near, mask = rectify(raw, camera, motion, MODEL, depth=depth)
    both = np.minimum(seen, mask)
    assert psnr(near, reference, both) > 35  # dB; the true depths reach 38.6
    assert psnr(near, reference, both) > psnr(far, reference, both) + 8


@pytest.mark.slow
def test_flight_is_rectified_by_what_the_photos_say(tmp_path):
    import pycolmap

    solution = run(FLYOVER / "photos", tmp_path / "out")
    rectify_folder(FLYOVER / "photos", tmp_path / "out" / "solution.json", tmp_path / "far", depth="infinity")
    near, far = (evaluate(tmp_path / out, FLYOVER / "ground_truth.json").psnr_db for out in ("out", "far"))
    assert near.median > far.median + 4
    assert near.min > far.min + 4
    # COLMAP projects its points as we do ours: their residuals have the same rms
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse")
    residuals = [
        model.images[seen.image_id].project_point(point.xyz) - model.images[seen.image_id].points2D[seen.point2D_idx].xy
        for point in model.points3D.values()
        for seen in point.track.elements
    ]
    assert np.sqrt(np.mean(np.square(residuals))) == pytest.approx(solution.quality["rms_px"], rel=0.02)
