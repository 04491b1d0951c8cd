"""Speed as ratios measured in one run against peers: prints one JSON object a line.

    python benchmarks/speed.py [--photos DIR] [--repeat N]

`run` on herz-jesus-8 against pycolmap's own chain (extract, match exhaustively, map, undistort) on the same
photos. Each runs in a process of its own, by turns; medians. Exits 1 if one crashes, never because a noisy figure
misses its target.
"""

from __future__ import annotations

import argparse
import json
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


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--repeat", type=int, default=3)
    args = parser.parse_args()
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
