"""When a shutter model is worth it: errors with and without one by pixels of shutter shift. Prints JSON lines.

    python benchmarks/worth.py [--seeds N]

Cameras and points of sample_scenes/courtyard (f = 800 px), rotations alone, noise of 0.5 px, as in Experiment I of the
paper (docs/experiments.md) but for the standard deviation of the rotation. `shift_px` is the root mean square over the
photos of rotation over the frame x focal length: how far the last line is moved against the first. Medians over the
seeds.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from rsundistort.experiments.one import OneOptions, draw_motions, run_trial
from rsundistort.experiments.scenes import load_scene

TRACKS = Path(__file__).resolve().parent.parent / "sample_scenes" / "courtyard" / "tracks.npz"
SPREADS_RAD = (0.0003, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    seeds = parser.parse_args().seeds
    scene = load_scene(TRACKS)
    for spread in SPREADS_RAD:
        options = OneOptions(methods=("wo-rs", "rotation"), rotation_rad=spread, translation=0.0)
        shifts, lines = [], []
        for seed in range(seeds):
            drawn = replace(options, seed=seed)
            turns = [np.linalg.norm(motion.phi) for motion in draw_motions(scene, drawn)[1:]]
            shifts.append(np.sqrt(np.mean(np.square(turns))) * scene.camera.height)  # phi x frame_span x fy
            lines += run_trial(scene, drawn, 0)
        figures: dict[str, float] = {"rotation_rad": spread, "shift_px": round(float(np.median(shifts)), 2)}
        for method, name in (("wo-rs", "global"), ("rotation", "rotation")):
            for metric in ("rotation_deg", "structure"):
                values = [line[metric] for line in lines if line["method"] == method]
                figures[f"{name}_{metric}"] = float(f"{np.median(values):.2g}")
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
