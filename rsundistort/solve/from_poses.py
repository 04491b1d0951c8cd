"""A model that holds poses and cameras only: its photos are measured, and triangulated from these poses."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..batch.progress import StageLog
from ..batch.rectify_options import RectifyOptions
from ..batch.workers import Workers
from ..colmap.measured_model import ColmapModel
from ..errors import InputError, ReconstructionError, RsUndistortWarning
from ..input.load import load_photos
from ..input.pairing import pairs_to_match
from ..io import list_photos
from ..io.cameras import camera_to_json
from ..io.metashape import PosedPhotos, named, read_metashape
from ..model import Observations, Reconstruction
from ..sfm import LEAST_MEASUREMENTS, match_photos, retriangulate
from .run_options import RunOptions
from .tracks import TrackSource

__all__ = ["measured", "posed_photos", "shutter_terms"]


def posed_photos(model: Path, folder: Path | None, raw_as: str) -> PosedPhotos:
    """Poses of Metashape's `cameras.xml`, of the photos of a folder.

    Raises
    ------
    InputError
        There is no folder: the file holds no measurements, and they are made in the photos.
    """
    if folder is None:
        raise InputError(
            f"{model} holds poses and cameras, but no measurements; say where the photos are (--images), which are "
            "measured anew, or export a COLMAP model, whose tracks are taken"
        )
    posed = named(read_metashape(model), list_photos(folder, raw_as), str(folder))
    if posed.shutter:
        warnings.warn(
            f"{model}: rolling_shutter of {len(posed.shutter)} photos, such as {posed.labels[min(posed.shutter)]}, is "
            "kept in the solution, but not used as motion, since Agisoft does not publish what it counts from; "
            "motions are solved for", RsUndistortWarning, stacklevel=5,
        )  # fmt: skip
    return posed


def shutter_terms(posed: PosedPhotos) -> dict[str, Any]:
    """Metashape's `rolling_shutter` by photo, as the solution keeps it."""
    return {
        posed.labels[key]: {"rotation": terms.rotation.tolist(), "translation": terms.translation.tolist()}
        for key, terms in posed.shutter.items()
    }


def measured(
    posed: PosedPhotos, folder: Path, rectify: RectifyOptions, seed: int, workers: Workers, work: Path, log: StageLog
) -> tuple[ColmapModel, TrackSource]:
    """A model with tracks of the photos' features that fit the poses, and what new tracks can be made from.

    Raises
    ------
    ReconstructionError
        The poses explain next to none of the matches.
    """
    names = list(posed.labels)
    cameras = {str(k): camera_to_json(camera) for k, camera in zip(posed.camera_ids, posed.cameras, strict=True)}
    of_photo = {name: str(posed.camera_ids[k]) for name, k in zip(names, posed.camera_idx.tolist(), strict=True)}
    (work / "cameras.json").write_text(json.dumps({"cameras": cameras, "images": of_photo}), encoding="utf-8")
    loaded = load_photos(
        folder, str(work / "cameras.json"), None, RunOptions().most_features(False), workers, log, masks=rectify.masks,
        raw_as=rectify.raw_as, again=rectify.again, max_megapixels=rectify.max_megapixels, only=names,
    )  # fmt: skip
    place = [names.index(name) for name in loaded.names]
    log.begin("matching")
    matched = match_photos(
        work / "database.db", loaded.names, loaded.features, posed.cameras, posed.camera_idx[place],
        seed=seed, pairs=pairs_to_match(loaded, "auto", seed),
    )  # fmt: skip
    log.end("matching")
    empty = Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
    given = Reconstruction(
        posed.cameras, loaded.names, matched.camera_idx, posed.R_cw[place], posed.center_w[place], np.zeros((0, 3)),
        empty,
    )  # fmt: skip
    try:
        rec = retriangulate(matched, given)
        count = len(rec.observations)
    except ReconstructionError:  # not one point
        count = 0
    if count < LEAST_MEASUREMENTS * len(names):
        raise ReconstructionError(
            f"the poses explain {count} measurements in {len(names)} photos, too few to continue; check that they "
            "are of these photos, or let run find poses of its own"
        )
    model = ColmapModel(
        rec, np.array(posed.camera_ids), np.arange(1, 1 + rec.num_images), np.arange(1, 1 + rec.num_points),
        np.arange(len(rec.observations)), np.zeros((rec.num_points, 3), np.uint8), posed.unposed,
        self_calibrated=True, has_colors=False,
    )  # fmt: skip
    return model, TrackSource(matched, loaded, workers)
