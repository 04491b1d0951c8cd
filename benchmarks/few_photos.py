"""Few real photos, without a shutter or warped by motions of several kinds: what is said of them, and what is harmed.

    python benchmarks/few_photos.py [--photos DIR] [--sets NAME ...] [--num N] [--first-seed K]

Each of N draws (40) takes three to eight neighbours of a set. A quarter of the draws stays as it is; others rotate by 3
to 50 mrad a frame: each photo at random, all of them almost alike (a pan), or one of them far more than the others (a
bump). Warps are by the camera file, or by the camera that a global shutter finds for the whole set where there is none
(EXIF's focal length of `phone` is off by a fifth: a warp by it would be no rotation). The solver does not get that
camera, and a third of the time no camera file either. Prints a line for each draw, and then by kind how many were
found, not found and not determined, and

    invented    of photos without a shutter, those with a corrected motion
    unseen      of photos with one, those said to be without, and to be trusted, though half of the photos are
                displaced by more than 2 px
    wrong       trusted, though what is left in half of the photos is more than 2 px
    harmed      photos whose motion is corrected and that are displaced more after that than before, by 0.5 px or more;
                in brackets those of them that no word of doubt names

Displacements are those by the rotation, root mean square over the frame; of a velocity at the median depth.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from measures import run_options

import rsundistort as rs
from rsundistort.errors import ReconstructionError
from rsundistort.io.cameras import camera_to_json
from rsundistort.simulate import WarpOptions, simulate_warp

HERE = Path(__file__).resolve().parent
KINDS = ("none", "random", "pan", "bump")
SEEN_PX, HARM_PX = 2.0, 0.5


@dataclass(frozen=True)
class Draw:
    """Photos of a set, their motions (k, 3) in radians a frame, their camera file, and whether the solver gets it."""

    name: str
    photos: list[Path]
    kind: str
    phi: np.ndarray
    camera: Path
    is_given: bool

    @classmethod
    def of(cls, photos: Path, cameras: dict[str, Path], seed: int) -> Draw:
        """Draw a set, of these with their cameras, and its motions."""
        rng = np.random.default_rng([seed, 101])
        name = [*cameras][int(rng.integers(len(cameras)))]
        files = sorted(each for each in (photos / name).iterdir() if each.suffix.lower() == ".jpg")
        num = int(rng.integers(3, min(8, len(files)) + 1))
        first = int(rng.integers(len(files) - num + 1))
        kind = KINDS[int(rng.integers(len(KINDS)))]
        size = float(np.exp(rng.uniform(np.log(0.003), np.log(0.05))))
        own, shared = size * rng.normal(size=(num, 3)), size * rng.normal(size=3)
        phi = {"none": 0.0 * own, "random": own, "pan": shared + 0.2 * own, "bump": 0.1 * own}[kind]
        if kind == "bump":
            phi[rng.integers(num)] = 2.0 * shared
        is_given = rng.random() > 1 / 3 and cameras[name].is_relative_to(photos)
        return cls(name, files[first : first + num], kind, phi, cameras[name], bool(is_given))


@dataclass(frozen=True)
class Found:
    """What a run makes of a draw: its verdict, and by photo (m,) how far pixels were and are displaced."""

    solution: rs.Solution
    before_px: np.ndarray
    left_px: np.ndarray
    corrected: np.ndarray
    doubted: np.ndarray

    @property
    def said(self) -> tuple[str, str]:
        """Shutter and shape."""
        verdict = self.solution.verdict or {}
        return verdict["shutter"], verdict["shape"]

    @property
    def harmed(self) -> np.ndarray:
        """(m,) photos that came out worse than they went in."""
        return self.corrected & (self.left_px > self.before_px + HARM_PX)


def solved(draw: Draw, folder: Path) -> Found:
    """Warp the photos, and solve them."""
    photos = folder / "source"
    photos.mkdir()
    for each in draw.photos:
        shutil.copy(each, photos)
    camera, truth = str(draw.camera), None
    if draw.phi.any():
        motion = {each.name: phi for each, phi in zip(draw.photos, draw.phi, strict=True)}
        simulate_warp(photos, folder / "warp", WarpOptions(camera, motion=motion, crop=True))
        truth = rs.read_solution(folder / "warp" / "ground_truth.json")
        # away from the camera file, which would be found beside them
        photos = (folder / "warp" / "photos").rename(folder / "photos")
        camera = str(folder / "warp" / "camera.json")
    rs.run(photos, folder / "out", run_options(camera=camera if draw.is_given else None))
    solution = rs.read_solution(folder / "out" / "solution.json")
    depths = median_depths(folder / "out", solution)
    px = np.array([displaced_px(solution, image, truth, depths.get(image.name)) for image in solution.registered])
    corrected = np.array([not image.lens_only and image.motion is not None for image in solution.registered])
    doubted = np.array([bool(image.doubtful) for image in solution.registered])
    return Found(solution, px[:, 0], px[:, 1], corrected & (solution.shutter_model != "global"), doubted)


def camera_of(photos: Path, folder: Path) -> Path:
    """The camera file of a set, or one in the folder of the camera that a global shutter finds."""
    for each in (photos / "camera.json", photos.parent / "camera.json"):
        if each.is_file():
            return each
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rs.run(photos, folder / "out", run_options(shutter_model="global"))
    found = rs.read_solution(folder / "out" / "solution.json").cameras.values()
    file = folder / "camera.json"
    file.write_text(json.dumps(camera_to_json(max(found, key=lambda camera: camera.width))))
    return file


def median_depths(out: Path, solution: rs.Solution) -> dict[str, float]:
    """Median depth of the points in front of each photo."""
    points = np.array([each.xyz for each in pycolmap.Reconstruction(out / "sparse").points3D.values()])
    depths = {}
    for image in solution.registered:
        if image.R_cw is not None and image.center_w is not None and len(points):
            depth = (points - image.center_w) @ image.R_cw[2]
            depths[image.name] = float(np.median(depth[depth > 0]))
    return depths


def displaced_px(
    solution: rs.Solution, image: rs.SolvedImage, truth: rs.Solution | None, depth: float | None
) -> tuple[float, float]:
    """How far the true motion displaces pixels, and how far they are out of place if that which is applied is undone.

    Root mean square over the frame, to first order and with the solution's camera; a velocity is as the rotation that
    moves points of this depth as much.
    """
    camera = solution.cameras[image.camera_id]
    side = np.linspace(0, 1, 7)
    x, y = ((np.array([camera.width, camera.height]) - 1) * np.stack(np.meshgrid(side, side), 2).reshape(-1, 2)).T
    ray = np.column_stack([(x - camera.K[0, 2]) / camera.K[0, 0], (y - camera.K[1, 2]) / camera.K[1, 1]])
    clock = ray[:, camera.clock_axis]

    def px(phi: np.ndarray) -> float:
        moved = np.column_stack([
            -ray[:, 0] * ray[:, 1] * phi[0] + (1 + ray[:, 0] ** 2) * phi[1] - ray[:, 1] * phi[2],
            -(1 + ray[:, 1] ** 2) * phi[0] + ray[:, 0] * ray[:, 1] * phi[1] + ray[:, 0] * phi[2],
        ])  # fmt: skip
        return float(camera.K[0, 0] * np.sqrt(np.mean(np.sum((clock[:, None] * moved) ** 2, axis=1))))

    true = np.zeros(3)
    if truth is not None:
        known = truth.image(image.name)
        assert known.motion is not None
        spans = truth.cameras[known.camera_id].frame_span / camera.frame_span
        true = known.motion.phi * spans
    applied = np.zeros(3)
    if image.motion is not None and not image.lens_only:
        applied = image.motion.phi.copy()
        if depth is not None and image.R_cw is not None:
            v = image.R_cw @ image.motion.velocity / depth
            applied += [v[1], -v[0], 0.0]
    return px(true), px(true - applied)


def main() -> None:
    """Draw photos and motions, and show what is made of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=HERE.parent.parent / "shared" / "photos")
    parser.add_argument("--sets", nargs="+", default=["herz-jesus-8", "fountain-small/gs", "dslr", "phone"])
    parser.add_argument("--num", type=int, default=40)
    parser.add_argument("--first-seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as calibrated:
        cameras = {}
        for k, name in enumerate(args.sets):
            own = Path(calibrated, str(k))
            own.mkdir()
            cameras[name] = camera_of(args.photos / name, own)
        draws = range(args.first_seed, args.first_seed + args.num)
        show((seed, Draw.of(args.photos, cameras, seed)) for seed in draws)


def show(draws: Iterable[tuple[int, Draw]]) -> None:
    """Solve draws of these seeds: a line for each, and the table."""
    tables: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    for seed, draw in draws:
        line = f"{seed:4} {draw.name:18}{len(draw.photos):2} {draw.kind:7}"
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                found = solved(draw, Path(folder))
            except ReconstructionError as error:
                print(line, error, flush=True)
                tables[draw.kind]["not solved"] += 1
                continue
        before, left = float(np.median(found.before_px)), float(np.median(found.left_px))
        shutter, shape = found.said
        harmed = found.harmed
        print(f"{line} {shutter:15}{shape:9} px {before:7.2f} -> {left:6.2f}  harmed {harmed.sum()}", flush=True)
        trusted = shape == "trusted"
        tables[draw.kind] += Counter({
            shutter: 1,
            "invented": int(draw.kind == "none" and found.corrected.any()),
            "unseen": int(trusted and shutter == "not-found" and before > SEEN_PX),
            "wrong": int(trusted and left > SEEN_PX),
            "harmed": int(harmed.sum()),
            "unnamed": int((harmed & ~found.doubted).sum()),
            "photos": len(harmed),
        })  # fmt: skip
    said = ("found", "not-found", "not-determined", "not solved", "invented", "unseen", "wrong")
    print(f"\n{'kind':8}" + "".join(f"{each:>16}" for each in (*said, "harmed")))
    for kind, table in tables.items():
        harm = f"{table['harmed']} ({table['unnamed']}) of {table['photos']}"
        print(f"{kind:8}" + "".join(f"{table[each]:16}" for each in said) + f"{harm:>16}")


if __name__ == "__main__":
    main()
