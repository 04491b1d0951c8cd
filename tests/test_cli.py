from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from folders import tree
from make_photos import save_png, save_textures, texture
from rsundistort_cli.main import cli
from scipy.spatial.transform import Rotation

from rsundistort import (
    Camera,
    RemapGrid,
    RowMotion,
    Solution,
    SolvedImage,
    read_solution,
    rectify,
    write_solution,
)
from rsundistort.io.record import Record

COMMAND = Path(sys.executable).with_name("rsundistort")
CAMERA = "300,300,160,120"
FEW = ["--max-features", "500"]
THREE = ["a.png", "b.png", "c.png"]


@pytest.fixture
def invoke(monkeypatch, tmp_path):
    """Runs the command inside an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*args):
        return CliRunner().invoke(cli, [str(arg) for arg in args])

    return run


def error_line(result):
    """The error of a refused job: one line, exit code 1, no traceback."""
    assert result.exit_code == 1, (result.exit_code, result.exception, result.stderr)
    assert isinstance(result.exception, SystemExit), result.exception
    lines = result.stderr.splitlines()
    errors = [line for line in lines if line.startswith("error: ")]
    assert len(errors) == 1, lines
    assert lines[-1] == errors[0]
    assert all(line.startswith("warning: ") for line in lines[:-1]), lines
    assert result.stdout == ""
    return errors[0]


def solution_of(path, names, camera=None):
    camera = camera or Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
    images = [
        SolvedImage(name, "1", np.eye(3), np.array([i, i * i / 9, 0.0]), RowMotion([0.02, -0.01, 0.03]))
        for i, name in enumerate(names)
    ]
    write_solution(path, Solution("rotation", {"1": camera}, {"1": camera.pinhole()}, tuple(images)))
    return path


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
    ],
)
def test_wrong_use_is_exit_code_2(invoke, tmp_path, args):
    result = invoke(*args)
    assert result.exit_code == 2
    assert "Usage:" in result.stderr
    assert "Traceback" not in result.stderr
    assert tree(tmp_path) == {}


def test_choices_are_those_of_the_library():
    from rsundistort_cli.options import INTERPOLATION_NAMES, MAP_KIND_NAMES, MATCHING_NAMES, READOUT_NAMES

    from rsundistort.input.pairing import MATCHINGS
    from rsundistort.model import READOUTS
    from rsundistort.rectify import INTERPOLATIONS, MAP_KINDS

    assert set(READOUT_NAMES) == set(READOUTS)
    assert set(INTERPOLATION_NAMES) == set(INTERPOLATIONS)
    assert set(MAP_KIND_NAMES) == set(MAP_KINDS)
    assert MATCHING_NAMES == MATCHINGS


# ---------------------------------------------------------------- run: what is refused


def _empty(folder):
    folder.mkdir()
    return []


def _missing(folder):
    return []


def _one(folder):
    save_textures(folder, ["a.png"])
    return ["--camera", CAMERA]


def _two(folder):
    save_textures(folder, ["a.png", "b.png"])
    return ["--camera", CAMERA]


def _truncated(folder):
    save_textures(folder, ["a.jpg", "b.jpg", "c.png", "d.png"])
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes()[:3000])
    return ["--camera", CAMERA]


def _two_left(folder):
    save_textures(folder, THREE)
    (folder / "c.png").write_bytes(b"")
    return ["--camera", CAMERA]


def _sizes(folder):
    save_textures(folder, THREE)
    save_png(folder / "b.png", texture(240, 320))
    return ["--camera", CAMERA]


def _no_camera(folder):
    save_textures(folder, THREE)
    return []


def _with_camera_file(content):
    def make(folder):
        save_textures(folder, THREE)
        (folder / "camera.json").write_text(content)
        return []

    return make


def _with_camera(*text):
    def make(folder):
        save_textures(folder, THREE)
        return ["--camera", *text]

    return make


def _apart(folder):
    save_textures(folder, THREE)
    return ["--camera", CAMERA]


def _flat(folder):
    folder.mkdir()
    for name in THREE:
        save_png(folder / name, np.full((240, 320, 3), 99, np.uint8))
    return ["--camera", CAMERA]


def _refine(folder):
    save_textures(folder, THREE)
    return ["--camera", CAMERA, "--refine", "f,zoom"]


def _camera_sigma(text):
    def make(folder):
        save_textures(folder, THREE)
        return ["--camera", CAMERA, "--camera-sigma", text]

    return make


def _contradicting(folder):
    save_textures(folder, THREE)
    return ["--camera", CAMERA, "--still", "a.png", "--still", "a.png=2"]


def _no_sigma(folder):
    save_textures(folder, THREE)
    return ["--camera", CAMERA, "--still", "a.png=-1"]


def _still_and_known(folder):
    save_textures(folder, THREE)
    (folder.parent / "gyro.csv").write_text("name,phi1,phi2,phi3,sigma\na.png,0,0,0,0.001\n")
    return ["--camera", CAMERA, "--still", "a.png=1", "--known", "gyro.csv"]


def _unknown_known(folder):
    save_textures(folder, THREE)
    (folder.parent / "gyro.csv").write_text("name,phi1,phi2,phi3,sigma\nnobody.png,0,0,0,0.001\n")
    return ["--camera", CAMERA, "--known", "gyro.csv"]


def _mixed_units(folder):
    save_textures(folder, THREE)
    (folder.parent / "gyro.csv").write_text("name,phi1,omega2,sigma\na.png,0,0,0.001\n")
    return ["--camera", CAMERA, "--known", "gyro.csv"]


def _one_length(folder):
    save_textures(folder, THREE)
    (folder.parent / "l.csv").write_text("photo1,x1,y1,photo2,x2,y2,length,sigma\na.png,1,2,,3,4,1,0.1\n")
    return ["--camera", CAMERA, "--lengths", "l.csv"]


def _still(folder):
    save_textures(folder, THREE)
    return ["--camera", CAMERA, "--still", "nobody.png"]


OTHER_SIZE = json.dumps({"width": 640, "height": 480, "K": [[600, 0, 320], [0, 600, 240], [0, 0, 1]]})


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (_empty, "no photos in photos"),
        (_missing, "photos is no folder"),
        (_one, "1 photo;"),
        (_two, "2 photos;"),
        (_truncated, "0 readable photos of 4"),
        (_two_left, "2 readable photos of 3"),
        (_sizes, "320x240"),
        (_no_camera, "give --camera"),
        (_with_camera_file(OTHER_SIZE), "640x480"),
        (_with_camera_file("{ no"), "camera.json"),
        (_with_camera_file('{"width": 320}'), "lacks K, height"),
        (_with_camera("none.json"), "none.json"),
        (_with_camera("1,2,x"), "expected a file or fx,fy,cx,cy"),
        (_with_camera("nan,300,160,120"), "NaN"),
        (_with_camera("300,300,1600,120"), "outside"),
        (_with_camera(","), "expected a file or fx,fy,cx,cy"),
        pytest.param(_with_camera(",".join(["1"] * 300)), "expected a file or fx,fy,cx,cy"),
        (_apart, "share more of the scene"),
        (_flat, "share more of the scene"),
        (_still, "nobody.png"),
        (_contradicting, "named twice"),
        (_no_sigma, "must be positive"),
        (_still_and_known, "give one of them"),
        (_unknown_known, "nobody.png"),
        (_mixed_units, "mixes"),
        (_one_length, "need two"),
        (_refine, "cannot refine 'zoom'"),
        (_camera_sigma("f=0"), "sigma of f is 0.0, expected a positive number"),
        (_camera_sigma("f=1,cx=-2"), "sigma of cx is -2.0"),
        (_camera_sigma("zoom=1"), "sigma of 'zoom'"),
        (_camera_sigma("f=1,fx=1"), "give one or the other"),
        (_camera_sigma("k1=nan"), "sigma of k1 is nan"),
    ],
)
def test_run_refuses_in_one_line_and_writes_nothing(invoke, tmp_path, make, says):
    options = make(tmp_path / "photos")
    before = tree(tmp_path)
    line = error_line(invoke("run", "photos", "-o", "deep/out", *FEW, *options))
    assert says in line
    assert tree(tmp_path) == before


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
    assert "turned by 90 degrees" in result.stdout
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
    # read by columns, the same cameras are told apart
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


def test_run_refuses_an_out_in_use(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    (tmp_path / "file").write_text("x")
    before = tree(tmp_path)
    for out, says in (
        ("out", "not empty"),
        ("file", "is a file"),
        ("photos", "holds the photos"),
        ("photos/../photos", "holds the photos"),
        ("file/out", "cannot be written"),
    ):
        line = error_line(invoke("run", "photos", "-o", out, "--camera", CAMERA))
        assert says in line
        assert tree(tmp_path) == before


def test_a_failing_run_leaves_what_it_was_to_overwrite(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    (tmp_path / "out" / "images").mkdir(parents=True)
    (tmp_path / "out" / "images" / "a.png").write_bytes(b"earlier")
    (tmp_path / "out" / "solution.json").write_text("earlier")
    with Record(tmp_path / "out").writing(["images/a.png", "solution.json"]):
        pass
    before = tree(tmp_path)
    error_line(invoke("run", "photos", "-o", "out", "--camera", CAMERA, "--overwrite", *FEW))
    assert tree(tmp_path) == before


def test_refusal_of_the_installed_command(tmp_path):
    """The whole process, where pycolmap and OpenCV have their own ways to stderr."""
    save_textures(tmp_path / "photos", THREE)
    before = tree(tmp_path)
    done = subprocess.run(
        [COMMAND, "run", "photos", "-o", "out", "--camera", CAMERA, *FEW],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 1
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith("error: ")
    assert tree(tmp_path) == before


def test_truncated_photos_with_the_installed_command(tmp_path):
    _truncated(tmp_path / "photos")
    done = subprocess.run(
        [COMMAND, "run", "photos", "-o", "out", "--camera", CAMERA, *FEW],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    assert [line.split(":")[0] for line in lines] == ["warning"] * 4 + ["error"]
    assert [name for name in ("a.jpg", "b.jpg", "c.png", "d.png") if any(name in line for line in lines[:4])] == [
        "a.jpg",
        "b.jpg",
        "c.png",
        "d.png",
    ]
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- rectify


def test_rectify(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    result = invoke("rectify", "photos", "--solution", "s.json", "-o", "out")
    assert result.exit_code == 0, result.stderr
    assert "3 photos rectified" in result.stdout
    assert result.stderr == ""
    names = {path for path, content in tree(tmp_path / "out").items() if content is not None}
    # the second is what --resume goes by, the third what --overwrite does
    files = {"solution.json", ".rectified.jsonl", ".rsundistort-written"}
    assert names == {f"{kind}/{name}" for kind in ("images", "masks") for name in THREE} | files
    assert invoke("rectify", "photos", "--solution", "s.json", "-o", "quiet", "-q").stdout == ""


def test_rectify_refuses_a_depth_that_is_none(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    result = invoke("rectify", "photos", "--solution", "s.json", "-o", "out", "--depth", "deep")
    assert result.exit_code == 1
    assert result.stderr.splitlines() == ["error: depth 'deep' is no folder, nor one of auto, infinity, plane, points"]
    assert not (tmp_path / "out").exists()


def test_rectify_to_another_view(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    args = ["rectify", "photos", "--solution", "s.json", "-q", "-o"]
    assert invoke(*args, "same").exit_code == 0
    assert invoke(*args, "out", "--alpha", "0", "--scale", "0.75").exit_code == 0
    solution = read_solution(tmp_path / "out" / "solution.json")
    new = solution.rectified_cameras["1"]
    assert (new.width, new.height) == (240, 180)
    for name in THREE:
        mask = cv2.imread(str(tmp_path / "out" / "masks" / name), cv2.IMREAD_UNCHANGED)
        assert mask.shape == (180, 240)
        assert (mask == 255).all()
        assert solution.image(name).roi == (0, 0, 240, 180)
    roi = read_solution(tmp_path / "same" / "solution.json").image("a.png").roi
    assert 250 < roi[2] < 320
    # a solution keeps its view, and its raw cameras
    again = ["rectify", "photos", "--solution", "out/solution.json", "-q", "-o", "again"]
    assert invoke(*again).exit_code == 0
    assert tree(tmp_path / "again" / "images") == tree(tmp_path / "out" / "images")
    assert invoke(*again, "--alpha", "keep", "--overwrite").exit_code == 0
    assert tree(tmp_path / "again" / "images") == tree(tmp_path / "same" / "images")
    for alpha in ("2", "some"):
        assert invoke(*args, "bad", "--alpha", alpha).exit_code == 2


def test_rectify_pushes_other_images_through_the_same_grid(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    (tmp_path / "labels").mkdir()
    (tmp_path / "depth").mkdir()
    rng = np.random.default_rng(0)
    labels = rng.choice(np.array([0, 7, 255], np.uint8), (240, 320))
    save_png(tmp_path / "labels" / "a.png", labels)
    depth = cv2.GaussianBlur(rng.normal(size=(240, 320)).astype(np.float32), (0, 0), 5)
    cv2.imwrite(str(tmp_path / "depth" / "b.tiff"), depth)
    args = ["rectify", "photos", "--solution", "s.json", "-o", "out", "--also", "labels", "--also", "depth=linear"]
    result = invoke(*args)
    assert result.exit_code == 0, result.stderr
    assert set(tree(tmp_path / "out" / "also")) == {"labels", "labels/a.png", "depth", "depth/b.tiff"}
    solution = read_solution(tmp_path / "s.json")
    for path, image, interpolation in (("labels/a.png", labels, "nearest"), ("depth/b.tiff", depth, "linear")):
        found = cv2.imread(str(tmp_path / "out" / "also" / path), cv2.IMREAD_UNCHANGED)
        expected, _ = rectify(image, solution.cameras["1"], solution.images[0].motion, interpolation=interpolation)
        np.testing.assert_array_equal(found, expected)
    assert "holds no image of any photo" in error_line(invoke(*args, "--also", "photos/..", "--overwrite"))
    shutil.copytree(tmp_path / "depth", tmp_path / "more" / "depth")
    assert "two folders named depth" in error_line(invoke(*args, "--also", "more/depth", "--overwrite"))
    # an image that does not fit takes its photo with it
    save_png(tmp_path / "labels" / "b.png", labels[:100])
    result = invoke(*args, "--overwrite")
    assert result.stderr == "warning: skipped: b.png: labels/b.png: photo has 320x100 pixels, its camera 320x240\n"
    assert sorted(tree(tmp_path / "out" / "images")) == ["a.png", "c.png"]


def test_rectify_writes_maps_both_ways(invoke, tmp_path):
    pytest.importorskip("OpenEXR")
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    for kind, ending in (("npz", "npz"), ("exr", "exr"), ("stmap", "exr")):
        result = invoke("rectify", "photos", "--solution", "s.json", "-o", kind, "--maps", kind)
        assert result.exit_code == 0, result.stderr
        names = {f"{name[0]}.{way}.{ending}" for name in THREE for way in ("forward", "inverse")}
        assert set(tree(tmp_path / kind / "maps")) == names
        photo, rectified, mask = (
            cv2.imread(str(tmp_path / folder / "a.png"), cv2.IMREAD_UNCHANGED)
            for folder in ("photos", f"{kind}/images", f"{kind}/masks")
        )
        found, seen = RemapGrid.load(tmp_path / kind / "maps" / f"a.forward.{ending}").apply(photo)
        np.testing.assert_array_equal(seen, mask)
        # cubic steps of 1/32 px may round otherwise
        assert (abs(found.astype(int) - rectified) > 0).mean() < 0.02
        back, known = RemapGrid.load(tmp_path / kind / "maps" / f"a.inverse.{ending}").apply(rectified)
        off = abs(back.astype(float) - photo)[cv2.erode(known, np.ones((9, 9), np.uint8)) > 0]
        assert np.median(off) <= 3  # grey levels; twice interpolated


def test_maps_turn_with_their_photos(invoke, tmp_path):
    (tmp_path / "photos").mkdir()
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    jpeg = cv2.imencode(".jpg", texture(320, 240), [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (tmp_path / "photos" / "a.jpg").write_bytes(jpeg[:2] + segment + jpeg[2:])
    solution_of(tmp_path / "s.json", ["a.jpg"])
    args = ["rectify", "photos", "--solution", "s.json", "-o", "out", "--maps", "npz", "--apply-orientation"]
    assert invoke(*args, "--quality", 100).exit_code == 0
    image, photo = (
        cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
        for name in ("out/images/a.jpg", "photos/a.jpg")
    )
    found, seen = RemapGrid.load(tmp_path / "out" / "maps" / "a.forward.npz").apply(photo)
    assert found.shape == image.shape
    assert image.shape[:2] == (320, 240)
    assert abs(found.astype(int) - image)[seen > 0].mean() < 2  # JPEG


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "b/../../a.png", "..", ".", "", "a\0.png", 7])
def test_names_that_leave_their_folder_are_refused(invoke, tmp_path, name):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    value = json.loads((tmp_path / "s.json").read_text())
    value["images"][0]["name"] = name
    (tmp_path / "s.json").write_text(json.dumps(value))
    before = tree(tmp_path)
    for args in (["rectify", "photos", "--solution", "s.json", "-o", "out"], ["analyze", "s.json"]):
        assert "expected a name inside the folder of photos" in error_line(invoke(*args))
    assert tree(tmp_path) == before


def test_nothing_is_written_through_links(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    save_textures(tmp_path / "elsewhere", ["a.png"])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "images").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "out" / "solution.json").symlink_to(tmp_path / "s.json")
    before = tree(tmp_path / "elsewhere"), (tmp_path / "s.json").read_bytes()
    assert "images" in error_line(invoke("rectify", "photos", "--solution", "s.json", "-o", "out", "--overwrite"))
    assert (tree(tmp_path / "elsewhere"), (tmp_path / "s.json").read_bytes()) == before
    (tmp_path / "out" / "images").unlink()
    said = error_line(invoke("rectify", "photos", "--solution", "s.json", "-o", "out", "--overwrite"))
    assert "out/solution.json is a folder or a link" in said
    (tmp_path / "out" / "solution.json").unlink()
    assert invoke("rectify", "photos", "--solution", "s.json", "-o", "out", "--overwrite").exit_code == 0
    assert (tmp_path / "s.json").read_bytes() == before[1]


def test_rectify_leaves_out_photos_of_another_size(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    save_png(tmp_path / "photos" / "b.png", texture(240, 320))
    (tmp_path / "photos" / "c.png").write_bytes(b"cut")
    solution_of(tmp_path / "s.json", THREE)
    result = invoke("rectify", "photos", "--solution", "s.json", "-o", "out")
    assert result.exit_code == 3, result.stderr
    assert result.stdout.splitlines()[-3] == "failed:"
    assert [line.split(":")[0] for line in result.stdout.splitlines()[-2:]] == ["  b.png", "  c.png"]
    warnings = result.stderr.splitlines()
    assert len(warnings) == 2
    assert warnings[0].startswith("warning: skipped: b.png")
    assert warnings[1].startswith("warning: skipped: c.png")
    assert "1 photo rectified" in result.stdout
    assert "2 left out" in result.stdout
    files = {"images", "images/a.png", "masks", "masks/a.png", "solution.json"}
    assert set(tree(tmp_path / "out")) == files | {".rectified.jsonl", ".rsundistort-written"}


def test_rectify_refuses_photos_that_are_all_of_another_size(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE, 240, 320)
    solution_of(tmp_path / "s.json", THREE)
    before = tree(tmp_path)
    assert "could be rectified" in error_line(invoke("rectify", "photos", "--solution", "s.json", "-o", "out"))
    assert tree(tmp_path) == before


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "No such file"),
        ("{", "no valid JSON"),
        ("[]", "is no solution"),
        ('{"format": "rsundistort-solution", "version": 99}', "version 99"),
        ('{"format": "rsundistort-solution", "version": 1}', "lacks"),
        ("others", "no motion for any photo"),
        pytest.param("no rectified camera", "s.json"),
    ],
)
def test_rectify_refuses_what_is_no_solution_of_the_photos(invoke, tmp_path, content, says):
    save_textures(tmp_path / "photos", THREE)
    if content == "others":
        solution_of(tmp_path / "s.json", ["x.png", "y.png"])
    elif content == "no rectified camera":
        solution_of(tmp_path / "s.json", THREE)
        value = json.loads((tmp_path / "s.json").read_text())
        value["rectified_cameras"] = {}
        (tmp_path / "s.json").write_text(json.dumps(value))
    elif content is not None:
        (tmp_path / "s.json").write_text(content)
    before = tree(tmp_path)
    assert says in error_line(invoke("rectify", "photos", "--solution", "s.json", "-o", "out"))
    assert tree(tmp_path) == before


def test_rectify_refuses_bad_folders(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    (tmp_path / "empty").mkdir()
    before = tree(tmp_path)
    for photos, out in (("empty", "out"), ("none", "out"), ("photos", "photos"), ("photos", "s.json")):
        error_line(invoke("rectify", photos, "--solution", "s.json", "-o", out))
        assert tree(tmp_path) == before


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
        ('{"a.png": [NaN, 0, 0]}', ""),
        ('{"a.png": [1e999, 0, 0]}', ""),
        ('{"a.png": [0, 0]}', ""),
        ('{"a.png": 3}', ""),
        ('{"a.png": null}', ""),
        pytest.param('{"a.png": "fast"}', ""),
        pytest.param('{"a.png": ["x", "y", "z"]}', ""),
        pytest.param('{"a.png": [[1], [2, 3]]}', ""),
        pytest.param('{"a.png": {"x": 1}}', ""),
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
        (["--camera", CAMERA, "--sigma", "inf"], ""),
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
