"""What is damaged besides `groups`: files of surveys and of other programs, experiments, and what is kept in OUT."""

from __future__ import annotations

import json
import re
import sqlite3
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import damage
import numpy as np
import pillow_heif
import pycolmap
from groups import Files, Group, archives, dumped, npy, one_of, packed
from hypothesis import strategies as st
from make_photos import exif_block, small_dng, texture
from test_exports import made
from test_metashape import FISHEYE, FRAME, project, xml
from test_solve import make_database

from rsundistort import Camera
from rsundistort.io.exports import EXPORTS
from rsundistort.io.kept import Kept


def in_folder(write: Callable[[Path], object]) -> Files:
    """The files that a function writes into a folder."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def one_damaged(
    files: Files, kinds: dict[str, Callable[[bytes], st.SearchStrategy[bytes]]]
) -> st.SearchStrategy[Files]:
    """All of some files, of which one is damaged in the way of its ending."""

    def damaged(name: str) -> st.SearchStrategy[Files]:
        return kinds[name.rpartition(".")[2]](files[name]).map(lambda data: {**files, name: data})

    return st.one_of(*(damaged(name) for name in sorted(files)))


# ---------------------------------------------------------------- surveys

CONTROL = (
    b"name,photo,x,y,E,N,U,sigma,sigma_up,use\n"
    b"P1,0.jpg,10,20,1000,2000,300,0.02,0.04,control\nP1,1.jpg,30.5,40,,,,,,\n"
    b"P2,0.jpg,5,6,1010,2000,301,0.02,,check\nP2,2.jpg,7,8,1010,2000,301,0.02,,check\n"
)


@cache
def metashape() -> Files:
    chunk = (
        "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>1 2 3</translation><scale>2</scale></transform>"
    )
    written = in_folder(lambda folder: EXPORTS["metashape"].write(folder, made()))
    return {
        "frame.xml": xml(FRAME, transform=chunk).encode(), "fisheye.xml": xml(FISHEYE, "fisheye").encode(),
        "cameras.xml": written["cameras.xml"], "project.xml": project().encode(),
    }  # fmt: skip


@cache
def opf() -> Files:
    return in_folder(lambda folder: EXPORTS["opf-rectified"].write(folder, made()))


def opf_projects() -> st.SearchStrategy[Files]:
    def trees(data: bytes) -> st.SearchStrategy[bytes]:
        return damage.json_texts(json.loads(data))

    return one_damaged(opf(), {"opf": trees, "json": trees, "gltf": trees, "bin": damage.binaries})


# ---------------------------------------------------------------- photos of phones and raw ones


@cache
def raw_photos() -> Files:
    """A HEIC with EXIF, and a DNG."""

    def write(folder: Path) -> None:
        heic = pillow_heif.from_bytes("BGR", (64, 48), texture(64, 48).tobytes())
        heic.save(folder / "a.heic", exif=bytes(exif_block(6, 28)))
        (folder / "a.dng").write_bytes(small_dng(6))

    return in_folder(write)


def heic_and_raw() -> st.SearchStrategy[Files]:
    return one_of(
        a__heic=damage.binaries(raw_photos()["a.heic"], heic_marks),
        a__dng=damage.binaries(raw_photos()["a.dng"], damage.tiff_marks),
    )


def heic_marks(data: bytes) -> list[int]:
    """Boxes, which lie in one that is no plain one, and so are found by their names."""
    names = rb"ftyp|meta|hdlr|pitm|iloc|iinf|infe|iref|iprp|ipco|ipma|ispe|hvcC|irot|imir|pixi|colr|mdat|Exif"
    return [max(0, match.start() + step) for match in re.finditer(names, data) for step in (-4, 4, 8, 16)]


# ---------------------------------------------------------------- databases


@cache
def database() -> tuple[Files, bytes]:
    """A model as COLMAP's, and the database behind it."""

    def write(folder: Path) -> None:
        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 3, 12
        model = pycolmap.synthesize_dataset(options)
        for image in model.images.values():
            for point in image.points2D:
                point.xy = np.asarray(point.xy, np.float32)  # as the database holds them
        model.write_binary(folder)
        make_database(folder / "d.db", SimpleNamespace(model=model))

    files = in_folder(write)
    return {name: data for name, data in files.items() if name.endswith(".bin")}, files["d.db"]


STATEMENTS = [
    *(
        f"UPDATE {table} SET {change}"
        for table in ("keypoints", "matches")
        for change in (
            "data = NULL", "data = 'x'", "data = 7", "data = x''", "data = zeroblob(100000000)", "rows = NULL",
            "rows = 'x'", "rows = -rows, cols = -cols", "rows = 0.5", "rows = 4294967296", "rows = 9223372036854775807",
            "cols = 0", "cols = 1, rows = rows * cols", "cols = 3", "cols = rows, rows = cols", "rows = rows - 1",
            "data = value(length(data), x'0000c07f')", "data = value(length(data), x'ffffffff')",
            "data = value(length(data), x'000080ff')", "data = value(length(data), x'ffff7f7f')", "rows = 0",
            "data = substr(data, 2)", "data = substr(data, 9), rows = rows - 1", "rows = rows + 1",
        )
    ),
    *(f"DELETE FROM {table}" for table in ("keypoints", "matches", "images", "cameras")),
    *(f"DROP TABLE {table}" for table in ("keypoints", "matches", "images", "two_view_geometries")),
    *(
        f"ALTER TABLE {table} RENAME TO old; CREATE VIEW {table} AS SELECT * FROM old"
        for table in ("keypoints", "matches", "images")
    ),
    "ALTER TABLE images RENAME TO old; CREATE VIEW images AS WITH RECURSIVE c(image_id, name) AS (SELECT 1, 'x' UNION "
    "ALL SELECT image_id + 1, name || 'x' FROM c) SELECT * FROM c",
    "ALTER TABLE keypoints RENAME TO old; CREATE TABLE keypoints (image_id INTEGER PRIMARY KEY, rows INTEGER, cols "
    "INTEGER, data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL); INSERT INTO keypoints SELECT image_id, "
    "rows, cols FROM old",
    *(f"UPDATE images SET name = {value}" for value in ("name || 'x'", "name || char(0)", "CAST(x'ff' AS TEXT)",
                                                        "image_id", "CAST(name AS BLOB)")),
    *(f"UPDATE images SET image_id = {value}" for value in ("-image_id", "image_id + 1000", "image_id * 3000000000")),
    *(f"UPDATE matches SET pair_id = {value}" for value in ("-pair_id", "pair_id * 2", "pair_id + 1", "pair_id - 1")),
    "UPDATE matches SET pair_id = 2147483648 WHERE pair_id = (SELECT min(pair_id) FROM matches)",
    "PRAGMA encoding = 'UTF-16'", "PRAGMA user_version = -1", "VACUUM",
]  # fmt: skip


def altered(statement: str) -> bytes:
    """The database after a statement; as it was where SQLite does not take it."""

    def write(folder: Path) -> None:
        path = folder / "d.db"
        path.write_bytes(database()[1])
        db = sqlite3.connect(path)
        db.create_function("value", 2, lambda size, word: word * ((size or 0) // len(word)), deterministic=True)
        try:
            db.executescript(statement)
        except sqlite3.Error:
            db.rollback()
        finally:
            db.close()

    return in_folder(write)["d.db"]


def databases() -> st.SearchStrategy[Files]:
    data = database()[1]
    # pages of 4096 bytes, whose heads tell what is in them
    heads = [each + step for each in range(0, len(data), 4096) for step in (0, 3, 5, 8, 100, 103)]
    return one_of(d__db=st.sampled_from(STATEMENTS).map(altered) | damage.binaries(data, lambda _: heads))


# ---------------------------------------------------------------- experiments

NUMBERS = {"rotation_deg": 0.1, "translation": 0.01, "structure": 0.02, "iterations": 7, "seconds": 0.25}
TRIALS = [
    {"scene": "flyover", "trial": trial, "method": method, **NUMBERS, "stop_reason": "cost", "phi_sigma": 0.01}
    for trial in range(2)
    for method in ("wo-rs", "rs")
]
SETTINGS = {"noise_px": 0.5, "seed": 0, "scenes": {"flyover": "ab" * 8}}


def lines(entries: list[dict]) -> bytes:
    return b"".join(dumped(entry) + b"\n" for entry in entries)


@cache
def scene() -> dict[str, np.ndarray]:
    """The arrays of `tracks.npz`."""
    found = made().reconstruction
    camera, obs = found.cameras[0], found.observations
    return {
        "width": np.array(camera.width), "height": np.array(camera.height), "K": camera.K, "R_cw": found.R_cw,
        "center_w": found.center_w, "points_w": found.points_w, "frame_idx": obs.frame_idx, "point_idx": obs.point_idx,
    }  # fmt: skip


# ---------------------------------------------------------------- what is kept in OUT


@cache
def kept() -> dict[str, np.ndarray]:
    """The arrays of a value that a stage of a run came to."""
    value = {
        "camera": Camera(64, 48, np.diag([50.0, 50, 1])),
        "rows": range(3),
        "of": [Path("a"), {1, 2}, (np.float64(1), None)],
    }

    def write(folder: Path) -> None:
        store = Kept(folder, "k")
        store.begin()
        store.put("x", value)
        store.path("x").rename(folder / "x.npz")

    with TemporaryDirectory() as name:
        path = Path(name, "x.npz")
        path.write_bytes(in_folder(write)["x.npz"])
        with np.load(path) as arrays:
            return dict(arrays)


def kept_values() -> st.SearchStrategy[bytes]:
    tree = json.loads(kept()["tree"].tobytes())
    trees = damage.json_texts(tree).map(lambda data: packed({**kept(), "tree": np.frombuffer(data, np.uint8)}, False))
    return archives(kept()) | trees


OTHER_GROUPS: dict[str, Group] = {
    "control points": Group("control", lambda: one_of(c__csv=damage.tokens(CONTROL)), 250),
    "Metashape": Group(
        "metashape", lambda: st.one_of(*(one_of(m__xml=damage.tokens(data)) for data in metashape().values())), 500
    ),
    "OPF": Group("opf", opf_projects, 700),
    "HEIC and RAW": Group("photo", heic_and_raw, 500),
    "databases": Group("database", databases, 700, lambda: database()[0]),
    "trials": Group(
        "trials",
        lambda: one_of(
            trials__jsonl=damage.tokens(lines(TRIALS)) | damage.trees(TRIALS).map(lines),
            settings__json=damage.json_texts(SETTINGS),
        ),
        200,
    ),
    "scenes": Group("scene", lambda: one_of(s__npz=archives(scene()), s__npy=st.just(npy(np.eye(3)))), 200),
    "kept values": Group("kept", lambda: one_of(x__npz=kept_values()), 250),
}


@cache
def other_wholes() -> dict[str, list[Files]]:
    """As `groups.wholes`."""
    return {
        "control points": [{"c.csv": CONTROL}],
        "Metashape": [{name: data} for name, data in metashape().items()],
        "OPF": [opf()],
        "HEIC and RAW": [{name: data} for name, data in raw_photos().items()],
        "databases": [{"d.db": database()[1]}],
        "trials": [{"trials.jsonl": lines(TRIALS)}, {"settings.json": dumped(SETTINGS)}],
        "scenes": [{"s.npz": packed(scene())}],
        "kept values": [{"x.npz": packed(kept(), False)}],
    }
