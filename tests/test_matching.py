"""Verification of pairs: close where no shutter is seen, and with room for one where it is."""

from __future__ import annotations

import numpy as np
import pytest
from sift_like import sift_like

from rsundistort import Camera, RowMotion, project_points
from rsundistort.colmap.conventions import quiet_pycolmap
from rsundistort.sfm import Features, match_photos, matching, read_num_verified
from rsundistort.sfm.features import features_of_both
from rsundistort.sfm.matching import LOOSE_PX, match_more, verify_loosely

CAMERA = Camera(1200, 900, [[1000, 0, 600], [0, 1000, 450], [0, 0, 1]])
RIGHT, WRONG = 400, 100
AHEAD, ASIDE = [0.02, 0.01, 0.3], [1.2, 0.4, 0.1]


@pytest.fixture
def pair(rng, tmp_path):
    """Two photos, the second from another place and with a motion; a fifth of their matches is wrong."""
    points_w = rng.uniform([-3, -2, 5], [3, 2, 12], (4000, 3))
    descriptors = sift_like(rng.uniform(0, 90, (RIGHT + WRONG, 128)))

    def matched(phi, center=AHEAD, **options):
        shown = [
            project_points(points_w - center, CAMERA, RowMotion(turn))
            for center, turn in (([0, 0, 0], np.zeros(3)), (center, np.asarray(phi) / CAMERA.frame_span))
        ]
        within = [valid & (np.abs(xy - [600, 450]) < [590, 440]).all(1) for xy, valid in shown]
        seen = np.flatnonzero(within[0] & within[1])[:RIGHT]
        assert len(seen) == RIGHT
        features = [
            Features(
                np.concatenate(
                    [xy[seen] + rng.normal(0, 0.5, (RIGHT, 2)), rng.uniform([0, 0], [1200, 900], (WRONG, 2))]
                ),
                np.ones(RIGHT + WRONG),
                descriptors,
            )
            for xy, _ in shown
        ]
        database = tmp_path / f"{len(list(tmp_path.iterdir()))}.db"
        return match_photos(database, ["a.jpg", "b.jpg"], features, [CAMERA], np.zeros(2, int), **options)

    return matched


def direction_of(matched):
    """The epipole in the second photo, in pixels; the true one is where all go ahead."""
    with quiet_pycolmap().Database.open(matched.database) as db:
        E = np.asarray(db.read_two_view_geometry(1, 2).E)
    t = np.linalg.svd(E)[0][:, 2]
    return 1000 * t[:2] / t[2]


def test_a_pair_without_a_shutter_gets_a_close_geometry(pair, monkeypatch):
    true = 1000 * np.array(AHEAD[:2]) / AHEAD[2]
    matched = pair([0, 0, 0])
    assert np.linalg.norm(direction_of(matched) - true) < 15
    assert read_num_verified(matched)[0, 1] >= 0.95 * RIGHT
    monkeypatch.setattr(matching, "CLOSE_PX", LOOSE_PX)
    assert np.linalg.norm(direction_of(pair([0, 0, 0])) - true) > 15


@pytest.mark.parametrize("center", [AHEAD, ASIDE])
def test_a_pair_with_a_shutter_keeps_its_matches(pair, center, monkeypatch):
    phi = [0.1, 0.05, 0.1]
    kept = read_num_verified(pair(phi, center))[0, 1]
    monkeypatch.setattr(matching, "CLOSE_PX", LOOSE_PX)
    assert kept >= 0.95 * read_num_verified(pair(phi, center))[0, 1]
    assert kept >= 0.95 * RIGHT


def test_pairs_are_verified_once_more_with_room_for_a_strong_shutter(pair):
    matched = pair([0, 0, 0])
    before = direction_of(matched)
    verify_loosely(matched)
    assert (direction_of(matched) != before).any()
    assert read_num_verified(matched)[0, 1] >= 0.95 * RIGHT


def test_features_of_both_kinds_are_the_largest_first():
    def features(sigma, value):
        return Features(
            np.full((len(sigma), 2), value), np.array(sigma), np.full((len(sigma), 128), value, np.uint8), 2.0
        )

    both = features_of_both(features([5.0, 1.0], 3), features([4.0, 1.0, 0.5], 7))
    np.testing.assert_array_equal(both.sigma, [5.0, 4.0, 1.0, 1.0, 0.5])
    np.testing.assert_array_equal(both.kind, [0, 1, 0, 1, 1])
    np.testing.assert_array_equal(both.descriptors[:, 0], [3, 7, 3, 7, 7])
    np.testing.assert_array_equal(both.xy_raw[:, 0], [3, 7, 3, 7, 7])
    assert both.step_px == 2.0
    np.testing.assert_array_equal(both.of_kind(1), [1, 3, 4])
    np.testing.assert_array_equal(both.largest(3).of_kind(1), [1])
    np.testing.assert_array_equal(features([5.0, 1.0], 3).of_kind(0), [0, 1])


def test_descriptors_of_one_kind_are_compared(rng, tmp_path):
    things = sift_like(rng.uniform(0, 90, (60, 128)))
    xy, kind = rng.uniform(0, 800, (60, 2)), np.repeat(np.array([0, 1], np.uint8), 30)
    # the second photo shows the last twenty as the other kind; and the first ten as both, which leaves them clear
    second = Features(
        np.vstack([xy, xy[:10]]), np.ones(70), np.vstack([things, things[:10]]),
        kind=np.concatenate([kind[:40], 1 - kind[40:], np.ones(10, np.uint8)]),
    )  # fmt: skip
    first = Features(xy, np.ones(60), things, kind=kind)
    matched = match_photos(tmp_path / "both.db", ["a.jpg", "b.jpg"], [first, second], [CAMERA], np.zeros(2, int))
    with quiet_pycolmap().Database.open(matched.database) as db:
        found = {*map(tuple, np.asarray(db.read_matches(1, 2)).tolist())}
    assert found == {(k, k) for k in range(40)}


def test_pairs_without_matches_are_not_matched_again(rng, tmp_path):
    descriptors = sift_like(rng.uniform(0, 90, (400, 128)))
    features = [
        Features(rng.uniform([0, 0], [1200, 900], (200, 2)), np.ones(200), descriptors[first : first + 200])
        for first in (0, 0, 200)
    ]
    names, idx = ["a.jpg", "b.jpg", "c.jpg"], np.zeros(3, int)
    matched = match_photos(tmp_path / "a.db", names, features, [CAMERA], idx, pairs=np.array([[0, 1], [2, 1]]))
    match_more(matched)
    with quiet_pycolmap().Database.open(matched.database) as db:
        assert [len(db.read_matches(*ids)) for ids in ((1, 2), (2, 3), (1, 3))] == [200, 0, 0]
        assert db.exists_matches(1, 3)
    match_more(matched)
