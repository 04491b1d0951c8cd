"""How true the truth is: prints one JSON object a line, and exits 1 if a figure is missing.

    python benchmarks/truth.py [--photos DIR] [--seeds N] [--all]

Photos that were simulated and rectified with their TRUE motion must come back to what no shutter bent: real photos
(herz-jesus-8 in the folder of test photos, default ../shared/photos) warped by `simulate warp`, and every folder of
sample_scenes against its references. What is lost here no solution can win back. Then: whether the sample scenes are
what their recipes make (one photo of each and its reference; --all: every file), and how long rendering takes. Targets
are printed beside the figures; a figure that misses its target is not an error of the program.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rsundistort import Camera, DepthMap, RowMotion, Solution, read_solution, rectify
from rsundistort.batch import use_threads
from rsundistort.evaluation import psnr
from rsundistort.io import read_photo
from rsundistort.io.video import extract_frames
from rsundistort.simulate import SceneOptions, WarpOptions, simulate_scene, simulate_warp
from rsundistort.simulate.render_folder import _encode_jpeg
from rsundistort.synthetic import add_noise, load_recipe, render_depth, render_view, warp_photo

ROOT = Path(__file__).resolve().parent.parent
SCENES = ROOT / "sample_scenes"


def show(name: str, **figures: Any) -> None:
    """Print one JSON line."""
    print(json.dumps({"name": name, **figures}), flush=True)


def median_and_worst(values: list[float]) -> dict[str, float]:
    return {"median": round(float(np.median(values)), 2), "worst": round(float(np.min(values)), 2)}


def against_reference(raw: np.ndarray, reference: np.ndarray, camera: Camera, motion: RowMotion) -> float:
    """PSNR in dB, over valid pixels, of a photo freed of shutter and lens against its reference freed of the lens."""
    rectified, mask = rectify(raw, camera, motion)
    if not camera.is_pinhole:
        reference, seen = rectify(reference, camera)
        mask = np.minimum(mask, seen)
    return psnr(rectified, reference, mask)


def warped_photos(photos: Path, work: Path, seeds: int) -> None:
    """Real photos warped and taken back, and what of the loss is the interpolation's and what the JPEG file's."""
    for seed in range(seeds):
        out = work / f"warped-{seed}"
        truth = simulate_warp(photos, out, WarpOptions(sigma_rad=0.05, seed=seed))
        camera = truth.cameras["1"]
        whole, interpolated, stored = [], [], []
        for image in truth.images:
            assert image.motion is not None
            original = read_photo(photos / image.name).pixels
            raw = read_photo(out / "photos" / image.name).pixels
            warped, mask = warp_photo(original, camera, image.motion)
            whole.append(against_reference(raw, original, camera, image.motion))
            interpolated.append(against_reference(warped, original, camera, image.motion))
            stored.append(psnr(raw, warped, mask))
        show(
            f"herz-jesus-8 warped by 0.05, seed {seed}, true motion",
            psnr_db=median_and_worst(whole),
            without_jpeg_db=median_and_worst(interpolated),
            jpeg_98_alone_db=median_and_worst(stored),
            target=">= 42 dB median",
        )


def scene_references(scene: Path, truth: Solution) -> None:
    """Photos of a sample scene, rectified with their true motion, against their references."""
    after, before, moving = [], [], []
    for image in truth.images:
        assert image.motion is not None
        camera = truth.cameras[image.camera_id]
        raw, reference = (read_photo(scene / folder / image.name).pixels for folder in ("photos", "global"))
        after.append(against_reference(raw, reference, camera, image.motion))
        before.append(against_reference(raw, reference, camera, RowMotion()))
        if image.motion.velocity.any():
            moving.append(image.name)
    show(
        f"{scene.name}, true rotation against the references",
        psnr_db=median_and_worst(after),
        psnr_before_db=median_and_worst(before),
        translating_photos=f"{len(moving)}/{len(truth.images)}",
        target="none: rotation alone does not undo translation" if moving else ">= 38 dB",
    )
    if moving:
        rotating_references(scene, truth)


def rotating_references(scene: Path, truth: Solution, photos: int = 3) -> None:
    """Photos of a scene whose camera also travels, rendered with the rotation alone and rectified with it."""
    recipe, after = load_recipe(scene / "recipe.json"), []
    bent = np.argsort([-(image.rs_shift_px or 0.0) for image in truth.images])
    for view in (recipe.views[number] for number in bent[:photos]):
        camera, motion = recipe.camera(view), RowMotion(phi=view.motion.phi)
        raw = render_view(recipe.scene, camera, replace(view, motion=motion), **recipe.render_options)
        reference = render_view(recipe.scene, camera, view.at_once(), **recipe.render_options)
        after.append(against_reference(raw, reference, camera, motion))
    show(
        f"{scene.name} rendered without its translation, true rotation against the references",
        psnr_db=median_and_worst(after),
        photos=f"the {len(after)} that the shutter bends most, before JPEG",
        target=">= 38 dB",
    )


def clip_references(scene: Path, truth: Solution) -> None:
    """Frames of a clip, rectified with true motion and depth, against the references; and what the coding costs."""
    recipe, after, before, coded = load_recipe(scene / "recipe.json"), [], [], []
    with tempfile.TemporaryDirectory() as work:
        frames = Path(work) / "frames"
        extract_frames(scene / "clip.mp4", frames, every=recipe.clip.references_every if recipe.clip else 1)
        for view in recipe.references:
            camera, image = recipe.camera(view), truth.image(view.name)
            assert image.motion is not None
            assert image.R_cw is not None
            raw = read_photo(frames / view.name).pixels
            reference = read_photo((scene / "global" / view.name).with_suffix(".jpg")).pixels
            depth = DepthMap(render_depth(recipe.scene, camera, view.at_once()))
            motion = image.motion.in_camera(image.R_cw)
            rectified, mask = rectify(raw, camera, motion, "constant-motion", depth=depth)
            after.append(psnr(rectified, reference, mask))
            before.append(psnr(raw, reference, mask))
            coded.append(psnr(raw, render_view(recipe.scene, camera, view, **recipe.render_options)))
    show(
        f"{scene.name}, true motion and depth against the references",
        psnr_db=median_and_worst(after),
        psnr_before_db=median_and_worst(before),
        coding_alone_db=median_and_worst(coded),
        target=">= 35 dB",
    )


def made_again(scene: Path, folder: Path) -> None:
    """One photo of a sample scene, the most bent one, and its reference, as the recipe renders them now."""
    recipe, truth = load_recipe(scene / "recipe.json"), read_solution(scene / "ground_truth.json")
    number = int(np.argmax([image.rs_shift_px or 0.0 for image in truth.images]))
    view = recipe.views[number]
    for kind, each in (("photos", view), ("global", view.at_once())):
        photo = render_view(recipe.scene, recipe.camera(view), each, **recipe.render_options)
        if kind == "photos":
            photo = add_noise(photo, recipe.noise, recipe.scene.seed, number)
        (folder / kind).mkdir(parents=True)
        (folder / kind / view.name).write_bytes(_encode_jpeg(photo, recipe.jpeg_quality))


def scene_again(scene: Path, folder: Path, everything: bool) -> None:
    """Files of a sample scene against those that its recipe makes now."""
    if everything:
        simulate_scene(scene / "recipe.json", folder, SceneOptions(depth=False))
    else:
        made_again(scene, folder)
    same, different, missing, figures = [], [], [], []
    for path in sorted(each for each in folder.rglob("*") if each.is_file()):
        name = path.relative_to(folder).as_posix()
        committed = scene / name
        if not committed.is_file():
            missing.append(name)
        elif committed.read_bytes() == path.read_bytes():
            same.append(name)
        else:
            different.append(name)
            if path.suffix == ".jpg":
                figures.append(psnr(read_photo(path).pixels, read_photo(committed).pixels))
    show(
        f"{scene.name} made again",
        identical=f"{len(same)}/{len(same) + len(different) + len(missing)}",
        different=different,
        not_committed=missing,
        lowest_psnr_db=round(min(figures), 2) if figures else None,
        target="all identical on the machine, and with the versions, that made them",
    )


def rendering_time(repeat: int = 3) -> None:
    """Seconds for one megapixel of the courtyard, without the file and without compiling."""
    use_threads(0)
    recipe = load_recipe(SCENES / "courtyard" / "recipe.json")
    view = recipe.views[3]
    small = recipe.camera(view)
    factor = (1e6 / (small.width * small.height)) ** 0.5
    K = np.array(small.K)
    K[:2] *= factor
    camera = replace(small, width=round(small.width * factor), height=round(small.height * factor), K=K)
    options = {key: value for key, value in recipe.render_options.items() if key != "samples"}
    render_view(recipe.scene, small, view, samples=1, **options)  # compiles, and makes the textures
    for samples, target in ((4, "<= 2 s on two cores"), (16, "none")):
        seconds, cpu = [], []
        for _ in range(repeat):
            began, cpu_began = time.perf_counter(), time.process_time()
            render_view(recipe.scene, camera, view, samples=samples, **options)
            seconds.append(time.perf_counter() - began)
            cpu.append(time.process_time() - cpu_began)
        show(
            f"rendering {camera.width}x{camera.height}, {samples} samples a pixel",
            seconds=round(float(np.median(seconds)), 2),
            cpu_seconds=round(float(np.median(cpu)), 2),  # of all threads together
            megapixels=round(camera.width * camera.height / 1e6, 3),
            threads=cv2.getNumThreads(),
            target=target,
        )


def main() -> None:
    """Measure all that can be measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--all", action="store_true", help="make all files of the sample scenes again")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        rendering_time()
        if (args.photos / "herz-jesus-8").is_dir():
            warped_photos(args.photos / "herz-jesus-8", work, args.seeds)
        else:
            show("real photos", skipped=f"no folder {args.photos.name} of test photos beside the project")
        scenes = sorted(path.parent for path in SCENES.glob("*/ground_truth.json"))
        clips = [scene for scene in scenes if (scene / "clip.mp4").is_file()]
        for scene in scenes:
            truth = read_solution(scene / "ground_truth.json")
            (clip_references if scene in clips else scene_references)(scene, truth)
        # a clip is made again as a whole, which takes minutes
        for scene in scenes if args.all else [scene for scene in scenes if scene not in clips]:
            scene_again(scene, work / scene.name, args.all)


if __name__ == "__main__":
    main()
