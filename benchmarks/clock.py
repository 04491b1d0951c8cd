"""Which row tells the time: the one that the sensor read, or the one without lens distortion? Prints one JSON object.

    python benchmarks/clock.py

On sample_scenes/handheld (k1 k2 p1 p2, all four directions), `distorted` is the library, `undistorted` the same with
the row freed of the lens as its clock. That is a pinhole camera with a shutter, whose photo a lens bends afterwards, so
it is made from the library with cameras that have no lens, and OpenCV's lens.

`psnr_db`: photos rectified with their true motions against their references, over the pixels that both show; median and
worst photo. `phi_mrad_per_frame`: largest error of any component of phi, of any photo, of a bundle adjustment of the
scene's true points, for exact measurements and for noise of 0.3 px; `rms_px` what it leaves. `shift_px`: farthest that
the two maps are apart in a photo, median and worst. Exits 1 if the undistorted row is not the worse one.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rsundistort import (
    Camera,
    Observations,
    Reconstruction,
    RowMotion,
    bundle_adjust,
    init_rectify_map,
    read_solution,
    undistort_points,
)
from rsundistort.evaluation import psnr

SCENE = Path(__file__).resolve().parent.parent / "sample_scenes" / "handheld"


def bent_afterwards(camera: Camera, motion: RowMotion) -> list[NDArray[np.float32]]:
    """The maps of `init_rectify_map`, but with the undistorted row for the clock."""
    u, v = (each.ravel() for each in init_rectify_map(camera.pinhole(), motion))
    K = np.array(camera.K)
    rays = np.column_stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))])
    uv = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(camera.dist))[0]
    return [each.reshape(camera.height, camera.width).astype(np.float32) for each in uv.reshape(-1, 2).T]


def remapped(photo: NDArray[Any], maps: Any) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """A photo through maps, and where they stay inside it."""
    h, w = photo.shape[:2]
    seen = (maps[0] >= 0) & (maps[0] <= w - 1) & (maps[1] >= 0) & (maps[1] <= h - 1)
    return cv2.remap(photo, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), seen


def photos() -> dict[str, Any]:
    """The rectified photos against their references, and how far the maps are apart."""
    truth = read_solution(SCENE / "ground_truth.json")
    decibels: dict[str, list[float]] = {"distorted": [], "undistorted": []}
    apart = []
    for image in truth.images:
        camera, motion = truth.cameras[image.camera_id], image.motion or RowMotion()
        raw, reference = (cv2.imread(str(SCENE / folder / image.name)) for folder in ("photos", "global"))
        reference, shown = remapped(reference, init_rectify_map(camera))
        maps = {"distorted": init_rectify_map(camera, motion), "undistorted": bent_afterwards(camera, motion)}
        for key, each in maps.items():
            rectified, seen = remapped(raw, each)
            decibels[key].append(psnr(rectified, reference, np.where(shown & seen, 255, 0).astype(np.uint8)))
        gap = np.hypot(*(a - b for a, b in zip(*maps.values(), strict=True)))
        apart.append(float(gap[seen].max()))
    psnr_db = {key: {"median": float(np.median(v)), "worst": min(v)} for key, v in decibels.items()}
    return {"psnr_db": psnr_db, "shift_px": {"median": float(np.median(apart)), "worst": max(apart)}}


def adjustment(noise_px: float) -> dict[str, Any]:
    """Errors of phi of the adjusted scene, and the residuals."""
    truth = read_solution(SCENE / "ground_truth.json")
    with np.load(SCENE / "tracks.npz") as tracks:
        names = [str(name) for name in tracks["image_names"]]
        frame, point, points_w = tracks["frame_idx"], tracks["point_idx"], tracks["points_w"]
        R_cw, center_w, xy = tracks["R_cw"], tracks["center_w"], tracks["xy_raw"]
    xy = xy + np.random.default_rng(0).normal(0, noise_px, xy.shape)
    ids = list(truth.cameras)
    camera_idx = np.array([ids.index(truth.image(name).camera_id) for name in names])
    phi = np.array([(truth.image(name).motion or RowMotion()).phi for name in names])
    straight = xy.copy()
    for i, name in enumerate(names):
        camera = truth.cameras[truth.image(name).camera_id]
        straight[frame == i] = undistort_points(xy[frame == i], camera, P=camera.K)
    result: dict[str, Any] = {}
    for key, measured, cameras in (
        ("distorted", xy, list(truth.cameras.values())),
        ("undistorted", straight, [camera.pinhole() for camera in truth.cameras.values()]),
    ):
        rec = Reconstruction(
            cameras, names, camera_idx, R_cw, center_w, points_w, Observations(frame, point, measured), phi,
            shutter_model="rotation",
        )  # fmt: skip
        found = bundle_adjust(rec, "rotation")
        error = np.abs(found.reconstruction.phi - phi) * rec.frame_span()[:, None]
        result[key] = {"phi_mrad_per_frame": float(error.max() * 1e3), "rms_px": found.rms_px}
    return result


def rounded(value: Any) -> Any:
    """Four digits of all numbers in nested dicts."""
    return {k: rounded(v) for k, v in value.items()} if isinstance(value, dict) else float(f"{value:.4g}")


def main() -> int:
    """Print the figures; 1 if the undistorted row is as good."""
    figures = {**photos(), "exact": adjustment(0.0), "noise 0.3 px": adjustment(0.3)}
    print(json.dumps(rounded(figures), indent=1))
    better, worse = (figures["psnr_db"][key] for key in ("distorted", "undistorted"))
    is_worse = all(worse[key] < better[key] for key in better)
    for each in ("exact", "noise 0.3 px"):
        better, worse = (figures[each][key] for key in ("distorted", "undistorted"))
        is_worse &= all(worse[key] > better[key] for key in better)
    return 0 if is_worse else 1


if __name__ == "__main__":
    sys.exit(main())
