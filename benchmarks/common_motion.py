"""Cameras that move alike in all photos: how right their common motion is; prints one JSON object a line.

    python benchmarks/common_motion.py [--kinds KIND ...] [--seeds N] [--first-seed K] [--photos M]

Twenty photos (at most) of 1600 x 1200 pixels at f = 1300, measured with 0.4 px, solved without knowledge of any motion:

    orbit     around a thing, once; the camera rotates with the orbit while a photo is read, so that it stays aimed
    straight  the same without that rotation
    arc       a quarter of the orbit
    portrait  the orbit with a camera that is held upright: its rows stand
    hand      an orbit in steps: no motion in common, but a hand that shakes three times as much
    flyover   straight down from 8 m, travelling along the photos
    side      along a wall, looking at it
    walk      ahead through a street
    bend      straight down from 8 m along a bend, turned otherwise: on the way from each photo to the next, as a drone
    frames    the same, rotating as from photo to photo, as frames of a video

`error_mrad`: rms over scenes and axes of the error of the mean of phi over the photos; `deviations`: of that in its
standard deviations, to be 1; `travel`: rms error of the mean velocity by the true one; `travels`: mean error of each
photo's velocity by their mean; `rotation_deg`: median error of the rotations after the scenes are aligned. Beside it
the same with priors whose means are zero.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, bundle_adjust
from rsundistort.bundle import Posterior
from rsundistort.evaluation import align_points
from rsundistort.model import RowMotion
from rsundistort.synthetic import look_at, project_rows

MODEL = "constant-motion"
KINDS = ("orbit", "straight", "arc", "portrait", "hand", "flyover", "side", "walk", "bend", "frames")
CAMERA = Camera(1600, 1200, [[1300, 0, 800], [0, 1300, 600], [0, 0, 1]], [], "top-to-bottom")
NOISE_PX = 0.4
PHOTOS = 20
# of the orbits: metres, radians a frame
RADIUS, RATE = 4.0, 0.012
# of the way from one photo to the next, while a frame is read
SHARE = 0.05

Array = NDArray[np.float64]


def orbit(kind: str, rng: np.random.Generator, m: int) -> tuple[Array, ...]:
    """Poses of m photos, common rotation and travel, and points."""
    whole = np.pi / 2 if kind == "arc" else 2 * np.pi
    angle = np.linspace(0, whole, m, endpoint=False) + 0.03 * rng.normal(size=m)
    height = 0.6 + 0.25 * rng.normal(size=m)
    center_w = np.column_stack([RADIUS * np.sin(angle), -RADIUS * np.cos(angle), height])
    points_w = rng.uniform(-1, 1, (400, 3)) * [1.3, 1.3, 0.9]
    R_cw = np.array([look_at(each, np.zeros(3), 90.0 * (kind == "portrait")) for each in center_w])
    travel = RADIUS * RATE * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    phi = -RATE * R_cw[:, :, 2]
    moves = kind != "hand"
    return R_cw, center_w, moves * (kind != "straight") * phi, moves * travel, points_w


def along(kind: str, rng: np.random.Generator, m: int) -> tuple[Array, ...]:
    """The same of cameras that travel straight on, and do not rotate."""
    if kind == "flyover":
        above = np.stack(np.meshgrid(np.linspace(-3, 3, 4), np.linspace(-4, 4, 5)), 2).reshape(-1, 2)[:m]
        center_w = np.column_stack([above, np.full(m, 8.0)]) + 0.15 * rng.normal(size=(m, 3))
        R_cw, way = np.repeat(np.diag([1.0, -1.0, -1.0])[None], m, 0), [0.0, 0.3, 0.0]
        points_w = rng.uniform(-1, 1, (500, 3)) * [7, 8, 1.5]
    elif kind == "side":
        center_w = np.column_stack([np.linspace(-5, 5, m), np.full(m, -5.0), 0.2 * rng.normal(size=m)])
        center_w += 0.1 * rng.normal(size=(m, 3))
        R_cw, way = np.array([look_at(each, each + np.array([0, 5.0, 0])) for each in center_w]), [0.08, 0.0, 0.0]
        points_w = rng.uniform(-1, 1, (500, 3)) * [7, 1.0, 2.5]
    else:
        center_w = np.column_stack([0.2 * rng.normal(size=m), np.linspace(0, 12, m), np.full(m, 1.6)])
        aims = center_w + np.column_stack([0.3 * rng.normal(size=m), np.full(m, 5.0), 0.2 * rng.normal(size=m)])
        R_cw, way = np.array([look_at(c, a) for c, a in zip(center_w, aims, strict=True)]), [0.0, 0.04, 0.0]
        side = rng.choice([-1.0, 1.0], 700)
        points_w = np.column_stack([side * rng.uniform(2, 3, 700), rng.uniform(1, 25, 700), rng.uniform(0, 5, 700)])
    R_cw = Rotation.from_rotvec(0.03 * rng.normal(size=(m, 3))).as_matrix() @ R_cw
    return R_cw, center_w, np.zeros((m, 3)), np.tile(way, (m, 1)), points_w


def on_the_way(kind: str, rng: np.random.Generator, m: int) -> tuple[Array, ...]:
    """The same of cameras that look down, and are on the way from one photo to the next."""
    bends, yaws = np.cumsum(rng.uniform(0.1, 0.3, m)), -np.cumsum(rng.uniform(0.1, 0.5, m))
    center_w = np.column_stack([3 * np.cos(bends), 3 * np.sin(bends), 8 + 0.15 * rng.normal(size=m)])
    rotvecs = np.column_stack([0.03 * rng.normal(size=(m, 2)), yaws])
    R_cw = Rotation.from_rotvec(rotvecs).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    rates = Rotation.from_matrix(R_cw[1:] @ R_cw[:-1].transpose(0, 2, 1)).as_rotvec()
    rates = (np.vstack([rates[:1], rates]) + np.vstack([rates, rates[-1:]])) / 2
    speed = SHARE * np.linalg.norm(np.diff(center_w, axis=0), axis=1).mean()
    ways = speed * np.column_stack([-np.sin(bends), np.cos(bends), 0 * bends])
    points_w = rng.uniform(-1, 1, (500, 3)) * [8, 8, 1.5]
    return R_cw, center_w, (kind == "frames") * SHARE * rates, ways, points_w


def scene(kind: str, seed: int, num_photos: int = PHOTOS) -> Reconstruction:
    """A scene with its measurements, and what is true of it."""
    rng = np.random.default_rng(seed)
    of_orbit = kind in KINDS[:5]
    make = orbit if of_orbit else on_the_way if kind in ("bend", "frames") else along
    R_cw, center_w, phi, velocity, points_w = make(kind, rng, num_photos)
    shaking = {"hand": 0.012, "walk": 0.01}.get(kind, 0.004)
    phi = phi + shaking * rng.normal(size=phi.shape)
    velocity = velocity + (0.03 if kind == "flyover" else 0.012) * rng.normal(size=phi.shape)
    span = 1200 / 1300  # of the clock
    phi, velocity = phi / span, velocity / span
    frame_idx, point_idx, xy_raw = [], [], []
    for i, center in enumerate(center_w):
        xy, seen = project_rows(points_w, R_cw[i], center, RowMotion(phi[i], velocity[i]), CAMERA)
        seen &= ((xy > 0) & (xy < [1600, 1200])).all(axis=1) & ((points_w - center) @ R_cw[i][2] > 0.5)
        if of_orbit:  # the side that faces the camera
            ahead, out = center - points_w, points_w
            across = np.linalg.norm(ahead, axis=1) * np.linalg.norm(out, axis=1)
            seen &= (ahead * out).sum(1) > 0.1 * across
        point_idx.append(np.flatnonzero(seen))
        frame_idx.append(np.full(seen.sum(), i))
        xy_raw.append(xy[seen] + NOISE_PX * rng.normal(size=(seen.sum(), 2)))
    measured = Observations(*(np.concatenate(each) for each in (frame_idx, point_idx, xy_raw)))
    names, same = [f"{i:02}.jpg" for i in range(len(phi))], np.zeros(len(phi), np.int64)
    truth = Reconstruction([CAMERA], names, same, R_cw, center_w, points_w, measured, phi, velocity, MODEL)
    return truth.take_points(truth.track_lengths(np.ones(len(measured), bool)) >= 2)


def errors(truth: Reconstruction) -> tuple[Array, Array, float, float, float]:
    """Of the mean of phi: errors and standard deviations (3,), rad; of the mean travel; of the rotations, degrees.

    And of each photo's travel.
    """
    start = replace(truth, phi=0 * truth.phi, velocity=0 * truth.velocity)
    options = BundleOptions(deviations="jackknife")
    result = bundle_adjust(start, MODEL, options)
    found, span = result.reconstruction, truth.frame_span()[0]
    m = truth.num_images
    vectors = np.zeros((3, m, 12))
    vectors[np.arange(3), :, 6 + np.arange(3)] = span / m
    sigma = np.sqrt(np.einsum("kma,kma->k", Posterior(result, options).of_photos(vectors), vectors))
    scale, turn, _ = align_points(found.center_w, truth.center_w)
    one, other = (np.einsum("mij,mj->mi", rec.R_cw, rec.velocity) for rec in (found, truth))
    apart = float(np.linalg.norm((scale * one - other).mean(0)) / max(np.linalg.norm(other.mean(0)), 1e-9))
    each = np.linalg.norm(scale * one - other, axis=1).mean() / np.linalg.norm(other, axis=1).mean()
    angle = Rotation.from_matrix(found.R_cw @ turn.T @ truth.R_cw.transpose(0, 2, 1)).magnitude()
    return (found.phi - truth.phi).mean(0) * span, sigma, apart, float(np.degrees(np.median(angle))), float(each)


def figures(kind: str, seeds: range, num_photos: int) -> dict[str, float]:
    """Those of a kind of scene."""
    found = [errors(scene(kind, seed, num_photos)) for seed in seeds]
    error, sigma = (np.array([each[k] for each in found]) for k in (0, 1))
    return {
        "error_mrad": round(1e3 * float(np.sqrt(np.mean(error**2))), 2),
        "deviations": round(float(np.sqrt(np.mean((error / sigma) ** 2))), 2),
        "travel": round(float(np.sqrt(np.mean([each[2] ** 2 for each in found]))), 2),
        "travels": round(float(np.mean([each[4] for each in found])), 2),
        "rotation_deg": round(float(np.median([each[3] for each in found])), 4),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--photos", type=int, default=PHOTOS, choices=range(3, PHOTOS + 1), metavar="M")
    args = parser.parse_args()
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for kind in args.kinds:
        found = figures(kind, seeds, args.photos)
        with mock.patch("rsundistort.bundle.prior_sigmas.has_means", return_value=False):
            zero = figures(kind, seeds, args.photos)
        print(json.dumps({"kind": kind, "scenes": len(seeds), **found, "means_of_zero": zero}), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
