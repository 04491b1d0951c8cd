"""What happens to real photo files: prints one JSON object a line, and exits 1 if one of them is not as it should be.

    python benchmarks/files.py [DIR_OF_PHOTOS]

DIR_OF_PHOTOS (default ../shared/photos) holds exif-orientation/ (one picture in the eight orientations, and 0), raw/
(DNGs of one scene in three orientations, and a file that is no RAW), lund/ and iphone6/ (phone photos with EXIF). All
go through `rectify` with zero motion. ExifRead and Pillow, which share no code with what they judge, read the tags
before and after.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import exifread
import numpy as np
from PIL import Image

from rsundistort import Camera, RowMotion, Solution, SolvedImage, rectify_folder, write_solution
from rsundistort.errors import FileError
from rsundistort.evaluation import psnr
from rsundistort.io import list_photos, output_name, read_photo, write_image
from rsundistort.model.orientation import MATRICES, orient_pixels

ROOT = Path(__file__).resolve().parent.parent


def still(photos: Path, out: Path, **options: Any) -> tuple[list[str], list[str]]:
    """Rectify a folder as if nothing had moved; which photos were left out, and what was said."""
    cameras: dict[str, Camera] = {}
    images = []
    for name in list_photos(photos):
        try:
            height, width = read_photo(photos / name).pixels.shape[:2]
        except FileError:
            height, width = 480, 640
        key = f"{width}x{height}"
        cameras[key] = Camera(width, height, [[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]])
        images.append(SolvedImage(name, key, motion=RowMotion()))
    path = out.with_suffix(".json")
    write_solution(path, Solution("rotation", cameras, {k: c.pinhole() for k, c in cameras.items()}, images))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        _, left_out = rectify_folder(photos, path, out, **options)
    return list(left_out), [str(w.message) for w in caught]


def tags(path: Path) -> dict[str, str]:
    """All tags but the thumbnail's and the places of the IFDs."""
    with path.open("rb") as file:
        found = exifread.process_file(file, details=True)
    places = ("Image ExifOffset", "Image GPSInfo", "EXIF InteroperabilityOffset")
    return {k: str(v) for k, v in found.items() if not k.startswith(("Thumbnail", "JPEG")) and k not in places}


def orientation(photos: Path, scratch: Path) -> tuple[dict[str, Any], bool]:
    """Nine in, nine out: stored frame and tag; and all alike when the tag is applied."""
    still(photos, scratch / "stored")
    _, said = still(photos, scratch / "shown", apply_orientation=True)
    kept, worst, right, wrong = 0, np.inf, np.inf, 0.0
    names = list_photos(photos)
    reference = read_photo(scratch / "shown" / "images" / "Landscape_1.jpg").pixels
    for name in names:
        before, after, shown = (
            read_photo(path / name) for path in (photos, scratch / "stored" / "images", scratch / "shown" / "images")
        )
        tag = "Image Orientation"
        kept += tags(photos / name)[tag] == tags(scratch / "stored" / "images" / name)[tag]
        worst = min(worst, psnr(after.pixels, before.pixels))
        right = min(right, psnr(shown.pixels, reference) if shown.metadata.orientation == 1 else 0.0)
        others = [orient_pixels(shown.pixels, o) for o in MATRICES if o != 1]
        wrong = max(wrong, *(psnr(other, reference) for other in others if other.shape == reference.shape))
    return {
        "in": len(names),
        "out": len(list((scratch / "stored" / "images").iterdir())),
        "same_tag": kept,
        "stored_frame_psnr_db_worst": round(worst, 1),
        "applied_psnr_db_worst": round(right, 1),
        "turned_wrongly_psnr_db_best": round(wrong, 1),
        "said": said,
    }, kept == len(names) == 9 and worst > 50 and right > wrong + 10


def raw(photos: Path, scratch: Path) -> tuple[dict[str, Any], bool]:
    """DNGs that differ in their tag only give the same pixels; what is no RAW is named and left out."""
    left_out, said = still(photos, scratch / "raw")
    read = {
        name: read_photo(scratch / "raw" / "images" / output_name(name))
        for name in list_photos(photos)
        if name not in left_out
    }
    first = next(iter(read.values())).pixels
    same = all(np.array_equal(photo.pixels, first) for photo in read.values())
    orientations = {name: photo.metadata.orientation for name, photo in read.items()}
    result = {"same_pixels": same, "dtype": str(first.dtype), "orientations": orientations, "left_out": left_out}
    good = same and left_out == ["truncated.nef"] and any("truncated.nef" in line for line in said)
    return {**result, "said": said}, good and sorted(orientations.values()) == [1, 6, 8]


def exact(photo: Path, scratch: Path) -> tuple[dict[str, Any], bool]:
    """A real picture as 8, 16 and float bits, colour, grey and with alpha: zero motion changes no bit."""
    pixels = read_photo(photo).pixels
    (scratch / "depths").mkdir()
    for depth in (np.uint8, np.uint16, np.float32):
        noise = np.random.default_rng(0).integers(0, 200, pixels.shape)
        deep = (
            pixels.astype(float) * {1: 1.0, 2: 256.0, 4: 3.7}[np.dtype(depth).itemsize] + noise * (depth != np.uint8)
        ).astype(depth)
        for kind, value in {"colour": deep, "grey": deep[..., 1], "alpha": np.dstack([deep, deep[..., 0]])}.items():
            for suffix in (".tif",) if depth == np.float32 else (".tif", ".png"):
                write_image(scratch / "depths" / f"{np.dtype(depth).name}-{kind}-{suffix[1:]}{suffix}", value)
    results = {}
    for interpolation in ("linear", "cubic", "lanczos"):
        out = scratch / f"depths-{interpolation}"
        still(scratch / "depths", out, interpolation=interpolation)
        for path in sorted((scratch / "depths").iterdir()):
            before, after = read_photo(path).pixels, read_photo(out / "images" / path.name).pixels
            same = before.dtype == after.dtype and np.array_equal(before, after)
            results[path.stem] = results.get(path.stem, True) and same
    return {"exact": results}, all(results.values())


def metadata(photos: list[Path], scratch: Path) -> tuple[list[dict[str, Any]], bool]:
    """EXIF tag by tag, maker note, XMP and ICC of real photos, before and after."""
    lines, good = [], True
    for path in photos:
        folder, out = scratch / f"in-{path.stem}", scratch / f"out-{path.stem}"
        folder.mkdir()
        (folder / path.name).write_bytes(path.read_bytes())
        still(folder, out)
        written = out / "images" / path.name
        before, after = tags(path), tags(written)
        old, new = read_photo(path).metadata, read_photo(written).metadata
        with Image.open(path) as one, Image.open(written) as two:
            notes = [image.getexif().get_ifd(0x8769).get(0x927C) for image in (one, two)]
            profiles = [image.info.get("icc_profile", b"") for image in (one, two)]
        note = notes[0]
        in_place = note is None or (notes[0] == notes[1] and old.exif.find(note) == new.exif.find(note))
        mark = new.xmp.find(b"<rdf:Description rdf:about", new.xmp.find(b"urn:rsundistort") - 60)
        rest = new.xmp[:mark] + new.xmp[new.xmp.find(b"/>", mark) + 2 :]
        line = {
            "photo": f"{path.parent.name}/{path.name}",
            "tags": len(before),
            "tags_changed": sorted(k for k in {*before, *after} if before.get(k) != after.get(k)),
            "exif_bytes_same": old.exif == new.exif,
            "maker_note": None if note is None else len(note),
            "maker_note_in_place": in_place,
            "xmp_bytes": len(old.xmp),
            "xmp_same_but_for_the_mark": rest == old.xmp or not old.xmp,
            "icc_bytes": len(profiles[0]),
            "icc_same": profiles[0] == profiles[1],
            "rectified_by": new.rectified_by,
        }
        good &= not line["tags_changed"] and in_place and line["xmp_same_but_for_the_mark"] and line["icc_same"]
        good &= new.rectified_by is not None
        lines.append(line)
    return lines, good


def main() -> None:
    """Run all checks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="?", default=ROOT.parent / "shared" / "photos")
    photos = parser.parse_args().photos
    warnings.simplefilter("ignore")
    good = True
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        five = [photos / "lund" / f"{k}.jpg" for k in ("01", "15", "29")]
        five += [photos / "iphone6" / f"IMG_{k}.jpg" for k in (4303, 4309)]
        for name, (result, fine) in {
            "exif-orientation": orientation(photos / "exif-orientation", scratch),
            "raw": raw(photos / "raw", scratch),
            "identity": exact(photos / "lund" / "01.jpg", scratch),
        }.items():
            print(json.dumps({"name": name, "as_it_should_be": bool(fine), **result}), flush=True)
            good &= fine
        lines, fine = metadata(five, scratch)
        for line in lines:
            print(json.dumps({"name": "metadata", **line}), flush=True)
    sys.exit(0 if good and fine else 1)


if __name__ == "__main__":
    main()
