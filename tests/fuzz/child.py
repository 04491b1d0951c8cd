"""A process that reads damaged files: a group and a folder a line, and a line back of what became of them.

A folder holds the files of one input. What a reader writes goes into `OUT` in it.
"""

from __future__ import annotations

import json
import resource
import sys
import time
import traceback
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
from click.testing import CliRunner
from rsundistort_cli.main import cli

from rsundistort import Camera, Plane, RowMotion, largest_shift_px, read_solution, rectify
from rsundistort.colmap import read_colmap_cameras, read_colmap_poses
from rsundistort.errors import RsUndistortError
from rsundistort.experiments.one import METHODS, check_settings, read_trials, summarize
from rsundistort.experiments.scenes import load_scene
from rsundistort.io import (
    facts_of_exif,
    read_control_points,
    read_known_lengths,
    read_known_motions,
    read_photo_times,
    write_solution,
)
from rsundistort.io.cameras import read_camera_file
from rsundistort.io.depth_maps import read_depth_map
from rsundistort.io.gpmf import parse_payload, read_gpmf
from rsundistort.io.gyro import read_gyro
from rsundistort.io.journal import entries_of
from rsundistort.io.kept import Kept
from rsundistort.io.masks import read_mask
from rsundistort.io.metashape import named, read_metashape, write_posed_photos
from rsundistort.io.models import read_model
from rsundistort.io.nerfstudio import read_transforms
from rsundistort.io.photos.exif_facts import read_exif
from rsundistort.io.photos.images import read_photo, stored_size, write_image
from rsundistort.io.photos.xmp import corrected_xmp, marked_xmp, rectified_by
from rsundistort.io.record import Record
from rsundistort.io.video import extract_frames
from rsundistort.rectify import RemapGrid
from rsundistort.report.diagnostics import read_diagnostics
from rsundistort.sfm.imported import matched_of_database
from rsundistort.simulate.warp_folder import read_motion_file
from rsundistort.synthetic.recipe import load_recipe

# Beyond the memory that an input may take, measured as it is used, what nobody uses may be asked for.
_ROOM = 4 << 30


def only(folder: Path) -> Path:
    """The one file of a folder."""
    (path,) = (each for each in folder.iterdir() if each.name != "OUT")
    return path


def command(*args: object) -> None:
    result = CliRunner().invoke(cli, [str(arg) for arg in args])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code in (0, 1, 2, 3), result.exit_code
    if result.exit_code in (1, 2):
        raise RsUndistortError(result.output)


def solution(folder: Path) -> None:
    """What is read can be written, and is then the same."""
    found = read_solution(only(folder))
    (folder / "OUT").mkdir()
    write_solution(folder / "OUT" / "solution.json", found)
    again = read_solution(folder / "OUT" / "solution.json")
    assert [image.name for image in again.images] == [image.name for image in found.images]


def photo(folder: Path) -> None:
    """What is read can be written as what it is called."""
    path = only(folder)
    stored_size(path)
    found = read_photo(path, max_megapixels=20)
    facts_of_exif(found.metadata.exif, found.metadata.xmp)
    read_exif(path)
    if path.suffix in (".jpg", ".png", ".tif", ".webp"):
        (folder / "OUT").mkdir()
        write_image(folder / "OUT" / path.name, found.pixels[:50, :50], found.metadata)


def xmp(folder: Path) -> None:
    packet = only(folder).read_bytes()
    corrected_xmp(packet, 640, 480, 1)
    facts_of_exif(b"", packet)
    assert rectified_by(marked_xmp(packet, "0.1")) == "0.1"


def model(folder: Path) -> None:
    names = {path.name for path in folder.iterdir()}
    found = read_model(
        folder if "images.bin" in names or "images.txt" in names else folder / min(names - {"tracks.csv"})
    )
    assert np.isfinite(found.reconstruction.points_w).all()


def colmap(folder: Path) -> None:
    """All that reads a model, whatever the first of them thinks."""
    refused = None
    for read in (read_colmap_cameras, lambda each: read_colmap_poses(each, any_lens=True), model):
        try:
            read(folder)
        except RsUndistortError as error:
            refused = error
    if refused is not None:
        raise refused


def record(folder: Path) -> None:
    path = only(folder)
    entries_of(path.read_text(encoding="utf-8", errors="replace"))
    path.rename(folder / Record.NAME)
    Record(folder).ours(["images"])


def rectified(folder: Path) -> None:
    command("rectify", folder / "photos", "--solution", folder / "solution.json", "-o", folder / "OUT", "--quiet")


def report(folder: Path) -> None:
    (folder / "OUT").mkdir()
    for path in [each for each in folder.iterdir() if each.is_file()]:
        path.rename(folder / "OUT" / path.name)
    command("report", folder / "OUT", "--quiet")


def metashape(folder: Path) -> None:
    found = read_metashape(only(folder))
    assert np.isfinite(found.center_w).all()
    write_posed_photos(folder / "again.xml", found)
    assert read_metashape(folder / "again.xml").labels == found.labels
    with suppress(RsUndistortError):  # labels are what they are
        named(found, [f"{label}.jpg" for label in found.labels if "/" not in label], "photos")


def opf(folder: Path) -> None:
    found = read_model(folder / "project.opf")
    assert np.isfinite(found.reconstruction.points_w).all()


def database(folder: Path) -> None:
    """What is taken over names keypoints that there are."""
    import pycolmap  # behind rsundistort, whose zlib has to be Python's

    rec = read_model(folder).reconstruction
    (folder / "OUT").mkdir()
    matched = matched_of_database(folder / "d.db", folder / "OUT" / "ours.db", rec)
    assert all(np.isfinite(each.xy_raw).all() and np.isfinite(each.sigma).all() for each in matched.features)
    with pycolmap.Database.open(folder / "OUT" / "ours.db") as db:
        for first, second in ((1, 2), (1, 3), (2, 3)):
            ends = [len(matched.features[k - 1].xy_raw) for k in (first, second)]
            assert (db.read_matches(first, second) < ends).all()


def trials(folder: Path) -> None:
    """What is left of the lines can be counted; settings are those of an experiment, or refused."""
    path = only(folder)
    if path.name == "settings.json":
        check_settings(path, {"noise_px": 0.5, "seed": 0}, {"flyover": "ab" * 8})
    else:
        found = [entry for key, entry in read_trials(path).items() if key[0] == "flyover"]
        json.dumps(summarize(found, list(METHODS)), allow_nan=False)


def kept(folder: Path) -> None:
    """What is damaged is missing."""
    (folder / "OUT").mkdir()
    store = Kept(folder / "OUT", "k")
    store.begin()
    store.put_file("x", only(folder))
    if store.get("x") is None:
        raise RsUndistortError("missing")


READERS = {
    "solution": solution,
    "report": report,
    "rectify": rectified,
    "camera": lambda folder: read_camera_file(only(folder), 640, 480),
    "recipe": lambda folder: load_recipe(only(folder)),
    "model": model,
    "colmap": colmap,
    "transforms": lambda folder: read_transforms(only(folder)),
    "motion": lambda folder: read_motion_file(only(folder)),
    "known motions": lambda folder: read_known_motions(only(folder), 0.03),
    "lengths": lambda folder: read_known_lengths(only(folder)),
    "times": lambda folder: read_photo_times(only(folder)),
    "gyroscope": lambda folder: read_gyro(only(folder)),
    "gpmf": lambda folder: parse_payload(only(folder).read_bytes()),
    "video": lambda folder: extract_frames(only(folder), folder / "OUT", every=2),
    "telemetry": lambda folder: read_gpmf(only(folder)),
    "photo": photo,
    "mask": lambda folder: read_mask(only(folder), 64, 48),
    "depth": lambda folder: read_depth_map(only(folder)),
    "diagnostics": lambda folder: read_diagnostics(only(folder)),
    "grid": lambda folder: RemapGrid.load(only(folder)),
    "xmp": xmp,
    "record": record,
    "control": lambda folder: read_control_points(only(folder)),
    "metashape": metashape,
    "opf": opf,
    "database": database,
    "trials": trials,
    "scene": lambda folder: load_scene(only(folder)),
    "kept": kept,
}  # fmt: skip


def memory(field: str) -> int:
    """Bytes that this process holds (VmSize), or held at most since it was last asked (VmHWM)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return int(line.split()[1]) * 1024
    return 0


def tried(group: str, folder: Path) -> dict[str, object]:
    """What became of an input: "read", "refused" or "failed", what was said, how long it took and how much memory."""
    before = memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    resource.setrlimit(resource.RLIMIT_AS, (memory("VmSize") + _ROOM, resource.RLIM_INFINITY))
    began = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            READERS[group](folder)
        became, said = "read", ""
    except RsUndistortError as error:
        became, said = "refused", str(error)
        no_room = "lloc" in said and "Security limit" not in said  # which libheif calls an allocation, too
        if type(error) is not RsUndistortError and ("\n" in said or len(said) > 500 or no_room):
            became = "failed"
    except BaseException:
        became, said = "failed", traceback.format_exc()
    used = max(memory("VmHWM") - before, 0)
    return {"became": became, "said": said, "seconds": time.perf_counter() - began, "bytes": used}


def compiled() -> None:
    """Have the kernels of `rectify` compiled, which takes a minute once and is no time of a file's."""
    camera = Camera(64, 48, [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]], [0.01, 0, 0, 0])
    photo = np.zeros((48, 64, 3), np.uint8)
    for model in ("global", "rotation", "constant-motion"):
        motion = RowMotion([0.01, 0, 0], [0.1, 0, 0])
        rectify(photo, camera, motion, model, depth=Plane([0, 0, 1.0], 3.0), interpolation="cubic")
        largest_shift_px(camera, motion, model)


if __name__ == "__main__":
    compiled()
    print("ready", flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        print(json.dumps(tried(asked["group"], Path(asked["folder"]))), flush=True)
