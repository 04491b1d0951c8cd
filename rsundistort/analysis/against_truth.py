"""A run's outputs against the truth: poses, motions and images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..batch.many_photos import mask_names
from ..batch.progress import ProgressCallback, StageLog
from ..errors import FileError, InputError
from ..evaluation import motion_errors, pose_errors, psnr
from ..io import output_name, read_photo, read_solution
from ..model import Camera, RowMotion, Solution, SolvedImage
from ..model.array_types import Array
from ..model.orientation import INVERSE, in_stored_frame, orient_pixels
from ..rectify import rectify
from .results import ErrorSummary, Evaluation, PhiErrorSummary, PsnrSummary

__all__ = ["evaluate"]

# Focal lengths that differ by this share are of views that somebody chose, not of what was found of one.
_OTHER_VIEW = 0.01


def _summary(values: Array) -> ErrorSummary:
    return ErrorSummary(float(np.mean(values)), float(np.median(values)), float(np.max(values)))


def _psnr_summary(photos: Mapping[str, float]) -> PsnrSummary | None:
    if not photos:
        return None
    values = list(photos.values())
    return PsnrSummary(float(np.median(values)), float(np.min(values)), photos)


def evaluate(
    out: Path | str,
    truth: Path | str,
    *,
    poses: Path | str | None = None,
    twins: Path | str | None = None,
    raw: Path | str | None = None,
    progress: ProgressCallback | None = None,
) -> Evaluation:
    """Compare the outputs of a run with the truth.

    Parameters
    ----------
    out : path
        Folder that a run wrote.
    truth : path
        Ground-truth file: motions, and poses if known.
    poses : path, optional
        Solution to take the true poses from, e.g. of the same photos without motion.
    twins : path, optional
        Folder of global-shutter photos of the same names (or JPEG files of the same stems), taken by the same camera: a
        lens is taken out of them before the comparison, and they are brought to another view or size. `global` beside
        the truth file when there is one. Photos without a reference are not compared, if any has one.
    raw : path, optional
        Folder of the photos that were rectified, for the figure before, which leaves out what the rectified photo does
        not show, if that is of the same size; `photos` beside the truth file.
    progress : callable, optional
        Called as (stage, done, total).

    Returns
    -------
    Evaluation
        Errors of poses, motions and images; None where there is nothing to compare with.
    """
    out, truth = Path(out), Path(truth)
    written, true_solution = read_solution(out / "solution.json"), read_solution(truth)
    solution = in_stored_frame(written)
    orientations = {image.name: image.applied_orientation for image in written.images}
    rotation = center = after = before = None
    pose_truth = read_solution(Path(poses)) if poses is not None else true_solution
    if any(image.posed for image in pose_truth.images):
        errors = pose_errors(solution, pose_truth)
        rotation = _summary(errors.rotation_deg)
        # none where all cameras are in one place
        center = _summary(errors.center) if np.isfinite(errors.center).all() else None
    phi = np.abs(motion_errors(solution, true_solution).phi_rad_per_frame) * 1e3
    x, y, z = phi.mean(0).tolist()
    folders = {"twins": (twins, truth.parent / "global"), "raw": (raw, truth.parent / "photos")}
    chosen = {k: Path(given) if given is not None else default for k, (given, default) in folders.items()}
    for key, (given, _) in folders.items():
        if given is not None and not chosen[key].is_dir():
            raise FileError(f"{chosen[key]} is no folder; --{key} takes a folder of photos")
    if chosen["twins"].is_dir():
        after, before = _image_errors(out, solution, orientations, true_solution, chosen, StageLog(progress))
    return Evaluation(
        photos=len(solution.images),
        registered=len(solution.registered),
        rotation_deg=rotation,
        center=center,
        phi_mrad_per_frame=PhiErrorSummary(**asdict(_summary(phi)), mean_per_component=(x, y, z)),
        psnr_db=after,
        psnr_before_db=before,
    )


def _reference_path(folder: Path, name: str) -> Path:
    """Where the reference of a photo is: a frame of a video is called as a PNG file, its reference may be a JPEG."""
    path = folder / output_name(name)
    small = path.with_suffix(".jpg")
    return small if small.is_file() and not path.is_file() else path


def _as_rectified(
    reference: NDArray[Any], image: SolvedImage, solution: Solution, truth: Solution
) -> tuple[NDArray[Any], NDArray[np.uint8]]:
    """A global-shutter photo as the rectified camera would have taken it, and the mask of what it shows.

    One of a pinhole camera stays as it is if it shows the same view: what focal length was found is part of the error.
    """
    by_name = {each.name: each for each in truth.images}
    taken_by = truth.cameras[by_name[image.name].camera_id] if image.name in by_name else None
    rectified = solution.rectified_cameras[image.camera_id]
    whole = np.full(reference.shape[:2], 255, np.uint8)
    if taken_by is None or (taken_by.is_pinhole and _same_view(taken_by, rectified)):
        return reference, whole
    return rectify(reference, taken_by, RowMotion(), "global", rectified)


def _same_view(camera: Camera, other: Camera) -> bool:
    same_size = (camera.width, camera.height) == (other.width, other.height)
    return same_size and bool(np.allclose(np.diag(camera.K), np.diag(other.K), rtol=_OTHER_VIEW))


def _check_sizes(photo: NDArray[Any], mask: NDArray[Any], shown: NDArray[np.uint8]) -> None:
    """Refuse a mask or a reference of another size than the photo."""
    for what, other in (("mask", mask.shape), ("reference", shown.shape)):
        if other != photo.shape[:2]:
            raise InputError(
                f"the {what} has the shape {other}, the rectified photo {photo.shape[:2]}; give those of one camera"
            )


def _image_errors(
    out: Path,
    solution: Solution,
    orientations: Mapping[str, int],
    truth: Solution,
    folders: Mapping[str, Path],
    log: StageLog,
) -> tuple[PsnrSummary | None, PsnrSummary | None]:
    """Signal-to-noise ratios of the rectified photos against their references, and of the photos before."""
    twins, raw = folders["twins"], folders["raw"]
    masks = mask_names([image.name for image in solution.images])
    raw_as = solution.options.get("raw_as", "tif")
    after: dict[str, float] = {}
    before: dict[str, float] = {}
    reference_of = {image.name: _reference_path(twins, image.name) for image in solution.registered}
    some = any(path.is_file() for path in reference_of.values())
    registered = [image for image in solution.registered if reference_of[image.name].is_file() or not some]
    log.begin("comparing", len(registered))
    for done, image in enumerate(registered, start=1):
        taken = read_photo(reference_of[image.name]).pixels
        files = out / "images" / output_name(image.name, raw_as), out / "masks" / masks[image.name]
        photo, mask = (orient_pixels(read_photo(path).pixels, INVERSE[orientations[image.name]]) for path in files)
        try:
            reference, shown = _as_rectified(taken, image, solution, truth)
            _check_sizes(photo, mask, shown)
            after[image.name] = psnr(photo, reference, np.minimum(mask, shown))
            if (raw / image.name).is_file():
                # photo and reference have the same lens
                counts = mask if mask.shape == taken.shape[:2] else None
                before[image.name] = psnr(read_photo(raw / image.name).pixels, taken, counts)
        except InputError as error:
            raise InputError(f"{image.name}: {error}") from error
        log.tell("comparing", done, len(registered))
    return _psnr_summary(after), _psnr_summary(before)
