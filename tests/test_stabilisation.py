"""Whether a clip was stabilised in the camera; the judge is a sum of sines, whose integrals are exact."""

from __future__ import annotations

import numpy as np
import pytest

from rsundistort.errors import InputError
from rsundistort.input.stabilisation import judge_stabilisation
from rsundistort.io.gyro import GyroLog

FRAME_S, NUM_FRAMES = 1 / 30, 150
TURN_SIGMA, PHI_SIGMA = 2e-4, 1e-3


class Motion:
    """Rates of sines about three axes, with the angle between two times in closed form."""

    def __init__(self, *parts):
        self.parts = parts  # (amplitude in rad/s (3,), Hz, phase (3,))

    def __add__(self, other):
        return Motion(*self.parts, *other.parts)

    def rate(self, t):
        t = np.asarray(t)[:, None]
        return sum((a * np.sin(2 * np.pi * f * t + p) for a, f, p in self.parts), np.zeros((len(t), 3)))

    def angle(self, start, end):
        ends = (np.asarray(t)[:, None] for t in (start, end))
        first, last = (
            sum((-a / (2 * np.pi * f) * np.cos(2 * np.pi * f * t + p) for a, f, p in self.parts), np.zeros((1, 3)))
            for t in ends
        )
        return last - first


def motion(seed, rms, low_hz, high_hz):
    rng = np.random.default_rng(seed)
    parts = [
        (rng.normal(0, 1, 3) * rms * np.sqrt(2 / 12), rng.uniform(low_hz, high_hz), rng.uniform(0, 7, 3))
        for _ in range(12)
    ]
    return Motion(*parts)


def clip(seed, frames, lines, true_s, *, scale=1.0, phi_sigma=PHI_SIGMA, **options):
    """The verdict on a clip whose frames rotate by one motion of the camera, and whose lines by another."""
    rng = np.random.default_rng(seed + 1000)
    times = np.arange(NUM_FRAMES) * FRAME_S
    pairs = np.column_stack([np.arange(NUM_FRAMES - 1), np.arange(1, NUM_FRAMES)])
    turns = -scale * frames.angle(times[:-1], times[1:]) + rng.normal(0, TURN_SIGMA, (NUM_FRAMES - 1, 3))
    phi = -lines.angle(times - true_s / 2, times + true_s / 2) + rng.normal(0, phi_sigma, (NUM_FRAMES, 3))
    return judge_stabilisation(times, pairs, turns, phi, phi_sigma, rotation_sigma=TURN_SIGMA, **options)


def log_of(what):
    t = np.arange(-0.5, NUM_FRAMES * FRAME_S + 0.5, 0.0025)
    return GyroLog(t, what.rate(t))


SEEDS = range(5)
NOTHING = Motion()


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_clip_as_the_sensor_saw_it(seed, share):
    """A hand: a pan and shaking of 1 to 5 Hz. The slope is the time of the readout."""
    hand = motion(seed, 0.1, 0.05, 0.3) + motion(seed + 50, 0.3, 1, 5)
    found = clip(seed, hand, hand, share * FRAME_S)
    assert found.verdict == "none"
    assert found.shutter.slope == pytest.approx(share * FRAME_S, rel=0.05)
    assert found.shutter.correlation > 0.8
    again = clip(seed, hand, hand, share * FRAME_S, readout_s=share * FRAME_S, log=log_of(hand))
    assert again.verdict == "none"
    assert again.frames_by_gyro.slope == pytest.approx(1, abs=0.02)
    assert again.shutter_by_gyro.slope == pytest.approx(share * FRAME_S, rel=0.05)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_video_that_runs_backwards_has_both_its_rotation_and_its_shutter(seed):
    """As one of a camera that reads the last line first: its lines rotate against its frames."""
    hand = motion(seed, 0.1, 0.05, 0.3) + motion(seed + 50, 0.3, 1, 5)
    found = clip(seed, hand, hand, -0.02)
    assert found.verdict == "none"
    assert "the other way" in found.reason
    assert not found.read_at_once


@pytest.mark.parametrize("seed", SEEDS)
def test_slow_errors_of_the_lines_are_no_readout_time(seed):
    """What lens and scene leave in the lines, next to a slow pan: the shaking shows the readout, here of 10 ms."""
    hand = motion(seed, 0.1, 0.05, 0.3) + motion(seed + 50, 0.1, 1, 5)
    found = clip(seed, hand, hand + motion(seed + 90, 0.3, 0.05, 0.3), 0.01, phi_sigma=1e-4, log=log_of(hand))
    assert found.shutter.slope == pytest.approx(0.01, rel=0.1)
    assert found.shutter_by_gyro.slope == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_shutter_without_its_rotation(seed):
    """Frames were rotated back as a whole: they pan smoothly, their lines still shake."""
    pan, shaking = motion(seed, 0.1, 0.05, 0.3), motion(seed + 50, 0.3, 1, 5)
    found = clip(seed, pan, pan + shaking, 0.02)
    assert found.verdict == "stabilised"
    assert "a shutter without its rotation" in found.reason
    tripod = clip(seed, NOTHING, shaking, 0.02)
    assert tripod.verdict == "stabilised"
    assert not found.read_at_once
    assert not tripod.read_at_once


@pytest.mark.parametrize("seed", SEEDS)
def test_a_rotation_without_its_shutter(seed):
    """The camera took the shutter out, and left the pan and some shaking."""
    hand = motion(seed, 0.1, 0.05, 0.3) + motion(seed + 50, 0.3, 1, 5)
    found = clip(seed, hand, NOTHING, 0.02)
    assert found.verdict == "stabilised"
    assert "rotation between the frames without its shutter" in found.reason
    assert "expected 3.3 ms or more; if the camera has a global shutter" in found.reason
    assert found.read_at_once
    less = clip(seed, hand, hand, 0.005, readout_s=0.02)
    assert less.verdict == "stabilised"
    assert "expected 20.0 ms" in less.reason
    assert not less.read_at_once
    assert clip(seed, hand, hand, 0.06).verdict == "stabilised"  # longer than from frame to frame


@pytest.mark.parametrize("seed", SEEDS)
def test_smooth_frames_with_the_lines_of_smooth_frames_are_detected_by_a_gyroscope_alone(seed):
    pan, shaking = motion(seed, 0.3, 0.05, 0.3), motion(seed + 50, 0.3, 1, 5)
    assert clip(seed, pan, pan, 0.02).verdict == "none"  # nothing in the pictures says otherwise
    found = clip(seed, pan, pan, 0.02, log=log_of(pan + shaking))
    assert found.verdict == "stabilised"
    assert "of what the gyroscope felt" in found.reason
    lines = clip(seed, pan, pan + shaking, 0.02, log=log_of(pan + shaking))
    assert "their lines as it says" in lines.reason
    assert lines.shutter_by_gyro.slope == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_wrong_focal_length_and_a_bias_are_not_taken_for_stabilisation(seed):
    hand = motion(seed, 0.1, 0.05, 0.3) + motion(seed + 50, 0.3, 1, 5)
    log = log_of(hand)
    biased = GyroLog(log.time_s, log.omega_c + np.array([0.05, -0.03, 0.02]))
    assert clip(seed, hand, hand, 0.02, scale=0.85, log=biased).verdict == "none"


@pytest.mark.parametrize("seed", SEEDS)
def test_a_camera_that_hardly_rotates_tells_nothing(seed):
    still = motion(seed, 0.005, 0.5, 5)
    for frames, lines in ((still, still), (NOTHING, still), (still, NOTHING), (NOTHING, NOTHING)):
        assert clip(seed, frames, lines, 0.02).verdict == "unknown"
        assert clip(seed, frames, lines, 0.02, readout_s=0.02).verdict == "unknown"


def test_false_rotations_and_missing_ones_change_nothing():
    hand = motion(0, 0.1, 0.05, 0.3) + motion(50, 0.3, 1, 5)
    rng = np.random.default_rng(0)
    times = np.arange(NUM_FRAMES) * FRAME_S
    pairs = np.column_stack([np.arange(NUM_FRAMES - 1), np.arange(1, NUM_FRAMES)])
    turns = -hand.angle(times[:-1], times[1:])
    phi = -hand.angle(times - 0.01, times + 0.01) + rng.normal(0, PHI_SIGMA, (NUM_FRAMES, 3))
    turns[rng.choice(len(turns), 6, replace=False)] = rng.normal(0, 0.3, (6, 3))
    phi[rng.choice(NUM_FRAMES, 6, replace=False)] = rng.normal(0, 0.1, (6, 3))
    turns[60:70] = np.nan
    phi[100:105] = np.nan
    found = judge_stabilisation(times, pairs, turns, phi, np.full(phi.shape, PHI_SIGMA))
    assert found.verdict == "none"
    assert found.shutter.slope == pytest.approx(0.02, rel=0.05)


def test_nothing_at_all_is_unknown_and_wrong_shapes_are_refused():
    times = np.arange(5) * FRAME_S
    pairs = np.column_stack([np.arange(4), np.arange(1, 5)])
    assert judge_stabilisation(times, pairs, np.zeros((4, 3)), np.zeros((5, 3)), 1e-3).verdict == "unknown"
    none = judge_stabilisation(times, pairs, np.full((4, 3), np.nan), np.full((5, 3), np.nan), 1e-3)
    assert (none.verdict, str(none)) == ("unknown", none.reason)
    for turns, phi, sigma, readout_s in (
        (np.zeros((3, 3)), np.zeros((5, 3)), 1e-3, None),
        (np.zeros((4, 3)), np.zeros((4, 3)), 1e-3, None),
        (np.zeros((4, 3)), np.zeros((5, 3)), np.zeros(5), None),
        (np.zeros((4, 3)), np.zeros((5, 3)), 1e-3, 0.0),
    ):
        with pytest.raises(InputError):
            judge_stabilisation(times, pairs, turns, phi, sigma, readout_s=readout_s)


@pytest.mark.parametrize("seed", SEEDS)
def test_frames_that_jump_were_not_made_smooth(seed):
    """A mount that vibrates at 40 to 90 Hz: frames do not show how it rotates while they are read."""
    vibrating = motion(seed, 0.1, 0.05, 0.3) + motion(seed + 50, 1.0, 40, 90)
    found = clip(seed, vibrating, vibrating, 0.02)
    assert found.frames_jump
    if found.shows_shaking:
        assert found.reason.startswith("shakes faster than 15 Hz")
    assert not clip(seed, motion(seed, 0.1, 0.05, 0.3), vibrating, 0.02).frames_jump
