"""Photos as people have them beside COLMAP's default chain, on two cores, one run each: one JSON object a line.

    python benchmarks/field.py [--photos DIR] [--only [NAME ...]] [--skip-peer] [--memory] [--large] [--warped]

For each set a line of the peer (pycolmap's extract, match exhaustively, map and undistort with default options; with
the set's camera.json that PINHOLE camera, held), a line of `run` and a line that compares them, each in a process of
its own; at the end a table. `measurements` are those of a registered photo; of the peer also the median number of
inliers of verified pairs. `error_px` is COLMAP's mean reprojection error, `rms_px` ours. Further parts:

    --memory   peak of `run --jobs 2` on photos of 12 megapixels, and of four of them enlarged to 48
    --large    seconds a photo of 500 photos of a survey, made here, against those of its first 125
    --warped   dslr warped by 0.02 rad against the reconstruction of the photos as they are

Herz-Jesus warped is in accuracy.py. `--only` without a name leaves the sets out. Exits 1 if one crashes or a figure is
missing, never because a figure misses its target. Linux only: peaks are the system's.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SETS = ("drone", "phone", "dslr", "lund", "iphone6", "herz-jesus-8")
TIME = {"phone": 0.4, "dslr": 0.4, "herz-jesus-8": 0.6}
# at least of the peer's, and at most: features of its, re-triangulation of our run
LEAST = {"registered": 1.0, "measurements": 1.0}
MOST = {"features": 0.15, "re-triangulation": 0.15}
COLUMNS = (
    "set", "photos", "registered", "measurements", "px", "seconds", "features s", "re-triangulation", "peak MB",
    "shift px", "model",
)  # fmt: skip

# both write into the folder of work, their last argument, what they reached, how much memory it took, and the
# processors' seconds
PEAK = """
import atexit, sys, time
from pathlib import Path
def note():
    lines = Path("/proc/self/status").read_text().splitlines()
    Path(sys.argv[-1], "cpu_s").write_text(str(time.process_time()))
    Path(sys.argv[-1], "peak").write_text(next(line.split()[1] for line in lines if line.startswith("VmHWM:")))
atexit.register(note)
"""

PEER = """
import json, sqlite3, statistics, time
import pycolmap
pycolmap.logging.minloglevel = 2
photos, work = map(Path, sys.argv[1:])
database, cpu, seconds = work / "database.db", pycolmap.Device.cpu, {}
names = sorted(p.name for p in photos.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
reader, mapper, mode = pycolmap.ImageReaderOptions(), pycolmap.IncrementalPipelineOptions(), pycolmap.CameraMode.AUTO
if (photos / "camera.json").is_file():
    K = json.loads((photos / "camera.json").read_text())["K"]
    reader.camera_model, mode = "PINHOLE", pycolmap.CameraMode.SINGLE
    reader.camera_params = ",".join(str(v) for v in (K[0][0], K[1][1], K[0][2] + 0.5, K[1][2] + 0.5))
    mapper.ba_refine_focal_length = mapper.ba_refine_extra_params = False
def timed(stage, function, *arguments, **options):
    began = time.perf_counter()
    result = function(*arguments, **options)
    seconds[stage] = round(time.perf_counter() - began, 2)
    return result
timed("features", pycolmap.extract_features, database, photos, image_names=names, camera_mode=mode,
      reader_options=reader, device=cpu)
timed("matching", pycolmap.match_exhaustive, database, device=cpu)
models = timed("mapping", pycolmap.incremental_mapping, database, photos, work, mapper)
assert models, "no model"
number, largest = max(models.items(), key=lambda item: item[1].num_reg_images())
timed("undistortion", pycolmap.undistort_images, work / "undistorted", work / str(number), photos)
pairs = sqlite3.connect(database).execute("SELECT rows FROM two_view_geometries WHERE rows > 0").fetchall()
(work / "figures.json").write_text(json.dumps({
    "photos": len(names), "registered": largest.num_reg_images(), "models": len(models),
    "measurements": round(largest.compute_num_observations() / largest.num_reg_images(), 1),
    "pair_inliers": statistics.median(rows for rows, in pairs),
    "error_px": round(largest.compute_mean_reprojection_error(), 3), "seconds": seconds,
}))
"""

OURS = """
from rsundistort_cli.main import cli
cli(["run", sys.argv[1], "-o", sys.argv[-1] + "/out", "--quiet", *sys.argv[2:-1]])
"""


def show(name: str, **figures: Any) -> None:
    """Print one JSON line."""
    print(json.dumps({"name": name, **figures}), flush=True)


def in_child(code: str, photos: Path, work: Path, *arguments: str) -> dict[str, Any]:
    """Seconds and peak of a program in a process of its own, or the last line of what it said as it crashed."""
    command = [sys.executable, "-c", PEAK + code, str(photos), *arguments, str(work)]
    began = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    seconds = round(time.perf_counter() - began, 2)
    if done.returncode:
        said = done.stderr.strip().splitlines()
        return {"crash": said[-1] if said else f"exit code {done.returncode}", "total_s": seconds}
    cpu_s = round(float((work / "cpu_s").read_text()), 2)
    return {"total_s": seconds, "cpu_s": cpu_s, "peak_mb": round(int((work / "peak").read_text()) / 1024)}


def peer(photos: Path) -> dict[str, Any]:
    """COLMAP's default chain."""
    with tempfile.TemporaryDirectory() as folder:
        found = in_child(PEER, photos, Path(folder))
        return found if "crash" in found else json.loads(Path(folder, "figures.json").read_text()) | found


def ours(photos: Path, *options: str) -> dict[str, Any]:
    """`run`, and what its solution says."""
    with tempfile.TemporaryDirectory() as folder:
        found = in_child(OURS, photos, Path(folder), *options)
        return found if "crash" in found else of_solution(Path(folder, "out", "solution.json"), found)


def of_solution(path: Path, found: dict[str, Any]) -> dict[str, Any]:
    """The figures of a solution with its seconds by stage; `other` is the start and the report."""
    solution = json.loads(path.read_text())
    registered = [image for image in solution["images"] if image["registered"]]
    shifts = [image["rs_shift_px"] or 0.0 for image in registered]
    kinds = ("features", "matching", "mapping", "re-triangulation", "adjustment", "rectifying", "writing")
    seconds = dict.fromkeys(kinds, 0.0)
    for stage in solution["stages"]:
        kind = stage["name"].split()[0]
        seconds[kind if kind in kinds else "adjustment"] += stage["seconds"]
    seconds["other"] = found["total_s"] - sum(seconds.values())
    return {
        "photos": len(solution["images"]),
        "registered": len(registered),
        "not_registered": {
            image["name"]: image.get("reason") for image in solution["images"] if not image["registered"]
        },
        "shutter_model": solution["shutter_model"],
        "measurements": round(solution["quality"]["num_observations"] / len(registered), 1),
        "rms_px": round(solution["quality"]["rms_px"], 3),
        "shift_px_median": round(statistics.median(shifts), 2),
        "shift_px_max": round(max(shifts), 2),
        "seconds": {kind: round(value, 2) for kind, value in seconds.items()},
        **found,
    }


def compared(name: str, a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Ratios of ours to the peer's with their targets, and which of them miss."""
    found = {"re-triangulation": a["seconds"]["re-triangulation"] / a["total_s"]}
    if b:
        found |= {key: a[key] / b[key] for key in LEAST}
        found |= {"time": a["total_s"] / b["total_s"], "features": a["seconds"]["features"] / b["seconds"]["features"]}
    most = MOST | ({"time": TIME[name]} if name in TIME else {})
    missed = [key for key, value in found.items() if value < LEAST.get(key, 0) or value > most.get(key, np.inf)]
    ratios = {key: round(value, 3) for key, value in found.items()}
    return {"ratios": ratios, "at_least": LEAST, "at_most": most, "missed": missed}


def table(rows: list[list[str]]) -> None:
    """Columns of text."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def sets(photos: Path, names: list[str], skip_peer: bool) -> list[str]:
    """All lines and the table; names of what crashed."""
    rows = [list(COLUMNS)]
    failed = []
    for name in names:
        ours(photos / name)  # kernels of whatever models a set needs
        results = {"peer": {} if skip_peer else peer(photos / name), "ours": ours(photos / name)}
        for who, result in results.items():
            if result:
                show(f"{name}, {who}", **result)
            if "crash" in result:
                failed.append(f"{name}, {who}")
        a, b = results["ours"], results["peer"]
        if "crash" not in a and "crash" not in b:
            show(f"{name}, compared", **compared(name, a, b))
        rows.append(row_of(name, a, b))
    print("\nours / COLMAP's; measurements of a registered photo; px: rms / mean error; re-triangulation: our share")
    table(rows)
    return failed


def row_of(name: str, a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """A row of the table."""

    def both(key: str, theirs: str | None = None) -> str:
        return f"{a.get(key, '-')} / {b.get(theirs or key, '-')}"

    features = " / ".join(str(each.get("seconds", {}).get("features", "-")) for each in (a, b))
    rest = ["crashed" if "crash" in a else "-"] * 3
    if "crash" not in a:
        rest = [
            f"{a['seconds']['re-triangulation'] / a['total_s']:.0%}",
            f"{a['shift_px_median']}, {a['shift_px_max']}",
            a["shutter_model"],
        ]
    number = str(a.get("photos", b.get("photos", "-")))
    return [name, number, both("registered"), both("measurements"), both("rms_px", "error_px"), both("total_s"),
            features, rest[0], both("peak_mb"), *rest[1:]]  # fmt: skip


def memory(photos: Path) -> list[str]:
    """Peaks at 12 and 48 megapixels; names of what crashed."""
    import cv2

    from rsundistort.io import read_photo, write_image

    with tempfile.TemporaryDirectory() as folder:
        large = Path(folder)
        for path in sorted(photos.glob("*.jpg"))[:4]:
            photo = read_photo(path)
            pixels = cv2.resize(photo.pixels, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
            write_image(large / path.name, pixels, photo.metadata, quality=95)
        failed = []
        for name, here, target in (("12 megapixels", photos, 1200), ("four of 48 megapixels", large, None)):
            found = ours(here, "--jobs", "2")
            if "crash" in found:
                failed.append(name)
            show(f"memory, {name}", **found, target_mb=target)
    return failed


def survey(folder: Path, num: int) -> None:
    """Photos of a drone that flies to and fro over hills, each rotated a little during its readout; and camera.json.

    The ground is noise of all sizes, so nothing looks like anything else. A ray meets the hills where it meets the
    level of the place before; their slopes are gentle, so a few such steps settle.
    """
    import cv2

    from rsundistort import Camera
    from rsundistort.io.cameras import camera_to_json

    width, height, focal, above, texel, margin = 480, 360, 400.0, 30.0, 0.075, 30.0
    step, apart, line = 6.0, 10.0, 50
    rng = np.random.default_rng(5)
    size = (np.array([line * step, -(-num // line) * apart]) + 2 * margin) / texel

    def noise(cell: float) -> Any:
        small = rng.standard_normal((int(size[1] / cell) + 2, int(size[0] / cell) + 2), np.float32)
        return cv2.resize(small, size.astype(int).tolist(), interpolation=cv2.INTER_CUBIC)

    ground = sum(1.5**octave * noise(2.0**octave) for octave in range(3, 8))
    ground = np.clip(128 + 2.5 * ground, 0, 255).astype(np.uint8)
    hills = 1.5 * noise(15 / texel)
    camera = Camera(width, height, [[focal, 0, 241.0], [0, focal, 178.5], [0, 0, 1]])
    (folder / "camera.json").write_text(json.dumps(camera_to_json(camera), default=np.ndarray.tolist))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rays_c = np.dstack([(x - 241.0) / focal, (y - 178.5) / focal, np.ones_like(x, float)])
    for k in range(num):
        row, place = divmod(k, line)
        center = np.array([line - 1 - place if row % 2 else place, row]) * (step, apart) + margin
        center += rng.normal(0, 0.3, 2)
        R_wc, _ = cv2.Rodrigues(rng.normal(0, (0.05, 0.05, 0.2)))
        turned = rng.normal(0, 0.01, 3)
        R = np.array([R_wc @ cv2.Rodrigues(r * turned)[0] for r in (np.arange(height) - 178.5) / height])
        rays = rays_c @ R.transpose(0, 2, 1)
        slope = rays[..., :2] / rays[..., 2:]
        level = np.zeros((height, width), np.float32)
        for _ in range(8):
            at = ((center + slope * (above - level[..., None])) / texel).astype(np.float32)
            level = cv2.remap(hills, at, None, cv2.INTER_LINEAR)
        photo = cv2.remap(ground, at, None, cv2.INTER_CUBIC)
        cv2.imwrite(str(folder / f"{k:04d}.jpg"), photo, [cv2.IMWRITE_JPEG_QUALITY, 92])


def large(num: int = 500, few: int = 125) -> list[str]:
    """Seconds a photo of many photos against those of few; names of what crashed."""
    with tempfile.TemporaryDirectory() as folder:
        whole, part = Path(folder, "whole"), Path(folder, "part")
        whole.mkdir()
        part.mkdir()
        survey(whole, num)
        for path in [*sorted(whole.glob("*.jpg"))[:few], whole / "camera.json"]:
            shutil.copy(path, part)
        results = {few: ours(part, "--jobs", "2"), num: ours(whole, "--jobs", "2")}
    for count, found in results.items():
        show(f"survey of {count} photos", **found)
    failed = [f"survey of {count} photos" for count, found in results.items() if "crash" in found]
    if not failed:
        each = {count: found["total_s"] / count for count, found in results.items()}
        show(f"seconds a photo, {num} against {few}", ratio=round(each[num] / each[few], 3), target=1.3)
    return failed


def warped(photos: Path) -> None:
    """Rotation errors of warped photos, whose lens is found from EXIF, as that of the photos as they are was.

    They are warped by the camera that was found there, or the warp would not be that of a rotating camera. What remains
    where the true motions are given, and between photos that went through the same remap and encoder without any
    motion, is not the shutter's.
    """
    from rsundistort import RunOptions, SolveOptions, read_solution, run
    from rsundistort.evaluation import pose_errors
    from rsundistort.io.cameras import camera_to_json
    from rsundistort.simulate import WarpOptions, simulate_warp

    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        reference = run(photos, work / "still", RunOptions(solve=SolveOptions(shutter_model="global")))
        camera = work / "found.json"
        camera.write_text(json.dumps(camera_to_json(reference.cameras["1"]), default=np.ndarray.tolist))
        for sigma, how in ((0.02, "auto"), (0.02, "true motions"), (0.02, "global"), (0.0, "global")):
            made = work / f"warped-{sigma}"
            if not made.is_dir():
                simulate_warp(photos, made, WarpOptions(camera=str(camera), sigma_rad=sigma))
                (made / "camera.json").unlink()
            options = SolveOptions(shutter_model=how if how in ("auto", "global") else "rotation")
            if how == "true motions":
                truth = read_solution(made / "ground_truth.json")
                span = next(iter(truth.cameras.values())).frame_span
                known = {each.name: (each.motion.phi * span, np.full(3, 1e-6)) for each in truth.images if each.motion}
                options = replace(options, known=known)
            solution = run(made / "photos", work / f"{how}-{sigma}", RunOptions(solve=options))
            error = pose_errors(solution, reference).rotation_deg
            cameras = [each.cameras[each.registered[0].camera_id] for each in (solution, reference)]
            show(
                f"{photos.name} warped by {sigma:g}, {how}",
                shutter_model=solution.shutter_model,
                registered=f"{len(solution.registered)}/{len(solution.images)}",
                reference_registered=len(reference.registered),
                rotation_deg={"median": round(float(np.median(error)), 4), "worst": round(float(error.max()), 4)},
                rotation_deg_but_for_a_common_one=without_common_rotation(solution, reference),
                focal_px=[round(float(each.K[0, 0]), 1) for each in cameras],
                centre_px=[np.round(each.K[:2, 2], 1).tolist() for each in cameras],
                target="all, <= 0.05 deg" if how == "auto" else None,
            )


def without_common_rotation(solution: Any, reference: Any) -> dict[str, float]:
    """Rotation errors in degrees less what all cameras are rotated by in their own frames: another principal point."""
    theirs = {image.name: image.R_cw for image in reference.registered}
    both = [(image.R_cw, theirs[image.name]) for image in solution.registered if image.name in theirs]
    R, R_true = (np.array(each) for each in zip(*both, strict=True))

    def nearest(M: Any) -> Any:
        U, _, Vt = np.linalg.svd(M)
        return U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt

    A = B = np.eye(3)  # R_true = B R A', of the world and of the cameras
    for _ in range(50):
        A = nearest(np.einsum("mji,jk,mkl->il", R_true, B, R))
        B = nearest(np.einsum("mij,jk,mlk->il", R_true, A, R))
    cosine = (np.einsum("mij,ik,mkl,jl->m", R_true, B, R, A) - 1) / 2
    error = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return {"median": round(float(np.median(error)), 4), "worst": round(float(error.max()), 4)}


def main() -> int:
    """Measure what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--only", nargs="*", default=list(SETS), choices=SETS, metavar="NAME")
    parser.add_argument("--skip-peer", action="store_true")
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--warped", action="store_true")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    if not args.photos.is_dir():
        show("field", skipped="no folder of test photos beside the project")
        return 0
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
    ours(ROOT / "sample_scenes" / "courtyard" / "photos")  # kernels are compiled once per installation
    failed = sets(args.photos, args.only, args.skip_peer) if args.only else []
    if args.memory:
        failed += memory(args.photos / "phone")
    if args.large:
        failed += large()
    if args.warped:
        warped(args.photos / "dslr")
    if failed:
        print("crashed: " + "; ".join(failed), file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
