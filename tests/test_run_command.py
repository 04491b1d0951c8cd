"""What `run` refuses, in one line and before it writes anything."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest
from commands import CAMERA, COMMAND, FEW, THREE, error_line
from folders import tree
from make_photos import save_png, save_textures, texture

from rsundistort.io.record import Record


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


def _camera_sigma(text, *others):
    def make(folder):
        save_textures(folder, THREE)
        return ["--camera", CAMERA, "--camera-sigma", text, *others]

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


def _still_of_global(folder):
    save_textures(folder, THREE)
    return ["--camera", CAMERA, "--still", "a.png", "--model", "global"]


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


def _tiny_scale(folder):
    save_textures(folder, THREE)
    return ["--camera", CAMERA, "--scale", "0.001"]


def _two_camera_files(folder):
    save_textures(folder, THREE)
    for name in ("camera.json", "cameras.json"):
        (folder / name).write_text(OTHER_SIZE)
    return []


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
        (_no_camera, "check the camera's focal length"),
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
        (_flat, "no photo shows a feature (a.png: shows no features); use photos of things with texture"),
        (_still, "nobody.png"),
        (_tiny_scale, "scale=0.001 leaves 0x0 pixels"),
        (_two_camera_files, "holds camera.json and cameras.json; remove one"),
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
        (_camera_sigma("k4=1"), "camera_sigma: k4 of a pinhole lens"),
        (_camera_sigma("f=1", "--refine", "none"), "refine none fixes the camera"),
        (_camera_sigma("fx=1", "--refine", "f,k1"), "how far fx may be off, which refine keeps fixed"),
        (_still_of_global, "a global shutter has no motion"),
    ],
)
def test_run_refuses_in_one_line_and_writes_nothing(invoke, tmp_path, make, says):
    options = make(tmp_path / "photos")
    before = tree(tmp_path)
    line = error_line(invoke("run", "photos", "-o", "deep/out", *FEW, *options))
    assert says in line
    assert tree(tmp_path) == before


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


def test_what_cannot_be_used_is_refused_before_any_work(tmp_path, invoke):
    save_textures(tmp_path / "photos", THREE)
    (tmp_path / "others").mkdir()
    for option, what in (("--also", "image"), ("--depth", "depth map")):
        line = error_line(invoke("run", "photos", "-o", "out", "--camera", CAMERA, *FEW, option, "others"))
        assert f"holds no {what} of any photo" in line
    line = error_line(invoke("run", "photos", "-o", "out", "--camera", CAMERA, *FEW, "--scale", "300"))
    assert "scale=300 makes" in line
    assert not (tmp_path / "out").exists()
