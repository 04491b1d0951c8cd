"""Photos with their features and their cameras, from a folder."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..batch.one_photo import check_not_rectified
from ..batch.progress import StageLog
from ..batch.workers import Workers
from ..errors import FileError, InputError, SkippedPhotoWarning
from ..io import MAX_MEGAPIXELS, ExifFacts, facts_of_exif, find_masks, list_photos, read_mask, read_photo
from ..io.kept import Kept
from ..io.outputs import work_folder
from ..io.photos.images import stored_size, unread_pictures
from ..io.places import local_place
from ..model import Camera, RowMotion
from ..model.array_types import Array
from ..sfm import (
    DETECTION_MEGAPIXELS,
    Features,
    ReducedPhoto,
    detect_affine_features,
    detect_features,
    detection_bytes,
    edge_width_px,
    features_of_both,
    grey_8_bit,
    other_scenes,
    reduce_photo,
)
from .photo_cameras import PhotoCameras, find_cameras
from .without_motion import FrameWithoutMotion, photo_without_motion

__all__ = ["LONG_EXPOSURE_S", "UNCONNECTED", "LoadedPhotos", "OtherFeatures", "load_photos", "reading_bytes"]

#: Longer exposures bound the motion: a camera that rotated much would have blurred the photo.
LONG_EXPOSURE_S = 1 / 250
#: Why a photo is not registered of which nothing else is known.
UNCONNECTED = "shares too little with the other photos"

# Bytes per pixel of a decoded photo, at most, except for floats; and the size of one whose header has none.
_BYTES_PER_PIXEL, _SIZE_OF_OTHERS = 16, (8000, 6000)

# SIFT doubles the sides of what it is given: a third of a photo's pixels become more than the photo has. A photo that
# has so many features there needs no more pixels, unless too few of them match those of other photos. (A quarter takes
# 0.85 of the time, and loses 0.8 dB on warped herz-jesus-8.)
_COARSE, _MANY_FEATURES = 1 / 3, 3000

# Photos for each thread that go to pycolmap at once: a few, since an interruption waits for them (four seconds each).
_AT_ONCE = 2

_NUMBERS = {2: "two", 3: "three"}


@dataclass(frozen=True)
class LoadedPhotos:
    """Content of a folder.

    Attributes
    ----------
    names, features, facts : lists of length m
        Readable photos, their features and EXIF.
    skipped : dict of name to reason
        Unreadable ones.
    orientations : mapping of name to int
        Their EXIF orientations.
    max_megapixels : float
        As in `RectifyOptions`.
    edges_px : sequence of float or None
        Width of the steepest edges of each photo whose exposure was so long that it matters.
    coarse : frozenset of str
        Photos whose features were detected in fewer pixels than allowed; see `OtherFeatures`.
    affine : bool
        Whether features of the shape of their surroundings are among them; see there, too.
    """

    names: list[str]
    features: list[Features]
    facts: list[ExifFacts]
    skipped: dict[str, str]
    cameras: PhotoCameras
    orientations: Mapping[str, int]
    folder: Path
    mask_of: Mapping[str, Path]
    max_megapixels: float
    edges_px: Sequence[float | None] = ()
    coarse: frozenset[str] = frozenset()
    affine: bool = False

    @property
    def camera_of(self) -> dict[str, int]:
        """Index of the camera of each photo."""
        return dict(zip(self.names, self.cameras.camera_idx.tolist(), strict=True))

    @property
    def featureless(self) -> dict[str, str]:
        """Photos without a feature, and why."""
        return {
            name: "its mask excludes all that it shows" if name in self.mask_of else "shows no features"
            for name, found in zip(self.names, self.features, strict=True)
            if not len(found.xy_raw)
        }

    def unregistered(
        self, registered: Sequence[str], num_verified: Mapping[tuple[int, int], int] | None = None
    ) -> dict[str, str]:
        """Photos that are not registered, and why; with the number of verified matches of each pair, if it is known."""
        lost = dict.fromkeys(sorted({*self.names} - {*registered}), UNCONNECTED)
        lost |= {name: why for name, why in self.featureless.items() if name in lost}
        for scene in other_scenes(num_verified or {}, np.isin(self.names, registered)):
            why = f"shows another scene, with {len(scene) - 1} other photos; put them in a folder of their own"
            lost |= dict.fromkeys((self.names[i] for i in scene), why)
        return {**self.skipped, **lost}


@dataclass(frozen=True)
class _LoadJob:
    """All that reading one photo takes."""

    name: str
    source: Path
    own_mask: Path | None
    max_features: int
    megapixels: float
    max_megapixels: float
    again: bool
    coarse: bool
    # taken out of the photo before features are detected
    camera: Camera | None = None
    motion: RowMotion | None = None


@dataclass(frozen=True)
class _Loaded:
    """Features and facts of a photo; or only the problem with it, or with its mask."""

    features: Features | None = None
    width: int = 0
    height: int = 0
    orientation: int = 1
    facts: ExifFacts = field(default_factory=ExifFacts)
    edge_px: float | None = None
    problem: str = ""
    coarse: bool = False


# A descriptor takes 16 pixels, and a camera of a row of pixels is none.
_LEAST_SIDE = 16


def _load(job: _LoadJob) -> _Loaded:
    try:
        photo = read_photo(job.source, job.max_megapixels)
        if not job.again:
            check_not_rectified(photo)
    except FileError as error:
        return _Loaded(problem=str(error))
    except InputError as error:
        return _Loaded(problem=f"{job.name}: {error}")
    height, width = photo.pixels.shape[:2]
    if min(width, height) < _LEAST_SIDE:
        return _Loaded(problem=f"{job.name} has {width}x{height} pixels, too few to show anything")
    # a mask that cannot be used stops the run: without it, what it excludes would be measured
    mask = None if job.own_mask is None else read_mask(job.own_mask, width, height)
    few, features = 1e-6 * _COARSE * width * height, None
    if job.coarse and few < job.megapixels:
        features = detect_features(photo.pixels, job.max_features, mask, few)
    is_coarse = features is not None and len(features.xy_raw) >= min(_MANY_FEATURES, job.max_features)
    if not is_coarse:
        features = detect_features(photo.pixels, job.max_features, mask, job.megapixels)
    facts = facts_of_exif(photo.metadata.exif, photo.metadata.xmp)
    edge_px = None
    if facts.exposure_s is not None and facts.exposure_s > LONG_EXPOSURE_S:
        edge_px = edge_width_px(grey_8_bit(photo.pixels))
    return _Loaded(features, width, height, photo.metadata.orientation, facts, edge_px, coarse=is_coarse)


def _bytes_of(job: _LoadJob) -> float:
    """Approximate bytes that reading a photo takes; 0 if it will not be decoded."""
    try:
        width, height = stored_size(job.source) or _SIZE_OF_OTHERS
    except FileError:  # it is reported when it is read
        return 0.0
    if width * height > job.max_megapixels * 1e6:
        return 0.0
    return reading_bytes(width, height, job.megapixels, 1 if job.motion is None else 2)


def reading_bytes(width: int, height: int, megapixels: float, copies: int = 1) -> float:
    """Approximate bytes that a photo takes, with copies of it, and the detection of its features."""
    return detection_bytes(width, height, megapixels) + copies * _BYTES_PER_PIXEL * width * height


def _listed(folder: Path, raw_as: str, only: Sequence[str] | None, least: int) -> list[str]:
    """The photos that are to be loaded; refused where they are too few, or no model can hold a name."""
    listed = list_photos(folder, raw_as) if only is None else list(only)
    if only is None and (unread := unread_pictures(folder)):
        more = f" and {len(unread) - 3} more" if len(unread) > 3 else ""
        warnings.warn(
            f"{folder}: {', '.join(unread[:3])}{more} passed over, since pictures of such kinds are not read; "
            "convert them to PNG or TIFF, and RAW to DNG",
            SkippedPhotoWarning,
            stacklevel=3,
        )
    if len(listed) < least:
        raise InputError(
            f"{folder} holds {len(listed)} photo{'s' * (len(listed) > 1)}; the shutter needs at least {_NUMBERS[least]}"
        )
    # what is not UTF-8 comes as surrogates
    if no_text := [name for name in listed if any("\ud800" <= letter <= "\udfff" for letter in name)]:
        raise InputError(f"{no_text[0]!r} in {folder} is no name in UTF-8, and no model can hold it; rename it")
    return listed


def load_photos(
    folder: Path,
    camera: str | None,
    readout: str | Mapping[str, str] | None,
    max_features: int,
    workers: Workers,
    log: StageLog,
    *,
    megapixels: float = DETECTION_MEGAPIXELS,
    masks: Path | str | None = None,
    raw_as: str = "tif",
    again: bool = False,
    max_megapixels: float = MAX_MEGAPIXELS,
    least: int = 3,
    kept: Kept | None = None,
    only: Sequence[str] | None = None,
    coarse: bool = False,
) -> LoadedPhotos:
    """Read every photo of a folder once, for its size and features; unusable ones are skipped with a warning.

    Parameters
    ----------
    camera, readout
        As in `find_cameras`.
    megapixels : float
        As in `detect_features`.
    masks, raw_as, again, max_megapixels
        As in `RectifyOptions`.
    least : int
        Smallest number of photos, two or three.
    only : sequence of str, optional
        Photos that are loaded; all that are there when left out.
    coarse : bool
        Whether fewer pixels are enough for the features of photos that show many there.
    """
    kept = kept or Kept()
    listed = _listed(folder, raw_as, only, least)
    mask_of = {} if masks is None else find_masks(local_place(masks).absolute(), listed)
    jobs = [
        _LoadJob(
            name, folder.absolute() / name, mask_of.get(name), max_features, megapixels, max_megapixels, again, coarse
        )
        for name in listed
    ]
    found, skipped = dict[str, _Loaded](), dict[str, str]()
    for name, each in _read(jobs, "features of", workers, log, kept):
        if each.features is None:
            skipped[name] = each.problem
            warnings.warn(f"skipped: {each.problem}", SkippedPhotoWarning, stacklevel=2)
        else:
            found[name] = each
    names, loaded = list(found), list(found.values())
    if len(names) < least:
        readable = f"{folder} holds {len(names)} readable photo{'s' * (len(names) != 1)} of {len(listed)}"
        raise InputError(f"{readable}; the shutter needs at least {_NUMBERS[least]} ({next(iter(skipped.values()))})")
    facts, features = [each.facts for each in loaded], [each.features for each in loaded if each.features is not None]
    cameras = find_cameras(folder, names, [(each.width, each.height) for each in loaded], facts, camera, readout)
    log.end("features", photos=len(names), keypoints=sum(len(f.xy_raw) for f in features))
    orientations = {name: each.orientation for name, each in found.items()}
    photos = LoadedPhotos(
        names, features, facts, skipped, cameras, orientations, folder.absolute(), mask_of, max_megapixels,
        [each.edge_px for each in loaded], frozenset(name for name, each in found.items() if each.coarse),
    )  # fmt: skip
    if len(photos.featureless) == len(names):
        better = "masks that are black in fewer places" if mask_of else "photos of things with texture"
        raise InputError(f"no photo shows a feature ({names[0]}: {photos.featureless[names[0]]}); use {better}")
    return photos


@dataclass(frozen=True)
class OtherFeatures:
    """Other features of photos that are loaded, for those whose own ones match too little.

    Attributes
    ----------
    photos : LoadedPhotos
    max_features, workers, log, megapixels, kept
        As in `load_photos`.
    """

    photos: LoadedPhotos
    max_features: int
    workers: Workers
    log: StageLog
    megapixels: float
    kept: Kept = field(default_factory=Kept)

    def finer(self) -> LoadedPhotos:
        """Those of all pixels that are allowed, where they are coarse."""
        photos = self.photos
        jobs = [job for job in self._jobs() if job.name in photos.coarse]
        finer = dict(_read(jobs, "finer features of", self.workers, self.log, self.kept))
        if lost := [each.problem for each in finer.values() if each.features is None]:
            raise FileError(lost[0])
        features = [
            finer[name].features or old if name in finer else old
            for name, old in zip(photos.names, photos.features, strict=True)
        ]
        return self._with("features", features, len(jobs))

    def affine(self) -> LoadedPhotos:
        """Those of all pixels, and those of the shape of their surroundings (`sfm.affine_features`), of all photos.

        A strong shutter shears surroundings. Of leaves and grass the usual features match better.
        """
        features = self._detect(self._jobs(), "affine features", self.kept, affine=True)
        return self._with("affine features", features, len(features))

    def without_motions(
        self, own: Mapping[str, Camera], phi: Mapping[str, Array], before: Sequence[Features]
    ) -> LoadedPhotos:
        """Those of photos as they are without lens and rotation, where the photos have them.

        A strong shutter shears what a feature is described by. Those of the shape of their surroundings are among them
        if they are in `before`. Other photos keep their features before, and so do those of a fisheye, which no pinhole
        camera can show.

        Parameters
        ----------
        own, phi : mappings of name to Camera and (3,) array
            Of the photos whose rotation is taken out.
        before : sequence of Features
            Of all photos.
        """
        jobs = [
            replace(job, camera=own[job.name], motion=RowMotion(phi[job.name]))
            for job in self._jobs()
            if job.name in phi and own[job.name].lens != "fisheye"
        ]
        stage, affine = "features without motions", any(each.kind is not None for each in before)
        found = dict(zip([job.name for job in jobs], self._detect(jobs, stage, Kept(), affine=affine), strict=True))
        features = [found.get(name, old) for name, old in zip(self.photos.names, before, strict=True)]
        return self._with(stage, features, len(jobs))

    def _detect(self, jobs: list[_LoadJob], stage: str, kept: Kept, *, affine: bool) -> list[Features]:
        """The usual features of all pixels that are allowed, and `affine` ones beside them."""
        key = f"{stage} of {{}}".format
        found: dict[str, Features] = {job.name: old for job in jobs if (old := kept.get(key(job.name)))}
        left = [job for job in jobs if job.name not in found]
        workers = self.workers
        if left and not workers.scheduler:
            workers = workers.fitting("features", max(map(_bytes_of, left)))
        self.log.begin(stage, len(jobs), len(found))
        results = workers.map(_reduce, left, lambda job, why: _Reduced(problem=f"{job.name}: {why}"))
        with closing(results):
            for start in range(0, len(left), _AT_ONCE * workers.jobs):
                some = left[start : start + _AT_ONCE * workers.jobs]
                reduced = [next(results) for _ in some]
                if lost := [each.problem for each in reduced if each.photo is None]:
                    raise FileError(lost[0])
                photos = [each.photo for each in reduced if each.photo is not None]
                others = self._affine_of(photos, workers.jobs) if affine else [None] * len(photos)
                for job, each, other in zip(some, reduced, others, strict=True):
                    assert each.features is not None
                    features = each.features if other is None else features_of_both(each.features, other)
                    found[job.name] = features if each.frame is None else each.frame.in_photo(features)
                    kept.put(key(job.name), found[job.name])
                self.log.tell(stage, len(found), len(jobs))
        return [found[job.name] for job in jobs]

    def _affine_of(self, photos: list[ReducedPhoto], num_threads: int) -> list[Features]:
        with work_folder() as work:
            return list(detect_affine_features(photos, self.max_features, num_threads, work))

    def _jobs(self) -> list[_LoadJob]:
        photos = self.photos
        limits = self.max_features, self.megapixels, photos.max_megapixels
        return [
            _LoadJob(name, photos.folder / name, photos.mask_of.get(name), *limits, again=True, coarse=False)
            for name in photos.names
        ]

    def _with(self, stage: str, features: list[Features], num_photos: int) -> LoadedPhotos:
        self.log.end(stage, photos=num_photos, keypoints=sum(len(each.xy_raw) for each in features))
        return replace(self.photos, features=features, coarse=frozenset(), affine=stage == "affine features")


@dataclass(frozen=True)
class _Reduced:
    """A photo as features are detected in it, and its usual ones; or only the problem with it."""

    photo: ReducedPhoto | None = None
    features: Features | None = None
    problem: str = ""
    frame: FrameWithoutMotion | None = None


def _reduce(job: _LoadJob) -> _Reduced:
    try:
        photo = read_photo(job.source, job.max_megapixels)
    except FileError as error:
        return _Reduced(problem=str(error))
    height, width = photo.pixels.shape[:2]
    mask = None if job.own_mask is None else read_mask(job.own_mask, width, height)
    pixels, megapixels, frame = photo.pixels, job.megapixels, None
    if job.camera is not None and job.motion is not None:
        pixels, mask, frame = photo_without_motion(pixels, mask, job.camera, job.motion, megapixels)
        megapixels *= frame.area_ratio
    usual = detect_features(pixels, job.max_features, mask, megapixels)
    return _Reduced(reduce_photo(pixels, mask, megapixels), usual, frame=frame)


def _read(
    jobs: Sequence[_LoadJob], key: str, workers: Workers, log: StageLog, kept: Kept
) -> Iterator[tuple[str, _Loaded]]:
    """Names and contents of photos; those that an earlier run kept are not read again."""
    # headers are not read for workers elsewhere, which limit their own memory
    if jobs and not workers.scheduler:
        workers = workers.fitting("features", max(map(_bytes_of, jobs)))
    before: dict[str, _Loaded] = {job.name: old for job in jobs if (old := kept.get(f"{key} {job.name}"))}
    log.begin("features", len(jobs), len(before))
    left = (job for job in jobs if job.name not in before)
    results = workers.map(_load, left, lambda job, why: _Loaded(problem=f"{job.name}: {why}"))
    with closing(results):
        for done, job in enumerate(jobs, 1):
            each = before[job.name] if job.name in before else next(results)
            if job.name not in before and each.features is not None:
                kept.put(f"{key} {job.name}", each)
            log.tell("features", done, len(jobs))
            yield job.name, each
