"""What the system does to a command: locks, kills, signals, full devices, links that are laid meanwhile."""

from __future__ import annotations

import errno
import multiprocessing
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from commands import solution_of

from rsundistort import Camera, RowMotion, Solution
from rsundistort.batch import rectify_folder
from rsundistort.batch.progress import StageLog
from rsundistort.errors import FileError, InputError, MissingOutputWarning
from rsundistort.input.load import load_photos
from rsundistort.io import write_image
from rsundistort.io.kept import Kept
from rsundistort.io.lock import LOCK_NAME, check_still_there, locked
from rsundistort.io.outputs import held_inside, only_writer, output_folder, work_folder
from rsundistort.io.record import Record
from rsundistort.rectify import ViewOptions
from rsundistort.solve.going_on import run_folder

NAMES = ["a.png", "b.png", "c.png", "d.png"]
COMMAND = [sys.executable, "-m", "rsundistort_cli"]
POSIX = pytest.mark.skipif(os.name != "posix", reason="signals and links are POSIX's")


@pytest.fixture
def batch(tmp_path, rng):
    """Photos and a solution of them, as arguments of `rectify`."""
    (tmp_path / "photos").mkdir()
    for name in NAMES:
        write_image(tmp_path / "photos" / name, rng.integers(0, 256, (240, 320, 3), np.uint8))
    return tmp_path / "photos", solution_of(tmp_path / "solution.json", NAMES), tmp_path / "out"


def hold(folder, ready):
    with locked(Path(folder)):
        ready.set()
        time.sleep(60)


def test_a_second_writer_is_refused_and_a_killed_one_holds_nothing(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready = context.Event()
    other = context.Process(target=hold, args=(str(tmp_path), ready))
    other.start()
    try:
        assert ready.wait(60)
        with pytest.raises(FileError, match=rf"is being written by process {other.pid} of .*; wait for it"):
            output_folder(tmp_path).__enter__()
    finally:
        other.kill()
        other.join()
    with output_folder(tmp_path) as scratch:
        (scratch / "a.txt").write_text("a")
    assert sorted(path.name for path in tmp_path.iterdir()) == [Record.NAME, "a.txt"]


def test_threads_of_one_process_are_two_writers(tmp_path):
    said = []

    def enter():
        with pytest.raises(FileError, match="by this process") as error:
            locked(tmp_path).__enter__()
        said.append(error)

    with locked(tmp_path) as first, locked(tmp_path) as again:
        assert (first, again) == (True, False)
        thread = threading.Thread(target=enter)
        thread.start()
        thread.join()
    assert len(said) == 1
    assert not (tmp_path / LOCK_NAME).exists()


@POSIX
def test_a_lock_that_is_a_link_is_not_followed(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / LOCK_NAME).symlink_to(tmp_path / "mine")
    with pytest.raises(FileError, match="cannot be written"), only_writer(tmp_path / "out"):
        pass
    assert (tmp_path / "mine").read_text() == "mine"


@POSIX
def test_a_folder_that_was_moved_is_noticed(tmp_path):
    out = tmp_path / "out"
    with only_writer(out):
        check_still_there(out)
        out.rename(tmp_path / "moved")
        out.mkdir()
        with pytest.raises(FileError, match="was moved"):
            check_still_there(out)


def test_folders_that_were_made_for_nothing_go(tmp_path):
    with only_writer(tmp_path / "a" / "b"):
        pass
    assert not list(tmp_path.iterdir())


def test_a_value_that_is_kept_comes_back_bit_by_bit(tmp_path, rng):
    camera = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
    still = rng.normal(size=(3, 2)).T
    still.flags.writeable = False
    value = Solution("rotation", {"1": camera}, {"1": camera}, ()), RowMotion([0.1, 0.2, 0.3])
    odd = {"nan": float("nan"), 3: range(2, 9, 3), "path": Path("a/b"), "set": {2, 1}, "one": np.float32(1) / 3}
    kept = Kept(tmp_path, "key")
    kept.begin()
    kept.put("value", [value, odd, still, still])
    (solution, motion), again, first, second = Kept(tmp_path, "key").get("value")
    np.testing.assert_array_equal(solution.cameras["1"].K, camera.K)
    np.testing.assert_array_equal(motion.phi, value[1].phi)
    assert str(again) == str(odd)
    for each in (first, second):
        assert each.tobytes() == still.tobytes()
        assert (each.flags.f_contiguous, each.flags.writeable) == (still.flags.f_contiguous, False)


def test_what_is_kept_of_something_else_or_damaged_is_missing(tmp_path):
    kept = Kept(tmp_path, "key")
    kept.begin()
    kept.put("value", [1, 2, 3])
    path = kept.path("value")
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        assert kept.get("value") is None
    path.write_bytes(whole)
    assert Kept(tmp_path, "another").holds() is False
    Kept(tmp_path, "another").begin()
    assert Kept(tmp_path, "another").get("value") is None
    with pytest.raises(InputError, match="cannot be kept"):
        kept.put("value", threading)


def test_only_classes_of_ours_are_made_of_a_file(tmp_path):
    kept = Kept(tmp_path, "key")
    kept.begin()
    for module, name in (("os", "system"), ("subprocess", "Popen"), ("rsundistort.io.kept", "Kept")):
        tree = f'["object", "{module}", "{name}", {{}}]'.encode()
        with kept.path("value").open("wb") as file:
            np.savez(file, tree=np.frombuffer(tree, np.uint8))
        assert kept.get("value") is None


@POSIX
def test_links_laid_meanwhile_are_not_written_through(batch, tmp_path):
    photos, solution, out = batch
    (tmp_path / "elsewhere").mkdir()

    def swap(stage, done, _total):
        if (stage, done) == ("rectifying", 1) and not (out / "images").is_symlink():
            (out / "images").rename(out / "before")
            (out / "images").symlink_to(tmp_path / "elsewhere")

    with pytest.raises(FileError, match=r"images leads out of .*; remove that link; [1-3] of 4 photos are done"):
        rectify_folder(photos, solution, out, jobs=1, progress=swap)
    assert not list((tmp_path / "elsewhere").iterdir())


@POSIX
@pytest.mark.parametrize("moment", ["before", "while it is open"])
def test_no_moment_is_left_for_a_link(tmp_path, moment):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    (out / "images").mkdir(parents=True)
    elsewhere.mkdir()

    def swap(now):
        if now == moment:
            (out / "images").rename(out / "before")
            (out / "images").symlink_to(elsewhere)

    swap("before")

    def write():
        with held_inside(out, "images/a.png") as path:
            if not path.is_relative_to("/proc"):
                pytest.skip("open folders have no names here")
            swap("while it is open")
            write_image(path, np.zeros((20, 20, 3), np.uint8))

    with pytest.raises(FileError, match=r"out/images leads out of .*out; remove that link$") as caught:
        write()
    assert caught.value.__cause__.errno == errno.ELOOP
    assert not list(elsewhere.iterdir())


def test_a_folder_that_vanishes_ends_in_one_line(batch):
    photos, solution, out = batch

    def move(stage, done, _total):
        if (stage, done) == ("rectifying", 1) and out.is_dir():
            out.rename(out.with_name("moved"))

    with pytest.raises(FileError, match=r"of 4 photos are done, whole"):
        rectify_folder(photos, solution, out, jobs=1, progress=move)


def test_names_that_are_no_text_are_refused_before_the_work(tmp_path):
    name = os.fsdecode(b"caf\xe9.png")
    for each in (*NAMES, name):
        try:
            write_image(tmp_path / "a.png", np.zeros((20, 20, 3), np.uint8))
            (tmp_path / each).write_bytes((tmp_path / "a.png").read_bytes())
        except OSError:
            pytest.skip("this file system takes UTF-8 only")
    with pytest.raises(InputError, match=r"no name in UTF-8.*rename it"):
        load_photos(tmp_path, "300,300,9,9", None, 500, None, None)


@pytest.mark.parametrize("scale", [1e300, np.inf, np.nan])
def test_scales_beyond_all_files_are_refused(scale):
    with pytest.raises(InputError, match="scale"):
        ViewOptions(scale=scale)


def test_temporary_folders_of_killed_processes_go(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    with work_folder() as work:
        stale = work.with_name(work.name.replace(f"-{os.getpid()}-", f"-{gone.pid}-"))
        stale.mkdir()
        with work_folder() as other:
            assert work.is_dir()
            assert other.is_dir()
            assert not stale.exists()
    assert not list(tmp_path.iterdir())


def test_a_full_folder_of_temporary_files_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(FileError, match="database or disk is full; set TMPDIR"), work_folder():
        raise RuntimeError("[database_sqlite.cc:1201] SQLite error: database or disk is full")
    with pytest.raises(RuntimeError, match="constraint failed"), work_folder():  # not the disk's fault, but ours
        raise RuntimeError("[database_sqlite.cc:1201] SQLite error: constraint failed")


@POSIX
def test_sigterm_ends_in_one_line_and_resume_goes_on(batch):
    photos, solution, out = batch
    command = [*COMMAND, "rectify", str(photos), "--solution", str(solution), "-o", str(out), "--jobs", "1"]
    program = (
        "import os, sys, rsundistort.batch.many_photos as m; real = m.rectify_photo\n"
        "import signal, time\n"
        "def act(job):\n    if job.name == 'c.png': os.kill(os.getpid(), signal.SIGTERM); time.sleep(0.2)\n"
        "    return real(job)\n"
        "m.rectify_photo = act; from rsundistort_cli.__main__ import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", program, *command[3:]], capture_output=True, text=True, timeout=120)
    assert done.returncode == 143, done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("stopped; ")
    assert "--resume continues" in done.stderr
    rectify_folder(photos, solution, out, resume=True)
    assert sorted(path.name for path in (out / "images").iterdir()) == NAMES


@POSIX
def test_what_an_interruption_left_half_made_says_nothing():
    program = (
        "import os, signal\n"
        "from rsundistort_cli.stopping import hears_signals\n"
        "class Half:\n    def __del__(self): raise AttributeError('half made')\n"
        "with hears_signals():\n    half = Half()\n    os.kill(os.getpid(), signal.SIGTERM)\n    half.wait()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (143, "stopped; nothing was written\n")


@pytest.mark.parametrize("is_solved", [True, False])
def test_a_full_disk_of_a_run_says_how_to_continue(tmp_path, is_solved):
    def fill_the_disk():
        with run_folder(tmp_path, "key", StageLog(None)) as run:
            run.kept.begin()
            if is_solved:
                run.solved([1.0], StageLog(None))
            raise FileError(f"{tmp_path} cannot be written") from OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(FileError) as raised:
        fill_the_disk()
    mend = "the same command with --resume continues" if is_solved else "correct that, or give another folder"
    assert str(raised.value) == f"{tmp_path} cannot be written; {mend}"
    with run_folder(tmp_path, "key", StageLog(None), resume=True) as run:
        assert run.outputs(StageLog(None)) == ([1.0] if is_solved else None)


@POSIX
@pytest.mark.parametrize(("command", "addresses", "needed"), [("run", 1_600_000, "2"), ("rectify", 600_000, "1.2")])
def test_native_code_is_not_loaded_where_it_would_crash(tmp_path, command, addresses, needed):
    options = {"run": "", "rectify": "--solution solution.json"}[command]
    line = f"ulimit -v {addresses}; exec {sys.executable} -m rsundistort_cli {command} {tmp_path} -o out {options}"
    done = subprocess.run(line, shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    (said,) = done.stderr.splitlines()
    assert said.startswith("error: addresses are limited to ")
    assert f", {needed} are needed" in said


@POSIX
@pytest.mark.parametrize(
    ("streams", "code", "said"),
    [
        ("> /dev/full", 3, "error: stdout cannot be written: No space left on device\n"),
        pytest.param(">&- 2>&- <&-", 0, "", marks=pytest.mark.slow),
        pytest.param("--progress json | head -n 0", 0, None, marks=pytest.mark.slow),
    ],
    ids=["full", "closed", "reader-gone"],
)
def test_streams_that_take_nothing_stop_no_batch(batch, streams, code, said):
    photos, solution, out = batch
    line = f"{' '.join(COMMAND)} rectify {photos} --solution {solution} -o {out} {streams}"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", line], capture_output=True, text=True, timeout=120)
    assert done.returncode == code, done.stderr
    assert said is None or done.stderr == said
    assert sorted(path.name for path in (out / "images").iterdir()) == NAMES


@POSIX
@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("--help > /dev/full", 3, "error: stdout cannot be written: No space left on device\n"),
        ("rectify --nothing 2> /dev/full", 2, ""),
    ],
)
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_help_and_refusals_that_nobody_gets_keep_their_exit_codes(line, code, said, unbuffered):
    line = f"PYTHONUNBUFFERED={unbuffered} {' '.join(COMMAND)} {line}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (code, said)


def test_a_report_that_is_missing_is_exit_code_3(monkeypatch, invoke):
    import warnings

    camera = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))

    def run(*_, **__):
        warnings.warn(MissingOutputWarning("no report was written: the disk is full", "report.html"), stacklevel=2)
        return Solution("global", {"1": camera}, {"1": camera}, ())

    monkeypatch.setattr(sys.modules["rsundistort.solve"], "run", run)
    result = invoke("run", ".", "-o", "out", "--quiet")
    assert result.exit_code == 3
    assert "report.html: no report was written" in result.stderr


def test_an_interruption_that_native_code_makes_another_error_of_is_one():
    script = """
import signal
from rsundistort_cli.stopping import hears_signals
with hears_signals():
    try:
        signal.raise_signal(signal.SIGTERM)
    except KeyboardInterrupt as stop:
        raise RuntimeError("cannot be imported") from stop
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "stopped; nothing was written\n")


def test_an_interruption_that_falls_into_a_callback_of_native_code_is_not_lost():
    script = """
import ctypes, signal, time
from rsundistort_cli.stopping import hears_signals
called = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGTERM))
with hears_signals():
    called()
    for _ in range(300):
        time.sleep(0.01)
    print("went on")
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (143, "", "stopped; nothing was written\n")
