"""Strong shutters: which photos are registered and how well, and relative poses of pairs beside those of others.

    python benchmarks/strong.py [--photos DIR] [--only PART ...] [--sets SET ...] [--rad R ...] [--seeds N]
                                [--first-seed K] [--work DIR] [--no-photos]
                                [--before CHECKOUT]

Prints one JSON object a line and at the end a table. Parts:

    sets      herz-jesus-8 and dslr warped by --rad (0.10, 0.15, 0.20, 0.30) radians a frame (standard deviation of
              each component of phi): photos registered, those that are wrong by more than 1 degree against the photos
              as they are, errors of the rotations, and of the places over their extent, dB against references with the
              lens found. A warp whose rows fold over is no photo that a camera can take: its seed is passed over, and
              said
    pairs     relative poses of all pairs of the same warps, and of the photos as they are: area under the curve of the
              larger of the errors of rotation and direction up to 5 degrees, on the same matches, of five points
              (OpenCV's USAC, 4 px), of pycolmap, and ours
    limit     the bound that the measurements of a set impose: those of the photos as they are, each moved as the warp
              moves it, adjusted from the true poses and motions with the intrinsics in the estimate. No match is lost
              or wrong; rotations and dB as above
    matches   the bound that the matches of each warp impose: their tracks by the poses of the photos as they are and
              the true motions, how many photos these connect (`sfm.firmly_connected`), and the adjustment of these
              tracks from the true poses and motions; and what mapping registers with the pairs as they were verified
              and the true motions taken out of the keypoints
    search    the same tracks without one photo, in turns: the motions that a search finds of it, and which photos have
              none even if their true motions are those that it tries
    fountain  fountain-small with its velocity three times as large
    weak      processor time of `run` on herz-jesus-8 as it is and warped by 0.02 rad, of this state over that of the
              checkout --before, by turns, and whether both write the same solution; without --before it is left out

Exits 1 if one crashes, never because a figure misses its target (photos right >= 90 %, none wrong and not named; 0.1
deg and 38 dB up to 0.20).
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from measures import fountain_truth, moved_photo, run_options, with_lens_of
from scipy.spatial.transform import Rotation

import rsundistort as rs
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.bundle import bundle_adjust
from rsundistort.colmap.conventions import quiet_pycolmap
from rsundistort.errors import InputError
from rsundistort.evaluation import psnr
from rsundistort.input import motion_search
from rsundistort.input.load import LoadedPhotos, load_photos
from rsundistort.input.motion_search import search_motions
from rsundistort.input.photo_cameras import camera_file_of
from rsundistort.io import read_photo
from rsundistort.io.cameras import camera_to_json
from rsundistort.model.similarity import fit_similarity
from rsundistort.sfm import (
    MatchedPhotos,
    firmly_connected,
    map_photos,
    match_photos,
    retriangulate,
    verify_with_shutter,
)
from rsundistort.sfm.epipolar import read_matches
from rsundistort.sfm.relative_pose import Pair, View, relative_poses
from rsundistort.simulate import WarpOptions, simulate_warp
from rsundistort.solve.run_outputs import Outputs

ROOT = Path(__file__).resolve().parent.parent
# RANSAC draws at random: areas of others are means of so many draws.
DRAWS = 6
PARTS, SETS = ("sets", "pairs", "limit", "matches", "search", "fountain", "weak"), ("herz-jesus-8", "dslr")
RADIANS = (0.10, 0.15, 0.20, 0.30)
COLUMNS = ("set", "rad", "seed", "registered", "right", "wrong", "deg", "worst", "dB", "least", "before", "s")
DB = ("dB", "least_dB", "before_dB")
WRONG_DEG, AUC_DEG, LEAST_MATCHES = 1.0, 5.0, 30


def show(name: str, **figures: Any) -> None:
    """Print one JSON line."""
    print(json.dumps({"name": name, **figures}), flush=True)


def rotation_errors(solution: rs.Solution, still: rs.Solution) -> dict[str, float]:
    """Degrees by photo, see `rotations_off`."""
    truth = {image.name: image.R_cw for image in still.registered}
    images = [image for image in solution.registered if image.name in truth]
    errors = rotations_off([image.R_cw for image in images], [truth[image.name] for image in images])
    return dict(zip([image.name for image in images], errors.tolist(), strict=True))


def rotations_off(R_cw: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> np.ndarray:
    """Degrees, after the common rotation that most photos agree on: a wrong one does not move the others."""
    steps = Rotation.from_matrix(np.einsum("mji,mjk->mik", np.array(truth), np.array(R_cw)))
    common = steps.mean()
    for _ in range(50):
        off = (steps * common.inv()).magnitude()
        common = steps.mean(1.0 / np.maximum(off, 1e-4))
    return np.degrees((steps * common.inv()).magnitude())


def places_off(solution: rs.Solution, still: rs.Solution) -> dict[str, float]:
    """How far each photo is from its place, over the extent of all places, after the similarity that most agree on."""
    truth = {image.name: image.center_w for image in still.registered}
    images = [image for image in solution.registered if image.name in truth]
    found, true = (np.array(each) for each in zip(*((i.center_w, truth[i.name]) for i in images), strict=True))
    extent = float(np.linalg.norm(np.ptp(true, axis=0)))
    moved = fit_similarity(found, true, np.full(true.shape, 1e-3 * extent)).similarity.of(found)
    off = np.linalg.norm(moved - true, axis=1) / extent
    return dict(zip([image.name for image in images], off.tolist(), strict=True))


class Bench:
    """Photos, the folder of work, and what came of it."""

    def __init__(self, photos: Path, work: Path, *, rectifies: bool = True) -> None:
        self.photos, self.work, self.rectifies = photos, work, rectifies
        self.rows: list[tuple[str, ...]] = []
        self.failed: list[str] = []
        self._still: dict[str, rs.Solution] = {}
        self._measured: dict[str, tuple[rs.Reconstruction, rs.BundleOptions]] = {}

    def still(self, name: str) -> rs.Solution:
        """Solution of the photos as they are."""
        if name not in self._still:
            out, module = self.work / f"{name}-still", importlib.import_module("rsundistort.solve.run")
            solve = module.solve_photos

            def kept(*args: Any, **more: Any) -> Any:
                solved = solve(*args, **more)
                self._measured[name] = solved.shared, args[3](solved.shared)
                return solved

            with mock.patch.object(module, "solve_photos", kept):
                options = run_options(shutter_model="global")
                self._still[name] = rs.run(self.photos / name, out, options, overwrite=True)
        return self._still[name]

    def warped(self, name: str, radians: float, seed: int) -> Path | None:
        """Folder of warped photos; None where rows fold over."""
        out = self.work / f"{name}-{radians}-{seed}"
        if not (out / "ground_truth.json").is_file():
            options = WarpOptions(self._camera(name), sigma_rad=radians, seed=seed, overwrite=True)
            try:
                simulate_warp(self.photos / name, out, options)
            except InputError as error:
                show(f"{name} by {radians}, seed {seed}", passed_over=str(error))
                return None
        return out

    def _camera(self, name: str) -> str | None:
        """The camera of a set: the file beside its photos, or what the solution of the photos as they are found.

        EXIF's focal length is off by 4 % for dslr: what such a camera makes of a rotation no rotation makes of these
        photos, by 4 px at 0.20 rad.
        """
        if camera_file_of(self.photos / name, None) is not None:
            return None
        path = self.work / f"{name}-camera.json"
        path.write_text(json.dumps(camera_to_json(next(iter(self.still(name).cameras.values())))))
        return str(path)

    def register(self, name: str, radians: float, seed: int) -> None:
        """One run on one warp."""
        folder = self.warped(name, radians, seed)
        if folder is None:
            return
        still, start = self.still(name), time.perf_counter()
        try:
            with nullcontext() if self.rectifies else mock.patch.object(Outputs, "rectify", _as_solved):
                solution = rs.run(folder / "photos", folder / "run", run_options(), overwrite=True)
            seconds = time.perf_counter() - start
            dB = self._of_photos(name, folder) if self.rectifies else {}
        except Exception as error:
            show(f"{name} by {radians}, seed {seed}", crash=f"{type(error).__name__}: {error}")
            self.failed.append(name)
            return
        errors = rotation_errors(solution, still)
        named = {image.name for image in solution.images if image.doubtful or image.lens_only}
        wrong = sorted(photo for photo, error in errors.items() if error > WRONG_DEG)
        right, values = len(errors) - len(wrong), [*errors.values()]
        places = [*places_off(solution, still).values()]
        show(
            f"{name} by {radians}, seed {seed}", registered=len(solution.registered), photos=len(solution.images),
            of_still=len(still.registered), right=right, wrong={photo: round(errors[photo], 2) for photo in wrong},
            wrong_and_not_named=sorted({*wrong} - named), median_deg=round(float(np.median(values)), 4),
            max_deg=round(max(values), 4), median_place=round(float(np.median(places)), 4),
            worst_place=round(max(places), 4), **dB, model=solution.quality["held_out_chosen"],
            verdict=[solution.verdict["shutter"], solution.verdict["shape"]], seconds=round(seconds, 1),
        )  # fmt: skip
        self.rows.append((
            name, str(radians), str(seed), f"{len(solution.registered)}/{len(solution.images)}",
            f"{right}/{len(still.registered)}", f"{len(wrong)}, {len({*wrong} - named)} not named",
            f"{np.median(values):.3f}", f"{max(values):.3f}", *(f"{dB[key]:.1f}" if dB else "" for key in DB),
            f"{seconds:.0f}",
        ))  # fmt: skip

    def _of_photos(self, name: str, folder: Path) -> dict[str, float]:
        """Ratios in dB of the rectified photos of a run to the photos as they are, and of the warped ones."""
        found = rs.evaluate(
            folder / "run", with_lens_of(folder / "run", folder / "ground_truth.json"),
            poses=self.work / f"{name}-still" / "solution.json", twins=self.photos / name,
        )  # fmt: skip
        values = found.psnr_db.median, found.psnr_db.min, found.psnr_before_db.median
        return {key: round(value, 2) for key, value in zip(DB, values, strict=True)}

    def limit(self, name: str, radians: float, seed: int) -> None:
        """The adjustment of right matches alone."""
        self.still(name)
        rec = self._measured[name][0]
        phi, xy = np.zeros((len(rec.image_names), 3)), rec.observations.xy_raw.copy()
        rng, camera_of = np.random.default_rng(seed), [rec.cameras[k] for k in rec.camera_idx]
        for f, mine in enumerate(rec.observations.by_photo(len(phi))):
            ideal = rs.undistort_points(xy[mine], camera_of[f], P=camera_of[f].K)
            moved = np.full_like(ideal, np.nan)
            while np.isnan(moved).any():  # rows that fold over
                phi[f] = rng.normal(0.0, radians, 3) / camera_of[f].frame_span
                moved = rs.distort_points(ideal, camera_of[f], rs.RowMotion(phi[f]), P=camera_of[f].K)
            xy[mine] = moved
        sizes = np.array([(camera.width, camera.height) for camera in camera_of])[rec.observations.frame_idx]
        inside = ((xy > -0.5) & (xy < sizes - 0.5)).all(axis=1)
        observations = replace(rec.observations, xy_raw=xy).select(inside)
        self._show_limit(f"limit of {name}", name, replace(rec, observations=observations), phi, radians, seed)

    def matches(self, name: str, radians: float, seed: int) -> None:
        """The adjustment of what the matches of one warp connect by true poses and motions."""
        folder = self.warped(name, radians, seed)
        if folder is None:
            return
        with self._right_matches(name, folder) as (_, matched, rec, phi_of):
            self._show_mapped(name, map_photos(matched), radians, seed)
            tracks = firmly_connected(retriangulate(matched, rec))
        obs, phi = tracks.observations, np.array([phi_of[photo] for photo in tracks.image_names])
        xy = obs.xy_raw.copy()
        for f, mine in enumerate(obs.by_photo(len(phi))):
            xy[mine] = _moved(xy[mine], rec.cameras[tracks.camera_idx[f]], rs.RowMotion(), rs.RowMotion(phi[f]))
        tracks = replace(tracks, observations=replace(obs, xy_raw=xy))
        self._show_limit(f"right matches of {name}", name, tracks, phi, radians, seed)

    def search(self, name: str, radians: float, seed: int) -> None:
        """Motions that a search finds of the photos of one warp, by what the others show."""
        folder = self.warped(name, radians, seed)
        if folder is None:
            return
        apart, hidden, seconds = {}, [], 0.0
        with self._right_matches(name, folder) as (loaded, matched, rec, phi_of):
            tracks = retriangulate(matched, rec)
            index = [loaded.names.index(photo) for photo in tracks.image_names]
            features, of = [matched.features[k] for k in index], matched.camera_idx[index]
            loaded = replace(loaded, names=list(tracks.image_names))
            matched = replace(matched, names=tracks.image_names, features=features, camera_idx=of)
            for f, photo in enumerate(tracks.image_names):
                scene = tracks.take_photos(np.arange(tracks.num_images) != f)
                find = partial(search_motions, loaded, matched, scene, 1.0, Workers(2), StageLog(None))
                start, phi = time.perf_counter(), find().get(photo, np.full(3, np.nan))
                seconds += time.perf_counter() - start
                apart[photo] = float(np.linalg.norm(phi - phi_of[photo]) * tracks.camera(f).frame_span)
                others = motion_search.tried_motions(tracks.camera(f))[1:]
                true = [phi_of[photo][None], *(each[:0] for each in others)]
                with mock.patch.object(motion_search, "tried_motions", lambda *_, true=true: true):
                    hidden += [] if find() else [photo]
        off = np.array([each for each in apart.values() if np.isfinite(each)])
        lost = sorted(photo for photo, each in apart.items() if not np.isfinite(each))
        show(
            f"search of {name} by {radians}, seed {seed}", photos=len(apart), found=len(off),
            median_rad=round(float(np.median(off)), 4), max_rad=round(float(off.max()), 4), seconds=round(seconds, 1),
            not_found=lost, not_by_true_motions=hidden,
        )  # fmt: skip
        self.rows.append((
            f"search of {name}", str(radians), str(seed), f"{len(off)}/{len(apart)}", "", "",
            f"{np.median(off):.4f} rad", f"{off.max():.4f} rad", "", "", "", f"{seconds:.0f}",
        ))  # fmt: skip

    @contextmanager
    def _right_matches(
        self, name: str, folder: Path
    ) -> Iterator[tuple[LoadedPhotos, MatchedPhotos, rs.Reconstruction, dict[str, np.ndarray]]]:
        """Photos of a warp, their keypoints where the photos as they were showed them, true poses, and motions."""
        self.still(name)
        rec = self._measured[name][0]
        truth = rs.read_solution(folder / "ground_truth.json")
        phi_of, of_warp = {image.name: image.motion.phi for image in truth.images}, next(iter(truth.cameras.values()))
        with tempfile.TemporaryDirectory() as work:
            loaded, matched = _load_and_match(folder / "photos", Path(work))
            still = [
                _moved(found.xy_raw, of_warp, rs.RowMotion(phi_of[photo]), rs.RowMotion())
                for photo, found in zip(loaded.names, loaded.features, strict=True)
            ]
            features = [replace(found, xy_raw=xy) for found, xy in zip(loaded.features, still, strict=True)]
            verify_with_shutter(matched)
            yield loaded, replace(matched, features=features, cameras=rec.cameras), rec, phi_of

    def _show_mapped(self, name: str, mapped: rs.Reconstruction, radians: float, seed: int) -> None:
        """What mapping makes of the matches of one warp, had it known the motions."""
        still = {image.name: image.R_cw for image in self.still(name).registered}
        found = {photo: R for photo, R in zip(mapped.image_names, mapped.R_cw, strict=True) if photo in still}
        errors = rotations_off([*found.values()], [still[photo] for photo in found])
        show(
            f"mapping of {name} by {radians}, seed {seed}, motions known", registered=len(found), of_still=len(still),
            wrong=int((errors > WRONG_DEG).sum()), max_deg=round(float(errors.max()), 2),
        )  # fmt: skip

    def _show_limit(
        self, title: str, name: str, tracks: rs.Reconstruction, phi: np.ndarray, radians: float, seed: int
    ) -> None:
        """The adjustment of measurements from true poses and motions phi (m, 3)."""
        rec, options = self._measured[name]
        start = replace(tracks, phi=phi, shutter_model="rotation")
        # the exposure of the photos as they are does not bound what moves them here
        free = replace(options, phi_limits={}, phi_sigma_most=None, velocity_sigma_most=None)
        found = bundle_adjust(start, "rotation", free).reconstruction
        R_cw = dict(zip(rec.image_names, rec.R_cw, strict=True))
        errors = rotations_off(found.R_cw, [R_cw[photo] for photo in found.image_names])
        dB = [
            psnr_between(
                read_photo(self.photos / name / photo).pixels, found.cameras[found.camera_idx[f]],
                rs.RowMotion(found.phi[f]), rs.RowMotion(phi[f]),
            )
            for f, photo in enumerate(found.image_names)
        ]  # fmt: skip
        wrong = int((errors > WRONG_DEG).sum())
        show(
            f"{title} by {radians}, seed {seed}", photos=len(phi), of_still=rec.num_images,
            measurements=len(tracks.observations), wrong=wrong, median_deg=round(float(np.median(errors)), 4),
            max_deg=round(float(errors.max()), 4), dB=round(float(np.median(dB)), 2), least_dB=round(min(dB), 2),
        )  # fmt: skip
        self.rows.append((
            title, str(radians), str(seed), f"{len(phi)}/{rec.num_images}", "", f"{wrong}",
            f"{np.median(errors):.3f}", f"{errors.max():.3f}", f"{np.median(dB):.1f}", f"{min(dB):.1f}",
        ))  # fmt: skip

    def pairs(self, name: str, radians: float, seed: int) -> None:
        """Relative poses of all pairs of one warp."""
        folder = self.photos / name if radians == 0 else self.warped(name, radians, seed)
        if folder is None:
            return
        still = {image.name: image for image in self.still(name).registered}
        with tempfile.TemporaryDirectory() as work:
            loaded, matched = _load_and_match(folder if radians == 0 else folder / "photos", Path(work))
            matches = read_matches(matched)
        cameras = loaded.cameras
        pairs, truth = [], []
        for (first, second), found in matches.items():
            names = loaded.names[first], loaded.names[second]
            if len(found) < LEAST_MATCHES or not still.keys() >= {*names}:
                continue
            one, other = (still[each] for each in names)
            truth.append((other.R_cw @ one.R_cw.T, other.R_cw @ (one.center_w - other.center_w)))
            views = [
                View.of(loaded.features[k].xy_raw[found[:, side]], cameras.cameras[cameras.camera_idx[k]])
                for side, k in enumerate((first, second))
            ]
            pairs.append(Pair(*views))
        start = time.perf_counter()
        ours, spread = relative_poses(pairs)
        seconds = time.perf_counter() - start
        solvers = {
            "five points": [[_five_points(pair, draw) for pair in pairs] for draw in range(DRAWS)],
            "pycolmap": [[_of_pycolmap(pair, draw) for pair in pairs] for draw in range(DRAWS)],
            "ours": [[None if pose is None else (pose.R_21, pose.t_21) for pose in ours]],
        }
        auc = {
            key: [_auc([_error(*each) for each in zip(found, truth, strict=True)]) for found in draws]
            for key, draws in solvers.items()
        }
        between = {key: [round(min(each), 3), round(max(each), 3)] for key, each in auc.items() if len(each) > 1}
        auc = {key: round(float(np.mean(each)), 3) for key, each in auc.items()}
        show(
            f"pairs of {name} by {radians}, seed {seed}", pairs=len(pairs), auc=auc, between=between,
            spread_rad=round(spread, 4), seconds_a_pair=round(seconds / len(pairs), 3),
        )  # fmt: skip
        self.rows.append(("pairs", str(radians), str(seed), name, *(f"{key} {value}" for key, value in auc.items())))


def _as_solved(outputs: Outputs, *_: Any) -> rs.Solution:
    """Instead of `Outputs.rectify`."""
    return outputs.solution


def _load_and_match(photos: Path, work: Path) -> tuple[LoadedPhotos, MatchedPhotos]:
    """Features and matches of a folder."""
    loaded = load_photos(photos, None, None, 8192, Workers(2), StageLog(lambda *_: None))
    cameras = loaded.cameras
    matched = match_photos(
        work / "database.db", loaded.names, loaded.features, cameras.cameras, cameras.camera_idx,
        calibrated=cameras.calibrated,
    )  # fmt: skip
    return loaded, matched


def _moved(xy: np.ndarray, camera: rs.Camera, motion: rs.RowMotion, to: rs.RowMotion) -> np.ndarray:
    """Pixels (n, 2) of a photo with a motion where a photo with another shows the same; far outside if nowhere."""
    ideal = rs.undistort_points(xy, camera, motion, P=camera.K)
    moved = rs.distort_points(ideal, camera, to, P=camera.K)
    return np.where(np.isfinite(moved), moved, -1e4)


def psnr_between(pixels: np.ndarray, camera: rs.Camera, found: rs.RowMotion, true: rs.RowMotion) -> float:
    """What is left of a photo in dB where a rectification takes one motion for another."""
    step, (height, width) = 16, pixels.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(0, width, step), np.arange(0, height, step)), axis=2).astype(float)
    shown = rs.distort_points(grid.reshape(-1, 2), camera, true, P=camera.K)
    shift = (rs.undistort_points(shown, camera, found, P=camera.K) - grid.reshape(-1, 2)).reshape(grid.shape)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    dx, dy = (cv2.remap(shift[..., k].astype(np.float32), x / step, y / step, cv2.INTER_LINEAR) for k in range(2))
    moved = cv2.remap(pixels, x + dx, y + dy, cv2.INTER_LANCZOS4, borderValue=(0, 0, 0))
    inside = (x + dx > 1) & (x + dx < width - 2) & (y + dy > 1) & (y + dy < height - 2)
    return float(psnr(moved, pixels, np.where(inside, 255, 0).astype(np.uint8)))


def _ideal(view: View) -> np.ndarray:
    return view.rays[:, :2] / view.rays[:, 2:]


def _five_points(pair: Pair, draw: int) -> tuple[np.ndarray, np.ndarray] | None:
    # its random draws are always the same: other orders of the matches are other draws
    order = np.random.default_rng(draw).permutation(len(pair.first.clock)) if draw else slice(None)
    x_1, x_2 = _ideal(pair.first)[order], _ideal(pair.second)[order]
    E, inlier = cv2.findEssentialMat(
        x_1, x_2, np.eye(3), method=cv2.USAC_DEFAULT, prob=0.999, threshold=4 / pair.first.focal_px, maxIters=2000
    )
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, x_1, x_2, np.eye(3), mask=inlier)
    return R, t.ravel()


def _of_pycolmap(pair: Pair, draw: int) -> tuple[np.ndarray, np.ndarray] | None:
    pycolmap = quiet_pycolmap()
    f = pair.first.focal_px
    camera = pycolmap.Camera(model="PINHOLE", width=1, height=1, params=[f, f, 0, 0])
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose, options.ransac.random_seed = True, draw
    each = np.repeat(np.arange(len(pair.first.clock), dtype=np.uint32)[:, None], 2, axis=1)
    found = pycolmap.estimate_calibrated_two_view_geometry(
        camera, _ideal(pair.first) * f, camera, _ideal(pair.second) * f, each, options
    )
    if found.cam2_from_cam1 is None:
        return None
    pose = found.cam2_from_cam1.matrix()
    return (pose[:, :3], pose[:, 3]) if np.linalg.norm(pose[:, 3]) > 0 else None


def _error(found: tuple[np.ndarray, np.ndarray] | None, truth: tuple[np.ndarray, np.ndarray]) -> float:
    """The larger of the errors of rotation and direction, degrees."""
    if found is None:
        return 180.0
    turned = np.degrees(Rotation.from_matrix(found[0] @ truth[0].T).magnitude())
    cosine = found[1] @ truth[1] / (np.linalg.norm(found[1]) * np.linalg.norm(truth[1]))
    return float(max(turned, np.degrees(np.arccos(np.clip(cosine, -1, 1)))))


def _auc(errors: list[float]) -> float:
    """Area under the curve of the share of pairs within an error, up to AUC_DEG, as a share."""
    return float(np.mean(np.maximum(AUC_DEG - np.array(errors), 0.0)) / AUC_DEG)


def fountain(bench: Bench, times: float = 3.0) -> None:
    """Fountain-small with its velocity larger: poses, motions, and photos with the depth of points."""
    source, out = bench.photos / "fountain-small", bench.work / "fountain"
    truth = fountain_truth(source)
    images = [
        replace(image, motion=rs.RowMotion(image.motion.phi, times * image.motion.velocity)) for image in truth.images
    ]
    truth, camera = replace(truth, images=images), truth.cameras["1"]
    (out / "photos").mkdir(parents=True)
    for image in images:
        pixels = read_photo(source / "gs" / image.name).pixels
        depth = np.load((source / "depth" / image.name).with_suffix(".npz"))
        bent, _ = moved_photo(pixels, depth[depth.files[0]], camera, image.motion.in_camera(image.R_cw))
        cv2.imwrite(str(out / "photos" / image.name), bent, [cv2.IMWRITE_JPEG_QUALITY, 98])
    rs.write_solution(out / "truth.json", truth)
    (out / "camera.json").write_text((source / "camera.json").read_text())
    solution = rs.run(
        out / "photos", out / "run", run_options(camera=str(out / "camera.json"), depth="points"), overwrite=True
    )
    found = rs.evaluate(out / "run", out / "truth.json", twins=source / "gs", raw=out / "photos")
    show(
        f"fountain-small, its velocity times {times}", registered=len(solution.registered), photos=len(images),
        model=solution.quality["held_out_chosen"], verdict=[solution.verdict["shutter"], solution.verdict["shape"]],
        dB=round(found.psnr_db.median, 2), least_dB=round(found.psnr_db.min, 2),
        before_dB=round(found.psnr_before_db.median, 2), deg=round(found.rotation_deg.mean, 4),
    )  # fmt: skip
    bench.rows.append((
        "fountain", f"v x {times:g}", "", f"{len(solution.registered)}/{len(images)}", "", "",
        f"{found.rotation_deg.median:.3f}", f"{found.rotation_deg.max:.3f}", f"{found.psnr_db.median:.1f}",
        f"{found.psnr_db.min:.1f}", f"{found.psnr_before_db.median:.1f}", "",
    ))  # fmt: skip


def weak(bench: Bench, before: Path, times: int = 2) -> None:
    """What weak shutters pay for strong ones."""
    name, states = "herz-jesus-8", {"before": before, "now": ROOT}
    warped = bench.warped(name, 0.02, 0)
    assert warped is not None
    for title, photos in (("as it is", bench.photos / name), ("by 0.02", warped / "photos")):
        seconds: dict[str, list[float]] = {state: [] for state in states}
        found = {}
        for _ in range(times):
            for state, checkout in states.items():
                out = bench.work / f"weak-{state}"
                start = resource.getrusage(resource.RUSAGE_CHILDREN)
                subprocess.run(
                    [sys.executable, "-m", "cli", "run", str(photos), "-o", str(out), "--overwrite", "-q"],
                    check=True, cwd=checkout, env={**os.environ, "PYTHONPATH": str(checkout)},
                )  # fmt: skip
                end = resource.getrusage(resource.RUSAGE_CHILDREN)
                seconds[state].append(end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime)
                solution = rs.read_solution(out / "solution.json")
                found[state] = [
                    (image.name, image.R_cw.tolist(), image.motion.phi.tolist()) for image in solution.registered
                ]
        seconds = {state: [round(each, 1) for each in values] for state, values in seconds.items()}
        show(
            f"weak: {name} {title}", processor_s=seconds,
            ratio=round(min(seconds["now"]) / min(seconds["before"]), 3), same=found["now"] == found["before"],
        )  # fmt: skip


def main() -> int:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=ROOT.parent / "shared" / "photos")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--sets", nargs="*", default=SETS)
    parser.add_argument("--rad", nargs="*", type=float, default=RADIANS)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--before", type=Path, help="another checkout of this project, for weak")
    parser.add_argument("--no-photos", action="store_true", help="sets are solved, not rectified: no dB")
    parser.add_argument("--work", type=Path, help="folder that keeps the warped photos for the next time")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() if args.work is None else nullcontext(args.work) as work:
        bench = Bench(args.photos, Path(work), rectifies=not args.no_photos)
        seeds = range(args.first_seed, args.first_seed + args.seeds)
        for name in args.sets:
            for radians in args.rad if "sets" in args.only else ():
                for seed in seeds:
                    bench.register(name, radians, seed)
            for radians in (0.0, 0.05, *args.rad) if "pairs" in args.only else ():
                for seed in seeds if radians else (0,):
                    bench.pairs(name, radians, seed)
            for radians in (0.02, *args.rad) if "limit" in args.only else ():
                for seed in seeds:
                    bench.limit(name, radians, seed)
            for part in (bench.matches, bench.search):
                for radians in args.rad if part.__name__ in args.only else ():
                    for seed in seeds:
                        part(name, radians, seed)
        if "fountain" in args.only:
            fountain(bench)
        if "weak" in args.only and args.before is not None:
            weak(bench, args.before)
    rows = [COLUMNS, *bench.rows]
    widths = [max(len(row[k]) for row in rows if k < len(row)) for k in range(len(COLUMNS))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=False)).rstrip())
    return bool(bench.failed)


if __name__ == "__main__":
    sys.exit(main())
