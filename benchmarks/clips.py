"""Random clips of rendered scenes, with their truth, for benchmarks of video; kept in a folder, rendered once.

    python benchmarks/clips.py FOLDER [--kind KIND ...] [--seeds N] [--frames N]

Renders clips of each kind and prints one JSON object a line: how strong the shutter is, and how long rendering took.

    walk    a walk with a hand's tremor, from gentle to wild; readout 0.2 to 0.9 of the frame's time
    level   the same, held level at all times: all y axes are parallel
    pan     from a tripod, so that there is no parallax
    arm     a pan at arm's length, by who turns around: the camera travels on an arc
    two     two frames while the camera rotates by 2 to 4 degrees a readout
    street  a walk along a street, of a phone's or an action camera's 854x480; at 1.2 m a second
    round   the same size, round a thing again and again, as who scans it: once in ten seconds, each time at another
            height and distance; at least 300 frames, so that all of the yard is seen
    vibrating  a walk that shakes at up to 24 Hz, with 30 frames a second
    gimbal  three seconds along a street, level and without any tremor, while the camera yaws to and fro. The last five
            only if asked for
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

SHORT = ("walk", "level", "pan", "two")
KINDS = (*SHORT, "street", "round", "vibrating", "gimbal", "arm")
WIDTH, HEIGHT, FOCAL_PX = 640, 360, 500.0
# 4 samples a pixel: a frame is 41 dB from one of 64, which is less than its noise would be; 16 take three times as long
SAMPLES = 4
# Of long videos.
LONG = 854, 480, 640.0
_DEPTH_M, _HALF_WIDTH_M = 13.0, 8.0
# A stretch of the street has textures of its own: these repeat themselves, and a street must not.
_STRETCH_M, _STREET_M = 12.0, 9.0
_SPEED = 1.2
_ROUND_S = 10.0


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


def yard(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Ground, four walls, a group of boxes in the middle, and some before the walls: a way leads round the middle."""
    half = 9.0
    found: list[dict[str, Any]] = [{
        "kind": "rectangle", "origin_w": [-half, -half, 0], "edge_a": [2 * half, 0, 0], "edge_b": [0, 2 * half, 0],
        "texture": "paving",
    }]  # fmt: skip
    corners = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * half
    for k, name in enumerate(("plaster", "stone", "brick", "planks")):
        edge = corners[(k + 1) % 4] - corners[k]
        found.append({
            "kind": "rectangle", "origin_w": [*corners[k].tolist(), 0], "edge_a": [*edge.tolist(), 0],
            "edge_b": [0, 0, 6], "texture": name,
        })  # fmt: skip
    for near in (True, False):
        for turn in np.linspace(0, 2 * np.pi, 6 if near else 14, endpoint=False) + rng.uniform(0, 0.3):
            away = rng.uniform(0.5, 1.4) if near else rng.uniform(6.5, 7.8)
            found.append({
                "kind": "box", "texture": str(rng.choice(["brick", "stone", "planks", "leaves"])),
                "center_w": [float(away * np.cos(turn)), float(away * np.sin(turn)), 0.0],
                "size_m": [*rng.uniform(0.4, 1.0, 2).tolist(), float(rng.uniform(0.5, 2.0))],
                "yaw_deg": float(rng.uniform(0, 90)),
            })  # fmt: skip
    return found


def street(rng: np.random.Generator, length_m: float) -> tuple[list[dict[str, Any]], dict[str, dict[str, Any]]]:
    """Ground, walls on both sides and boxes before them, along y; and their textures."""
    found, textures = [], {}

    def own(kind: str, k: int, size_m: tuple[float, float]) -> str:
        name = f"{kind}-{k}"
        colour = np.clip(np.array(TEXTURES[kind]["colour"]) + rng.integers(-25, 26, 3), 30, 230)
        textures[name] = {**TEXTURES[kind], "size_m": size_m, "colour": colour.tolist()}
        return name

    half, high = _STREET_M / 2, 7.0
    num = int(np.ceil((length_m + 30) / _STRETCH_M))
    for k in range(num):
        y = k * _STRETCH_M - 6
        found.append({
            "kind": "rectangle", "origin_w": [-half, y, 0], "edge_a": [_STREET_M, 0, 0], "edge_b": [0, _STRETCH_M, 0],
            "texture": own("paving", k, (_STREET_M, _STRETCH_M)),
        })  # fmt: skip
        for side in (-1, 1):
            kind = str(rng.choice(["plaster", "brick", "stone"]))
            ends = (y, _STRETCH_M) if side < 0 else (y + _STRETCH_M, -_STRETCH_M)
            found.append({
                "kind": "rectangle", "origin_w": [side * half, ends[0], 0], "edge_a": [0, ends[1], 0],
                "edge_b": [0, 0, high], "texture": own(kind, 2 * k + (side > 0), (_STRETCH_M, high)),
            })  # fmt: skip
            for cell in range(0 if k else 2, 3):  # none behind the first frame
                found.append({
                    "kind": "box", "texture": str(rng.choice(["brick", "stone", "planks", "leaves"])),
                    "center_w": [side * float(rng.uniform(1.9, 3.6)), y + 4.0 * cell + float(rng.uniform(1, 3)), 0.0],
                    "size_m": [*rng.uniform(0.4, 1.2, 2).tolist(), float(rng.uniform(0.5, 2.6))],
                    "yaw_deg": float(rng.uniform(0, 90)),
                })  # fmt: skip
    found.append({
        "kind": "rectangle", "origin_w": [-half, num * _STRETCH_M - 6, 0], "edge_a": [_STREET_M, 0, 0],
        "edge_b": [0, 0, high], "texture": own("plaster", 2 * num, (_STREET_M, high)),
    })  # fmt: skip
    return found, TEXTURES | textures


def long_path(kind: str, rng: np.random.Generator, num_frames: int) -> dict[str, Any]:
    """The path of a long video: along the street, or round the middle of the yard."""
    seconds = num_frames / 30
    num = max(4, round(seconds / 1.5) + 1)
    if kind == "street":
        y = np.linspace(0, _SPEED * seconds, num)
        places = np.column_stack([rng.uniform(-0.6, 0.6, num), y, rng.uniform(1.4, 1.8, num)])
        yaw, pitch = rng.uniform(-0.7, 0.7, num), rng.uniform(-0.12, 0.08, num)
        targets = places + 6 * np.column_stack([np.sin(yaw), np.cos(yaw), np.tan(pitch)])
    else:
        turn = 2 * np.pi * np.linspace(0, seconds / _ROUND_S, num)
        away, high = rng.uniform(3.2, 4.4, num), rng.uniform(1.2, 2.2, num)
        places = np.column_stack([away * np.cos(turn), away * np.sin(turn), high])
        targets = np.column_stack([rng.uniform(-0.4, 0.4, (num, 2)), rng.uniform(0.4, 1.2, num)])
    way = [
        {"center_w": c.tolist(), "look_at_w": t.tolist(), "roll_deg": float(rng.uniform(-2, 2))}
        for c, t in zip(places, targets, strict=True)
    ]
    return {
        "kind": "walk", "fps": 30, "num_frames": num_frames, "readout": 0.5, "way": way,
        "tremor": {"rotation_deg": 1.2, "travel_m": 0.005, "hz": [1, 12], "num": 5},
        "steps": {"hz": 1.9, "up_m": 0.025, "side_m": 0.02},
    }  # fmt: skip


def gimbal_path(rng: np.random.Generator, num_frames: int) -> dict[str, Any]:
    """The path of a camera on a gimbal, or of a drone's, that flies along the street and yaws to and fro."""
    time_s = np.linspace(0.0, num_frames / 30, 13)
    speed, far, fast = (float(rng.uniform(*limits)) for limits in ((1.5, 6.0), (0.3, 0.6), (1.0, 1.6)))
    yaw = far * np.sin(fast * time_s + rng.uniform(0.0, 2 * np.pi))
    side, high = rng.uniform(-0.5, 0.5), rng.uniform(1.6, 3.0)
    places = np.column_stack([np.full(len(time_s), side), speed * time_s, np.full(len(time_s), high)])
    targets = places + 6 * np.column_stack([np.sin(yaw), np.cos(yaw), np.zeros(len(time_s))])
    way = [{"center_w": c.tolist(), "look_at_w": t.tolist()} for c, t in zip(places, targets, strict=True)]
    readout = float(rng.uniform(0.3, 0.9))
    return {"kind": "walk", "fps": 30, "num_frames": num_frames, "readout": readout, "way": way, "level": True}


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
    if kind == "arm":
        turn = np.linspace(-0.5, 0.5, 7) * side * rng.uniform(0.6, 1.0)
        ahead = np.column_stack([np.sin(turn), np.cos(turn), np.zeros(7)])
        arc = [rng.uniform(-2, 2), 0.3, 1.6] + rng.uniform(0.3, 0.6) * ahead
        pitch = float(pitches[0])
        way = [{"center_w": c.tolist(), "look_at_w": look(c, yaw, pitch)} for c, yaw in zip(arc, turn, strict=True)]
        return {**entry, "kind": "walk", "tremor": tremor | {"travel_m": 0.005}, "way": way}
    length = 1.2 * num_frames / 30
    places = np.column_stack([
        side * np.linspace(-length / 2, length / 2, 4) + rng.uniform(-1, 1),
        rng.uniform(0.2, 1.2, 4), rng.uniform(1.4, 1.8, 4),
    ])  # fmt: skip
    way = [{"center_w": c.tolist(), "look_at_w": look(c, y, p)} for c, y, p in zip(places, yaws, pitches, strict=True)]
    if kind == "vibrating":
        tremor = {"rotation_deg": float(np.exp(rng.uniform(np.log(0.4), np.log(2.0)))), "hz": [1, 24], "num": 5}
    if kind != "level":
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
    is_long = kind in ("street", "round")
    width, height, focal_px = LONG if is_long else (WIDTH, HEIGHT, FOCAL_PX)
    K = [[focal_px, 0, width / 2 + 1.5], [0, focal_px, height / 2 - 1.75], [0, 0, 1]]
    if kind == "gimbal":
        taken = gimbal_path(rng, num_frames)
    else:
        taken = (long_path if is_long else path)(kind, rng, num_frames)
    if kind == "gimbal":
        around, textures = street(rng, taken["way"][-1]["center_w"][1])
    elif kind == "street":
        around, textures = street(rng, _SPEED * num_frames / 30)
    else:
        around, textures = yard(rng) if kind == "round" else surfaces(rng), TEXTURES
    return {
        "format": "rsundistort-recipe", "version": 1, "name": f"{kind}-{seed}", "seed": 1000 + seed,
        "camera": {"width": width, "height": height, "K": K, "dist": [], "readout": "top-to-bottom"},
        "render": {"samples": 2 if is_long else SAMPLES, "spread_px": 0.7, "exposure": 2.0, "jpeg_quality": 95},
        "light": {"sun_azimuth_deg": 235, "sun_elevation_deg": 43, "sun": [1.45, 1.28, 1.04]},
        "points": 300, "path": taken, "twins": {"every": 1 if kind == "two" else 100 if is_long else 10},
        "textures": textures, "surfaces": around,
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
    parser.add_argument("--kind", choices=KINDS, nargs="+", default=SHORT)
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
