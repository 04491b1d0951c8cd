"""Motions that are not steady: what is found of them, what the photos are worth, and whether any photo comes out worse.

    python benchmarks/unsteady.py [--photos DIR] [--only PART ...] [--kinds KIND ...] [--seeds N] [--first-seed K]

Prints one JSON object a line and at the end a table with targets. Parts, with their own number of seeds:

    changing (3)   herz-jesus-8 warped by 0.05 rad a frame, the rate changing by half of itself over half a frame;
                   `dB_without_lens` is against the photos as they are without the lens that was found
    vibrating (3)  herz-jesus-8 warped by 0.02 rad, with 1.5 mrad of vibration at 2 to 5 periods a frame
    anchored (3)   the same two with one photo that stood still, and `--still` says so: what the height of the scene is
                   worth, which level cameras that move so do not determine
    scene (1)      a rendered scene, from a drone that travels and vibrates, against its references
    shaken (1)     another one, from a camera that vibrates by 10 mrad, 1.2 to 1.5 periods a frame, which bends photos
                   by many pixels
    limit (3)      the bound that the measurements impose on the first two: those of the photos as they are, each moved
                   as the warp moves it, adjusted from the true poses and motions; no match is lost or wrong. Errors of
                   phi (mean over the photos, and about it, mrad a frame) and of log k, the height of the scene, with
                   their standard deviations; the true mean of phi1, and its standard deviation by the prior. With the
                   noise as it is; with the same residuals in another order, so that neighbours share nothing; and with
                   the lens held at that of the photos as they are
    harm (13)      herz-jesus-8 with motions of all kinds, 0 to 0.1 rad: no photo is to come out more than 0.3 dB below
                   what went in unless it is named as doubtful
    steady (2)     steady motions of 0.02 and 0.05 rad, with these models among the choices and without
    coverage (3)   errors of phi in units of the deviations that are reported, of all that ran before

Poses of warped photos are held against the global-shutter reconstruction of the photos as they are. Exits 1 if one
crashes, never because a figure misses its target.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from measures import for_the_lens_only, log_k_error, normalised_errors, pooled, run_options, with_lens_of, with_poses
from strong import psnr_between, rotations_off

import rsundistort as rs
from rsundistort.bundle import bundle_adjust
from rsundistort.critical import shape_cost
from rsundistort.evaluation import motion_errors
from rsundistort.io import read_photo
from rsundistort.model.reprojection import reprojection_residuals
from rsundistort.simulate import SceneOptions, WarpOptions, simulate_scene, simulate_warp
from rsundistort.synthetic.unsteady import Vibration

ROOT = Path(__file__).resolve().parent.parent
HERZ, STOOD = "herz-jesus-8", "0003.jpg"
PARTS = ("changing", "vibrating", "anchored", "limit", "scene", "shaken", "harm", "steady")
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "scene": ("flyover", {"amplitude_rad": 1.5e-3, "periods": [2, 5], "travel_m": 0.002}),
    "shaken": ("courtyard", {"amplitude_rad": 10e-3, "periods": [1.2, 1.5]}),
}
# strength in rad a frame, change of the rate, amplitude of the vibration in rad, groups of bends that follow it
MOTIONS = {"changing": (0.05, 0.5, 0.0, 1), "vibrating": (0.02, 0.0, 1.5e-3, 5)}
COLUMNS = ("part", "seed", "model", "verdict", "dB", "worst", "before", "deg", "phi/sigma", "doubtful", "s")
# strength in rad a frame, change of the rate, amplitude of the vibration in rad: steady, bent, vibrating, mixed
HARM = (
    (0.0, 0.0, 0.0), (0.003, 0.0, 0.0), (0.01, 0.0, 0.0), (0.03, 0.0, 0.0), (0.1, 0.0, 0.0), (0.01, 0.5, 0.0),
    (0.03, 0.5, 0.0), (0.1, 0.5, 0.0), (0.0, 0.0, 1.5e-3), (0.01, 0.0, 1e-3), (0.03, 0.0, 3e-3), (0.01, 0.5, 1.5e-3),
    (0.05, 0.5, 1.5e-3),
)  # fmt: skip


def show(name: str, **figures: Any) -> None:
    """Print one JSON line."""
    print(json.dumps({"name": name, **figures}), flush=True)


class Bench:
    """Photos, the folder of work, and what came of it."""

    def __init__(self, photos: Path, work: Path) -> None:
        self.photos, self.work = photos, work
        self.rows: list[tuple[str, ...]] = []
        self.errors: list[dict[str, Any]] = []
        self.failed: list[str] = []
        self._still: Path | None = None
        self._measured: tuple[rs.Reconstruction, rs.BundleOptions] | None = None

    @property
    def still(self) -> Path:
        """Solution of the photos as they are."""
        if self._still is None:
            out, module = self.work / "still", importlib.import_module("rsundistort.solve.run")
            solve = module.solve_photos

            def kept(*args: Any, **more: Any) -> Any:
                solved = solve(*args, **more)
                self._measured = solved.shared, args[3](solved.shared)
                return solved

            with mock.patch.object(module, "solve_photos", kept):
                rs.run(self.photos / HERZ, out, run_options(shutter_model="global"))
            self._still = out / "solution.json"
        return self._still

    @property
    def measured(self) -> tuple[rs.Reconstruction, rs.BundleOptions]:
        """Reconstruction of the photos as they are, and the options of its adjustment, which no exposure bounds."""
        assert self.still is not None
        assert self._measured is not None
        rec, options = self._measured
        return rec, replace(options, phi_limits={}, phi_sigma_most=None, velocity_sigma_most=None)

    def warped(
        self, sigma: float, seed: int, change: float = 0.0, shake: float = 0.0, still: tuple[str, ...] = ()
    ) -> Path:
        """Folder of herz-jesus-8 warped."""
        out = self.work / f"warped-{sigma}-{change}-{shake}-{seed}{'-still' * len(still)}"
        vibration = Vibration(shake, (2.0, 5.0)) if shake else None
        options = WarpOptions(sigma_rad=sigma, seed=seed, acceleration=change, vibration=vibration, still=still)
        if not out.is_dir():
            simulate_warp(self.photos / HERZ, out, options)
        return out

    def measure(
        self, part: str, seed: int, folder: Path, references: Path, poses: Path | None, name: str = "run",
        own_lens: bool = False, **options: Any,
    ) -> Any:  # fmt: skip
        """Run on a folder with its truth, and report what came of it; None where it crashed.

        With `own_lens` the references have the lens taken out that was found, and so have the photos before: what a
        better lens changes is no harm.
        """
        start = time.perf_counter()
        out = folder / name
        try:
            solution = rs.run(folder / "photos", out, run_options(**options), overwrite=True)
            seconds = time.perf_counter() - start
            truth_file = folder / "ground_truth.json"
            truth_file = with_lens_of(out, truth_file) if own_lens else truth_file
            found = rs.evaluate(out, truth_file, poses=poses, twins=references)
            of_lens = rs.evaluate(out, with_lens_of(out, folder / "ground_truth.json"), twins=references).psnr_db
        except Exception as error:
            show(f"{part}, seed {seed}", crash=f"{type(error).__name__}: {error}")
            self.failed.append(part)
            return None
        after, before = found.psnr_db.photos, found.psnr_before_db.photos
        if own_lens:
            before = for_the_lens_only(out, rs.read_solution(truth_file), folder / "photos", references)
        named = {image.name for image in solution.images if image.doubtful or image.lens_only}
        truth = rs.read_solution(folder / "ground_truth.json")
        phi = None
        if solution.shutter_model != "global":
            phi = normalised_errors(solution, truth) if all(i.posed for i in truth.images) else _phi(solution, truth)
            self.errors.append({"phi": phi["phi"]})
        quality = solution.quality
        value = {
            "model": quality["held_out_chosen"], "verdict": [solution.verdict["shutter"], solution.verdict["shape"]],
            "registered": len(solution.registered), "dB": round(found.psnr_db.median, 2),
            "worst": round(min(after.values()), 2), "dB_without_lens": round(of_lens.median, 2),
            "before": round(float(np.median([*before.values()])), 2),
            "deg": round(found.rotation_deg.mean, 4),
            "phi_mrad": np.round(found.phi_mrad_per_frame.mean_per_component, 2).tolist(),
            "phi_over_sigma": None if phi is None else round(float(np.sqrt(np.mean(phi["phi"] ** 2))), 2),
            "doubtful": sorted(named), "s": round(seconds, 1),
            "worse": {k: round(after[k] - before[k], 2) for k in after if after[k] < before[k] - 0.3},
            "held_out_error": {k: round(v, 3) for k, v in quality["held_out_error"].items()},
            "agreement": quality["agreement_of_halves"],
        }  # fmt: skip
        show(f"{part}, seed {seed}", **value)
        cells = [value[k] for k in ("model", "verdict", "dB", "worst", "before", "deg", "phi_over_sigma")]
        self.rows.append((part, str(seed), *map(str, cells), str(len(named)), f"{seconds:.0f}"))
        return value


def _phi(solution: rs.Solution, truth: rs.Solution) -> dict[str, Any]:
    """Errors of phi over their deviations."""
    span = np.array([[solution.cameras[image.camera_id].frame_span] for image in solution.registered])
    sigma = span * np.array([image.sigma_phi for image in solution.registered])
    return {"phi": motion_errors(solution, truth).phi_rad_per_frame / sigma}


def scene(bench: Bench, part: str, seed: int) -> None:
    """One of the project's own recipes with another motion: a drone that travels and vibrates, or a camera shaken."""
    name, vibration = SCENES[part]
    recipe = json.loads((ROOT / "sample_scenes" / name / "recipe.json").read_text())
    recipe["seed"] = recipe["seed"] + seed
    recipe["motion"] = recipe["motion"] | {"vibration": vibration}
    folder = bench.work / f"{part}-{seed}"
    folder.mkdir()
    (folder / "recipe.json").write_text(json.dumps(recipe))
    simulate_scene(folder / "recipe.json", folder / "scene", SceneOptions())
    bench.measure(part, seed, folder / "scene", folder / "scene" / "global", None)


def limit(bench: Bench, kind: str, seed: int) -> None:
    """Right matches alone, from the truth."""
    *motion, groups = MOTIONS[kind]
    truth = rs.read_solution(bench.warped(*motion[:1], seed, *motion[1:]) / "ground_truth.json")
    rec, options = bench.measured
    options = replace(options, bends=groups)
    obs, warped_by = rec.observations, truth.cameras["1"]
    span = warped_by.frame_span
    residuals, _ = reprojection_residuals(rec)
    shuffled = np.random.default_rng(seed).permutation(len(obs))
    relative = residuals / obs.sigma[:, None]
    # each residual that of another measurement of the same standard deviation
    mixed = obs.xy_raw + residuals - relative[shuffled] * obs.sigma[:, None]
    for name, xy, how in (
        ("as it is", obs.xy_raw, options), ("independent", mixed, options),
        ("lens held", obs.xy_raw, replace(options, refine=())),
    ):  # fmt: skip
        moved, motions = xy.copy(), [truth.image(photo).motion for photo in rec.image_names]
        for each, mine in zip(motions, obs.by_photo(rec.num_images), strict=True):
            ideal = rs.undistort_points(xy[mine], warped_by, P=warped_by.K)
            moved[mine] = rs.distort_points(ideal, warped_by, each, P=warped_by.K)
        inside = ((moved > -0.5) & (moved < np.array([warped_by.width, warped_by.height]) - 0.5)).all(axis=1)
        start = replace(rec, observations=replace(obs, xy_raw=moved).select(inside), shutter_model="rotation")
        result = bundle_adjust(start.with_motions(motions), "rotation", how)
        found, cost = result.reconstruction, shape_cost(result, how)
        off = 1e3 * span * (found.phi - np.array([each.phi for each in motions]))
        sigma = 1e3 * span * np.sqrt((result.sigma_phi**2).mean(axis=0))
        degrees = rotations_off(found.R_cw, rec.R_cw)
        dB = [
            psnr_between(read_photo(bench.photos / HERZ / photo).pixels, found.cameras[0], found.motion(i), motions[i])
            for i, photo in enumerate(rec.image_names)
        ]
        show(
            f"limit of {kind}, noise {name}, seed {seed}", measurements=len(start.observations),
            dB=round(float(np.median(dB)), 2), least_dB=round(min(dB), 2), deg=round(float(np.median(degrees)), 4),
            phi1_mrad=round(1e3 * span * float(np.mean([each.phi[0] for each in motions])), 2),
            prior_mrad=round(1e3 * result.phi_sigma / len(motions) ** 0.5, 2),
            mean_mrad=off.mean(0).round(2).tolist(), about_it_mrad=off.std(0).round(2).tolist(),
            sigma_mrad=sigma.round(2).tolist(), log_k=round(log_k_error(found, with_poses(truth, _poses(rec))), 5),
            sigma_log_k=round(cost.sigma_log_k, 5), noise=round(result.noise_factor, 2),
        )  # fmt: skip
        bench.rows.append((
            f"limit, {kind}", str(seed), name, "", f"{np.median(dB):.2f}", f"{min(dB):.2f}", "",
            f"{np.median(degrees):.4f}", f"{off.mean(0)[0] / sigma[0]:.2f}", "", "",
        ))  # fmt: skip


def _poses(rec: rs.Reconstruction) -> rs.Solution:
    """A reconstruction's poses as a solution."""
    images = [
        rs.SolvedImage(name, "1", rec.R_cw[i], rec.center_w[i], rs.RowMotion())
        for i, name in enumerate(rec.image_names)
    ]
    return rs.Solution("rotation", {"1": rec.cameras[0]}, {"1": rec.cameras[0].pinhole()}, images)


def main() -> int:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--kinds", nargs="*", choices=[*MOTIONS], default=[*MOTIONS], help="of anchored and limit")
    parser.add_argument("--seeds", type=int)
    parser.add_argument("--first-seed", type=int, default=0)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as work:
        bench = Bench(args.photos, Path(work))

        def seeds(own: int) -> range:
            return range(args.first_seed, args.first_seed + (args.seeds or own))

        references = bench.photos / HERZ
        for kind, (sigma, change, shake, _) in MOTIONS.items():
            for seed in seeds(3) if kind in args.only else ():
                bench.measure(kind, seed, bench.warped(sigma, seed, change, shake), references, bench.still)
            wanted = kind in args.kinds
            for seed in seeds(3) if wanted and "anchored" in args.only else ():
                folder = bench.warped(sigma, seed, change, shake, (STOOD,))
                bench.measure(f"anchored, {kind}", seed, folder, references, bench.still, still={STOOD: 1e-4})
            for seed in seeds(3) if wanted and "limit" in args.only else ():
                limit(bench, kind, seed)
        for part in SCENES:
            for seed in seeds(1) if part in args.only else ():
                scene(bench, part, seed)
        if "harm" in args.only:
            harm(bench, seeds(1), references)
        if "steady" in args.only:
            steady(bench, seeds(2), references)
        if bench.errors:
            show("coverage", phi_over_sigma=pooled(bench.errors), runs=len(bench.errors))
    widths = [max(len(row[k]) for row in [COLUMNS, *bench.rows]) for k in range(len(COLUMNS))]
    for row in [COLUMNS, *bench.rows]:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    return bool(bench.failed)


def harm(bench: Bench, seeds: Sequence[int], references: Path) -> None:
    """Photos that come out worse than they went in, and are not named."""
    photos, silent = 0, dict[str, float]()
    for seed in seeds:
        for k, (sigma, change, shake) in enumerate(HARM):
            folder = bench.warped(sigma, 100 * seed + k, change, shake)
            name = f"harm by {sigma}, {change}, {shake}"
            found = bench.measure(name, seed, folder, references, bench.still, own_lens=True, quality=100)
            if found is not None:
                photos += found["registered"]
                worse = {f"{folder.name}/{k}": v for k, v in found["worse"].items() if k not in found["doubtful"]}
                silent |= worse
    show("harm", photos=photos, worse_and_not_named=silent)


def steady(bench: Bench, seeds: Sequence[int], references: Path) -> None:
    """What steady motions lose, and how much longer they take."""
    for sigma in (0.02, 0.05):
        for seed in seeds:
            folder = bench.warped(sigma, seed)
            with mock.patch("rsundistort.bundle.choice.BENDS", {0: ""}):
                without = bench.measure(f"steady by {sigma}, without", seed, folder, references, bench.still)
            among = bench.measure(f"steady by {sigma}", seed, folder, references, bench.still)
            if without and among:
                loss, times = without["dB"] - among["dB"], among["s"] / without["s"]
                show(f"steady by {sigma}, seed {seed}", loss_db=round(loss, 2), times=round(times, 2))


if __name__ == "__main__":
    sys.exit(main())
