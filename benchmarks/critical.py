"""Critical motions on synthetic measurements: prints one JSON object a line.

    python benchmarks/critical.py [still] [nobody] [spread] [fountain] [nw-rsba] [--trials N]

`still`: the level cameras and points of sample_scenes/colonnade, random motions of 0.05 rad a frame, one photo (another
in each trial) still, which the tool is not given: how often `auto` picks it, or another that moved by less than 1 mrad,
and the error of the scene's vertical scale, beside that without remedy for both models.
`nobody`: eleven level photos that all moved: the error that the prior leaves, against its standard deviation / sqrt(m),
and how often it lies within two of the reported standard deviations.
`spread`: the reported standard deviation of log k against the scatter of k over the trials, for cameras that are level,
tilted by 5, 10 and 20 degrees, and with one photo rotated by 90.
`fountain`: ../shared/photos/fountain-small, photos that rotated and travelled but for the first: errors of phi and the
rectified photos against the true ones, as they are, with the photo that is found still, and with that named.
`nw-rsba`: degeneracy measure and sigma(log k) of that generator's problems (../shared/nw-rsba) by class, how many are
flagged, and the figures of benchmarks/nw_rsba.py with and without the remedy.

Measurements by `project_rows`, plain NumPy, with noise of 0.5 px. The vertical scale is that of the affine map that
takes the true points to the found ones best, along the mean y axis, against the root of the scale of area across it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
import nw_rsba
from scipy.spatial.transform import Rotation

from rsundistort import (
    BundleOptions,
    Camera,
    Observations,
    Reconstruction,
    RectifyOptions,
    RowMotion,
    RunOptions,
    SolveOptions,
    bundle_adjust,
    run,
)
from rsundistort.critical import heal, shape_cost, with_remedy
from rsundistort.critical.degeneracy import readout_axes
from rsundistort.evaluation import psnr
from rsundistort.solve import OutputOptions
from rsundistort.synthetic import project_rows

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
from critical_scenes import named_scene  # noqa: E402
from numpy_reference import project  # noqa: E402  (the paper's model, in plain NumPy)

NOISE_PX = 0.5
SIGMA_RAD = 0.05


def colonnade() -> Reconstruction:
    """Cameras, points and tracks of the sample scene, nothing measured, nothing moving."""
    with np.load(ROOT / "sample_scenes" / "colonnade" / "tracks.npz") as data:
        camera = Camera(int(data["width"]), int(data["height"]), data["K"])
        return Reconstruction(
            [camera],
            [str(name) for name in data["image_names"]],
            np.zeros(len(data["R_cw"]), np.int64),
            data["R_cw"],
            data["center_w"],
            data["points_w"],
            Observations(data["frame_idx"], data["point_idx"], np.zeros((len(data["frame_idx"]), 2))),
        )


def with_motion(scene: Reconstruction, rng: np.random.Generator, still: int | None, model: str) -> Reconstruction:
    """The scene with random motions and noisy measurements.

    With a still photo, the paper's motions: an axis uniform on the sphere, a normal angle. Else every component of phi
    is normal, with the same standard deviation: what a reported standard deviation assumes.
    """
    m = scene.num_images
    phi = rng.normal(0, SIGMA_RAD / np.sqrt(3), (m, 3))
    if still is not None:
        axis = rng.normal(size=(m, 3))
        phi = rng.normal(0, SIGMA_RAD, (m, 1)) * axis / np.linalg.norm(axis, axis=1, keepdims=True)
        phi[still] = 0.0
    phi /= scene.frame_span()[:, None]
    truth = replace(scene, phi=phi, shutter_model=model)
    return measured(truth, rng)


def measured(truth: Reconstruction, rng: np.random.Generator) -> Reconstruction:
    """The truth with new noise; measurements outside of the photo stay."""
    obs = truth.observations
    xy = np.zeros((len(obs), 2))
    for i in range(truth.num_images):
        mine = obs.frame_idx == i
        points = truth.points_w[obs.point_idx[mine]]
        motion = RowMotion(truth.phi[i])
        if truth.shutter_model == "two-step":
            camera = truth.camera(i)
            xy[mine] = project(
                points, truth.R_cw[i], truth.center_w[i], truth.phi[i], "two-step", camera.readout, camera.K, [],
                np.zeros(3),
            )  # fmt: skip
        else:
            xy[mine] = project_rows(points, truth.R_cw[i], truth.center_w[i], motion, truth.camera(i))[0]
    good = np.isfinite(xy).all(1)
    noisy = xy[good] + rng.normal(0, NOISE_PX, (int(good.sum()), 2))
    observations = Observations(obs.frame_idx[good], obs.point_idx[good], noisy)
    return replace(truth, observations=observations).with_points(np.ones(int(good.sum()), bool))


def start_of(truth: Reconstruction, rng: np.random.Generator) -> Reconstruction:
    """A rough global-shutter start."""
    turn = Rotation.from_rotvec(0.005 * rng.normal(size=(truth.num_images, 3))).as_matrix()
    return replace(
        truth,
        R_cw=turn @ truth.R_cw,
        center_w=truth.center_w + 0.02 * truth.baseline * rng.normal(size=truth.center_w.shape),
        points_w=truth.points_w + 0.02 * truth.baseline * rng.normal(size=truth.points_w.shape),
        phi=np.zeros_like(truth.phi),
        shutter_model="global",
    )


def log_vertical_scale(found: Reconstruction, truth: Reconstruction) -> float:
    """Log k of the found points against the true ones; the two have the same points."""
    axes = readout_axes(truth.R_cw, ["top-to-bottom"] * truth.num_images)
    vertical = np.linalg.eigh(axes.T @ axes)[1][:, -1]
    x = truth.points_w - truth.points_w.mean(0)
    y = found.points_w - found.points_w.mean(0)
    B = np.linalg.lstsq(x, y, rcond=None)[0].T
    along = np.linalg.norm(B @ vertical)
    return float(np.log(along / np.sqrt(abs(np.linalg.det(B)) / along)))


def options_of(remedy: str) -> BundleOptions:
    """Clean measurements of known noise."""
    return with_remedy(BundleOptions(loss="squared", outlier_rounds=0, sigma_px=NOISE_PX), remedy)


def solved(truth: Reconstruction, rng: np.random.Generator, model: str, remedy: str) -> tuple[Any, Any]:
    """The healed solution and what was done."""
    options = options_of(remedy)
    result = bundle_adjust(start_of(truth, rng), model, options, simpler_first=True)
    return heal(result, options, remedy)


def trial_still(trial: int) -> dict[str, Any]:
    """One random motion with one still photo."""
    numba.set_num_threads(1)
    rng = np.random.default_rng([5, trial])
    scene = colonnade()
    still = int(rng.integers(scene.num_images))
    truth = with_motion(scene, rng, still, "rotation")
    moved = np.linalg.norm(truth.phi, axis=1) * truth.frame_span()
    out: dict[str, Any] = {}
    for name, model, remedy in (
        ("auto", "rotation", "auto"),
        ("none", "rotation", "none"),
        ("none, two-step", "two-step", "none"),
    ):
        result, done = solved(truth, np.random.default_rng([6, trial]), model, remedy)
        error = log_vertical_scale(result.reconstruction, truth)
        out[name] = {"error": error, "sigma": done.after.sigma_log_k, "meter": done.after.degeneracy.value}
        if name == "auto":
            picked = [truth.image_names.index(anchor) for anchor in done.anchors]
            out["picked"] = bool(picked) and moved[picked[0]] < 1e-3
            out["remedy"] = done.name
    return out


def trial_nobody(trial: int) -> dict[str, Any]:
    """Eleven level photos, all of which moved."""
    numba.set_num_threads(1)
    rng = np.random.default_rng([7, trial])
    truth = with_motion(named_scene("parallel", 11, num_points=300, seed=trial), rng, None, "rotation")
    result, done = solved(truth, rng, "rotation", "auto")
    return {
        "error": log_vertical_scale(result.reconstruction, truth),
        "sigma": done.after.sigma_log_k,
        "remedy": done.name,
    }


def trial_spread(arguments: tuple[str, str, int]) -> tuple[float, float]:
    """Log k and its reported standard deviation in one trial of a scene."""
    numba.set_num_threads(1)
    kind, model, trial = arguments
    scene = named_scene(kind, num_points=300)
    # the motion is drawn from the prior in each trial: the posterior's standard deviation is that of the errors over
    # both
    rng = np.random.default_rng([9, trial])
    truth = with_motion(scene, rng, None, model)
    options = replace(options_of("prior"), phi_sigma=SIGMA_RAD / np.sqrt(3))
    result = bundle_adjust(start_of(truth, rng), model, options, simpler_first=True)
    return log_vertical_scale(result.reconstruction, truth), shape_cost(result, options).sigma_log_k


def percent(values: Any) -> float:
    return round(100 * float(values), 3)


def show_still(pool: ProcessPoolExecutor, trials: int) -> None:
    """Print the figures of `still`."""
    found = list(pool.map(trial_still, range(trials)))
    figures = {}
    for name in ("auto", "none", "none, two-step"):
        errors = np.abs([each[name]["error"] for each in found])
        covered = np.mean(errors <= 2 * np.array([each[name]["sigma"] for each in found]))
        figures[name] = {
            "median_percent": percent(np.median(errors)),
            "worst_percent": percent(errors.max()),
            "within_two_sigma": round(float(covered), 3),
            "median_sigma_percent": percent(np.median([each[name]["sigma"] for each in found])),
        }
    print(
        json.dumps(
            {
                "name": "colonnade, one photo still",
                "trials": trials,
                "picked_still": round(float(np.mean([each["picked"] for each in found])), 3),
                "remedies": {r: sum(each["remedy"] == r for each in found) for r in {e["remedy"] for e in found}},
                **figures,
                "target": "picked >= 0.9; auto: median <= 0.5 %, worst <= 2 %",
            }
        ),
        flush=True,
    )


def show_nobody(pool: ProcessPoolExecutor, trials: int) -> None:
    """Print the figures of `nobody`."""
    found = list(pool.map(trial_nobody, range(trials)))
    errors = np.abs([each["error"] for each in found])
    sigma = np.array([each["sigma"] for each in found])
    # median of |x| of a normal variable is 0.6745 sigma
    theory = 0.6745 * SIGMA_RAD / np.sqrt(3) / np.sqrt(11) / (720 / 900)
    print(
        json.dumps(
            {
                "name": "eleven level photos, all moved",
                "trials": trials,
                "median_percent": percent(np.median(errors)),
                "theory_percent": percent(theory),
                "ratio": round(float(np.median(errors)) / theory, 3),
                "within_two_sigma": round(float(np.mean(errors <= 2 * sigma)), 3),
                "remedies": {r: sum(each["remedy"] == r for each in found) for r in {e["remedy"] for e in found}},
                "target": "ratio <= 1.3, within two sigma 0.90 to 0.99",
            }
        ),
        flush=True,
    )


def show_spread(pool: ProcessPoolExecutor, trials: int) -> None:
    """Print the figures of `spread`."""
    for kind in ("parallel", "5 degrees", "10 degrees", "20 degrees", "one portrait"):
        for model in ("two-step", "rotation"):
            found = np.array(list(pool.map(trial_spread, [(kind, model, t) for t in range(trials)])))
            spread = float(np.sqrt(np.mean(found[:, 0] ** 2)))
            predicted = float(np.sqrt(np.mean(found[:, 1] ** 2)))
            print(
                json.dumps(
                    {
                        "name": f"sigma(log k), {kind}, {model}",
                        "trials": trials,
                        "predicted_percent": percent(predicted),
                        "spread_percent": percent(spread),
                        "ratio": round(predicted / spread, 3),
                        "target": "0.8 to 1.2",
                    }
                ),
                flush=True,
            )


def show_fountain(_pool: ProcessPoolExecutor, _trials: int) -> None:
    """Print the figures of `fountain`."""
    folder = ROOT.parent / "shared" / "photos" / "fountain-small"
    if not folder.is_dir():
        print(json.dumps({"name": "fountain", "skipped": "no such photos beside the project"}))
        return
    truth = json.loads((folder / "truth.json").read_text())
    first = min(truth)
    for name, more in (
        ("the prior alone", {"remedy": "prior"}),
        ("auto", {}),
        ("auto, the first photo left out", {"without": first}),
        (f"{first} named", {"still": {first: 0.5e-3}}),
    ):
        with tempfile.TemporaryDirectory() as work:
            photos = Path(work) / "photos"
            shutil.copytree(folder / "rs", photos)
            if "without" in more:
                (photos / more.pop("without")).unlink()
            options = RunOptions(
                camera=str(folder / "camera.json"), rectify=RectifyOptions(depth="points"),
                outputs=OutputOptions(report=False), solve=SolveOptions(**more),
            )  # fmt: skip
            out = Path(work) / "out"
            found = run(photos, out, options)
            db = [
                psnr(
                    cv2.imread(str(out / "images" / image.name)),
                    cv2.imread(str(folder / "gs" / image.name)),
                    cv2.imread(str(out / "masks" / image.name.replace(".jpg", ".png")), cv2.IMREAD_GRAYSCALE),
                )
                for image in found.registered
            ]
        off = np.array([image.motion.phi - truth[image.name]["phi"] for image in found.registered])
        off *= 1e3 * found.cameras[found.registered[0].camera_id].frame_span
        common = found.critical_motion["common_motion"]
        print(
            json.dumps(
                {
                    "name": f"fountain, {name}",
                    "anchors": found.critical_motion["anchors"],
                    "phi_off_mean_mrad": off.mean(0).round(2).tolist(),
                    "phi_off_rms_mrad": np.sqrt((off**2).mean(0)).round(2).tolist(),
                    "reported_mrad": [round(1e3 * s, 2) for s in common["sigma_phi_rad_per_frame"]],
                    "median_db": round(float(np.median(db)), 2),
                    "target": ">= 36 dB",
                }
            ),
            flush=True,
        )


def show_outsider(_pool: ProcessPoolExecutor, _trials: int) -> None:
    """Print the figures of `nw-rsba`."""
    folder = ROOT.parent / "shared" / "nw-rsba"
    if not folder.is_dir():
        print(json.dumps({"name": "nw-rsba", "skipped": "no such problems beside the project"}))
        return
    for name in nw_rsba.CLASSES:
        with np.load(folder / f"{name}.npz") as file:
            arrays = {key: file[key] for key in file.files}
        costs, before, after = [], [], []
        for k in range(len(arrays["K"])):
            result = bundle_adjust(nw_rsba.problem(arrays, k), "constant-motion", simpler_first=True)
            healed, done = heal(result, BundleOptions())
            costs.append(done.before)
            before.append(nw_rsba.errors(result.reconstruction, arrays, k))
            after.append(nw_rsba.errors(healed.reconstruction, arrays, k))
        values = [cost.degeneracy.value for cost in costs]
        sigmas = [cost.sigma_log_k for cost in costs]
        print(
            json.dumps(
                {
                    "name": f"nw-rsba {name}",
                    "flagged": f"{sum(cost.is_flagged for cost in costs)}/{len(costs)}",
                    "meter": [round(min(values), 3), round(max(values), 3)],
                    "sigma_percent": [percent(min(sigmas)), percent(max(sigmas))],
                    "points_rotation_centres": {
                        "none": np.median(before, axis=0).round(4).tolist(),
                        "auto": np.median(after, axis=0).round(4).tolist(),
                    },
                    "target": "all near-parallel and parallel, no general problem flagged; nothing worse",
                }
            ),
            flush=True,
        )


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {
        "still": (show_still, 50),
        "nobody": (show_nobody, 100),
        "spread": (show_spread, 200),
        "fountain": (show_fountain, 0),
        "nw-rsba": (show_outsider, 0),
    }
    parser.add_argument("parts", nargs="*", choices=[[], *parts], default=list(parts))
    parser.add_argument("--trials", type=int)
    args = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        for name in args.parts:
            show, trials = parts[name]
            show(pool, args.trials or trials)


if __name__ == "__main__":
    main()
