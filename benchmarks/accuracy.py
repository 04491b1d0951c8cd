"""The accuracy figures of the README: prints one JSON object a line, and exits 1 if one is missing.

    python benchmarks/accuracy.py [--photos DIR] [--seeds N]

Needs sample_scenes/courtyard; with the folder of test photos (default ../shared/photos) also warps real photos, and
runs real ones. Targets are printed beside the figures; a figure that misses its target is not an error of the program.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsundistort import (
    BundleOptions,
    RowMotion,
    RunOptions,
    SolveOptions,
    bundle_adjust,
    evaluate,
    read_solution,
    rectify,
    run,
)
from rsundistort.analysis import Evaluation
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.evaluation import pose_errors, psnr
from rsundistort.input.load import load_photos
from rsundistort.simulate import WarpOptions, simulate_warp
from rsundistort.solve.model_sequence import solve_photos

ROOT = Path(__file__).resolve().parent.parent


def show(name: str, **figures: Any) -> None:
    """Print one JSON line."""
    print(json.dumps({"name": name, **figures}), flush=True)


def brief(result: Evaluation) -> dict[str, Any]:
    """The figures that the README shows."""
    return {
        "registered": f"{result.registered}/{result.photos}",
        "rotation_deg": round(result.rotation_deg.mean, 4),
        "phi_mrad_per_frame": [round(v, 3) for v in result.phi_mrad_per_frame.mean_per_component],
        "psnr_before_db": round(result.psnr_before_db.median, 2),
        "psnr_db": round(result.psnr_db.median, 2),
        "psnr_worst_db": round(result.psnr_db.min, 2),
    }


def courtyard(work: Path) -> None:
    """The sample scene against its truth."""
    scene = ROOT / "sample_scenes" / "courtyard"
    run(scene / "photos", work / "courtyard")
    result = evaluate(work / "courtyard", scene / "ground_truth.json")
    show("courtyard", **brief(result), target="10/10, <= 0.05 deg, <= 1.5 mrad, >= 36 dB")


def herz_jesus(photos: Path, work: Path, seeds: int) -> None:
    """Real photos without a shutter: unharmed as they are, recovered when warped."""
    plain, still = work / "plain", work / "global"
    solution = run(photos, plain)
    reference = run(photos, still, RunOptions(solve=SolveOptions(shutter_model="global")))
    shifts = [image.rs_shift_px or 0.0 for image in solution.registered]
    show(
        "herz-jesus-8 as it is",
        shift_px_median=round(float(np.median(shifts)), 3),
        rotation_against_global_deg=round(float(pose_errors(solution, reference).rotation_deg.mean()), 4),
        target="<= 1 px, <= 0.03 deg",
    )
    for sigma, target in (
        (0.05, "8/8, <= 0.1 deg, >= 38 dB, worst >= 35 dB"),
        (0.02, "8/8, <= 0.1 deg, >= 40 dB"),
    ):
        pooled: list[float] = []
        for seed in range(seeds):
            warped, out = work / f"warped-{sigma}-{seed}", work / f"out-{sigma}-{seed}"
            simulate_warp(photos, warped, WarpOptions(sigma_rad=sigma, seed=seed))
            run(warped / "photos", out)
            truth = warped / "ground_truth.json"
            result = evaluate(out, truth, poses=plain / "solution.json", twins=photos)
            pooled += result.psnr_db.photos.values()
            show(f"herz-jesus-8 warped by {sigma}, seed {seed}", **brief(result), target=target)
            if seed == 0:
                blind = work / f"blind-{sigma}"
                run(warped / "photos", blind, RunOptions(solve=SolveOptions(shutter_model="global")))
                blind_result = evaluate(blind, truth, poses=plain / "solution.json")
                show(
                    "the same without a shutter model",
                    rotation_deg=round(blind_result.rotation_deg.mean, 3),
                )
        show(
            f"herz-jesus-8 warped by {sigma}, all seeds",
            psnr_db=round(float(np.median(pooled)), 2),
            target=target,
        )
    limits(photos, work / "warped-0.02-0")


def spread_of_halves(photos: Path, draws: int = 16) -> np.ndarray:
    """(draws, 3) mean phi over all photos, rad/row, from random halves of the scene points, around their mean.

    The scatter of half samples is that of the whole: no other error model enters than that points are independent.
    """
    log = StageLog(None)
    with tempfile.TemporaryDirectory() as folder:
        loaded = load_photos(photos, None, None, RunOptions().most_features(False), Workers(2), log)
        solved = solve_photos(loaded, "rotation", 0, lambda _: BundleOptions(), Path(folder), log)
    rec, rng = solved.shared, np.random.default_rng(0)
    options = BundleOptions(phi_sigma_start=solved.result.phi_sigma)
    means = []
    for _ in range(draws):
        half = rec.with_points((rng.random(rec.num_points) < 0.5)[rec.observations.point_idx])
        means.append(bundle_adjust(half, "rotation", options).reconstruction.phi.mean(0))
    return np.array(means) - np.mean(means, axis=0)


def limits(photos: Path, warped: Path) -> None:
    """What small errors of phi cost in dB, with the true motion as the base: the noise of its mean over the photos."""
    truth = read_solution(warped / "ground_truth.json")
    span = truth.cameras["1"].frame_span
    noise = spread_of_halves(warped / "photos")

    def psnr_db(error: np.ndarray) -> float:
        values = []
        for image in truth.registered:
            assert image.motion is not None
            raw = cv2.imread(str(warped / "photos" / image.name), cv2.IMREAD_UNCHANGED)
            reference = cv2.imread(str(photos / image.name), cv2.IMREAD_UNCHANGED)
            rectified, mask = rectify(raw, truth.cameras["1"], RowMotion(image.motion.phi + error))
            values.append(psnr(rectified, np.asarray(reference), mask))
        return float(np.median(values))

    show(
        "what errors of phi cost (warped by 0.02, seed 0)",
        true_motion_db=round(psnr_db(np.zeros(3)), 2),
        with_noise_of_mean_db=np.percentile([psnr_db(each) for each in noise], (10, 50, 90)).round(1).tolist(),
        noise_of_mean_mrad_per_frame=(1e3 * span * noise.std(axis=0)).round(2).tolist(),
    )


def real(name: str, photos: Path, work: Path, camera: str | None) -> None:
    """Real photos without truth: what the tool says of them."""
    solution = run(photos, work / name, RunOptions(camera=camera))
    shifts = [image.rs_shift_px or 0.0 for image in solution.registered]
    show(
        name,
        registered=f"{len(solution.registered)}/{len(solution.images)}",
        global_rms_px=round(solution.quality["global_rms_px"], 3),
        rms_px=round(solution.quality["rms_px"], 3),
        shift_px_median=round(float(np.median(shifts)), 2),
        shift_px_max=round(float(np.max(shifts)), 2),
        focal_px=round(float(solution.cameras["1"].K[0, 0]), 1),
    )


def main() -> None:
    """Run all that can be run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--seeds", type=int, default=5)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        courtyard(work)
        if not args.photos.is_dir():
            show("real photos", skipped=f"no folder {args.photos.name} of test photos beside the project")
            return
        herz_jesus(args.photos / "herz-jesus-8", work, args.seeds)
        real("iphone6", args.photos / "iphone6", work, str(args.photos / "iphone6" / "K.txt"))
        real("lund", args.photos / "lund", work, None)


if __name__ == "__main__":
    main()
