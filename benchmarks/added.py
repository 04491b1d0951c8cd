"""Photos of cameras whose own shutters nobody knows, moved besides: what a run finds should be more by just that.

    python benchmarks/added.py [--photos DIR] [--names lund iphone6 phone] [--rad 0.03] [--seeds 0] [--model NAME]

Photos of a set are warped as if their camera had rotated by so much a frame, and solved by their EXIF, as they are and
warped. The motions found in both differ by the known ones if both are right, whatever the shutter that the camera has:
then what is found in the photos as they are is a shutter, and the deviations are right, too, if the differences over
them (`over_sigma`, root mean square by component) are about one. One JSON object a line; milliradians a frame.

`own` is nothing where a run takes no motion out of the photos as they are: then it is part of what is left.
What both have in common, such as an error of the lens, cancels: that is for other benchmarks.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import warnings
from itertools import product
from pathlib import Path

import numpy as np
from measures import run_options

from rsundistort import RsUndistortWarning, SolvedImage, run
from rsundistort.io.cameras import camera_to_json
from rsundistort.model.array_types import Array
from rsundistort.simulate import WarpOptions, simulate_warp

ROOT = Path(__file__).resolve().parent.parent


def _rms(values: Array, digits: int = 1) -> list[float]:
    return np.sqrt((values**2).mean(0)).round(digits).tolist()


def _per_frame(images: dict[str, SolvedImage], names: list[str]) -> tuple[Array, Array]:
    """Motions (n, 3) and their standard deviations, milliradians a frame of these photos."""
    found = [(images[name].motion, images[name].sigma_phi) for name in names]
    phi = np.array([motion.phi for motion, _ in found])
    return 1e3 * phi, 1e3 * np.array([np.zeros(3) if sigma is None else sigma for _, sigma in found])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--names", nargs="+", default=["lund", "iphone6", "phone"])
    parser.add_argument("--rad", type=float, default=0.03)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--model", default="rotation", help="of the photos as they are")
    args = parser.parse_args()
    warnings.simplefilter("ignore", RsUndistortWarning)
    for name, seed in product(args.names, args.seeds):
        with tempfile.TemporaryDirectory() as folder:
            work, photos = Path(folder), args.photos / name
            as_taken = run(photos, work / "as-taken", run_options(shutter_model=args.model))
            # rotated as the camera would show it: by the lens that the photos say, since EXIF may be off by a fifth
            camera = work / "camera.json"
            camera.write_text(json.dumps(camera_to_json(next(iter(as_taken.cameras.values())))), encoding="utf-8")
            options = WarpOptions(str(camera), sigma_rad=args.rad, seed=seed)
            truth = simulate_warp(photos, work / "warp", options)
            # solved without the camera of the warp beside them, as their owner has them
            moved = run((work / "warp" / "photos").rename(work / "moved"), work / "out", run_options())
        spans = {image.name: truth.cameras[image.camera_id].frame_span for image in truth.images}
        true, before, after = ({each.name: each for each in s.registered} for s in (truth, as_taken, moved))
        names = sorted({*true} & {*before} & {*after})
        span = np.array([[spans[each]] for each in names])
        (known, _), (own, own_sigma), (found, sigma) = (_per_frame(each, names) for each in (true, before, after))
        left = (found - own - known) * span
        said = {
            "set": name, "seed": seed, "photos": len(names), "of": len(spans),
            "verdict": moved.verdict and {key: moved.verdict[key] for key in ("shutter", "shape")},
            "own": _rms(own * span), "added": _rms(known * span), "left": _rms(left),
            "over_sigma": _rms(left / (np.hypot(sigma, own_sigma) * span), 2),
        }  # fmt: skip
        print(json.dumps(said), flush=True)


if __name__ == "__main__":
    main()
