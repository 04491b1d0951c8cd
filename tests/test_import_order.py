"""pycolmap exports a zlib of its own: PNG is written where it comes after ours, and refused where it came before."""

from __future__ import annotations

import re
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

ROUND_TRIP = """
import sys
from pathlib import Path
import numpy as np
from rsundistort.io import Metadata, read_photo, write_image
for dtype in (np.uint8, np.uint16):
    for shape in ((300, 400), (300, 400, 3)):
        pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, shape, dtype=dtype)
        pixels[:100] = 7
        path = Path(sys.argv[1]) / f"{np.dtype(dtype).name}-{len(shape)}.png"
        write_image(path, pixels)
        back = read_photo(path).pixels
        assert back.dtype == dtype and np.array_equal(back, pixels)
metadata = Metadata(b"II*\\0\\x08\\0\\0\\0" + bytes(6), b"<x/>", bytes(16) + b"RGB " + bytes(70000))
write_image(path, pixels, metadata)
assert read_photo(path).metadata == metadata
import struct
profile = b"iCCPp\\0\\0" + PROFILE
data = SMALL
path.write_bytes(data[:33] + struct.pack(">I", len(profile) - 4) + profile + bytes(4) + data[33:])
assert read_photo(path).metadata.icc == bytes(70000)  # inflated
print("done")
"""


REFUSED = """
import sys
from pathlib import Path
import numpy as np
from rsundistort.errors import InputError
from rsundistort.io import output_folder, write_image
folder = Path(sys.argv[1])
write_image(folder / "photo.jpg", np.zeros((4, 6, 3), np.uint8))
png = lambda: write_image(folder / "mask.png", np.zeros((4, 6), np.uint8))
for job in (png, output_folder(folder / "out").__enter__):
    try:
        job()
    except InputError as error:
        print(error)
"""


def in_order(imports):
    """The names of what is imported."""
    return imports.replace("import ", "").replace("\n", "-")


@pytest.mark.parametrize(
    "first",
    [
        "import rsundistort\nimport pycolmap",
        "import rsundistort",
        pytest.param("import cv2\nimport pycolmap\nimport rsundistort", marks=pytest.mark.slow),
    ],
    ids=in_order,
)
def test_png_is_written_where_pycolmap_comes_after_zlib(tmp_path, first):
    # compressed here, since the process may not be able to
    small = bytes(cv2.imencode(".png", np.zeros((2, 2), np.uint8))[1])
    given = f"\nSMALL = {small!r}\nPROFILE = {zlib.compress(bytes(70000))!r}\n"
    done = subprocess.run(
        [sys.executable, "-c", first + given + ROUND_TRIP, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "done"


@pytest.mark.parametrize(
    "first",
    [
        "import pycolmap\nimport rsundistort",
        pytest.param("import pycolmap\nimport cv2\nimport rsundistort", marks=pytest.mark.slow),
    ],
    ids=in_order,
)
def test_png_and_folders_of_outputs_are_refused_where_pycolmap_came_first(tmp_path, first):
    command = [sys.executable, "-c", first + REFUSED, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    assert all("import rsundistort first, then pycolmap" in line for line in lines)
    assert [path.name for path in tmp_path.iterdir()] == ["photo.jpg"]


def test_every_package_is_installed():
    """A package that `pyproject.toml` forgets is missing from what pip installs, and present here."""
    root = Path(__file__).parent.parent
    there = {
        path.parent.relative_to(root).as_posix().replace("/", ".") for path in root.glob("rsundistort/**/__init__.py")
    }
    block = (root / "pyproject.toml").read_text(encoding="utf-8").partition("\npackages = [")[2].partition("]")[0]
    assert there | {"rsundistort_cli"} == set(re.findall(r'"([.\w]+)"', block))
