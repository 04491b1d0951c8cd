from __future__ import annotations

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
from commands import CAMERA, COMMAND, THREE, error_line, solution_of
from folders import tree
from make_photos import save_png, save_textures, texture
from scipy.spatial.transform import Rotation

from rsundistort import (
    Camera,
    RowMotion,
    Solution,
    SolvedImage,
    write_solution,
)

# ---------------------------------------------------------------- help


def test_help_lists_the_commands(invoke):
    result = invoke("--help")
    assert result.exit_code == 0
    for name in ("run", "rectify", "simulate", "evaluate", "info"):
        assert f"  {name} " in result.stdout
    assert "simulate" in invoke("-h").stdout
    assert "warp" in invoke("simulate", "--help").stdout
    assert "scene" in invoke("simulate", "--help").stdout


@pytest.mark.parametrize("args", [["--help"], ["run", "--help"], ["simulate", "warp", "--help"], ["--version"]])
def test_help_imports_nothing_heavy(args):
    code = f"""
import sys
from rsundistort_cli.main import cli
try:
    cli({args!r})
except SystemExit as stop:
    assert not stop.code, stop.code
heavy = sorted({{"numba", "cv2", "pycolmap", "numpy", "scipy", "rsundistort"}} & set(sys.modules))
assert not heavy, heavy
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_command_is_installed():
    done = subprocess.run([COMMAND, "--help"], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0
    assert "rsundistort run PHOTOS -o OUT" in done.stdout
    assert done.stderr == ""


def test_info(invoke):
    result = invoke("info")
    assert result.exit_code == 0
    for name in ("rsundistort", "python", "numba", "pycolmap", "threads"):
        assert name in result.stdout


@pytest.mark.parametrize(
    "args",
    [
        ["frobnicate"],
        ["run"],
        ["run", "photos"],
        ["run", "photos", "-o", "out", "--unknown"],
        ["run", "photos", "-o", "out", "--model", "spiral"],
        ["run", "photos", "-o", "out", "--readout", "upwards"],
        ["run", "photos", "-o", "out", "--quality", "101"],
        ["run", "photos", "-o", "out", "--max-features", "many"],
        ["run", "photos", "-o", "out", "--seed", "-1"],
        ["rectify", "photos", "-o", "out"],
        ["rectify", "photos", "-o", "out", "--solution", "s.json", "--interpolation", "magic"],
        ["evaluate", "out"],
        ["simulate", "spin"],
        ["simulate", "warp", "photos", "-o", "out", "--sigma", "-0.1"],
        ["simulate", "warp", "photos", "-o", "out", "--sigma", "0.1", "--motion", "motion.json"],
        ["simulate", "warp", "photos", "-o", "out", "--vibration-axis", "x"],
        ["simulate", "warp", "photos", "-o", "out", "--gyro-axes", "xyz"],
        ["run", "photos", "-o", "out", "--gyro-offset", "1"],
        ["run", "photos", "-o", "out", "--photo-times", "times.csv"],
        ["run", "photos", "-o", "out", "--camera-sigma", "f=1,f=2"],
    ],
)
def test_wrong_use_is_exit_code_2(invoke, tmp_path, args):
    result = invoke(*args)
    assert result.exit_code == 2
    assert "Usage:" in result.stderr
    assert "Traceback" not in result.stderr
    assert tree(tmp_path) == {}


def test_choices_are_those_of_the_library():
    from rsundistort_cli.options import (
        EXPORT_NAMES,
        INTERPOLATION_NAMES,
        MAP_KIND_NAMES,
        MATCHING_NAMES,
        READOUT_NAMES,
    )

    from rsundistort.input.pairing import MATCHINGS
    from rsundistort.io.exports import EXPORTS
    from rsundistort.model import READOUTS
    from rsundistort.rectify import INTERPOLATIONS, MAP_KINDS

    assert set(READOUT_NAMES) == set(READOUTS)
    assert set(INTERPOLATION_NAMES) == set(INTERPOLATIONS)
    assert set(MAP_KIND_NAMES) == set(MAP_KINDS)
    assert MATCHING_NAMES == MATCHINGS
    assert tuple(EXPORTS) == EXPORT_NAMES


# ---------------------------------------------------------------- analyze


LEVEL = {
    "R_cw": [[[c, 0, -s], [0, 1, 0], [s, 0, c]] for c, s in ((1, 0), (0.8, 0.6), (0.6, 0.8), (0.96, 0.28))],
    "center_w": [[0, 0, 0], [1, 0.1, 0], [2, -0.2, 0.5], [3, 0.3, 0]],
}


def _level_solution(path):
    camera = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
    images = [
        SolvedImage(f"{i}.png", "1", np.array(R), np.array(C, float), RowMotion())
        for i, (R, C) in enumerate(zip(LEVEL["R_cw"], LEVEL["center_w"], strict=True))
    ]
    write_solution(path, Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, tuple(images)))


def test_analyze_a_solution_and_transforms(invoke, tmp_path):
    _level_solution(tmp_path / "solution.json")
    result = invoke("analyze", "solution.json")
    assert result.exit_code == 0, result.stderr
    assert "vertical scale" in result.stdout
    assert "rotated by 90 degrees" in result.stdout
    assert all(len(line) <= 100 for line in result.stdout.splitlines())
    as_json = json.loads(invoke("analyze", tmp_path, "--json").stdout)
    assert as_json["critical"] is True
    assert as_json["singular_values"][-1] < 1e-9
    frames = []
    for R, C in zip(LEVEL["R_cw"], LEVEL["center_w"], strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = np.array(R).T @ np.diag([1, -1, -1])
        matrix[:3, 3] = C
        frames.append({"transform_matrix": matrix.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    found = json.loads(invoke("analyze", "transforms.json", "--json").stdout)
    np.testing.assert_allclose(found["singular_values"], as_json["singular_values"], atol=1e-9)
    # read by columns, the same cameras are distinguished
    # of a run it is the solution that says how photos were read; of other files beside it nothing is taken from there
    (tmp_path / ".rsundistort-written").write_text("")
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames[:3]}))
    (tmp_path / "my-transforms.json").write_text(json.dumps({"frames": frames[:3]}))
    beside, own = (
        json.loads(invoke("analyze", name, "--json").stdout) for name in ("transforms.json", "my-transforms.json")
    )
    assert (beside["photos"], own["photos"]) == (len(frames), 3)
    (tmp_path / ".rsundistort-written").unlink()
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    columns = json.loads(invoke("analyze", "transforms.json", "--readout", "left-to-right", "--json").stdout)
    assert columns["critical"] is False
    assert columns["advice"] == []


def test_analyze_a_colmap_model_with_a_lens(invoke, tmp_path):
    _level_solution(tmp_path / "solution.json")
    model = tmp_path / "model"
    model.mkdir()
    (model / "cameras.txt").write_text("1 SIMPLE_RADIAL 320 240 300 160.5 120.5 0.01\n")
    (model / "points3D.txt").write_text("")
    lines = []
    for i, (R, C) in enumerate(zip(LEVEL["R_cw"], LEVEL["center_w"], strict=True), start=1):
        x, y, z, w = Rotation.from_matrix(R).as_quat()
        t = -np.array(R) @ C
        lines.append(f"{i} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {i}.png\n\n")
    (model / "images.txt").write_text("".join(lines))
    found = json.loads(invoke("analyze", "model", "--json").stdout)
    expected = json.loads(invoke("analyze", "solution.json", "--json").stdout)
    np.testing.assert_allclose(found["singular_values"], expected["singular_values"], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("nothing.json", None, "does not exist"),
        ("transforms.json", "{}", "no transforms.json"),
        ("transforms.json", '{"frames": [{"transform_matrix": [[1, 2], [3, 4]]}]}', "no transforms.json"),
        ("transforms.json", '{"frames": []}', "0 poses"),
        ("solution.json", "{}", "is no solution"),
    ],
)
def test_analyze_refuses_what_has_no_poses(invoke, tmp_path, name, text, says):
    if text is not None:
        (tmp_path / name).write_text(text)
    assert says in error_line(invoke("analyze", name))


# ---------------------------------------------------------------- evaluate


def test_evaluate(invoke, tmp_path):
    (tmp_path / "out").mkdir()
    solution_of(tmp_path / "out" / "solution.json", THREE)
    solution_of(tmp_path / "truth.json", THREE)
    result = invoke("evaluate", "out", "--truth", "truth.json", "--json")
    assert result.exit_code == 0, result.stderr
    value = json.loads(result.stdout)
    assert value["photos"] == value["registered"] == 3
    assert value["rotation_deg"]["max"] < 1e-6
    assert value["phi_mrad_per_frame"]["max"] == 0
    text = invoke("evaluate", "out", "--truth", "truth.json").stdout
    assert "rotation error, deg" in text
    assert "3 of 3" in text


def test_evaluate_refuses(invoke, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "bare").mkdir()
    solution_of(tmp_path / "out" / "solution.json", THREE)
    solution_of(tmp_path / "truth.json", THREE)
    solution_of(tmp_path / "others.json", ["x.png", "y.png", "z.png"])
    (tmp_path / "garbled.json").write_text("{")
    before = tree(tmp_path)
    for args, says in (
        (["out", "--truth", "none.json"], "none.json"),
        (["out", "--truth", "garbled.json"], "garbled.json"),
        (["out", "--truth", "others.json"], "pose in both"),
        (["bare", "--truth", "truth.json"], "solution.json"),
        (["none", "--truth", "truth.json"], "solution.json"),
        (["truth.json", "--truth", "truth.json"], "solution.json"),
        (["out", "--truth", "truth.json", "--twins", "none"], "none is no folder"),
        (["out", "--truth", "truth.json", "--twins", "bare"], "a.png"),
        (["out", "--truth", "truth.json", "--poses", "none.json"], "none.json"),
    ):
        assert says in error_line(invoke("evaluate", *args))
    assert tree(tmp_path) == before


def test_evaluate_refuses_references_of_another_size(invoke, tmp_path):
    for folder in ("out/images", "out/masks", "twins"):
        (tmp_path / folder).mkdir(parents=True)
    solution_of(tmp_path / "out" / "solution.json", THREE)
    solution_of(tmp_path / "truth.json", THREE)
    for name in THREE:
        save_png(tmp_path / "out" / "images" / name, np.zeros((240, 320, 3), np.uint8))
        save_png(tmp_path / "out" / "masks" / name, np.full((240, 320), 255, np.uint8))
        save_png(tmp_path / "twins" / name, np.zeros((480, 640, 3), np.uint8))
    says = error_line(invoke("evaluate", "out", "--truth", "truth.json", "--twins", "twins"))
    assert "the reference has the shape (480, 640), the rectified photo (240, 320)" in says


# ---------------------------------------------------------------- simulate


@pytest.fixture
def photos(tmp_path):
    return save_textures(tmp_path / "photos", THREE)


def test_simulate_warp(invoke, photos, tmp_path):
    result = invoke("simulate", "warp", "photos", "-o", "out", "--camera", CAMERA, "--seed", 3)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    assert "shift px" in result.stdout
    assert all(name in result.stdout for name in THREE)
    assert {"photos/a.png", "masks/c.png", "camera.json", "ground_truth.json"} <= set(tree(tmp_path / "out"))


def test_simulate_warp_crop(invoke, photos, tmp_path):
    result = invoke("simulate", "warp", "photos", "-o", "out", "--camera", CAMERA, "--crop")
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    camera = json.loads((tmp_path / "out" / "camera.json").read_text())
    assert f"size     {camera['width']}x{camera['height']}" in result.stdout
    assert (camera["width"], camera["height"]) < (320, 240)
    made = set(tree(tmp_path / "out"))
    assert {f"{folder}/{name}" for folder in ("photos", "masks", "global") for name in THREE} < made
    # and it is found beside the photos by what reads them
    args = ["rectify", "out/photos", "--solution", "out/ground_truth.json", "-o", "back"]
    assert invoke(*args).exit_code == 0


def test_simulate_warp_of_motions_that_are_not_steady(invoke, photos, tmp_path):
    args = ["simulate", "warp", "photos", "-o", "out", "--camera", CAMERA, "--overwrite"]
    shaking = ["--acceleration", 0.5, "--vibration", 1.5, "--vibration-periods", 3, 4, "--vibration-axis", "y"]
    result = invoke(*args, *shaking, "--crop")
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    truth = json.loads((tmp_path / "out" / "ground_truth.json").read_text())
    assert truth["options"]["vibration"] == {"amplitude_rad": 0.0015, "periods": [3, 4], "axis": "y", "travel": 0}
    assert len(truth["images"][0]["bend"]["clock"]) == 65
    (tmp_path / "g.csv").write_text("time_s,wx,wy,wz\n" + "".join(f"{k / 100},0,1,0\n" for k in range(50)))
    result = invoke(*args, "--gyro", "g.csv", "--gyro-axes", "XZy", "--readout-ms", 40)
    assert result.exit_code == 0, result.stderr
    truth = json.loads((tmp_path / "out" / "ground_truth.json").read_text())
    assert truth["images"][2]["phi"] == pytest.approx([0, 0, 0.04 * 300 / 240], abs=1e-9)
    assert "how long" in error_line(invoke(*args, "--gyro", "g.csv"))
    (tmp_path / "rows.csv").write_text("name,row,rx,ry,rz\n" + "".join(f"b.png,{k},0,0,0\n" for k in (0, 99, 50, 239)))
    assert "table of b.png: row 50 comes after 99" in error_line(invoke(*args, "--motion", "rows.csv"))


def test_simulate_warp_refuses_to_crop_to_a_stamp(invoke, photos, tmp_path):
    (tmp_path / "motion.json").write_text('{"b.png": [3, 0, 0]}')
    before = tree(tmp_path)
    args = ["simulate", "warp", "photos", "-o", "out", "--camera", CAMERA, "--motion", "motion.json"]
    error = error_line(invoke(*args, "--crop"))
    assert "too strong" in error
    assert "b.png" in error
    assert tree(tmp_path) == before
    assert invoke(*args).exit_code == 0


@pytest.mark.parametrize(
    ("motion", "says"),
    [
        (None, "motion.json"),
        ('{"b.png": [-0.95, 0, 0]}', "the rows of b.png fold over"),
        ("garbage", "motion.json"),
        ("[1, 2, 3]", "motion.json"),
        ('{"nobody.png": [0, 0, 0]}', "nobody.png"),
        ('{"a.png": [NaN, 0, 0]}', "motion of a.png holds NaN or infinity"),
        ('{"a.png": [1e999, 0, 0]}', "motion of a.png holds NaN or infinity"),
        ('{"a.png": [0, 0]}', "shape=(2,), expected (3,)"),
        ('{"a.png": 3}', "shape=(), expected (3,)"),
        ('{"a.png": null}', "expected numbers of shape (3,), got None"),
        pytest.param('{"a.png": "fast"}', "got 'fast'"),
        pytest.param('{"a.png": ["x", "y", "z"]}', "got ['x', 'y', 'z']"),
        pytest.param('{"a.png": [[1], [2, 3]]}', "got [[1], [2, 3]]"),
        pytest.param('{"a.png": {"x": 1}}', "expected an object with row or clock"),
    ],
)
def test_simulate_warp_refuses_bad_motions(invoke, photos, tmp_path, motion, says):
    if motion is not None:
        (tmp_path / "motion.json").write_text(motion)
    before = tree(tmp_path)
    args = ["simulate", "warp", "photos", "-o", "out", "--camera", CAMERA, "--motion", "motion.json"]
    assert says in error_line(invoke(*args))
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--camera", CAMERA, "--still", "nobody.png"], "nobody.png"),
        (["--camera", CAMERA, "--sigma", "nan"], "sigma"),
        (["--camera", CAMERA, "--sigma", "inf"], "NaN or infinity"),
        (["--camera", "300,300"], "expected a file or fx,fy,cx,cy"),
        ([], "give --camera"),
    ],
)
def test_simulate_warp_refuses_bad_options(invoke, photos, tmp_path, options, says):
    before = tree(tmp_path)
    assert says in error_line(invoke("simulate", "warp", "photos", "-o", "out", *options))
    assert tree(tmp_path) == before


def test_simulate_warp_refuses_bad_photos(invoke, photos, tmp_path):
    args = ["simulate", "warp", "photos", "-o", "out", "--camera", CAMERA]
    save_png(photos / "b.png", texture(240, 320))
    before = tree(tmp_path)
    error_line(invoke(*args))
    assert tree(tmp_path) == before
    (photos / "b.png").write_bytes(b"cut")
    assert "b.png" in error_line(invoke(*args))
    shutil.rmtree(photos)
    error_line(invoke(*args))
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("recipe", [None, "{", "[]", "{}", '{"format": "x"}'])
def test_simulate_scene_refuses_bad_recipes(invoke, tmp_path, recipe):
    if recipe is not None:
        (tmp_path / "recipe.json").write_text(recipe)
    before = tree(tmp_path)
    assert "recipe.json" in error_line(invoke("simulate", "scene", "recipe.json", "-o", "out"))
    assert tree(tmp_path) == before
