"""Batches of photos: whole files only, going on after any end, what is wrong with one of them, and clusters."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from folders import seen_files
from four_photos import FOUR, arguments, invoke, save_solution
from make_photos import COURTYARD_NAMES, half_courtyard, save_png, save_textures, texture

from rsundistort import (
    Camera,
    RectifyOptions,
    RowMotion,
    RunOptions,
    Solution,
    SolvedImage,
    SolveOptions,
    read_solution,
    rectify_folder,
    run,
    write_solution,
)
from rsundistort.batch.workers import Workers
from rsundistort.errors import FileError, SkippedPhotoWarning
from rsundistort.io import read_photo
from rsundistort.io.journal import Journal
from rsundistort.io.kept import Kept

COMMAND = Path(sys.executable).with_name("rsundistort")


@pytest.fixture
def four(tmp_path):
    """A folder of four photos and its solution."""
    save_textures(tmp_path / "in", FOUR)
    save_solution(tmp_path / "s.json", FOUR)
    return tmp_path


def made(folder):
    """Which file each output is: another one after it was made again."""
    return {path.name: path.stat().st_ino for path in (folder / "images").iterdir()}


# ---------------------------------------------------------------- going on


def test_what_is_whole_and_current_is_passed_over(four):
    rectify_folder(four / "in", four / "s.json", four / "out")
    before, content = made(four / "out"), seen_files(four / "out")
    rectify_folder(four / "in", four / "s.json", four / "out", resume=True)
    assert made(four / "out") == before
    assert seen_files(four / "out") == content


@pytest.mark.parametrize(
    ("change", "again"),
    [
        ("photo", {"b.png"}),
        ("motion", {"b.png"}),
        ("options", set(FOUR)),
        ("own mask", {"b.png"}),
        ("cut", {"b.png"}),
        ("gone", {"b.png"}),
        ("mask gone", {"b.png"}),
        ("journal cut", {"d.jpg"}),
        ("journal garbled", set(FOUR)),
    ],
)
def test_what_is_stale_or_broken_is_made_again(four, change, again):
    """As a batch that never knew another state would have made it."""
    out, options = four / "out", RectifyOptions()
    (four / "masks").mkdir()
    save_png(four / "masks" / "b.png", np.full((240, 320), 255, np.uint8))
    if change == "own mask":
        options = replace(options, masks=four / "masks")
    rectify_folder(four / "in", four / "s.json", out, options)
    before = made(out)
    if change == "photo":
        save_png(four / "in" / "b.png", texture(320, 240, 9))
    elif change == "motion":
        solution = read_solution(four / "s.json")
        images = [replace(i, motion=RowMotion([0.01, 0, 0])) if i.name == "b.png" else i for i in solution.images]
        write_solution(four / "s.json", replace(solution, images=tuple(images)))
    elif change == "options":
        options = replace(options, interpolation="nearest")
    elif change == "own mask":
        save_png(four / "masks" / "b.png", np.zeros((240, 320), np.uint8))
    elif change == "cut":
        (out / "images" / "b.png").write_bytes((out / "images" / "b.png").read_bytes()[:99])
        before["b.png"] = None
    elif change == "gone":
        (out / "images" / "b.png").unlink()
        before["b.png"] = None
    elif change == "mask gone":
        (out / "masks" / "b.png").unlink()
    elif change == "journal cut":
        text = (out / Journal.NAME).read_text()
        (out / Journal.NAME).write_text(text[:-30])
    else:
        (out / Journal.NAME).write_text("[1]\nnull\n{}\n")
    rectify_folder(four / "in", four / "s.json", out, options, resume=True)
    after = made(out)
    assert {name for name in FOUR if after[name] != before.get(name)} == again
    rectify_folder(four / "in", four / "s.json", four / "fresh", options)
    assert seen_files(out) == seen_files(four / "fresh")
    assert (out / Journal.NAME).read_bytes() == (four / "fresh" / Journal.NAME).read_bytes()


def test_outputs_of_photos_that_fail_now_do_not_stay(four):
    rectify_folder(four / "in", four / "s.json", four / "out")
    (four / "in" / "b.png").write_bytes(b"cut")
    with pytest.warns(SkippedPhotoWarning, match=r"b\.png"):
        _, left_out = rectify_folder(four / "in", four / "s.json", four / "out", resume=True)
    assert list(left_out) == ["b.png"]
    assert set(seen_files(four / "out")) == {f"{k}/{n}" for k in ("images", "masks") for n in ("a.png", "c.png")} | {
        "images/d.jpg", "masks/d.png", "solution.json",
    }  # fmt: skip


def test_photos_that_left_the_folder_keep_their_outputs(four):
    """Who moves away what is done, and goes on, loses nothing; who begins anew has the new batch only."""
    rectify_folder(four / "in", four / "s.json", four / "out")
    before = seen_files(four / "out")
    (four / "in" / "a.png").unlink()
    rectify_folder(four / "in", four / "s.json", four / "out", resume=True)
    assert seen_files(four / "out") == before
    rectify_folder(four / "in", four / "s.json", four / "out", overwrite=True)
    assert set(before) - set(seen_files(four / "out")) == {"images/a.png", "masks/a.png"}


def test_a_stale_output_is_never_taken_for_an_earlier_one(four, monkeypatch):
    """Made with other options, then killed before that was noted; then gone on with the first options."""
    rectify_folder(four / "in", four / "s.json", four / "out")
    content = seen_files(four / "out")
    add = Journal.add
    monkeypatch.setattr(Journal, "add", lambda self, entry: None if entry.fingerprint else add(self, entry))
    monkeypatch.setattr(Journal, "write", lambda self, entries: None)
    rectify_folder(four / "in", four / "s.json", four / "out", interpolation="nearest", resume=True)
    monkeypatch.undo()
    # as if of the same length
    entries = Journal(four / "out").read()
    assert all(entry.fingerprint == "" for entry in entries.values())
    rectify_folder(four / "in", four / "s.json", four / "out", resume=True)
    assert seen_files(four / "out") == content


def test_the_folder_must_be_empty_or_hold_a_batch(four):
    out = four / "out"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    for more in ([], ["--resume"]):
        result = invoke(*arguments(four, *more))
        assert result.exit_code == 1
        assert "not empty" in result.stderr
        assert list(seen_files(out)) == ["mine.txt"]
        assert not list(out.glob(".*"))
    (out / "mine.txt").unlink()
    assert invoke(*arguments(four, "--resume")).exit_code == 0
    result = invoke(*arguments(four))
    assert result.exit_code == 1
    assert "--resume to continue" in result.stderr
    assert invoke(*arguments(four, "--resume", "--overwrite")).exit_code == 2


def begin(folder, *more):
    return subprocess.Popen(
        [COMMAND, *arguments(folder, *more)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        # tests that a shell runs in the background ignore interrupts, and would bequeath that
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def seen(folder):
    """Names in a folder of outputs, however it changes meanwhile."""
    with contextlib.suppress(FileNotFoundError):
        return [name for name in os.listdir(folder) if not name.startswith(".")]
    return []


def stop_after(process, folder, count, kind, truth):
    """Send a signal when so many photos are there; whatever can be seen is whole all the time."""
    while process.poll() is None and len(seen(folder / "images")) < count:
        for name in seen(folder / "images")[:3]:
            assert (folder / "images" / name).read_bytes() == truth[f"images/{name}"]
        time.sleep(0.005)
    process.send_signal(kind)
    out, err = process.communicate(timeout=60)
    for name, content in seen_files(folder).items() if folder.is_dir() else ():
        assert content == truth[name], name
    return out, err


@pytest.fixture
def many(tmp_path):
    """Forty photos and what comes of them."""
    names = [f"{k:03}.{'png' if k % 3 else 'jpg'}" for k in range(40)]
    save_textures(tmp_path / "in", names)
    save_solution(tmp_path / "s.json", names)
    rectify_folder(tmp_path / "in", tmp_path / "s.json", tmp_path / "whole")
    return tmp_path, seen_files(tmp_path / "whole")


def check_killed(many, moments):
    folder, truth = many
    for moment in moments:
        shutil.rmtree(folder / "out", ignore_errors=True)
        stop_after(begin(folder), folder / "out", moment, signal.SIGKILL, truth)
        (folder / "out" / "images").mkdir(parents=True, exist_ok=True)
        (folder / "out" / "images" / ".0123456789abcdef.partial").write_bytes(b"half")
        # killed before it made its folder there is nothing to go on with
        how = {"resume": True} if (folder / "out" / Journal.NAME).exists() else {"overwrite": True}
        rectify_folder(folder / "in", folder / "s.json", folder / "out", **how)
        assert seen_files(folder / "out") == truth
        assert not list((folder / "out").rglob("*.partial"))


def test_killed_once(many):
    check_killed(many, [7])


@pytest.mark.slow
def test_killed_at_twenty_random_moments(many, rng):
    check_killed(many, rng.integers(0, 40, 20).tolist())


@pytest.mark.slow  # test_faults_of_the_machine ends a batch by another signal
def test_an_interrupt_leaves_whole_files_and_says_how_to_go_on(many):
    folder, truth = many
    _, err = stop_after(process := begin(folder, "--jobs", "1"), folder / "out", 5, signal.SIGINT, truth)
    assert process.returncode == 130
    assert err.startswith("stopped; ")
    assert "--resume continues" in err
    assert len(err.splitlines()) == 1
    assert not list((folder / "out").rglob("*.partial"))
    result = invoke(*arguments(folder, "--resume"))
    assert result.exit_code == 0
    assert seen_files(folder / "out") == truth


# ---------------------------------------------------------------- one bad photo


def test_a_photo_that_vanishes_midway(four):
    def vanish(stage, done, total):
        if (stage, done) == ("rectifying", 1):
            (four / "in" / "d.jpg").unlink(missing_ok=True)

    with pytest.warns(SkippedPhotoWarning, match=r"d\.jpg cannot be read: No such file"):
        _, left_out = rectify_folder(four / "in", four / "s.json", four / "out", jobs=1, progress=vanish)
    assert list(left_out) == ["d.jpg"]


def test_photos_that_the_solution_does_not_name_are_reported(four):
    save_png(four / "in" / "stray.png", texture(320, 240))
    result = invoke(*arguments(four))
    assert result.exit_code == 3
    assert result.stdout.splitlines()[-1].startswith("  stray.png: it has no motion")
    assert "4 photos rectified" in result.stdout


def test_photos_that_could_not_be_registered_are_no_failure(four):
    solution = read_solution(four / "s.json")
    lost = replace(solution.images[0], motion=None, reason="shares too little")
    write_solution(four / "s.json", replace(solution, images=(lost, *solution.images[1:])))
    result = invoke(*arguments(four))
    assert result.exit_code == 0
    assert "warning: skipped: a.png" in result.stderr
    assert "3 photos rectified with the rotation model, 1 left out" in result.stdout


def test_a_photo_that_does_not_fit_the_memory_is_left_out(four, monkeypatch):
    from rsundistort.batch import one_photo as photo

    def scarce(pixels, *args, **kwargs):
        if pixels.shape == (240, 320, 3) and pixels[0, 0, 0] == scarce.mark:
            raise MemoryError
        return rectify(pixels, *args, **kwargs)

    rectify = photo.rectify
    scarce.mark = read_photo(four / "in" / "b.png").pixels[0, 0, 0]
    monkeypatch.setattr(photo, "rectify", scarce)
    with pytest.warns(SkippedPhotoWarning, match="does not fit into the memory"):
        _, left_out = rectify_folder(four / "in", four / "s.json", four / "out")
    assert "b.png" in left_out


@pytest.fixture
def travelling(four):
    """Of the four photos a solution whose camera travelled, and depth maps of them, one of which is no picture."""
    solution = read_solution(four / "s.json")
    motion = RowMotion([0.02, -0.01, 0.0], [0.05, 0.0, 0.0])
    images = [replace(i, motion=motion, R_cw=np.eye(3), center_w=np.ones(3)) for i in solution.images]
    write_solution(four / "s.json", replace(solution, shutter_model="constant-motion", images=tuple(images)))
    (four / "depth").mkdir()
    for name in FOUR:
        np.save(four / "depth" / f"{Path(name).stem}.npy", np.full((240, 320), 3.0, np.float32))
    return four


def test_a_bad_depth_map_does_not_stop_the_others(travelling):
    (travelling / "depth" / "b.npy").write_bytes(b"none")
    with pytest.warns(SkippedPhotoWarning, match=r"b\.png: .*b\.npy"):
        solution, left_out = rectify_folder(
            travelling / "in", travelling / "s.json", travelling / "out", depth=travelling / "depth"
        )
    assert list(left_out) == ["b.png"]
    assert [image.depth for image in solution.images] == ["map", None, "map", "map"]


def test_depths_are_known_of_photos_that_are_passed_over(travelling):
    """A changed map makes its photo stale, the others are left as they are."""
    work = (travelling / "in", travelling / "s.json", travelling / "out")
    first, _ = rectify_folder(*work, depth=travelling / "depth")
    before = made(travelling / "out")
    np.save(travelling / "depth" / "b.npy", np.full((240, 320), 2.5, np.float32))
    second, _ = rectify_folder(*work, depth=travelling / "depth", resume=True)
    assert {name for name, file in made(travelling / "out").items() if file != before[name]} == {"b.png"}
    for a, b in zip(first.images, second.images, strict=True):
        assert a.depth == b.depth == "map"
        assert (a.translation_shift_px == b.translation_shift_px) == (a.name != "b.png")


def test_images_that_go_along_are_not_replaced_by_themselves(four):
    (four / "out" / "also").mkdir(parents=True)
    shutil.copytree(four / "in", four / "out" / "also" / "labels")
    before = seen_files(four)
    with pytest.raises(FileError, match="would be replaced by the outputs"):
        rectify_folder(
            four / "in", four / "s.json", four / "out", overwrite=True, also=((four / "out/also/labels", "nearest"),)
        )
    assert seen_files(four) == before


# ---------------------------------------------------------------- the last stage of a run


@pytest.fixture(scope="module")
def courtyard(tmp_path_factory):
    folder = tmp_path_factory.mktemp("courtyard")
    half_courtyard(folder)
    options = RunOptions(max_features=700, solve=SolveOptions(shutter_model="rotation"))
    run(folder / "photos", folder / "out", options)
    return folder, options


class Stop:
    """A progress callback that does something at the n-th rectified photo."""

    def __init__(self, count, act):
        self.count, self.act = count, act

    def __call__(self, stage, done, total):
        if stage == "rectifying" and done == self.count:
            self.act()


def test_a_run_that_was_interrupted_is_gone_on_with(courtyard, tmp_path):
    folder, options = courtyard

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"of 6 photos are done, whole; the same command with --resume"):
        run(folder / "photos", tmp_path / "out", options, Stop(2, interrupt))
    before = made(tmp_path / "out")
    whole = seen_files(folder / "out")
    without_report = {name.split("/")[0] for name in whole} - {"report.html"}
    assert without_report == {p.split("/")[0] for p in seen_files(tmp_path / "out")} - {Kept.NAME}
    for name, content in seen_files(tmp_path / "out").items():
        if name.startswith(("images", "masks", "transforms")):
            assert content == whole[name]
    shutil.copytree(tmp_path / "out", tmp_path / "copy")
    rectify_folder(folder / "photos", tmp_path / "copy" / "solution.json", tmp_path / "copy", resume=True)
    run(folder / "photos", tmp_path / "out", options, resume=True)
    for out in (tmp_path / "copy", tmp_path / "out"):
        after = {name: content for name, content in seen_files(out).items() if Kept.NAME not in name}
        assert {n: c for n, c in after.items() if "/0" in n} == {n: c for n, c in whole.items() if "/0" in n}
    assert not (tmp_path / "out" / Kept.NAME).exists()
    kept = {n: i for n, i in before.items() if n in COURTYARD_NAMES[:2]}
    assert made(tmp_path / "out").items() >= kept.items()
    times = ("solution.json", "report.html", "report.npz")  # the last, where the photos are from there
    assert {n: c for n, c in after.items() if n not in times} == {n: c for n, c in whole.items() if n not in times}


def test_a_photo_that_vanishes_from_a_run_is_in_no_model(courtyard, tmp_path):
    folder, _ = courtyard
    shutil.copytree(folder / "photos", tmp_path / "photos")
    gone = COURTYARD_NAMES[-1]
    act = Stop(1, lambda: (tmp_path / "photos" / gone).unlink(missing_ok=True))
    options = RunOptions(
        camera=str(folder / "camera.json"), max_features=700, solve=SolveOptions(shutter_model="rotation")
    )
    with pytest.warns(SkippedPhotoWarning, match=f"{gone} cannot be read"):
        solution = run(tmp_path / "photos", tmp_path / "out", options, act)
    assert solution.image(gone).registered
    assert "cannot be read" in solution.image(gone).reason
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    names = {f"images/{name}" for name in COURTYARD_NAMES[:-1]}
    assert {frame["file_path"] for frame in frames} == names
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse")
    assert {f"images/{image.name}" for image in model.images.values()} == names


def test_a_run_says_3_when_its_last_stage_lost_photos(monkeypatch, tmp_path):
    camera = Camera(64, 48, np.diag([60.0, 60, 1]))
    image = SolvedImage("a.png", "1", motion=RowMotion(), reason="a.png cannot be read", rms_px=0.1, rs_shift_px=0.0)
    solution = Solution("global", {"1": camera}, {"1": camera}, (image,))
    # the package, which the function of its name hides
    monkeypatch.setattr(sys.modules["rsundistort.solve"], "run", lambda *_, **__: solution)
    result = invoke("run", tmp_path, "-o", tmp_path / "out", "--quiet")
    assert result.exit_code == 3
    assert result.stdout == ""
    assert result.stderr.split() == ["failed:", "a.png:", "a.png", "cannot", "be", "read"]


# ---------------------------------------------------------------- progress


def test_progress_as_json(four):
    (four / "in" / "b.png").write_bytes(b"cut")
    result = invoke(*arguments(four, "--progress", "json"))
    assert result.exit_code == 3
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert all(list(line) == ["stage", "done", "total", "rate", "eta_s"] for line in lines)
    assert lines[0] == {"stage": "rectifying", "done": 0, "total": 4, "rate": None, "eta_s": None}
    assert (lines[-1]["done"], lines[-1]["eta_s"]) == (4, 0.0)
    assert lines[-1]["rate"] > 0
    assert "failed:\n  b.png: " in result.stderr


def test_what_was_done_before_is_not_in_the_rate(capsys, monkeypatch):
    from rsundistort_cli import terminal

    clock = iter([0.0, 2.0])
    monkeypatch.setattr(terminal.time, "perf_counter", lambda: next(clock))
    with terminal.progress_bars(terminal.Talk(progress="json")) as progress:
        progress("rectifying", 80, 100)
        progress("rectifying", 90, 100)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines[1] == {"stage": "rectifying", "done": 90, "total": 100, "rate": 5.0, "eta_s": 2.0}


# ---------------------------------------------------------------- workers


def test_only_a_few_items_are_drawn_ahead():
    drawn, most = 0, 0

    def items():
        nonlocal drawn
        for k in range(200):
            drawn += 1
            yield k

    for done, result in enumerate(Workers(3).map(lambda k: k * k, items(), lambda k, why: -1)):
        assert result == done * done
        most = max(most, drawn - done)
    assert most <= 6


def test_opencv_has_one_thread_in_the_pool_and_its_own_again_afterwards():
    import cv2

    before = cv2.getNumThreads()
    assert set(Workers(2).map(lambda _: cv2.getNumThreads(), range(4), lambda k, why: 0)) == {1}
    assert cv2.getNumThreads() == before


def test_a_scheduler_that_is_not_there_is_refused_in_one_line(four, monkeypatch):
    pytest.importorskip("distributed")
    from rsundistort.batch import workers

    monkeypatch.setattr(workers, "_TIMEOUT_S", 0.2)
    result = invoke(*arguments(four, "--scheduler", "tcp://127.0.0.1:9"))
    assert result.exit_code == 1
    assert "error: no Dask scheduler answers at tcp://127.0.0.1:9" in result.stderr
    assert not (four / "out").exists()


@pytest.mark.slow
def test_a_cluster_that_loses_a_worker_does_the_same_work(many, cluster):
    """Warnings come back from the workers; those of a lost one are made by the other."""
    folder, truth = many
    address, workers = cluster
    (folder / "in" / "000.jpg").write_bytes((folder / "in" / "001.png").read_bytes())
    process = begin(folder, "--scheduler", address)
    while len(seen(folder / "out" / "images")) < 8:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    workers[0].kill()
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "40 photos rectified" in out
    assert "warning: 000.jpg is PNG by its content" in err
    done = seen_files(folder / "out")
    assert done.keys() == truth.keys()
    assert {name for name in truth if done[name] != truth[name]} == {"images/000.jpg"}


@pytest.mark.slow
def test_features_on_a_cluster_are_those_of_threads(courtyard, cluster, tmp_path):
    folder, options = courtyard
    address, _ = cluster
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Dask's own
        solution = run(folder / "photos", tmp_path / "out", options, scheduler=address)
    truth = read_solution(folder / "out" / "solution.json")
    assert solution.quality["num_observations"] == truth.quality["num_observations"]
    for image in solution.registered:
        np.testing.assert_array_equal(image.motion.phi, truth.image(image.name).motion.phi)
    name = f"images/{COURTYARD_NAMES[2]}"
    assert seen_files(tmp_path / "out")[name] == seen_files(folder / "out")[name]
