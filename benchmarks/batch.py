"""Batches of 12 MP JPEGs as ratios measured in one run: prints one JSON object a line.

    python benchmarks/batch.py [--count N] [--repeat N] [--interpolation cubic|linear]

- `rectify` against the least that the work takes: decode, `cv2.remap` with ready maps, encode, in a pool of as many
  threads, with the same interpolation, quality and sampling of colours, by the fastest calls that OpenCV has. Ours
  makes grids and masks, too. The ratio is that of photos a second.
- `rectify` of a lens alone against `pycolmap.undistort_images`, with its interpolation (linear) and the same quality;
  ratio of the times. Ours keeps colours at full resolution, which pycolmap halves.
- Resident memory of `rectify`, in a process of its own, against 150 MB and 120 MB a worker.

All three work in processes of their own, by turns; medians. Exits 1 if one crashes, never because a noisy figure misses
its target.
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

import cv2
import numpy as np

from rsundistort import Camera, RowMotion, Solution, SolvedImage, write_solution

WIDTH, HEIGHT, F = 4000, 3000, 3200.0
DIST = [-0.12, 0.03, 0.001, -0.0005]
QUALITY = 98

# prints the seconds of the work itself, without imports and compiled kernels' loading, and the largest resident set
OURS = """
import sys, time, json
from pathlib import Path
from rsundistort.batch import rectify_folder
photos, solution, out, warm, interpolation, quality, jobs = sys.argv[1:]
options = {"interpolation": interpolation, "quality": int(quality), "jobs": int(jobs)}
rectify_folder(warm, solution, out + "-warm", **options)
began = time.perf_counter()
rectify_folder(photos, solution, out, **options)
seconds = time.perf_counter() - began
# not ru_maxrss: that of a young process is its parent's
peak = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1024
print(json.dumps({"s": seconds, "mb": peak}))
"""

FLOOR = """
import sys, time, json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import cv2, numpy as np
photos, maps, out, interpolation, quality, jobs = sys.argv[1:]
cv2.setNumThreads(1)
maps = np.load(maps)
Path(out).mkdir()
full = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
params = [cv2.IMWRITE_JPEG_QUALITY, int(quality), *full]
flag = {"cubic": cv2.INTER_CUBIC, "linear": cv2.INTER_LINEAR}[interpolation]
def work(path):
    photo = cv2.imread(str(path), None, cv2.IMREAD_UNCHANGED)  # into its array; imdecode copies
    done = cv2.remap(photo, maps[0], maps[1], flag)
    (Path(out) / path.name).write_bytes(cv2.imencode(".jpg", done, params)[1].data)
paths = sorted(Path(photos).iterdir())
work(paths[0])
began = time.perf_counter()
with ThreadPoolExecutor(int(jobs)) as pool:
    list(pool.map(work, paths))
print(json.dumps({"s": time.perf_counter() - began}))
"""

PEER = """
import sys, time, json
import pycolmap
photos, model, out, quality = sys.argv[1:]
pycolmap.logging.minloglevel = 2
options = pycolmap.UndistortCameraOptions()
options.blank_pixels = 0
began = time.perf_counter()
pycolmap.undistort_images(out, model, photos, undistort_options=options, jpeg_quality=int(quality))
print(json.dumps({"s": time.perf_counter() - began}))
"""


def make_photos(folder: Path, count: int) -> list[str]:
    """JPEGs of a smooth texture with some detail, about 5 MB each, as cameras write them."""
    rng = np.random.default_rng(0)
    coarse = cv2.resize(
        rng.integers(0, 256, (94, 125, 3), dtype=np.uint8), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC
    )
    fine = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8), (0, 0), 2.0)
    scene = cv2.addWeighted(coarse, 0.6, fine, 0.4, 0)
    folder.mkdir()
    names = [f"{k:04}.jpg" for k in range(count)]
    for k, name in enumerate(names):
        data = cv2.imencode(".jpg", np.roll(scene, 37 * k, axis=1), [cv2.IMWRITE_JPEG_QUALITY, 93])[1]
        (folder / name).write_bytes(data.data)
    return names


def make_model(folder: Path, camera: Camera, names: list[str]) -> None:
    """The photos and their lens as a COLMAP model."""
    import pycolmap

    model = pycolmap.Reconstruction()
    K = camera.K
    params = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5, *DIST]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    )
    for k, name in enumerate(names):
        image = pycolmap.Image(name=name, keypoints=np.zeros((0, 2)), camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    folder.mkdir()
    model.write(folder)


def measured(code: str, *args: object) -> dict[str, float]:
    """What a program in a process of its own prints."""
    done = subprocess.run([sys.executable, "-c", code, *map(str, args)], check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def tell(
    name: str, ours: float, peer: float | None, ratio: float, target: float, at_least: bool, **more: object
) -> None:
    line = {
        "name": name,
        "ours_s": round(ours, 3),
        "peer_s": None if peer is None else round(peer, 3),
        "ratio": round(ratio, 3),
        "floor_s": None,
        "target": target,
        "ok": ratio >= target if at_least else ratio <= target,
    }
    print(json.dumps(line | more), flush=True)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--interpolation", choices=("cubic", "linear"), default="cubic")
    args = parser.parse_args()
    jobs = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        names = make_photos(folder / "photos", args.count)
        warm = folder / "warm"
        warm.mkdir()
        (warm / names[0]).write_bytes((folder / "photos" / names[0]).read_bytes())
        camera = Camera(WIDTH, HEIGHT, [[F, 0, (WIDTH - 1) / 2], [0, F, (HEIGHT - 1) / 2], [0, 0, 1]], DIST)
        rng = np.random.default_rng(1)
        for kind, spread in (("moved", 0.02), ("still", 0.0)):
            motions = [RowMotion(rng.normal(0, spread, 3) if spread else np.zeros(3)) for _ in names]
            images = tuple(SolvedImage(name, "1", motion=motion) for name, motion in zip(names, motions, strict=True))
            model = "rotation" if spread else "global"
            write_solution(folder / f"{kind}.json", Solution(model, {"1": camera}, {"1": camera.pinhole()}, images))
        maps = cv2.initUndistortRectifyMap(camera.K, np.array(DIST), np.eye(3), camera.K, (WIDTH, HEIGHT), cv2.CV_32FC1)
        np.save(folder / "maps.npy", np.array(maps))
        make_model(folder / "model", camera, names)

        def ours(kind: str, turn: int, interpolation: str) -> dict[str, float]:
            out = folder / f"{kind}-{turn}"
            how = (interpolation, QUALITY, jobs)
            return measured(OURS, folder / "photos", folder / f"{kind}.json", out, warm, *how)

        moved, still, floor, peer, peak = [], [], [], [], []
        for turn in range(args.repeat):
            found = ours("moved", turn, args.interpolation)
            moved.append(found["s"])
            peak.append(found["mb"])
            out = folder / f"floor-{turn}"
            how = (args.interpolation, QUALITY, jobs)
            floor.append(measured(FLOOR, folder / "photos", folder / "maps.npy", out, *how)["s"])
            still.append(ours("still", turn, "linear")["s"])
            peer.append(measured(PEER, folder / "photos", folder / "model", folder / f"peer-{turn}", QUALITY)["s"])
            for path in [*folder.glob(f"*-{turn}"), *folder.glob(f"*-{turn}-warm")]:
                subprocess.run(["rm", "-rf", str(path)], check=True)
            time.sleep(0.1)
    median = statistics.median
    what = f"{args.count} JPEGs of 12 MP, {args.interpolation}, {jobs} threads"
    alike = f"{args.count} JPEGs of 12 MP, linear, {jobs} threads"
    tell(
        f"batch, {what}: rate against decode + remap with ready maps + encode",
        median(moved), None, median(f / m for f, m in zip(floor, moved, strict=True)), 0.85, True,
        floor_s=round(median(floor), 3),
    )  # fmt: skip
    tell(
        f"batch, {alike}: time against pycolmap.undistort_images, lens alone",
        median(still), median(peer), median(s / p for s, p in zip(still, peer, strict=True)), 0.3, False,
    )  # fmt: skip
    limit = 150 + 120 * jobs
    tell(
        f"batch, {what}: resident MB against 150 and 120 a worker",
        median(moved), None, median(peak) / limit, 1.0, False, mb=round(median(peak), 1),
    )  # fmt: skip


if __name__ == "__main__":
    main()
