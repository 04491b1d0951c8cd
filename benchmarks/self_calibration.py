"""Focal length of photos that only EXIF knows, by us and by COLMAP's own chain: prints one JSON object a line.

    python benchmarks/self_calibration.py [--photos DIR] [--seeds N] [--names lund iphone6]

COLMAP (its features, its matching, its mapping from EXIF's focal length with f and k1 free) maps the photos once for
each seed; its own scatter over seeds is what its answer is worth. Ours is the rotation model with f, k1 and k2 refined,
as `run` does it. On the same measurements: what f a global shutter would have them say (`f_of_global_shutter`), and how
much worse the shutter model fits, in standard errors over the points, when f is held at COLMAP's median or at that of a
global shutter. The standard deviations of the mean of phi1, with f free and with f known, say whether shutter and lens
trade.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from rsundistort import BundleOptions, Reconstruction, RsUndistortWarning, RunOptions
from rsundistort.batch import use_threads
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.bundle import BundleResult, Posterior, bundle_adjust
from rsundistort.bundle.held_out import clipped_errors, standard_errors
from rsundistort.critical.common import row_phi
from rsundistort.input.load import load_photos
from rsundistort.solve.model_sequence import solve_photos

import pycolmap  # isort: skip  # after rsundistort: see rsundistort/io/photos/images.py

ROOT = Path(__file__).resolve().parent.parent


def colmap_focal_lengths(photos: Path, seeds: int) -> list[tuple[int, float]]:
    """Photos registered and focal length of COLMAP's largest model, for each seed."""
    pycolmap.logging.minloglevel = 3
    names = sorted(path.name for path in photos.glob("*.jpg"))
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    found = []
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        pycolmap.extract_features(
            database, photos, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
            device=pycolmap.Device.cpu,
        )  # fmt: skip
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
        for seed in range(seeds):
            options = pycolmap.IncrementalPipelineOptions()
            options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
            work = Path(folder) / str(seed)
            work.mkdir()
            models = pycolmap.incremental_mapping(database, photos, work, options)
            best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
            if best is not None:
                (camera,) = best.cameras.values()
                found.append((best.num_reg_images(), float(camera.mean_focal_length())))
    return found


def solve(photos: Path) -> tuple[BundleResult, BundleOptions]:
    """The rotation model of the photos, as `run` solves it, and the options of the adjustment."""
    log, options = StageLog(None), RunOptions()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", RsUndistortWarning)
        workers = Workers(use_threads(0))
        loaded = load_photos(photos, None, None, options.most_features(False), workers, log)

        def of(rec: Reconstruction) -> BundleOptions:
            return options.solve.options_for(loaded.cameras)

        solved = solve_photos(loaded, "rotation", 0, of, Path(folder), log)
    return solved.result, of(solved.shared)


def alternatives(result: BundleResult, options: BundleOptions, focal: dict[str, float]) -> dict[str, float]:
    """Focal length under a global shutter, and how much worse the shutter model fits with others' focal lengths."""
    rec = result.reconstruction
    free = replace(options, guessed=None, outlier_rounds=0, loss="squared", sigma_px=result.sigma_px)
    found = bundle_adjust(rec, "global", free).reconstruction.cameras[0]
    figures = {"f_of_global_shutter": round(float(found.K[0, 0]), 1)}
    focal = {**focal, "f_of_global_shutter": float(found.K[0, 0])}

    def errors(fitted: Reconstruction) -> np.ndarray:
        square = clipped_errors(fitted, rec.observations, result.sigma_px)[0]
        return np.bincount(rec.observations.point_idx, square, rec.num_points)

    best = errors(bundle_adjust(rec, "rotation", free).reconstruction)
    for name, f in focal.items():
        cameras = [replace(camera, K=np.diag([f, f, 1]) + camera.K * (1 - np.eye(3))) for camera in rec.cameras]
        held = bundle_adjust(replace(rec, cameras=cameras), "rotation", replace(free, refine=("k1", "k2")))
        figures[f"worse_at_{name}"] = round(standard_errors(errors(held.reconstruction) - best), 1)
    return figures


def mean_phi1(rec: Reconstruction) -> float:
    """Mean of the paper's phi1, radians per frame."""
    return float(np.mean(rec.phi[np.arange(rec.num_images), row_phi(rec)[:, 0]] * rec.frame_span()))


def sigma_mean_phi1(result: BundleResult, options: BundleOptions) -> float:
    """Its standard deviation, radians per frame."""
    rec = result.reconstruction
    mean = np.zeros((1, *result.covariances.shape[:2]))
    mean[0, np.arange(rec.num_images), 6 + row_phi(rec)[:, 0]] = rec.frame_span() / rec.num_images
    return float(np.sqrt((mean * Posterior(result, options).of_photos(mean)).sum()))


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--names", nargs="+", default=["lund", "iphone6"])
    args = parser.parse_args()
    for name in args.names:
        photos = args.photos / name
        if not photos.is_dir():
            print(json.dumps({"name": name, "skipped": "no folder of test photos beside the project"}))
            continue
        peer = colmap_focal_lengths(photos, args.seeds)
        result, options = solve(photos)
        camera = result.reconstruction.cameras[0]
        focal = [f for _, f in peer]
        figures = {
            "name": f"self-calibration of {name}",
            "colmap_f": [round(f, 1) for f in focal],
            "colmap_registered": [count for count, _ in peer],
            "colmap_median": round(float(np.median(focal)), 1),
            "f": round(float(camera.K[0, 0]), 1),
            "sigma_f": round(result.sigma_intrinsics[0]["f"], 2),
            "exif_f": round(float(options.guessed.cameras[0].K[0, 0]), 1),
            "registered": result.reconstruction.num_images,
            **alternatives(result, options, {"colmap_f": float(np.median(focal))}),
            "mean_phi1_mrad": round(1e3 * mean_phi1(result.reconstruction), 3),
            "sigma_mean_phi1_mrad": round(1e3 * sigma_mean_phi1(result, options), 4),
            "sigma_mean_phi1_f_known_mrad": round(1e3 * sigma_mean_phi1(result, replace(options, refine=())), 4),
            "ratio": round(float(camera.K[0, 0] / np.median(focal)), 4),
        }
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
