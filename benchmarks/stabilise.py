"""Clips as a camera that stabilises electronically would have written them: a judge of what names such clips."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from rsundistort import Camera, RowMotion, read_solution, rectify
from rsundistort.io import GyroLog

__all__ = ["rotations_by_gyro", "rotations_by_truth", "stabilise", "zoomed"]

# What the smoothed view is larger by, so that no border shows.
ZOOM = 1.15


def zoomed(camera: Camera) -> Camera:
    """The camera of the stabilised frames."""
    K = np.diag([ZOOM, ZOOM, 1.0]) @ camera.K
    K[:2, 2] = camera.K[:2, 2]
    return Camera(camera.width, camera.height, K, readout=camera.readout)


def rotations_by_truth(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations (m, 3, 3) of a rendered clip's frames, and how each rotates while it is read, (m, 3) per frame."""
    truth = read_solution(folder / "ground_truth.json")
    span = truth.cameras["1"].frame_span
    images = [image for image in truth.images if image.R_cw is not None and image.motion is not None]
    return (
        np.array([image.R_cw for image in images]),
        np.array([image.motion.phi * span for image in images if image.motion is not None]),
    )


def rotations_by_gyro(
    log: GyroLog, time_s: NDArray[np.float64], readout_s: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The same by a gyroscope in the camera's axes and clock."""
    inside = np.clip(time_s, log.time_s[0], log.time_s[-1])
    turns = Rotation.from_rotvec(log.rotations(inside)).as_matrix()
    start, end = (np.clip(time_s + side * readout_s / 2, log.time_s[0], log.time_s[-1]) for side in (-1, 1))
    return turns, np.nan_to_num(-log.mean(start, end)) * readout_s


def _smoothed(R_cw: NDArray[np.float64], frames: float) -> NDArray[np.float64]:
    """Rotations (m, 3, 3) smoothed by a Gaussian of so many frames; 0: those of a tripod's pan at a steady rate."""
    first, rest = R_cw[0], Rotation.from_matrix(R_cw @ R_cw[0].T).as_rotvec()
    if not frames:
        m = len(R_cw)
        ends = Rotation.from_matrix(np.stack([R_cw[0], R_cw[-1]]))
        return np.asarray(Slerp([0, m - 1], ends)(np.arange(m)).as_matrix())
    return np.asarray(Rotation.from_rotvec(gaussian_filter1d(rest, frames, axis=0, mode="nearest")).as_matrix() @ first)


def stabilise(
    video: Path, out: Path, camera: Camera, R_cw: NDArray[np.float64], frames: float = 12.0,
    phi: NDArray[np.float64] | None = None,
) -> None:  # fmt: skip
    """Write a clip whose frames rotate smoothly, by the rotations (m, 3, 3) that they had.

    Each is rotated as a whole; with the rotations `phi` (m, 3) radians per frame its shutter is taken out before.
    """
    smooth = _smoothed(R_cw, frames)
    new, span = zoomed(camera), camera.frame_span
    size = camera.width, camera.height
    with av.open(str(video)) as source, av.open(str(out), "w") as target:
        pictures = source.streams.video[0]
        stream = target.add_stream("libx264", rate=pictures.average_rate, options={"crf": "12"})
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        for k, picture in enumerate(source.decode(pictures)):
            if k >= len(R_cw):
                break
            pixels = picture.to_ndarray(format="bgr24")
            if phi is not None:
                pixels, _ = rectify(pixels, camera, RowMotion(phi[k] / span), "rotation", camera.pinhole())
            H = new.K @ smooth[k] @ R_cw[k].T @ np.linalg.inv(camera.K)
            turned = cv2.warpPerspective(
                pixels, H, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101
            )  # fmt: skip
            target.mux(stream.encode(av.VideoFrame.from_ndarray(turned, format="bgr24")))
        target.mux(stream.encode(None))
