"""Frames that are missing between others, by how far the camera moves there."""

from __future__ import annotations

import numpy as np
import pytest
from clips import HandHeld
from numpy.typing import NDArray

from rsundistort.solve.missing_frames import frames_missing, regular_gaps

FRAME_S = 1 / 30


def missing(hand: HandHeld, kept: NDArray[np.int64], joined: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """What is found of frames that are said to follow each other."""
    rng = np.random.default_rng(hand.seed)
    center_w = hand.centers(kept * FRAME_S) + rng.normal(0, 1e-3, (len(kept), 3))
    steps = np.ones(len(kept) - 1)
    return frames_missing(center_w, steps, steps > 0 if joined is None else joined)


@pytest.mark.parametrize("seed", range(6))
def test_no_frame_is_missing_of_a_hand_that_shakes(seed: int) -> None:
    assert not missing(HandHeld(seed), np.arange(90)).any()
    assert not missing(HandHeld(seed, swing=3.0, tremor=0.02), np.arange(0, 180, 2)).any()


@pytest.mark.parametrize("seed", range(6))
def test_frames_that_are_missing_here_and_there_are_found(seed: int) -> None:
    kept = np.delete(np.arange(120), [10, 31, 52, 60, 85, 97])
    found, true = missing(HandHeld(seed), kept), np.diff(kept) - 1
    assert not found[true == 0].any()
    assert (found == true)[true > 0].sum() >= 4


@pytest.mark.parametrize("rate", [25, 24])
@pytest.mark.parametrize("seed", range(3))
def test_all_gaps_of_a_conversion_are_found_by_most_of_them(seed: int, rate: int) -> None:
    kept = np.floor(np.arange(80) * 30 / rate + 0.5).astype(int)
    regular = regular_gaps(missing(HandHeld(seed), kept))
    assert regular is not None
    np.testing.assert_array_equal(regular[0], np.diff(kept) - 1)
    assert regular[1] == pytest.approx(30 / rate)


def test_gaps_without_an_order_are_of_no_conversion() -> None:
    gaps = np.zeros(119, int)
    gaps[[10, 31, 60, 85, 88]] = 1
    assert regular_gaps(gaps) is None
    gaps[[60, 85, 88]] = 0
    assert regular_gaps(gaps) is None  # two gaps fit some ratio


def test_a_camera_that_stands_misses_none() -> None:
    assert not missing(HandHeld(1, walks=False), np.arange(60)).any()
    assert not frames_missing(np.zeros((60, 3)), np.ones(59), np.ones(59, bool)).any()


def test_a_jerk_is_no_missing_frame() -> None:
    center_w = HandHeld(2).centers(np.arange(90) * FRAME_S)
    for at, push in ((30, [0.0, 0.05, 0.0]), (61, [0.03, 0.05, 0.02])):
        center_w[at:] += push
    assert not frames_missing(center_w, np.ones(89), np.ones(89, bool)).any()


@pytest.mark.parametrize("seed", range(6))
def test_frames_that_were_placed_wrongly_miss_none(seed: int) -> None:
    """As among passers-by: places are off by multiples of the way from frame to frame."""
    rng = np.random.default_rng(seed)
    center_w = HandHeld(seed).centers(np.arange(90) * FRAME_S)
    center_w += 0.01 * rng.standard_t(1.5, center_w.shape)
    assert not frames_missing(center_w, np.ones(89), np.ones(89, bool)).any()


def test_a_cut_is_no_gap() -> None:
    kept = np.concatenate([np.arange(40), np.arange(60, 100)])
    assert not missing(HandHeld(3), kept, np.diff(kept) == 1).any()
    assert not missing(HandHeld(3), np.arange(5)).any()
