"""The paper's Experiment I: bundle adjustment of synthetic measurements with known rolling-shutter motion."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..batch.progress import ProgressCallback, StageLog
from ..bundle import BundleOptions, bundle_adjust, objective
from ..errors import FormatError, InputError
from ..evaluation import align_points, rotation_angles_deg
from ..io.aside import write_aside
from ..io.json_text import parse_json, read_json
from ..io.outputs import only_writer
from ..io.record import Record
from ..io.rules import Between, check
from ..model import Observations, Reconstruction, RowMotion
from ..report.figures import need_matplotlib
from ..synthetic import project_rows
from .plots import cumulative_histograms
from .scenes import KnownScene, load_scene

__all__ = ["METHODS", "OneOptions", "check_settings", "experiment_one", "read_trials", "summarize"]

#: Methods: shutter model, and whether the paper's constraint (phi1 of the first photo) is held. They have no prior.
METHODS: dict[str, tuple[str, bool]] = {
    "wo-rs": ("global", False),
    "rs": ("two-step", False),
    "rs-star": ("two-step", True),
    "rs-linearized": ("linearized", False),
    "rotation": ("rotation", False),
    "constant-motion": ("constant-motion", False),
}
_FILES = ("settings.json", "trials.jsonl", "summary.json", "summary.csv", "histograms.png")
_METRICS = ("rotation_deg", "translation", "structure")
# what is made of a line of trials.jsonl
_NUMBERS = (*_METRICS, "iterations", "seconds")
_LINE = {"scene": str, "trial": int, "method": str} | dict.fromkeys(_NUMBERS, Between(0.0, 1e300))
# no prior: a standard deviation of so many radians or baselines a frame
_FREE = 1e4


@dataclass(frozen=True)
class OneOptions:
    """Protocol of the experiment; the defaults are the paper's.

    Parameters
    ----------
    trials : int
        Trials a scene.
    methods : sequence of str
        Of `METHODS`.
    noise_px : float
        Standard deviation of the noise on u and v.
    rotation_rad : float
        Standard deviation of the rotation over the frame; its axis is uniform on the sphere.
    translation : float
        Standard deviation of each component of the translation over the frame, in baselines.
    start_rotation_deg, start_length : float
        How far the start of the global-shutter solution is from the truth: orientations, and centres and points in
        baselines.
    seed : int
        The same seed gives the same trials, whatever the number of jobs.
    jobs : int
        Processes; 0 for all cores.
    """

    trials: int = 100
    methods: Sequence[str] = tuple(METHODS)
    noise_px: float = 0.5
    rotation_rad: float = 0.05
    translation: float = 0.05
    start_rotation_deg: float = 0.5
    start_length: float = 0.02
    seed: int = 0
    jobs: int = 0

    def __post_init__(self) -> None:
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown or not self.methods:
            raise InputError(f"method {(unknown or ['none'])[0]!r}, expected some of {', '.join(METHODS)}")
        for name in ("noise_px", "rotation_rad", "translation", "start_rotation_deg", "start_length"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"{name}={getattr(self, name)!r}, expected a finite number, 0 or more")
        if not self.noise_px > 0:
            raise InputError("noise_px=0: the methods weigh measurements by their noise; give a positive one")
        if self.trials < 1 or self.jobs < 0:
            raise InputError("trials must be at least 1, jobs 0 or more")


def draw_motions(scene: KnownScene, options: OneOptions) -> list[RowMotion]:
    """Motions of a scene, drawn once for all its trials; the first photo has none."""
    rng = np.random.default_rng([options.seed, 0])
    span = scene.camera.frame_span
    motions = [RowMotion()]
    for _ in range(scene.num_images - 1):
        axis = rng.normal(size=3)
        angle = rng.normal(0, options.rotation_rad)
        velocity = rng.normal(0, options.translation, 3)
        motions.append(RowMotion(angle * axis / np.linalg.norm(axis) / span, velocity / span))
    return motions


def draw_trial(scene: KnownScene, options: OneOptions, trial: int) -> tuple[Reconstruction, Reconstruction]:
    """Truth with its noisy measurements, and where the global-shutter solution starts from."""
    motions = draw_motions(scene, options)
    exact = np.empty((len(scene.frame_idx), 2))
    valid = np.empty(len(scene.frame_idx), bool)
    for i, motion in enumerate(motions):
        mine = scene.frame_idx == i
        points = scene.points_w[scene.point_idx[mine]]
        exact[mine], valid[mine] = project_rows(points, scene.R_cw[i], scene.center_w[i], motion, scene.camera)
    rng = np.random.default_rng([options.seed, 1, trial])
    noisy = exact + rng.normal(0, options.noise_px, exact.shape)
    truth = Reconstruction(
        [scene.camera],
        [str(i) for i in range(scene.num_images)],
        np.zeros(scene.num_images, np.int64),
        scene.R_cw,
        scene.center_w,
        scene.points_w,
        Observations(scene.frame_idx[valid], scene.point_idx[valid], noisy[valid]),
        np.array([motion.phi for motion in motions]),
        np.array([motion.velocity for motion in motions]),
        "constant-motion",
    ).with_points(np.ones(int(valid.sum()), bool))
    rotation = Rotation.from_rotvec(np.radians(options.start_rotation_deg) * rng.normal(size=(scene.num_images, 3)))
    start = replace(
        truth,
        R_cw=rotation.as_matrix() @ truth.R_cw,
        center_w=truth.center_w + options.start_length * rng.normal(size=truth.center_w.shape),
        points_w=truth.points_w + options.start_length * rng.normal(size=truth.points_w.shape),
        phi=np.zeros_like(truth.phi),
        velocity=np.zeros_like(truth.velocity),
        shutter_model="global",
    )
    return truth, start


def method_options(method: str, options: OneOptions) -> BundleOptions:
    """Least squares with the protocol's noise; the paper's methods without priors, ours with estimated ones."""
    paper = method in ("wo-rs", "rs", "rs-star", "rs-linearized")
    return BundleOptions(
        loss="squared",
        outlier_rounds=0,
        sigma_px=options.noise_px,
        phi_sigma=_FREE if paper else None,
        velocity_sigma=_FREE if paper else None,
        held_phi={"0": (0,)} if METHODS[method][1] else {},
        max_iterations=200,
    )


def errors_of(found: Reconstruction, truth: Reconstruction) -> dict[str, float]:
    """Rotation, translation and structure errors as in the paper, lengths in baselines.

    All after the similarity that best aligns the camera centres; the rotation is the mean absolute angle.
    """
    scale, A, shift = align_points(found.center_w, truth.center_w)
    angles = rotation_angles_deg(np.einsum("mij,kj,mlk->mil", found.R_cw, A, truth.R_cw))
    centers = scale * found.center_w @ A.T + shift
    points = scale * found.points_w @ A.T + shift
    return {
        "rotation_deg": float(angles.mean()),
        "translation": float(np.linalg.norm(centers - truth.center_w, axis=1).mean()),
        "structure": float(np.linalg.norm(points - truth.points_w, axis=1).mean()),
    }


def run_trial(scene: KnownScene, options: OneOptions, trial: int) -> list[dict[str, Any]]:
    """One line of `trials.jsonl` for each method."""
    truth, rough = draw_trial(scene, options, trial)
    start = bundle_adjust(
        rough, "global", replace(method_options("wo-rs", options), cost_tolerance=1e-6)
    ).reconstruction
    lines = []
    for method in options.methods:
        model = METHODS[method][0]
        began = time.perf_counter()
        chosen = method_options(method, options)
        result = bundle_adjust(rough if method == "wo-rs" else start, model, chosen)
        seconds = time.perf_counter() - began
        # the method's own cost of the true parameters, with the prior standard deviations it ended with
        final = replace(
            chosen, phi_sigma=result.phi_rms, velocity_sigma=max(result.velocity_rms, 1e-9), prior_sigma_rounds=0
        )  # fmt: skip
        true_cost = objective(truth, model, final)
        lines.append(
            {
                "scene": scene.name,
                "trial": trial,
                "method": method,
                **errors_of(result.reconstruction, truth),
                "iterations": result.num_iterations,
                "seconds": round(seconds, 3),
                "stop_reason": result.stop_reason,
                "cost": objective(result.reconstruction, model, final),
                "true_cost": true_cost,
                "phi_sigma": result.phi_sigma,
                "velocity_sigma": result.velocity_sigma,
            }
        )
    return lines


def read_trials(path: Path) -> dict[tuple[str, int, str], dict[str, Any]]:
    """Lines of an earlier run by scene, trial and method; what is cut short or damaged is left out, to be run again."""
    found = {}
    if path.is_file():
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                entry = parse_json(line)
                check(entry, _LINE)
            except ValueError:
                continue
            found[entry["scene"], entry["trial"], entry["method"]] = entry
    return found


def _cut_torn_line(path: Path) -> None:
    """Cut off what a crash left of a line: the next one must not continue it."""
    if path.is_file():
        os.truncate(path, path.read_bytes().rfind(b"\n") + 1)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started within have one thread each: as many as cores would wait for each other with more."""
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def summarize(entries: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> dict[str, Any]:
    """Medians and 90th percentiles by scene and method."""
    summary: dict[str, Any] = {}
    for scene in dict.fromkeys(entry["scene"] for entry in entries):
        summary[scene] = {}
        for method in methods:
            mine = [entry for entry in entries if (entry["scene"], entry["method"]) == (scene, method)]
            if mine:
                summary[scene][method] = {
                    key: {
                        "median": float(np.median([entry[key] for entry in mine])),
                        "p90": float(np.percentile([entry[key] for entry in mine], 90)),
                    }
                    for key in _NUMBERS
                }
    return summary


def experiment_one(
    scenes: Sequence[Path | str],
    out: Path | str,
    options: OneOptions | None = None,
    progress: ProgressCallback | None = None,
) -> dict[str, Any]:
    """Run the trials and write `settings.json`, `trials.jsonl`, `summary.json`, `summary.csv` and `histograms.png`.

    Trials that `out` already holds, of the same settings, are not run again.

    Parameters
    ----------
    scenes : sequence of path
        As `load_scene` takes them.

    Returns
    -------
    dict
        As in `summary.json`: scene, method, metric, median and p90.
    """
    options = options or OneOptions()
    loaded = [load_scene(path) for path in scenes]
    names = [scene.name for scene in loaded]
    if len(set(names)) != len(names):
        raise InputError(f"two scenes are called {max(names, key=names.count)!r}; rename one")
    # before the hours of work, not after them
    need_matplotlib()
    out = Path(out)
    with only_writer(out):
        # those that the result of a trial depends on
        settings = {k: v for k, v in asdict(options).items() if k not in ("jobs", "trials", "methods")}
        digests = {scene.name: scene.digest for scene in loaded}
        known = check_settings(out / "settings.json", settings, digests)
        record = Record(out)
        if not known:  # settings of this experiment: the rest is of it, too
            record.check(_FILES, map(Path, scenes))
        with record.writing(_FILES):
            text = json.dumps({**settings, "scenes": {**known, **digests}}, indent=1)
            write_aside(out / "settings.json", f"{text}\n".encode())
            return _experiment_one(loaded, out, options, StageLog(progress))


def _experiment_one(loaded: Sequence[KnownScene], out: Path, options: OneOptions, log: StageLog) -> dict[str, Any]:
    """The trials that are missing in a folder, and what comes of all of them."""
    trials = out / "trials.jsonl"
    _cut_torn_line(trials)
    done = read_trials(trials)
    jobs = []
    for scene in loaded:
        for trial in range(options.trials):
            missing = [m for m in options.methods if (scene.name, trial, m) not in done]
            if missing:
                jobs.append((scene, replace(options, methods=tuple(missing)), trial))
    cores = options.jobs or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    with trials.open("a", encoding="utf-8") as file:
        log.tell("trials", 0, len(jobs))
        # spawned, not forked: the kernels' threads do not survive a fork
        pool = ProcessPoolExecutor(min(cores, max(len(jobs), 1)), get_context("spawn"))
        with _one_thread_each(), pool:
            try:
                for count, future in enumerate(as_completed([pool.submit(run_trial, *job) for job in jobs]), start=1):
                    for entry in future.result():
                        done[entry["scene"], entry["trial"], entry["method"]] = entry
                        file.write(json.dumps(entry) + "\n")
                    file.flush()
                    log.tell("trials", count, len(jobs))
            except BaseException:
                # leaving the pool waits for it: hours, if what is queued were run
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    wanted = [
        done[scene.name, trial, method]
        for scene in loaded
        for method in options.methods
        for trial in range(options.trials)
    ]
    summary = summarize(wanted, options.methods)
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    _write_csv(out / "summary.csv", summary)
    cumulative_histograms(wanted, list(options.methods), out / "histograms.png")
    return summary


def check_settings(path: Path, settings: dict[str, Any], digests: dict[str, str]) -> dict[str, str]:
    """Refuse to mix trials of different settings, or of different scenes of one name, in one folder.

    Its scenes, with the parameters that distinguish them.
    """
    known: dict[str, str] = {}
    if path.is_file():
        try:
            earlier = read_json(path)
            check(earlier, {"scenes?": {str: str}})
        except FormatError as error:
            raise FormatError(f"{path} cannot be read; give another folder") from error
        known = earlier.get("scenes", {})
        changed = [key for key in settings if earlier.get(key) != settings[key]]
        if changed:
            raise InputError(
                f"{path.parent} holds trials with another {changed[0]} ({earlier.get(changed[0])!r}, not "
                f"{settings[changed[0]]!r}); give another folder"
            )
        other = [name for name, digest in digests.items() if known.get(name, digest) != digest]
        if other:
            raise InputError(f"{path.parent} holds trials of another scene called {other[0]}; give another folder")
    return known


def _write_csv(path: Path, summary: dict[str, Any]) -> None:
    rows = ["scene,method,metric,median,p90"]
    for scene, methods in summary.items():
        for method, metrics in methods.items():
            rows += [f"{scene},{method},{m},{v['median']:.6g},{v['p90']:.6g}" for m, v in metrics.items()]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
