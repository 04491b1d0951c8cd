"""Frames that are missing between others, by how far the camera moves there."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from clips import HandHeld
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsundistort.bundle.own_motions import OwnMotions
from rsundistort.solve.missing_frames import Gaps, frames_missing, gaps_between, told_by

FRAME_S = 1 / 30
READOUT_S = 0.6 * FRAME_S


def travelling(center_w: NDArray[np.float64]) -> OwnMotions:
    """Frames of which only the positions are known."""
    unknown = np.full_like(center_w, np.nan)
    return OwnMotions(np.full((len(center_w), 3, 3), np.nan), center_w, unknown, unknown, unknown)


def turning(hand: HandHeld, time_s: NDArray[np.float64], noise: float = 2e-4) -> OwnMotions:
    """Frames of a camera on the spot: their rotations, and those of their lines."""
    rng = np.random.default_rng(hand.seed)
    half = 0.5 * READOUT_S
    first, last = hand.rotations(time_s - half), hand.rotations(time_s + half)
    phi = Rotation.from_matrix(last @ first.transpose(0, 2, 1)).as_rotvec()
    unknown = np.full_like(phi, np.nan)
    R_cw = Rotation.from_rotvec(rng.normal(0, noise, phi.shape)).as_matrix() @ hand.rotations(time_s)
    return OwnMotions(R_cw, np.zeros_like(phi), phi + rng.normal(0, noise, phi.shape), unknown, unknown)


def of_turning(hand: HandHeld, kept: NDArray[np.int64], rate: float = 30, frame_s: float = FRAME_S) -> Gaps:
    """What is found of evenly spaced frames of a camera on the spot."""
    steps = np.ones(len(kept) - 1)
    return gaps_between(turning(hand, kept * frame_s), np.arange(len(kept)), steps, steps > 0, len(kept), rate)


def missing(hand: HandHeld, kept: NDArray[np.int64], joined: NDArray[np.bool_] | None = None) -> NDArray[np.int64]:
    """What is found of frames that are said to follow each other."""
    rng = np.random.default_rng(hand.seed)
    center_w = hand.centers(kept * FRAME_S) + rng.normal(0, 1e-3, (len(kept), 3))
    steps = np.ones(len(kept) - 1)
    return frames_missing(told_by(travelling(center_w), steps > 0 if joined is None else joined), steps)


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
    return gaps_between(travelling(center_w), place, steps, steps > 0, len(kept), rate)


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
    found = gaps_between(travelling(center_w), np.arange(80), steps, steps > 0, 80, 25)
    assert found.ratio is None
    assert not found.missing.any()


def test_a_camera_that_stands_misses_none() -> None:
    assert not missing(HandHeld(1, walks=False), np.arange(60)).any()
    assert not frames_missing(told_by(travelling(np.zeros((60, 3))), np.ones(59, bool)), np.ones(59)).any()


def test_a_jerk_is_no_missing_frame() -> None:
    center_w = HandHeld(2).centers(np.arange(90) * FRAME_S)
    for at, push in ((30, [0.0, 0.05, 0.0]), (61, [0.03, 0.05, 0.02])):
        center_w[at:] += push
    assert not frames_missing(told_by(travelling(center_w), np.ones(89, bool)), np.ones(89)).any()


@pytest.mark.parametrize("seed", range(6))
def test_frames_that_were_placed_wrongly_miss_none(seed: int) -> None:
    """As among passers-by: places are off by multiples of the way from frame to frame."""
    rng = np.random.default_rng(seed)
    center_w = HandHeld(seed).centers(np.arange(90) * FRAME_S)
    center_w += 0.01 * rng.standard_t(1.5, center_w.shape)
    assert not frames_missing(told_by(travelling(center_w), np.ones(89, bool)), np.ones(89)).any()


def test_a_cut_is_no_gap() -> None:
    kept = np.concatenate([np.arange(40), np.arange(60, 100)])
    assert not missing(HandHeld(3), kept, np.diff(kept) == 1).any()
    assert not missing(HandHeld(3), np.arange(5)).any()


@pytest.mark.parametrize("seed", range(6))
def test_frames_that_are_missing_of_a_camera_that_only_rotates_are_found(seed: int) -> None:
    kept = np.delete(np.arange(120), [10, 31, 52, 60, 85, 97])
    found, true = of_turning(HandHeld(seed), kept).missing, np.diff(kept) - 1
    assert not found[true == 0].any()
    assert (found == true)[true > 0].sum() >= 4


@pytest.mark.parametrize(("camera", "rate"), CONVERTED)
@pytest.mark.parametrize("seed", range(3))
def test_a_conversion_of_a_camera_that_only_rotates_is_found(seed: int, camera: float, rate: float) -> None:
    kept = converted(80, camera / rate, seed / 3)
    found = of_turning(HandHeld(seed), kept, rate, 1 / camera)
    np.testing.assert_array_equal(found.missing, np.diff(kept) - 1)
    assert found.ratio == pytest.approx(camera / rate, rel=2e-3)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("tremor", [0.004, 0.02, 0.05])
def test_no_frame_is_missing_of_a_camera_that_only_rotates(seed: int, tremor: float) -> None:
    for rate in (15, 25, 30):
        assert not of_turning(HandHeld(seed, tremor=tremor), np.arange(90), rate, 1 / rate).missing.any()


@pytest.mark.parametrize("seed", range(6))
def test_lines_that_do_not_rotate_as_their_frames_say_nothing(seed: int) -> None:
    """Frames that were stabilised, or of a global shutter."""
    own, steps = turning(HandHeld(seed), np.arange(90) * FRAME_S), np.ones(89)
    others = turning(HandHeld(100 + seed), np.arange(90) * FRAME_S)
    for phi in (others.phi, np.random.default_rng(seed).normal(0, 1e-4, (90, 3)), np.zeros((90, 3))):
        assert not frames_missing(told_by(replace(own, phi=phi), steps > 0), steps).any()


@pytest.mark.parametrize("seed", range(6))
def test_a_knock_is_no_missing_frame(seed: int) -> None:
    """The camera is rotated between two frames, so that no line shows it."""
    rng = np.random.default_rng(seed)
    own, steps = turning(HandHeld(seed), np.arange(90) * FRAME_S), np.ones(89)
    R_cw = own.R_cw.copy()
    for at in (20, 41, 66):
        R_cw[at:] = Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix() @ R_cw[at:]
    assert not frames_missing(told_by(replace(own, R_cw=R_cw), steps > 0), steps).any()
