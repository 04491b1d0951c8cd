"""`rectify` on the command line: photos of a solution, what goes through the same grid, and what is refused."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest
from commands import THREE, error_line, solution_of
from folders import tree
from make_photos import save_png, save_textures, texture

from rsundistort import (
    RemapGrid,
    read_solution,
    rectify,
)
from rsundistort.io.record import Record


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


def test_rectify_counts_the_photos_that_it_rectified(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    save_textures(tmp_path / "photos" / "more", ["d.png"])
    solution_of(tmp_path / "s.json", [*THREE, "more/d.png", "elsewhere.png"])
    (tmp_path / "photos" / "b.png").write_bytes(b"no photo")
    args = ["rectify", "photos", "--solution", "s.json", "-o", "out"]
    result = invoke(*args)
    assert (result.exit_code, result.stdout.splitlines()[0]) == (
        3,
        "3 photos rectified with the rotation model, 1 left out: out",
    )
    (tmp_path / "out" / "images" / "a-painting.png").write_bytes(b"of the user")
    result = invoke(*args, "--resume", "--json")  # what is whole is not rectified again
    assert json.loads(result.stdout)["rectified"] == 3


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


def test_an_image_of_two_photos_of_one_stem_is_refused(invoke, tmp_path):
    names = ["a.png", "a.jpg"]
    save_textures(tmp_path / "photos", names)
    save_textures(tmp_path / "labels", ["a.tif"])
    solution_of(tmp_path / "s.json", names)
    args = ["rectify", "photos", "--solution", "s.json", "-o", "out", "--also", "labels"]
    said = error_line(invoke(*args))
    assert "a.tif would be of a.jpg and of a.png; call it a.png.tif if it is of the latter" in said
    assert not (tmp_path / "out").exists()
    save_textures(tmp_path / "labels", ["a.png.tif"])
    assert invoke(*args).exit_code == 0
    assert set(tree(tmp_path / "out" / "also")) == {"labels", "labels/a.tif", "labels/a.png.tif"}


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


def test_maps_rotate_with_their_photos(invoke, tmp_path):
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


@pytest.mark.parametrize("name", ["../a.png", "/a.png", "b/../../a.png", "..", ".", "", "a\0.png"])
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


def test_scales_are_of_the_raw_photos(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    args = ["rectify", "photos", "-q", "-o", "out", "--overwrite", "--solution"]

    def size():
        camera = read_solution(tmp_path / "out" / "solution.json").rectified_cameras["1"]
        return camera.width, camera.height

    assert invoke(*args, "s.json", "--scale", "0.5").exit_code == 0
    half = tree(tmp_path / "out" / "images")
    assert size() == (160, 120)
    # the solution has that view now
    for scale in ("--scale", "0.5"), ():
        assert invoke(*args, "out/solution.json", *scale).exit_code == 0
        assert tree(tmp_path / "out" / "images") == half
    assert invoke(*args, "out/solution.json", "--max-size", "80").exit_code == 0
    assert size() == (80, 60)
    assert invoke(*args, "out/solution.json", "--scale", "1").exit_code == 0
    assert size() == (320, 240)
    result = invoke(*args, "s.json", "--scale", "200")
    assert result.exit_code == 1
    assert "scale=200 makes 64000x48000 pixels of 320x240" in result.stderr


def test_models_of_a_run_describe_the_photos_beside_them(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    solution_of(tmp_path / "s.json", THREE)
    args = ["rectify", "photos", "-q", "-o", "out", "--overwrite", "--solution"]
    assert invoke(*args, "s.json").exit_code == 0
    with Record(tmp_path / "out").writing(["transforms.json"]):
        (tmp_path / "out" / "transforms.json").write_text("{}")
    before = tree(tmp_path / "out")
    # the same view again is what they describe
    assert invoke(*args, "out/solution.json").exit_code == 0
    others = [["out/solution.json", "--alpha", "0"], ["out/solution.json", "--apply-orientation"], ["s.json"]]
    for other in others:
        result = invoke(*args, *other)
        assert result.exit_code == 1
        assert "out holds transforms.json, which describes the photos that were rectified there" in result.stderr
        assert tree(tmp_path / "out").keys() == before.keys()
    (tmp_path / "photos" / "a.png").unlink()
    assert invoke(*args, "out/solution.json").exit_code == 1
