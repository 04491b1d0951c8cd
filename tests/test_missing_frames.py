"""Frames that are missing between others, by how far the camera moves there."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from clips import HandHeld
from numpy.typing import NDArray

from rsundistort.solve.missing_frames import Gaps, frames_missing, gaps_between

FRAME_S = 1 / 30


def missing(hand: HandHeld, kept: NDArray[np.int64], joined: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """What is found of frames that are said to follow each other."""
    rng = np.random.default_rng(hand.seed)
    center_w = hand.centers(kept * FRAME_S) + rng.normal(0, 1e-3, (len(kept), 3))
    steps = np.ones(len(kept) - 1)
    return frames_missing(center_w, steps, steps > 0 if joined is None else joined)


def converted(num_frames: int, ratio: float, phase: float) -> NDArray[np.int64]:
    """Which frames a conversion keeps: those nearest to multiples of the ratio."""
    return np.floor(np.arange(num_frames) * ratio + phase).astype(np.int64)


def gaps(
    seed: int, kept: NDArray[np.int64], rate: float, frame_s: float, shake: float = 1e-3,
    place: NDArray[np.int64] | None = None,
) -> Gaps:  # fmt: skip
    """What is found of evenly spaced frames of a hand that shakes, of which some or all could be placed."""
    place = np.arange(len(kept)) if place is None else place
    rng = np.random.default_rng(seed)
    center_w = HandHeld(seed).centers(kept[place] * frame_s) + rng.normal(0, shake, (len(place), 3))
    steps = np.diff(place).astype(float)
    return gaps_between(center_w, place, steps, steps > 0, len(kept), rate)


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


# Frame rates of the camera and of the file.
CONVERTED = [(30, 25), (30, 24), (29.97, 23.976), (25, 24), (30, 20), (60, 25), (60, 24)]


@pytest.mark.parametrize(("camera", "rate"), CONVERTED)
@pytest.mark.parametrize("shake", [1e-3, 4e-3])
def test_a_conversion_to_a_lower_frame_rate_is_found_however_hands_shake(
    camera: float, rate: float, shake: float
) -> None:
    for seed in range(3):
        kept = converted(80, camera / rate, seed / 3)
        found = gaps(seed, kept, rate, 1 / camera, shake)
        np.testing.assert_array_equal(found.missing, np.diff(kept) - 1)
        assert found.ratio == pytest.approx(camera / rate, rel=2e-3)


@pytest.mark.parametrize("rate", [10, 15, 24, 25, 29.97, 30, 50, 60, 17])
def test_frames_of_a_hand_that_shakes_are_of_no_conversion(rate: float) -> None:
    for seed, shake in product(range(6), (1e-3, 5e-3, 0.05)):
        found = gaps(seed, np.arange(90), rate, 1 / rate, shake)
        assert found.ratio is None
        assert not found.missing.any()


def test_gaps_without_an_order_are_of_no_conversion() -> None:
    kept = np.delete(np.arange(120), [10, 31, 60, 85, 88])
    found = gaps(3, kept, 25, FRAME_S)
    assert found.ratio is None
    assert (found.missing == np.diff(kept) - 1).all()


def test_a_conversion_is_found_by_the_frames_that_were_placed() -> None:
    kept = converted(100, 1.2, 0.45)
    place = np.delete(np.arange(len(kept)), [0, 7, 8, 30, 51])
    found = gaps(1, kept, 25, FRAME_S, place=place)
    np.testing.assert_array_equal(found.missing, np.diff(kept) - 1)


def test_frames_that_are_unevenly_spaced_are_of_no_conversion() -> None:
    steps = np.where(np.arange(79) % 5 == 2, 2.0, 1.0)
    kept = np.concatenate([[0], np.cumsum(steps).astype(int)])
    center_w = HandHeld(1).centers(kept * FRAME_S)
    found = gaps_between(center_w, np.arange(80), steps, steps > 0, 80, 25)
    assert found.ratio is None
    assert not found.missing.any()


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
