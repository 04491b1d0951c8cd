"""The folder that a batch fills: what is in it, in the way of it, and beside it."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess

import numpy as np
import pycolmap
import pytest
from folders import seen_files
from four_photos import FOUR, arguments, invoke, save_solution
from make_photos import save_png, save_textures, texture

from rsundistort import (
    RunOptions,
    rectify_folder,
    run,
)
from rsundistort.errors import FileError, InputError
from rsundistort.io import read_colmap_poses, read_photo
from rsundistort.io.journal import Journal, JournalEntry


@pytest.fixture
def four(tmp_path):
    """A folder of four photos and its solution."""
    save_textures(tmp_path / "in", FOUR)
    save_solution(tmp_path / "s.json", FOUR)
    return tmp_path


def no_room_after(monkeypatch, count, code=errno.ENOSPC):
    """A disk that is full after so many files."""
    from rsundistort.io.photos import images

    written = []
    write = images.write_aside

    def full(path, *parts):
        if len(written) >= count:
            raise OSError(code, os.strerror(code), str(path))
        written.append(path)
        write(path, *parts)

    monkeypatch.setattr(images, "write_aside", full)


def test_a_full_disk_stops_the_batch_and_can_be_gone_on_with(four, monkeypatch):
    no_room_after(monkeypatch, 4)
    result = invoke(*arguments(four, "--jobs", "1"))
    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == 1
    assert "cannot be written: No space left on device; 2 of 4 photos are done" in result.stderr
    assert "--resume" in result.stderr
    monkeypatch.undo()
    assert invoke(*arguments(four, "--resume")).exit_code == 0
    rectify_folder(four / "in", four / "s.json", four / "fresh")
    assert seen_files(four / "out") == seen_files(four / "fresh")


def test_a_disk_without_any_room_leaves_nothing(four, monkeypatch):
    no_room_after(monkeypatch, 0)
    before = seen_files(four)
    with pytest.raises(FileError, match="No space left on device"):
        rectify_folder(four / "in", four / "s.json", four / "out")
    assert seen_files(four) == before
    assert not (four / "out").exists()


@pytest.fixture
def mounted(tmp_path):
    """Mounts a small disk in memory; skips where that is not allowed."""
    places = []

    def mount(options):
        place = tmp_path / "disk"
        place.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)]
        if not shutil.which("mount") or subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("may not mount a disk")
        places.append(place)
        return place

    yield mount
    for place in places:
        subprocess.run(["umount", str(place)], check=True)


def test_a_small_disk(four, mounted):
    out = mounted("size=400k") / "out"
    with pytest.raises(FileError, match=r"No space left on device.*of 4 photos are done"):
        rectify_folder(four / "in", four / "s.json", out, jobs=1)
    assert all(read_photo(out / name).pixels.shape[:2] == (240, 320) for name in seen_files(out))
    subprocess.run(["mount", "-o", "remount,size=4m", str(out.parent)], check=True)
    rectify_folder(four / "in", four / "s.json", out, resume=True)
    rectify_folder(four / "in", four / "s.json", four / "fresh")
    assert seen_files(out) == seen_files(four / "fresh")


def test_a_read_only_disk(four, mounted):
    out = mounted("ro") / "out"
    with pytest.raises(FileError, match="cannot be written: Read-only file system; give another folder"):
        rectify_folder(four / "in", four / "s.json", out)


def test_outputs_inside_the_photos_are_not_taken_for_photos(four):
    for more in ([], ["--overwrite"], ["--resume"]):
        command = ["rectify", four / "in", "--solution", four / "s.json", "-o", four / "in" / "out", *more]
        result = invoke(*command)
        assert result.exit_code == 0, result.stderr
        assert "4 photos rectified with the rotation model, 0 left out" in result.stdout


@pytest.mark.parametrize("inside", ["images", "masks"])
def test_photos_among_the_outputs_are_not_replaced(four, inside):
    (four / "out").mkdir()
    (four / "in").rename(four / "out" / inside)
    before = seen_files(four)
    for out in (four / "out", four / "out" / "images" / ".."):
        with pytest.raises(FileError, match="would be replaced by the outputs"):
            rectify_folder(four / "out" / inside, four / "s.json", out, overwrite=True)
    with pytest.raises(FileError, match="would be replaced by the outputs"):
        run(four / "out" / inside, four / "out", RunOptions(camera="300,300,160,120"), overwrite=True)
    assert seen_files(four) == before


@pytest.mark.parametrize("name", ["../x.png", "/etc/x.png", "a/../../x.png", "a//x.png", "./x.png", "", ".."])
def test_names_that_leave_the_folder_are_refused(four, name):
    save_png(four / "x.png", texture(320, 240))
    value = json.loads((four / "s.json").read_text())
    value["images"][1]["name"] = name
    (four / "s.json").write_text(json.dumps(value))
    before = seen_files(four)
    result = invoke(*arguments(four))
    assert result.exit_code == 1
    assert result.stderr.startswith("error: ")
    assert "expected a name inside the folder" in result.stderr
    assert seen_files(four) == before


def test_names_in_a_colmap_model_that_leave_its_folder_are_refused(tmp_path):
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=8, height=6, params=[9, 9, 4, 3], camera_id=1)
    )
    image = pycolmap.Image(name="../x.png", keypoints=np.zeros((0, 2)), camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    (tmp_path / "sparse").mkdir()
    model.write(tmp_path / "sparse")
    with pytest.raises(InputError, match=r"'\.\./x\.png'"):
        read_colmap_poses(tmp_path / "sparse")


@pytest.mark.parametrize("link", ["images", "masks", "images/sub"])
def test_links_that_lead_out_of_the_folder_are_refused(tmp_path, link):
    names = ["a.png", "sub/b.png"]
    (tmp_path / "in" / "sub").mkdir(parents=True)
    save_textures(tmp_path / "in", names)
    save_solution(tmp_path / "s.json", names)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "b.png").write_bytes(b"mine")
    (tmp_path / "out" / link).parent.mkdir(parents=True)
    (tmp_path / "out" / link).symlink_to(tmp_path / "elsewhere")
    before = seen_files(tmp_path / "elsewhere")
    with pytest.raises(FileError, match="leads out of"):
        rectify_folder(tmp_path / "in", tmp_path / "s.json", tmp_path / "out", overwrite=True)
    assert seen_files(tmp_path / "elsewhere") == before


def test_a_forged_journal_deletes_nothing_elsewhere(four):
    (four / "mine.png").write_bytes(b"mine")
    rectify_folder(four / "in", four / "s.json", four / "out")
    with Journal(four / "out") as journal:
        journal.add(JournalEntry("a.png", "", {"images/a.png": 1}))
    line = json.dumps({"name": "a.png", "fingerprint": "", "files": {"../mine.png": 4}, "turn": 1})
    with (four / "out" / Journal.NAME).open("a") as file:
        file.write(line + "\n")
    rectify_folder(four / "in", four / "s.json", four / "out", resume=True)
    assert (four / "mine.png").read_bytes() == b"mine"


def test_sub_folders_that_the_solution_names(tmp_path):
    names = ["a.png", "left/a.png", "left/in/b.jpg", "right/a.png"]
    for name in names:
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
    save_textures(tmp_path / "in", names)
    (tmp_path / "in" / "other").mkdir()
    save_png(tmp_path / "in" / "other" / "a.png", texture(320, 240))
    (tmp_path / "black" / "left").mkdir(parents=True)
    save_png(tmp_path / "black" / "left" / "a.png", np.zeros((240, 320), np.uint8))
    save_solution(tmp_path / "s.json", names)
    _, left_out = rectify_folder(tmp_path / "in", tmp_path / "s.json", tmp_path / "out", masks=tmp_path / "black")
    assert not left_out
    images = {f"images/{name}" for name in names}
    masks = {f"masks/{name}" for name in ("a.png", "left/a.png", "left/in/b.png", "right/a.png")}
    assert set(seen_files(tmp_path / "out")) == images | masks | {"solution.json"}
    assert [read_photo(tmp_path / "out" / "masks" / n).pixels.any() for n in ("a.png", "left/a.png")] == [True, False]
