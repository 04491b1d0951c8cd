"""Bundle adjustment against pycolmap's, and its growth with the problem: prints one JSON object a line.

    python benchmarks/bundle.py [--layout street block] [--sizes 40000 1000000] [--models ...] [--repeat N] [--scale]
    python benchmarks/bundle.py --covariances

Synthetic problems of a given number of observations, 2000 a photo, tracks of six on average: a street (cameras along a
line, facades on both sides) and a block (a grid of aerial photos). Measured by `project_rows`, plain NumPy that shares
nothing with the kernels.

Time per Levenberg-Marquardt iteration of ours, against pycolmap's bundle adjustment (global shutter, six unknowns a
photo, Ceres) on the same observations, both on two threads, each in a process of its own, by turns; medians. Peak
memory is that of the whole process with its libraries (VmHWM: ru_maxrss of a young process is its parent's), and beside
it what lies above these (`libraries_mb`: ours, pycolmap's). `floor_s`: the larger of the bytes that an iteration must
move over this machine's copying speed and of its multiply-adds over this machine's matrix product, both measured in the
same run. `ours_processor_us` is the time of all processors per iteration and observation, which neighbours on the
machine hardly change; `cg_iterations` are those of each step, if it was not factored. Exits 1 if one crashes, never
because a noisy figure misses its target.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

ITERATIONS = 6
PER_PHOTO, TRACK = 2000, 6.0
TARGETS = {"two-step": 0.6, "rotation": 0.6, "constant-motion": 0.9}
SCALE_SIZES = [100_000, 300_000, 1_000_000, 2_000_000, 5_000_000]
WIDTH, HEIGHT, FOCAL = 1000, 750, 1000.0


def street(num_photos: int, num_points: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """Poses a metre apart, looking ahead and to either side by turns; points on two facades 10 m away."""
    along = np.arange(num_photos) * 1.0
    centers = np.column_stack([along, np.zeros((num_photos, 2))]) + rng.normal(0, 0.05, (num_photos, 3))
    side = np.where(np.arange(num_photos) % 2, 1.0, -1.0) * np.deg2rad(50) + rng.normal(0, 0.03, num_photos)
    ahead = np.column_stack([np.cos(side), np.sin(side), np.zeros(num_photos)])
    points = np.column_stack(
        [
            rng.uniform(0, num_photos + 20, num_points),
            rng.choice([-10.0, 10.0], num_points) + rng.normal(0, 1, num_points),
            rng.uniform(-3, 3, num_points),
        ]
    )
    return centers, ahead, np.array([0.0, 0.0, -1.0]), points, 40.0


def block(num_photos: int, num_points: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """Nadir photos from 100 m, 80 % overlap along the strips and 60 % across; hills of 10 m."""
    strips = max(1, round(np.sqrt(num_photos * 15 / 40)))
    number = np.arange(num_photos)
    centers = np.column_stack([(number // strips) * 15.0, (number % strips) * 40.0, np.full(num_photos, 100.0)])
    centers += rng.normal(0, 0.5, centers.shape)
    ahead = np.array([0.0, 0.0, -1.0]) + np.column_stack([rng.normal(0, 0.02, (num_photos, 2)), np.zeros(num_photos)])
    edge = np.array([30.0, 40.0])
    low, high = centers[:, :2].min(0) - edge, centers[:, :2].max(0) + edge
    points = np.column_stack([rng.uniform(low, high, (num_points, 2)), rng.normal(0, 5, num_points)])
    return centers, ahead, np.array([-1.0, 0.0, 0.0]), points, 70.0


def make_problem(layout: str, size: int, seed: int = 0) -> Any:
    """A rough start with measurements of the truth, noise 0.5 px."""
    from rsundistort import Camera, Observations, Reconstruction, RowMotion
    from rsundistort.synthetic import project_rows

    rng = np.random.default_rng([seed, size])
    m = max(4, round(size / PER_PHOTO))
    n = round(size / TRACK * (1 + 20 / m if layout == "street" else 1))
    centers, ahead, down, points, reach = {"street": street, "block": block}[layout](m, n, rng)
    camera = Camera(WIDTH, HEIGHT, [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    right = np.cross(np.broadcast_to(down, ahead.shape), ahead)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R_cw = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    phi = rng.normal(0, 0.01, (m, 3))
    step = np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1))
    velocity = rng.normal(0, 0.01 * step, (m, 3))
    order = np.argsort(points[:, 0])
    sorted_x = points[order, 0]
    frame, point, xy = [], [], []
    for i in range(m):
        first, last = np.searchsorted(sorted_x, centers[i, 0] + np.array([-reach, reach]))
        some = order[first:last]
        # far outside the photo the rows' fixed point crawls: leave those out first
        q = (points[some] - centers[i]) @ R_cw[i].T
        some = some[(q[:, 2] > 1) & (np.abs(q[:, :2]) < 0.6 * q[:, 2:]).all(1)]
        uv, valid = project_rows(points[some], R_cw[i], centers[i], RowMotion(phi[i], velocity[i]), camera)
        inside = valid & (uv >= 0).all(1) & (uv <= [WIDTH - 1, HEIGHT - 1]).all(1)
        if layout == "street":  # the far end of a street is too small to be matched
            inside &= np.linalg.norm(points[some] - centers[i], axis=1) < 25
        chosen = np.flatnonzero(inside)
        chosen = rng.permutation(chosen)[:PER_PHOTO]
        frame.append(np.full(len(chosen), i))
        point.append(some[chosen])
        xy.append(uv[chosen] + rng.normal(0, 0.5, (len(chosen), 2)))
    truth = Reconstruction(
        cameras=[camera],
        image_names=[f"{i:06d}.jpg" for i in range(m)],
        camera_idx=np.zeros(m, np.int64),
        R_cw=R_cw,
        center_w=centers,
        points_w=points,
        observations=Observations(np.concatenate(frame), np.concatenate(point), np.concatenate(xy)),
        shutter_model="global",
    )
    truth = truth.take_points(truth.track_lengths(np.ones(len(truth.observations), bool)) >= 2)
    from dataclasses import replace

    return replace(
        truth,
        R_cw=Rotation.from_rotvec(rng.normal(0, 0.003, (m, 3))).as_matrix() @ truth.R_cw,
        center_w=truth.center_w + rng.normal(0, 0.02 * step, (m, 3)),
        points_w=truth.points_w + rng.normal(0, 0.02 * step, truth.points_w.shape),
    )


def save(folder: Path, rec: Any, peer: bool) -> None:
    """The problem as both processes read it."""
    obs = rec.observations
    np.savez(
        folder / "problem.npz", R_cw=rec.R_cw, center_w=rec.center_w, points_w=rec.points_w, frame_idx=obs.frame_idx,
        point_idx=obs.point_idx, xy=obs.xy_raw,
    )  # fmt: skip
    if peer:
        from rsundistort.colmap import write_colmap_model

        write_colmap_model(folder / "model", rec, rec.cameras, rec.image_names)


def ours(folder: Path, model: str, repeat: int) -> dict[str, Any]:
    """Time per iteration of our solver, in this process."""
    from rsundistort import BundleOptions, Camera, Observations, Reconstruction
    from rsundistort.bundle import elimination
    from rsundistort.bundle.prior_sigmas import PriorSigmas
    from rsundistort.bundle.problem import BundleProblem
    from rsundistort.bundle.solver import minimize

    def problem(rec: Any, **options: Any) -> Any:
        return BundleProblem(rec, model, BundleOptions(loss="squared", **options), 0.5, PriorSigmas(0.03, 0.3))

    def solve(problem: Any) -> Any:
        return minimize(
            problem, problem.initial_state(), max_iterations=ITERATIONS, cost_tolerance=1e-300, step_tolerance=1e-300,
            initial_damping=1e-4, max_damping=1e12,
        )  # fmt: skip

    small = make_problem("street", 8_000)
    for factor_limit in (None, -1.0):  # compile (once per installation) and load
        solve(problem(small, factor_limit=factor_limit))
    if folder.name == "none":
        return {}
    loaded = peak_mb()
    data = dict(np.load(folder / "problem.npz"))
    camera = Camera(WIDTH, HEIGHT, [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    m = len(data["R_cw"])
    rec = Reconstruction(
        cameras=[camera],
        image_names=[f"{i:06d}.jpg" for i in range(m)],
        camera_idx=np.zeros(m, np.int64),
        R_cw=data["R_cw"],
        center_w=data["center_w"],
        points_w=data["points_w"],
        observations=Observations(data["frame_idx"], data["point_idx"], data.pop("xy")),
        shutter_model="global",
    )
    searches: list[int] = []
    search = elimination.solve_iteratively

    def counted(*args: Any) -> Any:
        found = search(*args)
        searches.append(found.num_iterations if found else 0)
        return found

    elimination.solve_iteratively = counted
    times, setups, processor = [], [], []
    for _ in range(repeat):
        searches.clear()
        began = time.perf_counter()
        made = problem(rec)
        ready, spent = time.perf_counter(), time.process_time()
        result = solve(made)
        times.append((time.perf_counter() - ready) / result.num_iterations)
        processor.append((time.process_time() - spent) / result.num_iterations)
        setups.append(ready - began)
        del made
    return {
        "iteration_s": statistics.median(times),
        "processor_s": statistics.median(processor),
        "cg_iterations": list(searches),
        "setup_s": statistics.median(setups),
        "loaded_mb": loaded,
        "cost": [float(result.cost_history[0]), float(result.cost_history[-1])],
        "iterations": result.num_iterations,
    }


def peer(folder: Path, repeat: int) -> dict[str, Any]:
    """Time per iteration of pycolmap's, in this process: Ceres' minimiser without its set-up."""
    import pycolmap

    pycolmap.logging.minloglevel = 2
    loaded = peak_mb()
    times, setups = [], []
    for _ in range(repeat):
        began = time.perf_counter()
        model = pycolmap.Reconstruction(folder / "model")
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length = options.refine_extra_params = options.refine_principal_point = False
        options.print_summary = False
        solver = options.ceres.solver_options
        solver.max_num_iterations, solver.num_threads = ITERATIONS, 2
        solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = 0.0
        options.ceres.solver_options = solver
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in model.reg_image_ids():
            config.add_image(image_id)
        for camera_id in model.cameras:
            config.set_constant_cam_intrinsics(camera_id)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        summary = pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve().ceres_summary
        steps = summary.num_successful_steps + summary.num_unsuccessful_steps
        steps -= 1  # the start counts as a successful step
        times.append(summary.minimizer_time_in_seconds / steps)
        setups.append(time.perf_counter() - began - summary.minimizer_time_in_seconds)
    return {
        "iteration_s": statistics.median(times),
        "setup_s": statistics.median(setups),
        "loaded_mb": loaded,
        "cost": [summary.initial_cost, summary.final_cost],
        "iterations": steps,
        "linear_solver": summary.linear_solver_type_used.name,
        "threads": summary.num_threads_used,
        "num_residuals": summary.num_residuals_reduced,
    }


def peak_mb() -> float:
    """Largest resident memory that this process had."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def worker(arguments: list[str]) -> dict[str, Any]:
    """Run one measurement in a process of its own; its figures and its peak memory."""
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    command = [sys.executable, str(Path(__file__).resolve()), "--worker", *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=environment)
    figures: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return figures


def machine() -> tuple[float, float]:
    """Bytes a second that copying moves (read and written) and multiply-adds a second of a matrix product."""
    import numba

    @numba.njit(parallel=True)
    def copy(a: Any, b: Any) -> None:
        for i in numba.prange(len(a)):
            b[i] = a[i]

    a, b = np.ones(20_000_000), np.ones(20_000_000)
    square = np.ones((1500, 1500))
    copy(a, b)
    fastest = [np.inf, np.inf]
    for _ in range(5):
        began = time.perf_counter()
        copy(a, b)
        middle = time.perf_counter()
        square @ square
        end = time.perf_counter()
        fastest = [min(fastest[0], middle - began), min(fastest[1], end - middle)]
    return 16.0 * len(a) / fastest[0], 1500.0**3 / fastest[1]


def floor(rec: Any, nb: int) -> tuple[float, float]:
    """Bytes and multiply-adds of one iteration, without factorisation and without what the row's clock costs.

    Bytes: measurement, sigma and indices (40) read twice, for Jacobians and for the cost; photo Jacobians and
    residuals (2 nb + 2 doubles; the point's are part of them) written once, read once for the reduced system and once
    for the points. Multiply-adds: U and V, and a rank-2 update of nb x nb for each pair of photos of a track.
    """
    obs = rec.observations
    lengths = np.bincount(obs.point_idx).astype(float)
    pairs = float((lengths * (lengths + 1) / 2).sum())
    o = len(obs)
    return o * (80.0 + 3 * 8 * (2 * nb + 2)), o * (nb * (nb + 1) + 12.0) + pairs * (2 * nb * nb + 4 * nb)


def covariances() -> None:
    """Time of the covariances of blocks of photos, over that of the solution of the same system for every unknown."""
    from rsundistort import BundleOptions
    from rsundistort.bundle.prior_sigmas import PriorSigmas
    from rsundistort.bundle.problem import BundleProblem

    for photos in (30, 125, 500):
        rec = make_problem("block", PER_PHOTO * photos)
        problem = BundleProblem(rec, "rotation", BundleOptions(loss="squared"), 0.5, PriorSigmas(0.03, 0.3))
        state = problem.initial_state()

        def timed(of_priors: bool, problem: Any = problem, state: Any = state) -> float:
            equations = problem.linearize(state)
            began = time.perf_counter()
            equations.marginal_covariances(of_priors=of_priors)
            return time.perf_counter() - began

        equations = problem.linearize(state)
        m, nb = rec.num_images, equations.blocks[1].shape[2]
        began = time.perf_counter()
        inverse = equations.inverse
        for part in np.array_split(np.eye(m * nb).reshape(-1, m, nb), max(m * nb // 192, 1)):
            inverse.times(part, np.zeros((len(part), inverse.cameras.shape[1])))
        whole = time.perf_counter() - began
        alone, with_priors = (min(timed(of_priors) for _ in range(3)) for of_priors in (False, True))
        figures = {"photos": rec.num_images, "covariances_s": round(alone, 4), "with_priors_s": round(with_priors, 4)}
        ratios = {"ratio": round(alone / whole, 3), "ratio_with_priors": round(with_priors / whole, 3)}
        print(json.dumps({"name": "covariances", **figures, "whole_inverse_s": round(whole, 3), **ratios}), flush=True)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--layout", nargs="+", default=["street", "block"], choices=["street", "block"])
    parser.add_argument("--sizes", nargs="+", type=int)
    parser.add_argument("--models", nargs="+", default=list(TARGETS), choices=[*TARGETS, "global"])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--scale", action="store_true", help="ours alone, from 1e5 to 5e6 observations")
    parser.add_argument("--no-peer", action="store_true")
    parser.add_argument("--covariances", action="store_true", help="their time instead, against the whole inverse")
    parser.add_argument("--worker", nargs="+", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        kind, folder, *rest = args.worker
        figures = ours(Path(folder), rest[0], int(rest[1])) if kind == "ours" else peer(Path(folder), int(rest[0]))
        figures["peak_mb"] = peak_mb()
        print(json.dumps(figures))
        return
    if args.covariances:
        covariances()
        return
    with_peer = not (args.scale or args.no_peer)
    for model in args.models:
        worker(["ours", "none", model, "1"])
    speed, rate = machine()
    print(json.dumps({"name": "machine", "copy_gb_s": round(speed / 1e9, 1), "multiply_adds_g_s": round(rate / 1e9)}))
    for layout in args.layout:
        for size in args.sizes or (SCALE_SIZES if args.scale else [40_000, 1_000_000]):
            rec = make_problem(layout, size)
            o = len(rec.observations)
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary)
                save(folder, rec, with_peer)
                for model in args.models:
                    nb = {"global": 6, "constant-motion": 12}.get(model, 9)
                    moved, adds = floor(rec, nb)
                    runs = []
                    for _ in range(args.repeat):
                        a = worker(["ours", str(folder), model, "1"])
                        runs.append((a, worker(["peer", str(folder), "1"]) if with_peer else a))
                    figures: dict[str, Any] = {
                        "name": f"bundle {layout} {model}",
                        "observations": o,
                        "photos": rec.num_images,
                        "points": rec.num_points,
                    }
                    middle = statistics.median
                    figures["ours_s"] = round(middle(a["iteration_s"] for a, _ in runs), 4)
                    figures["ours_us_per_observation"] = round(1e6 * figures["ours_s"] / o, 3)
                    figures["ours_processor_us"] = round(1e6 * middle(a["processor_s"] for a, _ in runs) / o, 3)
                    figures["cg_iterations"] = runs[0][0]["cg_iterations"]
                    figures["ours_peak_mb"] = round(middle(a["peak_mb"] for a, _ in runs))
                    figures["ours_setup_s"] = round(middle(a["setup_s"] for a, _ in runs), 2)
                    figures["floor_s"] = round(max(moved / speed, adds / rate), 4)
                    figures["floor"] = {"bytes": round(moved), "multiply_adds": round(adds)}
                    figures["cost"] = [round(v, 1) for v in runs[0][0]["cost"]]
                    if with_peer:
                        figures["peer_s"] = round(middle(b["iteration_s"] for _, b in runs), 4)
                        figures["peer_peak_mb"] = round(middle(b["peak_mb"] for _, b in runs))
                        figures["peer_setup_s"] = round(middle(b["setup_s"] for _, b in runs), 2)
                        figures["peer"] = {k: runs[0][1][k] for k in ("linear_solver", "threads", "iterations")}
                        # each run of ours against the run of the peer beside it: both saw the same neighbours
                        ratio = middle(a["iteration_s"] / b["iteration_s"] for a, b in runs)
                        figures["ratio"] = round(ratio, 3)
                        figures["memory_ratio"] = round(figures["ours_peak_mb"] / figures["peer_peak_mb"], 3)
                        # what the problem takes: above the libraries, with their kernels ready
                        above = [middle(run[k]["peak_mb"] - run[k]["loaded_mb"] for run in runs) for k in (0, 1)]
                        figures["libraries_mb"] = [round(middle(run[k]["loaded_mb"] for run in runs)) for k in (0, 1)]
                        figures["memory_ratio_above_libraries"] = round(above[0] / above[1], 3)
                        target = TARGETS.get(model)
                        figures["target"] = target
                        figures["ok"] = target is None or (ratio <= target and figures["memory_ratio"] <= 1)
                    print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
