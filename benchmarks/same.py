"""Compares the outputs of two states of this project, byte for byte: prints one JSON object a line.

    python benchmarks/same.py BEFORE [--after .] [--work DIR] [--jobs 1] [--only NAME]

BEFORE is a commit, or the folder of a checkout; the other state is the folder `--after`, this one by default. Both run
the same commands on the same inputs: `run` and `evaluate` on `sample_scenes/courtyard` (`make demo`), `simulate scene`
on its recipe with small photos, `simulate warp`, `rectify` with the true motions, `solve` on a model of the true points
with and without photos, `analyze`, and `run` on the clip of `sample_scenes/walk`. Times and versions are left out of
the comparison. A file that differs is named with its first line that does. Exits 1 if there is one, other than the
words of `report.html` and of what the commands print.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from kills import comparable, visible

ROOT = Path(__file__).resolve().parent.parent
SCENE = ROOT / "sample_scenes" / "courtyard"
#: Files and outputs whose words may differ.
OF_WORDS = ("report.html", "stdout")


def inputs(folder: Path) -> None:
    """What the commands read: a small recipe, a recipe of a clip, and a model of the true points."""
    recipe = json.loads((SCENE / "recipe.json").read_text())
    camera = recipe["camera"] | {"width": 240, "height": 160, "K": [[200, 0, 121.0], [0, 200, 78.0], [0, 0, 1]]}
    recipe |= {"camera": camera, "render": recipe["render"] | {"samples": 4}}
    (folder / "small.json").write_text(json.dumps(recipe))
    tracks, truth = np.load(SCENE / "tracks.npz"), json.loads((SCENE / "ground_truth.json").read_text())
    poses = {image["name"]: image for image in truth["images"]}
    names = tracks["image_names"].tolist()
    K = tracks["K"]
    lens = {"width": int(tracks["width"]), "height": int(tracks["height"]), "focal_length": float(K[0, 0])}
    noise = np.random.default_rng(0).normal(0.0, 0.3, tracks["xy_raw"].shape)

    def pointed(value: dict[str, Any]) -> dict[str, Any]:
        return {"ptr_wrapper": {"data": value}}

    seen: dict[int, list[dict[str, Any]]] = {}
    for k, (frame, point, xy) in enumerate(
        zip(tracks["frame_idx"].tolist(), tracks["point_idx"].tolist(), tracks["xy_raw"] + noise, strict=True)
    ):
        seen.setdefault(point, []).append({"key": frame, "value": {"id_feat": k, "x": xy.tolist()}})
    model = {
        "sfm_data_version": "0.3",
        "views": [
            {"value": pointed({"id_view": i, "id_pose": i, "id_intrinsic": 0, "local_path": "", "filename": name})}
            for i, name in enumerate(names)
        ],
        "intrinsics": [{"key": 0, "value": pointed(lens | {"principal_point": [K[0, 2], K[1, 2]]})}],
        "extrinsics": [
            {"key": i, "value": {"rotation": poses[name]["R_cw"], "center": poses[name]["center_w"]}}
            for i, name in enumerate(names)
        ],
        "structure": [
            {"key": point, "value": {"X": tracks["points_w"][point].tolist(), "observations": each}}
            for point, each in seen.items()
        ],
    }
    (folder / "model").mkdir()
    (folder / "model" / "sfm_data.json").write_text(json.dumps(model))


def commands(given: Path, out: Path, jobs: str) -> dict[str, list[str]]:
    """Arguments by name; each writes into a folder of its name, and those behind may read what it wrote."""
    demo, truth = str(out / "demo"), str(SCENE / "ground_truth.json")
    photos, model = str(SCENE / "photos"), str(given / "model" / "sfm_data.json")
    with_jobs = ["--jobs", jobs]
    return {
        "demo": ["run", photos, "-o", demo, "--maps", "npz", "--rs-poses", *with_jobs],
        "evaluate": ["evaluate", demo, "--truth", truth, "--json"],
        "analyze": ["analyze", demo],
        "scene": ["simulate", "scene", str(given / "small.json"), "-o", str(out / "scene"), *with_jobs],
        "warp": [
            "simulate", "warp", str(out / "scene" / "photos"), "-o", str(out / "warp"), "--vibration", "2", *with_jobs,
        ],
        "rectify": ["rectify", photos, "--solution", truth, "-o", str(out / "rectify"), *with_jobs],
        "solve": ["solve", model, "-o", str(out / "solve"), "--images", photos, *with_jobs],
        "tracks": ["solve", model, "-o", str(out / "tracks"), "--model", "rotation", "--sparse-format", "txt"],
        "clip": [
            "run", str(ROOT / "sample_scenes" / "walk" / "clip.mp4"), "-o", str(out / "clip"), "--seed", "1",
            *with_jobs,
        ],
    }  # fmt: skip


def run(tree: Path, arguments: list[str], stdout: Path) -> int:
    """One command of a checkout; its exit code."""
    with tempfile.TemporaryDirectory() as alias:
        (Path(alias) / "rsundistort_cli").symlink_to(tree / "cli")
        environment = os.environ | {"PYTHONPATH": f"{tree}{os.pathsep}{alias}"}
        # elsewhere: the folder that Python is started in would be searched first
        done = subprocess.run(
            [sys.executable, "-m", "rsundistort_cli", *arguments],
            cwd=alias, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
    if done.returncode not in (0, 3):
        print(json.dumps({"command": arguments, "exit": done.returncode, "stderr": done.stderr[-2000:]}), flush=True)
    stdout.write_text(done.stdout)
    return done.returncode


def plain(path: Path, out: Path) -> bytes:
    """What is compared of a file: without times, versions and the folder that it lies in."""
    data = comparable(path)
    if path.name in ("solution.json", "ground_truth.json"):
        value = json.loads(data) | {"generator": None}
        for stage in value.get("stages", []):
            stage.pop("seconds", None)
        data = json.dumps(value, sort_keys=True, indent=0).encode()
    data = re.sub(rb"\d+(\.\d+)? s\b", b"", data) if path.name in OF_WORDS else data
    return data.replace(str(out).encode(), b"OUT")


def first_difference(before: bytes, after: bytes) -> str:
    """The first lines that differ; only the sizes of what is no text."""
    try:
        lines = [each.decode().splitlines() for each in (before, after)]
    except UnicodeDecodeError:
        return f"{len(before)} bytes, {len(after)} bytes"
    changed = [line[:160] for line in difflib.unified_diff(*lines, n=0, lineterm="") if line[0] in "+-"]
    return " ".join(changed[2:4])


def compared(before: Path, after: Path) -> tuple[int, dict[str, str]]:
    """Number of files of two folders, and those that differ."""
    files = [visible(before), visible(after)]
    different = dict.fromkeys(files[0].keys() - files[1].keys(), "only before")
    different |= dict.fromkeys(files[1].keys() - files[0].keys(), "only after")
    for name in sorted(files[0].keys() & files[1].keys()):
        contents = plain(files[0][name], before.parent), plain(files[1][name], after.parent)
        if contents[0] != contents[1]:
            different[name] = first_difference(*contents)
    return len(files[0].keys() | files[1].keys()), different


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before")
    parser.add_argument("--after", type=Path, default=ROOT)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--jobs", default="1")
    parser.add_argument("--only", action="append")
    asked = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory(prefix="rsundistort-same-") as scratch:
        work = (asked.work or Path(scratch)).resolve()
        trees = {"before": Path(asked.before).resolve(), "after": asked.after.resolve()}
        if not trees["before"].is_dir():
            trees["before"] = Path(scratch) / "tree"
            trees["before"].mkdir()
            packed = subprocess.run(["git", "archive", asked.before], cwd=ROOT, stdout=subprocess.PIPE, check=True)
            subprocess.run(["tar", "-x", "-C", str(trees["before"])], input=packed.stdout, check=True)
        given = work / "given"
        if not given.is_dir():
            given.mkdir(parents=True)
            inputs(given)
        for name in commands(given, work, asked.jobs):
            if asked.only and name not in asked.only:
                continue
            exits = []
            for state, tree in trees.items():
                out = work / state
                (out / name).mkdir(parents=True, exist_ok=True)
                if not (out / f"{name}.stdout" / "stdout").is_file():  # --work keeps what is done
                    (out / f"{name}.stdout").mkdir(exist_ok=True)
                    arguments = commands(given, out, asked.jobs)[name]
                    exits.append(run(tree, arguments, out / f"{name}.stdout" / "stdout"))
            counted, different = compared(work / "before" / name, work / "after" / name)
            _, said = compared(work / "before" / f"{name}.stdout", work / "after" / f"{name}.stdout")
            print(
                json.dumps({"name": name, "exits": exits, "files": counted, "different": different | said}), flush=True
            )
            failed |= bool(different.keys() - {*OF_WORDS}) or bool({*exits} - {0, 3})
    sys.exit(failed)


if __name__ == "__main__":
    main()
