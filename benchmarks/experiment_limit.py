"""How far from the best possible Experiment I ends: prints one JSON object for each scene and seed.

    python benchmarks/experiment_limit.py SCENE.npz [...] [--seeds N] [--trials N]

`oracle` starts the constant-motion model at the true parameters and gives it the true standard deviations of the
motion: the posterior mode under the very distribution that the motion was drawn from, which no estimator betters on
average (to second order in the noise). `ratio_reached` is the error of the paper's RS* over that of constant-motion,
which is given nothing and starts from the global-shutter solution; `ratio_limit` is RS* over the oracle: what any
method could reach. Medians over the trials. The same for the variant without translation and the rotation model
(`turning_...`).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import numpy as np

from rsundistort import bundle_adjust
from rsundistort.experiments import KnownScene, OneOptions, load_scene
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


def oracle(truth: Reconstruction, method: str, options: OneOptions) -> dict[str, float]:
    """Errors of a model from the truth, with the standard deviations that the motion was drawn with."""
    # the axis is uniform: a component has a third of the angle's variance
    given = replace(
        method_options(method, options),
        phi_sigma=options.rotation_rad / np.sqrt(3.0),
        velocity_sigma=max(options.translation, 1e-6),
    )
    return errors_of(bundle_adjust(truth, method, given).reconstruction, truth)


def trial_errors(scene: KnownScene, method: str, options: OneOptions, trial: int) -> dict[str, dict[str, float]]:
    """Errors of RS*, of a method, and of its oracle in one trial."""
    truth, rough = draw_trial(scene, options, trial)
    start = from_global(rough, options)
    found = {name: solved(start, truth, name, options) for name in ("rs-star", method)}
    return {**found, "oracle": oracle(truth, method, options)}


def ratios(errors: list[dict[str, dict[str, float]]], method: str) -> dict[str, dict[str, float]]:
    """Medians of RS* over those of the method and of its oracle, and the medians."""
    medians = {
        name: {k: float(np.median([trial[name][k] for trial in errors])) for k in METRICS}
        for name in ("rs-star", method, "oracle")
    }
    found = {
        f"ratio_{what}": {k: round(medians["rs-star"][k] / medians[name][k], 1) for k in METRICS}
        for what, name in (("reached", method), ("limit", "oracle"))
    }
    return found | {name: {k: round(v, 5) for k, v in each.items()} for name, each in medians.items()}


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
            turning = replace(options, translation=0.0)
            line = {"scene": scene.name, "seed": seed, "trials": args.trials}
            for prefix, method, chosen in (("", "constant-motion", options), ("turning_", "rotation", turning)):
                errors = [trial_errors(scene, method, chosen, trial) for trial in range(args.trials)]
                line |= {prefix + key: value for key, value in ratios(errors, method).items()}
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
