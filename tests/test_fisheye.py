"""The fisheye from end to end: the truth's own inverse, what COLMAP gets to see, a photo rectified, a run."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from make_photos import COURTYARD

from rsundistort import (
    Camera,
    RowMotion,
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
