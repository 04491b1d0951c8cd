"""What a photo takes of the memory for each of its pixels: prints one JSON object a line.

    python benchmarks/memory.py

Photos of 12 megapixels, each in a fresh process on one thread: decoded, rectified and encoded again, by kind of file;
and its features. It is the peak less what the process held before, which Linux reports; `reckoned` is what the batches
reckon with (`pipeline/write.py`, `sfm/features.py`). Exits 1 if one crashes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile

KINDS = {
    "JPEG": 10, "progressive JPEG": 10, "WebP": 20, "PNG uint8": 32, "PNG uint16": 32, "TIFF uint16": 60,
    "TIFF float32": 60, "features": 245,
}  # fmt: skip

CODE = """
import sys
from pathlib import Path
import cv2, numpy as np
import rsundistort as rs
from rsundistort.io import read_photo, write_image
from rsundistort.sfm import detect_features
kind, folder = sys.argv[1], Path(sys.argv[2])
W, H = 4000, 3000
cv2.setNumThreads(1)
photo = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8), (0, 0), 1.0)
if "uint16" in kind: photo = photo.astype(np.uint16) * 257
if "float32" in kind: photo = photo.astype(np.float32) / 255
ending = {"WebP": ".webp", "PNG": ".png", "TIFF": ".tif"}.get(kind.split()[0], ".jpg")
path = folder / f"photo{ending}"
cv2.imwrite(str(path), photo, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1] if "progressive" in kind else [])
lens = [-0.1, 0.02, 0.0, 0.0]
camera = rs.Camera(W, H, [[3200, 0, 1999.5], [0, 3200, 1499.5], [0, 0, 1]], lens)
small = rs.Camera(400, 300, [[320, 0, 199.5], [0, 320, 149.5], [0, 0, 1]], lens)
motion = rs.RowMotion([0.01, 0.02, 0.01])
rs.rectify(photo[:300, :400].copy(), small, motion)  # the kernels
del photo
def kilobytes(name):
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(name + ":"))
open("/proc/self/clear_refs", "w").write("5")
before = kilobytes("VmRSS")
read = read_photo(path)
if kind == "features":
    detect_features(read.pixels)
else:
    pixels, mask = rs.rectify(read.pixels, camera, motion)
    del read
    write_image(folder / f"out{ending}", pixels, quality=98)
print((kilobytes("VmHWM") - before) * 1024 / (W * H))
"""


def main() -> None:
    """Measure."""
    for kind, reckoned in KINDS.items():
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run(
                [sys.executable, "-c", CODE, kind, folder], check=True, stdout=subprocess.PIPE, text=True
            )
        found = float(done.stdout)
        line = {"name": f"memory, {kind}", "bytes_per_pixel": round(found, 1), "reckoned": reckoned}
        print(json.dumps({**line, "ok": found <= reckoned}), flush=True)


if __name__ == "__main__":
    main()
