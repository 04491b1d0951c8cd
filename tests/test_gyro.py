"""Motions from gyroscopes; the judge is a camera rotated in small steps by plain NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bundle_scenes import make_scene
from critical_scenes import named_scene
from scipy.spatial.transform import Rotation
from solved_scene import cameras_of

from rsundistort import Camera, GyroOptions, RowMotion, RsUndistortWarning
from rsundistort.batch.progress import StageLog
from rsundistort.bundle import BundleOptions, KnownMotions, misses_of
from rsundistort.errors import FileError, FormatError, InputError
from rsundistort.input.gyroscope import gyro_motions, known_readouts
from rsundistort.io import (
    GyroLog,
    VideoFrames,
    bends_from_gyro,
    gyro_offset,
    motions_from_gyro,
    read_gyro,
    read_photo_times,
)
from rsundistort.io.gyro import parse_axes
from rsundistort.model import READOUTS
from rsundistort.solve.known_contradiction import known_contradiction
from rsundistort.solve.model_sequence import solve_tracks
from rsundistort.synthetic import project_rows

READOUT_S = 0.03
BASE = np.array([0.3, -0.5, 0.8])
SLOPE = np.array([0.05, 0.02, -0.03])
SWING = np.array([0.4, 0.3, -0.2])


def rates(t):
    """Angular velocity of the camera about its own axes: steady, growing, and swinging once a second."""
    t = np.asarray(t)[..., None]
    return BASE + SLOPE * t + SWING * np.sin(2 * np.pi * t)


def mean_rates(t, span):
    """Their mean over a span about t, in closed form."""
    t = np.asarray(t)[..., None]
    return BASE + SLOPE * t + SWING * np.sin(2 * np.pi * t) * np.sinc(span)


def log(step_s=0.001, length_s=4.0, **kwargs):
    time_s = np.arange(0, length_s, step_s)
    return GyroLog(time_s, rates(time_s), **kwargs)


def write_csv(path, time_s, omega, columns=("time_s", "wx", "wy", "wz")):
    rows = [",".join(map(repr, [float(t), *map(float, w)])) for t, w in zip(time_s, omega, strict=True)]
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")
    return path


# ---------------------------------------------------------------- phi


def test_phi_is_minus_the_mean_rate_over_the_readout():
    times = {"a.png": 0.7, "b.png": 1.55, "c.png": 2.9}
    known = motions_from_gyro(log(), times, READOUT_S)
    for name, t in times.items():
        # linear between samples a millisecond apart: a swing of 2 pi rad/s is off by 5e-6 of its amplitude
        assert known[name][0] == pytest.approx(-READOUT_S * mean_rates(t, READOUT_S), rel=0, abs=1e-7)
        assert (known[name][1] > 0).all()


@pytest.mark.parametrize("readout", READOUTS)
def test_sign_by_a_camera_that_is_rotated_step_by_step(readout):
    """A gyroscope's rates, integrated sample by sample, show each point where the row model with that phi does."""
    camera = Camera(640, 480, [[600, 0, 319.5], [0, 600, 239.5], [0, 0, 1]], readout=readout)
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-1.5, 1.5, (40, 2)), np.full(40, 4.0)])
    omega = np.array([0.9, -0.6, 1.2])
    axis, sign = READOUTS[readout]
    lines = (camera.height, camera.width)[1 - axis]
    middle = camera.K[axis, 2]
    start = Rotation.from_rotvec([0.1, -0.2, 0.05])  # world from camera when the line of the principal point is read
    line_s = READOUT_S / lines
    seen = np.full((40, 2), np.nan)
    nearest = np.full(40, np.inf)
    for line in range(lines):
        dt = sign * (line - middle) * line_s
        world_from_camera = start * Rotation.from_rotvec(omega * dt)  # what a gyroscope on the camera measures
        q = world_from_camera.inv().apply(points)
        uv = q[:, :2] / q[:, 2:] * 600 + camera.K[:2, 2]
        off = np.abs(uv[:, axis] - line)
        better = off < nearest
        seen[better], nearest[better] = uv[better], off[better]
    inside = nearest < 0.6
    assert inside.sum() > 15
    times = np.arange(0, 1, 0.001)
    phi_frame, _ = motions_from_gyro(GyroLog(times, np.tile(omega, (len(times), 1))), {"x": 0.5}, READOUT_S)["x"]
    motion = RowMotion(phi_frame / camera.frame_span)
    uv, valid = project_rows(points, start.inv().as_matrix(), np.zeros(3), motion, camera)
    assert valid[inside].all()
    # the line that shows a point is known to half a pixel, which moves it by half a line's share of the motion
    assert np.abs(uv - seen)[inside].max() < 0.05
    still, _ = project_rows(points, start.inv().as_matrix(), np.zeros(3), RowMotion(), camera)
    assert np.abs(still - seen)[inside].max() > 3


@pytest.mark.parametrize("readout", READOUTS)
def test_bend_is_what_the_integral_of_the_rate_has_beside_its_line(readout):
    """About one axis in closed form, at 50 Hz and 30 ms: one and a half periods a frame."""
    camera = Camera(640, 480, [[600, 0, 300], [0, 610, 250], [0, 0, 1]], readout=readout)
    time_s = np.arange(0, 2, 1e-4)
    axis = np.array([0.6, -0.8, 0.0])
    shaking = GyroLog(time_s, np.outer(1.5 + 4 * np.sin(100 * np.pi * time_s), axis))
    phi, bend = bends_from_gyro(shaking, {"a": 0.5}, READOUT_S, {"a": camera}, offset_s=0.2)["a"]
    start, end = camera.clock_range
    clock = np.linspace(start, end, 5001)
    at = 0.7 + READOUT_S * ((clock - start) / (end - start) - 0.5)
    angle = -(1.5 * at - 4 * np.cos(100 * np.pi * at) / (100 * np.pi))  # the world rotates the other way
    slope, mean = np.polyfit(clock, angle, 1)
    # samples 0.1 ms apart, linear between: a share of (0.1 ms x 100 pi)^2 / 12 of 4 / 100 pi, 1e-6 rad
    assert phi == pytest.approx(slope * (end - start) * axis, abs=3e-6)
    assert bend.at(clock)[0] == pytest.approx(np.outer(angle - slope * clock - mean, axis), abs=3e-6)
    assert np.abs(bend.rotation).max() > 0.005
    assert not bend.moves
    assert (bend.start, bend.end) == (start, end)


def test_steady_rates_have_no_bend_and_photos_without_a_log_none_either():
    camera = Camera(640, 480, [[600, 0, 300], [0, 610, 250], [0, 0, 1]])
    time_s = np.arange(0, 1, 0.002)
    steady = GyroLog(time_s, np.tile(BASE, (len(time_s), 1)))
    found = bends_from_gyro(steady, {"a": 0.5, "b": 0.999}, {"a": 0.02, "b": 0.02}, {"a": camera, "b": camera})
    assert list(found) == ["a"]
    assert found["a"][0] == pytest.approx(-0.02 * BASE, abs=1e-12)
    assert np.abs(found["a"][1].rotation).max() < 1e-12


def test_each_photo_may_have_its_own_readout():
    known = motions_from_gyro(log(), {"a": 1.0, "b": 1.0}, {"a": 0.01, "b": 0.02})
    assert known["a"][0] == pytest.approx(-0.01 * mean_rates(1.0, 0.01), rel=0, abs=1e-7)
    assert known["b"][0] == pytest.approx(-0.02 * mean_rates(1.0, 0.02), rel=0, abs=1e-7)


def test_offset_is_added_to_the_photos_times():
    known = motions_from_gyro(log(), {"a": 0.2}, READOUT_S, offset_s=1.3)
    assert known["a"][0] == pytest.approx(-READOUT_S * mean_rates(1.5, READOUT_S), rel=1e-5)


def test_sigma_grows_with_each_thing_that_is_uncertain(rng):
    def sigma(log_, readout_s=READOUT_S, **kwargs):
        return motions_from_gyro(log_, {"a": 1.0}, readout_s, **kwargs)["a"][1]

    time_s = np.arange(0, 2, 0.002)
    still = GyroLog(time_s, np.zeros((len(time_s), 3)))
    assert sigma(still) == pytest.approx(np.full(3, READOUT_S * 0.01))  # the zero-rate offset alone
    noisy = GyroLog(time_s, rng.normal(0, 0.2, (len(time_s), 3)))
    assert noisy.noise == pytest.approx(np.full(3, 0.2), rel=0.1)
    # 15 samples are averaged; what they happen to be comes on top
    assert (sigma(noisy) > READOUT_S * 0.2 / np.sqrt(15)).all()
    steady = GyroLog(time_s, np.full((len(time_s), 3), 2.0))
    assert sigma(steady) == pytest.approx(np.full(3, READOUT_S * np.hypot(0.01, 0.03 * 2.0)))
    swinging = GyroLog(time_s, np.tile(np.sin(2 * np.pi * 3 * (time_s - 1.0))[:, None], 3))
    assert (sigma(swinging, offset_sigma_s=0.01) > 1.3 * sigma(swinging)).all()
    assert (sigma(swinging) > READOUT_S * 0.1).all()  # it rotates by 0.57 rad/s more at the last line than at the first


def test_mean_of_a_piecewise_linear_rate_is_exact(rng):
    time_s = np.cumsum(rng.uniform(0.5, 1.5, 50))
    uneven = GyroLog(time_s, rng.normal(size=(50, 3)))
    fine = np.linspace(10.3, 31.7, 400_001)
    slow = np.stack([np.interp(fine, time_s, uneven.omega_c[:, k]) for k in range(3)], axis=1)
    expected = ((slow[1:] + slow[:-1]) / 2).mean(axis=0)
    assert uneven.mean(np.array(10.3), np.array(31.7)) == pytest.approx(expected, abs=1e-6)


def test_a_solution_far_from_known_motions_is_reported():
    rec = named_scene("random", m=4)
    found = np.array([[0.02, -0.01, 0.03], [0.01, 0.02, 0.0], [-0.02, 0.01, 0.01], [0.0, 0.0, 0.02]])
    rec = replace(rec, shutter_model="rotation", phi=found / rec.frame_span()[:, None])
    near = {name: (phi + 0.001, np.full(3, 0.001)) for name, phi in zip(rec.image_names, found, strict=True)}
    assert known_contradiction(rec, near, {}) is None
    assert known_contradiction(rec, {}, {}) is None
    reversed_ = {name: (-phi, np.full(3, 0.001)) for name, phi in zip(rec.image_names[1:], found[1:], strict=True)}
    # twice the root mean square of nine numbers that sum, squared, to 15e-4
    assert "gyroscope, by 26 times the uncertainty" in (known_contradiction(rec, reversed_, {}) or "")
    assert "(--known), by 26 times the uncertainty" in (known_contradiction(rec, {}, reversed_) or "")
    one, other = dict(list(reversed_.items())[:1]), dict(list(reversed_.items())[1:])
    assert "the gyroscope and the known motions (--known), by 26" in (known_contradiction(rec, one, other) or "")
    still = replace(rec, shutter_model="global")
    assert known_contradiction(still, reversed_, {}) is None
    worse = KnownMotions(gain=-12.3, is_better=False, free_gain=0.0, miss=0.0, size=20.0)
    said = known_contradiction(still, reversed_, {}, worse) or ""
    assert "they predict the photos worse than none (by -12.3 standard errors)" in said
    # what is within its own uncertainty may predict worse than none
    assert known_contradiction(still, reversed_, {}, replace(worse, size=2.0)) is None
    # and the photos of a gyroscope that rests may be bent by their lens
    assert not replace(worse, gain=0.0, size=2.0, miss=9.0).is_contradicted
    assert replace(worse, gain=0.0, miss=9.0).is_contradicted


def test_unknown_components_say_nothing_of_a_contradiction():
    rec = named_scene("random", m=4)
    rec = replace(rec, shutter_model="rotation", phi=np.full((4, 3), 0.01) / rec.frame_span()[:, None])
    sigma = np.array([0.001, np.inf, np.inf])
    known = {name: (np.zeros(3), sigma) for name in rec.image_names}
    assert misses_of(rec, known) == pytest.approx(10.0)
    assert misses_of(rec, {name: (np.zeros(3), np.full(3, np.inf)) for name in rec.image_names}) == 0.0


@pytest.mark.parametrize("model", ["auto", "rotation"])
def test_motions_that_the_photos_contradict_are_left_out(rng, model):
    scene = make_scene(rng, "rotation", num_images=8, num_points=300, noise_px=0.2, phi_size=0.01)
    start = replace(scene, phi=np.zeros_like(scene.phi), shutter_model="global")
    true = scene.phi * scene.frame_span()[:, None]

    def solved(known):
        options = BundleOptions(known_phi=known)
        return solve_tracks(start, cameras_of(start), model, 0, lambda _: options, StageLog(None), "none")

    names, sigma = scene.image_names, np.full(3, 5e-4)
    right, wrong = (
        solved({name: (way * phi, sigma) for name, phi in zip(names, true, strict=True)}) for way in (1.0, -1.0)
    )
    assert right.known_motions is not None
    assert not right.known_motions.is_contradicted
    assert wrong.known_motions is not None
    assert wrong.known_motions.is_contradicted
    np.testing.assert_array_equal(wrong.shared.phi, solved({}).shared.phi)


# ---------------------------------------------------------------- what the log covers


def test_photos_outside_the_log_are_left_out_with_a_warning():
    with pytest.warns(RsUndistortWarning, match="2 of 3 photos, such as early"):
        known = motions_from_gyro(log(), {"early": 0.01, "a": 1.0, "late": 3.99}, READOUT_S)
    assert list(known) == ["a"]


def test_photos_in_a_gap_of_the_log_are_left_out():
    time_s = np.concatenate([np.arange(0, 1, 0.01), np.arange(1.5, 3, 0.01)])
    with pytest.warns(RsUndistortWarning, match="1 of 2 photos, such as gap"):
        known = motions_from_gyro(GyroLog(time_s, rates(time_s)), {"gap": 1.2, "a": 2.0}, READOUT_S)
    assert list(known) == ["a"]


def test_a_log_of_another_time_is_refused():
    with pytest.raises(InputError, match=r"from 0\.000 to 3\.999 s.*taken from 99\.000 to 100\.000 s.*offset"):
        motions_from_gyro(log(), {"a": 99.0, "b": 100.0}, READOUT_S)
    with pytest.raises(InputError, match="positive"):
        motions_from_gyro(log(), {"a": 1.0}, 0.0)


@pytest.mark.parametrize(
    ("time_s", "omega"),
    [([0.0], [[0, 0, 0]]), ([0, 0], np.zeros((2, 3))), ([1, 0], np.zeros((2, 3))), ([0, np.nan], np.zeros((2, 3)))],
)
def test_logs_are_checked(time_s, omega):
    with pytest.raises(InputError):
        GyroLog(np.array(time_s, float), np.array(omega, float))


# ---------------------------------------------------------------- axes and files


def test_axes_name_what_lies_to_the_right_down_and_ahead():
    assert np.array_equal(parse_axes("XYZ"), np.eye(3))
    # the sensor's y points left, its x down, its z ahead: it rotates by (1, 2, 3) about its own axes
    assert parse_axes("yXZ") @ [1, 2, 3] == pytest.approx([-2, 1, 3])
    for text in ("XY", "XXZ", "xyzz", "ABC", ""):
        with pytest.raises(InputError, match="expected X, Y and Z"):
            parse_axes(text)
    with pytest.warns(RsUndistortWarning, match="mirror"):
        parse_axes("xYZ")


def test_csv(tmp_path):
    time_s = np.arange(0, 1, 0.01)
    path = write_csv(tmp_path / "gyro.csv", time_s, rates(time_s))
    found = read_gyro(path)
    assert np.array_equal(found.time_s, time_s)
    assert np.array_equal(found.omega_c, rates(time_s))
    assert found.readout_s is None
    assert read_gyro(path, "yXZ").omega_c == pytest.approx(rates(time_s)[:, [1, 0, 2]] * [-1, 1, 1])


def test_csv_with_other_columns_and_a_line_that_was_cut_off(tmp_path):
    path = tmp_path / "gyro.csv"
    path.write_text("\ufeffn, wz ,time_s,wx,wy\n1,3,0.0,1,2\n2,6,0.1,4,5\n3,9,0.2,7", encoding="utf-8")
    with pytest.warns(RsUndistortWarning, match="cut off"):
        found = read_gyro(path)
    assert found.omega_c == pytest.approx(np.array([[1, 2, 3], [4, 5, 6]]))


def test_empty_cells_behind_the_columns_of_a_log_are_none(tmp_path):
    path = tmp_path / "gyro.csv"
    path.write_text("time_s,wx,wy,wz\n0.0,1,2,3,, \n0.1,4,5,6,\n")
    assert read_gyro(path).omega_c == pytest.approx(np.array([[1, 2, 3], [4, 5, 6]]))


def test_samples_of_one_time_are_one(tmp_path):
    path = write_csv(tmp_path / "g.csv", [0, 0.001, 0.001, 0.002], [[0, 0, 0], [1, 2, 3], [3, 2, 1], [0, 0, 0]])
    assert read_gyro(path).omega_c[1] == pytest.approx([2, 2, 2])


GCSV = """GYROFLOW IMU LOG
version,1.3
id,custom_logger_name
orientation,{orientation}
note,a note, with commas
frame_readout_time,15.23
tscale,0.001
gscale,0.002
ascale,0.0005
t,gx,gy,gz,ax,ay,az
0,39,86,183,-1137,-15689,-2986
1,56,100,202,-1179,-15694,-2887
2,63,108,218,-1247,-15702,-2794
"""


def test_gcsv(tmp_path):
    """Gyroflow's axes are up, left and back; XYZ is a sensor that lies along them."""
    path = tmp_path / "log.gcsv"
    path.write_text(GCSV.format(orientation="XYZ"))
    found = read_gyro(path)
    assert found.time_s == pytest.approx([0, 0.001, 0.002])
    assert found.omega_c[0] == pytest.approx(0.002 * np.array([-86, -39, -183]))
    assert found.readout_s == pytest.approx(0.01523)
    # right is where y does not point, down where x does not, ahead where z does not
    assert np.array_equal(read_gyro(path, "yxz").omega_c, found.omega_c)


def test_gcsv_of_another_orientation(tmp_path):
    """Letters say which axis of the sensor lies up, left, back: here -z is up, y left, x back."""
    path = tmp_path / "log.gcsv"
    path.write_text(GCSV.format(orientation="zYX"))
    assert read_gyro(path).omega_c[0] == pytest.approx(0.002 * np.array([-86, 183, -39]))


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.csv", "time_s,wx,wy\n0,1,2\n", "no column 'wz'"),
        ("a.csv", "", "no column 'time_s'"),
        ("a.csv", "time_s,wx,wy,wz\n", "two samples"),
        ("a.csv", "time_s,wx,wy,wz\n0,1,2,3\n", "two samples"),
        ("a.csv", "time_s,wx,wy,wz\n0,1,2,3\n1,x,2,3\n2,1,2,3\n", "could not convert"),
        ("a.csv", "time_s,wx,wy,wz\n0,1,2,3\n2,1,2,3\n1,1,2,3\n", "sample 3: the time goes back"),
        ("a.csv", "time_s,wx,wy,wz\n0,1,2,3\n2,1,nan,3\n", "NaN"),
        ("a.csv", "time_s,wx,wy,wz\n0,1,2,3\n0,01,1,2,3\n1,1,2,3\n", "line 3 has more cells than the 4 columns"),
        ("a.csv", "time_s,wx,wy,wz,wx\n0,1,2,3,4\n1,1,2,3,4\n", "two columns 'wx'"),
        (
            "a.gcsv",
            GCSV.format(orientation="XYZ") + "3,63,1,2,3,4,5,6,7\n",
            "line 14 has more cells than the 7 columns",
        ),
        ("a.gcsv", GCSV.replace("gscale,0.002\n", "").format(orientation="XYZ"), "no gscale"),
        ("a.gcsv", GCSV.replace("tscale,0.001", "tscale,quick").format(orientation="XYZ"), "quick"),
        ("a.gcsv", GCSV.replace("orientation,{orientation}\n", ""), "give --gyro-axes"),
        ("a.gcsv", GCSV.format(orientation="XYY"), "expected X, Y and Z"),
        ("a.gcsv", "GYROFLOW IMU LOG\nversion,1\n", "begins its samples"),
        ("a.gcsv", GCSV.split("0,39")[0].format(orientation="XYZ"), "two samples"),
    ],
)
def test_bad_logs_are_refused(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=says):
        read_gyro(tmp_path / name)


def test_missing_and_binary_logs_are_refused(tmp_path):
    with pytest.raises(FileError, match=r"none\.csv"):
        read_gyro(tmp_path / "none.csv")
    (tmp_path / "noise.csv").write_bytes(bytes(range(256)) * 20)
    with pytest.raises(FormatError):
        read_gyro(tmp_path / "noise.csv")


def test_photo_times(tmp_path):
    path = tmp_path / "frames.csv"
    path.write_text("name,frame,time_s\na.png,0,0.0\nb.png,1,\nc.png,2,0.066\n")
    assert read_photo_times(path) == {"a.png": 0.0, "c.png": 0.066}
    for cells, says in (
        ("name\na", "name, time_s"),
        ("name,time_s\na,x", "line 2"),
        ("name,time_s\na,1\na,2", "twice"),
    ):
        path.write_text(cells)
        with pytest.raises(FormatError, match=says):
            read_photo_times(path)


# ---------------------------------------------------------------- the offset of the clocks


def test_offset_is_found_from_a_solution(rng):
    """White shaking, low-passed as hands do it; the solution's phi carry an error of 0.3 mrad."""
    time_s = np.arange(0, 30, 0.005)
    shaking = rng.normal(size=(len(time_s), 3))
    smooth = np.stack([np.convolve(shaking[:, k], np.hanning(60) / 10, "same") for k in range(3)], axis=1)
    shaken = GyroLog(time_s, smooth)
    times = np.arange(5, 20, 0.5)
    truth = 1.2345
    phi = np.stack(
        [v[0] for v in motions_from_gyro(shaken, dict(enumerate(times)), READOUT_S, offset_s=truth).values()]
    )
    found, correlation = gyro_offset(shaken, times, phi + rng.normal(0, 3e-4, phi.shape), READOUT_S, largest_s=5)
    assert found == pytest.approx(truth, abs=0.002)
    assert correlation > 0.99
    _, wrong = gyro_offset(shaken, times, -phi, READOUT_S, largest_s=5)
    assert wrong < 0.8
    with pytest.raises(InputError, match="no offset"):
        gyro_offset(shaken, times + 100, phi, READOUT_S, largest_s=5)


# ---------------------------------------------------------------- in a run


def test_photos_find_their_times_and_readouts(tmp_path):
    time_s = np.arange(0, 4, 0.001)
    gyro = GyroOptions(write_csv(tmp_path / "gyro.csv", time_s, rates(time_s)), offset_s=0.5)
    readouts = {"a.jpg": READOUT_S, "b.jpg": READOUT_S, "c.jpg": None}
    cameras = dict.fromkeys(readouts, Camera(640, 480, [[600, 0, 319.5], [0, 600, 239.5], [0, 0, 1]]))
    with pytest.raises(InputError, match="--photo-times"):
        gyro_motions(tmp_path, gyro, gyro.log(), readouts, cameras)
    (tmp_path / "frames.csv").write_text("name,time_s\nb.jpg,1.0\nother.jpg,2.0\n")
    known, bends = gyro_motions(tmp_path, gyro, gyro.log(), readouts, cameras)
    assert list(known) == list(bends) == ["b.jpg"]
    # the slope of the rotation, which differs from its mean by what the rate curves: a swing a second in 0.03 s
    assert known["b.jpg"][0] == pytest.approx(-READOUT_S * mean_rates(1.5, READOUT_S), rel=1e-3)
    assert 0 < np.abs(bends["b.jpg"].rotation).max() < 1e-3
    (tmp_path / "times.csv").write_text("name,time_s\nc.jpg,1.0\n")
    with pytest.raises(InputError, match=r"c\.jpg .*--readout-ms"):
        gyro_motions(tmp_path, replace(gyro, times=tmp_path / "times.csv"), gyro.log(), readouts, cameras)
    (tmp_path / "times.csv").write_text("name,time_s\nz.jpg,1.0\n")
    with pytest.raises(InputError, match=r"none of the photos, such as a\.jpg"):
        gyro_motions(tmp_path, replace(gyro, times=tmp_path / "times.csv"), gyro.log(), readouts, cameras)
    (tmp_path / "times.csv").write_text("name,time_s\nb.jpg,1.0\nA.jpg,1.0\n")
    with pytest.raises(InputError, match=r"times\.csv: 'A\.jpg' is not among the photos"):
        gyro_motions(tmp_path, replace(gyro, times=tmp_path / "times.csv"), gyro.log(), readouts, cameras)
    (tmp_path / "A.jpg").write_bytes(b"left out, since it cannot be read")
    assert list(gyro_motions(tmp_path, replace(gyro, times=tmp_path / "times.csv"), gyro.log(), readouts, cameras)[0])
    with pytest.raises(InputError, match="expected seconds"):
        GyroOptions(gyro.file, offset_s=float("nan"))


def test_who_says_how_long_the_readout_takes():
    """The user before the log, the log before the table."""
    camera = Camera(1280, 720, [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]])
    other = Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
    frames = VideoFrames(("a.png",), np.zeros(1), 1, 0, 1, "Apple", "iPhone 6s")
    stated = log(readout_s=0.02)

    def known(given_s, log_):
        return known_readouts([frames] * 2, [camera, other], [0, 1], given_s, log_)

    assert known(0.03, stated) == {0: (0.03, "given"), 1: (0.03, "given")}
    assert known(None, stated) == dict.fromkeys((0, 1), (0.02, "the gyroscope's log"))
    found = known(None, log())
    assert list(found) == [0]  # the other's size is not in the table
    assert found[0][0] == pytest.approx(0.01501)
