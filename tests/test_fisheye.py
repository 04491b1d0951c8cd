"""The fisheye from end to end: the truth's own inverse, what COLMAP gets to see, a photo rectified, a run."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from make_photos import COURTYARD
from scipy.optimize import least_squares

from rsundistort import (
    Camera,
    RowMotion,
    RsUndistortWarning,
    RunOptions,
    SolveOptions,
    evaluate,
    optimal_new_camera,
    rectify,
    run,
    unproject_points,
)
from rsundistort.colmap.lenses import camera_to_colmap, refined_camera
from rsundistort.errors import InputError
from rsundistort.input.fisheyes import cameras_as_fisheyes
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.model.field import fisheye_apart_px
from rsundistort.model.projection import project_points
from rsundistort.sfm import Features
from rsundistort.sfm.database import ideal_keypoints
from rsundistort.simulate import SceneOptions, simulate_scene
from rsundistort.synthetic.lens import distort_rays, undistort_to_rays

K = np.array([[260.0, 0, 402], [0, 262, 297], [0, 0, 1]])
DIST = [0.05, -0.02, 0.01, -0.004]
CAMERA = Camera(800, 600, K, DIST, lens="fisheye")
BARREL = Camera(800, 600, [[600, 0, 402], [0, 602, 297], [0, 0, 1]], [-0.1, 0, 0, 0])


def test_inverse_lens_of_the_truth_is_opencvs(rng):
    uv = rng.uniform([0, 0], [799, 599], (500, 2))
    uv[0] = K[:2, 2]
    rays = undistort_to_rays(uv, CAMERA)
    known = np.isfinite(rays).all(1)
    # px; at 1.5 rad a pixel is 1/260 rad, and its tangent good to 1e-16 * 14
    np.testing.assert_allclose(distort_rays(np.column_stack([rays, np.ones(500)])[known], CAMERA), uv[known], atol=1e-9)
    np.testing.assert_array_equal(rays[0], [0, 0])
    # OpenCV takes radii above pi/2 for pi/2
    near = np.linalg.norm((uv - K[:2, 2]) / np.diag(K)[:2], axis=1) < 1.57
    assert near.mean() > 0.9
    tight = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    theirs = cv2.fisheye.undistortPoints(uv[near, None], K, np.array(DIST), criteria=tight)[:, 0]
    np.testing.assert_allclose(rays[near], theirs, rtol=1e-9, atol=1e-12)


def test_truth_sees_nothing_beyond_the_side_and_beyond_the_fold():
    around = np.array([[1.0, 0], [0, -1], [0.6, 0.8]])
    for dist, last in (([], np.pi / 2), ([-0.3, 0, 0, 0], 0.7027)):  # a (1 - 0.3 a^2) turns back at a = 1.054
        camera = Camera(10, 10, np.eye(3), dist, lens="fisheye")
        assert np.isfinite(undistort_to_rays(0.999 * last * around, camera)).all()
        assert np.isnan(undistort_to_rays(1.001 * last * around, camera)).all()


@pytest.mark.parametrize("camera", [CAMERA, BARREL], ids=["fisheye", "pinhole"])
def test_colmap_sees_the_rays_of_the_keypoints(camera, rng):
    motion = RowMotion([0.05, -0.03, 0.04])
    xy = rng.uniform([100, 50], [700, 550], (50, 2))
    features = Features(np.vstack([xy, [[-2000.0, 300.0]]]), np.ones(51), np.zeros((51, 128), np.uint8))
    keypoints = ideal_keypoints(features, camera, motion, "rotation")
    theirs = camera_to_colmap(camera, True, 1).cam_from_img(keypoints.astype(float)[:50])
    ideal, valid = unproject_points(xy, camera, motion)
    assert valid.all()
    # float32 of some hundred pixels, over the focal length, and the tangent's slope of up to 30 at 80 degrees
    angles = [np.arctan(np.linalg.norm(rays, axis=1)) for rays in (theirs, ideal)]
    np.testing.assert_allclose(*angles, atol=1e-6)
    np.testing.assert_allclose(np.arctan2(*theirs.T), np.arctan2(*ideal.T), atol=1e-5)
    assert (keypoints[50] < -9000).all()  # the ray that does not exist


@pytest.mark.parametrize("lens", ["fisheye", "pinhole"])
def test_colmap_refines_the_lens_that_a_camera_has(lens, rng):
    K_round = [[260.0, 0, 402], [0, 260, 297], [0, 0, 1]]
    camera = Camera(800, 600, K_round, [0.04, 0, 0, 0], "left-to-right", lens)
    guessed = camera_to_colmap(camera, False, 1)
    assert refined_camera(guessed, camera) == camera
    points = rng.uniform([-1, -1, 1], [1, 1, 2], (20, 3))
    theirs = [guessed.img_from_cam(point) - 0.5 for point in points]
    np.testing.assert_allclose(project_points(points, camera)[0], theirs, atol=1e-9)


def test_what_a_pinhole_photo_cannot_show_is_no_camera_and_no_pixel(rng):
    photo = np.full((600, 800), 200, np.uint8)
    wide = Camera(800, 600, K, lens="fisheye")  # its corners are beyond 90 degrees
    with pytest.raises(InputError, match="90 degrees or more from the axis"):
        optimal_new_camera(wide)
    rectified, mask = rectify(photo, wide)  # K and size kept: 57 degrees to the sides
    assert (mask == 255).all()
    assert (rectified == 200).all()
    narrow = Camera(400, 300, K - np.array([[0, 0, 200], [0, 0, 150], [0, 0, 0]]), lens="fisheye")
    for alpha in (0.0, 1.0):
        new, (x, y, w, h) = optimal_new_camera(narrow, alpha=alpha)
        _, mask = rectify(photo[:300, :400], narrow, new_camera=new)
        assert (mask[y : y + h, x : x + w] == 255).all()
        assert (mask == 255).all() == (alpha == 0)
    fisheye_out = Camera(800, 600, K, lens="fisheye")
    with pytest.raises(InputError, match="new_camera has lens distortion"):
        rectify(photo, CAMERA, new_camera=fisheye_out)


@pytest.mark.slow
def test_run_on_photos_of_a_fisheye(tmp_path):
    """A view of 135 degrees across, read by columns, from a camera that is 3 % off in f and knows nothing of k1 k2."""
    camera = {
        "width": 480, "height": 320, "K": [[200.0, 0, 243], [0, 200, 156.5], [0, 0, 1]], "dist": [0.03, -0.012, 0, 0],
        "lens": "fisheye",
    }  # fmt: skip
    recipe = json.loads((COURTYARD / "recipe.json").read_text())
    recipe["camera"] = {**camera, "readout": "left-to-right"}
    recipe["render"] |= {"samples": 8, "jpeg_quality": 98}
    (tmp_path / "recipe.json").write_text(json.dumps(recipe))
    simulate_scene(tmp_path / "recipe.json", tmp_path / "scene", SceneOptions(depth=False))
    guess = {**recipe["camera"], "K": [[206.0, 0, 243], [0, 206, 156.5], [0, 0, 1]], "dist": []}
    (tmp_path / "guess.json").write_text(json.dumps(guess))
    options = RunOptions(camera=str(tmp_path / "guess.json"), solve=SolveOptions(refine=("f", "k1", "k2")))
    solution = run(tmp_path / "scene" / "photos", tmp_path / "out", options)
    result = evaluate(tmp_path / "out", tmp_path / "scene" / "ground_truth.json")
    assert result.registered == 10
    assert result.rotation_deg.max < 0.1  # a third of a pixel
    assert result.phi_mrad_per_frame.mean < 1.5
    assert result.psnr_db.min > result.psnr_before_db.median + 8
    (found,) = solution.cameras.values()
    assert found.lens == "fisheye"
    assert found.K[0, 0] == pytest.approx(200, rel=5e-3)
    np.testing.assert_allclose(found.dist[:2], [0.03, -0.012], atol=5e-3)


@pytest.mark.parametrize(
    ("equivalent_mm", "width", "is_apart"), [(28, 4000, False), (24, 4000, False), (18, 1024, True), (15, 1024, True)]
)
def test_a_fisheye_is_no_pinhole_lens_where_the_view_is_wide(equivalent_mm, width, is_apart):
    size = np.array([width, 0.75 * width])
    f = equivalent_mm * np.hypot(*size) / 43.27
    K = [[f, 0, size[0] / 2 - 0.5], [0, f, size[1] / 2 - 0.5], [0, 0, 1]]
    assert (fisheye_apart_px(Camera(width, round(0.75 * width), K)) > 0.5) == is_apart


def test_pixels_by_which_a_fisheye_is_apart_are_those_of_a_lens_that_is_fitted():
    K = [[532.0, 0, 511.5], [0, 532.0, 383.5], [0, 0, 1]]
    wide = Camera(1024, 768, K, lens="fisheye")
    xy = np.stack(np.meshgrid(np.linspace(15, 1008, 33), np.linspace(11, 756, 33)), -1).reshape(-1, 2)
    rays = cv2.fisheye.undistortPoints(xy[None], wide.K, np.zeros(4))[0]

    def error_px(p):
        K = np.array([[p[0], 0, 511.5], [0, p[0], 383.5], [0, 0, 1]])
        dist = np.array([p[1], p[2], 0, 0, p[3]])
        return (
            cv2.projectPoints(np.c_[rays, np.ones(len(rays))], np.zeros(3), np.zeros(3), K, dist)[0][:, 0] - xy
        ).ravel()

    fitted = least_squares(error_px, [532.0, -0.3, 0.1, -0.01], x_scale=[100, 0.1, 0.1, 0.01])
    rms_px = np.sqrt((fitted.fun.reshape(-1, 2) ** 2).sum(1).mean())
    assert fisheye_apart_px(wide) == pytest.approx(rms_px, rel=0.05)


@pytest.mark.parametrize(
    ("f", "signs", "bends_px", "becomes_one"),
    [
        (460, (True, False), 0.0, True),  # nothing explains a view this wide
        (460, (False, True), 0.0, True),  # it needs a lens that varies
        (460, (False, False), 0.1, True),  # it needs a residual field
        (460, (False, False), 0.0, False),  # a pinhole lens explains it
        (900, (True, True), 3.0, False),  # a fisheye of so narrow a view is a pinhole lens
    ],
)
def test_cameras_that_no_file_describes_become_fisheyes(f, signs, bends_px, becomes_one):
    signs = dict(zip(("is_unexplained", "doubted"), signs, strict=True))
    K = np.array([[f, 0, 511.5], [0, f, 383.5], [0, 0, 1]])
    found = Camera(1024, 768, K + np.array([[1, 0, 2], [0, 1, -3], [0, 0, 0]]), [-0.25, 0.07, 0, 0, -0.01])
    if bends_px:
        field = bends_px * np.cos(np.pi * np.arange(8) / 7)[None, :, None] * np.ones((6, 1, 2))
        found = replace(found, field=field)
    guess = Camera(1024, 768, K, readout="bottom-to-top")
    cameras = PhotoCameras((guess,), ("hero",), np.zeros(9, int), False, (False,), "EXIF")
    other = cameras_as_fisheyes(cameras, [found], **signs)
    assert (other is not None) == becomes_one
    if other is not None:
        assert other[0].cameras == (Camera(1024, 768, found.K, readout="bottom-to-top", lens="fisheye"),)
        assert [each.split(":")[0] for each in other[1]] == [
            "no pinhole lens explains the photos of hero, and a fisheye does"
        ]
        assert cameras_as_fisheyes(other[0], other[0].cameras, **signs) is None  # it is one already
    assert cameras_as_fisheyes(replace(cameras, calibrated=True), [found], **signs) is None


def test_a_focal_length_that_is_not_known_is_no_longer_than_that_of_a_full_frame_fisheye():
    guess = Camera(1024, 768, [[760.0, 0, 511.5], [0, 760.0, 383.5], [0, 0, 1]])
    cameras = PhotoCameras((guess,), ("a",), np.zeros(9, int), False, (False,), "the photos")
    assert cameras_as_fisheyes(cameras, [guess], is_unexplained=True, doubted=False) is None
    unknown = replace(cameras, without_focal=(0,))
    assert cameras_as_fisheyes(unknown, [guess], is_unexplained=False, doubted=True) is None
    (found,) = cameras_as_fisheyes(unknown, [guess], is_unexplained=True, doubted=False)[0].cameras
    assert found.K[0, 0] == found.K[1, 1] == pytest.approx(1280 / np.pi)


@pytest.mark.slow
@pytest.mark.parametrize("moves", [True, False])
def test_photos_of_an_action_camera_that_nobody_described(tmp_path, moves):
    """A view of 127 degrees across, without a camera file: a pinhole lens, its field and a lens that varies miss it."""
    recipe = json.loads((COURTYARD / "recipe.json").read_text())
    recipe["camera"] |= {"K": [[432.0, 0, 486.5], [0, 432, 313.25], [0, 0, 1]], "dist": [0.02, -0.005, 0.001, -0.0005]}
    recipe["camera"]["lens"] = "fisheye"
    recipe["motion"]["sigma_rad_per_frame"] *= moves
    (tmp_path / "recipe.json").write_text(json.dumps(recipe))
    simulate_scene(tmp_path / "recipe.json", tmp_path / "scene", SceneOptions(depth=False))
    (tmp_path / "scene" / "camera.json").unlink()
    with pytest.warns(RsUndistortWarning, match="a fisheye does"):
        solution = run(tmp_path / "scene" / "photos", tmp_path / "out")
    (found,) = solution.cameras.values()
    assert found.lens == "fisheye"
    assert found.K[0, 0] == pytest.approx(432, rel=5e-4)
    assert evaluate(tmp_path / "out", tmp_path / "scene" / "ground_truth.json").rotation_deg.median < 0.02
    assert solution.verdict is not None
    assert solution.verdict["shutter"] == ("found" if moves else "not-found")
    assert solution.verdict["shape"] == "trusted"
