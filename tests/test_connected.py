"""Which photos hang together: sets of photos with more and less in common."""

from __future__ import annotations

import numpy as np
import pytest

from rsundistort import Camera, Observations, Reconstruction
from rsundistort.sfm import LEAST_MEASUREMENTS, firmly_connected, other_scenes
from rsundistort.sfm.connected import connected_photos

CAMERA = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])


def showing(num_photos, *sets):
    """A reconstruction of so many photos, of which sets (photos, number of points) show points of their own."""
    frame, point, count = [], [], 0
    for photos, number in sets:
        for photo in photos:
            frame.append(np.full(number, photo))
            point.append(count + np.arange(number))
        count += number
    frame_idx, point_idx = np.concatenate(frame), np.concatenate(point)
    xy = np.stack([frame_idx, point_idx], axis=1).astype(float)
    return Reconstruction(
        [CAMERA], [f"{k}.jpg" for k in range(num_photos)], np.zeros(num_photos, int),
        np.broadcast_to(np.eye(3), (num_photos, 3, 3)), np.arange(3.0 * num_photos).reshape(-1, 3), np.ones((count, 3)),
        Observations(frame_idx, point_idx, xy),
    )  # fmt: skip


def test_a_chain_of_threes_hangs_together():
    chain = showing(8, *(((k, k + 1, k + 2), LEAST_MEASUREMENTS) for k in range(6)))
    assert connected_photos(chain).all()
    assert firmly_connected(chain) is chain


@pytest.mark.parametrize("ties", [0, 4, LEAST_MEASUREMENTS - 1])
def test_a_part_that_hangs_on_by_little_is_reported_and_by_nothing_left_out(ties):
    # 4, 5 and 6 know each other well; of the others only 3 shows something that two of them show
    parts = showing(7, ((0, 1, 2, 3), 200), ((4, 5, 6), 300), ((3, 4, 5), ties))
    assert connected_photos(parts).tolist() == [True] * 4 + [False] * 3
    kept = firmly_connected(parts)
    if ties > 4:
        assert kept is parts
        return
    assert kept.image_names == ("0.jpg", "1.jpg", "2.jpg", "3.jpg")


def test_the_larger_part_is_the_one_of_more_photos():
    parts = showing(7, ((0, 1, 2), 900), ((3, 4, 5, 6), 100))
    assert connected_photos(parts).tolist() == [False] * 3 + [True] * 4


def test_points_of_one_other_photo_tell_no_place():
    pair = showing(4, ((0, 1, 2), 100), ((2, 3), 500))
    assert connected_photos(pair).tolist() == [True] * 3 + [False]


def test_parts_with_a_photo_in_common_are_one():
    # 4 knows its place among 0 to 3 by what 2 and 3 show, and 5 and 6 know theirs by 4
    parts = showing(7, ((0, 1, 2, 3), 200), ((4, 5, 6), 300), ((2, 3, 4), LEAST_MEASUREMENTS))
    assert connected_photos(parts).all()


@pytest.mark.parametrize(
    ("pairs", "says"),
    [
        ({(4, 5): 80, (5, 6): 80}, [[4, 5, 6]]),
        ({(4, 5): 80, (5, 6): 80, (3, 6): 29}, [[4, 5, 6]]),  # by chance
        ({(4, 5): 80, (5, 6): 80, (3, 6): 80}, []),  # a part that could not be registered
        ({(4, 5): 80}, []),  # two photos are no scene
        ({}, []),
    ],
)
def test_photos_that_match_each_other_and_none_that_is_registered_are_another_scene(pairs, says):
    registered = np.arange(8) < 4
    found = other_scenes({(0, 1): 90, (1, 2): 90, (2, 3): 90, **pairs}, registered)
    assert [each.tolist() for each in found] == says
