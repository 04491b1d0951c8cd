"""Outputs of a sample scene in seconds: its true tracks, measured with noise, instead of features."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsundistort import Observations, Reconstruction, RectifyOptions, Solution, SolveOptions, read_solution
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.input.photo_cameras import PhotoCameras
from rsundistort.io import output_folder
from rsundistort.solve import OutputOptions
from rsundistort.solve.model_sequence import solve_tracks
from rsundistort.solve.run_outputs import Outputs

SCENES = Path(__file__).parent.parent / "sample_scenes"


def cameras_of(rec: Reconstruction) -> PhotoCameras:
    """The cameras of a reconstruction, as if a file had specified them."""
    count = len(rec.cameras)
    labels = tuple(f"camera {k}" for k in range(count))
    return PhotoCameras(tuple(rec.cameras), labels, rec.camera_idx, True, (True,) * count, "camera.json")


def solve_scene(
    name: str, out: Path, *, unwarped: bool = False, maps: str | None = None, report: bool = True, **options
) -> Solution:
    """What `run` would write of a sample scene, or of its global-shutter reference; `options` as of `SolveOptions`."""
    asked = SolveOptions(**options)
    truth, tracks = read_solution(SCENES / name / "ground_truth.json"), np.load(SCENES / name / "tracks.npz")
    xy = tracks["xy_global" if unwarped else "xy_raw"]
    seen = np.isfinite(xy).all(1)
    xy = xy + np.random.default_rng(0).normal(0, 0.2, xy.shape)
    camera = truth.cameras["1"]
    rec = Reconstruction(
        [camera], tracks["image_names"].tolist(), np.zeros(len(tracks["R_cw"]), int), tracks["R_cw"],
        tracks["center_w"], tracks["points_w"],
        Observations(tracks["frame_idx"][seen], tracks["point_idx"][seen], xy[seen]),
    )  # fmt: skip
    cameras, log = cameras_of(rec), StageLog(None)
    solved = solve_tracks(rec, cameras, asked.shutter_model, 0, lambda _: asked.options_for(cameras), log, asked.remedy)
    outputs = Outputs.of_solved(solved, asked, RectifyOptions(maps=maps), OutputOptions(report=report), {})
    with output_folder(out) as scratch:
        outputs.begin(scratch, log)
    return outputs.rectify(SCENES / name / ("global" if unwarped else "photos"), out, Workers(2), log)
