"""Focal lengths of cameras without one in a file or EXIF: from the photos."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..batch.progress import StageLog
from ..errors import RsUndistortWarning
from ..io.kept import Kept
from ..io.outputs import work_folder
from ..model import Camera
from ..sfm import choose_pairs, global_descriptors
from ..sfm.epipolar import read_verified
from ..sfm.focal_length import FocalLength, estimate_focal_length
from ..sfm.matching import match_photos
from .load import LoadedPhotos
from .pairing import capture_sequences, places_of
from .photo_cameras import PhotoCameras

__all__ = ["warn_of_weak_focal_lengths", "with_focal_lengths"]

# Number of features of a photo, the largest, and of pairs of each camera that are used.
_FEATURES, _PAIRS = 4096, 30
# Matches of a pair that overlaps.
_LEAST_MATCHES = 60
# Threshold of fundamental matrices, in pixels of the image that the features were detected in: a shutter bends by some.
_WITHIN_PX = 4.0
# Relative standard deviation of a focal length that the solution should have found better.
_WEAK = 0.05


def with_focal_lengths(photos: LoadedPhotos, seed: int, log: StageLog, kept: Kept | None = None) -> LoadedPhotos:
    """The photos with focal lengths from their matches, where no other source gives them, and a note on that."""
    cameras, kept = photos.cameras, kept or Kept()
    if not cameras.without_focal:
        return photos
    log.begin("focal length")
    before: dict[str, FocalLength] = kept.get("focal lengths") or {}
    found = {k: before.get(str(k)) or _focal_length(photos, k, seed) for k in cameras.without_focal}
    kept.put("focal lengths", {str(k): each for k, each in found.items()})
    log.end(
        "focal length", pixels=[each.pixels for each in found.values()], sigma=[each.sigma for each in found.values()]
    )
    new, sigma, said = list(cameras.cameras), [dict(each) for each in cameras.sigma], []
    for k, focal in found.items():
        K = new[k].K.copy()
        K[0, 0] = K[1, 1] = focal.pixels
        new[k] = replace(new[k], K=K)
        sigma[k]["f"] = focal.sigma
        by = f"by {focal.num_pairs} pairs of them" if focal.num_pairs else "as is usual"
        value = f"{focal.pixels:.0f} px (+-{100 * focal.sigma:.0f} %) {by}"
        said.append(f"no focal length in the photos of {cameras.labels[k]}: {value}; give --camera if you know it")
    source = "found from the photos, refined" if len(found) == len(new) else cameras.source
    known = replace(cameras, cameras=tuple(new), sigma=sigma, source=source, notes=[*cameras.notes, *said])
    return replace(photos, cameras=known)


def warn_of_weak_focal_lengths(
    cameras: PhotoCameras, solved: Sequence[Camera], sigmas: Sequence[Mapping[str, float]], used: Collection[int]
) -> None:
    """Warn of cameras without a focal length whose photos, all together, hardly determine it.

    Parameters
    ----------
    cameras : PhotoCameras
        With focal lengths from pairs, and their relative standard deviations.
    solved, sigmas
        The same cameras, in this order, as solved; and standard deviations of their intrinsics in pixels, empty where
        these were not refined.
    used : collection of int
        Those of registered photos.
    """
    for k in cameras.without_focal:
        focal, refined = float(solved[k].K[0, 0]), sigmas[k] if k < len(sigmas) else {}
        sigma = next((refined[name] for name in ("f", "fx") if name in refined), focal * cameras.sigma[k].get("f", 0.0))
        if k in used and k < len(sigmas) and sigma > _WEAK * focal:
            said = f"{focal:.0f} +- {sigma:.0f} px; give --camera if you know it"
            warnings.warn(f"the photos hardly determine their focal length: {said}", RsUndistortWarning, stacklevel=3)


def _focal_length(photos: LoadedPhotos, camera: int, seed: int) -> FocalLength:
    """The focal length of a camera from its photos."""
    cameras = photos.cameras
    mine = np.flatnonzero(cameras.camera_idx == camera)
    features = [photos.features[i].largest(_FEATURES) for i in mine.tolist()]
    names, facts = [photos.names[i] for i in mine.tolist()], [photos.facts[i] for i in mine.tolist()]
    of_one = np.zeros(len(mine), np.int64)
    pairs = choose_pairs(
        len(mine), capture_sequences(names, of_one, facts), places_of(facts),
        global_descriptors([each.descriptors for each in features], seed),
    )  # fmt: skip
    step_px = float(np.median([each.step_px for each in features]))
    if not len(pairs):
        return estimate_focal_length([], cameras.cameras[camera])
    few = pairs[np.unique(np.linspace(0, len(pairs) - 1, _PAIRS).astype(np.int64))]
    with work_folder() as work:
        matched = match_photos(
            work / "database.db", names, features, [cameras.cameras[camera]], of_one,
            calibrated=False, focal_known=False, within_px=_WITHIN_PX * step_px, seed=seed, pairs=few,
        )  # fmt: skip
        verified = read_verified(matched)
    xy = [each.xy_raw for each in features]
    shown = [
        (xy[i][matches[:, 0]], xy[j][matches[:, 1]])
        for (i, j), matches in verified.items()
        if len(matches) >= _LEAST_MATCHES
    ]
    return estimate_focal_length(shown, cameras.cameras[camera], step_px, seed)
