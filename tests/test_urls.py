"""Photos and outputs by URL: the same work as with folders, and the same refusals."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
from folders import seen_files
from four_photos import FOUR, invoke, save_solution
from make_photos import save_png, save_textures, texture

from rsundistort import RunOptions, rectify_folder, run, solve
from rsundistort.errors import FileError, InputError, SkippedPhotoWarning
from rsundistort.io.journal import Journal, RemoteJournal
from rsundistort.io.photos.images import list_photos
from rsundistort.io.places import RemoteFolder, place_of

fsspec = pytest.importorskip("fsspec")
shared_files = pytest.importorskip("shared_files")

NAMES = [*FOUR, "left/a.png"]


@pytest.fixture
def memory():
    """The file system of memory:// URLs, empty before and after."""
    fs = fsspec.filesystem("memory")
    fs.store.clear()
    fs.pseudo_dirs[:] = [""]
    yield fs
    fs.store.clear()
    fs.pseudo_dirs[:] = [""]


def put(fs, folder, url):
    for path, data in seen_files(folder).items():
        fs.pipe_file(f"{url}/{path}", data)


def held(fs, url):
    """Contents of the files under a URL that can be seen, by name."""
    root = fs._strip_protocol(url)
    found = {path.removeprefix(f"{root}/"): fs.cat_file(path) for path in fs.find(root)}
    return {path: data for path, data in found.items() if not path.rpartition("/")[2].startswith(".")}


@pytest.fixture(scope="module")
def made_locally(tmp_path_factory):
    """Photos, their solution, a mask, and what comes of them in folders."""
    folder = tmp_path_factory.mktemp("photos")
    (folder / "in" / "left").mkdir(parents=True)
    save_textures(folder / "in", NAMES)
    save_png(folder / "in" / ".hidden.png", texture(320, 240))
    save_solution(folder / "s.json", NAMES)
    (folder / "black").mkdir()
    save_png(folder / "black" / "b.png", np.zeros((240, 320), np.uint8))
    rectify_folder(folder / "in", folder / "s.json", folder / "truth", masks=folder / "black", maps="npz")
    return folder, seen_files(folder / "truth")


@pytest.fixture
def photos(made_locally, tmp_path):
    """A copy of them for the test, and what comes of them."""
    folder, truth = made_locally
    for name in ("in", "black"):
        shutil.copytree(folder / name, tmp_path / name)
    shutil.copy(folder / "s.json", tmp_path)
    return tmp_path, truth


@pytest.fixture
def remote(photos, memory):
    """The same photos and masks in memory."""
    folder, truth = photos
    put(memory, folder / "in", "memory://bucket/in")
    put(memory, folder / "black", "memory://bucket/black")
    return folder, truth, memory


MADE = {"masks": "memory://bucket/black", "maps": "npz"}


def versions(fs, url="memory://bucket/out"):
    """When each output was put."""
    return {path: fs.info(path)["created"] for path in fs.find(f"{url}/images")}


# ---------------------------------------------------------------- the same work


def test_by_url_as_in_folders(remote):
    folder, truth, fs = remote
    _, left_out = rectify_folder("memory://bucket/in", folder / "s.json", "memory://bucket/out/", **MADE)
    assert not left_out
    assert held(fs, "memory://bucket/out") == truth
    journal = [json.loads(line) for line in fs.cat_file("/bucket/out/.rectified.jsonl").splitlines()]
    assert [entry["name"] for entry in journal] == sorted(NAMES)
    assert all(len(entry["fingerprint"]) == 32 for entry in journal)


@pytest.mark.parametrize("end", ["in", "out"])
def test_one_end_by_url(remote, end):
    folder, truth, fs = remote
    photos = "memory://bucket/in" if end == "in" else folder / "in"
    out = "memory://bucket/out" if end == "out" else folder / "out"
    rectify_folder(photos, folder / "s.json", out, masks=folder / "black", maps="npz")
    assert (seen_files(out) if end == "in" else held(fs, out)) == truth


def test_a_file_url_is_a_path(photos):
    folder, truth = photos
    rectify_folder(
        (folder / "in").as_uri(), folder / "s.json", (folder / "o ut").as_uri(), masks=folder / "black", maps="npz"
    )
    assert seen_files(folder / "o ut") == truth
    result = invoke("info", "--json")
    assert result.exit_code == 0
    result = invoke("rectify", (folder / "in").as_uri(), "--solution", (folder / "s.json").as_uri(), "-o",
                    (folder / "o ut").as_uri(), "--resume", "--maps", "npz")  # fmt: skip
    assert result.exit_code == 0, result.stderr


@pytest.mark.slow
def test_workers_of_a_cluster_read_and_write_by_url(photos, cluster):
    """Of which they see nothing by path here; the one that stays does the work of both."""
    from distributed import Client

    folder, truth = photos
    address, workers = cluster
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Dask's own
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2)
            client.upload_file(shared_files.__file__)
        root = f"shared://{folder}"
        url = {"masks": f"{root}/black", "maps": "npz", "scheduler": address}
        rectify_folder(f"{root}/in", folder / "s.json", f"{root}/out", **url)
        assert seen_files(folder / "out") == truth
        assert not list((folder / "out").rglob("*.partial"))
        workers[0].kill()
        rectify_folder(f"{root}/in", folder / "s.json", f"{root}/out", **url, overwrite=True)
        assert seen_files(folder / "out") == truth
    with pytest.raises(InputError, match="workers of a scheduler do not see"):
        rectify_folder("memory://in", folder / "s.json", folder / "other", scheduler=address)


# ---------------------------------------------------------------- going on


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ("nothing", set()),
        ("photo", {"b.png"}),
        ("mask", {"b.png"}),
        ("cut", {"b.png"}),
        ("gone", {"b.png"}),
        ("map gone", {"b.png"}),
        ("journal cut", {"left/a.png"}),
    ],
)
def test_what_is_stale_or_broken_is_made_again(remote, change, again):
    folder, _, fs = remote
    work = ("memory://bucket/in", folder / "s.json", "memory://bucket/out")
    rectify_folder(*work, **MADE)
    before = versions(fs)
    if change == "photo":
        fs.pipe_file("/bucket/in/b.png", bytes((folder / "in" / "a.png").read_bytes()))
    elif change == "mask":
        fs.pipe_file("/bucket/black/b.png", fs.cat_file("/bucket/out/masks/a.png"))
    elif change == "cut":
        fs.pipe_file("/bucket/out/images/b.png", fs.cat_file("/bucket/out/images/b.png")[:99])
    elif change == "gone":
        fs.rm_file("/bucket/out/images/b.png")
    elif change == "map gone":
        fs.rm_file("/bucket/out/maps/b.inverse.npz")
    elif change == "journal cut":
        fs.pipe_file("/bucket/out/.rectified.jsonl", fs.cat_file("/bucket/out/.rectified.jsonl")[:-30])
    rectify_folder(*work, **MADE, resume=True)
    after = versions(fs)
    assert {path for path in after if after[path] != before.get(path)} == {f"/bucket/out/images/{n}" for n in again}
    rectify_folder("memory://bucket/in", folder / "s.json", "memory://bucket/fresh", **MADE)
    assert held(fs, "memory://bucket/out") == held(fs, "memory://bucket/fresh")


def test_after_an_interruption(remote):
    folder, truth, fs = remote

    def interrupt(stage, done, total):
        if (stage, done) == ("rectifying", 3):
            raise KeyboardInterrupt

    work = ("memory://bucket/in", folder / "s.json", "memory://bucket/out")
    with pytest.raises(KeyboardInterrupt, match="3 of 5 photos are done, whole; the same command with --resume"):
        rectify_folder(*work, **MADE, jobs=1, progress=interrupt)
    before = versions(fs)
    assert all(truth[path] == data for path, data in held(fs, "memory://bucket/out").items())
    rectify_folder(*work, **MADE, resume=True)
    assert held(fs, "memory://bucket/out") == truth
    assert sum(versions(fs)[path] == before[path] for path in before) >= 3


def test_what_is_about_to_be_replaced_does_not_pass_for_done_after_a_kill(remote, monkeypatch):
    """The journal that was put last may be old, but never says of a photo that it is what it was before."""
    folder, truth, fs = remote
    work = ("memory://bucket/in", folder / "s.json", "memory://bucket/out")
    rectify_folder(*work, **MADE)
    put_journal = RemoteJournal.settle

    def killed_after_the_first(self):
        put_journal(self)
        if any(not entry.fingerprint for entry in self.read().values()):
            monkeypatch.setattr(RemoteJournal, "settle", lambda self: None)

    monkeypatch.setattr(RemoteJournal, "settle", killed_after_the_first)
    rectify_folder(*work, **MADE, quality=50, interpolation="nearest", overwrite=True)
    monkeypatch.undo()
    assert held(fs, "memory://bucket/out") != truth
    rectify_folder(*work, **MADE, resume=True)
    assert held(fs, "memory://bucket/out") == truth


def test_the_journal_is_put_now_and_then(remote, monkeypatch):
    folder, _, fs = remote
    seen = []
    monkeypatch.setattr(RemoteJournal, "_EVERY_S", 0.0)
    monkeypatch.setattr(RemoteJournal, "_TIMES", 0.0)

    def look(stage, done, total):
        seen.append(fs.cat_file("/bucket/out/.rectified.jsonl").count(b"\n"))

    rectify_folder("memory://bucket/in", folder / "s.json", "memory://bucket/out", progress=look)
    assert seen == [0, 1, 2, 3, 4, 5]


def test_a_new_batch_leaves_nothing_of_the_old_one(remote):
    folder, truth, fs = remote
    work = ("memory://bucket/in", folder / "s.json", "memory://bucket/out")
    rectify_folder(*work, **MADE)
    fs.rm_file("/bucket/in/a.png")
    fs.pipe_file("/bucket/out/images/mine.png", b"mine")
    fs.pipe_file("/bucket/out/mine.txt", b"mine")
    rectify_folder(*work, **MADE, overwrite=True)
    gone = {"images/a.png", "masks/a.png", "maps/a.forward.npz", "maps/a.inverse.npz"}
    # without "a.png" the masks of the others keep their names
    assert held(fs, "memory://bucket/out").keys() == (truth.keys() - gone) | {"mine.txt", "images/mine.png"}


# ---------------------------------------------------------------- what goes wrong


def test_one_bad_photo_does_not_stop_the_others(remote):
    folder, _truth, fs = remote
    fs.pipe_file("/bucket/in/b.png", b"cut")
    result = invoke("rectify", "memory://bucket/in", "--solution", folder / "s.json", "-o", "memory://bucket/out")
    assert result.exit_code == 3
    assert "4 photos rectified" in result.stdout
    assert "memory://bucket/out" in result.stdout
    assert result.stdout.splitlines()[-1].startswith("  b.png: b.png cannot be decoded")
    assert {"images/b.png", "masks/b.png"}.isdisjoint(held(fs, "memory://bucket/out"))


def test_a_bad_mask_is_named_without_the_folder_it_passed_through(remote):
    folder, _, fs = remote
    fs.pipe_file("/bucket/black/b.png", b"none")
    with pytest.warns(SkippedPhotoWarning, match=r"skipped: b\.png: mask masks/b\.png cannot be decoded"):
        rectify_folder("memory://bucket/in", folder / "s.json", "memory://bucket/out", **MADE)


def test_a_photo_that_vanishes_midway(remote):
    folder, _, fs = remote

    def vanish(stage, done, total):
        if (stage, done) == ("rectifying", 0):
            fs.rm_file("/bucket/in/b.png")

    with pytest.warns(SkippedPhotoWarning, match=r"b\.png: memory://bucket/in/b\.png cannot be read: no such file"):
        rectify_folder("memory://bucket/in", folder / "s.json", "memory://bucket/out", progress=vanish)


def test_a_store_that_takes_no_more_stops_the_batch_and_can_be_gone_on_with(remote, monkeypatch):
    folder, truth, fs = remote
    pipe = type(fs).pipe_file
    count = iter(range(99))

    def full(self, path, value, **kwargs):
        if "/images/" in path and next(count) >= 2:
            raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))
        pipe(self, path, value, **kwargs)

    monkeypatch.setattr(type(fs), "pipe_file", full)
    command = ["rectify", "memory://bucket/in", "--solution", folder / "s.json", "-o", "memory://bucket/out",
               "--masks", "memory://bucket/black", "--maps", "npz"]  # fmt: skip
    result = invoke(*command, "--jobs", "1")
    assert result.exit_code == 1
    assert len(result.stderr.splitlines()) == 1
    assert "Disk quota exceeded; 2 of 5 photos are done, whole" in result.stderr
    monkeypatch.undo()
    assert invoke(*command, "--resume").exit_code == 0
    assert held(fs, "memory://bucket/out") == truth


def test_a_folder_that_may_not_be_written_is_reported_before_any_work(remote, monkeypatch):
    folder, _, fs = remote

    def refuse(self, path, value, **kwargs):
        raise PermissionError("Access Denied")

    before = held(fs, "memory://")
    monkeypatch.setattr(type(fs), "pipe_file", refuse)
    result = invoke("rectify", "memory://bucket/in", "--solution", folder / "s.json", "-o", "memory://bucket/out")
    assert result.exit_code == 1
    said = "error: memory://bucket/out/.rectified.jsonl cannot be written: no permission (Access Denied)"
    assert result.stderr.splitlines() == [said]
    assert held(fs, "memory://") == before


def test_a_temporary_folder_that_cannot_be_written_stops_the_batch(remote, monkeypatch):
    folder, _, _ = remote
    monkeypatch.setattr(tempfile, "tempdir", str(folder / "none"))
    for out in ("memory://bucket/out", folder / "out"):
        with pytest.raises(FileError, match="none cannot be written: No such file or directory"):
            rectify_folder("memory://bucket/in", folder / "s.json", out)


def test_nothing_is_left_of_a_first_photo_that_could_not_be_put(remote, monkeypatch):
    folder, _, fs = remote
    pipe = type(fs).pipe_file

    def full(self, path, value, **kwargs):
        if "/images/" in path:
            raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))
        pipe(self, path, value, **kwargs)

    monkeypatch.setattr(type(fs), "pipe_file", full)
    with pytest.raises(FileError, match="Disk quota exceeded; 0 of 5 photos are done"):
        rectify_folder("memory://bucket/in", folder / "s.json", "memory://bucket/out")
    assert not fs.exists("/bucket/out")


def test_nothing_is_left_where_nothing_could_be_done(remote):
    folder, _, fs = remote
    for name in NAMES:
        fs.pipe_file(f"/bucket/in/{name}", b"cut")
    with (
        pytest.warns(SkippedPhotoWarning),
        pytest.raises(InputError, match="none of the 5 photos of memory://bucket/in could be rectified"),
    ):
        rectify_folder("memory://bucket/in", folder / "s.json", "memory://bucket/out")
    assert not fs.exists("/bucket/out")


def test_the_folder_must_be_empty_or_hold_a_batch(remote):
    folder, _, fs = remote
    fs.pipe_file("/bucket/out/mine.txt", b"mine")
    command = ["rectify", "memory://bucket/in", "--solution", folder / "s.json", "-o", "memory://bucket/out"]
    for more in ([], ["--resume"]):
        result = invoke(*command, *more)
        assert result.exit_code == 1
        assert "error: memory://bucket/out is not empty" in result.stderr
    assert held(fs, "memory://bucket/out") == {"mine.txt": b"mine"}
    fs.rm_file("/bucket/out/mine.txt")
    assert invoke(*command).exit_code == 0
    result = invoke(*command)
    assert result.exit_code == 1
    assert "--resume to continue" in result.stderr


@pytest.mark.parametrize(
    ("source", "out", "said"),
    [
        ("memory://bucket/in", "memory:///bucket/in/", "memory:///bucket/in holds the photos"),
        ("memory://bucket/out/images", "memory://bucket/out", "images would be replaced by the outputs"),
        ("memory://bucket/out/also/in", "memory:///bucket/out", "also/in would be replaced by the outputs"),
    ],
)
def test_photos_among_the_outputs_are_not_replaced(photos, memory, source, out, said):
    folder, _ = photos
    put(memory, folder / "in", source)
    before = held(memory, "memory://")
    with pytest.raises(FileError, match=said):
        rectify_folder(source, folder / "s.json", out, overwrite=True)
    assert held(memory, "memory://") == before


def test_names_that_leave_the_folder_are_refused(remote):
    folder, _, fs = remote
    value = json.loads((folder / "s.json").read_text())
    value["images"][1]["name"] = "../x.png"
    (folder / "s.json").write_text(json.dumps(value))
    result = invoke("rectify", "memory://bucket/in", "--solution", folder / "s.json", "-o", "memory://bucket/out")
    assert result.exit_code == 1
    assert "expected a name inside the folder" in result.stderr
    assert not fs.exists("/bucket/out")


def test_a_forged_journal_deletes_nothing_elsewhere(remote):
    folder, _, fs = remote
    fs.pipe_file("/bucket/mine.png", b"mine")
    line = json.dumps({"name": "a.png", "fingerprint": "", "files": {"../mine.png": 4}, "turn": 1, "depth": None})
    fs.pipe_file("/bucket/out/.rectified.jsonl", line.encode())
    rectify_folder("memory://bucket/in", folder / "s.json", "memory://bucket/out", resume=True)
    assert fs.cat_file("/bucket/mine.png") == b"mine"


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("nowhere://bucket/in", "error: nowhere://bucket/in cannot be opened: Protocol not known: nowhere"),
        ("memory://bucket/none", "error: memory://bucket/none is no folder; give the folder that holds the photos"),
        ("memory://bucket/../in", "error: memory://bucket/../in: a URL must not have '..' in it"),
    ],
)
def test_urls_that_cannot_be_photos(remote, url, said):
    folder, _, _ = remote
    result = invoke("rectify", url, "--solution", folder / "s.json", "-o", folder / "out")
    assert result.exit_code == 1
    assert result.stderr.splitlines() == [said]
    assert not (folder / "out").exists()


def test_a_package_that_is_missing_is_named(remote, monkeypatch):
    folder, _, _ = remote
    missing = {"class": "no_such_package.FileSystem", "err": "Install no-such-package to access it"}
    from fsspec.registry import known_implementations

    monkeypatch.setitem(known_implementations, "absent", missing)
    result = invoke("rectify", "absent://x/in", "--solution", folder / "s.json", "-o", folder / "out")
    assert result.exit_code == 1
    said = "error: absent://x/in: a package is missing: Install no-such-package to access it"
    assert result.stderr.splitlines() == [said]


@pytest.mark.parametrize("what", ["--also", "--depth", "--solution"])
def test_what_must_be_local_says_so(remote, what):
    folder, _, _ = remote
    command = ["rectify", "memory://bucket/in", "--solution", folder / "s.json", "-o", "memory://bucket/out"]
    result = invoke(*command, what, "memory://bucket/other")
    assert result.exit_code == 1
    assert result.stderr.startswith("error: memory://bucket/other is a URL, and here a path is needed; ")
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize("command", ["run", "solve"])
def test_other_commands_take_paths(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = invoke(command, tmp_path, "-o", "s3://bucket/out")
    assert result.exit_code == 1
    assert result.stderr.startswith("error: s3://bucket/out is a URL, and here a path is needed; ")
    assert not list(tmp_path.iterdir())


def test_run_and_solve_take_paths(tmp_path):
    with pytest.raises(InputError, match="URLs are taken by rectify"):
        run(tmp_path, "s3://bucket/out", RunOptions())
    with pytest.raises(InputError, match="URLs are taken by rectify"):
        solve(tmp_path, "s3://bucket/out")


# ---------------------------------------------------------------- file systems


def test_a_file_replaces_another_where_nothing_is_renamed_onto_what_is_there(tmp_path):
    folder = place_of(f"shared://{tmp_path}")
    folder.write("sub/a", b"one")
    folder.write("sub/a", b"two")
    assert seen_files(tmp_path) == {"sub/a": b"two"}
    assert not list(tmp_path.rglob("*.partial"))


def test_nothing_is_left_of_a_file_that_could_not_be_written(tmp_path, monkeypatch):
    folder = place_of(f"shared://{tmp_path}")
    folder.write("a", b"one")

    def broken(self, path1, path2, **kwargs):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    def kept(self, path):
        raise AssertionError(path)

    monkeypatch.setattr(shared_files.SharedFileSystem, "mv", broken)
    with pytest.raises(FileError, match=r"shared:.*/b cannot be written: .*Input/output error"):
        folder.write("b", b"two")
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_file_system_that_knows_no_times_has_its_photos_made_again(remote, monkeypatch):
    folder, _, fs = remote
    ls = type(fs).ls

    def timeless(self, path, detail=True, **kwargs):
        return [{k: v for k, v in entry.items() if k != "created"} for entry in ls(self, path, detail=True)]

    monkeypatch.setattr(type(fs), "ls", timeless)
    work = ("memory://bucket/in", folder / "s.json", folder / "out")
    rectify_folder(*work)
    before = (folder / "out" / "images" / "a.png").stat().st_ino
    rectify_folder(*work, resume=True)
    assert (folder / "out" / "images" / "a.png").stat().st_ino != before


def test_photos_are_listed_by_url_as_in_folders(remote):
    folder, _, fs = remote
    for extra in ("in/notes.txt", "in/other/x.png", "in/right/c.JPG"):
        fs.pipe_file(f"/bucket/{extra}", b"")
        (folder / extra).parent.mkdir(exist_ok=True)
        (folder / extra).write_bytes(b"")
    for sub_folders in ((), ("left",), ("left", "right", "none")):
        by_url = list_photos(RemoteFolder("memory://bucket/in"), "tif", sub_folders)
        assert by_url == list_photos(folder / "in", "tif", sub_folders)


def test_the_place_in_a_url_ends_without_a_slash():
    assert str(place_of("memory://bucket/in//")) == "memory://bucket/in"
    assert place_of(Path("in")) == place_of("in") == Path("in")
    assert place_of("file:///a%20b") == Path("/a b")


def test_the_journal_of_an_earlier_batch_is_read(remote):
    _, _, fs = remote
    fs.pipe_file("/bucket/out/.rectified.jsonl", b"[1]\n")
    journal = RemoteJournal(RemoteFolder("memory://bucket/out"))
    with journal:
        journal.fetch()
        assert journal.read() == {}
    assert fs.cat_file(f"/bucket/out/{Journal.NAME}") == b"[1]\n"
