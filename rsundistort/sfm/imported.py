"""The matches of a COLMAP database of another program."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..colmap.conventions import HALF, quiet_pycolmap
from ..errors import FileError, InputError
from ..model import Reconstruction
from .database import MatchedPhotos, write_photos
from .features import Features, size_sigma

__all__ = ["matched_of_database"]

# pair_id = id1 * this + id2
_MAX_IMAGES = 2147483647
_TABLES = {
    "images": ("image_id", "name"),
    "keypoints": ("image_id", "rows", "cols", "data"),
    "matches": ("pair_id", "rows", "cols", "data"),
    "two_view_geometries": ("pair_id", "rows", "cols", "data"),
}
_SMALLEST_LIMIT = 1 << 20
# Photos have sides up to a million pixels.
_FARTHEST_PX = 1e6
_WIDTHS = {"keypoints": (2, 4, 6), "matches": (2,), "two_view_geometries": (2,)}


def matched_of_database(source: Path, database: Path, reconstruction: Reconstruction, seed: int = 0) -> MatchedPhotos:
    """The photos of a reconstruction with all their keypoints and matches, from the database behind it.

    Parameters
    ----------
    source : Path
        COLMAP's database; it is only read.
    database : Path
        File to make.
    reconstruction : Reconstruction
        Whose photos and cameras count; its measurements are keypoints of the database.

    Raises
    ------
    FileError
        There is no such database.
    InputError
        It does not hold the photos, or holds other keypoints.
    """
    rec = reconstruction
    with _opened(source, database.parent) as db:
        _check_tables(db)
        ids = dict(db.execute("SELECT name, image_id FROM images"))
        lost = [name for name in rec.image_names if name not in ids]
        if lost:
            raise InputError(f"{source} lacks {len(lost)} photos of the model, such as {lost[0]}; give the model's own")
        features = [_features(_array(db, "keypoints", ids[name]), name) for name in rec.image_names]
        _check_keypoints(source, rec, features)
        matched = MatchedPhotos(
            database, tuple(rec.image_names), tuple(features), tuple(rec.cameras), rec.camera_idx, True, seed
        )
        with quiet_pycolmap().Database.open(database) as ours:
            write_photos(ours, matched)
            counts = {ids[name]: (k + 1, len(features[k].xy_raw)) for k, name in enumerate(rec.image_names)}
            if not _copy_matches(db, ours, counts):
                raise InputError(f"{source} holds no matches between the photos of the model; give the model's own")
    return matched


@contextmanager
def _opened(source: Path, work: Path) -> Iterator[sqlite3.Connection]:
    """COLMAP's tables, to be read: pycolmap would make a database that is missing, and change one that is old."""
    if not source.is_file():
        raise FileError(f"{source} is missing; give the database that the model was made from")
    # what COLMAP has not merged yet lies beside it, and SQLite would write there to read both: so from a copy
    pending = source.with_name(f"{source.name}-wal")
    try:
        if pending.is_file() and pending.stat().st_size:
            copy = work / "given.db"
            shutil.copyfile(source, copy)
            shutil.copyfile(pending, copy.with_name(f"{copy.name}-wal"))
            uri = copy.resolve().as_uri()
        else:
            uri = f"{source.resolve().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as db:
            if hasattr(db, "setlimit"):  # Python 3.11: no value is larger than its file
                db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(source.stat().st_size, _SMALLEST_LIMIT))
            yield db
    except sqlite3.Error as error:
        raise FileError(f"{source} is no COLMAP database: {error}") from error
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"{source} cannot be copied to {work}: {error.strerror}") from error


def _check_tables(db: sqlite3.Connection) -> None:
    """Refuse tables that are computed as they are read: views, virtual ones, generated columns."""
    for table, needed in _TABLES.items():
        row = db.execute("SELECT type, rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
        if row is None or row[0] != "table" or not row[1]:
            raise sqlite3.DatabaseError(f"it has no table {table}")
        stored = {name for _, name, *_, hidden in db.execute(f"PRAGMA table_xinfo({table})") if not hidden}
        if lost := [name for name in needed if name not in stored]:
            raise sqlite3.DatabaseError(f"its table {table} has no column {lost[0]}")


def _array(db: sqlite3.Connection, table: str, value: int) -> NDArray[Any]:
    """The matrix of a row of a table; (0, 2) if there is none."""
    dtype, key = (np.float32, "image_id") if table == "keypoints" else (np.uint32, "pair_id")
    # lengths before the data: a row may claim a gigabyte
    what = f"FROM {table} WHERE {key} = ?"
    row = db.execute(f"SELECT rows, cols, typeof(data), length(data) {what}", (value,)).fetchone()
    if row is None or row[0] == 0 or row[2] == "null":
        return np.zeros((0, 2), dtype)
    rows, cols, kind, size = row
    if kind != "blob" or not isinstance(rows, int) or cols not in _WIDTHS[table] or size != rows * cols * 4:
        raise sqlite3.DatabaseError(f"{table} of {value} are cut short, or of another shape than COLMAP's")
    (data,) = db.execute(f"SELECT data {what}", (value,)).fetchone()
    return np.frombuffer(data, dtype).reshape(rows, cols)


def _features(keypoints: NDArray[np.float32], name: str) -> Features:
    """Keypoints x, y[, scale, angle | affine shape] as COLMAP stores them."""
    table = np.asarray(keypoints, np.float64)
    if not (np.abs(table) <= _FARTHEST_PX).all():
        raise sqlite3.DatabaseError(f"keypoints of {name} are no numbers, or in no photo")
    sigma = np.ones(len(table))
    if table.shape[1] == 4:
        sigma = size_sigma(2.0 * table[:, 2])  # a radius; OpenCV gives diameters
    elif table.shape[1] == 6:
        sigma = size_sigma(2.0 * np.sqrt(np.abs(table[:, 2] * table[:, 5] - table[:, 3] * table[:, 4])))
    return Features(table[:, :2] - HALF, sigma, np.zeros((0, 128), np.uint8))


def _check_keypoints(source: Path, rec: Reconstruction, features: Sequence[Features]) -> None:
    """Refuse a database of other keypoints than the model's."""
    obs = rec.observations
    for name, found, mine in zip(rec.image_names, features, obs.by_photo(rec.num_images), strict=True):
        known = {tuple(xy) for xy in found.xy_raw.tolist()}
        if not all(tuple(xy) in known for xy in obs.xy_raw[mine].tolist()):
            raise InputError(f"{source} holds other keypoints of {name} than the model; give the model's own")


def _copy_matches(db: sqlite3.Connection, ours: Any, photos: dict[int, tuple[int, int]]) -> int:
    """Copy the matches between photos by their new ids; of pairs without, those that were verified. How many pairs.

    `photos` gives the new id and the number of keypoints by the old id.
    """
    copied = set()
    for table in ("matches", "two_view_geometries"):
        pairs = db.execute(
            f"SELECT pair_id FROM {table} WHERE rows > 0 AND typeof(pair_id) = 'integer' ORDER BY pair_id"
        )
        for (pair,) in pairs.fetchall():
            first, second = (photos.get(k) for k in divmod(pair, _MAX_IMAGES))
            if first is None or second is None or first == second or (first[0], second[0]) in copied:
                continue
            matches = _array(db, table, pair)
            if len(matches) and not (matches < [first[1], second[1]]).all():
                raise sqlite3.DatabaseError(f"{table} of {pair} are of keypoints that it does not hold")
            ours.write_matches(first[0], second[0], matches)
            copied.add((first[0], second[0]))
    return len(copied)
