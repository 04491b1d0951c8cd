"""How the stages grow with the number of photos: prints one JSON object a line.

    python benchmarks/large_sets.py [--sizes 125 250 500 1000] [--features 600] [--gps] [--exhaustive]

A synthetic street, walked down twice with a photo every four metres, which look to either side by turns. Its facades
hold points with random descriptors, which each photo sees with noise, among clutter that no other photo has; a fifth of
the points look like many others, as windows do. So no photo has to be rendered, and none is: the time of `features` is
that of a photo times their number.

A line for each size: how many pairs, partners of a photo, and the share of the pairs of photos with 30 common points or
more that is among them; photos registered, and the errors of their positions; seconds by stage, and those of all
processors (`processor_s`), which neighbours on the machine hardly change. Then for each stage the exponent of the
growth of the latter between the smallest and the largest size (1: in proportion). Exits 1 if something crashes, never
because a noisy figure misses its target.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT, FOCAL = 1000, 750, 500.0
# metres: between photos, between the two walks, to the facades, how far a point is seen, half the height of the facades
STEP, APART, TO_FACADE, REACH, UP = 4.0, 1.0, 8.0, 30.0, 3.5
# of visible points that are detected; clutter for each of them; noise of pixels and of descriptors
DETECTED, CLUTTER, NOISE_PX, NOISE_BYTES = 0.7, 0.4, 0.5, 6.0
# of points that look like others, and how many kinds of them there are; standard deviation of GPS in metres
REPEATED, KINDS, GPS_M = 0.2, 30, 4.0
# points of a metre of street for a photo to have a feature
PER_METRE = 0.056
COMMON = 30


@dataclass(frozen=True)
class Street:
    """Photos of the street: poses, features and which point each feature is of, -1 for clutter."""

    center_w: NDArray[np.float64]
    R_cw: NDArray[np.float64]
    gps: NDArray[np.float64]
    features: list[Any]
    point: list[NDArray[np.int64]]

    def common(self) -> NDArray[np.int64]:
        """(m, m) points that photos share."""
        from scipy.sparse import csr_array

        frame = np.repeat(np.arange(len(self.point)), [len(p) for p in self.point])
        point = np.concatenate(self.point)
        seen = csr_array((np.ones((point >= 0).sum(), np.int64), (frame[point >= 0], point[point >= 0])))
        return np.asarray((seen @ seen.T).toarray())


def descriptors_of(num: int, words: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """RootSIFT-like vectors (positive, of length 512) about random words."""
    drawn = words[rng.integers(len(words), size=num)] * rng.gamma(1.5, 1 / 1.5, (num, 128))
    return 512.0 * np.sqrt(drawn / drawn.sum(1, keepdims=True))


def make_street(num_photos: int, per_photo: int, seed: int = 0) -> Street:
    """Two walks down a street that is as long as there are photos."""
    from rsundistort.sfm import Features

    rng = np.random.default_rng([seed, num_photos])
    number, half = np.arange(num_photos), -(-num_photos // 2)
    center_w = np.column_stack([number % half * STEP, number // half * APART, np.zeros(num_photos)])
    center_w += rng.normal(0, 0.1, (num_photos, 3))
    turn = np.where(number % 2, 1.0, -1.0) * np.deg2rad(20) + rng.normal(0, 0.05, num_photos)
    tilt = rng.normal(0, 0.05, num_photos)
    z = np.column_stack([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R_cw = np.stack([x, np.cross(z, x), z], axis=1)

    length = half * STEP + REACH
    num_points = round(PER_METRE * per_photo * length)
    facade = rng.choice([-TO_FACADE, TO_FACADE], num_points) + rng.normal(0, 0.7, num_points)
    points_w = np.column_stack([rng.uniform(0, length, num_points), facade, rng.uniform(-UP, UP, num_points)])
    words = rng.gamma(0.6, 1.0, (400, 128)) + 0.05
    looks = descriptors_of(num_points, words, rng)
    kind = np.where(rng.uniform(size=num_points) < REPEATED, rng.integers(KINDS, size=num_points), -1)
    looks[kind >= 0] = descriptors_of(KINDS, words, rng)[kind[kind >= 0]]
    features, point = [], []
    for R, center in zip(R_cw, center_w, strict=True):
        near = np.flatnonzero(((points_w - center) ** 2).sum(1) < REACH**2)
        at = (points_w[near] - center) @ R.T
        xy = FOCAL * at[:, :2] / at[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        seen = (at[:, 2] > 0.5) & ((xy > 0) & (xy < (WIDTH - 1, HEIGHT - 1))).all(1)
        seen &= rng.uniform(size=len(near)) < DETECTED
        clutter = int(CLUTTER * seen.sum())
        places = rng.uniform(0, (WIDTH - 1, HEIGHT - 1), (clutter, 2))
        xy = np.concatenate([xy[seen] + rng.normal(0, NOISE_PX, (seen.sum(), 2)), places])
        looked = np.concatenate([looks[near[seen]], descriptors_of(clutter, words, rng)])
        looked = np.clip(np.rint(looked + rng.normal(0, NOISE_BYTES, looked.shape)), 0, 255).astype(np.uint8)
        order = rng.permutation(len(xy))  # which features are the strongest says nothing
        features.append(Features(xy[order], np.ones(len(xy)), looked[order]))
        point.append(np.concatenate([near[seen], np.full(clutter, -1)])[order])
    gps = center_w + rng.normal(0, GPS_M, center_w.shape)
    return Street(center_w, R_cw, gps[:, :2], features, point)


def measure(num_photos: int, per_photo: int, with_gps: bool, exhaustive: bool) -> dict[str, Any]:
    """Pairs and seconds of a street."""
    from rsundistort import Camera
    from rsundistort.sfm import choose_pairs, global_descriptors, map_photos, match_photos, retriangulate

    street = make_street(num_photos, per_photo)
    camera = Camera(WIDTH, HEIGHT, [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    seconds: dict[str, float] = {}
    processor: dict[str, float] = {}

    def timed(stage: str, function: Any) -> Any:
        began, used = time.perf_counter(), time.process_time()
        result = function()
        seconds[stage] = round(time.perf_counter() - began, 2)
        processor[stage] = round(time.process_time() - used, 2)
        return result

    def chosen() -> Any:
        looks = global_descriptors([each.descriptors for each in street.features])
        return choose_pairs(num_photos, [np.arange(num_photos)], street.gps if with_gps else None, looks)

    share = np.triu(street.common() >= COMMON, 1)
    found: dict[str, Any] = {"photos": num_photos, "of_pairs": num_photos * (num_photos - 1) // 2}
    pairs = None
    if not exhaustive:
        pairs = timed("pairs", chosen)
        partners = np.bincount(pairs.ravel(), minlength=num_photos)
        found |= {
            "pairs": len(pairs), "partners": round(partners.mean(), 1), "most_partners": int(partners.max()),
            "sharing": int(share.sum()), "recall": round(share[pairs[:, 0], pairs[:, 1]].sum() / share.sum(), 4),
        }  # fmt: skip
    names = [f"{k:05d}.jpg" for k in range(num_photos)]
    with tempfile.TemporaryDirectory() as work:
        matched = timed(
            "matching",
            lambda: match_photos(
                Path(work) / "database.db", names, street.features, [camera], np.zeros(num_photos, int), pairs=pairs
            ),
        )
        mapped = timed("mapping", lambda: map_photos(matched))
        again = timed("rebuilt tracks", lambda: retriangulate(matched, mapped))
    at = [names.index(name) for name in mapped.image_names]
    error = aligned(mapped.center_w, street.center_w[at]) - street.center_w[at]
    return found | {
        "registered": mapped.num_images,
        "observations": len(again.observations),
        "error_m": round(float(np.median(np.linalg.norm(error, axis=1))), 3),
        "worst_error_m": round(float(np.linalg.norm(error, axis=1).max()), 3),
        "seconds": seconds,
        "processor_s": processor,
    }


def aligned(these: NDArray[np.float64], those: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places moved onto others by a similarity (Umeyama 1991)."""
    a, b = these - these.mean(0), those - those.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    turn = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    return np.asarray((a @ (u @ turn @ vt).T) * (s * turn.diagonal()).sum() / (a**2).sum() + those.mean(0))


def main() -> None:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[125, 250, 500, 1000])
    parser.add_argument("--features", type=int, default=600)
    parser.add_argument("--gps", action="store_true")
    parser.add_argument("--exhaustive", action="store_true")
    args = parser.parse_args()
    lines = []
    for size in args.sizes:
        lines.append(measure(size, args.features, args.gps, args.exhaustive))
        print(json.dumps(lines[-1]), flush=True)
    if len(lines) > 1:
        growth = np.log(args.sizes[-1] / args.sizes[0])
        first, last = lines[0]["processor_s"], lines[-1]["processor_s"]
        exponents = {stage: round(float(np.log(last[stage] / first[stage]) / growth), 2) for stage in last}
        print(json.dumps({"exponents": exponents}))


if __name__ == "__main__":
    main()
