"""Grids, photos and points: against OpenCV, against each other, and there and back with an independent warp."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import numpy_reference
import pytest
from numpy_reference import DIRECTIONS, MODELS, Fisheye, lens, undistort_with_opencv
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from rsundistort import (
    Camera,
    RowMotion,
    distort_points,
    init_rectify_map,
    largest_shift_px,
    optimal_new_camera,
    rectify,
    undistort_points,
)
from rsundistort.errors import InputError
from rsundistort.model import READOUTS, Bend
from rsundistort.rectify import INTERPOLATIONS
from rsundistort.rectify.coarse_grid import coarse_grid
from rsundistort.rectify.maps import rectified_rays
from rsundistort.synthetic.warp import warp_photo

W, H = 200, 160
K = np.array([[210.0, 0, 97.3], [0, 205.0, 81.6], [0, 0, 1]])
make_camera = partial(numpy_reference.make_camera, W, H, K)
LENS = [-0.12, 0.03, 0.001, -0.002]
FISHEYE = Fisheye([0.03, -0.01, 0.004, -0.001])
RATIONAL = [0.1, -0.05, 0.001, -0.002, 0.01, 0.25, 0.02, 0.005, 0.002, -0.001, 0.001, 0.0015]
MOTION = RowMotion([0.09, -0.06, 0.08])
STRONG = RowMotion(np.array([0.7, -0.5, 0.6]) / np.linalg.norm([0.7, -0.5, 0.6]) * 0.2)

all_models = pytest.mark.parametrize("model", MODELS)
all_directions = pytest.mark.parametrize("readout", DIRECTIONS)
lenses = pytest.mark.parametrize(
    "dist", [[], LENS, RATIONAL, FISHEYE], ids=["pinhole", "4-parameters", "12-parameters", "fisheye"]
)
with_and_without_lens = pytest.mark.parametrize("dist", [[], LENS, FISHEYE], ids=["pinhole", "lens", "fisheye"])


def opencv_map(dist, R, new_K, size):
    """`cv2.initUndistortRectifyMap` of either lens model."""
    of = cv2.fisheye if isinstance(dist, Fisheye) else cv2
    return of.initUndistortRectifyMap(K, np.array(dist), R, new_K, size, cv2.CV_32FC1)


def smooth_photo(rng, channels=1, dtype=np.float32, sigma=3.0):
    """Blurred noise over the whole range: without detail that an interpolation could lose."""
    noise = cv2.GaussianBlur(rng.normal(size=(H, W, channels)), (0, 0), sigma).reshape(H, W, channels)
    unit = (noise - noise.min()) / (noise.max() - noise.min())
    photo = unit if dtype == np.float32 else np.rint(unit * np.iinfo(dtype).max)
    return np.ascontiguousarray(photo.astype(dtype)[..., 0] if channels == 1 else photo.astype(dtype))


def pixel_grid(width, height):
    return np.dstack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))).reshape(-1, 2)


def inside(map_x, map_y):
    """Where a map points into the raw photo; a thousandth of a pixel is left to float32."""
    return (map_x >= -1e-3) & (map_x <= W - 1 + 1e-3) & (map_y >= -1e-3) & (map_y <= H - 1 + 1e-3)


@lenses
@all_models
def test_without_motion_the_map_is_opencvs(model, dist):
    R = Rotation.from_rotvec([0.02, -0.05, 0.1]).as_matrix()
    new_K, size = np.array([[273.0, 0, 135.5], [0, 246, 93.0], [0, 0, 1]]), (260, 190)
    expected = opencv_map(dist, R, new_K, size)
    maps = init_rectify_map(make_camera(dist), None, model, R, new_K, size)
    for found, opencv in zip(maps, expected, strict=True):
        assert found.shape == (190, 260)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, opencv, rtol=0, atol=1e-3)  # px; OpenCV 4 rounds on the way


def test_all_kinds_of_maps_say_the_same():
    camera = make_camera(LENS)
    map_x, map_y = init_rectify_map(camera, MOTION)
    both, nothing = init_rectify_map(camera, MOTION, m1type=cv2.CV_32FC2)
    assert nothing is None
    np.testing.assert_array_equal(both, np.dstack([map_x, map_y]))
    fixed = init_rectify_map(camera, MOTION, m1type=cv2.CV_16SC2)
    for found, expected in zip(fixed, cv2.convertMaps(map_x, map_y, cv2.CV_16SC2), strict=True):
        np.testing.assert_array_equal(found, expected)
    back = cv2.convertMaps(*fixed, cv2.CV_32FC1)
    np.testing.assert_allclose(back, (map_x, map_y), rtol=0, atol=1 / 64 + 1e-4)  # px; fixed point is 1/32 px
    with pytest.raises(InputError, match=r"m1type=.*expected cv2\.CV_32FC1"):
        init_rectify_map(camera, MOTION, m1type=cv2.CV_8UC1)


@with_and_without_lens
@all_directions
@all_models
def test_map_is_where_distort_points_sends_the_pixels(model, readout, dist):
    camera = make_camera(dist, readout)
    R = Rotation.from_rotvec([0.02, -0.05, 0.1]).as_matrix()
    map_x, map_y = init_rectify_map(camera, MOTION, model, R)
    raw = distort_points(pixel_grid(W, H), camera, MOTION, model, R, K)
    assert np.isfinite(raw).all()
    # px; float32 of numbers up to 256
    np.testing.assert_allclose(np.column_stack([map_x.ravel(), map_y.ravel()]), raw, rtol=0, atol=2e-5)


def test_map_points_far_outside_where_no_raw_pixel_answers():
    camera = Camera(W, H, K, [-0.6, 0, 0, 0])  # folds at 0.745: the corners of a wide view lie beyond
    wide = np.array([[100.0, 0, 100], [0, 100, 80], [0, 0, 1]])
    map_x, map_y = init_rectify_map(camera, MOTION, new_K=wide)
    assert np.isfinite(map_x).all()
    assert np.isfinite(map_y).all()
    assert max(map_x[0, 0], map_y[0, 0]) <= -1e5
    raw = distort_points([[0.0, 0.0], [100.0, 80.0]], camera, MOTION, P=wide)
    assert np.isnan(raw[0]).all()
    assert np.isfinite(raw[1]).all()


@with_and_without_lens
@all_directions
@all_models
def test_distort_points_inverts_undistort_points(model, readout, dist, rng):
    camera = make_camera(dist, readout)
    R, P = Rotation.from_rotvec([0.02, -0.05, 0.1]).as_matrix(), K * [[1.3], [1.2], [1]]
    raw = rng.uniform([0, 0], [W - 1, H - 1], (100, 2))
    for kwargs in ({}, {"P": P}, {"R": R, "P": P}):
        ideal = undistort_points(raw, camera, MOTION, model, **kwargs)
        back = distort_points(ideal, camera, MOTION, model, **kwargs)
        np.testing.assert_allclose(back, raw, rtol=0, atol=1e-9)  # px; 1e-11 of the inverse times the focal length


@pytest.mark.parametrize("function", [undistort_points, distort_points])
def test_points_keep_the_shapes_of_opencv(function, rng):
    points = rng.uniform(-0.2, 0.2, (7, 2)) * 200 + [100, 80]
    flat = function(points, make_camera(LENS), MOTION, P=K)
    assert flat.shape == (7, 2)
    for shape in ((7, 1, 2), (1, 7, 2)):
        shaped = function(points.reshape(shape), make_camera(LENS), MOTION, P=K)
        assert shaped.shape == shape
        np.testing.assert_array_equal(shaped.reshape(7, 2), flat)
    assert function(np.zeros((0, 1, 2)), make_camera(LENS), MOTION, P=K).shape == (0, 1, 2)
    np.testing.assert_array_equal(function(points.tolist(), make_camera(LENS), MOTION, P=K), flat)
    for shape in ((2,), (2, 7, 2), (7, 3)):
        with pytest.raises(InputError, match=r"points\.shape=.*expected \(N, 2\), \(N, 1, 2\) or \(1, N, 2\)"):
            function(np.zeros(shape), make_camera())


@lenses
def test_without_motion_points_are_opencvs(dist, rng):
    raw = rng.uniform([0, 0], [W - 1, H - 1], (100, 2))
    R, P = Rotation.from_rotvec([0.02, -0.05, 0.1]).as_matrix(), K * [[1.3], [1.2], [1]]
    expected = undistort_with_opencv(raw, K, dist, R, P)
    # px; both iterate to rounding
    np.testing.assert_allclose(undistort_points(raw, make_camera(dist), R=R, P=P), expected, rtol=0, atol=1e-9)
    rays = rng.uniform(-0.4, 0.4, (100, 2))
    expected = lens(dist, rays) * np.diag(K)[:2] + K[:2, 2]
    np.testing.assert_allclose(distort_points(rays, make_camera(dist)), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32], ids=["uint8", "uint16", "float32"])
@pytest.mark.parametrize("channels", [1, 3, 4], ids=["grey", "colour", "alpha"])
@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_without_lens_and_motion_a_photo_comes_back_bit_for_bit(interpolation, channels, dtype, rng):
    photo = smooth_photo(rng, channels, dtype, sigma=0.8)
    rectified, mask = rectify(photo, make_camera(), interpolation=interpolation)
    assert rectified.dtype == dtype
    np.testing.assert_array_equal(rectified, photo)
    assert mask.dtype == np.uint8
    assert (mask == 255).all()


def test_single_channel_axis_is_kept(rng):
    photo = smooth_photo(rng, 1, np.uint8)[..., None]
    rectified, _ = rectify(photo, make_camera(LENS), MOTION)
    assert rectified.shape == photo.shape


@with_and_without_lens
@all_directions
def test_mask_is_where_the_map_lies_in_the_raw_frame(readout, dist, rng):
    camera, photo = make_camera(dist, readout), smooth_photo(rng, 3, np.uint8)
    new_camera = Camera(260, 190, [[210, 0, 127.3], [0, 205, 96.6], [0, 0, 1]])
    rectified, mask = rectify(photo, camera, MOTION, new_camera=new_camera)
    seen = inside(*init_rectify_map(camera, MOTION, new_K=new_camera.K, size=(260, 190)))
    assert 0.3 < seen.mean() < 0.95
    np.testing.assert_array_equal(mask, np.where(seen, 255, 0))
    assert (rectified[~seen] == 0).all()


@pytest.mark.parametrize("interpolation", INTERPOLATIONS)
def test_photo_in_strips_is_the_photo_in_one_remap(interpolation, rng):
    camera, photo = make_camera(LENS), smooth_photo(rng, 3, np.uint16)
    rectified, mask = rectify(photo, camera, MOTION, interpolation=interpolation)
    flag, border = INTERPOLATIONS[interpolation], cv2.BORDER_REPLICATE
    maps = np.empty((2, H, W), np.float32)
    coarse_grid(camera, MOTION, "rotation", rectified_rays(None, None, camera), (W, H)).fill(0, *maps, mask.copy())
    whole = cv2.remap(photo, *maps, flag, borderMode=border)
    assert (mask > 0).mean() > 0.8
    np.testing.assert_array_equal(rectified[mask > 0], whole[mask > 0])


def test_result_does_not_depend_on_jobs(rng):
    camera, photo = make_camera(LENS, "left-to-right"), smooth_photo(rng, 3, np.uint8)
    one = rectify(photo, camera, MOTION)
    for jobs in (2, 5):
        for found, expected in zip(rectify(photo, camera, MOTION, jobs=jobs), one, strict=True):
            np.testing.assert_array_equal(found, expected)


def test_wrong_photos_and_cameras_are_refused_by_name():
    camera = make_camera()
    for photo in (
        np.zeros((H, W)),
        np.zeros((H, W), np.int32),
        np.zeros((H, W, 3, 1), np.uint8),
        np.zeros(H, np.uint8),
    ):
        with pytest.raises(InputError, match=r"photo is .*expected uint8, uint16 or float32 \(h, w\[, channels\]\)"):
            rectify(photo, camera)
    with pytest.raises(InputError, match="photo has 160x200 pixels, its camera 200x160"):
        rectify(np.zeros((W, H), np.uint8), camera)
    with pytest.raises(InputError, match="interpolation='area', expected one of nearest, linear, cubic"):
        rectify(np.zeros((H, W), np.uint8), camera, interpolation="area")
    with pytest.raises(InputError, match="new_camera has lens distortion"):
        rectify(np.zeros((H, W), np.uint8), camera, new_camera=make_camera(LENS))
    with pytest.raises(InputError, match="R holds a matrix that is no rotation"):
        init_rectify_map(camera, R=2 * np.eye(3))
    with pytest.raises(InputError, match="new_K is singular"):
        init_rectify_map(camera, new_K=np.zeros((3, 3)))
    with pytest.raises(InputError, match="P is singular"):
        undistort_points(np.zeros((1, 2)), camera, P=np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"P.shape=\(3, 5\), expected \(3, 3\)"):
        undistort_points(np.zeros((1, 2)), camera, P=np.zeros((3, 5)))
    with pytest.raises(InputError, match=r"size\[0\]=0, expected a positive"):
        init_rectify_map(camera, size=(0, 5))


def test_projection_matrices_are_those_of_opencv():
    camera, xy = make_camera(LENS), np.array([[10.0, 20.0], [120.0, 130.0]])
    P = np.column_stack([camera.K, [7.0, 8.0, 9.0]])
    found = undistort_points(xy, camera, P=P)
    np.testing.assert_allclose(found, cv2.undistortPoints(xy, camera.K, camera.dist, P=P)[:, 0], atol=1e-3)
    np.testing.assert_allclose(distort_points(found, camera, P=P), xy, atol=1e-9)


motions = pytest.mark.parametrize("motion", [MOTION, STRONG, RowMotion(-STRONG.phi)], ids=["some", "strong", "back"])


@motions
@with_and_without_lens
@all_directions
def test_alpha_0_leaves_no_empty_pixel(readout, dist, motion):
    camera = make_camera(dist, readout)
    for size in (None, (150, 150)):
        new_camera, roi = optimal_new_camera(camera, motion, alpha=0.0, size=size)
        assert (new_camera.width, new_camera.height) == (size or (W, H))
        assert not new_camera.dist.any()
        assert new_camera.readout == readout
        _, mask = rectify(np.zeros((H, W), np.uint8), camera, motion, new_camera=new_camera)
        assert (mask == 255).all()
        assert roi == (0, 0, new_camera.width, new_camera.height)


@motions
@with_and_without_lens
@all_directions
def test_alpha_1_keeps_every_raw_pixel(readout, dist, motion):
    camera = make_camera(dist, readout)
    new_camera, (x, y, w, h) = optimal_new_camera(camera, motion, alpha=1.0)
    kept = undistort_points(pixel_grid(W, H), camera, motion, P=new_camera.K)
    assert kept.min() >= -1e-9  # px; the extreme border pixel lies on the edge, to rounding
    assert (kept.max(0) <= np.array([W - 1, H - 1]) + 1e-9).all()
    _, mask = rectify(np.zeros((H, W), np.uint8), camera, motion, new_camera=new_camera)
    assert (mask == 0).any()
    assert (mask[y : y + h, x : x + w] == 255).all()
    assert w * h > 0.3 * W * H


def test_alpha_between_grows_the_view_and_keeps_the_shape_of_pixels():
    camera = make_camera(LENS)
    focal, area = [], []
    for alpha in (0.0, 0.3, 0.7, 1.0):
        new_camera, (x, y, w, h) = optimal_new_camera(camera, MOTION, alpha=alpha)
        assert new_camera.K[0, 0] / new_camera.K[1, 1] == pytest.approx(K[0, 0] / K[1, 1], rel=1e-12)  # rounding
        _, mask = rectify(np.zeros((H, W), np.uint8), camera, MOTION, new_camera=new_camera)
        assert (mask[y : y + h, x : x + w] == 255).all()
        focal.append(new_camera.K[0, 0])
        area.append(w * h)
    assert (np.diff(focal) < 0).all()
    assert (np.diff(area) < 0).all()


def test_without_lens_and_motion_the_best_new_camera_is_the_old_one():
    for alpha in (0.0, 0.5, 1.0):
        new_camera, roi = optimal_new_camera(make_camera(), alpha=alpha)
        np.testing.assert_allclose(new_camera.K, K, rtol=0, atol=1e-9)  # rounding
        assert roi == (0, 0, W, H)


@pytest.mark.parametrize("alpha", [-0.01, 1.01, float("nan")])
def test_alpha_out_of_range_is_refused(alpha):
    with pytest.raises(InputError, match=r"alpha=.*expected a number from 0 to 1"):
        optimal_new_camera(make_camera(), alpha=alpha)


def test_lens_that_does_not_reach_the_border_is_refused():
    with pytest.raises(InputError, match="check dist and phi"):
        optimal_new_camera(Camera(W, H, K, [-1.5, 0, 0, 0]))


@all_directions
def test_largest_shift_is_that_of_the_farthest_pixel(readout):
    camera = make_camera(LENS, readout)
    raw = pixel_grid(W, H)
    still = distort_points(undistort_points(raw, camera, MOTION), camera)
    longest = np.linalg.norm(still - raw, axis=1).max()
    shift = largest_shift_px(camera, MOTION)
    assert longest > 3
    # found on a grid of 6 px; the shift is smooth, and largest at a border, which the grid holds
    assert 0.99 * longest <= shift <= longest * (1 + 1e-12)
    assert largest_shift_px(camera, RowMotion()) < 1e-9


@with_and_without_lens
@all_directions
def test_warp_of_a_bent_motion_rotates_each_line_by_itself(readout, dist, rng):
    camera, original = make_camera(dist, readout), smooth_photo(rng)
    bend = Bend(*camera.clock_range, rng.normal(size=(9, 3)) * 0.01)
    warped, mask = warp_photo(original, camera, RowMotion(MOTION.phi, bend=bend))
    axis, sign = READOUTS[readout]
    for line in (0, 7, H // 2, H - 1):
        # the photo of a camera that had the line's rotation all the time shows the line as it is
        clock = sign * (line - camera.K[axis, 2]) / camera.K[axis, axis]
        turn = clock * MOTION.phi + CubicSpline(bend.clock, bend.rotation)(clock)
        still, still_mask = warp_photo(original, camera, turn / clock)
        at = np.s_[line] if axis == 1 else np.s_[:, line]
        np.testing.assert_array_equal(mask[at], still_mask[at])
        np.testing.assert_allclose(warped[at], still[at], atol=1e-5)
    rectified, seen = rectify(warped, camera, RowMotion(MOTION.phi, bend=bend))
    steady, _ = rectify(warped, camera, MOTION)
    target = original if not dist else cv2.remap(original, *opencv_map(dist, np.eye(3), K, (W, H)), cv2.INTER_CUBIC)
    known, _ = rectify(mask, camera, RowMotion(MOTION.phi, bend=bend), interpolation="nearest")
    valid = cv2.erode(np.minimum(seen, known), np.ones((7, 7), np.uint8), borderValue=0) > 0
    error, without = (np.sqrt(np.mean((image - target)[valid] ** 2)) for image in (rectified, steady))
    assert error < 10 ** (-45 / 20)  # photos in 0 to 1; bicubic at 1/32 px twice, as of steady motions
    assert without > 3 * error


@with_and_without_lens
@all_directions
@pytest.mark.parametrize("motion", [MOTION, STRONG], ids=["some", "strong"])
def test_warped_photo_is_rectified_back_to_the_original(motion, readout, dist, rng):
    camera, original = make_camera(dist, readout), smooth_photo(rng)
    raw, raw_mask = warp_photo(original, camera, np.array(motion.phi))
    rectified, mask = rectify(raw, camera, motion)
    target = original
    if dist:  # rectified photos have no lens
        maps = opencv_map(dist, np.eye(3), K, (W, H))
        target = cv2.remap(original, *maps, cv2.INTER_CUBIC)
    known, _ = rectify(raw_mask, camera, motion, interpolation="nearest")  # the warp repeats its border
    valid = cv2.erode(np.minimum(mask, known), np.ones((7, 7), np.uint8), borderValue=0) > 0
    assert valid.mean() > 0.6

    def psnr(image):
        return -10 * np.log10(np.mean((image - target)[valid] ** 2))

    # photos of a smooth scene in 0 to 1: bicubic at 1/32 px twice leaves 50 to 60 dB
    assert psnr(rectified) >= 45
    assert psnr(raw) < 35  # there was something to take out
    wrong, _ = rectify(raw, camera, RowMotion(-motion.phi))
    assert psnr(wrong) < psnr(raw)
