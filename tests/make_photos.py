"""Photos for the tests: textures, EXIF, and the courtyard at half its size."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np

COURTYARD = Path(__file__).parent.parent / "sample_scenes" / "courtyard"
COURTYARD_NAMES = [f"{k:04}.png" for k in range(1, 7)]


def texture(width: int, height: int, seed: int = 0, channels: int = 3) -> np.ndarray:
    """Smooth noise, 8 bit: (h, w) for one channel, else (h, w, channels)."""
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    stretched = cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX)
    return stretched[..., 0] if channels == 1 and stretched.ndim == 3 else stretched


def save_png(path: Path, pixels: np.ndarray) -> None:
    path.write_bytes(bytes(cv2.imencode(".png", pixels)[1]))


def save_textures(folder: Path, names: list[str], width: int = 320, height: int = 240) -> Path:
    """A folder of photos that have nothing in common."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, name in enumerate(names):
        (folder / name).write_bytes(bytes(cv2.imencode(Path(name).suffix, texture(width, height, seed))[1]))
    return folder


def exif_block(orientation: int, focal_35mm: int | None = None) -> np.ndarray:
    """A little-endian TIFF header with the orientation, and the focal length of a 35 mm equivalent."""
    short = 3
    if focal_35mm is None:
        ifd = struct.pack("<HHHIHHI", 1, 0x0112, short, 1, orientation, 0, 0)
        return np.frombuffer(b"II*\0" + struct.pack("<I", 8) + ifd, np.uint8)
    exif_at = 8 + 2 + 2 * 12 + 4
    ifd = struct.pack("<H", 2)
    ifd += struct.pack("<HHIHH", 0x0112, short, 1, orientation, 0)
    ifd += struct.pack("<HHII", 0x8769, 4, 1, exif_at) + struct.pack("<I", 0)
    sub = struct.pack("<HHHIHHI", 1, 0xA405, short, 1, focal_35mm, 0, 0)
    return np.frombuffer(b"II*\0" + struct.pack("<I", 8) + ifd + sub, np.uint8)


def half_camera(camera: dict) -> dict:
    """The camera of photos shrunk to half their size; pixel centres are whole numbers."""
    K = np.array(camera["K"])
    K[:2, 2] = (K[:2, 2] + 0.5) / 2 - 0.5
    K[[0, 1], [0, 1]] /= 2
    return {**camera, "width": camera["width"] // 2, "height": camera["height"] // 2, "K": K.tolist()}


def half_courtyard(folder: Path, names: list[str] | None = None) -> Path:
    """Photos (PNG), camera and truth of the courtyard at half its size; returns the photos' folder."""
    names = COURTYARD_NAMES if names is None else names
    photos = folder / "photos"
    photos.mkdir(parents=True)
    for name in names:
        full = cv2.imread(str(COURTYARD / "photos" / name.replace(".png", ".jpg")), cv2.IMREAD_COLOR)
        height, width = full.shape[:2]
        save_png(photos / name, cv2.resize(full, (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    camera = half_camera(json.loads((COURTYARD / "camera.json").read_text()))
    (folder / "camera.json").write_text(json.dumps(camera))
    # phi is per unit of the clock, which does not know the size
    truth = json.loads((COURTYARD / "ground_truth.json").read_text())
    truth["cameras"] = {key: half_camera(value) for key, value in truth["cameras"].items()}
    truth["rectified_cameras"] = {key: half_camera(v) for key, v in truth["rectified_cameras"].items()}
    for image in truth["images"]:
        image["name"] = image["name"].replace(".jpg", ".png")
    truth["images"] = [image for image in truth["images"] if image["name"] in names]
    (folder / "ground_truth.json").write_text(json.dumps(truth))
    return photos
