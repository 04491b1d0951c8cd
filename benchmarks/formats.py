"""What other programs make of our exports, and we of their poses. Prints one JSON object.

    python benchmarks/formats.py [--orthority PYTHON] [--blender PYTHON]

`metashape`: the photos of sample_scenes/courtyard solved without a shutter, as programs without one do, and written as
`cameras.xml`; `solve` with it and the photos. Median error of the rotation between two photos, degrees, of what was
given and of what was found. `orthority`: the OpenSfM project of that, read by orthority in an environment of its own
(`pip install orthority`; PYTHON is its interpreter: its OpenCV would replace ours): the distance in pixels from where a
point was measured to where its camera shows it, median. `blender`: `camera.usda` of a made-up path, imported by Blender
in an environment of its own (`pip install bpy`): the largest distance in pixels from where our cameras show points to
where its camera does, of frames upright and wide, with pixels that are square and not. Exits 1 if what was found is not
ten times as good, or Blender is off by 0.001 px.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RunOptions, Solution, SolveOptions, read_solution, run, solve
from rsundistort.io.usd import write_usd_camera
from rsundistort.model.track import CameraTrack
from rsundistort.solve import OutputOptions

SCENE = Path(__file__).resolve().parent.parent / "sample_scenes" / "courtyard"

# In orthority's environment: all photos in its world, which rotates ours by the map's convergence.
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

# In Blender's environment: pixels of points at each frame, from the upper left corner.
_BLENDER = """
import json, sys
import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

path, width, height, aspect, frames = json.loads(sys.argv[1])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=path)
scene = bpy.context.scene
scene.render.resolution_x, scene.render.resolution_y = width, height
scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = max(1, aspect), max(1, 1 / aspect)
camera, points = (next(each for each in bpy.data.objects if each.type == kind) for kind in ("CAMERA", "POINTCLOUD"))
places = [each.vector.copy() for each in points.data.attributes["position"].data]
shown = []
for frame in frames:
    scene.frame_set(frame)
    seen = [world_to_camera_view(scene, camera, points.matrix_world @ Vector(each)) for each in places]
    shown.append([(x * width, (1 - y) * height) for x, y, _ in seen])
print("shown", json.dumps(shown))
"""


def blender_px(python: str, work: Path) -> float:
    """The largest distance between Blender's pixels and ours."""
    rng, frames = np.random.default_rng(0), [0, 1, 2, 4]
    R_cw = Rotation.from_rotvec(rng.normal(0, 0.2, (4, 3))).as_matrix()
    track = CameraTrack(np.array(frames) / 25, 1 / 25, R_cw, rng.normal(0, 1, (4, 3)), Camera(1, 1, np.eye(3)))
    points_w = np.column_stack([rng.uniform(-1, 1, (50, 2)), rng.uniform(6, 12, 50)])
    x_c = np.einsum("mij,mnj->mni", track.R_cw, points_w - track.center_w[:, None])
    off = []
    for width, height in ((640, 360), (360, 640)):
        for fx, fy in ((500, 500), (500, 505), (505, 500)):
            camera = Camera(width, height, [[fx, 0, width / 2 + 13], [0, fy, height / 2 - 9], [0, 0, 1]])
            file = work / f"{width}-{fx}-{fy}.usda"
            write_usd_camera(file, replace(track, camera=camera), points_w)
            asked = json.dumps([str(file), width, height, fy / fx, frames])
            said = subprocess.run([python, "-c", _BLENDER, asked], check=True, capture_output=True, text=True).stdout
            shown = json.loads(said.partition("shown ")[2].splitlines()[0])
            off.append(np.abs(np.array(shown) - 0.5 - (x_c / x_c[..., 2:]) @ camera.K[:2].T).max())
    return float(max(off))


def between_deg(found: Solution, truth: Solution) -> float:
    """Median error of the rotation between two photos."""
    turns = [truth.image(image.name).R_cw.T @ image.R_cw for image in found.registered]
    off = [(np.trace(a @ b.T) - 1) / 2 for k, a in enumerate(turns) for b in turns[:k]]
    return float(np.degrees(np.median(np.arccos(np.clip(off, -1, 1)))))


def main() -> int:
    """Print the figures; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--orthority", metavar="PYTHON")
    parser.add_argument("--blender", metavar="PYTHON")
    peers = parser.parse_args()
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
        if peers.blender:
            figures["blender"] = {"largest_px": blender_px(peers.blender, Path(work))}
        if peers.orthority:
            read = subprocess.run(
                [peers.orthority, "-W", "ignore", "-c", _READER, str(found / "opensfm")],
                check=True, capture_output=True, text=True,
            )  # fmt: skip
            figures["orthority"] = json.loads(read.stdout)
    print(json.dumps(figures))
    worse = 10 * figures["metashape"]["found_deg"] > figures["metashape"]["given_deg"]
    return int(worse or figures.get("blender", {}).get("largest_px", 0.0) > 1e-3)


if __name__ == "__main__":
    sys.exit(main())
