"""The outputs of a reconstruction: models for other programs, rectified photos, and the solution."""

from __future__ import annotations

import os
import shlex
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from ..batch.extras import find_extras
from ..batch.geometry import DEPTHS, PhotoGeometry, SceneGeometry, ScenePoints, with_depths
from ..batch.many_photos import PointColors, mask_names, rectify_photos
from ..batch.one_photo import applied_part
from ..batch.progress import StageLog
from ..batch.rectify_options import RectifyOptions
from ..batch.video_frames import rectify_clip
from ..batch.views import with_view
from ..batch.workers import Workers
from ..colmap.rectified_model import ModelIds
from ..errors import FileError, InputError, MissingOutputWarning, RsUndistortWarning
from ..io import (
    output_folder,
    output_name,
    read_photo_times,
    write_colmap_model,
    write_colmap_workspace,
    write_path,
    write_point_cloud,
    write_shutter_poses,
    write_solution,
    write_trajectory,
    write_transforms,
)
from ..io.depth_maps import find_depth_maps
from ..io.export_scene import ExportScene
from ..io.exports import EXPORTS, check_exports
from ..io.journal import Journal
from ..io.outputs import batch_folder
from ..io.places import local_place
from ..io.record import Record
from ..io.usd import write_usd_camera
from ..io.video import FRAME_TABLE, frame_name
from ..model import Reconstruction, RowMotion, Solution, SolvedImage
from ..model.array_types import Mask
from ..model.orientation import orient_path, orient_reconstruction, orient_solution
from ..model.track import CameraTrack, ShownFrames, camera_track
from ..rectify import bend_px
from ..report import Diagnostics, relative_folder, write_diagnostics, write_report
from .outcome import Solved, solution_of
from .run_options import OutputOptions, SolveOptions

__all__ = [
    "OF_VIDEOS",
    "REPLACED",
    "USD",
    "VIDEO",
    "Outputs",
    "check_images_of",
    "check_usd",
    "files_of_run",
    "inputs_of",
    "photo_times",
    "remove_former",
]

#: Folders that a run replaces.
REPLACED = ("images", "masks", "sparse", "stereo", "rs-poses", *EXPORTS)

#: All frames of a video, rectified.
VIDEO = "video.mp4"
#: The camera of a video for match-moving.
USD = "camera.usda"
#: Files that only videos have.
OF_VIDEOS = ("path.csv", "path.txt", VIDEO, USD)

# Files besides the photos.
_FILES = (
    "solution.json", "report.npz", "poses.txt", "points.ply", "transforms.json", "run-colmap-geometric.sh",
    "run-colmap-photometric.sh", "stereo/fusion.cfg", "stereo/patch-match.cfg",
)  # fmt: skip
_REPORT = "report.html"
_RS_POSES = ("rs-poses/gsplat.npz", "rs-poses/transforms.json")
_PARTS = ("cameras", "images", "points3D", "rigs", "frames")


def files_of_run(names: Sequence[str], raw_as: str, options: OutputOptions) -> list[str]:
    """All files that the outputs of photos may have, to report conflicts before the work.

    Refuses photos that an export would confuse.
    """
    check_exports(options.exports, names)
    masks = mask_names(names)
    files = [*_FILES, *(f"sparse/{part}.{options.sparse_format}" for part in _PARTS), *_asked_for(options)]
    return files + [each for n in names for each in (f"images/{output_name(n, raw_as)}", f"masks/{masks[n]}")]


def _asked_for(options: OutputOptions) -> list[str]:
    """Files that are written where they are asked for, but those of videos."""
    return [*_RS_POSES] * options.rs_poses + [_REPORT] * options.report + _exported(options.exports)


def _exported(programs: Iterable[str]) -> list[str]:
    return [f"{name}/{file}" for name in programs for file in EXPORTS[name].files]


def remove_former(out: Path, options: OutputOptions, of_video: Sequence[str] = ()) -> None:
    """Remove what an earlier run wrote that was not asked for this time: it belongs to another solution.

    `of_video` are the files of a video that are written this time.
    """
    every = {*_RS_POSES, _REPORT, *_exported(EXPORTS), *OF_VIDEOS}
    Record(out).remove(every - {*_asked_for(options), *of_video})


def check_images_of(names: Sequence[str], options: RectifyOptions) -> None:
    """Refuse, before any work, folders of other images or depth maps that hold none of these photos."""
    if not names:
        return
    find_extras(options.also, names)
    if str(options.depth) not in DEPTHS:
        find_depth_maps(Path(options.depth).absolute(), names)


def check_usd(options: OutputOptions, is_clip: bool) -> None:
    """Refuse, before any work, a USD camera without a path, or without USD's library."""
    if options.usd and not is_clip:
        raise InputError("--usd is for a video whose frames share a path, without --every and --sharpest")
    if options.usd and find_spec("pxr") is None:
        raise InputError('--usd needs USD\'s library: pip install "rsundistort[usd]"')


def inputs_of(options: RectifyOptions, *given: Path | str | None) -> list[Path]:
    """Files and folders that are read: those given, and those that the options name."""
    return [local_place(path) for path in (*given, *options.inputs) if path is not None]


def photo_times(folder: Path) -> dict[str, float]:
    """Times of the photos of a folder, by the `frames.csv` beside frames of a video; {} without one."""
    try:
        return read_photo_times(folder / FRAME_TABLE)
    except (FileError, ValueError):  # no such table, or another's
        return {}


@dataclass(frozen=True)
class PointRgb:
    """Colours of points that are known beforehand.

    Attributes
    ----------
    values : (n, 3) uint8 array
        Red, green, blue.
    known : (n,) bool array
        Which points have one; those of the others come from the photos.
    """

    values: NDArray[np.uint8]
    known: Mask


@dataclass(frozen=True)
class Outputs:
    """Outputs of a reconstruction, before the photos are rectified and after.

    Attributes
    ----------
    solution : Solution
        The solution in the stored frame, with the rectified cameras.
    reconstruction : Reconstruction
        Poses, points and measurements, and the motions that are corrected.
    applied : mapping of name to int
        EXIF orientations that are applied.
    rgb : PointRgb or None
        Colours of points; None if all come from the photos.
    with_photos : bool
        Whether there are photos to rectify.
    times : mapping of name to float
        When photos were taken, in seconds.
    solved : Solved or None
        Data of the report; None if there is none.
    shown : ShownFrames or None
        Of a video whose frames share a path.
    every_frame : bool
        Whether all of its frames are rectified.
    """

    solution: Solution
    reconstruction: Reconstruction
    rectifying: RectifyOptions
    options: OutputOptions
    ids: ModelIds
    applied: Mapping[str, int]
    rgb: PointRgb | None = None
    with_photos: bool = True
    times: Mapping[str, float] = field(default_factory=dict)
    solved: Solved | None = None
    shown: ShownFrames | None = None
    every_frame: bool = False

    @classmethod
    def of_solved(
        cls,
        solved: Solved,
        solving: SolveOptions,
        rectifying: RectifyOptions,
        options: OutputOptions,
        orientations: Mapping[str, int],
        ids: ModelIds | None = None,
        rgb: PointRgb | None = None,
        with_photos: bool = True,
        times: Mapping[str, float] | None = None,
    ) -> Outputs:
        """Outputs of a solution, whose photos have these EXIF orientations."""
        rec = solved.reconstruction
        solution = with_view(solution_of(solved, solving, rectifying), rectifying.view)
        applied: dict[str, int] = {}
        if rectifying.apply_orientation:
            applied = {name: applied_part(orientations.get(name, 1), True)[0] for name in rec.image_names}
        ids = replace(ids or ModelIds.in_order(rec), cameras=solved.camera_ids)
        rec = rec.with_motions([solution.image(name).taken_out or RowMotion() for name in rec.image_names])
        if (options.rs_poses or not {"ncore", "opf"}.isdisjoint(options.exports)) and rec.bends:
            solution = replace(solution, quality={**solution.quality, "rs_poses_px": _left_by_two_poses(rec)})
        return cls(solution, rec, rectifying, options, ids, applied, rgb, with_photos, times or {}, solved)

    def begin(self, folder: Path, log: StageLog) -> Solution:
        """Write all except the photos and the colours of points, so that the rest can be resumed."""
        if self.with_photos:
            for name in ("images", "masks"):
                (folder / name).mkdir()
            Journal(folder).write(())
        rgb = None if self.rgb is None else self.rgb.values
        written = replace(self._models(folder, self.solution, {}, rgb, None), stages=tuple(log.stages))
        write_solution(folder / "solution.json", written)
        self._tell_report(folder, rgb)
        return written

    def report(self, out: Path, jobs: int, log: StageLog, photos: Path | None = None) -> None:
        """Write the report of `out`, if it is wanted; a failure only causes a warning."""
        if not self.options.report:
            return
        try:
            with _only_warned_of():
                write_report(out, photos, jobs=jobs, progress=log.tell)
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(
                f"all but the report is written; continue with: rsundistort report {shlex.quote(str(out))}"
            ) from stop

    def rectify(self, photos: Path, out: Path, workers: Workers, log: StageLog, resume: bool = False) -> Solution:
        """Rectify the photos of a folder into `out`, which `begin` has filled, and write the rest again.

        With `resume` photos that are complete are skipped.
        """
        solution, rec, options = self.solution, self.reconstruction, self.rectifying
        colors = None if self.rgb is not None and self.rgb.known.all() else PointColors(rec)
        scene = SceneGeometry(solution, options.depth, ScenePoints.of_reconstruction(rec))
        with batch_folder(out, overwrite=True) as journal:
            done = rectify_photos(
                photos, scene, list(rec.image_names), out, options, workers, log, journal,
                colors=colors, resume=resume, others=False,
            )  # fmt: skip
        log.begin("writing")
        left_out = {name: each.problem for name, each in done.items() if each.problem}
        if len(left_out) == len(done):
            raise InputError(f"none of the {len(done)} photos of {photos} could be rectified; see the warnings")
        images = [replace(image, reason=left_out.get(image.name, image.reason)) for image in solution.images]
        found = {name: each.depth for name, each in done.items() if each.depth is not None}
        solution = with_depths(replace(solution, images=tuple(images)), found)
        with output_folder(out, overwrite=True) as scratch:
            rgb = self._rgb(colors)
            written = self._models(scratch, solution, left_out, rgb, relative_to(photos, out / "rs-poses"), photos)
            self._tell_report(scratch, rgb, relative_folder(photos, out))
            log.end("writing")
            written = replace(written, stages=tuple(log.stages))
            write_solution(scratch / "solution.json", written)
        if any((out / "stereo").rglob("*.bin")):
            warnings.warn(
                f"{out / 'stereo'} holds maps that COLMAP made of an earlier result, and would take for those of this "
                "one; remove them before you run it", RsUndistortWarning, stacklevel=2,
            )  # fmt: skip
        self.report(out, workers.jobs, log, photos)
        if not left_out:
            journal.path.unlink()  # nothing to resume
        return written

    @cached_property
    def _diagnostics(self) -> Diagnostics | None:
        if self.solved is None:
            return None
        shared = self.solved.shared
        # photos that vary have cameras of their own: shared values are those of the first
        first = [int(np.argmax(shared.camera_idx == k)) for k in range(len(shared.cameras))]
        ids = [self.ids.cameras[k] for k in (first if shared.varies else range(len(shared.cameras)))]
        return Diagnostics.of_results(self.solved.result, self.solved.global_result, ids)

    def _tell_report(self, folder: Path, rgb: NDArray[np.uint8] | None, photos: str = "") -> None:
        """Keep the data of the report beyond the solution."""
        with _only_warned_of():
            if self._diagnostics is not None:
                diagnostics = replace(self._diagnostics.with_colors(rgb), photos=photos)
                write_diagnostics(folder / "report.npz", diagnostics)

    def _rgb(self, colors: PointColors | None) -> NDArray[np.uint8] | None:
        """Colours from the photos, where they were not known."""
        found = None if colors is None else colors.rgb()
        if self.rgb is None or found is None:
            return found if self.rgb is None else self.rgb.values
        return np.where(self.rgb.known[:, None], self.rgb.values, found)

    def _models(
        self,
        folder: Path,
        solution: Solution,
        left_out: Mapping[str, str],
        rgb: NDArray[np.uint8] | None,
        photos: PurePath | None,
        source: Path | None = None,
    ) -> Solution:
        """Write the models for other programs; returns the rotated solution in them.

        `photos` is the folder of the original photos, relative to the folder of their poses; `source` the same from
        here.
        """
        rec, ids, options, raw_as = self.reconstruction, self.ids, self.options, self.rectifying.raw_as
        names = [None if name in left_out else output_name(name, raw_as) for name in rec.image_names]
        written = {name: new for name, new in zip(rec.image_names, names, strict=True) if new is not None}
        last = photos is not None or not self.with_photos
        cut = [new for new in written.values() if " " in new]
        if options.sparse_format == "txt" and cut and last:
            warnings.warn(
                f"sparse/: names end at a space in text, such as {cut[0]}; --sparse-format bin "
                "keeps them", RsUndistortWarning, stacklevel=3,
            )  # fmt: skip
        originals = {name: name if photos is None else (photos / name).as_posix() for name in written}
        stored = solution
        if options.rs_poses:
            problem = write_shutter_poses(folder / "rs-poses", solution, originals, "../points.ply")
            if problem and last:
                warnings.warn(f"rs-poses is without transforms.json: {problem}", RsUndistortWarning, stacklevel=3)
        if self.applied:
            solution, rec = orient_solution(solution, self.applied), orient_reconstruction(rec, self.applied)
            # rotated cameras are further ones, in the same order in both
            ids = replace(ids, cameras=[int(key) for key in solution.cameras])
        new_cameras = [solution.rectified_cameras[str(key)] for key in ids.cameras]
        as_text = options.sparse_format == "txt"
        write_colmap_model(folder / "sparse", rec, new_cameras, names, rgb, ids, text=as_text)
        if self.with_photos:
            by_id = sorted((ids.images[i], name) for i, name in enumerate(names) if name is not None)
            write_colmap_workspace(folder, [name for _, name in by_id])
        write_point_cloud(folder / "points.ply", rec.points_w, rgb)
        self._trajectory(folder / "poses.txt", solution)
        track = self._path(folder, solution)
        masks = mask_names([image.name for image in solution.images])
        files = {name: (f"images/{new}", f"masks/{masks[name]}") for name, new in written.items()}
        write_transforms(folder / "transforms.json", solution, files, "points.ply")
        self._export(folder, ExportScene(solution, rec, written, rgb, stored, source, originals, track), last)
        return solution

    def _export(self, folder: Path, scene: ExportScene, tell: bool) -> None:
        """Write the exports; an error of one loses no other."""
        for name in self.options.exports:
            warning: RsUndistortWarning | None = None
            try:
                if said := EXPORTS[name].write(folder / name, scene):
                    warning = RsUndistortWarning(f"{name}: {said}")
            except InputError as error:
                warning = MissingOutputWarning(f"no {name} was written: {error}", f"{name}/")
                shutil.rmtree(folder / name, ignore_errors=True)
            if warning is not None and tell:
                warnings.warn(warning, stacklevel=4)

    def _path(self, folder: Path, solution: Solution) -> CameraTrack | None:
        """Write the path of the camera of a video; rotated as the key frames in the solution are. None of photos."""
        found = None if self.solved is None else self.solved.result.path
        if found is None:
            return None
        path = orient_path(found.path, next(iter(self.applied.values()), 1))
        write_path(folder / "path.csv", found.names, path)
        write_trajectory(folder / "path.txt", path.time_s, path.R_cw, path.center_w)
        camera = solution.rectified_cameras[solution.registered[0].camera_id]
        shown = self.shown or ShownFrames(path.time_s, found.names)
        track = camera_track(path, found.names, shown, camera, even=self.every_frame)
        if self.options.usd:
            write_usd_camera(folder / USD, track, self.reconstruction.points_w)
        return track

    def rectify_clip(self, video: Path, out: Path, workers: Workers, log: StageLog) -> None:
        """Rectify all frames of a video into `out`, which `begin` has filled."""
        assert self.solved is not None
        assert self.solved.whole is not None
        whole, solution = self.solved.whole.with_own_cameras(), self.solution
        # one view for all: each frame has the lens that focusing moved
        new_camera = next(iter(solution.rectified_cameras.values()))
        lens_only = any(image.lens_only for image in solution.registered)
        images = tuple(
            SolvedImage(name, str(whole.camera_idx[i]), whole.R_cw[i], whole.center_w[i], whole.motion(i))
            for i, name in enumerate(whole.image_names)
        )
        cameras = {str(k): camera for k, camera in enumerate(whole.cameras)}
        every = Solution(whole.shutter_model, cameras, dict.fromkeys(cameras, new_camera), images)
        # depth maps are those of the key frames: with them, and without them in between, things would jump
        depth = self.rectifying.depth if str(self.rectifying.depth) in DEPTHS else "auto"
        scene = SceneGeometry(every, depth, ScenePoints.of_reconstruction(whole))
        placed, repeated = {*whole.image_names}, solution.options["video"]["repeated"]
        before = {frame_name(video, k): frame_name(video, k - 1) for k in repeated}
        still = PhotoGeometry(video.name, self.solved.shared.cameras[0], new_camera, RowMotion(), "global")

        def geometry_of(name: str) -> PhotoGeometry | None:
            if lens_only:
                return still
            while name in before:
                name = before[name]
            return scene.of(name) if name in placed else None

        with Record(out).writing([VIDEO]):
            rectify_clip(video, out / VIDEO, geometry_of, still, self.rectifying.interpolation, workers, log)

    def _trajectory(self, path: Path, solution: Solution) -> None:
        """Write the poses by time if all photos have one, else by their index."""
        posed = {k: image for k, image in enumerate(solution.images) if image.posed}
        times = [self.times.get(image.name, np.nan) for image in posed.values()]
        if not np.isfinite(times).all():
            times = list(posed)
        poses = [(image.R_cw, image.center_w) for image in posed.values()]
        write_trajectory(path, np.array(times), np.array([R for R, _ in poses]), np.array([c for _, c in poses]))


def _left_by_two_poses(rec: Reconstruction) -> float:
    """Largest error in pixels, over the photos, of two poses per photo; at each one's near points."""
    left = 0.0
    obs = rec.observations
    for i in range(rec.num_images):
        seen = rec.points_w[obs.point_idx[obs.frame_idx == i]]
        depth = (seen - rec.center_w[i]) @ rec.R_cw[i, 2]
        moves = rec.shutter_model == "constant-motion" and (depth > 0).any()
        near = float(np.percentile(depth[depth > 0], 5)) if moves else np.inf
        left = max(left, bend_px(rec.camera(i), rec.motion(i).in_camera(rec.R_cw[i]), near))
    return left


def relative_to(folder: Path, start: Path) -> PurePath:
    """A folder relative to another; absolute if that is impossible, as between drives."""
    try:
        return PurePath(os.path.relpath(folder.resolve(), start.resolve()))
    except ValueError:
        return folder.resolve()


@contextmanager
def _only_warned_of() -> Iterator[None]:
    """An error of the report loses no run."""
    try:
        yield
    except Exception as error:
        said = " ".join(str(error).split()) or type(error).__name__
        warnings.warn(MissingOutputWarning(f"no report was written: {said}", _REPORT), stacklevel=4)
