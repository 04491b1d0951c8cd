"""Motions of photos that match nothing as they were taken: many are tried, by what each leaves to be seen of a scene.

A strong shutter stretches and shears what it reads, beyond what any descriptor bears. As viewpoints are simulated for
photos taken from other sides (Morel and Yu, ASIFT, SIAM J. Imaging Sciences 2009), so are motions here.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..batch.progress import StageLog
from ..batch.workers import Workers
from ..errors import FileError
from ..io import read_mask, read_photo
from ..model import Camera, Reconstruction, RowMotion
from ..model.array_types import Array, Index
from ..sfm import MatchedPhotos, detect_features, reduce_photo
from ..sfm.descriptor_matches import DescriptorIndex, match_descriptors
from ..sfm.registration import place_photo, points_of_keypoints
from .load import LoadedPhotos, reading_bytes
from .without_motion import photo_without_motion

__all__ = ["search_motions", "tried_motions"]

# Steps of the logarithm of a stretch along the readout, and of a shear, of what is seen: half of a step costs a photo
# of dslr less than half of its matches. Rows never run on backwards, nor much faster than twice as fast.
_STEP, _STRETCHES, _LARGEST_SHEAR = 0.5, np.exp(0.5 * np.arange(-4, 2)), 1.0
# Motions of so many prior standard deviations, of those found, are taken into account.
_LIKELY = 4.0
# Size of what features are detected in, of so many at most.
_MEGAPIXELS, _MAX_FEATURES = 0.3, 8192
# Registered photos that are asked, those next to a photo in the order of names.
_ASKED = 32
# Photos that are searched before it is decided whether it is worth going on.
_PHOTOS_AT_ONCE = 16
# Measurements that fit, from which on a motion is worth features of its own, which decide: wrong ones have 4 to 6.
_LEAST = 8


@dataclass(frozen=True)
class _Shown:
    """Points of a scene by how photos describe them: of each photo its descriptors, and their points."""

    points_w: Array
    of_photos: Sequence[tuple[DescriptorIndex, Index]]

    def matches(self, descriptors: NDArray[np.uint8]) -> tuple[Index, Index]:
        """Descriptors and the points that they match, each pair once."""
        mine, pairs = DescriptorIndex.of(descriptors), [np.zeros((0, 2), np.int64)]
        for index, points in self.of_photos:
            one, other = match_descriptors(mine, index).T
            pairs.append(np.column_stack([one.astype(np.int64), points[other]]))
        descriptor, point = np.unique(np.concatenate(pairs), axis=0).T
        return descriptor, point


@dataclass(frozen=True)
class _Trial:
    """Motions of one stretch that are tried on a photo."""

    name: str
    source: Path
    own_mask: Path | None
    max_megapixels: float
    megapixels: float
    camera: Camera
    phi: Array
    shown: _Shown


@dataclass(frozen=True)
class _Best:
    """The motion by which most measurements fit, and how many; or the problem with the photo."""

    phi: Array = field(default_factory=lambda: np.zeros(3))
    num_fitting: int = 0
    problem: str = ""


def tried_motions(camera: Camera, fastest: float = np.inf) -> list[Array]:
    """Rotations phi, radians per unit of the clock, that stretch and shear what a camera reads: (k, 3) by stretch.

    Those that stand for none of up to `fastest`, half of a step away at most, are left out.

    A point x at the clock r appears at x - r phi x e_z without rotation, so that phi across the readout stretches along
    it, and phi along the readout shears. A rotation about the optical axis does both in opposite ways on both sides of
    the frame: one of them is like another of these.
    """
    along, across = camera.clock_axis, 1 - camera.clock_axis
    sign = camera.clock_sign * (1.0 if along else -1.0)
    tried = []
    for stretch in _STRETCHES:
        step = _STEP * stretch
        shear = step * np.arange(-int(_LARGEST_SHEAR / step), int(_LARGEST_SHEAR / step) + 1)
        phi = np.zeros((len(shear), 3))
        phi[:, across], phi[:, along] = sign * (stretch - 1.0), shear
        nearest = min(1.0, stretch * np.exp(0.5 * _STEP)) if stretch < 1.0 else max(1.0, stretch * np.exp(-0.5 * _STEP))
        slowest = np.hypot(nearest - 1.0, np.maximum(np.abs(shear) - 0.5 * step, 0.0))
        tried.append(phi[slowest <= fastest])
    return tried


def search_motions(
    photos: LoadedPhotos,
    matched: MatchedPhotos,
    scene: Reconstruction,
    megapixels: float,
    workers: Workers,
    log: StageLog,
    *,
    phi_sigma: float = np.inf,
    passed_over: Collection[str] = (),
) -> dict[str, Array]:
    """Rough rotations phi (3,) of photos that a scene lacks, of those that show points of it without their rotation.

    Many photos that are lacking may show another scene: if of some none is found, the search ends. Where no rotation
    that is likely would hide what a photo shows, there is nothing to search.

    Parameters
    ----------
    matched : MatchedPhotos
        Photos and their features.
    scene : Reconstruction
        Poses, motions, points; its measurements are keypoints of `matched`.
    megapixels : float
        Largest size of photos in which features are detected.
    phi_sigma : float
        Prior standard deviation of each component, radians per frame.
    passed_over : collection of str
        Photos that are not searched.
    """
    hiding = [_hiding(camera, phi_sigma) for camera in scene.cameras]
    asked = [
        k for k, name in enumerate(photos.names)
        if name not in scene.image_names and name not in passed_over and hiding[matched.camera_idx[k]]
    ]  # fmt: skip
    if not asked:
        return {}
    shown, motions, stage = _shown_by_photos(matched, scene), dict[str, Array](), "search for motions"
    trials = []
    for k in asked:
        name, camera = photos.names[k], scene.cameras[matched.camera_idx[k]]
        near = sorted(shown, key=lambda other: (abs(other - k), other))[:_ASKED]
        of_photo = _Shown(scene.points_w, [shown[other] for other in near])
        where = photos.folder / name, photos.mask_of.get(name), photos.max_megapixels
        trials += [
            _Trial(name, *where, min(_MEGAPIXELS / stretch, megapixels), camera, phi, of_photo)
            for stretch, phi in zip(_STRETCHES, hiding[matched.camera_idx[k]], strict=True)
        ]
    if not workers.scheduler:
        sizes = (reading_bytes(each.camera.width, each.camera.height, each.megapixels) for each in trials)
        workers = workers.fitting("features", max(sizes))
    log.begin(stage, len(trials))
    at_once = _PHOTOS_AT_ONCE * len(_STRETCHES)
    for start in range(0, len(trials), at_once):
        best: dict[str, _Best] = {}
        some = trials[start : start + at_once]
        results = workers.map(_try, some, lambda trial, why: _Best(problem=f"{trial.name}: {why}"))
        with closing(results):
            for done, (trial, found) in enumerate(zip(some, results, strict=True), start + 1):
                if found.problem:
                    raise FileError(found.problem)
                if found.num_fitting > best.get(trial.name, _Best()).num_fitting:
                    best[trial.name] = found
                log.tell(stage, done, len(trials))
        motions |= {name: each.phi for name, each in best.items() if each.num_fitting >= _LEAST}
        if motions.keys().isdisjoint(best):  # the others show another scene, rather
            break
    log.end(stage, photos=len(asked), found=sorted(motions))
    return motions


def _hiding(camera: Camera, phi_sigma: float) -> list[Array]:
    """Likely motions that are tried on photos of a camera; none if these are no others than a photo without motion."""
    if camera.lens == "fisheye":
        return []
    tried = tried_motions(camera, _LIKELY * phi_sigma / camera.frame_span)
    return tried if any(phi.any() for phi in tried) else []


def _shown_by_photos(matched: MatchedPhotos, scene: Reconstruction) -> dict[int, tuple[DescriptorIndex, Index]]:
    """By photo its usual descriptors of points of a scene, and these points."""
    found = {}
    for k, point in points_of_keypoints(matched, scene).items():
        usual = matched.features[k].of_kind(0)
        usual = usual[point[usual] >= 0]
        found[k] = DescriptorIndex.of(matched.features[k].descriptors[usual]), point[usual]
    return found


def _try(trial: _Trial) -> _Best:
    try:
        photo = read_photo(trial.source, trial.max_megapixels)
    except FileError as error:
        return _Best(problem=str(error))
    height, width = photo.pixels.shape[:2]
    mask = None if trial.own_mask is None else read_mask(trial.own_mask, width, height)
    reduced = reduce_photo(photo.pixels, mask, trial.megapixels)
    camera = _resized(trial.camera, reduced.gray)
    best = _Best()
    for phi in trial.phi:
        found = _placed_without(phi, reduced.gray, reduced.mask, camera, trial.shown)
        if found is not None and found.num_fitting > best.num_fitting:
            best = found
    return best


def _placed_without(
    phi: Array, gray: NDArray[np.uint8], mask: NDArray[np.uint8] | None, camera: Camera, shown: _Shown
) -> _Best | None:
    """The motion of a photo whose features are detected without a rotation that it may have, and what fits that."""
    megapixels = 1e-6 * gray.size
    pixels, seen, frame = photo_without_motion(gray, mask, camera, RowMotion(phi), megapixels)
    features = frame.in_photo(detect_features(pixels, _MAX_FEATURES, seen, megapixels * frame.area_ratio))
    keypoint, point = shown.matches(features.descriptors)
    placed = place_photo(shown.points_w[point], features.xy_raw[keypoint], camera, features.step_px, phi)
    return None if placed is None else _Best(placed.phi, len(np.unique(keypoint[placed.fits])))


def _resized(camera: Camera, image: NDArray[Any]) -> Camera:
    """The camera of a photo that was resized."""
    height, width = image.shape[:2]
    scale, K = np.array([width / camera.width, height / camera.height]), np.array(camera.K)
    K[:2] *= scale[:, None]
    K[:2, 2] += 0.5 * scale - 0.5
    return Camera(width, height, K, camera.dist, camera.readout, camera.lens, camera.field)
