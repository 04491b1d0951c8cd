"""What commands say of faults of the machine: prints the table of docs/hardening.md.

    python benchmarks/faults.py [--only WORD]

Each row is a command with something wrong about the machine: `rectify` on the sample scene `courtyard`, `run` on five
of its photos at half size. It prints the exit code, how long it took, and the last line on stderr. Disks that are full
or cannot be written are small ones of memory (tmpfs), which only root may mount; without it those rows are left out,
and said to be. Exits 1 if an exit code is another one than documented, or more than one line is an error, or anything
looks like a traceback or a native stack.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from kills import make_scene

SCENE = Path(__file__).parent.parent / "sample_scenes" / "courtyard"
PHOTOS, TRUTH = SCENE / "photos", SCENE / "ground_truth.json"
COMMAND = [sys.executable, "-m", "rsundistort_cli"]
RUN = [*COMMAND, "run", "--max-features", "500", "--quiet"]
RECTIFY = [*COMMAND, "rectify", str(PHOTOS), "--solution", str(TRUTH), "--jobs", "1", "-o"]


@dataclass
class Fault:
    """A command, what is done to it, and the exit codes that are right."""

    name: str
    command: str
    codes: tuple[int, ...]
    arguments: list[str]
    environment: dict[str, str] = field(default_factory=dict)
    limit: tuple[int, int] | None = None
    meanwhile: Callable[[subprocess.Popen], None] | None = None
    stdout: str | None = None
    closed: tuple[int, ...] = ()
    disk: tuple[Path, str] | None = None


@contextmanager
def small_disk(place: Path, options: str) -> Iterator[bool]:
    """A file system of memory at a place, if it may be mounted."""
    place.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)], capture_output=True)
    try:
        yield done.returncode == 0
    finally:
        if done.returncode == 0:
            subprocess.run(["umount", "-l", str(place)], check=True)


def until(is_there: Callable[[], bool], seconds: float = 60.0) -> None:
    """Wait for something."""
    end = time.monotonic() + seconds
    while not is_there() and time.monotonic() < end:
        time.sleep(0.005)


def tried(fault: Fault) -> tuple[int, str, float]:
    """Exit code, stderr and seconds."""

    def prepare() -> None:
        for number in (signal.SIGINT, signal.SIGHUP):  # which shells and nohup have ignored in the background
            signal.signal(number, signal.SIG_DFL)
        if fault.limit is not None:
            resource.setrlimit(fault.limit[0], (fault.limit[1], fault.limit[1]))
        for number in fault.closed:
            os.close(number)

    with tempfile.TemporaryFile() as said, open(fault.stdout or os.devnull, "w") as stdout:
        began = time.perf_counter()
        process = subprocess.Popen(
            fault.arguments, stdout=stdout, stderr=said, env=os.environ | fault.environment, preexec_fn=prepare
        )
        if fault.meanwhile is not None:
            threading.Thread(target=fault.meanwhile, args=(process,), daemon=True).start()
        code = process.wait(600)
        said.seek(0)
        return code, said.read().decode(errors="replace"), time.perf_counter() - began


def cpu_s(pid: int) -> float:
    """Seconds that a process has worked: others may have the processor meanwhile."""
    user, system = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def after_first(out: Path, act: Callable[[subprocess.Popen], None]) -> Callable[[subprocess.Popen], None]:
    """Do it when the first photo is there."""

    def meanwhile(process: subprocess.Popen) -> None:
        until(lambda: any((out / "images").glob("[!.]*")))
        act(process)

    return meanwhile


def swap_images(out: Path) -> None:
    """Lay a link in the place of `images`."""
    (out.parent / "elsewhere").mkdir()
    (out / "images").rename(out / "before")
    (out / "images").symlink_to(out.parent / "elsewhere")


def remove(out: Path) -> None:
    """Take OUT away."""
    shutil.rmtree(out, ignore_errors=True)


def move_away(out: Path) -> None:
    """Give OUT another name."""
    out.rename(out.with_name("moved-away"))


def move_and_replace(out: Path) -> None:
    """Another folder in the place of OUT."""
    out.rename(out.with_name(f"{out.name}-moved"))
    (out / "images").mkdir(parents=True)
    (out / "masks").mkdir()


def faults(work: Path) -> Iterator[Fault]:
    """All rows."""
    make_scene(work / "small")
    run = [*RUN, str(work / "small" / "photos"), "--camera", str(work / "small" / "camera.json"), "-o"]
    for name, command in (("run", run), ("rectify", RECTIFY)):
        out = work / name

        def on(
            row: str,
            codes: tuple[int, ...],
            *,
            to: Path,
            name: str = name,
            command: list[str] = command,
            **given: object,
        ) -> Fault:
            return Fault(row, name, codes, [*command, str(to)], **given)  # type: ignore[arg-type]

        yield on("disk of OUT full (1 MB)", (1,), to=out / "full", disk=(out / "full", "size=1m"))
        yield on("OUT read-only", (1,), to=out / "ro" / "out", disk=(out / "ro", "ro"))
        yield on("OUT is in a file", (1,), to=PHOTOS / "0000.jpg" / "out")
        yield on("OUT has 300 characters", (1,), to=out / ("x" * 300))
        yield on("files of 20 kB at most", (1,), to=out / "fsize", limit=(resource.RLIMIT_FSIZE, 20_000))
        yield on("no temporary folder", (0, 1), to=out / "notmp", environment={"TMPDIR": "/nowhere"})
        full = work / "tmp"
        yield on(
            "TMPDIR full (200 kB)", (0, 1), to=out / "tmp", environment={"TMPDIR": str(full)}, disk=(full, "size=200k")
        )
        cache = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
        if name == "rectify":
            ro = work / "cache"
            yield on(
                "kernel cache read-only", (0,), to=out / "cache", disk=(ro, "ro"),
                environment={"NUMBA_CACHE_DIR": str(ro / "x"), **cache},
            )  # fmt: skip
            yield on(
                "kernel cache full (50 kB)", (0,), to=out / "cache-full", disk=(work / "cache", "size=50k"),
                environment={"NUMBA_CACHE_DIR": str(work / "cache"), **cache},
            )  # fmt: skip
        yield on("stdout full", (0,) if name == "run" else (3,), to=out / "stdout", stdout="/dev/full")
        yield on("stdin, stdout and stderr closed", (0,), to=out / "closed", closed=(0, 1, 2))
        yield on("20 open files at most", (0, 1), to=out / "nofile", limit=(resource.RLIMIT_NOFILE, 20))
        yield on("8 open files at most", (1,), to=out / "nofile8", limit=(resource.RLIMIT_NOFILE, 8))
        yield on("1.2 GB of addresses at most", (0, 1, 3), to=out / "as", limit=(resource.RLIMIT_AS, 1_200_000_000))
        yield on("0.6 GB of addresses at most", (1,), to=out / "as2", limit=(resource.RLIMIT_AS, 600_000_000))
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            to = out / number.name

            def stop(process: subprocess.Popen, number: int = number) -> None:
                process.send_signal(number)

            def early(process: subprocess.Popen, number: int = number) -> None:
                until(lambda: process.poll() is not None or cpu_s(process.pid) > 0.3)
                process.send_signal(number)

            yield on(f"{number.name} after 0.3 s", (128 + number, -number), to=to / "early", meanwhile=early)
            yield on(
                f"{number.name} after the first photo", (128 + number,), to=to / "late",
                meanwhile=after_first(to / "late", stop),
            )  # fmt: skip
        for row, folder, act in (
            ("OUT removed after the first photo", out / "gone", remove),
            ("OUT moved after the first photo", out / "moved", move_away),
            ("OUT moved, another in its place", out / "other", move_and_replace),
            ("a link in the place of images/", out / "swap" / "out", swap_images),
        ):
            meanwhile = after_first(folder, lambda _, act=act, folder=folder: act(folder))
            # what comes when all photos are there is written nowhere through the link
            codes = (0, 1) if act is swap_images else (1,)
            yield on(row, codes, to=folder, meanwhile=meanwhile)
        yield on("a second writer (the second)", (1,), to=out / "two")


def in_use(fault: Fault) -> tuple[int, str, float]:
    """The second of two that write one folder."""
    out = Path(fault.arguments[-1])
    first = subprocess.Popen(fault.arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(lambda: (out / ".rsundistort-lock").exists())
        first.send_signal(signal.SIGSTOP)  # however long the second takes
        return tried(Fault(fault.name, fault.command, fault.codes, [*fault.arguments, "--overwrite"]))
    finally:
        first.send_signal(signal.SIGCONT)
        first.wait(600)


def main() -> int:
    """Try all, and print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", default="")
    wanted = parser.parse_args().only
    failed: list[str] = []
    print("| fault | command | exit code | seconds | last line on stderr |\n| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for fault in faults(work):
            if wanted not in f"{fault.command} {fault.name}":
                continue
            if "second writer" in fault.name:
                code, said, seconds = in_use(fault)
            elif fault.disk is None:
                code, said, seconds = tried(fault)
            else:
                with small_disk(*fault.disk) as mounted:
                    if not mounted:
                        print(f"| {fault.name} | {fault.command} | | | not tried: no disk may be mounted here |")
                        continue
                    code, said, seconds = tried(fault)
            lines = [line for line in said.splitlines() if line.strip()]
            errors = [line for line in lines if not line.startswith(("warning: ", "failed:", "  "))]
            if any(work.rglob("elsewhere/*")):
                failed.append(f"{fault.name}, {fault.command}: written through the link")
            if code not in fault.codes or len(errors) > 1 or "Traceback" in said or "    @ " in said:
                failed.append(json.dumps([fault.name, fault.command, code, said[-600:]]))
            last = lines[-1].replace(str(work), "...").replace(str(PHOTOS), "PHOTOS") if lines else ""
            if len(last) > 240:
                last = f"{last[:80]}[...]{last[-120:]}"
            print(
                f"| {fault.name} | `{fault.command}` | {code} | {seconds:.0f} | {last.replace('|', '/')} |", flush=True
            )
    for each in failed:
        print(each, file=sys.stderr)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
