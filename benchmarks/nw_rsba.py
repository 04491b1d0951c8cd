"""An outsider's bundle-adjustment problems: prints two JSON objects {class: {"points", "rotation_deg", "centres"}}.

    python benchmarks/nw_rsba.py DIR [--prior-sigmas FACTOR] [--means-of-zero] [--deviations MODEL]

DIR holds general.npz, near-parallel.npz, parallel.npz of twenty problems each. Default options, no knowledge of the
true motion. Medians; points: rms after the similarity that best aligns the points, in scene units; rotation (mean
angle) and centres (rms) after the similarity that best aligns the centres. `--prior-sigmas` multiplies the standard
deviations that the estimate of the priors starts from; `--means-of-zero` is without what motions have in common, and
`--deviations model` takes measurements as independent.

The first object has the medians, the second the errors by those of version 0.1 on the same problem
(`nw_rsba_0.1.json`): geometric means of the ratios, and the standard errors of their logarithms. Medians of twenty
jump.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from rsundistort import BundleOptions, Camera, Observations, Reconstruction, bundle_adjust
from rsundistort.evaluation import align_points, rotation_angles_deg

CLASSES = ("general", "near-parallel", "parallel")


def problem(arrays: Any, k: int) -> Reconstruction:
    """The start of one problem."""
    start = [arrays[f"start_{name}"][k] for name in ("R_cw", "center_w", "points_w")]

    def of(name: str) -> Any:
        value = arrays[name]
        return value if value.ndim == 1 else value[k]

    camera = Camera(int(np.ravel(arrays["width"])[0]), int(np.ravel(arrays["height"])[0]), arrays["K"][k])
    names = [str(i) for i in range(len(start[0]))]
    observations = Observations(of("frame_idx"), of("point_idx"), arrays["xy"][k])
    return Reconstruction([camera], names, np.zeros(len(names), np.int64), *start, observations)


def errors(found: Reconstruction, arrays: Any, k: int) -> tuple[float, float, float]:
    """Points, rotation in degrees, centres."""
    true_points = arrays["true_points_w"][k]
    true_R, true_center = arrays["true_R_cw"][k], arrays["true_center_w"][k]
    scale, A, shift = align_points(found.points_w, true_points)
    points = scale * found.points_w @ A.T + shift - true_points
    scale, A, shift = align_points(found.center_w, true_center)
    centers = scale * found.center_w @ A.T + shift - true_center
    angles = rotation_angles_deg(np.einsum("mij,kj,mlk->mil", found.R_cw, A, true_R))
    rms = [float(np.sqrt((d**2).sum(1).mean())) for d in (points, centers)]
    return rms[0], float(angles.mean()), rms[1]


def main() -> None:
    """Solve all problems."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dir", type=Path)
    parser.add_argument("--prior-sigmas", type=float, default=1.0)
    parser.add_argument("--means-of-zero", action="store_true")
    parser.add_argument("--deviations", default="jackknife", choices=("jackknife", "model"))
    args = parser.parse_args()
    if args.means_of_zero:
        mock.patch("rsundistort.bundle.prior_sigmas.has_means", return_value=False).start()
    default = BundleOptions()
    options = BundleOptions(
        phi_sigma_start=args.prior_sigmas * default.phi_sigma_start,
        velocity_sigma_start=args.prior_sigmas * default.velocity_sigma_start,
        deviations=args.deviations,
    )
    before = json.loads((Path(__file__).parent / "nw_rsba_0.1.json").read_text(encoding="utf-8"))
    summary, ratios = {}, {}
    for name in CLASSES:
        with np.load(args.dir / f"{name}.npz") as file:
            arrays = {key: file[key] for key in file.files}
        found = []
        for k in range(len(arrays["K"])):
            start = problem(arrays, k)
            result = bundle_adjust(start, "constant-motion", options, simpler_first=True).reconstruction
            if result.num_points < start.num_points:
                raise SystemExit(f"{name} {k}: {start.num_points - result.num_points} points were lost")
            found.append(errors(result, arrays, k))
        points, rotation, centers = np.median(found, axis=0).round(4)
        summary[name] = {"points": points, "rotation_deg": rotation, "centres": centers}
        logs = np.log(np.array(found) / before[name])
        ratio = np.stack([np.exp(logs.mean(0)), logs.std(0, ddof=1) / np.sqrt(len(logs))], axis=1)
        ratios[name] = dict(zip(summary[name], ratio.round(3).tolist(), strict=True))
    print(json.dumps(summary))
    print(json.dumps(ratios))


if __name__ == "__main__":
    main()
