"""`solve` on COLMAP models: prints one JSON object a line.

    python benchmarks/solve.py [--photos DIR] [--observations N]

- Real photos (herz-jesus-8) warped by a rolling shutter, made into models by pycolmap with its default thresholds and
  with looser ones: what `solve` makes of each, alone and with the database, against pycolmap's model of the photos as
  they were. Targets: 0.15 deg alone, 0.1 deg and 95 % of its measurements with the database.
- Whether the rectified photos and the poses fit each other: keypoints that pycolmap detects anew in OUT/images,
  triangulated with the poses of OUT/sparse (median error at most 0.5 px); and pycolmap's own model of OUT/images with
  its default thresholds (all photos, mean error within 10 % of that of the photos as they were).
- A synthetic model of 1,000 photos and 5,000,000 measurements: time and memory of `solve`, beside pycolmap's global
  bundle adjustment of the same model, each in a process of its own.

Exits 1 if one crashes, never because a figure misses its target.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import bundle

import rsundistort as rs
from rsundistort.colmap import write_colmap_model
from rsundistort.evaluation import pose_errors
from rsundistort.simulate import WarpOptions, simulate_warp

ROOT = Path(__file__).resolve().parent.parent

# photos, work, camera (json), loose thresholds: a database and a model in work
MODEL = """
import json, pathlib, sys
import pycolmap
from rsundistort.sfm.database import pipeline_options
photos, work, K, loose = sys.argv[1:]
photos, work, K, loose = pathlib.Path(photos), pathlib.Path(work), json.loads(K), float(loose)
pycolmap.logging.minloglevel = 2
work.mkdir(parents=True)
reader = pycolmap.ImageReaderOptions()
reader.camera_model = "PINHOLE"
reader.camera_params = ",".join(str(v) for v in (K[0][0], K[1][1], K[0][2] + 0.5, K[1][2] + 0.5))
names = sorted(path.name for path in photos.glob("*.jpg"))
pycolmap.extract_features(work / "database.db", photos, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE,
                          reader_options=reader, device=pycolmap.Device.cpu)
pycolmap.match_exhaustive(work / "database.db", device=pycolmap.Device.cpu)
options = pipeline_options(loose, 0, False, len(names)) if loose > 1 else pycolmap.IncrementalPipelineOptions()
options.ba_refine_focal_length = options.ba_refine_extra_params = False
options.random_seed = 0
models = pycolmap.incremental_mapping(work / "database.db", photos, work, options)
best = max(models.values(), key=lambda model: model.num_reg_images())
(work / "model").mkdir()
best.write(work / "model")
print(json.dumps({"photos": best.num_reg_images(), "points": best.num_points3D(),
                  "observations": best.compute_num_observations(),
                  "error_px": best.compute_mean_reprojection_error()}))
"""

# database, photos, model with poses: errors of points triangulated anew, with the database's ids
REFIT = """
import json, sys
import numpy as np
import pycolmap
database, photos, model = sys.argv[1:]
pycolmap.logging.minloglevel = 2
poses = {image.name: image.cam_from_world() for image in pycolmap.Reconstruction(model).images.values()}
posed = pycolmap.Reconstruction()
with pycolmap.Database.open(database) as db:
    for camera in db.read_all_cameras():
        posed.add_camera(camera)
    for rig in db.read_all_rigs():
        posed.add_rig(rig)
    frames = {data.id: frame for frame in db.read_all_frames() for data in frame.data_ids}
    for image in db.read_all_images():
        frame = frames[image.image_id]
        frame.rig_from_world = poses[image.name]
        posed.add_frame(frame)
        image.frame_id = frame.frame_id
        keypoints = db.read_keypoints(image.image_id)[:, :2].astype(np.float64)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in keypoints])
        posed.add_image(image)
        posed.register_frame(frame.frame_id)
found = pycolmap.triangulate_points(posed, database, photos, photos + "/../refit")
errors = [np.linalg.norm(image.project_point(found.points3D[p.point3D_id].xyz) - p.xy)
          for image in found.images.values() for p in image.points2D if p.has_point3D()]
print(json.dumps({"median_px": float(np.median(errors)), "measurements": len(errors)}))
"""

PEER = """
import json, resource, sys, time
import pycolmap
pycolmap.logging.minloglevel = 2
model = pycolmap.Reconstruction(sys.argv[1])
began = time.perf_counter()
options = pycolmap.BundleAdjustmentOptions()
options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
pycolmap.bundle_adjustment(model, options)
print(json.dumps({"s": time.perf_counter() - began,
                  "mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}))
"""

OURS = """
import json, resource, sys, time
from rsundistort import SolveOptions, solve
began = time.perf_counter()
solution = solve(sys.argv[1], sys.argv[2], SolveOptions(readout="top-to-bottom"))
print(json.dumps({"s": time.perf_counter() - began, "model": solution.shutter_model,
                  "stages": {stage["name"]: stage["seconds"] for stage in solution.stages},
                  "mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}))
"""


def show(name: str, **figures: Any) -> None:
    """Print one JSON line."""
    print(json.dumps({"name": name, **figures}), flush=True)


def printed(code: str, *arguments: object) -> dict[str, Any]:
    """What a program in a process of its own prints last."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def real_photos(photos: Path, work: Path) -> None:
    """Models of warped photos."""
    K = json.dumps(json.loads((photos / "camera.json").read_text())["K"])
    truth = printed(MODEL, photos, work / "unwarped", K, 1)
    rs.solve(work / "unwarped" / "model", work / "truth", rs.SolveOptions(shutter_model="global"))
    reference = rs.read_solution(work / "truth" / "solution.json")
    simulate_warp(photos, work / "warp", WarpOptions(sigma_rad=0.05, seed=0))
    warped = work / "warp" / "photos"
    for kind, loose in (("default", 1), ("loosened", 4)):
        given = printed(MODEL, warped, work / kind, K, loose)
        before = rs.read_solution(rs_of(work / kind / "model", work / f"{kind}-global"))
        for database in (None, work / kind / "database.db"):
            out = work / f"{kind}-{'alone' if database is None else 'database'}"
            options = rs.SolveOptions(readout="top-to-bottom")
            solution = rs.solve(work / kind / "model", out, options, images=warped, database=database)
            errors, errors_before = (pose_errors(each, reference).rotation_deg for each in (solution, before))
            share = solution.quality["num_observations"] / truth["observations"]
            show(
                f"solve, warped herz-jesus-8, {kind} thresholds, {out.name.split('-')[1]}",
                rotation_deg=round(float(errors.mean()), 4),
                rotation_worst_deg=round(float(errors.max()), 4),
                rotation_before_deg=round(float(errors_before.mean()), 3),
                observations=solution.quality["num_observations"],
                observations_given=given["observations"],
                share_of_unwarped=round(share, 4),
                target="<= 0.15 deg" if database is None else "<= 0.1 deg, >= 0.95",
                ok=bool(errors.mean() <= (0.15 if database is None else 0.1) and (database is None or share >= 0.95)),
            )
        rebuilt = printed(MODEL, out / "images", work / f"{kind}-rebuilt", K, 1)
        refit = printed(REFIT, work / f"{kind}-rebuilt" / "database.db", out / "images", out / "sparse")
        ratio = rebuilt["error_px"] / truth["error_px"]
        show(
            f"pycolmap on OUT of {kind} thresholds",
            median_px=round(refit["median_px"], 3),
            measurements=refit["measurements"],
            registered=f"{rebuilt['photos']}/{truth['photos']}",
            error_px=round(rebuilt["error_px"], 4),
            error_unwarped_px=round(truth["error_px"], 4),
            ratio=round(ratio, 3),
            target="<= 0.5 px, all, <= 1.1",
            ok=bool(refit["median_px"] <= 0.5 and rebuilt["photos"] == truth["photos"] and ratio <= 1.1),
        )


def rs_of(model: Path, out: Path) -> Path:
    """The solution of a model without a shutter."""
    rs.solve(model, out, rs.SolveOptions(shutter_model="global"))
    return out / "solution.json"


def large_model(observations: int, work: Path) -> None:
    """A street of many photos."""
    bundle.PER_PHOTO = 5000
    rec = bundle.make_problem("street", observations)
    folder = work / "street"
    # raw pixels in a model of pinholes, as COLMAP would have them of such photos
    as_global = rs.Reconstruction(
        rec.cameras, rec.image_names, rec.camera_idx, rec.R_cw, rec.center_w, rec.points_w, rec.observations
    )
    write_colmap_model(folder, as_global, list(rec.cameras), list(rec.image_names))
    ours, peer = printed(OURS, folder, work / "street-out"), printed(PEER, folder)
    show(
        f"solve, {rec.num_images} photos, {len(rec.observations)} measurements",
        ours_s=round(ours["s"], 1),
        peer_s=round(peer["s"], 1),
        ratio=round(ours["s"] / peer["s"], 2),
        ours_mb=round(ours["mb"]),
        peer_mb=round(peer["mb"]),
        model=ours["model"],
        stages=ours["stages"],
        target="<= 8192 MB",
        ok=bool(ours["mb"] <= 8192),
    )


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--observations", type=int, default=5_000_000)
    args = parser.parse_args()
    photos = args.photos / "herz-jesus-8"
    with tempfile.TemporaryDirectory() as work:
        if photos.is_dir():
            real_photos(photos, Path(work))
        else:
            show("solve, warped herz-jesus-8", skipped="no folder of test photos beside the project")
        if args.observations:
            large_model(args.observations, Path(work))


if __name__ == "__main__":
    main()
