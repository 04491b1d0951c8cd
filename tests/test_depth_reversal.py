"""Scenes of a long lens with their depths reversed, against the scenes that they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, RowMotion, bundle_adjust, project_points
from rsundistort.solve.depth_reversal import choose_depths, with_depths_reversed
from rsundistort.solve.solutions import num_explained

# 34 degrees across
CAMERA = Camera(1200, 800, [[2000, 0, 600], [0, 2000, 400], [0, 0, 1]])
NOISE_PX = 0.12


def looking_at(center_w, target_w):
    ahead = (target_w - center_w) / np.linalg.norm(target_w - center_w)
    right = np.cross([0.1, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(ahead, right), ahead])


@pytest.fixture
def scene(rng):
    """Photos of a cloud of points from one side, rotated by a tenth of a radian a frame, at their true poses."""
    points_w = rng.uniform(-1, 1, (300, 3)) * [1.6, 1.0, 1.0] + [0, 0, 7]
    centers = np.column_stack([np.linspace(-2, 2, 6), rng.normal(0, 0.5, 6), rng.normal(0, 0.3, 6)])
    R_cw = np.array([looking_at(center, np.array([0, 0, 7.0])) for center in centers])
    phi = rng.normal(0, 0.1, (6, 3)) / CAMERA.frame_span
    parts = []
    for i in range(6):
        xy, valid = project_points((points_w - centers[i]) @ R_cw[i].T, CAMERA, RowMotion(phi[i]))
        seen = np.flatnonzero(valid & (np.abs(xy - [600, 400]) < [600, 400]).all(1))
        parts.append((np.full(len(seen), i), seen, xy[seen] + rng.normal(0, NOISE_PX, (len(seen), 2))))
    observations = Observations(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    rec = Reconstruction(
        [CAMERA], [f"{i}.jpg" for i in range(6)], np.zeros(6, int), R_cw, centers, points_w, observations, phi,
        shutter_model="rotation",
    )  # fmt: skip
    return rec.with_points(np.ones(len(observations), bool), min_track=3)


def test_parallel_rays_do_not_tell_depths_from_reversed_ones(scene):
    # from a thousand times as far, by a lens a thousand times as long
    middle = np.median(scene.points_w, axis=0)
    camera = Camera(1200, 800, [[2e6, 0, 600], [0, 2e6, 400], [0, 0, 1]])
    far = replace(scene, cameras=[camera], center_w=middle - 7000 * scene.R_cw[:, 2], phi=0 * scene.phi)
    other = with_depths_reversed(far)

    def seen(rec, i):
        return project_points((rec.points_w - rec.center_w[i]) @ rec.R_cw[i].T, camera, RowMotion())[0]

    for i in range(6):
        spread = np.ptp(seen(far, i), axis=0).max()
        assert np.abs(seen(far, i) - seen(other, i)).max() < 0.001 * spread
        assert np.linalg.det(other.R_cw[i]) == pytest.approx(1.0)
    depths = [((rec.points_w - rec.center_w[0]) @ rec.R_cw[0].T)[:, 2] for rec in (far, other)]
    assert np.corrcoef(depths)[0, 1] == pytest.approx(-1.0)


def test_reversing_twice_changes_nothing(scene):
    twice = with_depths_reversed(with_depths_reversed(scene))
    np.testing.assert_allclose(twice.R_cw, scene.R_cw, atol=1e-12)
    shapes = [rec.points_w - rec.points_w.mean(0) for rec in (twice, scene)]
    np.testing.assert_allclose(*shapes, atol=1e-9)


def test_depths_that_explain_more_are_kept(scene):
    options = BundleOptions()
    right = bundle_adjust(scene, "rotation", options)
    # noise of one component of 300 leaves three sigmas once
    assert num_explained(right.reconstruction) > 0.97 * len(scene.observations)
    kept = choose_depths(right, options)
    assert kept.result is right
    assert not kept.is_reversed
    wrong = bundle_adjust(with_depths_reversed(scene), "rotation", options)
    mended = choose_depths(wrong, options)
    assert mended.is_reversed
    assert mended.explained_reversed > mended.explained
    # relative directions, in degrees
    R = mended.result.reconstruction.R_cw
    between, truth = (each[1:] @ each[:-1].transpose(0, 2, 1) for each in (R, scene.R_cw))
    cosine = (np.einsum("nij,nij->n", between, truth) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.5
