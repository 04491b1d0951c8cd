"""Photos that lost their EXIF: the focal length that they show, and what a run makes of it; one JSON object a line.

    python benchmarks/unknown_camera.py [--photos DIR] [--names herz-jesus-8 iphone6 phone dslr drone lund]
                                        [--clips DIR [--kinds walk vibrating] [--seeds 100 101 ...]]
                                        [--lenses [--scenes courtyard colonnade]] [--videos [--seeds 100 101 ...]]

`f_reference` is that of `camera.json`, or what a run finds that has the EXIF. `f_pairs` is what pairs of photos say
before anything is mapped, with its relative standard deviation, and `f` what the run ends with. `walk` of the sample
scenes is a video without its camera file: `readout_ms` should be 20. With `--clips` only `f_pairs` of random clips
(`clips.py`) is shown, and at the end the root mean square of its relative errors, and the largest. With `--lenses` the
sample scenes are rendered again by other lenses (a fisheye, a wide one, stretched ones), with their shutter and
without, and solved without a camera; with `--videos` so are random clips, walks and pans from a tripod.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import warnings
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from clips import clip_folder, clip_recipe

from rsundistort import RsUndistortWarning, RunOptions, Solution, evaluate, read_solution, run
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import RsUndistortError
from rsundistort.input.key_frames import read_clip
from rsundistort.input.load import load_photos
from rsundistort.input.unknown_focal import with_focal_lengths
from rsundistort.simulate import SceneOptions, simulate_scene
from rsundistort.solve import OutputOptions

ROOT = Path(__file__).resolve().parent.parent
_Lens = tuple[str, float, float, list[float]]
# Those of videos: an action camera's of 130 and 150 degrees, and a wide pinhole of 115.
_VIDEO_LENSES: dict[str, _Lens] = {
    "fisheye 130": ("fisheye", 0.45, 0.45, [0.02, -0.005, 0.001, -0.0005]),
    "fisheye 150": ("fisheye", 0.4, 0.4, [0.03, -0.01, 0.0, 0.0]),
    "wide": ("pinhole", 0.4, 0.4, [-0.03, 0.01, 0.0, 0.0, 0.0]),
}
# Lenses by name: kind, fx and fy as shares of the width, coefficients. The fisheye is an action camera's, the wide
# pinhole shows 90 degrees from border to border; pixels are 3 % too narrow, or squeezed by an anamorphic adapter.
_LENSES: dict[str, _Lens] = {
    "fisheye": ("fisheye", 0.45, 0.45, [0.02, -0.005, 0.001, -0.0005]),
    "wide": ("pinhole", 0.5, 0.5, [-0.02, 0.01, 0.0, 0.0, 0.0]),
    "narrow pixels": ("pinhole", 0.833 / 0.97, 0.833, []),
    "anamorphic": ("pinhole", 0.833 / 1.33, 0.833, []),
}


def solved(photos: Path, out: Path, camera: str | None = None) -> Solution:
    """What a run makes of photos."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RsUndistortWarning)
        return run(photos, out, RunOptions(camera=camera, outputs=OutputOptions(report=False)))


def focal(solution: Solution) -> float:
    """The focal length of its photos, the median."""
    return float(np.median([solution.cameras[image.camera_id].K[0, 0] for image in solution.registered]))


def figures_of(solution: Solution, reference: float) -> dict[str, object]:
    """What is worth comparing."""
    stage = next(each for each in solution.stages if each["name"] == "focal length")
    f = focal(solution)
    return {
        "f_reference": round(reference, 1),
        "f_pairs": [round(each, 1) for each in stage["pixels"]],
        "sigma_pairs": [round(each, 3) for each in stage["sigma"]],
        "f": round(f, 1),
        "ratio": round(f / reference, 4),
        "registered": len(solution.registered),
        "verdict": solution.verdict["shutter"] if solution.verdict else None,
    }


def of_clips(folder: Path, kinds: list[str], seeds: list[int]) -> None:
    """What pairs of key frames say of the focal length of clips."""
    errors = []
    for kind, seed in product(kinds, seeds):
        clip = clip_folder(folder, kind, seed)
        true = json.loads((clip / "camera.json").read_text())["K"][0][0]
        with tempfile.TemporaryDirectory() as work, warnings.catch_warnings():
            warnings.simplefilter("ignore", RsUndistortWarning)
            frames, log = Path(work) / "frames", StageLog(None)
            read_clip(clip / "clip.mp4", frames)
            keys = load_photos(frames, None, None, RunOptions().most_features(True), Workers(0), log, least=2)
            camera = with_focal_lengths(keys, 0, log).cameras.cameras[0]
        errors.append(float(np.log(camera.K[0, 0] / true)))
        print(json.dumps({"clip": clip.name, "f_pairs": round(camera.K[0, 0], 1), "f_true": true}), flush=True)
    print(
        json.dumps(
            {
                "clips": len(errors),
                "rms": round(float(np.sqrt(np.mean(np.square(errors)))), 3),
                "largest": round(float(np.abs(errors).max()), 3),
            }
        )
    )


def through(camera: dict[str, Any], lens: _Lens) -> None:
    """Give a recipe's camera another lens."""
    kind, x, y, dist = lens
    fx, fy = x * camera["width"], y * camera["width"]
    K = [[fx, 0, camera["K"][0][2]], [0, fy, camera["K"][1][2]], [0, 0, 1]]
    camera |= {"K": K, "dist": dist, "lens": kind}


def without_camera(recipe: dict[str, Any], folder: Path, taken: str, name: str) -> None:
    """What a run makes of a rendered recipe (what is `taken` of it: photos or a clip) without its camera file."""
    folder.mkdir()
    (folder / "recipe.json").write_text(json.dumps(recipe))
    simulate_scene(folder / "recipe.json", folder / "scene", SceneOptions(depth=False))
    (folder / "scene" / "camera.json").unlink()
    found: dict[str, Any] = {"name": name}
    try:
        solution = solved(folder / "scene" / taken, folder / "out")
    except RsUndistortError as error:
        print(json.dumps(found | {"error": str(error)}), flush=True)
        return
    truth = read_solution(folder / "scene" / "ground_truth.json")
    result = evaluate(folder / "out", folder / "scene" / "ground_truth.json")
    found |= {
        "lens": solution.cameras[solution.registered[0].camera_id].lens,
        "f_ratio": round(focal(solution) / recipe["camera"]["K"][0][0], 5),
        "registered": result.registered,
        "rotation_deg": None if result.rotation_deg is None else round(result.rotation_deg.median, 4),
        "psnr_db": None if result.psnr_db is None else round(result.psnr_db.median, 2),
    }
    time = solution.quality.get("readout_time")
    if time:
        true_s = truth.options["readout_ms"] / 1e3
        found["readout_error_percent"] = round(100 * (time["seconds"] / true_s - 1), 2)
        found["error_over_sigma"] = round((time["seconds"] - true_s) / time["sigma"], 2)
    print(json.dumps(found | {"verdict": solution.verdict}), flush=True)


def of_lenses(work: Path, scenes: list[str]) -> None:
    """Scenes as other lenses show them."""
    for scene, (name, lens), share in product(scenes, _LENSES.items(), (1.0, 0.0)):
        recipe = json.loads((ROOT / "sample_scenes" / scene / "recipe.json").read_text())
        through(recipe["camera"], lens)
        motion = recipe["motion"].items()
        recipe["motion"] = {key: share * value if key.endswith("_per_frame") else value for key, value in motion}
        folder = work / f"{scene}-{name}-{share:.0f}"
        without_camera(recipe, folder, "photos", f"{scene}, {name}, {'as it is' if share else 'no shutter'}")


def of_videos(work: Path, seeds: list[int]) -> None:
    """Random clips as wide lenses show them."""
    for kind, (name, lens), seed in product(("walk", "pan"), _VIDEO_LENSES.items(), seeds):
        recipe = clip_recipe(kind, seed)
        through(recipe["camera"], lens)
        without_camera(recipe, work / f"{kind}-{name}-{seed}", "clip.mp4", f"{kind} {seed}, {name}")


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--names", nargs="+", default=["herz-jesus-8", "iphone6", "phone", "dslr", "drone", "lund"])
    parser.add_argument("--clips", type=Path)
    parser.add_argument("--kinds", nargs="+", default=["walk", "vibrating"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[*range(100, 108)])
    parser.add_argument("--lenses", action="store_true")
    parser.add_argument("--scenes", nargs="+", default=["courtyard", "colonnade"])
    parser.add_argument("--videos", action="store_true")
    args = parser.parse_args()
    if args.videos:
        with tempfile.TemporaryDirectory() as folder:
            of_videos(Path(folder), args.seeds)
        return
    if args.lenses:
        with tempfile.TemporaryDirectory() as folder:
            of_lenses(Path(folder), args.scenes)
        return
    if args.clips is not None:
        of_clips(args.clips, args.kinds, args.seeds)
        return
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        clip = work / "walk.mp4"
        shutil.copy(ROOT / "sample_scenes" / "walk" / "clip.mp4", clip)
        video = solved(clip, work / "walk")
        seconds = video.quality["readout_time"]["seconds"]
        print(
            json.dumps({"name": "walk", **figures_of(video, 500.0), "readout_ms": round(1e3 * seconds, 2)}), flush=True
        )
        for name in args.names:
            photos = args.photos / name
            if not photos.is_dir():
                print(json.dumps({"name": name, "skipped": "no folder of test photos beside the project"}))
                continue
            bare = work / name
            bare.mkdir()
            for path in sorted(photos.glob("*.[jJ][pP][gG]")):
                pixels = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
                cv2.imwrite(str(bare / path.name), pixels, [cv2.IMWRITE_JPEG_QUALITY, 98])
            file = photos / "camera.json"
            known = (
                json.loads(file.read_text())["K"][0][0]
                if file.is_file()
                else focal(solved(photos, work / f"{name}-exif"))
            )
            print(json.dumps({"name": name, **figures_of(solved(bare, work / f"{name}-bare"), known)}), flush=True)


if __name__ == "__main__":
    main()
