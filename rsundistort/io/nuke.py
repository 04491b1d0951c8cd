"""The camera track for Nuke: a script with a camera, and a `.chan` file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..model import Camera
from ..model.array_types import Array, Index
from .export_scene import ExportScene, euler_deg
from .usd import FILM_WIDTH, FLIP

__all__ = ["write_nuke"]

#: Frames of files are counted from one in Nuke.
_FIRST = 1


def write_nuke(folder: Path, scene: ExportScene) -> str:
    """Write `camera.nk` and `camera.chan`: of a video with a path every frame, else the photos by name, from 1.

    The world is rotated so that y is up, as in `camera.usda`: y and z are negated. The film back is as wide as 36 mm;
    `win_translate` is where the principal point is not in the middle, in halves of the width, and `win_scale` the ratio
    of focal lengths. Nothing is left over: the text is empty.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras: Sequence[Camera]
    if scene.track is not None:
        track = scene.track
        frames = _FIRST + np.round(track.numbers).astype(int)
        cameras = [track.camera] * len(frames)
        R_cw, center_w = track.R_cw, track.center_w
    else:
        images = sorted(scene.images, key=lambda image: image.name)
        frames = np.arange(_FIRST, _FIRST + len(images))
        cameras = [scene.camera(image) for image in images]
        R_cw = np.array([image.R_cw for image in images]).reshape(-1, 3, 3)
        center_w = np.array([image.center_w for image in images]).reshape(-1, 3)
    # camera to world, y up in both; Nuke rotates about z first, then x, then y: R = Ry Rx Rz
    rotated = FLIP @ R_cw.transpose(0, 2, 1) @ FLIP
    angles = np.unwrap(euler_deg(rotated, "zxy")[:, [1, 2, 0]], axis=0, period=360)
    centers = center_w @ FLIP
    lens = np.array([_lens(camera) for camera in cameras]).reshape(-1, 6)
    (folder / "camera.nk").write_text(_script(frames, centers, angles, lens, cameras), encoding="utf-8")
    rows = np.column_stack([frames, centers, angles, np.degrees(2 * np.arctan(lens[:, 2] / (2 * lens[:, 0])))])
    text = "".join("\t".join([str(int(row[0])), *map(repr, row[1:])]) + "\n" for row in rows.tolist())
    (folder / "camera.chan").write_text(text, encoding="utf-8")
    return ""


def _lens(camera: Camera) -> list[float]:
    """`focal`, `haperture` and `vaperture` in mm, `win_translate` u and v, and `win_scale` v."""
    mm = FILM_WIDTH / camera.width
    fx, fy, ratio = camera.K[0, 0], camera.K[1, 1], camera.K[0, 0] / camera.K[1, 1]
    cx, cy = camera.K[0, 2] + 0.5, camera.K[1, 2] + 0.5
    u, v = 1 - 2 * cx / camera.width, (2 * cy - camera.height) / camera.width * ratio
    return [float(fx * mm), FILM_WIDTH, float(camera.height * mm * fx / fy), float(u), float(v), float(ratio)]


def _script(frames: Index, centers: Array, angles: Array, lens: Array, cameras: Sequence[Camera]) -> str:
    def curve(values: Array) -> str:
        if np.ptp(values) == 0:
            return repr(float(values[0]))
        return "{curve " + " ".join(f"x{f} {v!r}" for f, v in zip(frames.tolist(), values.tolist(), strict=True)) + "}"

    size = f"{cameras[0].width} {cameras[0].height}"
    lines = [
        "Root {",
        f" first_frame {frames[0]}",
        f" last_frame {frames[-1]}",
        f' format "{size} 0 0 {size} 1 rectified"',
        "}",
        "Camera2 {",
        " inputs 0",
        " rot_order ZXY",
        f" translate {{{' '.join(map(curve, centers.T))}}}",
        f" rotate {{{' '.join(map(curve, angles.T))}}}",
        *(f" {name} {curve(lens[:, k])}" for k, name in enumerate(("focal", "haperture", "vaperture"))),
        f" win_translate {{{curve(lens[:, 3])} {curve(lens[:, 4])}}}",
        f" win_scale {{1 {curve(lens[:, 5])}}}",
        " name rsundistort_camera",
        "}",
    ]
    return "\n".join(lines) + "\n"
