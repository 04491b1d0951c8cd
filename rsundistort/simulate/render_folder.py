"""Photos of a synthetic scene, with everything that is true about them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..batch.progress import ProgressCallback, StageLog
from ..batch.workers import use_threads
from ..errors import InputError
from ..io import output_folder, write_solution
from ..io.cameras import camera_to_json
from ..io.record import Record
from ..io.video_writer import write_video
from ..model import Solution, SolvedImage
from ..synthetic import (
    Recipe,
    TruePoints,
    View,
    add_noise,
    check_recipe,
    load_recipe,
    render_depth,
    render_view,
    true_points,
)
from ..synthetic import rs_shift_px as shift_in_scene

__all__ = ["SceneOptions", "simulate_scene"]

# What is written besides the photos and depth maps.
_FILES = ("tracks.npz", "ground_truth.json")


@dataclass(frozen=True)
class SceneOptions:
    """Options of `simulate_scene`.

    Parameters
    ----------
    depth : bool
        Whether depth maps are written; they take more room than all the rest.
    jobs, overwrite
        As in `RunOptions`.
    """

    depth: bool = True
    jobs: int = 0
    overwrite: bool = False


def simulate_scene(
    recipe: Path | str | Recipe,
    out: Path | str,
    options: SceneOptions | None = None,
    progress: ProgressCallback | None = None,
) -> Solution:
    """Render a recipe: rolling-shutter photos and what is true about them.

    Writes `photos/`, or of a recipe whose path is that of a video `clip.mp4`; `global/`, their global-shutter
    references, from the pose of the principal row, without noise and blur, of a video of some frames only; `depth/` and
    `global-depth/` of what has references (float32 TIFF, z in the camera at the moment of the pixel's line, inf where
    nothing is); `tracks.npz` (points on the surfaces with the pixels that show them; keys as in `TruePoints`, with `K`,
    `width`, `height`, `R_cw`, `center_w`, `image_names` of the photos); `camera.json`, or `cameras.json` where there
    are several; `ground_truth.json`; and the recipe with the files that it names. The same recipe gives the same bytes.

    Parameters
    ----------
    recipe : path or Recipe
        What to render.
    out : path
        Folder for the outputs; it gets all of them or stays as it was.
    options : SceneOptions, optional
        See there.
    progress : callable, optional
        Called as (stage, done, total).

    Returns
    -------
    Solution
        The truth.

    Raises
    ------
    InputError
        When the recipe makes no sense: a camera in a wall, a surface behind every camera, rows that fold over.
    """
    options = options or SceneOptions()
    source = None if isinstance(recipe, Recipe) else Path(recipe)
    loaded = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    out = Path(out)
    log = StageLog(progress)
    use_threads(options.jobs)
    log.begin("checking")
    check_recipe(loaded)
    log.end("checking")
    read = {} if source is None else {"recipe.json": source, **{name: source.parent / name for name in loaded.files}}
    # a recipe is also rendered where it was copied to
    copied = {name: file for name, file in read.items() if not ((out / name).exists() and file.samefile(out / name))}
    references = {view.name for view in loaded.references}
    folders = (*(() if loaded.clip else ("photos",)), "global", *(("depth", "global-depth") if options.depth else ()))
    with output_folder(out, overwrite=options.overwrite, apart_from=list(read.values())) as scratch:
        made = [
            f"{folder}/{_file_of(loaded, folder, view.name)}"
            for folder in folders
            for view in loaded.views
            if folder == "photos" or view.name in references
        ]
        clip = [] if loaded.clip is None else [loaded.clip.NAME]
        Record(out).check([*made, *clip, *_FILES, _cameras_file(loaded), *copied], read.values())
        log.begin("points")
        points = true_points(loaded)
        log.end("points")
        for folder in folders:
            (scratch / folder).mkdir()
        log.begin("rendering", len(loaded.views))
        _write_photos(scratch, loaded, references, options.depth, log)
        log.end("rendering")
        truth = _truth(loaded, points)
        _write_cameras(scratch, loaded)
        arrays: dict[str, Any] = _tracks(loaded, points)
        np.savez_compressed(scratch / "tracks.npz", **arrays)
        write_solution(scratch / "ground_truth.json", truth)
        for name, file in copied.items():
            (scratch / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, scratch / name)
    return truth


def _write_photos(folder: Path, recipe: Recipe, references: set[str], depth: bool, log: StageLog) -> None:
    """The photos, or the video, with the references and depth maps of those that have them."""

    def rendered() -> Iterator[tuple[View, NDArray[np.uint8]]]:
        """The photos, whose references and depth maps are written meanwhile."""
        for number, view in enumerate(recipe.views):
            yield view, add_noise(_render(recipe, view), recipe.noise, recipe.scene.seed, number)
            if view.name in references:
                _write_reference(folder, recipe, view, depth)
            log.tell("rendering", number + 1, len(recipe.views))

    if recipe.clip is not None:
        write_video(folder / recipe.clip.NAME, (photo for _, photo in rendered()), recipe.clip.fps)
    else:
        for view, photo in rendered():
            (folder / "photos" / view.name).write_bytes(_encode_jpeg(photo, recipe.jpeg_quality))


def _render(recipe: Recipe, view: View) -> NDArray[np.uint8]:
    return render_view(recipe.scene, recipe.camera(view), view, **recipe.render_options)


def _write_reference(folder: Path, recipe: Recipe, view: View, depth: bool) -> None:
    """The global-shutter reference of a photo, and the depth maps of both."""
    reference = view.at_once()
    photo = _encode_jpeg(_render(recipe, reference), recipe.jpeg_quality)
    (folder / "global" / _file_of(recipe, "global", view.name)).write_bytes(photo)
    if depth:
        for to, each in (("depth", view), ("global-depth", reference)):
            values = render_depth(recipe.scene, recipe.camera(view), each)
            (folder / to / _file_of(recipe, to, view.name)).write_bytes(bytes(cv2.imencode(".tif", values)[1]))


def _file_of(recipe: Recipe, folder: str, name: str) -> str:
    """Name of a photo's file in a folder: depth maps are TIFF, references of a clip's frames JPEG, since smaller."""
    suffix = ".tif" if "depth" in folder else ".jpg" if recipe.clip else Path(name).suffix
    return Path(name).with_suffix(suffix).name


def _truth(recipe: Recipe, points: TruePoints) -> Solution:
    """The ground truth in the format of a solution; no times and dates, which would change its bytes."""
    moves = any(view.motion.moves for view in recipe.views)
    counts = np.bincount(points.frame_idx, minlength=len(recipe.views))
    images = tuple(
        SolvedImage(
            view.name,
            view.camera_id,
            view.R_cw,
            view.center_w,
            view.motion,
            num_observations=int(number),
            rs_shift_px=shift_in_scene(recipe.scene, recipe.camera(view), view),
        )
        for view, number in zip(recipe.views, counts, strict=True)
    )
    options: dict[str, Any] = {"simulation": "scene", "recipe": recipe.name, "seed": recipe.scene.seed}
    quality: dict[str, Any] = {"num_points": len(points.points_w), "num_observations": len(points.frame_idx)}
    if recipe.readout_ms is not None:
        options["readout_ms"] = recipe.readout_ms
    if (clip := recipe.clip) is not None:
        options["video"] = {"name": clip.NAME, "fps": float(clip.fps), "time_s": clip.time_s}
        quality["readout_time"] = {"seconds": clip.readout_s, "sigma": 0.0, "source": "recipe"}
    return Solution(
        shutter_model="constant-motion" if moves else "rotation",
        cameras=recipe.cameras,
        rectified_cameras={key: camera.pinhole() for key, camera in recipe.cameras.items()},
        images=images,
        quality=quality,
        options=options,
        generator={"rsundistort": version("rsundistort")},
    )


def _tracks(recipe: Recipe, points: TruePoints) -> dict[str, NDArray[Any]]:
    cameras = [recipe.camera(view) for view in recipe.views]
    same = len(recipe.cameras) == 1
    return {
        "image_names": np.array([view.name for view in recipe.views]),
        "K": cameras[0].K if same else np.array([camera.K for camera in cameras]),
        "width": np.array(cameras[0].width if same else [camera.width for camera in cameras]),
        "height": np.array(cameras[0].height if same else [camera.height for camera in cameras]),
        "R_cw": np.array([view.R_cw for view in recipe.views]),
        "center_w": np.array([view.center_w for view in recipe.views]),
        "points_w": points.points_w,
        "frame_idx": points.frame_idx,
        "point_idx": points.point_idx,
        "xy_raw": points.xy_raw,
        "xy_global": points.xy_global,
    }


def _cameras_file(recipe: Recipe) -> str:
    return "camera.json" if len(recipe.cameras) == 1 else "cameras.json"


def _write_cameras(folder: Path, recipe: Recipe) -> None:
    """`camera.json`, or all cameras with the photos they took."""
    if len(recipe.cameras) == 1:
        value = camera_to_json(next(iter(recipe.cameras.values())))
    else:
        value = {
            "cameras": {key: camera_to_json(camera) for key, camera in recipe.cameras.items()},
            "images": {view.name: view.camera_id for view in recipe.views},
        }
    (folder / _cameras_file(recipe)).write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def _encode_jpeg(photo: NDArray[np.uint8], quality: int) -> bytes:
    """The JPEG file of a BGR photo; the same bytes for the same pixels, quality and libjpeg."""
    # chroma at full size: halved, it alone costs 2 dB
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, data = cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling])
    if not done:
        raise InputError(f"a photo of {photo.shape[1]}x{photo.shape[0]} pixels cannot be written as JPEG")
    return bytes(data)
