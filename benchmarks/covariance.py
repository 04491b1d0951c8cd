"""Predicted standard deviations against Monte Carlo: prints one JSON object a line.

    python benchmarks/covariance.py [--trials N]

Measurements of the points of sample_scenes/courtyard with 0.5 px of noise, drawn anew in each trial; all trials start
at the truth, so their gauge is the same: the pose of one photo and one coordinate of the farthest centre are held
there. `phi` and `centres`: spread over the trials by predicted standard deviation; root mean square and range over all
free components (of 200 trials, each has a standard error of 5 %).
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, bundle_adjust, read_solution

SCENE = Path(__file__).resolve().parent.parent / "sample_scenes" / "courtyard"
NOISE_PX = 0.5


def courtyard(model: str) -> Reconstruction:
    """The truth with exact measurements."""
    truth = read_solution(SCENE / "ground_truth.json")
    with np.load(SCENE / "tracks.npz") as tracks:
        names = [str(name) for name in tracks["image_names"]]
        camera = Camera(int(tracks["width"]), int(tracks["height"]), tracks["K"])
        motions = [truth.image(name).motion for name in names]
        return Reconstruction(
            [camera], names, np.zeros(len(names), np.int64), tracks["R_cw"], tracks["center_w"], tracks["points_w"],
            Observations(tracks["frame_idx"], tracks["point_idx"], tracks["xy_raw"]),
            np.array([m.phi for m in motions if m is not None]),
            np.array([m.velocity for m in motions if m is not None]),
            model,
        )  # fmt: skip


def ratios(model: str, trials: int) -> dict[str, NDArray[np.float64]]:
    """Spread over trials by predicted standard deviation, of the free components of phi and of the centres."""
    exact = courtyard(model)
    # priors that weigh nothing: with them the spread of the estimates is not the posterior's
    options = BundleOptions(
        loss="squared", outlier_rounds=0, spread_rounds=0, sigma_px=NOISE_PX, phi_sigma=1e3, velocity_sigma=1e3
    )  # fmt: skip
    rng = np.random.default_rng(0)
    phi, centers, predicted = [], [], []
    for _ in range(trials):
        obs = exact.observations
        noisy = Observations(obs.frame_idx, obs.point_idx, obs.xy_raw + rng.normal(0, NOISE_PX, obs.xy_raw.shape))
        start = Reconstruction(
            exact.cameras, exact.image_names, exact.camera_idx, exact.R_cw, exact.center_w, exact.points_w, noisy,
            exact.phi, exact.velocity, model,
        )  # fmt: skip
        result = bundle_adjust(start, model, options)
        phi.append(result.reconstruction.phi)
        centers.append(result.reconstruction.center_w)
        predicted.append(np.diagonal(result.covariances, axis1=1, axis2=2))
    sigma = np.sqrt(np.mean(predicted, axis=0))
    found = {}
    for name, values, first in (("phi", phi, 6), ("centres", centers, 3)):
        expected = sigma[:, first : first + 3]
        free = expected > 0
        found[name] = np.std(values, axis=0, ddof=1)[free] / expected[free]
    return found


def main() -> None:
    """Both exact models."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    args = parser.parse_args()
    for model in ("rotation", "constant-motion"):
        found = ratios(model, args.trials)
        figures = {
            name: {
                "rms": round(float(np.sqrt(np.mean(r**2))), 3),
                "range": [round(float(f(r)), 3) for f in (np.min, np.max)],
            }
            for name, r in found.items()
        }
        print(json.dumps({"name": f"covariance, {model}", "trials": args.trials, **figures, "target": "0.85 to 1.15"}))


if __name__ == "__main__":
    main()
