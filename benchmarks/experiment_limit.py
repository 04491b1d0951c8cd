"""How far from the best possible Experiment I ends: prints one JSON object for each scene and seed.

    python benchmarks/experiment_limit.py SCENE.npz [...] [--seeds N] [--trials N]

`oracle` starts the constant-motion model at the true parameters and tells it the true spreads of the motion: the
posterior mode under the very distribution that the motion was drawn from, which no estimator betters on average (to
second order in the noise). `ratio_reached` is the error of the paper's RS* over that of constant-motion, which is told
nothing and starts from the global-shutter solution; `ratio_limit` is RS* over the oracle: what any method could reach.
Medians over the trials. `noise_of_rs_star` is RS* on measurements of the same motion without its translation, which its
model lacks: the error that is left to it by noise alone.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import numpy as np

from rsundistort import bundle_adjust
from rsundistort.experiments import OneOptions, load_scene
from rsundistort.experiments.one import draw_trial, errors_of, method_options
from rsundistort.model import Reconstruction

METRICS = ("rotation_deg", "structure")


def solved(start: Reconstruction, truth: Reconstruction, method: str, options: OneOptions) -> dict[str, float]:
    """Errors of a method of the experiment."""
    model = {"rs-star": "two-step"}.get(method, method)
    return errors_of(bundle_adjust(start, model, method_options(method, options)).reconstruction, truth)


def from_global(rough: Reconstruction, options: OneOptions) -> Reconstruction:
    """The global-shutter solution, where all methods start."""
    rough_options = replace(method_options("wo-rs", options), cost_tolerance=1e-6)
    return bundle_adjust(rough, "global", rough_options).reconstruction


def oracle(truth: Reconstruction, options: OneOptions) -> dict[str, float]:
    """Errors of constant-motion from the truth, with the spreads that the motion was drawn with."""
    # the axis is uniform: a component has a third of the angle's variance
    told = replace(
        method_options("constant-motion", options),
        phi_sigma=options.rotation_rad / np.sqrt(3.0),
        velocity_sigma=options.translation,
    )
    return errors_of(bundle_adjust(truth, "constant-motion", told).reconstruction, truth)


def main() -> None:
    """Print the ratios of each scene and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--trials", type=int, default=20)
    args = parser.parse_args()
    for path in args.scenes:
        scene = load_scene(path)
        for seed in range(args.seeds):
            options = OneOptions(seed=seed)
            errors: dict[str, list[dict[str, float]]] = {}
            for trial in range(args.trials):
                truth, rough = draw_trial(scene, options, trial)
                start = from_global(rough, options)
                for method in ("rs-star", "constant-motion"):
                    errors.setdefault(method, []).append(solved(start, truth, method, options))
                errors.setdefault("oracle", []).append(oracle(truth, options))
                turning = replace(options, translation=0.0)
                truth, rough = draw_trial(scene, turning, trial)
                errors.setdefault("noise_of_rs_star", []).append(
                    solved(from_global(rough, turning), truth, "rs-star", turning)
                )
            medians = {m: {k: float(np.median([e[k] for e in all_])) for k in METRICS} for m, all_ in errors.items()}
            ratios = {
                name: {k: round(medians["rs-star"][k] / medians[method][k], 1) for k in METRICS}
                for name, method in (("ratio_reached", "constant-motion"), ("ratio_limit", "oracle"))
            }
            rounded = {m: {k: round(v, 5) for k, v in each.items()} for m, each in medians.items()}
            print(
                json.dumps({"scene": scene.name, "seed": seed, "trials": args.trials, **ratios, **rounded}), flush=True
            )


if __name__ == "__main__":
    main()
