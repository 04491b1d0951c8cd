"""No command removes or replaces a file that it did not write, nor one that it reads, whatever `--overwrite` says."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
from click.testing import CliRunner
from commands import solution_of
from four_photos import save_solution
from make_photos import save_textures
from rsundistort_cli.main import cli
from test_recipes import TINY

from rsundistort import rectify_folder
from rsundistort.errors import FileError
from rsundistort.io import output_folder
from rsundistort.io.journal import Journal
from rsundistort.io.outputs import _SCRATCH, batch_folder
from rsundistort.io.places import place_of
from rsundistort.io.record import Record
from rsundistort.solve.run_options import OutputOptions
from rsundistort.solve.run_outputs import remove_former

THREE = ["a.png", "b.png", "c.png"]
CAMERA = ["--camera", "300,300,160,120"]
FEW = ["--max-features", "200"]


@pytest.fixture
def invoke(monkeypatch, tmp_path):
    """Runs the command inside a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return lambda *args: CliRunner().invoke(cli, [str(arg) for arg in args])


def digests(folder):
    """Of all files, hidden ones and what links lead to as well."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def refused(result, said):
    """One line that says what and how to mend it, exit code 1, no traceback."""
    assert result.exit_code == 1, (result.exit_code, result.exception, result.stderr)
    assert isinstance(result.exception, SystemExit), result.exception
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, result.stderr
    assert said in errors[0]
    assert "; " in errors[0]  # the mend


# ---------------------------------------------------------------- inputs among the outputs


@pytest.mark.parametrize("folder", ["photos", "masks", "global"])
def test_simulate_warp_keeps_the_originals(invoke, tmp_path, folder):
    save_textures(tmp_path / folder, THREE)
    before = digests(tmp_path)
    command = ["simulate", "warp", folder, "-o", ".", "--overwrite", "--crop", *CAMERA]
    refused(invoke(*command), f"{folder} would be replaced by the outputs")
    assert digests(tmp_path) == before


@pytest.mark.parametrize("out", ["taken/masks", "taken/global"])
def test_simulate_warp_keeps_files_that_lie_where_its_own_would(invoke, tmp_path, out):
    save_textures(tmp_path / "photos", THREE)
    save_textures(tmp_path / out, ["b.png"])
    before = digests(tmp_path)
    result = invoke("simulate", "warp", "photos", "-o", "taken", "--overwrite", "--crop", *CAMERA)
    refused(result, f"{out}/b.png would be replaced, and nothing shows that rsundistort wrote it")
    assert digests(tmp_path) == before


def test_simulate_warp_keeps_the_camera_it_reads(invoke, tmp_path):
    save_textures(tmp_path / "raw", THREE)
    assert invoke("simulate", "warp", "raw", "-o", ".", *CAMERA, "--overwrite").exit_code == 0
    assert invoke("simulate", "warp", "raw", "-o", ".", *CAMERA, "--overwrite").exit_code == 0
    before = digests(tmp_path)
    # now it is the camera beside the photos
    refused(invoke("simulate", "warp", "raw", "-o", ".", "--overwrite"), "camera.json would be replaced by the outputs")
    assert digests(tmp_path) == before


@pytest.mark.parametrize("names", [("still", "swung"), ("pics", "swung-global")])
def test_experiment_two_keeps_the_photos(invoke, tmp_path, names):
    pytest.importorskip("matplotlib")
    for name in names:
        save_textures(tmp_path / name, THREE)
    before = digests(tmp_path)
    result = invoke("experiment", "two", *names, "-o", ".", "--overwrite", *CAMERA)
    refused(result, "would be replaced by the outputs")
    assert digests(tmp_path) == before


def test_run_keeps_the_video(invoke, tmp_path):
    (tmp_path / "out" / "frames").mkdir(parents=True)
    (tmp_path / "out" / "frames" / "walk.mp4").write_bytes(b"the only one")
    before = digests(tmp_path)
    result = invoke("run", "out/frames/walk.mp4", "-o", "out", "--every", 2, "--overwrite")
    refused(result, "walk.mp4 would be replaced by the outputs")
    assert digests(tmp_path) == before


def test_run_and_rectify_keep_the_depth_maps(invoke, tmp_path):
    save_textures(tmp_path / "photos", THREE)
    save_solution(tmp_path / "s.json", THREE)
    for name in ("images", "maps"):
        (tmp_path / "out" / name).mkdir(parents=True)
        np.save(tmp_path / "out" / name / "a.npy", np.ones((240, 320), np.float32))
    np.savez(tmp_path / "out" / "maps" / "a.forward.npz", depth=np.ones((240, 320), np.float32))
    before = digests(tmp_path)
    refused(invoke("run", "photos", "-o", "out", "--depth", "out/images", "--overwrite", *CAMERA), "images would be")
    command = ["rectify", "photos", "--solution", "s.json", "-o", "out", "--maps", "npz", "--overwrite"]
    refused(invoke(*command, "--depth", "out/maps"), "maps would be replaced by the outputs")
    refused(invoke(*command), "a.forward.npz would be replaced, and nothing shows that rsundistort wrote it")
    assert digests(tmp_path) == before


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_rectify_keeps_what_links_lead_to(invoke, tmp_path, link):
    """Whether it wrote that itself or not."""
    save_textures(tmp_path / "in", THREE)
    save_solution(tmp_path / "s.json", THREE)
    rectify_folder(tmp_path / "in", tmp_path / "s.json", tmp_path / "out")
    (tmp_path / "photos").mkdir()
    for name in THREE:
        link(tmp_path / "out" / "images" / name, tmp_path / "photos" / name)
    before = digests(tmp_path)
    command = ["rectify", "photos", "--solution", "s.json", "-o", "out", "--again", "--overwrite"]
    refused(invoke(*command), "photos/a.png would be replaced by the outputs by way of out/images/a.png")
    assert digests(tmp_path) == before
    (tmp_path / "out" / Record.NAME).unlink()
    (tmp_path / "out" / Journal.NAME).unlink()
    before = digests(tmp_path)
    refused(invoke(*command), "would be replaced")
    assert digests(tmp_path) == before


def test_a_link_among_the_outputs_is_not_ours(invoke, tmp_path):
    save_textures(tmp_path / "in", THREE)
    save_solution(tmp_path / "s.json", THREE)
    (tmp_path / "mine.png").write_bytes(b"mine")
    (tmp_path / "out" / "images").mkdir(parents=True)
    (tmp_path / "out" / "images" / "a.png").symlink_to(tmp_path / "mine.png")
    result = invoke("rectify", "in", "--solution", "s.json", "-o", "out", "--overwrite")
    refused(result, "out/images/a.png is a folder or a link")
    assert (tmp_path / "out" / "images" / "a.png").is_symlink()
    assert (tmp_path / "mine.png").read_bytes() == b"mine"


def test_rendering_a_recipe_where_it_lies(invoke, tmp_path):
    (tmp_path / "recipe.json").write_text(json.dumps(TINY))
    result = invoke("simulate", "scene", "recipe.json", "-o", ".", "--overwrite", "--no-depth")
    assert result.exit_code == 0, result.stderr
    assert json.loads((tmp_path / "recipe.json").read_text()) == TINY
    assert (tmp_path / "photos" / "0000.jpg").is_file()
    (tmp_path / "other.json").write_text(json.dumps({**TINY, "seed": 4}))
    before = digests(tmp_path)
    refused(invoke("simulate", "scene", "other.json", "-o", ".", "--overwrite"), "recipe.json would be replaced")
    assert digests(tmp_path) == before


# ---------------------------------------------------------------- others' files among the outputs

STRANGERS = (
    "images/mine.png", "images/.x.partial", "images/.notes", "images/deep/mine.txt", "masks/.x.partial.png", "mine.txt",
    ".x.partial", "maps/.a.partial.npz", "photos/mine.jpg", "global/mine.jpg", "sparse/mine.txt", "stereo/mine.bin",
    "frames/mine.mp4", "still/mine.jpg", ".rsundistort-mine/a.txt", "depth/mine.tif",
)  # fmt: skip


def commands(folder):
    return [
        ["rectify", folder / "in", "--solution", folder / "s.json", "--maps", "npz"],
        ["rectify", folder / "few", "--solution", folder / "s.json"],
        ["simulate", "warp", folder / "in", "--crop", *CAMERA],
        ["simulate", "warp", folder / "few", *CAMERA],
        ["simulate", "scene", folder / "recipe.json"],
        ["run", folder / "in", *CAMERA, *FEW],
        ["solve", folder / "in"],
    ]


@pytest.fixture
def inputs(tmp_path):
    folder = tmp_path / "inputs"
    save_textures(folder / "in", THREE)
    save_textures(folder / "few", THREE[:2])
    save_solution(folder / "s.json", THREE)
    (folder / "recipe.json").write_text(json.dumps(TINY))
    return folder


def test_whatever_others_keep_in_the_folder_stays(invoke, inputs, tmp_path):
    """All commands, twice, over each other, in a folder with files of others everywhere."""
    out = tmp_path / "out"
    for name in STRANGERS:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(name.encode())
    others = digests(tmp_path)
    worked = 0
    for command in commands(inputs) * 2:
        result = invoke(*command, "-o", out, "--overwrite")
        assert result.exit_code in (0, 1), result.stderr
        assert isinstance(result.exception, (SystemExit, type(None))), result.exception
        worked += result.exit_code == 0
        after = digests(tmp_path)
        assert {name: after.get(name) for name in others} == others, command
    assert worked == 10


@pytest.mark.parametrize("number", range(5))
@pytest.mark.parametrize("kind", ["foreign", "changed"])
def test_a_file_in_the_place_of_an_output_is_refused(invoke, inputs, tmp_path, number, kind):
    """Each file that a command writes, one after the other."""
    command = [*commands(inputs)[number], "-o", tmp_path / "out", "--overwrite"]
    assert invoke(*command).exit_code == 0
    written = [name for name in digests(tmp_path / "out") if not name.rpartition("/")[2].startswith(".")]
    for name in written:
        path = tmp_path / "out" / name
        if kind == "foreign":
            shutil.rmtree(tmp_path / "out")
            path.parent.mkdir(parents=True)
            path.write_bytes(b"mine")
        else:
            content = path.read_bytes()
            path.write_bytes(content[::-1])
        before = digests(tmp_path)
        refused(invoke(*command), "would be replaced" if kind == "foreign" else "was changed since")
        assert digests(tmp_path) == before
        if kind == "changed":
            path.unlink()


def test_a_new_batch_takes_away_the_old_one_alone(invoke, inputs, tmp_path):
    out = tmp_path / "out"
    command = ["rectify", inputs / "in", "--solution", inputs / "s.json", "-o", out, "--maps", "npz"]
    assert invoke(*command).exit_code == 0
    (out / "images" / "mine.png").write_bytes(b"mine")
    (out / "masks" / "c.png").write_bytes(b"mine now")
    assert invoke(*commands(inputs)[1], "-o", out, "--overwrite").exit_code == 0
    found = {name for name in digests(out) if not name.startswith(".")}
    assert found == {f"{k}/{n}" for k in ("images", "masks") for n in THREE[:2]} | {
        "images/mine.png", "masks/c.png", "solution.json",
    }  # fmt: skip


def test_resuming_keeps_what_lies_where_the_rest_would(invoke, inputs, tmp_path):
    out = tmp_path / "out"
    assert invoke(*commands(inputs)[1], "-o", out).exit_code == 0
    (out / "images" / "c.png").write_bytes(b"mine")
    before = digests(tmp_path)
    command = ["rectify", inputs / "in", "--solution", inputs / "s.json", "-o", out, "--resume"]
    refused(invoke(*command), "images/c.png would be replaced, and nothing shows that rsundistort wrote it")
    (out / "images" / "c.png").unlink()
    assert invoke(*command).exit_code == 0
    before.pop("out/images/c.png")
    assert digests(tmp_path).items() >= {n: d for n, d in before.items() if n.endswith(".png")}.items()


def test_reports_and_figures_of_others_stay(invoke, inputs, tmp_path):
    out = tmp_path / "out"
    solution_of(inputs / "s.json", THREE)
    assert invoke(*commands(inputs)[0], "-o", out).exit_code == 0
    for _ in range(2):
        assert invoke("report", out, "-q").exit_code == 0
    (out / "report.html").write_text("my notes")
    refused(invoke("report", out), "report.html was changed since it was written here")
    assert (out / "report.html").read_text() == "my notes"
    pytest.importorskip("matplotlib")
    for _ in range(2):
        assert invoke("report", out, "--figures", tmp_path / "figures", "-q").exit_code == 0
    assert (tmp_path / "figures" / "paths.pdf").is_file()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "models.png").write_bytes(b"mine")
    refused(invoke("report", out, "--figures", tmp_path / "other"), "models.png would be replaced")
    assert list(digests(tmp_path / "other")) == ["models.png"]


# ---------------------------------------------------------------- version 0.1


def test_a_batch_without_a_record_is_known_by_its_journal(invoke, inputs, tmp_path):
    for more in ("--overwrite", "--resume"):
        out = tmp_path / more
        assert invoke(*commands(inputs)[0], "-o", out).exit_code == 0
        (out / Record.NAME).unlink()
        (out / "images" / "mine.png").write_bytes(b"mine")
        assert invoke(*commands(inputs)[1], "-o", out, more).exit_code == 0
        kept = THREE if more == "--resume" else THREE[:2]
        assert {path.name for path in (out / "images").iterdir()} == {*kept, "mine.png"}
        assert not Record(out).ours(["images"]) ^ {f"images/{name}" for name in kept}


def test_other_outputs_without_a_record_are_refused(invoke, inputs, tmp_path):
    command = [*commands(inputs)[2], "-o", tmp_path / "out", "--overwrite"]
    assert invoke(*command).exit_code == 0
    (tmp_path / "out" / Record.NAME).unlink()
    refused(invoke(*command), "(version 0.1 kept no record); move it away, or give another folder for the outputs")


# ---------------------------------------------------------------- processes that were killed


def test_what_a_killed_process_left_is_no_content(tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    # a container gives its first process the same number each time
    stale = [
        tmp_path / f"{_SCRATCH}{gone.pid}-abc", tmp_path / f"{_SCRATCH}{os.getpid()}-abc",
        tmp_path / ".rsundistort-abcdefgh",
    ]  # fmt: skip
    busy = tmp_path / f"{_SCRATCH}{os.getppid()}-abc"
    for folder in (*stale, busy):
        (folder / "images").mkdir(parents=True)
        (folder / "images" / "a.png").write_bytes(b"half")
    with output_folder(tmp_path) as scratch:
        (scratch / "a.txt").write_text("a")
    assert not stale[0].exists()
    assert not stale[1].exists()
    assert stale[2].exists()  # nobody knows whose it is
    assert busy.exists()
    with pytest.raises(FileError, match="not empty"), batch_folder(tmp_path):
        pytest.fail("entered")


@pytest.mark.parametrize("name", ["maps", "also"])
def test_a_batch_that_did_nothing_leaves_nothing(tmp_path, name):
    def stopped():
        (tmp_path / name / "deep").mkdir(parents=True)
        (tmp_path / name / "deep" / "half.npz").write_text("ha")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), batch_folder(tmp_path):
        stopped()
    with batch_folder(tmp_path, resume=True):
        pass


def test_what_changed_since_a_folder_was_complete_is_named(tmp_path):
    record = Record(tmp_path)
    record.check(["a.txt", "b.txt"])
    with record.writing(["a.txt", "b.txt"]):
        for name in ("a.txt", "b.txt"):
            (tmp_path / name).write_text("whole")
    record.finish("key")
    assert Record(tmp_path).is_finished("key")
    assert Record(tmp_path).changed("key") == []
    assert Record(tmp_path).changed("other") is None
    (tmp_path / "b.txt").unlink()
    assert not Record(tmp_path).is_finished("key")
    assert Record(tmp_path).changed("key") == ["b.txt"]


def test_a_killed_process_leaves_a_record_by_which_its_files_are_known(tmp_path):
    record = Record(tmp_path)
    record.check(["a.txt", "b.txt", "c.txt"])
    record.claim(["a.txt", "b.txt", "c.txt"])
    (tmp_path / "a.txt").write_text("whole")
    record.add(["a.txt"])
    (tmp_path / "b.txt").write_text("ha")
    with (tmp_path / Record.NAME).open("a") as file:
        file.write('["d.txt", "1')
    after = Record(tmp_path)
    (tmp_path / "d.txt").write_text("mine")
    assert after.ours(["a.txt", "b.txt", "c.txt", "d.txt"]) == {"a.txt", "b.txt"}
    with after.writing(["a.txt"]):
        pass
    (tmp_path / "c.txt").write_text("mine")
    assert (tmp_path / Record.NAME).read_bytes().count(b"\n") == 2
    assert Record(tmp_path).ours(["a.txt", "b.txt", "c.txt", "d.txt"]) == {"a.txt", "b.txt"}


def test_a_record_says_nothing_of_what_lies_elsewhere(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (tmp_path / "mine.txt").write_text("mine")
    facts = (tmp_path / "mine.txt").stat()
    (out / Record.NAME).write_text(json.dumps(["../mine.txt", f"{facts.st_size} {facts.st_mtime_ns}"]) + "\n")
    assert Record(out).ours([".."]) == set()
    (tmp_path / "mine.txt").rename(tmp_path / "mine.jsonl")
    (out / Record.NAME).unlink()
    (out / Record.NAME).symlink_to(tmp_path / "mine.jsonl")
    with Record(out).writing(["a.txt"]):
        (out / "a.txt").write_text("a")
    assert (tmp_path / "mine.jsonl").read_text() == "mine"
    assert Record(out).ours(["a.txt"]) == {"a.txt"}
    (out / "images").symlink_to(tmp_path)
    with pytest.raises(FileError, match="leads out of"):
        Record(out).check(["images/new.txt"])


def test_many_files_are_looked_up_in_good_time(tmp_path):
    """Not by the square of their number: three files a photo of a large batch."""
    names = [f"images/{k}.png" for k in range(3000)]
    (tmp_path / "images").mkdir()
    record = Record(tmp_path)
    began = time.perf_counter()
    with record.writing():
        for name in names:
            record.claim([name])
            (tmp_path / name).touch()
            record.add([name])
    record.check(names)
    assert time.perf_counter() - began < 10  # by the square, a minute
    assert Record(tmp_path).ours(["images"]) == {*names}


# ---------------------------------------------------------------- by URL


@pytest.fixture
def memory():
    fs = pytest.importorskip("fsspec").filesystem("memory")
    fs.store.clear()
    fs.pseudo_dirs[:] = [""]
    yield fs
    fs.store.clear()
    fs.pseudo_dirs[:] = [""]


def test_files_of_others_stay_by_url(invoke, inputs, memory):
    url = "memory://bucket/out"
    command = ["rectify", inputs / "in", "--solution", inputs / "s.json", "-o", url, "--overwrite"]
    memory.pipe_file("/bucket/out/images/mine.png", b"mine")
    memory.pipe_file("/bucket/out/images/.x.partial", b"mine")
    for _ in range(2):
        result = invoke(*command)
        assert result.exit_code == 0, result.stderr
    assert memory.cat_file("/bucket/out/images/mine.png") == b"mine"
    assert memory.cat_file("/bucket/out/images/.x.partial") == b"mine"
    for name, said in (("images/b.png", "was changed since"), ("solution.json", "was changed since")):
        before = memory.cat_file(f"/bucket/out/{name}")
        memory.pipe_file(f"/bucket/out/{name}", b"mine")
        refused(invoke(*command), f"{url}/{name} {said}")
        assert memory.cat_file(f"/bucket/out/{name}") == b"mine"
        memory.rm_file(f"/bucket/out/{name}")
        assert before
        assert invoke(*command).exit_code == 0
    assert Record(place_of(url)).ours(["images"]) == {f"images/{name}" for name in THREE}


def test_what_an_earlier_run_wrote_and_this_one_does_not_is_removed(tmp_path):
    names = ["solution.json", "rs-poses/transforms.json", "metashape/cameras.xml", "report.html", "camera.usda"]
    with output_folder(tmp_path) as scratch:
        for name in names:
            (scratch / name).parent.mkdir(exist_ok=True)
            (scratch / name).write_text("old")
    (tmp_path / "metashape" / "mine.txt").write_text("mine")
    (tmp_path / "camera.usda").write_text("changed")
    remove_former(tmp_path, OutputOptions(exports=["metashape"], report=False))
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {"solution.json", "metashape/cameras.xml", "metashape/mine.txt", "camera.usda", Record.NAME}
    remove_former(tmp_path, OutputOptions(), ["camera.usda"])
    assert not (tmp_path / "metashape" / "cameras.xml").exists()
    assert (tmp_path / "metashape" / "mine.txt").exists()
