"""Two frames of a video, however far the camera rotated between them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from make_photos import texture
from scipy.spatial.transform import Rotation

from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.errors import ReconstructionError
from rsundistort.input.key_frames import read_clip
from rsundistort.input.load import load_photos
from rsundistort.solve.clip_pair import FramePair

av = pytest.importorskip("av")

WIDTH, HEIGHT, F = 640, 480, 600.0
K = np.array([[F, 0, 319.5], [0, F, 239.5], [0, 0, 1]])


def pair_of(tmp_path: Path, frames: list[np.ndarray]) -> FramePair:
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="bgr24")))
        container.mux(stream.encode(None))
    clip = read_clip(tmp_path / "clip.mp4", tmp_path / "frames")
    assert clip.part.tolist() == [0, 0]
    camera = f"{F},{F},319.5,239.5"
    return FramePair.of(clip, load_photos(tmp_path / "frames", camera, None, 2048, Workers(1), StageLog(None), least=2))


@pytest.mark.parametrize("roll_deg", [0, 20, 45])
def test_points_are_followed_through_any_roll(tmp_path, roll_deg):
    wide = cv2.resize(texture(WIDTH // 2, WIDTH // 2, 4), (2 * WIDTH, 2 * WIDTH), interpolation=cv2.INTER_CUBIC)
    into_wide = np.array([[1, 0, WIDTH / 2], [0, 1, WIDTH - HEIGHT / 2], [0, 0, 1]])
    H = K @ Rotation.from_rotvec([0.01, -0.02, np.deg2rad(roll_deg)]).as_matrix() @ np.linalg.inv(K)
    frames = [cv2.warpPerspective(wide, each @ np.linalg.inv(into_wide), (WIDTH, HEIGHT)) for each in (np.eye(3), H)]
    pair = pair_of(tmp_path, frames)
    there = cv2.perspectiveTransform(pair.xy[0][:, None], H)[:, 0]
    off = np.linalg.norm(pair.xy[1] - there, axis=1)
    assert (off < 0.5).sum() > 1000
    assert np.mean(off < 1.0) > 0.98


def test_two_frames_from_one_place_are_named(tmp_path):
    H = K @ Rotation.from_rotvec([0.01, -0.02, 0.0]).as_matrix() @ np.linalg.inv(K)
    frame = texture(WIDTH, HEIGHT, 3)
    pair = pair_of(tmp_path, [frame, cv2.warpPerspective(frame, H, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)])
    with pytest.raises(ReconstructionError, match=r"show the scene from one place.*takes three frames"):
        pair.placed()


def test_frames_that_share_nothing_are_named(tmp_path):
    with pytest.raises(ReconstructionError, match=r"clip_000000\.png and clip_000001\.png share too little"):
        pair_of(tmp_path, [texture(WIDTH, HEIGHT, seed) for seed in (1, 2)]).placed()
