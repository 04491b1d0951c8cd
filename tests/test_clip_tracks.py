"""Tracks of key frames: what connects those to which the camera returns."""

from __future__ import annotations

import numpy as np

from rsundistort.solve.clip_tracks import few_returns


def tracks(rng, num_keys=200, num_points=400):
    """Points that a camera sees in ten key frames in a row, and in the same ones again a hundred later."""
    first = rng.integers(0, 90, num_points)
    key = (first[:, None] + np.concatenate([np.arange(10), 100 + np.arange(10)])).ravel()
    point = np.repeat(np.arange(num_points), 20)
    order = rng.permutation(len(key))
    return key[order], point[order]


def test_what_the_camera_returns_to_is_connected_by_some_key_frames_only(rng) -> None:
    key, point = tracks(rng)
    index, anew, source = few_returns(key, point)
    assert (source[anew] == point[index]).all()
    # every measurement is there, in a point of its visit
    visits = anew[: len(key)]
    assert sorted(index[: len(key)].tolist()) == list(range(len(key)))
    shown = key[index]
    for each in np.unique(visits):
        assert np.ptp(shown[: len(key)][visits == each]) == 9
    # what connects the visits is shown by one of eight key frames and the next
    again = shown[len(key) :]
    assert set((again % 8).tolist()) == {0, 1}
    for each in np.unique(anew[len(key) :]):
        mine = again[anew[len(key) :] == each]
        assert mine.min() < 100 <= mine.max()
    pairs = {(i, j) for each in np.unique(anew) for i in shown[anew == each] for j in shown[anew == each] if j > i + 16}
    assert len(pairs) < 0.1 * 100 * 19


def test_tracks_without_a_return_stay_as_they_are(rng) -> None:
    key = np.arange(30).repeat(4)
    point = key // 10 * 4 + np.tile(np.arange(4), 30)
    index, anew, source = few_returns(key, point)
    assert len(index) == len(key)
    assert sorted(source.tolist()) == list(range(12))
    assert (source[anew] == point[index]).all()
