"""Random clips of rendered scenes, with their truth, for benchmarks of video; kept in a folder, rendered once.

    python benchmarks/clips.py FOLDER [--kind KIND ...] [--seeds N] [--frames N]

Renders clips of each kind and prints one JSON object a line: how strong the shutter is, and how long rendering took.

    walk    a walk with a hand's tremor, from gentle to wild; readout 0.2 to 0.9 of the frame's time
    level   the same, held level at all times: all y axes are parallel
    pan     from a tripod, so that there is no parallax
    two     two frames while the camera rotates by 2 to 4 degrees a readout
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from rsundistort import read_solution
from rsundistort.simulate import SceneOptions, simulate_scene

KINDS = ("walk", "level", "pan", "two")
WIDTH, HEIGHT, FOCAL_PX = 640, 360, 500.0
# 4 samples a pixel: a frame is 41 dB from one of 64, which is less than its noise would be; 16 take three times as long
SAMPLES = 4
_DEPTH_M, _HALF_WIDTH_M = 13.0, 8.0


def texture(kind: str, size_m: tuple[float, float], colour: tuple[int, int, int], **options: Any) -> dict[str, Any]:
    """A texture of moderate size, so that it is made in a second."""
    return {"kind": kind, "size_m": size_m, "texels_per_m": 64, "colour": colour, **options}


TEXTURES = {
    "paving": texture(
        "blocks", (8, 8), (163, 155, 142), joint_colour=(98, 92, 80), course_m=0.34, length_m=0.5, joint_m=0.028
    ),
    "plaster": texture("plaster", (16, 6), (219, 186, 134), fallen=0.25, weather=0.8),
    "brick": texture(
        "blocks", (8, 4), (158, 96, 70), joint_colour=(182, 168, 148), course_m=0.12, length_m=0.3, joint_m=0.017
    ),
    "stone": texture(
        "blocks", (8, 4), (186, 176, 156), joint_colour=(136, 128, 114), course_m=0.3, length_m=0.55, joint_m=0.025
    ),
    "planks": texture("planks", (4, 4), (146, 104, 66)),
    "leaves": texture("foliage", (3, 3), (96, 128, 52)),
}


def surfaces(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Ground, three walls, and boxes between them and the camera's place."""
    w, d = _HALF_WIDTH_M, _DEPTH_M

    def wall(origin: list[float], edge: list[float], name: str) -> dict[str, Any]:
        return {"kind": "rectangle", "origin_w": origin, "edge_a": edge, "edge_b": [0, 0, 6], "texture": name}

    found = [
        {"kind": "rectangle", "origin_w": [-w, -3, 0], "edge_a": [2 * w, 0, 0], "edge_b": [0, d + 3, 0],
         "texture": "paving"},
        wall([-w, d, 0], [2 * w, 0, 0], "plaster"),
        wall([-w, -3, 0], [0, d + 3, 0], "brick"),
        wall([w, d, 0], [0, -d - 3, 0], "stone"),
    ]  # fmt: skip
    # one in each of twelve cells, so that the whole view has things near and far
    for cell in range(12):
        x, y = -6 + 4 * (cell % 4), 4.0 + 2.7 * (cell // 4)
        found.append({
            "kind": "box", "texture": str(rng.choice(["brick", "stone", "planks", "leaves"])),
            "center_w": [float(x + rng.uniform(-1, 1)), float(y + rng.uniform(-0.7, 0.7)), 0.0],
            "size_m": [*rng.uniform(0.4, 1.2, 2).tolist(), float(rng.uniform(0.5, 2.6))],
            "yaw_deg": float(rng.uniform(0, 90)),
        })  # fmt: skip
    return found


def path(kind: str, rng: np.random.Generator, num_frames: int) -> dict[str, Any]:
    """The path of a clip."""
    readout = float(rng.uniform(0.2, 0.9))
    # gentle to wild: a hand that films carefully, and one that runs
    tremor = {"rotation_deg": float(np.exp(rng.uniform(np.log(0.4), np.log(4.0)))), "hz": [1, 12], "num": 5}
    side = float(rng.choice([-1, 1]))
    entry: dict[str, Any] = {"fps": 30, "num_frames": num_frames, "readout": readout}

    def look(center: Any, yaw: float, pitch: float) -> list[float]:
        return (np.asarray(center) + 6 * np.array([np.sin(yaw), np.cos(yaw), np.tan(pitch)])).tolist()

    if kind == "two":
        readout = float(rng.uniform(0.4, 0.8))
        # about a random axis that is not that of the view, which would hardly move the middle of the photo
        axis = rng.normal(size=3) * [1, 1, 0.5]
        pitch, yaw, roll = rng.uniform(0.03, 0.06) / readout * axis / np.linalg.norm(axis[:2])
        centers = np.array([[0, 0.5, 1.5], [0.25 * side, 0.6, 1.55]])
        way = [
            {"center_w": c.tolist(), "look_at_w": look(c, s * yaw, s * pitch), "roll_deg": float(np.degrees(s * roll))}
            for c, s in zip(centers, (-0.5, 0.5), strict=True)
        ]
        return {**entry, "kind": "walk", "fps": 15, "num_frames": 2, "readout": readout, "way": way}
    yaws, pitches, rolls = (rng.uniform(-a, a, 4) for a in (0.25, 0.08, 0.05))
    if kind == "pan":
        center = [float(rng.uniform(-2, 2)), 0.5, 1.6]
        turn = np.linspace(-0.5, 0.5, 4) * side * rng.uniform(0.3, 1.0)
        way = [
            {"look_at_w": look(center, yaw, pitch), "roll_deg": float(np.degrees(roll))}
            for yaw, pitch, roll in zip(turn, pitches, rolls, strict=True)
        ]
        return {**entry, "kind": "pan", "center_w": center, "tremor": tremor, "way": way}
    length = 1.2 * num_frames / 30
    places = np.column_stack([
        side * np.linspace(-length / 2, length / 2, 4) + rng.uniform(-1, 1),
        rng.uniform(0.2, 1.2, 4), rng.uniform(1.4, 1.8, 4),
    ])  # fmt: skip
    way = [{"center_w": c.tolist(), "look_at_w": look(c, y, p)} for c, y, p in zip(places, yaws, pitches, strict=True)]
    if kind == "walk":
        for point, roll in zip(way, rolls, strict=True):
            point["roll_deg"] = float(np.degrees(roll))
    steps = {"hz": float(rng.uniform(1.6, 2.2)), "up_m": 0.025, "side_m": 0.02}
    tremor["travel_m"] = 0.005
    return {**entry, "kind": "walk", "tremor": tremor, "steps": steps, "way": way, "level": kind == "level"}


def clip_recipe(kind: str, seed: int, num_frames: int = 60) -> dict[str, Any]:
    """The recipe of a random clip; the same kind and seed give the same.

    Of 40 to 150 frames: the way points are as many, so that shorter ones rotate faster; longer ones leave the yard.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    K = [[FOCAL_PX, 0, WIDTH / 2 + 1.5], [0, FOCAL_PX, HEIGHT / 2 - 1.75], [0, 0, 1]]
    return {
        "format": "rsundistort-recipe", "version": 1, "name": f"{kind}-{seed}", "seed": 1000 + seed,
        "camera": {"width": WIDTH, "height": HEIGHT, "K": K, "dist": [], "readout": "top-to-bottom"},
        "render": {"samples": SAMPLES, "spread_px": 0.7, "exposure": 2.0, "jpeg_quality": 95},
        "light": {"sun_azimuth_deg": 235, "sun_elevation_deg": 43, "sun": [1.45, 1.28, 1.04]},
        "points": 300, "path": path(kind, rng, num_frames), "twins": {"every": 1 if kind == "two" else 10},
        "textures": TEXTURES, "surfaces": surfaces(rng),
    }  # fmt: skip


def clip_folder(work: Path, kind: str, seed: int, num_frames: int = 60) -> Path:
    """The folder of a random clip below `work`, as `simulate_scene` writes it; rendered where it is not there yet."""
    recipe = json.dumps(clip_recipe(kind, seed, num_frames), indent=1)
    folder = work / f"{kind}-{seed}-{hashlib.sha256(recipe.encode()).hexdigest()[:8]}"
    if not (folder / "ground_truth.json").is_file():
        work.mkdir(parents=True, exist_ok=True)
        named = work / f"{folder.name}.json"
        named.write_text(recipe)
        simulate_scene(named, folder, SceneOptions(depth=False, overwrite=True))
        named.unlink()
    return folder


def main() -> None:
    """Render clips, and describe them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", choices=KINDS, nargs="+", default=KINDS)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--frames", type=int, default=60)
    args = parser.parse_args()
    for kind in args.kind:
        for seed in range(args.seeds):
            began, cpu = time.perf_counter(), time.process_time()
            folder = clip_folder(args.folder, kind, seed, args.frames)
            seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
            truth = read_solution(folder / "ground_truth.json")
            span = truth.cameras["1"].frame_span
            turns = [np.degrees(np.linalg.norm(image.motion.phi)) * span for image in truth.images if image.motion]
            shifts = [image.rs_shift_px or 0.0 for image in truth.images]
            value = {
                "clip": folder.name, "frames": len(shifts), "seconds": round(seconds, 1), "cpu_s": round(cpu, 1),
                "readout_ms": round(truth.options["readout_ms"], 2),
                "degrees_a_frame": round(float(np.median(turns)), 2),
                "shift_px": [round(float(each), 1) for each in (np.median(shifts), np.max(shifts))],
                "megabytes": round((folder / "clip.mp4").stat().st_size / 1e6, 2),
            }  # fmt: skip
            print(json.dumps(value), flush=True)


if __name__ == "__main__":
    main()
