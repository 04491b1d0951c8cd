"""Weak motions of real photos that a gyroscope knows: found by them, and not by those of other photos.

    python benchmarks/known_motions.py [--photos DIR] [--sets NAME ...] [--rad R] [--sigma S] [--seed K]

Warps photos by motions of R rad a frame (0.001), and solves them without a word on these, with motions that are known
to S rad (0.0003), with these reversed, and with those of the photo next to each, which it did not make. Prints the
verdict on the shutter, the error of phi in mrad a frame (root mean square; in brackets that of no motion), and by how
many standard errors the known motions predict better than none; "left out" are those that the photos contradict.
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from pathlib import Path

import numpy as np
from measures import run_options

import rsundistort as rs
from rsundistort.evaluation import motion_errors
from rsundistort.io.motions import Known
from rsundistort.simulate import WarpOptions, simulate_warp

HERE = Path(__file__).resolve().parent


def rms_mrad(phi: np.ndarray) -> float:
    """Root mean square of rotations in radians."""
    return float(1e3 * np.sqrt(np.mean(np.square(phi))))


def solved(photos: Path, truth: rs.Solution, true: dict[str, np.ndarray], known: Known) -> str:
    """The verdict with these known motions, and how right it is."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rs.run(photos, Path(folder, "out"), run_options(known=known))
        found = rs.read_solution(Path(folder, "out", "solution.json"))
    error = rms_mrad(motion_errors(found, truth).phi_rad_per_frame)
    gain = found.quality["known_motions_gain"]
    none = rms_mrad(np.array([true[image.name] for image in found.registered]))
    verdict = (found.verdict or {}).get("shutter")
    left_out = "left out" if found.quality["known_motions_left_out"] else ""
    return f"{verdict:>15} {error:6.2f} ({none:.2f}) {'' if gain is None else f'{gain:+.1f}'} {left_out}"


def main() -> None:
    """Print a line for each set and each kind of knowledge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=HERE.parent.parent / "shared" / "photos")
    parser.add_argument("--sets", nargs="+", default=["dslr", "phone", "herz-jesus-8"])
    parser.add_argument("--rad", type=float, default=0.001)
    parser.add_argument("--sigma", type=float, default=0.0003)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    for name in args.sets:
        source = args.photos / name
        file = source / "camera.json"
        with tempfile.TemporaryDirectory() as folder:
            warp = Path(folder, "warp")
            camera = str(file) if file.is_file() else None
            simulate_warp(source, warp, WarpOptions(camera, sigma_rad=args.rad, seed=args.seed))
            truth = rs.read_solution(warp / "ground_truth.json")
            true = {each.name: each.motion.phi * truth.cameras[each.camera_id].frame_span for each in truth.images}
            rng = np.random.default_rng([args.seed, 1])
            deviation = np.full(3, args.sigma)
            own = {key: (phi + args.sigma * rng.normal(size=3), deviation) for key, phi in true.items()}
            reversed_ = {key: (-phi, sigma) for key, (phi, sigma) in own.items()}
            others = dict(zip(own, [*list(own.values())[1:], next(iter(own.values()))], strict=True))
            for says, known in (
                ("nothing known", {}),
                ("its motions", own),
                ("reversed", reversed_),
                ("those of others", others),
            ):
                print(f"{name:14}{says:18}{solved(warp / 'photos', truth, true, known)}", flush=True)


if __name__ == "__main__":
    main()
