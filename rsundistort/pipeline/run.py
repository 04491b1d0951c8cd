"""The main job: a folder of photos in, rectified photos and poses out."""

from __future__ import annotations

import platform
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..bundle import BundleOptions, GuessedCameras, KnownLength, reprojection_residuals
from ..critical import with_remedy
from ..errors import InputError, RsUndistortWarning
from ..io import (
    output_folder,
    output_name,
    write_colmap_model,
    write_solution,
    write_transforms,
)
from ..io.journal import Journal
from ..io.motions import Known
from ..io.outputs import batch_folder
from ..model import READOUTS, Reconstruction, Solution, SolvedImage, check_shutter_model
from ..model.orientation import turn_reconstruction, turn_solution
from ..rectify import largest_shift_px
from .cameras import PhotoCameras, check_readouts
from .depth import PhotoDepths, ScenePoints, check_depth, with_depths
from .frames import find_photos
from .gyro import GyroOptions, gyro_contradiction, gyro_motions, known_readouts
from .load import LoadedPhotos, load_photos
from .photo import RectifyOptions, turn_of
from .progress import ProgressCallback, StageLog
from .solve import Solved, solve_photos
from .views import with_view
from .workers import Workers, use_threads
from .write import PointColors, mask_names, rectify_photos

__all__ = ["RunOptions", "run", "versions"]


# What EXIF does not know, and a set of photos tells; and how far it may be off (relative f, lens coefficients):
# equivalent focal lengths are rounded to millimetres, focusing and stabilising crop a little, phones hardly distort.
_GUESSED = ("f", "k1", "k2")
_GUESS_SIGMA = {"f": 0.05, "k1": 0.2, "k2": 0.4}


@dataclass(frozen=True, kw_only=True)
class RunOptions(RectifyOptions):
    """Options of `run`: those of `RectifyOptions` for its last stage, and the following.

    There are no features where the `masks` are black. With `apply_orientation` photos that it mirrors are turned only,
    and keep the mirror as their orientation: no camera takes a mirror image.

    Parameters
    ----------
    camera : str, optional
        File or folder of cameras, or numbers, as `io.read_camera_file` takes them; else `camera.json` or `cameras.json`
        in or beside the folder of photos, else EXIF.
    readout : str or mapping of group to str, optional
        Readout direction of all photos, or of groups; else the camera file's; else it is guessed, and told by the fit.
    shutter_model : str
        "constant-motion", "rotation", "linearized", "two-step", "global", or "auto": the one that foretells held-out
        measurements best.
    seed : int
        Of every random choice.
    jobs : int
        Threads; 0 for all cores.
    max_features : int
        Per photo.
    refine : tuple of str, optional
        Intrinsics that are solved for with the rest, as in `BundleOptions`; by default none where the camera is given,
        f, k1 and k2 where EXIF had to guess it.
    still : mapping of photo name to float
        Photos known not to have moved: phi1 is held at zero in them (the paper's remedy), or, where the number is
        positive, near zero with that standard deviation, radians per frame.
    known : mapping of photo name to (phi, sigma)
        Motions known from elsewhere, as in `BundleOptions.known_phi`.
    lengths : sequence of KnownLength
        Lengths measured in the scene, as in `BundleOptions.lengths`.
    remedy : str
        What to do about a critical motion: "auto", "prior" or "none"; see `critical.heal`.
    every, sharpest : int, optional
        Of a video: each N-th frame, or the sharpest of each N frames, as in `io.extract_frames`.
    gyro : GyroOptions, optional
        A gyroscope's log, for the motions that are neither `known` nor those of `still` photos.
    readout_s : float, optional
        Time of the readout of a frame; else the log's, else that of the camera in the table, if it is there.
    overwrite : bool
        Replace the outputs of an earlier run.
    scheduler : str, optional
        Address of a Dask scheduler whose workers find the features and rectify the photos, as in `rectify_folder`.
    """

    camera: str | None = None
    readout: str | Mapping[str, str] | None = None
    shutter_model: str = "auto"
    seed: int = 0
    jobs: int = 0
    max_features: int = 16384
    refine: tuple[str, ...] | None = None
    still: Mapping[str, float] = field(default_factory=dict)
    known: Mapping[str, tuple[ArrayLike, ArrayLike]] = field(default_factory=dict)
    lengths: Sequence[KnownLength] = ()
    remedy: str = "auto"
    every: int | None = None
    sharpest: int | None = None
    gyro: GyroOptions | None = None
    readout_s: float | None = None
    overwrite: bool = False
    scheduler: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shutter_model != "auto":
            check_shutter_model(self.shutter_model)
        check_readouts(self.readout)
        check_depth(self.depth)
        with_remedy(self.bundle_options(), self.remedy)
        if self.jobs < 0 or self.max_features < 100:
            raise InputError("jobs must be 0 or more, max_features at least 100")
        if self.readout_s is not None and not 0 < self.readout_s < np.inf:
            raise InputError(f"readout_s={self.readout_s!r}, expected a positive number of seconds")

    def rectify_options(self) -> RectifyOptions:
        """Those of the last stage, alone."""
        return RectifyOptions(**{each.name: getattr(self, each.name) for each in fields(RectifyOptions)})

    def bundle_options(self, readout: Mapping[str, str] | None = None) -> BundleOptions:
        """Options of the adjustments of photos with these readout directions, top-to-bottom where none is named."""
        soft, hard = {}, {}
        for name, sigma in self.still.items():
            # the rotation that stretches the photo along its readout
            phi1 = 0 if READOUTS[(readout or {}).get(name, "top-to-bottom")][0] == 1 else 1
            if not 0 <= sigma < np.inf:
                raise InputError(f"still photo {name!r}: sigma {sigma!r}, expected 0 or a positive number")
            if sigma > 0 and name in self.known:
                raise InputError(f"photo {name!r} is said to be still and its motion to be known; give one of them")
            if sigma > 0:
                soft[name] = (np.zeros(3), np.where(np.arange(3) == phi1, sigma, np.inf))
            else:
                hard[name] = (phi1,)
        return BundleOptions(
            held_phi=hard, known_phi={**self.known, **soft}, lengths=self.lengths, refine=self.refine or ()
        )  # fmt: skip

    def options_for(self, reconstruction: Reconstruction, cameras: PhotoCameras) -> BundleOptions:
        """Options of the adjustments of a reconstruction, by its readout directions and by whether EXIF guessed."""
        rec = reconstruction
        options = self.bundle_options({name: rec.camera(i).readout for i, name in enumerate(rec.image_names)})
        if cameras.calibrated:
            return options
        refine = _GUESSED if self.refine is None else self.refine
        return replace(options, refine=refine, guessed=GuessedCameras(cameras.cameras, _GUESS_SIGMA))


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    names = ("rsundistort", "opencv-contrib-python-headless", "numpy", "scipy", "numba", "pycolmap")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def run(
    photos: Path | str,
    out: Path | str,
    options: RunOptions | None = None,
    progress: ProgressCallback | None = None,
) -> Solution:
    """Recover how the camera moved during each photo's readout; write rectified photos, masks and poses.

    Parameters
    ----------
    photos : path
        Folder of photos of one camera, or a video, whose frames go to `out/frames`.
    out : path
        Folder for the outputs. It stays as it was until the motions are solved; then it gets the solution, and the
        rectified photos one by one. Should that be interrupted, `rectify_folder(..., resume=True)` goes on.
    options : RunOptions, optional
        See there.
    progress : callable, optional
        Called as (stage, done, total).

    Returns
    -------
    Solution
        As written to `out/solution.json`; photos that did not register are in it, with the reason.
    """
    options = options or RunOptions()
    photos, out = Path(photos), Path(out)
    log = StageLog(progress)
    workers = Workers(use_threads(options.jobs), options.scheduler)
    inputs = [photos] if options.masks is None else [photos, Path(options.masks)]
    replaced = ("images", "masks", "sparse")
    with output_folder(out, overwrite=options.overwrite, apart_from=inputs, replaced=replaced) as scratch:
        gyro_log = None if options.gyro is None else options.gyro.log()
        source = find_photos(photos, scratch, options.camera, options.every, options.sharpest, log)
        folder = source.folder
        loaded = load_photos(folder, source.camera, options.readout, options.max_features, workers, log, options)
        cameras = loaded.cameras
        readouts = known_readouts(
            folder, loaded.names, cameras.cameras, cameras.camera_idx, source.frames, options.readout_s, gyro_log
        )  # fmt: skip
        ends = (end[0] for each in options.lengths for end in (each.start, each.end))
        for name in (*options.still, *options.known, *ends):
            if name not in loaded.names:
                raise InputError(f"anchor {name!r} is not among the photos of {photos}")
        from_gyro: Known = {}
        if options.gyro is not None and gyro_log is not None:
            times = [readouts[k][0] if k in readouts else None for k in cameras.camera_idx.tolist()]
            motions = gyro_motions(folder, options.gyro, gyro_log, dict(zip(loaded.names, times, strict=True)))
            from_gyro = {k: v for k, v in motions.items() if k not in options.known and k not in options.still}
            options = replace(options, known={**options.known, **from_gyro})
        with tempfile.TemporaryDirectory() as work:
            solved = solve_photos(
                loaded, options.shutter_model, options.seed, lambda rec: options.options_for(rec, cameras),
                Path(work), log, options.remedy,
            )  # fmt: skip
        rec = solved.result.reconstruction
        if contradiction := gyro_contradiction(rec, from_gyro):
            warnings.warn(contradiction, RsUndistortWarning, stacklevel=2)
        solution = with_view(_solution(loaded, solved, options, readouts, source.video), options.view)
        depths = PhotoDepths(solution, options.depth, ScenePoints.of_reconstruction(rec))
        turns: dict[str, int] = {}
        if options.apply_orientation:
            turns = {name: turn_of(loaded.orientations[name], True)[0] for name in rec.image_names}
        # whole but for the photos and the points' colours: what comes after can be gone on with
        for name in ("images", "masks"):
            (scratch / name).mkdir()
        Journal(scratch).write(())
        turned = _write_models(scratch, solution, rec, turns, options, {})
        write_solution(scratch / "solution.json", replace(turned, stages=tuple(log.stages)))
    if source.frames is not None:
        folder = out / "frames"
    colors = PointColors(rec)
    go_on = f"whole; go on with: rsundistort rectify {folder} --solution {out / 'solution.json'} -o {out} --resume"
    with batch_folder(out, overwrite=True) as journal:
        done = rectify_photos(
            folder,
            solution,
            list(rec.image_names),
            out,
            options.rectify_options(),
            depths,
            workers,
            log,
            journal,
            colors=colors,
            go_on=go_on,
        )
    log.begin("writing")
    left_out = {name: each.problem for name, each in done.items() if each.problem}
    if len(left_out) == len(done):
        raise InputError(f"none of the {len(done)} photos of {photos} could be rectified; see the warnings")
    images = [replace(image, reason=left_out.get(image.name, image.reason)) for image in solution.images]
    found = {name: each.depth for name, each in done.items() if each.depth is not None}
    solution = with_depths(replace(solution, images=tuple(images)), found)
    with output_folder(out, overwrite=True) as scratch:
        turned = _write_models(scratch, solution, rec, turns, options, left_out, colors.rgb())
        log.end("writing")
        turned = replace(turned, stages=tuple(log.stages))
        write_solution(scratch / "solution.json", turned)
    if not left_out:
        journal.path.unlink()  # nothing to go on with
    return turned


def _write_models(
    folder: Path,
    solution: Solution,
    rec: Reconstruction,
    turns: Mapping[str, int],
    options: RunOptions,
    left_out: Mapping[str, str],
    rgb: NDArray[np.uint8] | None = None,
) -> Solution:
    """Write the models for COLMAP and nerfstudio; returns the solution as they have it, turned."""
    if turns:
        solution, rec = turn_solution(solution, turns), turn_reconstruction(rec, turns)
    names = [None if name in left_out else output_name(name, options.raw_as) for name in rec.image_names]
    new_cameras = [solution.rectified_cameras[str(k + 1)] for k in range(len(rec.cameras))]
    write_colmap_model(folder / "sparse", rec, new_cameras, names, rgb)
    masks = mask_names([image.name for image in solution.images])
    files = {
        name: (f"images/{written}", f"masks/{masks[name]}")
        for name, written in zip(rec.image_names, names, strict=True)
        if written is not None
    }
    write_transforms(folder / "transforms.json", solution, files)
    return solution


def _readouts(rec: Reconstruction, cameras: PhotoCameras) -> str | dict[str, str]:
    """Direction of the readout of all cameras, or by group where they differ."""
    directions = {label: camera.readout for label, camera in zip(cameras.labels, rec.cameras, strict=True)}
    return rec.cameras[0].readout if len(set(directions.values())) == 1 else directions


def _guesses(solved: Solved, cameras: PhotoCameras) -> list[str]:
    """What was guessed of the cameras, and what the photos said of it, for people."""
    choice = solved.readouts
    found = [] if choice is None else choice.turned
    said = [] if found else list(cameras.notes)
    for k in found:
        assert choice is not None
        said.append(
            f"{cameras.labels[k]} fits better as read out {choice.reconstruction.cameras[k].readout} "
            f"(by {choice.gain[k]:.0f} standard errors); --readout settles it"
        )
    return said


def _image_rms(rec: Reconstruction) -> NDArray[np.float64]:
    """(m,) root mean square residual of each photo in pixels."""
    res, valid = reprojection_residuals(rec)
    frame = rec.observations.frame_idx[valid]
    square = np.bincount(frame, np.mean(res[valid] ** 2, axis=1), minlength=rec.num_images)
    return np.sqrt(square / np.maximum(np.bincount(frame, minlength=rec.num_images), 1))


def _critical(solved: Solved) -> dict[str, Any]:
    """What `solution.json` says of critical motions."""
    remedy = solved.remedy
    assert remedy is not None
    after = remedy.after
    return {
        "singular_values": after.meter.singular_values.tolist(),
        "null_vector": after.meter.null_vector.tolist(),
        "y_axis_spread_deg": after.meter.y_axis_spread_deg,
        "meaning": after.meter.meaning,
        "sigma_log_k": after.sigma_log_k,
        "sigma_log_k_before": remedy.before.sigma_log_k,
        "weakest_sigma": after.weakest_sigma,
        "weakest_share": after.weakest_share,
        "flagged": after.is_flagged,
        "remedy": remedy.name,
        "anchors": dict(remedy.anchors),
        "sentence": remedy.sentence,
        "warnings": list(remedy.warnings),
        "advice": [each.sentence for each in solved.advice],
    }


def _solution(
    loaded: LoadedPhotos,
    solved: Solved,
    options: RunOptions,
    readouts: Mapping[int, tuple[float, str]],
    video: dict[str, Any] | None,
) -> Solution:
    """The solution of an adjusted reconstruction, with every photo of the folder in it."""
    rec = solved.result.reconstruction
    rms = _image_rms(rec)
    counts = np.bincount(rec.observations.frame_idx, minlength=rec.num_images)
    cameras = {str(k + 1): camera for k, camera in enumerate(rec.cameras)}
    places = {name: i for i, name in enumerate(rec.image_names)}
    images = []
    for name in sorted([*loaded.names, *loaded.skipped]):
        if name in loaded.skipped:
            images.append(SolvedImage(name, "1", reason=loaded.skipped[name]))
        elif name not in places:
            images.append(SolvedImage(name, "1", reason="shares too little with the other photos"))
        else:
            i = places[name]
            images.append(
                SolvedImage(
                    name=name,
                    camera_id=str(int(rec.camera_idx[i]) + 1),
                    R_cw=rec.R_cw[i],
                    center_w=rec.center_w[i],
                    motion=rec.motion(i),
                    sigma_phi=None if rec.shutter_model == "global" else solved.result.sigma_phi[i],
                    num_observations=int(counts[i]),
                    rms_px=float(rms[i]),
                    rs_shift_px=largest_shift_px(rec.camera(i), rec.motion(i), rec.shutter_model),
                )
            )
    quality = {
        "num_points": rec.num_points,
        "num_observations": len(rec.observations),
        "rms_px": solved.result.rms_px,
        "global_rms_px": solved.global_result.rms_px,
        "held_out_rms_px": {} if solved.choice is None else solved.choice.held_out_rms_px,
        "sigma_intrinsics": dict(zip(cameras, solved.result.sigma_intrinsics, strict=True)),
        "phi_sigma_rad_per_frame": solved.result.phi_sigma,
        "stop_reason": solved.result.stop_reason,
        "readout_times": {str(k + 1): {"ms": 1e3 * s, "source": source} for k, (s, source) in readouts.items()},
    }
    return Solution(
        shutter_model=rec.shutter_model,
        cameras=cameras,
        # same size and K, so that raw and rectified compare pixel by pixel
        rectified_cameras={key: camera.pinhole() for key, camera in cameras.items()},
        images=tuple(images),
        quality=quality,
        critical_motion=None if solved.remedy is None else _critical(solved),
        options={
            "camera": loaded.cameras.source,
            "shutter_model": options.shutter_model,
            "readout": _readouts(rec, loaded.cameras),
            "guesses": _guesses(solved, loaded.cameras),
            "seed": options.seed,
            "max_features": options.max_features,
            "interpolation": options.interpolation,
            "quality": options.quality,
            "raw_as": options.raw_as,
            "refine": list(solved.result.sigma_intrinsics[0]),
            "still": dict(options.still),
            "known": sorted(options.known),
            "lengths": len(options.lengths),
            "remedy": options.remedy,
            "depth": str(options.depth),
            "video": video,
            "gyro": options.gyro and options.gyro.facts(),
        },
        generator=versions(),
    )
