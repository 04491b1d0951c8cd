"""pycolmap exports a zlib of its own; whoever imports it first must still be able to write PNG."""

from __future__ import annotations

import subprocess
import sys

import pytest

ROUND_TRIP = """
import sys
from pathlib import Path
import numpy as np
from rsundistort.io import read_photo, write_image
for dtype in (np.uint8, np.uint16):
    for shape in ((300, 400), (300, 400, 3)):
        pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, shape, dtype=dtype)
        pixels[:100] = 7
        path = Path(sys.argv[1]) / f"{np.dtype(dtype).name}-{len(shape)}.png"
        write_image(path, pixels)
        back = read_photo(path).pixels
        assert back.dtype == dtype and np.array_equal(back, pixels)
print("done")
"""


@pytest.mark.parametrize(
    "first",
    [
        "import pycolmap\nimport rsundistort",
        "import pycolmap\nimport cv2\nimport rsundistort",
        "import rsundistort\nimport pycolmap",
        "import rsundistort",
        "import cv2\nimport pycolmap\nimport rsundistort",
    ],
    ids=lambda text: text.replace("import ", "").replace("\n", "-"),
)
def test_png_is_written_whoever_comes_first(tmp_path, first):
    done = subprocess.run(
        [sys.executable, "-c", first + ROUND_TRIP, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "done"
