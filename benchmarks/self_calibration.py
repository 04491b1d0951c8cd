"""Focal length of photos that only EXIF knows, by us and by COLMAP's own chain: prints one JSON object a line.

    python benchmarks/self_calibration.py [--photos DIR] [--seeds N] [--names lund iphone6]

COLMAP (its features, its matching, its mapping from EXIF's focal length with f and k1 free) maps the photos once for
each seed; its own spread over seeds is what its answer is worth. Ours is `run` with f, k1 and k2 refined. The last
figure says how strongly the focal length and the mean of phi1 go together: a shutter that traded with the lens would
show there.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np

from rsundistort import RunOptions, run

import pycolmap  # isort: skip  # after rsundistort: see rsundistort/io/images.py

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
        with tempfile.TemporaryDirectory() as folder:
            solution = run(photos, Path(folder) / "out", RunOptions())
        camera = solution.cameras["1"]
        focal = [f for _, f in peer]
        figures = {
            "name": f"self-calibration of {name}",
            "colmap_f": [round(f, 1) for f in focal],
            "colmap_registered": [count for count, _ in peer],
            "colmap_median": round(float(np.median(focal)), 1),
            "f": round(float(camera.K[0, 0]), 1),
            "sigma_f": round(solution.quality["sigma_intrinsics"]["1"]["f"], 2),
            "registered": len(solution.registered),
            "model": solution.shutter_model,
            "ratio": round(float(camera.K[0, 0] / np.median(focal)), 4),
        }
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
