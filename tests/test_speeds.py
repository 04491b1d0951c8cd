"""The readout time by slow and by fast rotations, of frames whose lines are fitted here one by one."""

from __future__ import annotations

import numpy as np
import pytest
from clips import HandHeld
from scipy.spatial.transform import Rotation

from rsundistort.verdict.judge_path import BY_SLOW_ROTATIONS, problem_of
from rsundistort.verdict.speeds import readouts_by_speed

FRAME_S = 1 / 30
NOISE = 2e-4


def lines_of(rotations_at, time_s, readout_s):
    """Rotation (m, 3, 3) in the middle of each frame, and rotation over it (m, 3): the steady motion nearest to it."""
    late = np.linspace(-0.5, 0.5, 33) * readout_s
    R_cw, phi = [], []
    for time in time_s:
        middle = rotations_at(np.array([time]))[0]
        turns = Rotation.from_matrix(rotations_at(time + late) @ middle.T).as_rotvec()
        slope, constant = np.polyfit(late / readout_s, turns, 1)
        R_cw.append(Rotation.from_rotvec(constant).as_matrix() @ middle)
        phi.append(slope)
    return np.array(R_cw), np.array(phi)


def by_speed(rotations_at, rng, readout_s=0.02, num=60, part=None, without=()):
    """The two readout times of frames with noise, without some that are missing."""
    time_s = np.delete(np.arange(num) * FRAME_S, without)
    num = len(time_s)
    R_cw, phi = lines_of(rotations_at, time_s, readout_s)
    R_cw = Rotation.from_rotvec(rng.normal(0, NOISE, (num, 3))).as_matrix() @ R_cw
    sigma = np.full((num, 3), NOISE)
    phi = phi + rng.normal(0, NOISE, (num, 3))
    part = np.zeros(num, int) if part is None else part
    return readouts_by_speed(time_s, part, R_cw, sigma, phi, sigma, readout_s)


def shaken(seed, hz, size):
    """A hand, and a vibration of one frequency."""

    def rotations(time_s):
        angle = 2 * np.pi * hz * np.asarray(time_s)[:, None] + [0.0, 1.0, 2.0]
        return Rotation.from_rotvec(size * np.sin(angle)).as_matrix() @ HandHeld(seed).rotations(time_s)

    return rotations


@pytest.mark.parametrize("seed", range(20))
def test_noise_of_frames_that_hardly_rotate_is_no_shaking(seed):
    def rotations(time_s):
        return Rotation.from_rotvec(
            0.05 * Rotation.from_matrix(HandHeld(seed).rotations(time_s)).as_rotvec()
        ).as_matrix()

    assert by_speed(rotations, np.random.default_rng(seed), num=48).unfollowed < 0.1


@pytest.mark.parametrize("readout_s", [0.008, 0.02, 0.03])
@pytest.mark.parametrize("hz", [9.0, 12.5])
def test_slow_and_fast_rotations_of_a_hand_ask_for_the_same_readout_time(rng, readout_s, hz):
    found = by_speed(shaken(1, hz, 0.003), rng, readout_s)
    assert found.unfollowed < 0.01
    for seconds, sigma in (found.slow, found.fast):
        assert abs(seconds - readout_s) < 4 * sigma + 0.03 * readout_s
        assert sigma < 0.1 * readout_s


@pytest.mark.parametrize("hz", [15.7, 17.0, 20.0])
def test_a_vibration_faster_than_half_of_the_frame_rate_runs_the_other_way(rng, hz):
    slow, fast, unfollowed, _ = by_speed(shaken(1, hz, 0.003), rng)
    assert unfollowed > 0.2
    assert abs(slow.seconds - 0.02) < 4 * slow.sigma
    # what the frames show has a rate of this share of that of the lines, and its sign is the other
    shown = -0.02 * hz / (30 - hz)
    assert fast.seconds < 0.3 * shown
    told = {"seconds": 0.024, "sigma": 0.0005, "of_frame": 0.72, "source": "the video"}
    assert problem_of(told) == ""
    told["by_speed"] = [each._asdict() for each in (slow, fast)]
    assert "vibrates faster" in problem_of(told)
    by_slow = told | {"source": BY_SLOW_ROTATIONS, "seconds": slow.seconds, "sigma": slow.sigma}
    assert problem_of(by_slow) == ""
    assert "contradict" in problem_of(by_slow | {"seconds": 1.3 * slow.seconds, "sigma": 1e-4})  # given, and wrong


def test_a_path_that_slow_rotations_contradict_is_no_measurement(rng):
    slow, fast, *_ = by_speed(shaken(1, 9.0, 0.003), rng)
    speeds = {"by_speed": [each._asdict() for each in (slow, fast)]}
    told = {"sigma": 0.0003, "of_frame": 0.72, "source": "the video"} | speeds
    assert problem_of(told | {"seconds": slow.seconds + 0.0002}) == ""
    assert "slow rotations alone contradict it" in problem_of(told | {"seconds": slow.seconds + 0.004})


def test_a_readout_against_its_direction_has_the_same_sign_at_all_speeds(rng):
    hand = shaken(1, 11.0, 0.003)
    time_s = np.arange(60) * FRAME_S
    R_cw, phi = lines_of(hand, time_s, 0.02)
    sigma = np.full((60, 3), NOISE)
    slow, fast, *_ = readouts_by_speed(time_s, np.zeros(60, int), R_cw, sigma, -phi, sigma, -0.02)
    assert slow.seconds == pytest.approx(-0.02, rel=0.02)
    assert fast.seconds == pytest.approx(-0.02, rel=0.05)
    told = {"seconds": -0.02, "sigma": 0.0005, "of_frame": -0.6, "source": "the video"}
    problem = problem_of(told | {"by_speed": [slow._asdict(), fast._asdict()]})
    assert "the last line is read first" in problem
    assert "contradict" not in problem


def test_nothing_is_said_of_few_frames_of_gaps_or_of_rotations_lost_in_the_noise(rng):
    assert by_speed(shaken(1, 9.0, 0.003), rng, num=20) is None
    assert by_speed(shaken(1, 9.0, 0.003), rng, num=40, part=np.repeat([0, 1], 20)) is None
    assert by_speed(shaken(1, 9.0, 0.003), rng, num=48, without=range(22, 26)) is None
    still = by_speed(lambda time_s: np.tile(np.eye(3), (len(time_s), 1, 1)), rng)
    assert still == (None, None, 0.0, 0.0)


MISSING = {"here and there": (4, 11, 20, 21, 35, 42, 51, 52), "converted": range(2, 60, 6)}


@pytest.mark.parametrize("without", MISSING.values(), ids=MISSING)
@pytest.mark.parametrize("wrong", [0.9, 1.0, 1.15])
def test_frames_that_are_missing_are_filled_in(rng, without, wrong):
    """Also if the readout time that is thought is wrong."""
    time_s = np.delete(np.arange(60) * FRAME_S, without)
    R_cw, phi = lines_of(shaken(1, 9.0, 0.003), time_s, 0.02)
    phi = phi + rng.normal(0, NOISE, phi.shape)
    part, sigma = np.zeros(len(time_s), int), np.full(phi.shape, NOISE)
    found = readouts_by_speed(time_s, part, R_cw, sigma, phi, sigma, wrong * 0.02)
    assert found.unfollowed < 0.02
    assert abs(found.slow.seconds - 0.02) < 4 * found.slow.sigma + 2e-4
    assert found.slow.sigma < 1e-3
    assert readouts_by_speed(time_s, part, R_cw, sigma, phi, sigma, 0.02, fills=False) is None


@pytest.mark.parametrize("without", MISSING.values(), ids=MISSING)
@pytest.mark.parametrize("hz", [17.0, 20.0])
def test_a_fast_vibration_shows_also_where_frames_are_missing(rng, without, hz):
    slow, _, unfollowed, _ = by_speed(shaken(1, hz, 0.003), rng, without=without)
    assert unfollowed > 0.15
    assert abs(slow.seconds - 0.02) < 4 * slow.sigma


@pytest.mark.parametrize("errors", [0.0, 6e-4])
def test_errors_of_the_frames_rotations_are_no_vibration(rng, errors):
    """A hand that rotates slowly: it trembles, or its frames are off by more than their standard deviations."""
    hand, trembles = HandHeld(3), 2 * np.pi * 0.37 / FRAME_S
    off, size = errors * rng.normal(size=(60, 3)), 2e-3 * (errors == 0)

    def rotations(time_s):
        angle = trembles * np.asarray(time_s)[:, None] + [0.0, 1.0, 2.0]
        return Rotation.from_rotvec(size * np.sin(angle)).as_matrix() @ hand.rotations(np.asarray(time_s) / 4)

    time_s = np.arange(60) * FRAME_S
    R_cw, phi = lines_of(rotations, time_s, 0.02)
    sigma = np.full((60, 3), NOISE)
    R_cw = Rotation.from_rotvec(off).as_matrix() @ R_cw
    found = readouts_by_speed(time_s, np.zeros(60, int), R_cw, sigma, phi + rng.normal(0, NOISE, (60, 3)), sigma, 0.02)
    assert (found.fast is None) == (errors > 0)
    # errors of frames are at all frequencies: by slow ones, too, they look like a shorter readout time
    assert abs(found.slow.seconds - 0.02) < 0.1 * 0.02


def test_frames_of_which_most_are_missing_are_not_filled_in(rng):
    assert by_speed(shaken(1, 9.0, 0.003), rng, num=90, without=np.flatnonzero(np.arange(90) % 5 > 2)) is None
