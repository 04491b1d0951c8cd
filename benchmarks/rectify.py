"""Rectification of one photo, against `cv2.undistort` on the same photo: prints one JSON object a line.

    python benchmarks/rectify.py [--repeat N]

4000x3000, three channels, linear interpolation, both on two threads, by turns; medians. `floor_s` is `cv2.remap` alone
with ready maps of full size, `bytes_moved` what it must read and write at the least. `cpu_ratio` is the ratio of the
processors' time, which other programs on the machine disturb less: `cv2.undistort` works on one thread (its strips are
a row or so), so half of it is the ratio of an idle machine. `bent map` is a map of full size of a motion that vibrates,
against that of a steady one. Exits 1 if one crashes, never because a noisy figure misses
its target.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

import rsundistort as rs
from rsundistort.model import Bend

WIDTH, HEIGHT = 4000, 3000
K = np.array([[3000.0, 0, 1990], [0, 3010, 1510], [0, 0, 1]])
DIST = np.array([-0.12, 0.03, 0.001, -0.002])
MOTION = rs.RowMotion([0.03, -0.02, 0.03])
CAMERA = rs.Camera(WIDTH, HEIGHT, K, DIST)
# a milliradian of three periods
TREMOR = 1e-3 * np.sin(np.linspace(0.0, 6 * np.pi, 65)[:, None] + np.arange(3))
VIBRATING = rs.RowMotion(MOTION.phi, bend=Bend(*CAMERA.clock_range, TREMOR))
THREADS = 2
MAX_EXTRA_MB = 32
AGAINST = {"peer": "cv2.undistort", "rotation": "uint8"}

# The peak of a fresh process less what it held before, less result and mask. Linux resets the peak when asked.
MEMORY = """
import sys
sys.path.insert(0, {folder!r})
from rectify import *
photo = picture()
rs.rectify(photo[:300, :400].copy(), rs.Camera(400, 300, K), MOTION, interpolation="linear", jobs=THREADS)
def kilobytes(name):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name + ":"))
open("/proc/self/clear_refs", "w").write("5")
before = kilobytes("VmRSS")
result = rs.rectify(photo, CAMERA, MOTION, interpolation="linear", jobs=THREADS)
print((kilobytes("VmHWM") - before) / 1024 - sum(each.nbytes for each in result) / 2**20)
"""


def picture() -> np.ndarray[Any, Any]:
    """A photo of blurred noise."""
    coarse = np.random.default_rng(0).integers(0, 256, (HEIGHT // 10, WIDTH // 10, 3)).astype(np.uint8)
    return cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)


def pictures() -> dict[str, np.ndarray[Any, Any]]:
    """The same photo in three depths."""
    photo = picture()
    deep = photo.astype(np.uint16) * 257
    return {"uint8": photo, "uint16": deep, "float32": deep.astype(np.float32) / 65535}


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds on the wall and of all processors."""
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - cpu


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=15)
    args = parser.parse_args()
    cv2.setNumThreads(THREADS)
    photos = pictures()
    maps = rs.init_rectify_map(CAMERA, MOTION)

    def ours(kind: str, model: str = "rotation") -> Callable[[], object]:
        return lambda: rs.rectify(photos[kind], CAMERA, MOTION, model, interpolation="linear", jobs=THREADS)

    works: dict[str, Callable[[], object]] = {
        "peer": lambda: cv2.undistort(photos["uint8"], K, DIST),
        "floor": lambda: cv2.remap(photos["uint8"], *maps, cv2.INTER_LINEAR),
        "rotation": ours("uint8"),
        "two-step": ours("uint8", "two-step"),
        "uint16": ours("uint16"),
        "float32": ours("float32"),
        "map": lambda: rs.init_rectify_map(CAMERA, MOTION),
        "bent map": lambda: rs.init_rectify_map(CAMERA, VIBRATING),
    }
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
    for work in works.values():
        work()
    for _ in range(max(7, args.repeat)):
        for name, work in works.items():
            times[name].append(timed(work))

    def median(name: str) -> float:
        return statistics.median(wall for wall, _ in times[name])

    floor = {"floor_s": round(median("floor"), 4), "bytes_moved": photos["uint8"].nbytes * 2 + 2 * maps[0].nbytes}
    for name, against, target in (
        ("rotation", "peer", 0.65),
        ("two-step", "peer", 0.6),
        ("uint16", "rotation", 2.5),
        ("float32", "rotation", 2.5),
        ("bent map", "map", 1.3),
    ):
        pairs = list(zip(times[name], times[against], strict=True))
        ratio = statistics.median(a[0] / b[0] for a, b in pairs)
        figures = {
            "name": f"rectify 4000x3000 {name} against {AGAINST.get(against, against)}",
            "ours_s": round(median(name), 4),
            "peer_s": round(median(against), 4),
            "ratio": round(ratio, 3),
            "cpu_ratio": round(statistics.median(a[1] / b[1] for a, b in pairs), 3),
            **floor,
            "target": target,
            "ok": ratio <= target,
        }
        print(json.dumps(figures), flush=True)
    code = MEMORY.format(folder=sys.path[0])
    done = subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True)
    extra = float(done.stdout)
    figures = {"name": "rectify 4000x3000 extra memory", "ours_mb": round(extra, 1), "target": MAX_EXTRA_MB}
    print(json.dumps({**figures, "ok": extra <= MAX_EXTRA_MB}), flush=True)


if __name__ == "__main__":
    main()
