"""Whether every file at hand is read: sample scenes, and ../shared where it is there; JSON of what was refused.

    python benchmarks/readable.py

Each file is given to the readers that take its kind, the strictest of which must take it.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from rsundistort import read_solution
from rsundistort.errors import RsUndistortError
from rsundistort.experiments.scenes import load_scene
from rsundistort.io import has_telemetry, read_gyro, read_photo
from rsundistort.io.cameras import read_camera_file
from rsundistort.io.depth_maps import read_depth_map
from rsundistort.io.gpmf import parse_payload
from rsundistort.io.models import read_model
from rsundistort.io.nerfstudio import read_transforms
from rsundistort.io.video import VideoReader
from rsundistort.synthetic.recipe import load_recipe

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = (ROOT / "sample_scenes", ROOT.parent / "shared")


def first_frame(path: Path) -> object:
    with VideoReader(path) as reader:
        return next(iter(reader))


def camera(path: Path) -> object:
    return read_camera_file(path, 640, 480)


READERS: dict[str, list[Callable[[Path], object]]] = {
    ".json": [read_solution, load_recipe, camera, read_transforms, read_model],
    ".npz": [load_scene, read_depth_map],
    ".gpmf": [lambda path: parse_payload(path.read_bytes())],
    ".mp4": [first_frame],
    ".mov": [first_frame],
    ".csv": [read_gyro],
    ".gcsv": [read_gyro],
    ".yaml": [camera],
    ".xml": [camera],
    **{suffix: [read_photo] for suffix in (".jpg", ".jpeg", ".png", ".tif", ".webp", ".dng", ".heic", ".nef", ".arw")},
}


def main() -> None:
    """Read all, and print what no reader takes."""
    warnings.simplefilter("ignore")
    read: Counter[str] = Counter()
    refused: dict[str, str] = {}
    files = [path for folder in FOLDERS for path in sorted(folder.rglob("*")) if path.is_file()]
    for path in files:
        readers = READERS.get(path.suffix.lower(), [])
        if path.suffix.lower() == ".mp4" and has_telemetry(path):
            readers = [*readers, read_gyro]
        errors = []
        for reader in readers:
            try:
                reader(path)
                read[f"{path.suffix.lower()} by {reader.__name__}"] += 1
                break
            except RsUndistortError as error:
                errors.append(f"{reader.__name__}: {error}")
        else:
            if errors:
                refused[str(path.relative_to(ROOT.parent))] = "; ".join(errors)
    for folder in {path.parent for path in files if path.name in ("images.bin", "images.txt")}:
        try:
            read_model(folder)
            read["COLMAP models"] += 1
        except RsUndistortError as error:
            refused[str(folder.relative_to(ROOT.parent))] = str(error)
    json.dump({"read": dict(sorted(read.items())), "refused": refused}, sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
