"""A GoPro's gyroscope against its own pictures: axes, clock and rotation found unaided. Prints one JSON object.

    python benchmarks/gopro.py [--video FILE] [--focal PX] [--radius PX]

Corners are followed from each frame to the next (Lucas and Kanade, there and back), and the rotation that explains them
best is fitted to their directions, r = f theta, with a loss that leaves waves and parallax out. The telemetry is read
with its axes as they are stored, and as the reader takes them to the camera.

`stored`: `--gyro-axes` as found from the pictures for the numbers as they are stored. `axes`: the same for the log as
read; XYZ if the reader is right. `offset_s` with its standard deviation; `offset_best_s`: where the axis that moves
correlates best, looked for by itself. `correlation` of that axis; `ratio` of the rotations of the pictures to those of
the gyroscope; `focal_px`: in the middle of the picture, at which they agree. `reversed`: what is said where the clip is
held against its own log run backwards.

The focal length is of the middle of the picture, pixels a radian. That of the default clip is not known; the flow of
its pan alone says 560 to 660, weakly. Exits 1 unless the axes are XYZ, the correlation is 0.95 or more,
the offset is within a frame of the best, the ratio within 10 %, and the reversed log is refused.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rsundistort.input.gyro_alignment import GyroAlignment, align_gyro
from rsundistort.io import GyroLog, read_gyro

ROOT = Path(__file__).resolve().parent.parent


def followed(video: Path) -> tuple[NDArray[np.float64], list[tuple[NDArray[Any], NDArray[Any]]], tuple[int, int]]:
    """Times of the frames, corners in each and where they are in the next, and width and height."""
    times, corners, before = [], [], None
    with av.open(str(video)) as container:
        for picture in container.decode(container.streams.video[0]):
            times.append(picture.time)
            frame = picture.to_ndarray(format="gray")
            if before is not None:
                here = cv2.goodFeaturesToTrack(before, 500, 0.005, 10)
                there, found, _ = cv2.calcOpticalFlowPyrLK(before, frame, here, None)
                back, returned, _ = cv2.calcOpticalFlowPyrLK(frame, before, there, None)
                good = (found & returned).ravel() > 0
                good &= np.linalg.norm((back - here)[:, 0], axis=1) < 0.3
                corners.append((here[good, 0], there[good, 0]))
            before = frame
    return np.array(times) - times[0], corners, (frame.shape[1], frame.shape[0])


def directions(xy: NDArray[Any], middle: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
    """Unit directions of pixels of a lens with r = f theta."""
    off = (xy - middle) / focal_px
    angle = np.maximum(np.linalg.norm(off, axis=1), 1e-12)
    return np.column_stack([off * (np.sin(angle) / angle)[:, None], np.cos(angle)])


def rotation(here: NDArray[np.float64], there: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vector that takes directions to others; NaN for fewer than twenty."""
    if len(here) < 20:
        return np.full(3, np.nan)
    turn = Rotation.identity()
    for _ in range(15):
        turned = turn.apply(here)
        left = there - turned
        size = np.linalg.norm(left, axis=1)
        weight = 1 / (1 + (size / max(1.2 * np.median(size), 1e-9)) ** 2) ** 2
        J = -np.cross(turned[:, None, :], np.eye(3)).transpose(0, 2, 1)
        H = np.einsum("n,nij,nik->jk", weight, J, J)
        turn = Rotation.from_rotvec(np.linalg.solve(H, np.einsum("n,nij,ni->j", weight, J, left))) * turn
    return np.asarray(turn.as_rotvec())


def best_offset(log: GyroLog, times: NDArray[np.float64], turns: NDArray[np.float64]) -> float:
    """Where the axis that moves most correlates best."""
    seen = -turns / np.diff(times)[:, None]
    axis = int(np.argmax(np.nanstd(seen, axis=0)))

    def correlation(offset: float) -> float:
        felt = log.mean(times[:-1] + offset, times[1:] + offset)[:, axis]
        both = np.isfinite(felt) & np.isfinite(seen[:, axis])
        return float(np.corrcoef(felt[both], seen[both, axis])[0, 1])

    return float(max(np.arange(-0.5, 0.5, 0.001), key=correlation))


def main() -> int:
    """Print the figures; 1 if one of them is not what it must be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    shared = ROOT.parent / "shared" / "video" / "gopro-hero5-gentle.mp4"
    parser.add_argument("--video", type=Path, default=shared)
    parser.add_argument("--focal", type=float, default=560.0)
    parser.add_argument("--radius", type=float, default=300.0, help="of the part of the picture that is looked at")
    args = parser.parse_args()
    times, corners, size = followed(args.video)
    middle = (np.array(size) - 1) / 2
    turns = []
    for pair in corners:
        inside = np.linalg.norm(pair[0] - middle, axis=1) < args.radius
        turns.append(rotation(*(directions(xy[inside], middle, args.focal) for xy in pair)))
    pairs = np.column_stack([np.arange(len(turns)), np.arange(1, len(turns) + 1)])
    log = read_gyro(args.video)
    backwards = GyroLog(log.time_s, log.omega_c[::-1])
    found, stored, other = (
        align_gyro(each, times, pairs, turns) for each in (log, read_gyro(args.video, "XYZ"), backwards)
    )
    if not isinstance(found, GyroAlignment) or not isinstance(stored, GyroAlignment):
        print(json.dumps({"refused": str(found), "stored": str(stored)}))
        return 1
    moves = int(np.argmax(np.nanstd(turns, axis=0)))
    best_s = best_offset(log, times, np.array(turns))
    figures = {
        "samples": len(log.time_s),
        "rate_hz": round(1 / log.step_s, 2),
        "stored": stored.axes,
        "axes": found.axes,
        "also": list(found.also),
        "tilt_deg": np.degrees(Rotation.from_matrix(found.camera_from_gyro).as_rotvec()).round(2).tolist(),
        "tilt_sigma_deg": found.axes_sigma_deg.round(2).tolist(),
        "offset_s": round(found.offset_s, 4),
        "offset_sigma_s": round(found.offset_sigma_s, 5),
        "offset_best_s": round(best_s, 3),
        "correlation": round(float(found.axis_correlations[moves]), 4),
        "correlations": found.axis_correlations.round(3).tolist(),
        "ratio": round(found.ratio, 3),
        "ratio_sigma": round(found.ratio_sigma, 3),
        "focal_px": round(args.focal * found.ratio, 1),
        "bias_rad_s": found.bias.round(4).tolist(),
        "rms_rad_s": round(found.rms, 4),
        "reversed": str(other),
    }
    print(json.dumps(figures, indent=1))
    frame_s = float(np.median(np.diff(times)))
    right = found.axes == "XYZ" and found.axis_correlations[moves] >= 0.95 and abs(found.ratio - 1) <= 0.1
    return 0 if right and abs(found.offset_s - best_s) <= frame_s and not isinstance(other, GyroAlignment) else 1


if __name__ == "__main__":
    sys.exit(main())
