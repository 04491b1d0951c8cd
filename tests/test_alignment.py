"""Tracks aligned at full size: windows of an analytic texture, which can be sampled anywhere exactly."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rsundistort.model import Camera, Observations, Reconstruction
from rsundistort.sfm import PatchPlaces, align_tracks, allowed_patches, cut_patches
from rsundistort.sfm.epipolar import sampson_distance
from rsundistort.sfm.features import SIFT_PX

CAMERA = Camera(320, 240, [[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])


class Texture:
    """A sum of waves over a plane, in units of its length."""

    def __init__(self, rng, finest=0.06, count=60):
        angle, length = rng.uniform(0, 2 * np.pi, count), finest * 2 ** rng.uniform(0, 4, count)
        self.wave = 2 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        self.phase = rng.uniform(0, 2 * np.pi, count)

    def __call__(self, x, y):
        return np.mean(np.cos(np.stack([x, y], -1) @ self.wave.T + self.phase), -1)


def look_at(center, target):
    ahead = np.asarray(target, float) - center
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0, 1.0, 0], ahead)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead])


def photo_of(texture, R_cw, center, gain, rng):
    """The plane z = 0 as a pinhole camera sees it, by plain NumPy."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - 159.5) / 300, (v - 119.5) / 300, np.ones(u.shape)], -1) @ R_cw
    scale = -center[2] / rays[..., 2]
    x, y = center[0] + scale * rays[..., 0], center[1] + scale * rays[..., 1]
    grey = 128 + gain * 400 * texture(x, y) + rng.normal(0, 1.0, u.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def plane_from(*last):
    """Five photos of a plane, points measured to a pixel in four of them, and where they are really seen."""
    rng = np.random.default_rng(0)
    texture = Texture(rng)
    centers = np.array([[-0.8, 0.1, -3.0], [-0.3, -0.2, -2.8], [0.1, 0.2, -3.2], [0.5, 0.0, -3.0], last])
    R_cw = np.array([look_at(center, [0.1, 0.0, 0.0]) for center in centers])
    photos = [
        photo_of(texture, R, c, gain, rng) for R, c, gain in zip(R_cw, centers, rng.uniform(0.6, 1.2, 5), strict=True)
    ]
    points = np.column_stack([rng.uniform(-0.8, 0.8, (150, 2)), np.zeros(150)])
    seen = np.einsum("mij,mnj->mni", R_cw, points[None] - centers[:, None])
    truth = 300 * seen[..., :2] / seen[..., 2:] + [159.5, 119.5]
    # the last photo shows but few by features
    frame, point = np.divmod(np.arange(4 * 150 + 20), 150)
    noise = rng.normal(0, 0.4, (len(frame), 2))
    obs = Observations(frame, point, truth[frame, point] + noise, np.full(len(frame), 3.0))
    names = [f"{k}.png" for k in range(5)]
    rec = Reconstruction([CAMERA], names, np.zeros(5, int), R_cw, centers, points, obs)
    return rec, photos, truth


@pytest.fixture(scope="module")
def plane():
    return plane_from(0.9, -0.1, -2.9)


def source(photos, masks=None):
    def patches_of(places):
        for frame, each in places.items():
            mask = None if masks is None else masks[frame]
            yield frame, cut_patches(photos[frame], each), allowed_patches(mask, each)

    return patches_of


def apart(rec):
    """(o, 2) how far from the other measurements of its point each shows the plane, by plain geometry."""
    obs = rec.observations
    rays = np.column_stack([(obs.xy_raw - [159.5, 119.5]) / 300, np.ones(len(obs))])
    rays = np.einsum("nij,ni->nj", rec.R_cw[obs.frame_idx], rays)
    center = rec.center_w[obs.frame_idx]
    on_plane = center[:, :2] - center[:, 2:] / rays[:, 2:] * rays[:, :2]
    counts = np.bincount(obs.point_idx)
    mean = np.stack([np.bincount(obs.point_idx, on_plane[:, k]) / counts for k in range(2)], 1)
    return 100 * (on_plane - mean[obs.point_idx])  # about 100 px to the unit of length


def test_aligned_measurements_show_the_same_point(plane):
    rec, photos, _ = plane
    found = align_tracks(rec, np.ones(5), source(photos))
    apart_px = apart(found)
    assert np.median(np.linalg.norm(apart_px, axis=1)) < 0.05
    # before: 0.4 px of noise
    assert np.percentile(np.linalg.norm(apart_px, axis=1), 90) < 0.2
    assert len(photos) == found.num_images


def test_points_are_found_where_no_feature_was(plane):
    rec, photos, truth = plane
    obs = align_tracks(rec, np.ones(5), source(photos)).observations
    new = obs.frame_idx == 4
    assert new.sum() > 100
    assert np.median(np.linalg.norm(obs.xy_raw[new] - truth[4, obs.point_idx[new]], axis=1)) < 0.6


def test_features_are_aligned_from_farther_off_than_points_are_searched_for():
    rec, photos, _ = plane_from(2.4, -0.1, -2.0)  # 50 degrees from the second photo
    found = align_tracks(rec, np.ones(5), source(photos))
    aside = found.observations.frame_idx == 4
    assert set(found.observations.point_idx[aside]) <= set(range(20))
    aligned = aside & (found.observations.sigma < 1)
    assert aligned.sum() > 12
    assert np.median(np.linalg.norm(apart(found)[aligned], axis=1)) < 0.1


def test_deviations_are_those_of_the_differences(plane, rng):
    rec, photos, truth = plane
    exact = Observations(
        rec.observations.frame_idx, rec.observations.point_idx,
        truth[rec.observations.frame_idx, rec.observations.point_idx], rec.observations.sigma,
    )  # fmt: skip
    obs = align_tracks(replace(rec, observations=exact), np.ones(5), source(photos)).observations
    error = (obs.xy_raw - truth[obs.frame_idx, obs.point_idx]) / (SIFT_PX * obs.sigma)[:, None]
    moved = np.abs(error).sum(1) > 0
    # errors of the best view are none; of the others both windows' noise and the floor of trust
    assert 0.3 < np.sqrt(np.mean(error[moved] ** 2)) < 1.5


def test_masks_hide_points_from_alignment(plane):
    rec, photos, _ = plane
    masks = [None] * 4 + [np.zeros((240, 320), np.uint8)]
    obs = align_tracks(rec, np.ones(5), source(photos, masks)).observations
    assert (obs.frame_idx == 4).sum() == (rec.observations.frame_idx == 4).sum()


def test_photos_that_cannot_be_read_again_keep_their_measurements(plane):
    rec, _, _ = plane
    found = align_tracks(rec, np.ones(5), lambda places: ()).observations
    assert np.array_equal(found.xy_raw, rec.observations.xy_raw)
    assert np.array_equal(found.sigma, rec.observations.sigma)


def test_photos_of_one_colour_change_nothing(plane):
    rec, photos, _ = plane
    flat = [np.full_like(photo, 90) for photo in photos]
    assert np.array_equal(align_tracks(rec, np.ones(5), source(flat)).observations.xy_raw, rec.observations.xy_raw)


def test_same_result_whatever_the_number_of_threads(plane):
    import numba

    rec, photos, _ = plane
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            results.append(align_tracks(rec, np.ones(5), source(photos)).observations)
    finally:
        numba.set_num_threads(before)
    assert np.array_equal(results[0].xy_raw, results[1].xy_raw)
    assert np.array_equal(results[0].sigma, results[1].sigma)


def test_patches_of_halved_photos_lie_where_pyr_down_has_them(rng):
    photo = cv2.GaussianBlur(rng.integers(0, 255, (200, 260)).astype(np.uint8), (0, 0), 3)
    places = PatchPlaces(np.array([0, 1]), np.array([[40, 50], [20, 25]]))
    whole, half = cut_patches(photo, places)
    assert np.array_equal(whole, photo[50 : 50 + whole.shape[0], 40 : 40 + whole.shape[1]])
    # pixel k of the halved photo is pixel 2k of the whole one
    assert np.abs(half[:24, :24].astype(int) - photo[50:98:2, 40:88:2]).mean() < 3


def test_patches_beyond_the_border_repeat_it():
    photo = np.arange(100 * 120, dtype=np.uint32).reshape(100, 120).astype(np.uint8)
    (patch,) = cut_patches(photo, PatchPlaces(np.array([0]), np.array([[-10, -5]])))
    assert (patch[:6, :11] == photo[0, 0]).all()


def test_sampson_distance_is_that_of_opencv(rng):
    x_1, x_2 = (np.column_stack([rng.uniform(-0.5, 0.5, (30, 2)), np.ones(30)]) for _ in range(2))
    R, t = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0], np.array([0.3, -0.1, 0.9])
    E = np.cross(np.eye(3), t) @ R * -1.0
    expected = [cv2.sampsonDistance(a, b, E) ** 0.5 for a, b in zip(x_1, x_2, strict=True)]
    np.testing.assert_allclose(sampson_distance(x_1, x_2, R, t), expected, rtol=1e-9)


def test_sampson_distance_of_true_matches_is_zero(rng):
    R, t = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0], np.array([0.3, -0.1, 0.2])
    X = rng.uniform(-1, 1, (20, 3)) + np.array([0, 0, 4])
    Y = X @ R.T + t
    assert sampson_distance(X / X[:, 2:], Y / Y[:, 2:], R, t).max() < 1e-12
    assert np.isinf(sampson_distance(X / X[:, 2:], Y / Y[:, 2:], R, np.zeros(3))).all()
