"""Mapping by pycolmap, with room for shutter distortion: all photos at once, or one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np

from ..colmap.conventions import quiet_pycolmap
from ..colmap.lenses import refined_camera
from ..errors import ReconstructionError
from ..model import Reconstruction
from .connected import LEAST_MEASUREMENTS
from .database import LOOSE, MatchedPhotos, from_pycolmap, pipeline_options, write_photos
from .epipolar import Matches, matches_that_fit

__all__ = ["PLACING_KEYPOINTS", "map_photos"]

# Mapping only has to place the photos; the tracks are rebuilt afterwards. All at once this many of the largest
# keypoints of each do, or more, or all (seconds of processor time with 2048 / all: herz-jesus-8 2.1 / 4.6, a phone's 16
# photos 2.0 / 4.4). More are tried while photos are left out, and all only if twice as many place more of them.
# It takes others than incremental mapping does where photos hang together weakly: 13 instead of 8 of a drone's 14, 29
# instead of 27 in lund; so the other way is tried only where it leaves out more than a quarter.
PLACING_KEYPOINTS: tuple[int | None, ...] = (2048, 4096, None)
_ENOUGH_REGISTERED = 0.75

# Mapping one after the other only has to place the photos: it gets this many of the largest keypoints of each. All of
# them come back when the tracks are rebuilt. (herz-jesus-8: 16384 keypoints map in 4.7 s, 4096
# of them in 1.1 s, poses alike.)
_MAPPING_KEYPOINTS = 4096

# Beyond this many photos all are adjusted together whenever there are 1.4 times as many, not 1.1 times as pycolmap has
# it, and less far: the longer a street, the slower that converges, and our own adjustment follows. (250 photos of
# benchmarks/large_sets.py: 38 s of processor time instead of 96, and smaller errors; lund: 29 photos instead of 27.)
_LARGE = 60


def _mapping_database(matched: MatchedPhotos, folder: Path, limit: int | None, rough: Reconstruction | None) -> Path:
    """A database of the largest keypoints (all: None) and the verified matches among them, or those that fit poses."""
    pycolmap = quiet_pycolmap()
    path = folder / "mapping.db"
    fitting = Matches() if rough is None else matches_that_fit(matched, rough)
    with pycolmap.Database.open(matched.database) as db, pycolmap.Database.open(path) as small:
        write_photos(small, matched, limit)
        for pair_id in sorted(db.read_two_view_geometry_num_inliers()[0]):
            i, j = pycolmap.pair_id_to_image_pair(pair_id)
            pair = db.read_two_view_geometry(i, j)
            if (i - 1, j - 1) in fitting:
                pair = pycolmap.TwoViewGeometry()
                pair.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                pair.inlier_matches = fitting[i - 1, j - 1].astype(np.uint32)
            matches = np.asarray(pair.inlier_matches)
            if limit is not None and len(matches):
                pair.inlier_matches = matches[(matches < limit).all(1)]
            small.write_two_view_geometry(i, j, pair)
    return path


def map_photos(
    matched: MatchedPhotos,
    progress: Callable[[int], None] | None = None,
    keypoints: Sequence[int | None] = PLACING_KEYPOINTS,
    shown: MatchedPhotos | None = None,
    rough: Reconstruction | None = None,
) -> Reconstruction:
    """Global-shutter reconstruction with room for shutter distortion.

    All photos are placed at once (pycolmap's global mapper). Where that leaves some out, they are also placed one after
    the other with loosened thresholds, and the attempt that registers more counts. A camera that is a guess is refined.

    Parameters
    ----------
    progress : callable, optional
        Called with the number of photos registered so far.
    keypoints : sequence of int or None
        How many of the largest keypoints of each place it, in attempts one after the other; None for all.
    shown : MatchedPhotos, optional
        The photos as they are, where the keypoints of `matched` are not: their pixels are the measurements.
    rough : Reconstruction, optional
        Poses that place the photos roughly: of pairs of its photos the matches count that fit these, where there are
        any, instead of those that an epipolar geometry with room for a shutter fits.

    Raises
    ------
    ReconstructionError
        When no two photos could be registered.
    """
    total = len(matched.names)
    enough = _ENOUGH_REGISTERED * total
    found, count = None, 0
    for limit in keypoints:
        found = _with_more(found, _mapped_at_once(matched, limit, shown, rough))
        before, count = count, 0 if found is None else found.num_images
        if count == total or enough <= count == before:
            break
    if found is None or count < enough:
        found = _with_more(found, _mapped_one_by_one(matched, progress, shown, rough))
    if found is None or found.num_images < 2:
        raise ReconstructionError(
            f"none of the {len(matched.names)} photos overlap enough to be registered; "
            "use photos that share more of the scene, or check the camera's focal length"
        )
    return found


def _with_more(best: Reconstruction | None, other: Reconstruction | None) -> Reconstruction | None:
    """The one of more photos; of equals the first."""
    if best is None or other is None:
        return best or other
    return other if other.num_images > best.num_images else best


def _mapped_at_once(
    matched: MatchedPhotos, limit: int | None, shown: MatchedPhotos | None, rough: Reconstruction | None
) -> Reconstruction | None:
    """What the global mapper registers by the largest keypoints, without photos that hang on by few measurements."""
    work = Path(mkdtemp(prefix="mapping-", dir=matched.database.parent))
    options = _global_options(matched)
    models = quiet_pycolmap().global_mapping(_mapping_database(matched, work, limit, rough), work, work, options)
    return _firmly_connected(_largest(models.values()), shown or matched)


def _mapped_one_by_one(
    matched: MatchedPhotos, progress: Callable[[int], None] | None, shown: MatchedPhotos | None,
    rough: Reconstruction | None,
) -> Reconstruction | None:  # fmt: skip
    """What incremental mapping registers.

    With the largest keypoints first, then with all, then with less loose thresholds, until all photos are in one model
    or nothing is gained. A guessed camera is refined first, with tight thresholds: loose ones let the focal length run
    away; and believed if half of the photos say so.
    """
    if not matched.calibrated:
        attempts = [(_MAPPING_KEYPOINTS, 1.0), (None, 1.0), (None, 2.0)]
        refined = _best_model(matched, attempts, progress, rough)
        if refined is not None and 2 * refined.num_reg_images() >= len(matched.names):
            matched = _refined(matched, refined)
        matched = replace(matched, calibrated=True)
    attempts = [(_MAPPING_KEYPOINTS, LOOSE), (None, LOOSE), (None, 2.0), (None, 1.0)]
    return _firmly_connected(_best_model(matched, attempts, progress, rough), shown or matched)


def _firmly_connected(model: Any, matched: MatchedPhotos) -> Reconstruction | None:
    """Our reconstruction of a pycolmap model, or of none; photos that hang on by few measurements are left out."""
    if model is None or not model.num_points3D():
        return None
    if not matched.calibrated:
        matched = _refined(matched, model)
    return from_pycolmap(model, matched, None).without_photos(LEAST_MEASUREMENTS)


def _refined(matched: MatchedPhotos, model: Any) -> MatchedPhotos:
    """The photos with the cameras that mapping refined; one that took none of the registered photos stays a guess."""
    cameras = [
        refined_camera(model.cameras[k + 1], camera) if k + 1 in model.cameras else camera
        for k, camera in enumerate(matched.cameras)
    ]
    return replace(matched, cameras=tuple(cameras), calibrated=True)


def _largest(models: Iterable[Any]) -> Any:
    """The model with the most photos, of equals with the most points; None of none."""
    return max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _best_model(
    matched: MatchedPhotos, attempts: Sequence[tuple[int | None, float]], progress: Callable[[int], None] | None,
    rough: Reconstruction | None,
) -> Any:  # fmt: skip
    """The pycolmap model with the most photos over attempts (number of keypoints, looseness), or None.

    They end when all photos are registered, or when one with all keypoints gains nothing.
    """
    pycolmap = quiet_pycolmap()
    total = len(matched.names)
    best, count = None, 0
    for number, (limit, loose) in enumerate(attempts):
        registered = [2]

        def on_next_image(registered: list[int] = registered) -> None:
            registered[0] += 1
            if progress is not None:
                progress(min(registered[0], total))

        work = Path(mkdtemp(prefix="mapping-", dir=matched.database.parent))
        models = pycolmap.incremental_mapping(
            _mapping_database(matched, work, limit, rough),
            work,
            work,
            _mapping_options(loose, matched),
            next_image_callback=on_next_image,
        )
        before, best = count, _largest([*models.values(), *([] if best is None else [best])])
        count = 0 if best is None else best.num_reg_images()
        if count == total or (number > 1 and count and count <= before):
            break
    return best


def _global_options(matched: MatchedPhotos) -> Any:
    """Options of the global mapper; seeds and threads are those of `pipeline_options`."""
    options = quiet_pycolmap().GlobalPipelineOptions()
    mapper = options.mapper
    options.num_threads = mapper.num_threads = 1
    mapper.skip_retriangulation = True
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    for each in (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        each.random_seed = matched.seed
    mapper.bundle_adjustment.refine_focal_length = not matched.calibrated
    mapper.bundle_adjustment.refine_extra_params = not matched.calibrated
    return options


def _mapping_options(loose: float, matched: MatchedPhotos) -> Any:
    options = pipeline_options(loose, matched.seed, not matched.calibrated, len(matched.names))
    if len(matched.names) > _LARGE:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.4
        options.ba_global_function_tolerance = 1e-4
        options.ba_global_max_refinements = 2
    return options
