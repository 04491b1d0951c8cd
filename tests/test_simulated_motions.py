"""Simulated motions that are not steady: against closed forms, SciPy's rotations row by row, and the photos."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from make_photos import exif_block, save_png, save_textures, texture
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RowMotion, RsUndistortWarning
from rsundistort.batch import rectify_folder
from rsundistort.errors import FormatError, InputError
from rsundistort.io import GyroLog, read_photo, read_solution
from rsundistort.io.cameras import camera_to_json
from rsundistort.io.photos.images import write_image
from rsundistort.io.photos.metadata import Metadata
from rsundistort.model import READOUTS
from rsundistort.simulate import WarpOptions, read_motion_file, simulate_warp
from rsundistort.synthetic import Vibration, load_recipe
from rsundistort.synthetic.unsteady import RowTable, accelerations, read_row_tables, tracks, unsteady, vibrations

CAMERA = Camera(320, 240, [[300, 0, 161.5], [0, 310, 118.25], [0, 0, 1]], [-0.05, 0.01, 0.001, -0.001])
GIVEN = "300,310,161.5,118.25,-0.05,0.01,0.001,-0.001"
COURTYARD = Path(__file__).parents[1] / "sample_scenes" / "courtyard"


def readings(camera, num=101):
    start, end = camera.clock_range
    return np.linspace(start, end, num)


def lines_of(camera):
    """Rows or columns, and the clock when each was read."""
    axis, sign = READOUTS[camera.readout]
    lines = np.arange((camera.width, camera.height)[axis])
    return lines, sign * (lines - camera.K[axis, 2]) / camera.K[axis, axis]


def test_accelerated_rotation_about_one_axis_has_its_closed_form():
    clock = readings(CAMERA)
    middle, half = clock.mean(), (clock[-1] - clock[0]) / 2
    phi, share = np.array([0, 0.06, 0]), np.array([9.0, 0.5, -9.0])
    motion, turn, way = unsteady("a", CAMERA, RowMotion(phi), share)
    # the integral of phi (1 + share s), less its mean: of s^2 over the frame that is 1/3
    bent = phi * 0.5 * half * (((clock - middle) / half) ** 2 / 2 - 1 / 6)[:, None]
    np.testing.assert_allclose(motion.phi, phi, atol=1e-12)
    np.testing.assert_allclose(motion.at(clock)[0], clock[:, None] * phi + bent, atol=1e-12)
    np.testing.assert_allclose(Rotation.from_matrix(turn).as_rotvec(), phi * 0.5 * half / 6, atol=1e-12)
    assert not way.any()
    rate = np.gradient(motion.at(clock)[0][:, 1], clock)
    assert rate[[1, 50, -2]] / 0.06 == pytest.approx([1 - 0.49, 1, 1 + 0.49], abs=1e-6)


@pytest.mark.parametrize("readout", READOUTS)
def test_vibration_and_rotation_about_any_axes_are_those_of_each_line(readout):
    camera = Camera(320, 240, CAMERA.K, [], readout)
    shake = vibrations([camera], Vibration(3e-3, (4, 5), travel=0.02), 3)[0]
    steady = RowMotion([0.05, -0.1, 0.08], [0.3, -0.1, 0.2])
    motion, turn, way = unsteady("a", camera, steady, 0.0, shake)
    clock = lines_of(camera)[1]
    added, moved = shake(clock)
    expected = Rotation.from_rotvec(added) * Rotation.from_rotvec(clock[:, None] * steady.phi)
    rotation, position = motion.at(clock)
    found = Rotation.from_rotvec(rotation) * Rotation.from_matrix(turn)
    assert (found * expected.inv()).magnitude().max() < 0.02 / 310  # what is said to be left, in pixels
    np.testing.assert_allclose(position + way, clock[:, None] * steady.velocity + moved, atol=1e-4)
    # pose and phi are those of the nearest steady motion: nothing is left that is constant or grows evenly
    fine = np.linspace(motion.bend.start, motion.bend.end, 20_001)
    rest = np.hstack(motion.bend.at(fine))
    assert np.abs(np.trapezoid(np.stack([rest, fine[:, None] * rest]), fine, axis=1)).max() < 1e-7


def test_vibrations_have_the_amplitude_axis_and_number_of_periods_asked_for():
    clock = readings(CAMERA, 40_001)
    for shake in vibrations([CAMERA] * 5, Vibration(2e-3, (3, 6), "z", 0.1), 1):
        turn, way = shake(clock)
        assert not turn[:, :2].any()
        assert np.abs(turn[:, 2]).max() == pytest.approx(2e-3, rel=1e-4)
        assert np.linalg.norm(way, axis=1).max() == pytest.approx(0.1, rel=1e-4)
        assert 5 <= np.count_nonzero(np.diff(np.sign(turn[:, 2]))) <= 12
    phases = [shake(clock[:1])[0][0, 2] for shake in vibrations([CAMERA] * 5, Vibration(2e-3, axis="z"), 1)]
    assert np.ptp(phases) > 1e-4


def test_fast_vibrations_take_as_many_readings_as_they_need_and_say_where_these_end():
    slow, fast = (
        unsteady("a", CAMERA, RowMotion(), 0.0, vibrations([CAMERA], Vibration(2e-3, (k, k)), 1)[0])[0] for k in (3, 30)
    )
    assert len(slow.bend.clock) == 65 < len(fast.bend.clock)
    with pytest.warns(RsUndistortWarning, match=r"b: the truth follows the motion to .* px"):
        unsteady("b", CAMERA, lambda clock: (np.abs(clock)[:, None] * [0, 40, 0], np.zeros((len(clock), 3))))


@pytest.mark.parametrize("readout", READOUTS)
def test_table_by_row_is_the_rotation_of_each_row(readout, rng):
    camera = Camera(320, 240, CAMERA.K, [], readout)
    lines, clock = lines_of(camera)
    smooth = np.stack([np.sin(lines / 40 + k) for k in range(3)], axis=1)
    rotation, position = smooth * [0.01, 0.02, 0.03] + [2.0, 2.0, 0.0], smooth[:, ::-1] * 0.1
    motion, turn, way = unsteady("a", camera, RowTable(lines, rotation, position))
    found = Rotation.from_rotvec(motion.at(clock)[0]) * Rotation.from_matrix(turn)
    assert (found * Rotation.from_rotvec(rotation).inv()).magnitude().max() < 0.02 / 310
    np.testing.assert_allclose(motion.at(clock)[1] + way, position, atol=1e-4)
    ascending = np.argsort(clock)
    same, _, _ = unsteady("a", camera, RowTable(clock[ascending], rotation[ascending], by_clock=True))
    np.testing.assert_allclose(same.phi, motion.phi, atol=1e-9)


ROWS = [0.0, 80.0, 160.0, 239.0]
TURNS = [[0.0, 0.01 * k, 0.0] for k in (0, 1, 3, 4)]


@pytest.mark.parametrize(
    ("rows", "turns", "says"),
    [
        (ROWS[:3], TURNS[:3], "3 poses, expected 4 or more"),
        ([0, 160, 80, 239], TURNS, "row 80 comes after 160"),
        ([0, 80, 80, 239], TURNS, "row 80 comes after 80"),
        ([*range(20), 230, 239], np.zeros((22, 3)), "a gap between row 19 and 230"),
        ([0, 80, np.nan, 239], TURNS, "pose 3 of 4"),
        (ROWS, [*TURNS[:1], [0, np.inf, 0], *TURNS[2:]], "NaN or infinity in pose 2 of 4, row 80"),
        (ROWS, TURNS[:2], "rotation"),
        ([5, 80, 160, 239], TURNS, "poses from 5 to 239, but rows of the photo from 0 to 239"),
        ([0, 80, 160, 200], TURNS, "poses from 0 to 200"),
    ],
)
def test_bad_tables_say_what_is_wrong_and_where(tmp_path, rows, turns, says):
    (tmp_path / "m.json").write_text(json.dumps({"b.png": {"row": rows, "rotation": np.asarray(turns).tolist()}}))
    with pytest.raises((InputError, FormatError), match=says) as stated:
        unsteady("b.png", CAMERA, read_motion_file(tmp_path / "m.json")["b.png"])
    assert "b.png" in str(stated.value)
    assert "\n" not in str(stated.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name,row,rx,ry\na,0,0,0\n", "'rz'"),
        ("name,row,rx,ry,rz,x\na,0,0,0,0,0\n", "'y'"),
        ("name,row,rx,ry,rz\na,0,0,0,0\na,x,0,0,0\n", r"line 3 \(a\): expected numbers"),
        ("name,row,rx,ry,rz\na,0,0,nan,0\n", r"line 2 \(a\): NaN"),
        ("name,row,rx,ry,rz\na,0,0,0,0\n", "table of a: 1 poses"),
    ],
)
def test_bad_csv_tables_are_refused(tmp_path, text, says):
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(FormatError, match=says):
        read_row_tables(tmp_path / "m.csv")


def test_csv_and_json_tables_say_the_same(tmp_path):
    rows = [f"b.png,{row:g},{','.join(map(str, turn))}" for row, turn in zip(ROWS, TURNS, strict=True)]
    (tmp_path / "m.csv").write_text("\n".join(["name,row,rx,ry,rz", *rows]) + "\n")
    (tmp_path / "m.json").write_text(json.dumps({"b.png": {"row": ROWS, "rotation": TURNS}, "a.png": [0, 0, 0.1]}))
    by_csv, by_json = read_motion_file(tmp_path / "m.csv"), read_motion_file(tmp_path / "m.json")
    np.testing.assert_array_equal(by_csv["b.png"].rotation, by_json["b.png"].rotation)
    assert by_json["a.png"] == [0, 0, 0.1]


def test_stretch_of_a_gyroscopes_log_rotates_as_it_says():
    """About one axis in closed form; the world rotates the other way in the camera."""
    time_s = np.arange(0, 0.05, 1e-5)  # one stretch of 0.03 s fits at several places: find out which by its phase
    log = GyroLog(time_s, np.outer(2.0 + np.sin(2 * np.pi * 40 * time_s), [0, 1, 0]), 0.03)
    (path,) = tracks(log, [CAMERA], None, 4)
    motion, _, _ = unsteady("a", CAMERA, path)
    start, end = CAMERA.clock_range
    clock = readings(CAMERA)
    turned = motion.at(clock)[0][:, 1]
    passed = (clock - start) / (end - start) * 0.03

    def expected(begin):
        angle = 2 * passed - (np.cos(80 * np.pi * (begin + passed)) - np.cos(80 * np.pi * begin)) / (80 * np.pi)
        return -angle

    misses = [np.ptp(turned - expected(begin)) for begin in np.arange(0, 0.02, 1e-5)]
    assert min(misses) < 1e-7
    assert np.median(misses) > 1e-4
    assert tracks(log, [CAMERA], 0.03, 4)[0](clock)[0] == pytest.approx(path(clock)[0])


def test_rotations_of_a_log_compose_as_rotations_do(rng):
    time_s = np.arange(0, 1, 1e-3)
    log = GyroLog(time_s, rng.normal(size=3) + np.outer(np.sin(20 * time_s), rng.normal(size=3)))
    at = np.linspace(0.1, 0.9, 401)
    R = Rotation.identity()
    for step in np.linspace(0.1, 0.9, 20_001)[:-1] + 2e-5:  # ten times as fine, one after the other
        rate = [np.interp(step, time_s, log.omega_c[:, k]) for k in range(3)]
        R = Rotation.from_rotvec(-4e-5 * np.array(rate)) * R
    assert (Rotation.from_rotvec(log.rotations(at)[-1]) * R.inv()).magnitude() < 1e-5


def test_logs_that_are_too_short_or_of_unknown_readout_are_refused():
    log = GyroLog(np.arange(0, 0.1, 0.01), np.zeros((10, 3)))
    with pytest.raises(InputError, match="how long a frame is read; give --readout-ms"):
        tracks(log, [CAMERA], None, 0)
    with pytest.raises(InputError, match=r"no stretch of 0\.2 s"):
        tracks(log, [CAMERA], 0.2, 0)


def test_accelerations_follow_their_spread_and_seed():
    drawn = accelerations(2000, 0.5, 3)
    assert drawn.std() == pytest.approx(0.5, rel=0.05)
    np.testing.assert_array_equal(accelerations(10, 0.5, 3), drawn[:10])
    for bad in (-1, np.nan, np.inf):
        with pytest.raises(InputError, match="acceleration"):
            accelerations(2, bad, 3)


@pytest.mark.parametrize(
    "options", [{"amplitude_rad": -1}, {"periods": (5, 2)}, {"periods": (0, 2)}, {"axis": "w"}, {"travel": np.nan}]
)
def test_bad_vibrations_are_refused(options):
    with pytest.raises(InputError, match="vibration"):
        Vibration(**options)


# ---------------------------------------------------------------- simulate_warp


def test_warp_and_truth_of_a_motion_that_is_not_steady(tmp_path):
    """Rectified with the truth that was written, the photo is the original again; with its steady part it is not."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for seed, name in enumerate(("a.png", "b.png")):
        save_png(photos / name, cv2.GaussianBlur(texture(320, 240, seed), (0, 0), 2.0))
    options = WarpOptions(
        camera="300,310,161.5,118.25", still=("b.png",), acceleration=0.5, vibration=Vibration(8e-3), seed=3
    )
    truth = simulate_warp(photos, tmp_path / "out", options)
    written = read_solution(tmp_path / "out" / "ground_truth.json")
    assert json.loads((tmp_path / "out" / "ground_truth.json").read_text())["version"] == 2
    np.testing.assert_array_equal(
        written.image("a.png").motion.bend.rotation, truth.image("a.png").motion.bend.rotation
    )
    assert written.image("b.png").motion.bend is None
    rectify_folder(tmp_path / "out" / "photos", tmp_path / "out" / "ground_truth.json", tmp_path / "back")
    inner = (slice(20, -20), slice(20, -20))
    original, warped, back = (
        read_photo(folder / "a.png").pixels[inner].astype(int)
        for folder in (photos, tmp_path / "out" / "photos", tmp_path / "back" / "images")
    )
    assert np.abs(back - original).mean() < 1.0
    assert np.abs(warped - original).mean() > 5.0


def test_what_is_not_steady_changes_no_draw_of_the_steady_part(tmp_path):
    photos = save_textures(tmp_path / "photos", ["a.png", "b.png"])
    plain = simulate_warp(photos, tmp_path / "plain", WarpOptions(camera=GIVEN, seed=5))
    shaken = simulate_warp(
        photos, tmp_path / "shaken", WarpOptions(camera=GIVEN, seed=5, vibration=Vibration(0.0), acceleration=1e-9)
    )
    for name in ("a.png", "b.png"):
        assert shaken.image(name).motion.phi == pytest.approx(plain.image(name).motion.phi, abs=1e-9)
    assert all(image.motion.bend is None for image in plain.images)
    assert "vibration" not in plain.options


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"motion": {"a.png": RowTable(ROWS, TURNS)}, "acceleration": 0.1}, "acceleration"),
        ({"motion": {}, "gyro": GyroLog([0, 1], np.zeros((2, 3)), 0.1)}, "one of them"),
        ({"motion": {"c.png": RowTable(ROWS, TURNS)}}, "'c.png' is not among the photos"),
        ({"motion": {"a.png": RowTable(ROWS, TURNS, np.outer(np.square(ROWS), [1, 0, 0]))}}, "a.png"),
        ({"motion": {"a.png": RowTable(ROWS, -30 * np.array(TURNS)[:, ::-1] @ np.eye(3)[[2, 0, 1]])}}, "rows of a.png"),
        ({"vibration": Vibration(0.2, (5, 5), "x")}, "fold over"),
    ],
)
def test_warps_that_make_no_sense_are_refused(tmp_path, options, says):
    photos = save_textures(tmp_path / "photos", ["a.png", "b.png"])
    with pytest.raises(InputError, match=says) as stated:
        simulate_warp(photos, tmp_path / "out", WarpOptions(camera=GIVEN, **options))
    assert "\n" not in str(stated.value)
    assert not (tmp_path / "out").exists()


def test_photos_of_two_sizes_are_not_warped_together(tmp_path):
    photos = save_textures(tmp_path / "photos", ["a.png"])
    write_image(photos / "b.png", texture(200, 160, 1))
    with pytest.raises(InputError, match=r"^b\.png has 200x160 pixels, a\.png \d+x\d+; warp photos of each size"):
        simulate_warp(photos, tmp_path / "out", WarpOptions(camera=GIVEN))
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- recipes


def recipe_with(tmp_path, **motion):
    data = json.loads((COURTYARD / "recipe.json").read_text())
    data["motion"] = data["motion"] | motion if "kind" not in motion else motion
    (tmp_path / "recipe.json").write_text(json.dumps(data))
    return load_recipe(tmp_path / "recipe.json")


def test_recipe_shakes_the_camera_about_the_path_that_it_would_have_had(tmp_path):
    plain = recipe_with(tmp_path)
    vibration = {"amplitude_rad": 2e-3, "travel_m": 0.01, "periods": [2, 4]}
    shaken = recipe_with(tmp_path, acceleration=0.3, vibration=vibration)
    seed = json.loads((COURTYARD / "recipe.json").read_text())["seed"]
    cameras = [plain.camera(view) for view in plain.views]
    shares = accelerations(len(cameras), 0.3, seed)
    shakes = vibrations(cameras, Vibration(2e-3, (2, 4), travel=0.01), seed)
    bent = 0
    for before, after, share, shake, camera in zip(plain.views, shaken.views, shares, shakes, cameras, strict=True):
        if after.motion.bend is None:
            assert not before.motion.phi.any()  # the photo that stands still
            continue
        bent += 1
        start, end = camera.clock_range
        for clock in np.linspace(start, end, 7):
            turn, way = (each[0] for each in shake(np.array([clock])))
            grown = (clock - (start + end) / 2) ** 2 / (end - start) * share
            R = Rotation.from_rotvec(turn) * Rotation.from_rotvec(before.motion.phi * (clock + grown))
            R_cw, center_w = after.motion.pose_at(clock, after.R_cw, after.center_w)
            np.testing.assert_allclose(R_cw, R.as_matrix() @ before.R_cw, atol=2e-5)
            np.testing.assert_allclose(center_w, before.center_w + clock * before.motion.velocity + way, atol=2e-5)
    assert bent > 1


def test_recipe_takes_tables_and_logs_beside_it(tmp_path):
    rows = "\n".join(f"0001.jpg,{row},0,{0.0001 * row},0,{0.001 * row},0,0" for row in range(0, 4001, 10))
    (tmp_path / "t.csv").write_text(f"name,row,rx,ry,rz,x,y,z\n{rows}\n")
    recipe = recipe_with(tmp_path, kind="given", tables="t.csv")
    assert recipe.files == ("t.csv",)
    view, camera = recipe.views[1], recipe.camera(recipe.views[1])
    still = recipe_with(tmp_path, kind="none").views[1]
    assert view.motion.phi == pytest.approx([0, 1e-4 * camera.K[1, 1], 0], abs=1e-9)
    R_cw, center_w = view.motion.pose_at((100 - camera.K[1, 2]) / camera.K[1, 1], view.R_cw, view.center_w)
    np.testing.assert_allclose(R_cw, Rotation.from_rotvec([0, 0.01, 0]).as_matrix() @ still.R_cw, atol=1e-9)
    np.testing.assert_allclose(center_w, still.center_w + np.array([0.1, 0, 0]), atol=1e-9)
    assert recipe.views[0].motion.bend is None
    (tmp_path / "g.csv").write_text("time_s,wx,wy,wz\n" + "".join(f"{0.01 * k},0,0,2\n" for k in range(100)))
    turned = recipe_with(tmp_path, kind="gyro", log="g.csv", readout_ms=30)
    for view in turned.views:
        assert view.motion.phi == pytest.approx([0, 0, -0.06 / turned.camera(view).frame_span], abs=1e-9)


@pytest.mark.parametrize(
    ("motion", "says"),
    [
        ({"kind": "rotation", "sigma_rad_per_frame": 0.1, "tables": "t.csv"}, "'tables'"),
        ({"kind": "none", "acceleration": 0.1}, "'acceleration'"),
        ({"kind": "given", "tables": {"9999.jpg": {"row": ROWS, "rotation": TURNS}}}, "9999.jpg"),
        ({"kind": "given", "tables": {"0001.jpg": {"row": ROWS[::-1], "rotation": TURNS}}}, "0001.jpg: row 160"),
        ({"kind": "given", "tables": "../t.csv"}, "t.csv"),
        ({"kind": "none", "vibration": {"amplitude": 1}}, "'amplitude'"),
        ({"kind": "none", "vibration": 3}, "motion: vibration"),
        ({"kind": "gyro"}, "'log'"),
        ({"kind": "gyro", "log": "nothing.csv"}, "nothing.csv"),
    ],
)
def test_recipes_that_say_nonsense_are_refused(tmp_path, motion, says):
    with pytest.raises((FormatError, InputError, OSError), match=says):
        recipe_with(tmp_path, **motion)


def test_the_camera_of_a_warp_is_known_as_well_as_that_of_its_photos(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in range(3):
        write_image(photos / f"{k}.jpg", texture(320, 240, k), Metadata(exif_block(1, 35).tobytes()))

    def sigma(name, camera=None):
        simulate_warp(photos, tmp_path / name, WarpOptions(camera, sigma_rad=0.01))
        return json.loads((tmp_path / name / "camera.json").read_text()).get("sigma")

    with pytest.warns(RsUndistortWarning, match="0.jpg: the focal length is that of its EXIF; a warp by one that is"):
        guessed = sigma("guessed")
    (camera,) = read_solution(tmp_path / "guessed" / "ground_truth.json").cameras.values()
    assert guessed["f"] == pytest.approx(0.05 * camera.K[0, 0])
    assert guessed["k1"] == 0.2
    assert "k4" not in guessed
    assert sigma("given", GIVEN) is None
    (photos / "camera.json").write_text(json.dumps(camera_to_json(CAMERA) | {"sigma": {"f": 2.0}}))
    assert sigma("said") == {"f": pytest.approx(2.0)}
