"""Matches and new tracks of a camera that travelled while its photos were read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matched_scene import matched_scene

from rsundistort import Camera, Observations, Reconstruction, RowMotion, project_points
from rsundistort.colmap.conventions import HALF
from rsundistort.model.reprojection import reprojection_residuals
from rsundistort.sfm import retriangulate
from rsundistort.sfm.database import ideal_keypoints
from rsundistort.sfm.epipolar import FreedMatches, read_matches
from rsundistort.sfm.scale_breaks import photos_beside_breaks

CAMERA = Camera(1200, 900, [[1000, 0, 600], [0, 1000, 450], [0, 0, 1]])
PHOTOS, NOISE_PX = 6, 0.2


@pytest.fixture
def scene(rng):
    """Photos along a wall, of a camera that rotates and travels by 5 % of the depth, and what they show with noise."""
    points_w = rng.uniform([-6, -2, 4], [6, 2, 9], (1200, 3))
    center_w = np.column_stack([np.linspace(-2, 2, PHOTOS), *rng.normal(0, 0.2, (2, PHOTOS))])
    phi = rng.normal(0, 0.02, (PHOTOS, 3)) / CAMERA.frame_span
    velocity = rng.normal(0, 0.3, (PHOTOS, 3)) / CAMERA.frame_span
    frame, point, xy = [], [], []
    for i in range(PHOTOS):
        motion = RowMotion(phi[i], velocity[i])
        uv, valid = project_points(points_w - center_w[i], CAMERA, motion, "constant-motion")
        seen = np.flatnonzero(valid & (np.abs(uv - [600, 450]) < [600, 450]).all(1))
        frame.append(np.full(len(seen), i))
        point.append(seen)
        xy.append(uv[seen] + rng.normal(0, NOISE_PX, (len(seen), 2)))
    observed = Observations(np.concatenate(frame), np.concatenate(point), np.concatenate(xy))
    names, R_cw = [f"{i}.jpg" for i in range(PHOTOS)], np.tile(np.eye(3), (PHOTOS, 1, 1))
    return Reconstruction(
        [CAMERA], names, np.zeros(PHOTOS, int), R_cw, center_w, points_w, observed, phi, velocity,
        shutter_model="constant-motion",
    )  # fmt: skip


@pytest.fixture
def matched(scene, rng, tmp_path):
    return matched_scene(scene, rng, tmp_path / "database.db", share_wrong=0.1)


def share_explained(matched, scene):
    matches, freed = read_matches(matched), FreedMatches(matched, scene)
    fits = [freed.explained(*pair, rows) for pair, rows in matches.items()]
    return np.concatenate(fits).mean()


def test_matches_fit_where_the_camera_was_when_it_read_them(scene, matched):
    assert share_explained(matched, scene) > 0.88  # a tenth is wrong
    assert share_explained(matched, replace(scene, velocity=np.zeros_like(scene.velocity))) < 0.5


def test_keypoints_are_where_the_reference_pose_sees_them(scene, matched):
    freed = FreedMatches(matched, scene)
    # of the wrong ones few are left
    right = {pair: rows[freed.explained(*pair, rows)] for pair, rows in read_matches(matched).items()}
    depths, rows = freed.depths(right), scene.observations.by_photo(PHOTOS)
    for i, found in enumerate(matched.features):
        motion = scene.motion(i).in_camera(scene.R_cw[i])
        uv = ideal_keypoints(found, CAMERA, motion, "constant-motion", None, depths[i]) - HALF
        points = scene.points_w[scene.observations.point_idx[rows[i]]] - scene.center_w[i]
        seen = points @ CAMERA.K.T
        off = np.linalg.norm(uv - seen[:, :2] / seen[:, 2:], axis=1)
        assert np.median(off[np.isfinite(depths[i])]) < 2 * NOISE_PX
        at_infinity = ideal_keypoints(found, CAMERA, motion, "constant-motion") - HALF
        assert np.median(np.linalg.norm(at_infinity - seen[:, :2] / seen[:, 2:], axis=1)) > 5.0


def test_new_tracks_are_whole_and_have_no_breaks(scene, matched):
    tracks = retriangulate(matched, scene)
    assert len(tracks.observations) > 0.8 * len(scene.observations)
    residuals, valid = reprojection_residuals(tracks)
    assert np.median(np.linalg.norm(residuals[valid], axis=1)) < 3 * NOISE_PX
    assert not photos_beside_breaks(matched, tracks).any()


def test_a_camera_that_did_not_travel_needs_no_depths(scene, matched):
    still = replace(scene, velocity=np.zeros_like(scene.velocity))
    assert FreedMatches(matched, still).depths(read_matches(matched)) == {}
