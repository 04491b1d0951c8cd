"""What other programs make of our exports, and we of their poses. Prints one JSON object.

    python benchmarks/formats.py [--orthority PYTHON]

`metashape`: the photos of sample_scenes/courtyard solved without a shutter, as programs without one do, and written as
`cameras.xml`; `solve` with it and the photos. Median error of the rotation between two photos, degrees, of what was
given and of what was found. `orthority`: the OpenSfM project of that, read by orthority in an environment of its own
(`pip install orthority`; PYTHON is its interpreter: its OpenCV would replace ours): the distance in pixels from where a
point was measured to where its camera shows it, median. Exits 1 if what was found is not ten times as good.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from rsundistort import RunOptions, Solution, SolveOptions, read_solution, run, solve
from rsundistort.solve import OutputOptions

SCENE = Path(__file__).resolve().parent.parent / "sample_scenes" / "courtyard"

# In orthority's environment: all photos in its world, which turns ours by the map's convergence.
_READER = """
import csv, json, sys
import cv2, numpy as np
from orthority.camera import create_camera
from orthority.param_io import OsfmReader

place = sys.argv[1]
value = json.load(open(place + "/reconstruction.json"))
value[0]["reference_lla"] = {"latitude": 46.5, "longitude": 7.25, "altitude": 500.0}
json.dump(value, open(place + "/placed.json", "w"))
reader = OsfmReader(place + "/placed.json")
lenses, poses = reader.read_int_param(), reader.read_ext_param()
points = {key: point["coordinates"] for key, point in value[0]["points"].items()}
seen = {}
for name, track, _, x, y, *_ in csv.reader(open(place + "/tracks.csv").read().splitlines()[1:], delimiter="\\t"):
    seen.setdefault(name, []).append((*points[track], float(x), float(y)))
about = lambda angle, axis: cv2.Rodrigues(np.eye(3)[axis] * angle)[0]
world, off = None, []
for name, pose in poses.items():
    shot, (omega, phi, kappa) = value[0]["shots"][name], pose["opk"]
    R_cw = cv2.Rodrigues(np.array(shot["rotation"]))[0]
    turn = about(omega, 0) @ about(phi, 1) @ about(kappa, 2) @ np.diag([1, -1, -1]) @ R_cw
    world = world or (lambda X, turn=turn, at=-R_cw.T @ shot["translation"], xyz=pose["xyz"]: (X - at) @ turn.T + xyz)
    lens = {key: each for key, each in lenses[pose["camera"]].items()}
    camera = create_camera(lens.pop("cam_type"), **lens, xyz=pose["xyz"], opk=pose["opk"])
    table, (width, height) = np.array(seen[name]), lens["im_size"]
    measured = table[:, 3:] * max(width, height) + np.array([width - 1, height - 1]) / 2
    off.append(np.linalg.norm(camera.world_to_pixel(world(table[:, :3]).T).T - measured, axis=1))
off = np.concatenate(off)
print(json.dumps({"median_px": float(np.median(off)), "measurements": len(off)}))
"""


def between_deg(found: Solution, truth: Solution) -> float:
    """Median error of the rotation between two photos."""
    turns = [truth.image(image.name).R_cw.T @ image.R_cw for image in found.registered]
    off = [(np.trace(a @ b.T) - 1) / 2 for k, a in enumerate(turns) for b in turns[:k]]
    return float(np.degrees(np.median(np.arccos(np.clip(off, -1, 1)))))


def main() -> int:
    """Print the figures; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--orthority", metavar="PYTHON")
    peer = parser.parse_args().orthority
    truth = read_solution(SCENE / "ground_truth.json")
    with tempfile.TemporaryDirectory() as work:
        given, found = Path(work, "given"), Path(work, "found")
        options = SolveOptions(shutter_model="global", refine=(), readout="top-to-bottom")
        written = OutputOptions(exports=("metashape",), report=False)
        camera = RunOptions(solve=options, outputs=written, camera=str(SCENE / "camera.json"))
        before = run(SCENE / "photos", given, camera)
        after = solve(
            given / "metashape" / "cameras.xml", found, SolveOptions(shutter_model="rotation"),
            outputs=OutputOptions(exports=("opensfm",), report=False), images=SCENE / "photos",
        )  # fmt: skip
        figures = {"metashape": {"given_deg": between_deg(before, truth), "found_deg": between_deg(after, truth)}}
        if peer:
            read = subprocess.run(
                [peer, "-W", "ignore", "-c", _READER, str(found / "opensfm")],
                check=True, capture_output=True, text=True,
            )  # fmt: skip
            figures["orthority"] = json.loads(read.stdout)
    print(json.dumps(figures))
    return int(10 * figures["metashape"]["found_deg"] > figures["metashape"]["given_deg"])


if __name__ == "__main__":
    sys.exit(main())
