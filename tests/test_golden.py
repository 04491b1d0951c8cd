"""Photos of the sample scenes, rectified with their true motion, are what they were; so are the grids behind them.

A new scene needs `pytest tests/test_golden.py --regolden` once.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rsundistort import Camera, RowMotion, init_rectify_map, largest_shift_px, read_solution, rectify
from rsundistort.io import read_photo

SCENES = Path(__file__).parent.parent / "sample_scenes"
FOLDER = "sample_scenes"  # of the golden files
STEP = 4  # at a quarter of their size


def at_a_quarter(camera):
    """The camera of a photo whose pixels are means of 4x4; what is left over on the right and below falls away."""
    K = np.array(camera.K)
    K[:2, :2] /= STEP
    K[:2, 2] = (K[:2, 2] - (STEP - 1) / 2) / STEP
    return Camera(camera.width // STEP, camera.height // STEP, K, camera.dist, camera.readout)


def shrink(photo):
    """Means of 4x4 pixels; not by OpenCV, so that nothing but `rectify` depends on its version."""
    h, w = (n // STEP for n in photo.shape[:2])
    blocks = photo[: h * STEP, : w * STEP].reshape(h, STEP, w, STEP, -1)
    return np.rint(blocks.mean(axis=(1, 3))).astype(photo.dtype)


def chosen_photos():
    """Two photos a scene: where the shutter bent most, of different cameras if the scene has several."""
    chosen = []
    for truth_path in sorted(SCENES.glob("*/ground_truth.json")):
        if not (truth_path.parent / "photos").is_dir():  # a clip, whose frames depend on the decoder
            continue
        truth = read_solution(truth_path)
        by_shift = []
        for image in truth.registered:
            camera, motion = truth.cameras[image.camera_id], RowMotion(image.motion.phi)  # translation needs depth
            by_shift.append((-largest_shift_px(camera, motion), image.name, image.camera_id, camera, motion))
        by_shift.sort(key=lambda entry: entry[:2])
        first_of_camera = {entry[2]: entry for entry in reversed(by_shift)}
        by_shift.sort(key=lambda entry: first_of_camera[entry[2]] is not entry)
        for (_, name, _, camera, motion), interpolation in zip(by_shift, ("cubic", "linear"), strict=False):
            stem, path = f"{truth_path.parent.name}-{Path(name).stem}", truth_path.parent / "photos" / name
            chosen.append(pytest.param(path, at_a_quarter(camera), motion, stem, interpolation, id=stem))
    return chosen


CHOSEN = chosen_photos()
photos = pytest.mark.parametrize(("path", "camera", "motion", "stem", "interpolation"), CHOSEN)


@photos
def test_rectified_photo_is_the_golden_one(path, camera, motion, stem, interpolation, golden):
    rectified, _ = rectify(shrink(read_photo(path).pixels), camera, motion, interpolation=interpolation)
    # OpenCV 4 (4.12, 4.14) and 5.0 round cubic and linear remaps of 8 bit otherwise; JPEG and grid are the same.
    # Measured on courtyard: 30 % of the pixels differ by 1 grey level, 0.5 % by 2, at most 0.005 % by 3, none by more.
    # A shift by 1/32 pixel changes 1.2 % of the pixels by more than 2, the two-step model 45 %.
    golden.image(f"{FOLDER}/{stem}.png", rectified, max_grey=2, max_share=0.001)


@photos
def test_grid_is_the_golden_one(path, camera, motion, stem, interpolation, golden):
    grid = np.dstack(init_rectify_map(camera, motion))[::8, ::8]
    # pixels; float32 of numbers up to 512 is good to 3e-5
    golden.array(f"{FOLDER}/{stem}-grid.npz", grid, atol=1e-4)


def test_golden_files_are_small_and_each_has_its_photo():
    files = [path for path in (Path(__file__).parent / "golden" / FOLDER).iterdir() if path.is_file()]
    stems = [param.id for param in CHOSEN]
    assert {f.name for f in files} == {f"{stem}{ending}" for stem in stems for ending in (".png", "-grid.npz")}
    assert sum(f.stat().st_size for f in files) <= 1_000_000
