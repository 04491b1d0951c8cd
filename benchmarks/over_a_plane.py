"""Motions of cameras that look straight down and travel, with the model that is chosen and with velocities.

    python benchmarks/over_a_plane.py [--num 3] [--first-seed 0]

Prints one JSON object a line. Over a plane a velocity looks like a rotation, or like a lens that varies: which of them
is chosen decides what phi is, and its deviations have to allow for the others.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from pathlib import Path

import numpy as np
from measures import normalised_errors, run_options

from rsundistort import read_solution, run
from rsundistort.evaluation import motion_errors
from rsundistort.simulate import SceneOptions, simulate_scene

FLYOVER = Path(__file__).resolve().parent.parent / "sample_scenes" / "flyover" / "recipe.json"
MOTION = {"kind": "random", "rotation_rad_per_frame": 0.024, "translation_m_per_frame": 0.09}


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    for seed in range(args.first_seed, args.first_seed + args.num):
        with tempfile.TemporaryDirectory() as folder:
            recipe = Path(folder, "recipe.json")
            content = json.loads(FLYOVER.read_text())
            path, noise = content["path"][:6], {"read_grey": 1.5, "shot_grey": 3.0}
            changed = {"seed": seed, "path": path, "motion": MOTION, "noise": noise}
            recipe.write_text(json.dumps(content | changed))
            scene = Path(folder, "scene")
            truth = simulate_scene(recipe, scene, SceneOptions(depth=False))
            for model in ("auto", "constant-motion"):
                run(scene / "photos", Path(folder, model), run_options(shutter_model=model))
                found = read_solution(Path(folder, model) / "solution.json")
                error, over_sigma = (
                    motion_errors(found, truth).phi_rad_per_frame,
                    normalised_errors(found, truth)["phi"],
                )
                said = {
                    "seed": seed, "asked": model, "model": found.shutter_model,
                    "shape": (found.verdict or {}).get("shape"),
                    "phi_mrad": round(1e3 * rms(error), 2),
                    "over_sigma": None if over_sigma is None else round(rms(over_sigma), 2),
                }  # fmt: skip
                print(json.dumps(said), flush=True)


if __name__ == "__main__":
    main()
