"""Mapping by pycolmap, with room for shutter distortion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ReconstructionError
from ..model import Camera, Reconstruction
from .database import HALF, LOOSE, MatchedPhotos, from_pycolmap, pipeline_options, quiet_pycolmap, write_photos

__all__ = ["map_photos"]

# Mapping only has to place the photos: it gets this many of the strongest keypoints of each. All of them come back
# when the tracks are rebuilt. (herz-jesus-8: 16384 keypoints map in 4.7 s, 4096 of them in 1.1 s, poses alike.)
_MAPPING_KEYPOINTS = 4096

# Beyond this many photos all are adjusted together whenever there are 1.4 times as many, not 1.1 times as pycolmap has
# it, and less far: the longer a street, the slower that converges, and our own adjustment follows. (250 photos of
# benchmarks/large_sets.py: 38 s of processor time instead of 96, and smaller errors; lund: 29 photos instead of 27.)
_LARGE = 60


def _mapping_database(matched: MatchedPhotos, folder: Path, limit: int | None) -> Path:
    """A database of the strongest keypoints (all: None) and the verified matches among them."""
    pycolmap = quiet_pycolmap()
    path = folder / "mapping.db"
    with pycolmap.Database.open(matched.database) as db, pycolmap.Database.open(path) as small:
        write_photos(small, matched, limit)
        for pair_id in sorted(db.read_two_view_geometry_num_inliers()[0]):
            i, j = pycolmap.pair_id_to_image_pair(pair_id)
            pair = db.read_two_view_geometry(i, j)
            matches = np.asarray(pair.inlier_matches)
            if limit is not None and len(matches):
                pair.inlier_matches = matches[(matches < limit).all(1)]
            small.write_two_view_geometry(i, j, pair)
    return path


def map_photos(matched: MatchedPhotos, progress: Callable[[int], None] | None = None) -> Reconstruction:
    """Global-shutter reconstruction by incremental mapping with loosened thresholds.

    Only photos that registered are in it. Mapping is tried with the strongest keypoints first, then with all, then
    with less loose thresholds, until all photos are in one model; the attempt with the most photos is returned. A
    camera that is only a guess is refined first, with tight thresholds: loose ones let the focal length run away.

    Parameters
    ----------
    matched : MatchedPhotos
        Photos with their matches.
    progress : callable, optional
        Called with the number of photos registered so far.

    Raises
    ------
    ReconstructionError
        When no two photos could be joined.
    """
    best = None
    if not matched.calibrated:
        best = _best_model(matched, [(None, 1.0), (None, 2.0)], progress)
        if best is not None:
            # a camera that took none of the joined photos is not in the model
            cameras = [
                _refined_camera(best.cameras[k + 1], camera) if k + 1 in best.cameras else camera
                for k, camera in enumerate(matched.cameras)
            ]
            matched = replace(matched, cameras=tuple(cameras), calibrated=True)
    attempts = [(_MAPPING_KEYPOINTS, LOOSE), (None, LOOSE), (None, 2.0), (None, 1.0)]
    found = _best_model(matched, attempts, progress)
    if found is None:
        raise ReconstructionError(
            f"none of the {len(matched.names)} photos overlap enough to be joined; "
            "use photos that share more of the scene, or check the camera's focal length"
        )
    return from_pycolmap(found, matched, None)


def _best_model(
    matched: MatchedPhotos,
    attempts: Sequence[tuple[int | None, float]],
    progress: Callable[[int], None] | None,
) -> Any:
    """The pycolmap model with the most photos over attempts (number of keypoints, looseness), or None."""
    pycolmap = quiet_pycolmap()
    total = len(matched.names)
    best, best_count = None, (0, 0)
    for number, (limit, loose) in enumerate(attempts):
        registered = [2]

        def on_next_image(registered: list[int] = registered) -> None:
            registered[0] += 1
            if progress is not None:
                progress(min(registered[0], total))

        work = matched.database.parent / f"mapping-{matched.calibrated}-{number}"
        work.mkdir()
        models = pycolmap.incremental_mapping(
            _mapping_database(matched, work, limit),
            work,
            work,
            _mapping_options(loose, matched),
            next_image_callback=on_next_image,
        )
        for model in models.values():
            count = (model.num_reg_images(), model.num_points3D())
            if count > best_count:
                best, best_count = model, count
        if best_count[0] == total:
            break
    return best


def _mapping_options(loose: float, matched: MatchedPhotos) -> Any:
    options = pipeline_options(loose, matched.seed, not matched.calibrated, len(matched.names))
    if len(matched.names) > _LARGE:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
        options.ba_global_function_tolerance = 1e-4
        options.ba_global_max_refinements = 2
    return options


def _refined_camera(refined: Any, camera: Camera) -> Camera:
    """Our camera of a SIMPLE_RADIAL or SIMPLE_RADIAL_FISHEYE camera that mapping refined."""
    f, cx, cy, k1 = refined.params
    K = [[f, 0, cx - HALF], [0, f, cy - HALF], [0, 0, 1]]
    return replace(camera, K=np.array(K), dist=np.array([k1, 0, 0, 0]))
