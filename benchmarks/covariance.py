"""Predicted standard deviations against Monte Carlo: prints one JSON object a line.

    python benchmarks/covariance.py [--trials N]

Measurements of the points of sample_scenes/courtyard with 0.5 px of noise, drawn anew in each trial; all trials start
at the truth, so their gauge is the same: the pose of one photo and one coordinate of the farthest centre are held
there. `phi` and `centres`: standard deviation over the trials by the predicted one; root mean square and range over all
free components (of 200 trials, each has a standard error of 5 %).

Then errors by the deviations that are reported (`BundleOptions.deviations`): root mean square over `--few` trials of
phi, of their mean over the photos, of the height of the scene (log k) and of the centres. The noise is as said, half as
large again, or comes with smooth errors of its own size: of the lens, the same in all photos, in waves of a photo's
width or two, or of the scene, others in each photo. The priors' standard deviations are estimated; `phi_mrad` is the
error of phi per frame, `factor` by how much more than 0.5 px the noise was that weighed the measurements against the
priors.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, bundle_adjust, read_solution
from rsundistort.bundle import Posterior
from rsundistort.critical.cost import _log_scale

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
    """Standard deviation over trials by the predicted one, of the free components of phi and of the centres."""
    exact = courtyard(model)
    # priors that weigh nothing: with them the standard deviation of the estimates is not the posterior's. The noise is
    # independent and known: the jackknife, which has to allow for other noise, would say a sixth more
    options = BundleOptions(
        loss="squared", outlier_rounds=0, prior_sigma_rounds=0, sigma_px=NOISE_PX, phi_sigma=1e3, velocity_sigma=1e3,
        deviations="model",
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


def _waves(places: NDArray[np.float64], length: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """(o, 2) smooth random displacements of unit variance at places (o, d), Gaussian covariance of a length."""
    k, phase = rng.normal(0, 1 / length, (60, places.shape[1])), rng.uniform(0, 2 * np.pi, (2, 1, 60))
    return np.einsum("aoi,ai->oa", np.cos(places @ k.T + phase), rng.normal(0, np.sqrt(2 / 60), (2, 60)))


def _of_lens(length: float) -> Callable[[Reconstruction, np.random.Generator], NDArray[np.float64]]:
    def errors(rec: Reconstruction, rng: np.random.Generator) -> NDArray[np.float64]:
        return _waves(rec.observations.xy_raw / rec.cameras[0].width, length, rng)

    return errors


def _of_scene(rec: Reconstruction, rng: np.random.Generator) -> NDArray[np.float64]:
    obs = rec.observations
    x = rec.points_w - np.median(rec.points_w, axis=0)
    size = np.linalg.norm(x, axis=1, keepdims=True)
    x = x / np.median(size) * np.minimum(1.0, 2 * np.median(size) / size)  # far points aside
    errors = np.empty((len(obs), 2))
    for i in range(rec.num_images):
        errors[obs.frame_idx == i] = _waves(x[obs.point_idx[obs.frame_idx == i]], 0.3, rng)
    return errors


#: What comes on top of independent noise, in units of it.
CASES: dict[str, Callable[[Reconstruction, np.random.Generator], Any]] = {
    "independent": lambda _rec, _rng: 0.0,
    "half as large again": lambda rec, rng: rng.normal(0, np.sqrt(1.25), (len(rec.observations), 2)),
    "lens, short waves": _of_lens(0.15),
    "lens, long waves": _of_lens(0.3),
    "scene": _of_scene,
}


def coverage(model: str, case: str, deviations: str, trials: int) -> dict[str, float]:
    """Root mean square errors by their reported deviations."""
    exact = courtyard(model)
    options = BundleOptions(loss="squared", outlier_rounds=0, sigma_px=NOISE_PX, deviations=deviations)
    obs, m, height = exact.observations, exact.num_images, _log_scale(exact)
    squares: list[dict[str, float]] = []
    for trial in range(trials):
        rng = np.random.default_rng(trial)
        noise = NOISE_PX * (rng.normal(size=obs.xy_raw.shape) + CASES[case](exact, rng))
        start = replace(exact, observations=replace(obs, xy_raw=obs.xy_raw + noise))
        result = bundle_adjust(start, model, options)
        rec, posterior = result.reconstruction, Posterior(result, options)
        phi, center, points = rec.phi - exact.phi, rec.center_w - exact.center_w, rec.points_w - exact.points_w
        mean = np.zeros((3, *result.covariances.shape[:2]))
        mean[:, :, 6:9] = np.eye(3)[:, None] / m
        of_mean = (mean * posterior.of_photos(mean)).sum((1, 2))
        of_center = np.diagonal(result.covariances, axis1=1, axis2=2)[:, 3:6]
        free = of_center > 0
        errors = {
            "phi": phi / result.sigma_phi,
            "mean_phi": phi.mean(0) / np.sqrt(of_mean),
            "log_k": (height * points).sum() / np.sqrt(posterior.of_points(height)[0]),
            "centres": center[free] / np.sqrt(of_center[free]),
            "phi_mrad": 1e3 * phi * exact.frame_span()[:, None],
            "factor": result.noise_factor,
        }
        if model == "constant-motion":
            errors["velocity"] = (rec.velocity - exact.velocity) / result.sigma_velocity
        squares.append({name: float(np.mean(np.square(value))) for name, value in errors.items()})
    return {name: round(float(np.sqrt(np.mean([each[name] for each in squares]))), 2) for name in squares[0]}


def main() -> None:
    """Both exact models."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--few", type=int, default=20)
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
    for model in ("rotation", "constant-motion"):
        for case in CASES:
            for deviations in ("model", "jackknife"):
                figures = coverage(model, case, deviations, args.few)
                name = f"coverage, {model}, {case}, {deviations}"
                print(json.dumps({"name": name, "trials": args.few, **figures, "target": "0.7 to 1.4"}), flush=True)


if __name__ == "__main__":
    main()
