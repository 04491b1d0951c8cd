"""Time, memory and size of the report of many photos of 12 MP: prints one JSON object a line.

    python benchmarks/report.py [--photos N]

A synthetic street, solved from its measurements; its photos are made up. `peer_s` is the time of what the report stands
beside: solving and rectifying. Exits 1 if it crashes, never because a noisy figure misses its target.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import bundle
from batch import make_photos

import rsundistort as rs
from rsundistort.colmap import write_colmap_model
from rsundistort.solve import OutputOptions

REPORT = """
import json, sys, time
sys.path.insert(0, sys.argv[2])
from bundle import peak_mb
from rsundistort.report import write_report
began = time.perf_counter()
path = write_report(sys.argv[1])
print(json.dumps({"s": time.perf_counter() - began, "html_mb": path.stat().st_size / 1e6,
                  "peak_mb": peak_mb()}))
"""


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=100)
    count = parser.parse_args().photos
    bundle.WIDTH, bundle.HEIGHT, bundle.FOCAL, bundle.PER_PHOTO = 4000, 3000, 4000.0, 1000
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        rec = bundle.make_problem("street", 1000 * count)
        for made, name in zip(make_photos(folder / "photos", count), rec.image_names, strict=True):
            (folder / "photos" / made).rename(folder / "photos" / name)
        write_colmap_model(folder / "model", rec, list(rec.cameras), list(rec.image_names))
        options = rs.SolveOptions(readout="top-to-bottom", shutter_model="rotation")
        began = time.perf_counter()
        rs.solve(
            folder / "model", folder / "out", options, outputs=OutputOptions(report=False), images=folder / "photos"
        )
        beside = time.perf_counter() - began
        command = [sys.executable, "-c", REPORT, str(folder / "out"), str(Path(__file__).parent)]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    found = json.loads(done.stdout.splitlines()[-1])
    figures = {
        "name": f"report of {count} photos of 12 MP",
        "ours_s": round(found["s"], 1),
        "peer_s": round(beside, 1),
        "ratio": round(found["s"] / beside, 3),
        "peak_mb": round(found["peak_mb"]),
        "html_mb": round(found["html_mb"], 1),
        "target": "100 photos: <= 30 s, <= 15 MB",
        "ok": count > 100 or (found["s"] <= 30 and found["html_mb"] <= 15),
    }
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
