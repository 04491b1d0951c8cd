"""What the alignment of tracks at full size is worth: prints one JSON object a line.

    python benchmarks/alignment.py [--photos DIR] [--sigma RAD] [--seeds N]

Photos of herz-jesus-8 are warped by known motions. The same tracks are adjusted (rotation) with the positions of SIFT,
with these aligned, and with those that were found where no feature was.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from rsundistort import BundleOptions, RunOptions, Solution, bundle_adjust, read_solution
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers, use_threads
from rsundistort.bundle.bundle_options import BundleResult
from rsundistort.input.load import load_photos
from rsundistort.sfm import map_photos, match_photos, retriangulate
from rsundistort.simulate import WarpOptions, simulate_warp
from rsundistort.solve.tracks import TrackSource

ROOT = Path(__file__).resolve().parent.parent


def show(name: str, result: BundleResult, truth: Solution) -> None:
    """Print one JSON line: residual, measurements, and errors of phi, their mean over the photos apart."""
    rec = result.reconstruction
    true = {image.name: image.motion.phi for image in truth.registered if image.motion is not None}
    error = 1e3 * rec.frame_span()[:, None] * (rec.phi - np.array([true[name] for name in rec.image_names]))
    mean = error.mean(0)
    figures = {
        "residual_px": round(result.rms_px, 4),
        "measurements_a_photo": round(len(rec.observations) / rec.num_images),
        "phi_error_mrad": np.sqrt(((error - mean) ** 2).mean(0)).round(3).tolist(),
        "mean_phi_error_mrad": mean.round(3).tolist(),
    }
    print(json.dumps({"name": name, **figures}), flush=True)


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--sigma", type=float, default=0.02)
    parser.add_argument("--seeds", type=int, default=2)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    photos, workers, log, options = args.photos / "herz-jesus-8", Workers(use_threads(2)), StageLog(None), RunOptions()
    for seed in range(args.seeds):
        with tempfile.TemporaryDirectory() as folder:
            work = Path(folder)
            simulate_warp(photos, work / "warp", WarpOptions(sigma_rad=args.sigma, seed=seed))
            truth = read_solution(work / "warp" / "ground_truth.json")
            loaded = load_photos(work / "warp" / "photos", None, None, options.most_features(False), workers, log)
            cameras = loaded.cameras
            matched = match_photos(
                work / "database.db", loaded.names, loaded.features, cameras.cameras, cameras.camera_idx
            )
            result = bundle_adjust(map_photos(matched), "rotation", simpler_first=True)
            result = bundle_adjust(retriangulate(matched, result.reconstruction), "rotation")
            again = BundleOptions(phi_sigma_start=result.phi_sigma)
            track_source = TrackSource(matched, loaded, workers)
            tracks = retriangulate(matched, result.reconstruction)
            aligned = track_source.aligned(tracks, log)
            measured = replace(aligned, observations=aligned.observations.select(np.arange(len(tracks.observations))))
            more = track_source.aligned(retriangulate(matched, result.reconstruction, of_two=True), log)
            for label, each in (
                ("as SIFT has them", tracks),
                ("aligned", measured),
                ("and found where no feature was", aligned),
                ("and points of two photos that a third shows", more),
            ):
                show(
                    f"warped by {args.sigma:g} rad, seed {seed}: {label}", bundle_adjust(each, "rotation", again), truth
                )


if __name__ == "__main__":
    main()
