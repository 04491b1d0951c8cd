"""Relative poses of photos with a shutter: derivatives, exactness, wrong matches; none where there is none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RowMotion, project_points
from rsundistort._kernels import epipolar as kernels
from rsundistort.sfm.relative_pose import (
    NO_SHUTTER,
    Pair,
    RelativePose,
    View,
    _across,
    _poses_for_mapping,
    best_relative_pose,
    find_relative_pose,
    relative_poses,
)

CAMERAS = {
    "rows": Camera(1200, 900, [[1000, 0, 600], [0, 1000, 450], [0, 0, 1]], [-0.1, 0.02, 0, 0]),
    "columns": Camera(1200, 900, [[1000, 0, 600], [0, 1010, 450], [0, 0, 1]], readout="right-to-left"),
    "fisheye": Camera(1200, 900, [[700, 0, 600], [0, 700, 450], [0, 0, 1]], [0.02, 0, 0, 0], lens="fisheye"),
}
R_21, T_21 = Rotation.from_euler("xyz", [3, -8, 2], degrees=True).as_matrix(), np.array([-0.96, 0.05, 0.28])


def rotated_deg(R_a, R_b):
    return np.degrees(Rotation.from_matrix(R_a @ R_b.T).magnitude())


def between_deg(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def matches(rng, camera, phi, noise_px=0.0, count=400):
    """Points of a scene 4 to 9 baselines away as both photos show them, (2, n, 2) pixels."""
    while True:
        points = rng.uniform([-5, -4, 4], [5, 4, 9], (20 * count, 3))
        shown = [
            project_points(each, camera, RowMotion(each_phi))
            for each, each_phi in ((points, phi[0]), (points @ R_21.T + T_21, phi[1]))
        ]
        inside = [valid & (np.abs(xy - [600, 450]) < [600, 450]).all(1) for xy, valid in shown]
        seen = np.flatnonzero(inside[0] & inside[1])[:count]
        if len(seen) >= count // 2:
            return np.array([xy[seen] for xy, _ in shown]) + rng.normal(0, noise_px or 1e-12, (2, len(seen), 2))


def pair_of(xy, camera):
    return Pair(View.of(xy[0], camera), View.of(xy[1], camera))


@pytest.mark.parametrize("kind", CAMERAS)
def test_distances_vanish_at_the_truth(rng, kind):
    camera = CAMERAS[kind]
    phi = rng.normal(0, 0.2, (2, 3)) / camera.frame_span
    pair = pair_of(matches(rng, camera, phi), camera)
    assert RelativePose(R_21, T_21, phi).distances_px(pair).max() < 1e-6
    assert np.median(RelativePose(R_21, T_21, 0 * phi).distances_px(pair)) > 3.0


def test_distance_without_a_shutter_is_sampson_s_of_opencv(rng):
    camera = Camera(1200, 900, [[1000, 0, 600], [0, 1000, 450], [0, 0, 1]])
    xy = matches(rng, camera, np.zeros((2, 3)), noise_px=2.0)
    found = RelativePose(R_21, T_21, np.zeros((2, 3))).distances_px(pair_of(xy, camera))
    cross = np.array([[0, -T_21[2], T_21[1]], [T_21[2], 0, -T_21[0]], [-T_21[1], T_21[0], 0]])
    K_inverse = np.linalg.inv(camera.K)
    F = K_inverse.T @ cross @ R_21 @ K_inverse
    expected = [np.sqrt(cv2.sampsonDistance(np.append(a, 1.0), np.append(b, 1.0), F)) for a, b in zip(*xy, strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("kind", CAMERAS)
def test_gradient_is_that_of_the_residuals(rng, kind):
    camera = CAMERAS[kind]
    phi = rng.normal(0, 0.2, (2, 3)) / camera.frame_span
    pair = pair_of(matches(rng, camera, phi, noise_px=1.0, count=60), camera)
    t, across = T_21 / np.linalg.norm(T_21), _across(T_21 / np.linalg.norm(T_21))
    H, g = np.empty((11, 11)), np.empty(11)
    # a wide loss: squares; the signed distances' products with their derivatives are the gradient
    kernels.pair_system(*pair.arrays, R_21, t, across, phi[0], phi[1], 1e9, H, g)
    start, numeric = np.empty(len(pair.first.clock)), np.empty(11)
    kernels.sampson(*pair.arrays, R_21, t, phi[0], phi[1], start)
    for k in range(11):
        both = []
        for step in (1e-6, -1e-6):
            d = np.zeros(11)
            d[k] = step
            found = np.empty_like(start)
            R = Rotation.from_rotvec(d[:3]).as_matrix() @ R_21
            kernels.sampson(*pair.arrays, R, t + d[3:5] @ across, phi[0] + d[5:8], phi[1] + d[8:], found)
            both.append(found)
        numeric[k] = ((both[0] - both[1]) / 2e-6) @ start
    # denominators count as constants, and L is to first order: both are of the order of the residuals or of phi^2
    np.testing.assert_allclose(g, numeric, rtol=0.05, atol=0.02 * np.abs(numeric).max())


@pytest.mark.parametrize("share_wrong", [0.0, 0.3])
def test_a_strong_shutter_is_found_with_the_pose(rng, share_wrong):
    camera = CAMERAS["rows"]
    errors, without = [], []
    for _ in range(6):
        phi = rng.normal(0, 0.1, (2, 3)) / camera.frame_span
        xy = matches(rng, camera, phi, noise_px=0.5)
        wrong = rng.uniform(size=xy.shape[1]) < share_wrong
        xy[1, wrong] = rng.uniform([0, 0], [1200, 900], (wrong.sum(), 2))
        pair = pair_of(xy, camera)
        for sigma, found in ((0.1, errors), (1e-4, without)):
            pose = find_relative_pose(pair, sigma)
            found.append(max(rotated_deg(pose.R_21, R_21), between_deg(pose.t_21, T_21)))
    assert np.median(errors) < 0.5 * np.median(without)


def test_photos_without_a_shutter_get_none(rng):
    camera = CAMERAS["rows"]
    pairs = [pair_of(matches(rng, camera, np.zeros((2, 3)), noise_px=0.5), camera) for _ in range(5)]
    poses, spread = relative_poses(pairs)
    assert spread < 5e-3
    for pose in poses:
        assert rotated_deg(pose.R_21, R_21) < 0.2
        assert between_deg(pose.t_21, T_21) < 1.0


@pytest.mark.parametrize("noise_px", [0.5, 2.0])
def test_photos_without_a_shutter_are_posed_as_well_as_by_pycolmap(rng, noise_px):
    # a long lens has other minima, and a fixed width of the loss would waste noisy matches; 30 pairs show 0.02 or so
    camera = Camera(1200, 900, [[4000, 0, 600], [0, 4000, 450], [0, 0, 1]])
    ours, theirs = [], []
    for _ in range(30):
        points = np.column_stack(
            [rng.uniform([-1.3, -1], [1.3, 1], (300, 2)), rng.normal(10, 0.15 + noise_px / 3, 300)]
        )
        R = Rotation.from_rotvec(np.radians(12) * unit(rng.normal(size=3) * [1, 1, 0.3])).as_matrix()
        t = np.array([0, 0, 10]) - R[:, 2] * 10 + rng.normal(0, 0.1, 3)
        xy = [project_points(each, camera, RowMotion())[0] for each in (points, points @ R.T + t)]
        pair = pair_of(xy + rng.normal(0, noise_px, (2, 300, 2)), camera)
        for pose, errors in ((best_relative_pose(pair, NO_SHUTTER), ours), (_poses_for_mapping(pair)[0], theirs)):
            errors.append(max(rotated_deg(pose.R_21, R), between_deg(pose.t_21, t)))
    assert within_five_degrees(ours) > within_five_degrees(theirs) - 0.03


def unit(a):
    return a / np.linalg.norm(a)


def within_five_degrees(errors):
    """Area under the curve of the share of pairs within an error."""
    return np.mean(np.maximum(5 - np.array(errors), 0)) / 5


def test_the_spread_of_the_motions_is_found(rng):
    camera = CAMERAS["rows"]
    pairs = [
        pair_of(matches(rng, camera, rng.normal(0, 0.1, (2, 3)) / camera.frame_span, noise_px=0.5), camera)
        for _ in range(8)
    ]
    _, spread = relative_poses(pairs)
    assert 0.05 < spread < 0.2


def test_too_few_matches_have_no_pose(rng):
    camera = CAMERAS["rows"]
    xy = matches(rng, camera, np.zeros((2, 3)))[:, :10]
    assert find_relative_pose(pair_of(xy, camera), 0.1) is None
    assert relative_poses([pair_of(xy, camera)])[0] == [None]
