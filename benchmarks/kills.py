"""Kills `run`, `rectify` and `run` of a video at random moments and goes on with them: prints one JSON object a line.

    python benchmarks/kills.py [--kills 100] [--seed 0] [--only run|rectify|video]

Each run into an empty folder is killed, gone on with (`--resume`), killed again and so on, until it comes to its end;
then every file is compared with that of an undisturbed run, byte for byte but for the times that a solution and its
report tell. Every other kill comes at any time, the ones between in the stage that was hit least so far. Half of the
signals are SIGKILL, the others SIGTERM and SIGINT, which have to end it in one line and with their exit codes. A
watcher looks at the outputs all the time: what is visible must be whole. The scene is five photos of `courtyard` at
half size; the video, a second of `walk` at half size, of which every frame is written. Exits 1 if anything differs, is
cut short, or cannot be gone on with.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Iterable
from pathlib import Path

import av
import cv2

SCENE = Path(__file__).parent.parent / "sample_scenes" / "courtyard"
WALK = SCENE.parent / "walk"
COMMAND = [sys.executable, "-m", "rsundistort_cli"]
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def make_scene(folder: Path) -> None:
    """Five photos at half size, and their camera."""
    (folder / "photos").mkdir(parents=True)
    for path in sorted((SCENE / "photos").iterdir())[:5]:
        photo = cv2.imread(str(path))
        cv2.imwrite(str(folder / "photos" / path.name), cv2.resize(photo, None, fx=0.5, fy=0.5))
    camera = json.loads((SCENE / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(halved(camera)))


def make_clip(folder: Path, num_frames: int = 30) -> None:
    """The first frames of a video at half size, and their camera."""
    camera = halved(json.loads((WALK / "camera.json").read_text()))
    (folder / "clip.json").write_text(json.dumps(camera))
    with av.open(str(WALK / "clip.mp4")) as source, av.open(str(folder / "clip.mp4"), "w") as target:
        stream = target.add_stream("libx264", rate=30, options={"crf": "14"})
        stream.width, stream.height, stream.pix_fmt = camera["width"], camera["height"], "yuv420p"
        for _, frame in zip(range(num_frames), source.decode(video=0), strict=False):
            small = frame.reformat(camera["width"], camera["height"], "yuv420p")
            target.mux(stream.encode(av.VideoFrame.from_ndarray(small.to_ndarray(), format="yuv420p")))
        target.mux(stream.encode())


def halved(camera: dict) -> dict:
    """A camera file for photos at half size; pixel centres are whole numbers."""
    half = dict(camera)
    half["width"], half["height"] = camera["width"] // 2, camera["height"] // 2
    half["K"] = [
        [(each + 0.5 * (j == 2)) / 2 - 0.5 * (j == 2) for j, each in enumerate(row)] for row in camera["K"][:2]
    ]
    half["K"].append([0, 0, 1])
    return half


def visible(out: Path) -> dict[str, Path]:
    """Files that a user sees."""
    found = {}
    for folder, within, files in os.walk(out):  # what goes meanwhile is passed over
        within[:] = [each for each in within if not each.startswith(".")]
        paths = (Path(folder, each) for each in files if not each.startswith("."))
        found |= {path.relative_to(out).as_posix(): path for path in paths}
    return found


def comparable(path: Path) -> bytes:
    """The content without the times in it."""
    data = path.read_bytes()
    if path.name == "solution.json":
        value = json.loads(data)
        for stage in value.get("stages", []):
            stage.pop("seconds")
        return json.dumps(value, sort_keys=True).encode()
    if path.name == "report.html":
        return re.sub(rb"(\d+(\.\d+)? (s|min|h)\b *)+", b"", data)
    return data


class Watcher:
    """Looks at the outputs again and again, and notes what is cut short."""

    def __init__(self, out: Path, images: dict[str, bytes]) -> None:
        self.out, self.images = out, images
        self.cut: set[str] = set()
        self.looks = 0
        self._seen: dict[str, tuple[int, int, int]] = {}
        self._ended = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        while not self._ended.wait(0.005):
            self.look()

    def look(self) -> None:
        """Once."""
        self.looks += 1
        for name, path in visible(self.out).items():
            try:
                facts = path.stat()
                stamp = facts.st_ino, facts.st_size, facts.st_mtime_ns
                if self._seen.get(name) != stamp and not self._is_whole(name, path):
                    self.cut.add(name)
                self._seen[name] = stamp
            except FileNotFoundError:
                continue

    def _is_whole(self, name: str, path: Path) -> bool:
        data = path.read_bytes()
        if name.startswith(("images/", "masks/")) or name.endswith(".mp4"):
            return data == self.images[name]
        if name.endswith(".json"):
            try:
                return bool(json.loads(data))
            except ValueError:
                return False
        if name.endswith(".npz"):
            return zipfile.is_zipfile(path)
        return bool(data) and (not name.endswith(".html") or data.rstrip().endswith(b"</html>"))

    def end(self) -> None:
        """Look no more."""
        self._ended.set()


class Stages:
    """The stages that a command with `--progress json` has come to: "" at first, then as it names them."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.began: dict[str, float] = {"": time.perf_counter()}
        self.last = ""
        self._news = threading.Condition()
        self._ended = False
        threading.Thread(target=self._read, args=(process.stdout,), daemon=True).start()

    def _read(self, stdout: Iterable[str]) -> None:
        for line in stdout:
            # "choice: rotation" is a step of the stage "choice"
            with self._news:
                self.last = json.loads(line)["stage"].partition(":")[0]
                self.began.setdefault(self.last, time.perf_counter())
                self._news.notify_all()
        with self._news:
            self._ended = True
            self._news.notify_all()

    def wait_for(self, stage: str) -> None:
        """Until it begins, or all has ended."""
        with self._news:
            self._news.wait_for(lambda: stage in self.began or self._ended)


def killed(command: list[str], stage: str, after_s: float | None, number: signal.Signals) -> tuple[int, str, str]:
    """Exit code, stderr and last stage of a command that gets a signal so long after a stage began, if it still is.

    None lets it come to its end.
    """
    with tempfile.TemporaryFile("w+") as stderr:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True)
        stages = Stages(process)
        stages.wait_for(stage)
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            process.send_signal(number)
        last = stages.last
        code = process.wait(300)
        stderr.seek(0)
        return code, stderr.read(), last


def undisturbed(command: list[str]) -> dict[str, float]:
    """How long each stage takes."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    stages = Stages(process)
    if process.wait(600):
        raise SystemExit(f"{command} fails undisturbed")
    ends = [*list(stages.began.values())[1:], time.perf_counter()]
    return {name: end - began for (name, began), end in zip(stages.began.items(), ends, strict=True)}


def problem_of(code: int, said: str) -> str:
    """What is wrong with how it ended; empty if nothing is."""
    errors = [line for line in said.splitlines() if line.strip() and not line.startswith("warning: ")]
    if code in (0, -signal.SIGKILL):
        return " | ".join(errors)
    printed = len(errors) == 1 and errors[0].startswith("stopped; ")
    # a signal may come before the command hears any; and one that comes in an `exec`, as imports have them, makes
    # Python end by SIGINT itself, which shells call 130, too
    if (code == -signal.SIGTERM and not errors) or (code == -signal.SIGINT and (printed or not errors)):
        return ""
    if code in (128 + signal.SIGTERM, 128 + signal.SIGINT) and printed:
        return ""
    return f"exit code {code}: {' | '.join(errors)[-300:]}"


def tried(name: str, command: list[str], folder: Path, kills: int, rng: random.Random) -> dict:
    """What came of so many kills."""
    whole = folder / name / "undisturbed" / "out"
    seconds = undisturbed([*command, "-o", str(whole)])
    stages, lasts_s, hits = list(seconds), sum(seconds.values()), dict.fromkeys(seconds, 0)
    expected = {each: comparable(path) for each, path in visible(whole).items()}
    images = {each: path.read_bytes() for each, path in visible(whole).items()}
    done = ends = looks = 0
    codes: dict[str, int] = {}
    problems: list[str] = []
    while done < kills:
        out = folder / name / "killed" / "out"
        shutil.rmtree(out.parent, ignore_errors=True)
        watcher, code, resume, last = Watcher(out, images), -1, [], ""
        while code != 0:
            number = rng.choice(SIGNALS)
            stage, within_s = "", lasts_s
            if rng.random() < 0.5:  # what is behind it does not come again
                stage = min(stages[stages.index(last) :], key=lambda each: (hits[each], rng.random()))
                within_s = seconds[stage]
            code, said, reached = killed([*command, "-o", str(out), *resume], stage, rng.uniform(0.0, within_s), number)
            codes[str(code)] = codes.get(str(code), 0) + 1
            if code != 0:
                done, last = done + 1, max(last, reached, key=stages.index)
                hits[reached] += 1
            if problem := problem_of(code, said):
                problems.append(problem)
                break
            resume = ["--resume"]
        else:
            ends += 1
            found = {each: comparable(path) for each, path in visible(out).items()}
            names = sorted({*found, *expected})
            problems += [f"differs: {each}" for each in names if found.get(each) != expected.get(each)]
        watcher.look()
        watcher.end()
        looks += watcher.looks
        print(f"{name}: {done} kills, {ends} ends, {len(problems)} problems", file=sys.stderr, flush=True)
        problems += [f"cut short: {each}" for each in sorted(watcher.cut)]
    return {
        "command": name, "kills": done, "came_to_the_end": ends, "undisturbed_s": round(lasts_s, 1),
        "killed_in": {stage or "start": count for stage, count in hits.items()}, "exit_codes": codes,
        "looks": looks, "problems": problems,
    }  # fmt: skip


def main() -> int:
    """Kill, go on, compare."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=("run", "rectify", "video"))
    options = parser.parse_args()
    # where it was started in the background it is ignored, by what is started here, too
    signal.signal(signal.SIGINT, signal.default_int_handler)
    failed = False
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        make_scene(folder)
        photos, solution = str(folder / "photos"), str(folder / "run" / "undisturbed" / "out" / "solution.json")
        run = [*COMMAND, "run", photos, "--camera", str(folder / "camera.json"), "--max-features", "500"]
        commands = {"run": run, "rectify": [*COMMAND, "rectify", photos, "--solution", solution]}
        make_clip(folder)
        commands["video"] = [
            *COMMAND, "run", str(folder / "clip.mp4"), "--camera", str(folder / "clip.json"), "--frames", "all",
            "--max-features", "800",
        ]  # fmt: skip
        commands = {name: [*command, "--progress", "json"] for name, command in commands.items()}
        for name, command in commands.items():
            kills = options.kills if options.only in (None, name) else 0
            found = tried(name, command, folder, kills, random.Random(options.seed))
            print(json.dumps(found), flush=True)
            failed |= bool(found["problems"])
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
