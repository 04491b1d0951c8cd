"""Errors of poses, motions and images: against errors that were put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RowMotion, Solution, SolvedImage
from rsundistort.errors import InputError
from rsundistort.evaluation import motion_errors, pose_errors, psnr

CAMERA = Camera(640, 480, [[500, 0, 320], [0, 400, 240], [0, 0, 1]])


def make_solution(R_cw, center_w, phi=None, camera=CAMERA):
    motions = [RowMotion(p) for p in (np.zeros((len(R_cw), 3)) if phi is None else phi)]
    images = [
        SolvedImage(f"{i}.jpg", "1", R, c, motion)
        for i, (R, c, motion) in enumerate(zip(R_cw, center_w, motions, strict=True))
    ]
    return Solution("rotation", {"1": camera}, {"1": camera}, images)


def draw_poses(rng, n):
    return Rotation.random(n, rng=rng).as_matrix(), rng.normal(size=(n, 3))


@pytest.mark.parametrize("num_images", [3, 4, 20])
def test_similarity_of_the_world_is_no_error(num_images, rng):
    R, C = draw_poses(rng, num_images)
    A, scale, shift = Rotation.random(rng=rng).as_matrix(), 0.2, np.array([3.0, 4, -50])
    errors = pose_errors(make_solution(R @ A.T, scale * C @ A.T + shift), make_solution(R, C))
    assert errors.names == tuple(f"{i}.jpg" for i in range(num_images))
    # rounding of centres 250 times the scene's size away, and of rotations
    assert errors.rotation_deg.max() < 1e-12
    assert errors.center.max() < 1e-12


def test_mirrored_world_is_an_error(rng):
    R, C = draw_poses(rng, 12)
    assert pose_errors(make_solution(R, C * [1, 1, -1]), make_solution(R, C)).center.max() > 0.1


def test_known_rotation_errors_are_recovered(rng):
    R, C = draw_poses(rng, 8)
    R, C = np.repeat(R, 2, axis=0), np.repeat(C, 2, axis=0) + 0.1 * rng.normal(size=(16, 3))
    # each orientation twice, rotated there and back: no common rotation can lower the errors
    angles = np.repeat(np.radians([1e-7, 1e-4, 0.01, 0.1, 1, 5, 20, 60]), 2)
    axes = np.repeat(rng.normal(size=(8, 3)), 2, axis=0)
    axes *= (-1.0) ** np.arange(16)[:, None] / np.linalg.norm(axes, axis=1, keepdims=True)
    A = Rotation.random(rng=rng).as_matrix()
    turned = Rotation.from_rotvec(angles[:, None] * axes).as_matrix() @ R
    errors = pose_errors(make_solution(turned @ A.T, C @ A.T), make_solution(R, C))
    # degrees; rounding, also for the smallest, where an arc cosine would give 0 or 1e-6
    np.testing.assert_allclose(errors.rotation_deg, np.degrees(angles), rtol=0, atol=1e-12)
    assert errors.center.max() < 1e-12


def test_known_centre_errors_are_recovered_in_steps_of_the_truth():
    # corners of a square, one pair of opposite ones pulled out and one pushed in: the best similarity is none
    C = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    pulled = C * [1.1, 0.9, 1]
    R = np.tile(np.eye(3), (4, 1, 1))
    errors = pose_errors(make_solution(R, 5 * pulled), make_solution(R, C))
    # the scale that fits best: <pulled, C> / <pulled, pulled> = 4 / 4.04 = 1 / 1.01
    expected = np.abs(np.array([1.1, 0.9, 1.1, 0.9]) / 1.01 - 1) / np.sqrt(2)  # steps are sqrt(2) long
    np.testing.assert_allclose(errors.center, expected, rtol=1e-12)  # rounding
    assert errors.rotation_deg.max() < 1e-12


def test_position_errors_are_undefined_where_all_cameras_are_in_one_place(rng):
    R, C = draw_poses(rng, 4)
    assert np.isnan(pose_errors(make_solution(R, C), make_solution(R, np.ones((4, 3)))).center).all()


def test_only_photos_with_poses_on_both_sides_count(rng):
    R, C = draw_poses(rng, 6)
    truth, solution = make_solution(R, C), make_solution(R, C)
    lost = SolvedImage("1.jpg", "1", reason="too few matches")
    moved = SolvedImage("2.jpg", "1", motion=RowMotion())
    some = replace(solution, images=[solution.images[0], lost, moved, *solution.images[3:]][::-1])
    assert pose_errors(some, truth).names == ("5.jpg", "4.jpg", "3.jpg", "0.jpg")
    assert motion_errors(some, truth).names == ("5.jpg", "4.jpg", "3.jpg", "2.jpg", "0.jpg")
    few = replace(solution, images=solution.images[:2])
    with pytest.raises(InputError, match="2 photos have a pose in both solution and truth; need at least three"):
        pose_errors(few, truth)


@pytest.mark.parametrize(("readout", "span"), [("top-to-bottom", 480 / 400), ("right-to-left", 640 / 500)])
def test_motion_errors_are_in_radians_per_frame(readout, span, rng):
    R, C = draw_poses(rng, 4)
    camera = Camera(640, 480, CAMERA.K, readout=readout)
    phi, error = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    errors = motion_errors(make_solution(R, C, phi + error, camera), make_solution(R, C, phi, camera))
    np.testing.assert_allclose(errors.phi_rad_per_frame, error * span, rtol=0, atol=1e-14)  # rounding
    # a camera of another focal length has another clock: the same rotation over a frame is no error
    wider = Camera(640, 480, np.diag([0.5, 0.5, 1]) @ CAMERA.K, readout=readout)
    none = motion_errors(make_solution(R, C, phi, camera), make_solution(R, C, phi / 2, wider))
    np.testing.assert_allclose(none.phi_rad_per_frame, 0, atol=1e-14)  # rounding
    with pytest.raises(InputError, match="no photo has a motion"):
        motion_errors(replace(make_solution(R, C), images=[]), make_solution(R, C))


@pytest.mark.parametrize(
    ("dtype", "offset", "expected"),
    [
        (np.uint8, 5, 20 * np.log10(255 / 5)),
        (np.uint16, 5, 20 * np.log10(65535 / 5)),
        (np.float32, 0.125, 20 * np.log10(8)),
        (np.float64, 0.01, 40.0),
    ],
)
@pytest.mark.parametrize("shape", [(40, 50), (40, 50, 3)], ids=["grey", "colour"])
def test_psnr_of_a_constant_difference_is_its_closed_form(shape, dtype, offset, expected, rng):
    peak = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
    truth = (rng.uniform(0, 0.8, shape) * peak).astype(dtype)
    image = (truth + np.array(offset, dtype)).astype(dtype)
    # both ways, where unsigned numbers would wrap; float32 rounds sums at 1e-7
    assert psnr(image, truth) == pytest.approx(expected, abs=1e-5)
    assert psnr(truth, image) == pytest.approx(expected, abs=1e-5)
    assert psnr(truth, truth) == np.inf


def test_psnr_counts_neither_the_mask_nor_the_margin_around_it():
    truth = np.zeros((40, 60), np.uint8)
    mask = np.full((40, 60), 255, np.uint8)
    mask[10:20, 30:40] = 0
    border = np.ones((40, 60), bool)
    border[2:-2, 2:-2] = False
    hole = np.zeros((40, 60), bool)
    hole[8:22, 28:42] = True
    image = np.where(border | hole, 200, 0).astype(np.uint8)
    assert psnr(image, truth, mask) == np.inf  # nothing within two pixels of an invalid one counts
    assert psnr(image, truth, mask, margin_px=1) < 30
    image[2, 2] = image[22, 30] = 200  # the first pixels that do count
    counted = (40 - 4) * (60 - 4) - 14 * 14
    assert psnr(image, truth, mask) == pytest.approx(10 * np.log10(255**2 / (2 * 200**2 / counted)), rel=1e-12)
    assert psnr(image, truth, mask, margin_px=3) == np.inf
    assert np.isnan(psnr(image, truth, np.zeros_like(mask)))
    corner = np.zeros_like(truth)
    corner[0, 0] = 255
    assert psnr(corner, truth, margin_px=0) == pytest.approx(10 * np.log10(40 * 60), rel=1e-12)


@pytest.mark.parametrize("odd", [np.zeros((4, 5), np.int64), np.zeros((4, 5), np.int8), np.full((4, 5), np.inf)])
def test_images_without_a_known_peak_are_refused(odd):
    with pytest.raises(InputError, match=r"expected uint8, uint16 or float in 0 to 1|NaN or infinity"):
        psnr(odd, odd)


def test_images_that_do_not_compare_are_refused():
    image = np.zeros((4, 5), np.uint8)
    for truth in (np.zeros((5, 4), np.uint8), np.zeros((4, 5), np.uint16), np.zeros((4, 5, 3), np.uint8)):
        with pytest.raises(InputError, match="do not compare"):
            psnr(image, truth)
