"""Gyroscopes found from rotations between frames; the judge is a camera rotated by SciPy in steps of a millisecond."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from rsundistort.errors import InputError
from rsundistort.input.gyro_alignment import GyroAlignment, NoAlignment, align_gyro
from rsundistort.io.gyro import GyroLog, motions_from_gyro, parse_axes

STEP_S, LENGTH_S, FRAME_S = 0.001, 14.0, 1 / 30
NUM_FRAMES = 300
FIRST_S = 2.0  # when the first frame is taken, by the clock of the rotating camera


@cache
def walk(seed=0, kind="hand"):
    """Rates (n, 3) about the camera's axes, and its orientations, world from camera, at the end of each step."""
    rng = np.random.default_rng(seed)
    n = round(LENGTH_S / STEP_S)
    omega = gaussian_filter1d(rng.normal(size=(n, 3)), 0.03 / STEP_S, axis=0)
    omega *= 0.3 / omega.std(0)
    if kind == "pan":  # about the vertical axis alone
        omega = omega * [0, 1, 0] + [0, 0.2, 0]
    elif kind == "still":
        omega = omega * 0.01
    elif kind == "even":
        omega = omega * 0.0 + [0.0, 0.4, 0.0]
    elif kind == "repeats":
        t = np.arange(n) * STEP_S
        omega = np.stack([np.sin(2 * np.pi * (2 * t + k / 3)) * (0.2 + 0.1 * k) for k in range(3)], axis=1)
    steps = Rotation.from_rotvec(omega * STEP_S)
    size = 1
    while size < n:  # products of all before
        steps = Rotation.concatenate([steps[:size], steps[:-size] * steps[size:]])
        size *= 2
    return omega, steps


def frames(seed=0, kind="hand", noise_rad=3e-4, scale=1.0, outliers=0):
    """Times by the camera's clock, which shows zero at the first frame, pairs of neighbours, and rotations."""
    rng = np.random.default_rng(seed + 100)
    _, orientation = walk(seed, kind)
    times = np.arange(NUM_FRAMES) * FRAME_S
    at = orientation[np.round((times + FIRST_S) / STEP_S).astype(int) - 1].inv()  # camera from world
    turns = scale * (at[1:] * at[:-1].inv()).as_rotvec() + rng.normal(0, noise_rad, (NUM_FRAMES - 1, 3))
    false = rng.choice(len(turns), outliers, replace=False)
    turns[false] = rng.normal(0, 0.3, (outliers, 3))
    return times, np.column_stack([np.arange(NUM_FRAMES - 1), np.arange(1, NUM_FRAMES)]), turns


def gyroscope(seed=0, kind="hand", camera_from_gyro=None, bias=(0, 0, 0), offset_s=0.0, noise=0.01, rate_hz=200):
    """Its log; its clock shows `offset_s` at the first frame."""
    rng = np.random.default_rng(seed + 200)
    omega, _ = walk(seed, kind)
    index = np.arange(0, len(omega), round(1 / rate_hz / STEP_S))
    time_s = (index + 0.5) * STEP_S  # the middle of a step
    measured = (
        omega[index] @ (np.eye(3) if camera_from_gyro is None else camera_from_gyro)
        + bias
        + rng.normal(0, noise, (len(index), 3))
    )
    return GyroLog(time_s - FIRST_S + offset_s, measured, readout_s=0.02)


def angle_deg(a, b):
    return np.degrees(Rotation.from_matrix(a @ b.T).magnitude())


@pytest.mark.parametrize("axes", ["XYZ", "yXZ", "yxz", "ZXY", "Xyz", "zyx"])
def test_axes_offset_and_bias_are_found(axes):
    camera_from_gyro = parse_axes(axes)
    log = gyroscope(camera_from_gyro=camera_from_gyro, bias=(0.02, -0.03, 0.01), offset_s=1.234)
    found = align_gyro(log, *frames())
    assert isinstance(found, GyroAlignment)
    assert (found.axes, found.also) == (axes, ())
    assert angle_deg(found.camera_from_gyro, camera_from_gyro) < 0.3
    assert found.offset_s == pytest.approx(1.234, abs=min(0.001, 4 * found.offset_sigma_s))
    assert found.bias == pytest.approx([0.02, -0.03, 0.01], abs=0.003)
    assert found.ratio == pytest.approx(1, abs=0.005)
    assert found.correlation > 0.99
    assert (found.axis_correlations > 0.99).all()
    # 0.3 mrad in each rotation of a thirtieth of a second, and what the gyroscope's noise leaves of seven samples
    assert found.rms == pytest.approx(np.hypot(3e-4 / FRAME_S, 0.01 / np.sqrt(6.7)), rel=0.15)
    assert axes in str(found)


def test_an_offset_that_is_roughly_known_may_be_any():
    day = 1.7e9  # seconds since 1970, as phones log
    found = align_gyro(gyroscope(offset_s=day + 1.234), *frames(), around_s=day + 8)
    assert isinstance(found, GyroAlignment)
    assert found.offset_s - day == pytest.approx(1.234, abs=min(0.001, 4 * found.offset_sigma_s))


def test_the_log_in_the_camera_is_what_a_run_needs():
    log = gyroscope(camera_from_gyro=parse_axes("yXZ"), bias=(0.05, 0.02, -0.04), offset_s=-0.4, noise=0.001)
    found = align_gyro(log, *frames(noise_rad=1e-5))
    known = motions_from_gyro(found.in_camera(log), {"a": 5.0}, 0.02, offset_s=found.offset_s)
    omega, _ = walk()
    truth = omega[round((5.0 + FIRST_S - 0.01) / STEP_S) : round((5.0 + FIRST_S + 0.01) / STEP_S)].mean(0)
    assert known["a"][0] == pytest.approx(-0.02 * truth, abs=0.02 * 0.01)
    assert found.in_camera(log).readout_s == 0.02


def test_a_sensor_a_few_degrees_off_its_axes():
    tilted = Rotation.from_rotvec(np.radians([4, -3, 5])).as_matrix() @ parse_axes("ZXY")
    found = align_gyro(gyroscope(camera_from_gyro=tilted), *frames())
    assert found.axes == "ZXY"
    assert angle_deg(found.camera_from_gyro, tilted) < 0.3
    assert (found.axes_sigma_deg < 0.2).all()


def test_a_sensor_that_lies_across():
    across = Rotation.from_rotvec(np.radians([10, 35, -20])).as_matrix()
    found = align_gyro(gyroscope(camera_from_gyro=across, offset_s=0.3), *frames())
    assert found.axes is None
    assert angle_deg(found.camera_from_gyro, across) < 0.3
    assert found.offset_s == pytest.approx(0.3, abs=0.001)
    assert "oblique" in str(found)


def test_false_rotations_and_missing_ones_do_no_harm():
    times, pairs, turns = frames(outliers=25)
    turns[40:50] = np.nan
    found = align_gyro(gyroscope(camera_from_gyro=parse_axes("yxz"), offset_s=0.5), times, pairs, turns)
    assert found.axes == "yxz"
    assert found.offset_s == pytest.approx(0.5, abs=0.001)
    assert found.num_rotations == len(turns) - 10
    assert found.num_inliers == pytest.approx(len(turns) - 35, abs=6)


def test_a_wrong_focal_length_shows_as_the_ratio():
    found = align_gyro(gyroscope(offset_s=0.1), *frames(scale=1.2))
    assert found.ratio == pytest.approx(1.2, abs=0.01)
    assert found.offset_s == pytest.approx(0.1, abs=0.001)


def test_standard_deviations_are_honest():
    """Errors over twenty draws of noise, in their standard deviations."""
    log = gyroscope(offset_s=0.7, noise=1e-4)
    errors = []
    times, pairs, _ = frames()
    clean = frames(noise_rad=0)[2]
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(0, 1e-3, clean.shape)
        found = align_gyro(log, times, pairs, clean + noise, largest_s=1.5)
        off = Rotation.from_matrix(found.camera_from_gyro).as_rotvec(degrees=True)
        errors.append([(found.offset_s - 0.7) / found.offset_sigma_s, *(off / found.axes_sigma_deg)])
    # rms of twenty normal numbers: 0.69 to 1.31 at two standard deviations
    assert (np.sqrt(np.mean(np.square(errors), axis=0)) > 0.6).all()
    assert (np.sqrt(np.mean(np.square(errors), axis=0)) < 1.5).all()


def test_a_pan_tells_one_axis_and_the_rest_stays_what_the_log_says():
    found = align_gyro(gyroscope(kind="pan", offset_s=0.2), *frames(kind="pan"))
    assert found.axes == "XYZ"
    assert set(found.also) == {"zYX", "ZYx", "xYz"}
    assert found.axis_correlations[1] > 0.99
    assert found.offset_s == pytest.approx(0.2, abs=0.001)
    # what is assumed of sensors, 5 degrees, but for what the gyroscope's noise looks like
    assert 3 < found.axes_sigma_deg[1] <= 5.1
    assert (found.axes_sigma_deg[[0, 2]] < 0.5).all()
    turned = align_gyro(gyroscope(kind="pan", camera_from_gyro=parse_axes("yXZ")), *frames(kind="pan"))
    assert {turned.axes, *turned.also} == {"yXZ", "YXz", "ZXY", "zXy"}  # x is down


def test_a_clip_of_a_long_log():
    log = gyroscope(offset_s=-1.5)
    times, pairs, turns = frames()
    found = align_gyro(log, times[:120], pairs[:119], turns[:119])
    assert found.offset_s == pytest.approx(-1.5, abs=0.002)


def test_frames_apart_and_uneven_times():
    _, orientation = walk()
    times = np.cumsum(np.random.default_rng(3).uniform(0.02, 0.06, 200))
    at = orientation[np.round((times + FIRST_S) / STEP_S).astype(int) - 1].inv()
    pairs = np.concatenate([np.column_stack([np.arange(200 - k), np.arange(k, 200)]) for k in (1, 2)])
    turns = (at[pairs[:, 1]] * at[pairs[:, 0]].inv()).as_rotvec()
    found = align_gyro(gyroscope(offset_s=0.4, camera_from_gyro=parse_axes("zyx")), times, pairs, turns)
    assert found.axes == "zyx"
    assert found.offset_s == pytest.approx(0.4, abs=0.001)


# ---------------------------------------------------------------- what is refused, and why


def test_a_log_of_another_clip_is_refused():
    for seed in (1, 2, 3):
        found = align_gyro(gyroscope(seed=seed), *frames())
        assert isinstance(found, NoAlignment)
        assert "another clip, or the video is stabilised" in found.reason
        assert found.correlation < 0.7


def test_a_log_that_drifts_is_of_another_clip_wherever_it_fits_best():
    for seed in range(3):
        time_s = np.arange(0, 12, 0.005)
        drift = np.random.default_rng(seed).normal(size=(len(time_s), 3)).cumsum(0)
        found = align_gyro(GyroLog(time_s, 0.3 * drift / np.abs(drift).max()), *frames())
        assert isinstance(found, NoAlignment)
        assert "another clip" in found.reason


def test_a_mirror_image_is_named():
    log = gyroscope(offset_s=0.3)
    mirrored = GyroLog(log.time_s, log.omega_c * [1, 1, -1])
    found = align_gyro(mirrored, *frames())
    assert isinstance(found, NoAlignment)
    assert "mirror image of the camera's, as XYz takes them" in found.reason
    times, pairs, turns = frames()
    assert "as xyz takes them" in str(align_gyro(log, times, pairs, -turns))  # the sign of rotations


@pytest.mark.parametrize(
    ("kind", "says"), [("still", "stood still"), ("even", "rotated uniformly"), ("repeats", "rotations repeat")]
)
def test_motions_that_tell_nothing(kind, says):
    found = align_gyro(gyroscope(kind=kind), *frames(kind=kind))
    assert isinstance(found, NoAlignment), str(found)
    assert says in found.reason


def test_too_little():
    times, pairs, turns = frames()
    assert "too few" in align_gyro(gyroscope(), times, pairs[:10], turns[:10]).reason
    assert "too few" in align_gyro(gyroscope(), times, pairs, np.full_like(turns, np.nan)).reason
    assert "did not move" in align_gyro(gyroscope(), times, pairs, np.zeros_like(turns)).reason
    dead = GyroLog(np.arange(0.0, 10.0, 0.01), np.zeros((1000, 3)))
    assert "did not move" in align_gyro(dead, times, pairs, turns).reason
    far = gyroscope(offset_s=1e6)
    assert "no offset up to 10 s" in align_gyro(far, times, pairs, turns).reason
    assert "no offset within 10 s of 50 s" in align_gyro(far, times, pairs, turns, around_s=50).reason
    with pytest.raises(InputError, match="expected"):
        align_gyro(gyroscope(), times, pairs, turns[:5])
    with pytest.raises(InputError, match="pairs"):
        align_gyro(gyroscope(), times, pairs.astype(float), turns)
    with pytest.raises(InputError, match="connect frames"):
        align_gyro(gyroscope(), times[:100], pairs, turns)
