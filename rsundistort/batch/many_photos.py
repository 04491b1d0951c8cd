"""The outputs of a run."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import closing
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, SkippedPhotoWarning
from ..io import find_masks, output_name
from ..io.journal import Journal, JournalEntry
from ..io.lock import check_still_there
from ..io.outputs import BATCH_FOLDERS, make_inside
from ..io.photos.kinds import kind_of_name
from ..io.places import Place, RemoteFolder, absolute, files_of, place_of, sizes_under
from ..io.record import Record
from ..model import Reconstruction, Solution
from ..model.array_types import Array, Index
from .extras import find_extras
from .geometry import DEPTHS, SceneGeometry
from .one_photo import PhotoDone, PhotoJob, photo_colors, rectify_photo
from .progress import StageLog
from .rectify_options import RectifyOptions
from .workers import Workers

__all__ = ["PointColors", "mask_names", "rectify_photos"]

# What a photo takes at its peak, from decoding to encoding, for each pixel (measured: 7 to 9, 18, 31, 56; RAW and HEIC,
# which become TIFF, 40); and besides its grids, full maps of depth, and another image of its frame.
_BYTES_PER_PIXEL = {"JPEG": 10, "WebP": 20, "PNG": 32, "TIFF": 60}
_BYTES_OF_OTHERS, _BYTES_OF_GRIDS, _BYTES_OF_DEPTH = 40, 40, 32
# What is said of photos that are done when the others were interrupted.
_GO_ON = "whole; the same command with --resume continues"


def mask_names(names: Sequence[str]) -> dict[str, str]:
    """Name of each photo's mask: its stem, unless two photos share it (a.jpg and a.png)."""
    stems = {name: PurePosixPath(name).with_suffix("").as_posix() for name in names}
    counts = Counter(stems.values())
    return {name: f"{stem}.png" if counts[stem] == 1 else f"{name}.png" for name, stem in stems.items()}


def rectify_photos(
    folder: Place,
    scene: SceneGeometry,
    names: Sequence[str],
    out: Place,
    options: RectifyOptions,
    workers: Workers,
    log: StageLog,
    journal: Journal,
    *,
    posed: bool = True,
    resume: bool = False,
    colors: PointColors | None = None,
    others: bool = True,
) -> dict[str, PhotoDone]:
    """Rectify photos into `out/images` and `out/masks`, each file whole or not at all.

    Photos that cannot be read, are of another size than their camera, or are rectified already, are skipped with a
    warning. At the end, what else an earlier batch wrote is deleted; with `resume` only what it made of these photos,
    and is not true any more. What is not ours stays, and is refused before anything is written where it is in the way.

    Parameters
    ----------
    out : Path or RemoteFolder
        `batch_folder` made it ready, and gave `journal`.
    options, workers, log, journal
        What is done to each, where, who gets the progress, and what records what is done.
    posed : bool
        Whether they keep poses, which no mirror image has.
    resume : bool
        Pass over what is whole and current by the journal.
    colors : PointColors, optional
        Takes the colours of the points.
    others : bool
        Whether `resume` leaves what an earlier batch made of other photos.

    Returns
    -------
    dict of name to PhotoDone
        Of every photo; those that were left out have a `problem`.
    """
    before, record = journal.read(), Record(out)
    jobs = _Jobs(folder, scene, names, out, options, colors, posed)
    done = _still_whole(jobs, names, before, out) if resume else {}
    todo = {name: jobs[name].targets for name in names if name not in done}
    earlier = record.ours(BATCH_FOLDERS)
    if resume and others:
        earlier &= {path for entry in before.values() for path in entry.files}
    # what was cut short, or changed, since it was made is made again by `resume`
    record.check(earlier.union(*todo.values()), [file for name in names for file in jobs[name].inputs], again=resume)
    _make_room(jobs, todo, out, record)
    _open_again(todo.keys() & before.keys(), before, journal)
    log.begin("rectifying", len(names), len(done))
    fitting = workers.fitting("rectifying", _most_bytes(scene.solution, todo, options))
    try:
        if colors is not None:
            _look_again(jobs, list(done), fitting, colors)
        with closing(_rectified(jobs, todo, record, fitting)) as results:
            for result in results:
                if not result.problem:
                    journal.add(_entry(result))
                    if colors is not None and result.colors is not None:
                        colors.add(result.name, result.colors)
                done[result.name] = result
                log.tell("rectifying", len(done), len(names))
    except FileError as error:
        raise FileError(f"{error}; {len(done)} of {len(names)} photos are done, {_GO_ON}") from error
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(f"{len(done)} of {len(names)} photos are done, {_GO_ON}") from stop
    if made := {name: _entry(each) for name, each in done.items() if not each.problem}:
        others_kept = {name: before[name] for name in before.keys() - done.keys()} if resume and others else {}
        _settle(others_kept | made, earlier, record, journal)
    log.end("rectifying", photos=len(made))
    return {name: done[name] for name in names}


def _open_again(names: Set[str], before: Mapping[str, JournalEntry], journal: Journal) -> None:
    """Write down that outputs of photos may be of either making from here on."""
    for name in sorted(names):
        journal.add(JournalEntry(name, "", before[name].files))
    journal.settle()


def _settle(kept: Mapping[str, JournalEntry], earlier: Set[str], record: Record, journal: Journal) -> None:
    """Delete what an earlier batch wrote and nobody keeps, and write down what is kept."""
    record.remove(earlier - {path for entry in kept.values() for path in entry.files})
    record.settle()
    journal.write(kept[name] for name in sorted(kept))


def _still_whole(
    jobs: _Jobs, names: Sequence[str], before: Mapping[str, JournalEntry], out: Place
) -> dict[str, PhotoDone]:
    """The photos of an earlier batch whose outputs are whole and current."""
    sizes = sizes_under(out, BATCH_FOLDERS)
    found = {}
    for name in names:
        entry = before.get(name)
        if entry and entry.fingerprint and entry.fingerprint == jobs[name].fingerprint() and entry.is_whole(sizes):
            found[name] = PhotoDone(name, "", entry.fingerprint, entry.files, entry.turn, entry.depth)
    return found


def _look_again(jobs: _Jobs, names: Sequence[str], workers: Workers, colors: PointColors) -> None:
    """Take the colours of photos that were rectified before."""
    with closing(workers.map(photo_colors, map(jobs.__getitem__, names), _unseen)) as found:
        for name, each in zip(names, found, strict=True):
            colors.add(name, each)


def _unseen(job: PhotoJob, why: str) -> Array:
    raise FileError(f"{job.name}: {why}")


def _make_room(jobs: _Jobs, targets: Mapping[str, Sequence[str]], out: Place, record: Record) -> None:
    """Make the folders of the outputs of photos."""
    if isinstance(out, RemoteFolder):  # they are made with what is in them, and its record is put as a whole: once
        record.claim(path for paths in targets.values() for path in paths)
    else:
        for within in jobs.folders(targets):
            make_inside(out, within)


def _rectified(
    jobs: _Jobs, targets: Mapping[str, Sequence[str]], record: Record, workers: Workers
) -> Generator[PhotoDone, None, None]:
    """The photos as they are done, those that were left out with a warning; the record has what is written of them."""

    def begun() -> Iterator[PhotoJob]:
        for name, paths in targets.items():
            if isinstance(jobs.out, Path):
                check_still_there(jobs.out)
            record.claim(paths)
            yield jobs[name]

    results = workers.map(rectify_photo, begun(), lambda job, why: PhotoDone(job.name, why))
    with record.writing(), closing(results):
        for result in results:
            record.add(targets[result.name])
            if result.problem:
                warnings.warn(f"skipped: {result.name}: {result.problem}", SkippedPhotoWarning, stacklevel=3)
            yield result


class _Jobs:
    """Jobs of the photos by name, each made when it is asked for."""

    def __init__(
        self,
        folder: Place,
        scene: SceneGeometry,
        names: Sequence[str],
        out: Place,
        options: RectifyOptions,
        colors: PointColors | None,
        posed: bool,
    ) -> None:
        # absolute: workers elsewhere have another working directory
        self._folder, self.out = absolute(folder), absolute(out)
        self._files = files_of(self._folder, names)
        self._scene, self._options, self._colors, self._posed = scene, options, colors, posed
        self._extras = find_extras(options.also, names)
        self._mask_name = mask_names([image.name for image in scene.solution.images])
        self._own = {} if options.masks is None else find_masks(absolute(place_of(options.masks)), names)

    def __getitem__(self, name: str) -> PhotoJob:
        stem = PurePosixPath(self._mask_name[name]).with_suffix("").as_posix()
        return PhotoJob(
            name=name,
            source=self._files[name],
            out=self.out,
            image=f"images/{output_name(name, self._options.raw_as)}",
            mask=f"masks/{self._mask_name[name]}",
            geometry=self._scene.of(name),
            posed=self._posed,
            options=self._options,
            own_mask=self._own.get(name),
            also=tuple(self._extras[name]),
            maps=None if self._options.maps is None else f"maps/{stem}",
            sample_xy=None if self._colors is None else self._colors.pixels(name),
        )

    def folders(self, names: Iterable[str]) -> list[str]:
        """Folders of the outputs of photos."""
        kinds = ("images", "masks", *(["maps"] if self._options.maps is not None else []))
        found = [kind / within for within in {PurePosixPath(name).parent for name in names} for kind in kinds]
        found += {PurePosixPath(each.target).parent for name in names for each in self._extras[name]}
        return sorted(path.as_posix() for path in found)


def _most_bytes(solution: Solution, names: Iterable[str], options: RectifyOptions) -> float:
    """Bytes that the largest photo takes, estimated."""
    own_depth = str(options.depth) not in DEPTHS
    besides = _BYTES_OF_GRIDS * bool(options.maps) + _BYTES_OF_DEPTH * own_depth
    besides += _BYTES_PER_PIXEL["PNG"] * bool(options.also)

    def bytes_of(name: str) -> float:
        camera_id = solution.image(name).camera_id
        cameras = (solution.cameras[camera_id], solution.rectified_cameras[camera_id])
        each = _BYTES_PER_PIXEL.get(kind_of_name(name), _BYTES_OF_OTHERS) + besides
        return float(each) * max(camera.width * camera.height for camera in cameras)

    return max(map(bytes_of, names), default=1.0)


def _entry(done: PhotoDone) -> JournalEntry:
    return JournalEntry(done.name, done.fingerprint, done.files, done.orientation, done.depth)


class PointColors:
    """Mean colour of each point over the photos that see it."""

    _FINE = 2**16

    def __init__(self, reconstruction: Reconstruction) -> None:
        self._seen = reconstruction.observations
        photos = self._seen.by_photo(reconstruction.num_images)
        self._of = dict(zip(reconstruction.image_names, photos, strict=True))
        # whole numbers of 1 / _FINE, whose sum does not depend on the order of the photos
        self._sum = np.zeros((reconstruction.num_points, 3), np.int64)
        self._count = np.zeros(reconstruction.num_points)

    def pixels(self, name: str) -> Index:
        """(k, 2) raw pixels where a photo shows points."""
        return np.rint(self._seen.xy_raw[self._of[name]]).astype(np.int64)

    def add(self, name: str, colors: Array) -> None:
        """Take the (k, 3) colours at those pixels, 0 to 255."""
        points = self._seen.point_idx[self._of[name]]
        np.add.at(self._sum, points, np.rint(self._FINE * colors).astype(np.int64))
        np.add.at(self._count, points, 1)

    def rgb(self) -> NDArray[np.uint8]:
        """(n, 3) red, green, blue."""
        mean = self._sum / (self._FINE * np.maximum(self._count, 1)[:, None])
        return np.clip(np.rint(mean), 0, 255).astype(np.uint8)
