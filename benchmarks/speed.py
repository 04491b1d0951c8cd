"""Speed as ratios measured in one run against peers: prints one JSON object a line.

    python benchmarks/speed.py [--photos DIR] [--repeat N] [--before CHECKOUT]

`run` on herz-jesus-8 against pycolmap's own chain (extract, match exhaustively, map, undistort) on the same
photos. Each runs in a process of its own, by turns; medians. Exits 1 if one crashes, never because a noisy figure
misses its target. With `--before`, another checkout of this project, it measures only what solving takes of both, by
turns: seconds of all stages of `run` but those that detect, match, map, align or rectify.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

PEER = """
import sys, json, pathlib, pycolmap
pycolmap.logging.minloglevel = 2
photos, work = map(pathlib.Path, sys.argv[1:])
camera = json.loads((photos / "camera.json").read_text())
K = camera["K"]
reader = pycolmap.ImageReaderOptions()
reader.camera_model = "PINHOLE"
reader.camera_params = ",".join(str(v) for v in (K[0][0], K[1][1], K[0][2] + 0.5, K[1][2] + 0.5))
names = sorted(p.name for p in photos.glob("*.jpg"))
database = work / "database.db"
pycolmap.extract_features(database, photos, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE,
                          reader_options=reader, device=pycolmap.Device.cpu)
pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
options = pycolmap.IncrementalPipelineOptions()
options.ba_refine_focal_length = options.ba_refine_extra_params = False
models = pycolmap.incremental_mapping(database, photos, work, options)
assert models[0].num_reg_images() == len(names)
pycolmap.undistort_images(work / "undistorted", work / "0", photos)
"""

OURS = """
import sys
from rsundistort_cli.main import cli
cli(["run", sys.argv[1], "-o", sys.argv[2] + "/out", "--quiet"])
"""


def timed(code: str, photos: Path) -> float:
    """Seconds of a program in a process of its own."""
    with tempfile.TemporaryDirectory() as work:
        began = time.perf_counter()
        subprocess.run([sys.executable, "-c", code, str(photos), work], check=True, stderr=subprocess.DEVNULL)
        return time.perf_counter() - began


#: Stages of a run that work on pixels and pairs, not on measurements.
NOT_SOLVING = ("features", "matching", "mapping", "alignment", "rectifying", "writing")
SOLVED = ("herz-jesus-8", "fountain-small/rs", "iphone6")


def solving(photos: Path, checkout: Path) -> tuple[float, float]:
    """Seconds by the clock of the stages that solve, and of all, of a run of that checkout."""
    script = "import sys, rsundistort; rsundistort.run(*sys.argv[1:])"
    with tempfile.TemporaryDirectory() as out:
        subprocess.run(
            [sys.executable, "-W", "ignore", "-c", script, str(photos), out], check=True, cwd=checkout,
            env={**os.environ, "PYTHONPATH": str(checkout)}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        stages = json.loads(Path(out, "solution.json").read_text())["stages"]
    seconds = {stage["name"]: float(stage["seconds"]) for stage in stages}
    return sum(each for name, each in seconds.items() if not name.startswith(NOT_SOLVING)), sum(seconds.values())


def compare(before: Path, photos: Path, repeat: int) -> None:
    """What solving takes now, by what it took before."""
    for name in SOLVED:
        if not (photos / name).is_dir():
            continue
        states = {"before": before.resolve(), "now": ROOT}
        found: dict[str, list[tuple[float, float]]] = {state: [] for state in states}
        for checkout in states.values():
            solving(photos / name, checkout)  # kernels are compiled once per installation
        for _ in range(repeat):
            for state, checkout in states.items():
                found[state].append(solving(photos / name, checkout))
        part, whole = zip(*(map(statistics.median, zip(*found[state], strict=True)) for state in states), strict=True)
        figures = {
            "before_s": round(part[0], 2),
            "now_s": round(part[1], 2),
            "ratio": round(part[1] / part[0], 2),
            "target": 2.0,
            "ok": part[1] <= 2.0 * part[0],
            "ratio_of_all": round(whole[1] / whole[0], 2),
        }
        print(json.dumps({"name": f"solving {name}", **figures}), flush=True)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--before", type=Path, help="another checkout of this project")
    args = parser.parse_args()
    if args.before is not None:
        compare(args.before, args.photos, args.repeat)
        return
    photos = args.photos / "herz-jesus-8"
    if not photos.is_dir():
        print(json.dumps({"name": "run", "skipped": "no folder of test photos beside the project"}))
        return
    timed(OURS, photos)  # kernels are compiled once per installation
    ours, peer = [], []
    for _ in range(args.repeat):
        ours.append(timed(OURS, photos))
        peer.append(timed(PEER, photos))
    a, b = statistics.median(ours), statistics.median(peer)
    figures = {
        "ours_s": round(a, 2),
        "peer_s": round(b, 2),
        "ratio": round(a / b, 3),
        "floor_s": None,
        "target": 1.2,
        "ok": a <= 1.2 * b,
    }
    print(json.dumps({"name": "run herz-jesus-8 against pycolmap's chain", **figures}), flush=True)
    command = Path(sys.executable).with_name("rsundistort")
    times = []
    for _ in range(7):
        began = time.perf_counter()
        subprocess.run([str(command), "--help"], check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - began)
    a = statistics.median(times)
    print(json.dumps({"name": "rsundistort --help", "ours_s": round(a, 3), "target": 0.3, "ok": a <= 0.3}))


if __name__ == "__main__":
    main()
