"""What depth is worth where the camera travelled during the readout: prints one JSON object a line.

    python benchmarks/depth.py [--scenes NAME ...]

`flyover` of sample_scenes and `street` (benchmarks/street.json, rendered here: 5 % of the median depth a frame) are
solved from their photos and rectified at infinity, on the plane, and as the points; the same with the true motion and
the renderer's depths says what can be reached. Scenes without translation must not lose by it, also when the
constant-motion model is forced upon them. PSNR is that against the global-shutter references, over pixels that are
valid in all of the compared photos. Exits 1 if a figure is missing, never because one missed its target.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from rsundistort import (
    Camera,
    DepthMap,
    Plane,
    RowMotion,
    RunOptions,
    SolveOptions,
    init_rectify_map,
    read_solution,
    rectify,
    rectify_folder,
    run,
)
from rsundistort.batch import use_threads
from rsundistort.batch.geometry import SceneGeometry, ScenePoints
from rsundistort.evaluation import psnr
from rsundistort.io import read_photo
from rsundistort.simulate import simulate_scene
from rsundistort.synthetic import load_recipe, render_depth

ROOT = Path(__file__).resolve().parent.parent
STILL = ("courtyard", "handheld", "colonnade")
MOVING = ("flyover", "street")


def show(name: str, **figures: Any) -> None:
    """Print one JSON line."""
    print(json.dumps({"name": name, **figures}), flush=True)


def against_references(scene: Path, folders: dict[str, Path]) -> dict[str, list[float]]:
    """PSNR in dB of each photo of each folder of outputs, over what all of them show."""
    truth = read_solution(scene / "ground_truth.json")
    found: dict[str, list[float]] = {name: [] for name in folders}
    for image in truth.images:
        if not all((out / "images" / image.name).is_file() for out in folders.values()):
            continue
        reference = read_photo(scene / "global" / image.name).pixels
        camera = truth.cameras[image.camera_id]
        masks = [read_photo(out / "masks" / f"{Path(image.name).stem}.png").pixels for out in folders.values()]
        if camera.dist.any():
            reference, seen = rectify(reference, camera)
            masks.append(seen)
        for name, out in folders.items():
            pixels = read_photo(out / "images" / image.name).pixels
            found[name].append(psnr(pixels, reference, np.min(masks, axis=0)))
    return found


def summary(values: list[float]) -> dict[str, float]:
    """Median and worst, rounded."""
    return {"median": round(statistics.median(values), 2), "worst": round(min(values), 2)}


def reachable(scene: Path) -> None:
    """True motion with the renderer's depths: the upper bound."""
    recipe, truth = load_recipe(scene / "recipe.json"), read_solution(scene / "ground_truth.json")
    far, near, plain = [], [], []
    for image, view in zip(truth.images, recipe.views, strict=True):
        assert image.motion is not None
        assert image.R_cw is not None
        camera, motion = truth.cameras[image.camera_id], image.motion.in_camera(image.R_cw)
        raw, reference = (read_photo(scene / folder / image.name).pixels for folder in ("photos", "global"))
        depth = render_depth(recipe.scene, camera, view.at_once())
        without, seen = rectify(raw, camera, motion, "constant-motion")
        flat, _ = rectify(raw, camera, motion, "constant-motion", depth=Plane([0, 0, 1], float(np.median(depth))))
        whole, mask = rectify(raw, camera, motion, "constant-motion", depth=DepthMap(depth))
        mask = np.minimum(mask, seen)
        far.append(psnr(without, reference, mask))
        plain.append(psnr(flat, reference, mask))
        near.append(psnr(whole, reference, mask))
    show(
        f"{scene.name}, true motion", infinity_db=summary(far), median_depth_db=summary(plain),
        true_depth_db=summary(near),
    )  # fmt: skip


def estimated(scene: Path, work: Path) -> None:
    """The whole run, and its solution rectified with other depths."""
    import pycolmap

    out = work / f"{scene.name}-auto"
    solution = run(scene / "photos", out, RunOptions())
    folders = {"auto": out}
    if solution.shutter_model == "constant-motion":
        for depth in ("infinity", "plane", "points"):
            folders[depth] = work / f"{scene.name}-{depth}"
            rectify_folder(scene / "photos", out / "solution.json", folders[depth], depth=depth)
    else:
        folders["infinity"] = out
    figures = against_references(scene, folders)
    used = [image.depth for image in solution.registered if image.depth]
    show(
        f"{scene.name}, estimated motion and depth",
        shutter_model=solution.shutter_model,
        used={kind: used.count(kind) for kind in sorted(set(used))},
        **{f"{name}_db": summary(values) for name, values in figures.items()},
        gain_db=summary([a - b for a, b in zip(figures["auto"], figures["infinity"], strict=True)]),
        rms_px=round(solution.quality["rms_px"], 3),
        sparse_reprojection_px=round(pycolmap.Reconstruction(out / "sparse").compute_mean_reprojection_error(), 3),
        target="gain >= 4 dB; reprojection near sqrt(pi/2) of rms" if scene.name in MOVING else "gain >= -0.2 dB",
    )


def forced(scene: Path, work: Path) -> None:
    """Constant-motion forced on a scene whose camera only rotated."""
    folders = {depth: work / f"{scene.name}-forced-{depth}" for depth in ("auto", "infinity")}
    options = RunOptions(solve=SolveOptions(shutter_model="constant-motion"))
    solution = run(scene / "photos", folders["auto"], options)
    rectify_folder(scene / "photos", folders["auto"] / "solution.json", folders["infinity"], depth="infinity")
    figures = against_references(scene, folders)
    used = [image.depth for image in solution.registered if image.depth]
    show(
        f"{scene.name}, constant-motion forced",
        used={kind: used.count(kind) for kind in sorted(set(used))},
        **{f"{name}_db": summary(values) for name, values in figures.items()},
        gain_db=summary([a - b for a, b in zip(figures["auto"], figures["infinity"], strict=True)]),
        target="gain >= -0.2 dB",
    )


def median_ms(work: Any, repeat: int = 7) -> float:
    """Median time of a call in ms, after one that compiles."""
    work()
    seconds = []
    for _ in range(repeat):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return round(1e3 * statistics.median(seconds), 1)


def cost(out: Path) -> None:
    """What depths of a photo cost, and grids of 12 megapixels, on one thread."""
    solution = read_solution(out / "solution.json")
    names = [image.name for image in solution.registered]
    scene = SceneGeometry(solution, "auto", ScenePoints.of_colmap_model(out / "sparse", names, "tif"))
    show("depth of a photo from its points", ms=median_ms(lambda: scene.of(names[1]).find_depth()), target="<= 100 ms")
    camera = Camera(4000, 3000, np.array([[3200.0, 0, 1999.5], [0, 3200.0, 1499.5], [0, 0, 1]]), [-0.1, 0.02, 0, 0])
    motion = RowMotion([0.02, 0.01, 0.01], [0.3, 0.1, 0.0])
    rng = np.random.default_rng(0)
    coarse = rng.uniform(6, 12, (72, 96)).astype(np.float32)
    steps = np.where(np.indices((3000, 4000)).sum(0) // 500 % 2, 6.0, 12.0).astype(np.float32)
    grids = {
        "infinity": None,
        "plane": Plane([0, 0.3, 1], 8.0),
        "map of points": DepthMap(coarse, (4000, 3000)),
        "own map": DepthMap(steps),
    }
    times = {
        name: median_ms(lambda d=depth: init_rectify_map(camera, motion, "constant-motion", depth=d), 3)
        for name, depth in grids.items()
    }
    show("grid of 12 megapixels, one thread", ms=times)


def main() -> None:
    """Measure all that was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=[*MOVING, *STILL], choices=[*MOVING, *STILL])
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    use_threads(0)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for name in args.scenes:
            scene = ROOT / "sample_scenes" / name
            if name == "street":
                scene = work / name
                simulate_scene(ROOT / "benchmarks" / "street.json", scene)
            if name in MOVING:
                reachable(scene)
            estimated(scene, work)
            if name in STILL:
                forced(scene, work)
            elif name == args.scenes[0]:
                cost(work / f"{name}-auto")


if __name__ == "__main__":
    main()
