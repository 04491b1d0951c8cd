"""The matches of somebody else's COLMAP database."""

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
    seed : int
        Seed of every random choice.

    Raises
    ------
    FileError
        When there is no such database.
    InputError
        When it does not hold the photos, or holds other keypoints.
    """
    rec = reconstruction
    with _opened(source, database.parent) as db:
        ids = dict(db.execute("SELECT name, image_id FROM images"))
        lost = [name for name in rec.image_names if name not in ids]
        if lost:
            raise InputError(f"{source} lacks {len(lost)} photos of the model, such as {lost[0]}; give the model's own")
        features = [_features(_array(db, "keypoints", "image_id", ids[name], np.float32)) for name in rec.image_names]
        _check_keypoints(source, rec, features)
        matched = MatchedPhotos(
            database, tuple(rec.image_names), tuple(features), tuple(rec.cameras), rec.camera_idx, True, seed
        )
        with quiet_pycolmap().Database.open(database) as ours:
            write_photos(ours, matched)
            if not _copy_matches(db, ours, {ids[name]: k + 1 for k, name in enumerate(rec.image_names)}):
                raise InputError(f"{source} holds no matches between the photos of the model; give the model's own")
    return matched


@contextmanager
def _opened(source: Path, work: Path) -> Iterator[sqlite3.Connection]:
    """COLMAP's tables, to be read: pycolmap would make a database that is missing, and change one that is old."""
    if not source.is_file():
        raise FileError(f"{source} is missing; give the database that the model was made from")
    # what COLMAP has not put into it yet is beside it, and to read both SQLite would write there: so from a copy
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
            yield db
    except sqlite3.Error as error:
        raise FileError(f"{source} is no COLMAP database: {error}") from error
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"{source} cannot be copied to {work}: {error.strerror}") from error


def _array(db: sqlite3.Connection, table: str, key: str, value: int, dtype: type) -> NDArray[Any]:
    """The matrix of a row of a table; (0, 2) if there is none."""
    row = db.execute(f"SELECT rows, cols, data FROM {table} WHERE {key} = ?", (value,)).fetchone()
    if row is None or not row[0] or row[2] is None:
        return np.zeros((0, 2), dtype)
    if len(row[2]) != row[0] * row[1] * np.dtype(dtype).itemsize:
        raise sqlite3.DatabaseError(f"{table} of {value} are cut short")
    return np.frombuffer(row[2], dtype).reshape(row[0], row[1])


def _features(keypoints: NDArray[np.float32]) -> Features:
    """Keypoints x, y[, scale, angle | affine shape] as COLMAP stores them."""
    table = np.asarray(keypoints, np.float64).reshape(len(keypoints), -1)
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


def _copy_matches(db: sqlite3.Connection, ours: Any, new_id: dict[int, int]) -> int:
    """Copy the matches between photos by their new ids; of pairs without, those that were verified. How many pairs."""
    copied = set()
    for table in ("matches", "two_view_geometries"):
        for (pair,) in db.execute(f"SELECT pair_id FROM {table} WHERE rows > 0 ORDER BY pair_id").fetchall():
            first, second = (new_id.get(k) for k in divmod(pair, _MAX_IMAGES))
            if first is not None and second is not None and (first, second) not in copied:
                ours.write_matches(first, second, _array(db, table, "pair_id", pair, np.uint32))
                copied.add((first, second))
    return len(copied)
