"""Videos as one path: readout times, rotations and rectified frames against the truth, and a GoPro's gyroscope.

    python benchmarks/video.py [--only PART ...] [--clips FOLDER] [--num 20] [--first-seed 100] [--shared ../shared]
                               [--frames 300 600 1200 1800] [--long street round to-and-fro]
                               [--edit NAME ...] [--kind walk pan vibrating]

Prints one JSON object a line. Clips are rendered into FOLDER once (`clips.py`: 80 s of one core each).

    walk     sample_scenes/walk: readout time, rotations of all frames, frames against references; and the same key
             frames as photos that know nothing of each other
    level    random clips that are held level: the height of the scene, too
    pan      random clips from a tripod
    two      two frames whose readout time is known: how far off the corrected positions are
    readout  random walks, gentle to wild: errors of the readout time, and these over their standard deviations
    vibrating  likewise walks that shake at up to 24 Hz, faster than frames can show
    arm        likewise pans at arm's length, by who turns around
    gimbal     likewise level cameras without any tremor, along a street, that yaw to and fro
    stabilised  walks, rotated back to smooth paths: which are named; and how many of those that the sensor saw are
    edited   random walks as programs, lamps and passers-by leave them (`edited.py`): readout times, by the path and by
             slow rotations alone, and verdicts; only some edits with `--edit`, and of other clips with `--kind`
    gopro    ../shared/video: clock, axes and rotation of its gyroscope, readout by pictures and by the gyroscope
    peer     `run` of videos, each in a process of its own, beside pycolmap's extract, match sequentially, map and
             undistort with default options, on the same key frames and with the same camera: seconds and peaks; and
             ratios, of the seconds (`time`) and, as all that follow, of those of the processors, since the machine may
             be busy (`cpu`); of what any way from a video to a map takes, of the path of all frames, and of the start
             and the outputs; `least` is all but what comes after the first path: with none of that, a run ends there
    length   the same `run` of the first so many frames of long videos of 854x480 (`clips.py`: a walk along a street,
             which never returns, and rounds about a thing), and of the GoPro's, played to and fro, on the way back
             upside down, so that lines are read from first to last as the camera reads them: seconds a frame, peaks,
             and readout times
    unordered  every fourth frame of two rounds and two streets as photos that know nothing of each other, of scenes
             that repeat themselves, so that many pairs look alike which are none: poses against the truth
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from dataclasses import replace
from functools import partial
from itertools import islice, product
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from clips import clip_folder
from edited import EDITS, OF_NO_CAMERA, edited
from field import OURS, PEER, in_child
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from stabilise import rotations_by_truth, stabilise, zoomed

from rsundistort import Reconstruction, Solution, evaluate, read_solution, rectify, run
from rsundistort.batch.geometry import SceneGeometry, ScenePoints
from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.evaluation import psnr
from rsundistort.input.key_frames import read_clip
from rsundistort.input.load import load_photos
from rsundistort.input.unknown_focal import with_focal_lengths
from rsundistort.io.video import VideoReader, frame_name
from rsundistort.model import RowMotion, SolvedImage
from rsundistort.model.projection import unproject_points
from rsundistort.solve import RunOptions, SolveOptions
from rsundistort.solve.outcome import Solved
from rsundistort.solve.video_path import frame_path, solve_clip

WALK = Path(__file__).parents[1] / "sample_scenes" / "walk"
# By the focal length with which the frames rotate as far as the gyroscope.
GOPRO = "547,547,426.5,239.5"
# Stages of `run` that make a map of key frames, and those of the path; the rest rectifies, writes and reports.
MAP = ("frames", "features", "rotations", "matching", "mapping")
PATH = (
    "flow", "path", "path again", "gyroscope", "critical motion", "halves", "stabilisation",
    "comparison with a global shutter",
)  # fmt: skip
# Seconds by the clock, and of all processors: on a busy machine only these compare.
KINDS = {"s": "total", "cpu_s": "cpu"}
# What makes stages count the processors' seconds.
BY_PROCESSOR = """
import types
from rsundistort.batch import progress
progress.time = types.SimpleNamespace(perf_counter=time.process_time)
"""
LONG = ("street", "round", "to-and-fro")
PARTS = (
    "walk",
    "level",
    "pan",
    "two",
    "readout",
    "vibrating",
    "gimbal",
    "arm",
    "stabilised",
    "edited",
    "gopro",
    "peer",
    "length",
    "unordered",
)


def solved_clip(video: Path, camera: str | None, readout_s: float | None = None) -> tuple[Solved, float]:
    """A clip solved as `run` does, and the processor's seconds that it took."""
    began = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        clip = read_clip(video, Path(scratch) / "frames")
        keys = load_photos(
            Path(scratch) / "frames",
            camera,
            None,
            RunOptions().most_features(True),
            Workers(0),
            StageLog(None),
            least=2,
        )
        keys = with_focal_lengths(keys, 0, StageLog(None))
        known = None if readout_s is None else (readout_s, "given")
        options = SolveOptions()
        solved = solve_clip(
            clip, keys, frame_path(clip, known), lambda _: options.options_for(keys.cameras), Path(scratch),
            StageLog(None),
        )  # fmt: skip
    return solved, time.process_time() - began


def in_true_world(rec: Reconstruction, truth: Solution) -> tuple[NDArray[np.float64], list[str]]:
    """Rotation errors in degrees after the worlds are rotated onto each other, of the frames of both."""
    true = {image.name: image.R_cw for image in truth.images if image.R_cw is not None}
    names = [name for name in rec.image_names if name in true]
    found = np.array([rec.R_cw[rec.image_names.index(name)] for name in names])
    wanted = np.array([true[name] for name in names])
    U, _, Vt = np.linalg.svd(np.einsum("nab,nac->bc", wanted, found))
    world = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return np.degrees(Rotation.from_matrix(found @ world.T @ wanted.transpose(0, 2, 1)).magnitude()), names


def against_references(video: Path, solved: Solved) -> dict[str, Any]:
    """PSNR of frames, as they were read and rectified, against their references."""
    rec = solved.whole
    assert rec is not None
    images = tuple(
        SolvedImage(name, "1", R_cw=rec.R_cw[i], center_w=rec.center_w[i], motion=rec.motion(i))
        for i, name in enumerate(rec.image_names)
    )
    solution = Solution(rec.shutter_model, {"1": rec.cameras[0]}, {"1": rec.cameras[0].pinhole()}, images)
    scene = SceneGeometry(solution, "auto", ScenePoints.of_reconstruction(rec))
    raw, better = [], []
    with VideoReader(video) as reader:
        for number, _, picture in reader:
            name = frame_name(video, number)
            reference = next(iter((video.parent / "global").glob(f"{Path(name).stem}.*")), None)
            if reference is None or name not in rec.image_names:
                continue
            pixels, wanted = picture.to_ndarray(format="bgr24"), cv2.imread(str(reference))
            geometry = scene.of(name)
            camera, motion, model, new_camera = geometry.grid
            rectified, valid = rectify(pixels, camera, motion, model, new_camera, depth=geometry.find_depth().depth)
            mask = cv2.erode(valid, np.ones((9, 9), np.uint8))
            raw.append(psnr(pixels, wanted, mask))
            better.append(psnr(rectified, wanted, mask))
    return {
        "twins": len(raw), "raw_db": round(float(np.median(raw)), 2),
        "rectified_db": round(float(np.median(better)), 2),
        "worst_db": round(float(np.min(better)), 2),
    }  # fmt: skip


def judged(folder: Path, solved: Solved, cpu_s: float) -> dict[str, Any]:
    """Figures of a clip whose truth lies beside it."""
    truth = read_solution(folder / "ground_truth.json")
    true_s, found = truth.options["readout_ms"] / 1e3, solved.evidence
    assert solved.whole is not None
    errors, names = in_true_world(solved.whole, truth)
    return {
        "clip": folder.name, "frames": len(names), "of_frames": len(truth.images),
        "readout_ms": round(1e3 * found["seconds"], 3), "sigma_ms": round(1e3 * found["sigma"], 3),
        "true_ms": round(1e3 * true_s, 3), "error_percent": round(100 * (found["seconds"] / true_s - 1), 2),
        "error_over_sigma": round((found["seconds"] - true_s) / found["sigma"], 2),
        "rotation_deg": round(float(np.median(errors)), 4), "worst_rotation_deg": round(float(errors.max()), 4),
        "verdict": None if solved.verdict is None else [solved.verdict.shutter, solved.verdict.shape],
        "stabilisation": found["stabilisation"]["verdict"], "cpu_s": round(cpu_s, 1),
    }  # fmt: skip


def positions(folder: Path, solved: Solved) -> dict[str, float]:
    """How far pixels of frames are off, as they were read and as they are corrected: the largest over a lattice.

    And the largest standard deviation of a corrected one by the covariances of phi.
    """
    truth = read_solution(folder / "ground_truth.json")
    rec, covariances = solved.whole, solved.result.covariances
    assert rec is not None
    before, after, sigma = [], [], []
    for image in truth.images:
        if image.name not in rec.image_names or image.motion is None:
            continue
        i, camera = rec.image_names.index(image.name), truth.cameras[image.camera_id]
        x, y = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 7))
        xy = np.column_stack([x.ravel(), y.ravel()])
        wanted, plain, found = (
            unproject_points(xy, camera, motion, "rotation")[0]
            for motion in (
                replace(image.motion, velocity=np.zeros(3), bend=None, frame=None), RowMotion(),
                RowMotion(rec.phi[i]),
            )
        )  # fmt: skip
        focal_px = float(camera.K[0, 0])
        before.append(focal_px * np.linalg.norm(plain - wanted, axis=1).max())
        after.append(focal_px * np.linalg.norm(found - wanted, axis=1).max())
        if covariances is not None:
            steps = [RowMotion(rec.phi[i] + step) for step in 1e-5 * np.eye(3)]
            J = np.array([unproject_points(xy, camera, each, "rotation")[0] - found for each in steps]) / 1e-5
            sigma.append(focal_px * np.sqrt(np.einsum("anj,ab,bnj->n", J, covariances[i, 6:9, 6:9], J)).max())
    return {
        "as_read_px": round(float(np.max(before)), 2), "corrected_px": round(float(np.max(after)), 2),
        "sigma_px": round(float(np.max(sigma, initial=0.0)), 2),
    }  # fmt: skip


def height_error_percent(folder: Path, solved: Solved) -> float:
    """How far the height of the cameras' path is off against its width: of the affine map to the true one."""
    truth = read_solution(folder / "ground_truth.json")
    rec = solved.whole
    assert rec is not None
    # points by the true cameras' rays would need depths: the scene's own points, seen by the found ones, show the shape
    true = {image.name: (image.R_cw, image.center_w) for image in truth.images}
    R_true = np.array([true[name][0] for name in rec.image_names])
    c_true = np.array([true[name][1] for name in rec.image_names])
    U, _, Vt = np.linalg.svd(np.einsum("nab,nac->bc", R_true, rec.R_cw))
    world = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    points = rec.points_w @ world.T
    obs = rec.observations
    # each point once more, by the true poses and motions
    again = np.full_like(points, np.nan)
    by_point = np.argsort(obs.point_idx, kind="stable")
    starts = np.searchsorted(obs.point_idx[by_point], np.arange(rec.num_points + 1))
    rays = np.empty((len(obs), 3))
    where = np.empty((len(obs), 3))
    for i, name in enumerate(rec.image_names):
        mine = obs.frame_idx == i
        image = truth.image(name)
        assert image.motion is not None
        camera = truth.cameras[image.camera_id]
        clock = camera.clock_sign * (obs.xy_raw[mine, camera.clock_axis] - camera.K[camera.clock_axis, 2])
        clock /= camera.K[camera.clock_axis, camera.clock_axis]
        turn, way = image.motion.at(clock)
        ideal = unproject_points(obs.xy_raw[mine], camera, RowMotion(), "global")[0]
        R = Rotation.from_rotvec(turn).as_matrix() @ R_true[i]
        rays[mine] = np.einsum("nab,na->nb", R, np.column_stack([ideal, np.ones(len(ideal))]))
        where[mine] = c_true[i] + way
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    for k in range(rec.num_points):
        mine = by_point[starts[k] : starts[k + 1]]
        if len(mine) >= 3:
            across = np.eye(3) - rays[mine, :, None] * rays[mine, None]
            total = across.sum(0)
            if np.linalg.cond(total) < 1e3:
                again[k] = np.linalg.solve(total, np.einsum("nab,nb->a", across, where[mine]))
    good = np.isfinite(again).all(1)
    x, y = points[good] - np.median(points[good], axis=0), again[good] - np.median(again[good], axis=0)
    near = np.linalg.norm(y, axis=1) < 3 * np.median(np.linalg.norm(y, axis=1))
    B = np.linalg.lstsq(x[near], y[near], rcond=None)[0]
    for _ in range(5):  # a few points are far off
        left = np.linalg.norm(y - x @ B, axis=1)
        weight = np.sqrt(near / np.maximum(left, np.median(left)))[:, None]
        B = np.linalg.lstsq(weight * x, weight * y, rcond=None)[0]
    up = R_true[:, 1].mean(0) / np.linalg.norm(R_true[:, 1].mean(0))
    along = np.linalg.norm(up @ B)
    return float(100 * (1.5 * np.log(along) - 0.5 * np.log(abs(np.linalg.det(B)))))


def walk(args: argparse.Namespace) -> None:
    """The sample, as a clip and as photos."""
    solved, cpu_s = solved_clip(WALK / "clip.mp4", str(WALK / "camera.json"))
    print(json.dumps(judged(WALK, solved, cpu_s) | against_references(WALK / "clip.mp4", solved)), flush=True)
    with tempfile.TemporaryDirectory() as out:
        began = time.process_time()
        options = RunOptions(camera=str(WALK / "camera.json"), every=9)
        run(WALK / "clip.mp4", Path(out) / "photos", options)
        value = evaluate(Path(out) / "photos", WALK / "ground_truth.json")
        said = {"photos_of_walk": value.to_json(), "cpu_s": round(time.process_time() - began, 1)}
        print(json.dumps(said, default=float), flush=True)


def of_kind(kind: str, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Random clips of a kind."""
    values = []
    for seed in range(args.first_seed, args.first_seed + args.num):
        folder = clip_folder(args.clips, kind, seed, 90 if kind == "gimbal" else 60)
        known = read_solution(folder / "ground_truth.json").options["readout_ms"] / 1e3 if kind == "two" else None
        try:
            solved, cpu_s = solved_clip(folder / "clip.mp4", str(folder / "camera.json"), known)
        except Exception as error:  # counted, as what a user would see
            print(json.dumps({"clip": folder.name, "error": str(error)}), flush=True)
            values.append({"error": str(error)})
            continue
        value = judged(folder, solved, cpu_s)
        if kind in ("pan", "walk", "vibrating", "gimbal", "arm"):
            value |= against_references(folder / "clip.mp4", solved)
        if kind == "two":
            value |= positions(folder, solved)
        if kind == "level":
            value["height_error_percent"] = round(height_error_percent(folder, solved), 3)
        print(json.dumps(value), flush=True)
        values.append(value)
    return values


def readout(args: argparse.Namespace, kind: str = "walk") -> None:
    """Errors of the readout time over random clips of a kind."""
    values = [each for each in of_kind(kind, args) if "error" not in each]
    percent = np.abs([each["error_percent"] for each in values])
    normalised = np.array([each["error_over_sigma"] for each in values])
    print(
        json.dumps({
            "clips": len(values), "of": args.num, "median_error_percent": round(float(np.median(percent)), 3),
            "worst_error_percent": round(float(percent.max()), 3),
            "normalised_rms": round(float(np.sqrt(np.mean(normalised**2))), 2),
            "rectified_db": round(float(np.median([each["rectified_db"] for each in values])), 2),
        }),
        flush=True,
    )  # fmt: skip


def stabilised(args: argparse.Namespace) -> None:
    """Clips as they were read, rotated back as wholes by Gaussians of so many frames, and freed of the shutter."""
    for seed in range(args.first_seed, args.first_seed + args.num):
        folder = clip_folder(args.clips, "walk", seed)
        camera = read_solution(folder / "ground_truth.json").cameras["1"]
        R_cw, phi = rotations_by_truth(folder)
        found = {"clip": folder.name}
        with tempfile.TemporaryDirectory() as scratch:
            new = zoomed(camera)
            intrinsics = ",".join(str(each) for each in (new.K[0, 0], new.K[1, 1], new.K[0, 2], new.K[1, 2]))
            for name, frames, turns in (("smooth", 12.0, None), ("less smooth", 4.0, None), ("without", 12.0, phi)):
                video = Path(scratch) / f"{name}.mp4"
                stabilise(folder / "clip.mp4", video, camera, R_cw, frames, turns)
                solved, _ = solved_clip(video, intrinsics)
                found[name] = solved.evidence["stabilisation"]["verdict"]
        solved, _ = solved_clip(folder / "clip.mp4", str(folder / "camera.json"))
        found["as read"] = solved.evidence["stabilisation"]["verdict"]
        print(json.dumps(found), flush=True)


def edits(args: argparse.Namespace) -> None:
    """Random clips that were changed after they were filmed."""
    for kind, name in product(args.kind, args.edit):
        for seed in range(args.first_seed, args.first_seed + args.num):
            folder = clip_folder(args.clips, kind, seed)
            true_s = read_solution(folder / "ground_truth.json").options["readout_ms"] / 1e3
            said: dict[str, Any] = {"edit": name, "clip": folder.name}
            camera = None if name in OF_NO_CAMERA else str(folder / "camera.json")
            with tempfile.TemporaryDirectory() as scratch:
                edited(folder / "clip.mp4", Path(scratch) / "clip.mp4", name)
                try:
                    solved, _ = solved_clip(Path(scratch) / "clip.mp4", camera)
                except Exception as error:  # counted, as what a user would see
                    print(json.dumps(said | {"error": str(error)}), flush=True)
                    continue
            found, verdict = solved.evidence, solved.verdict
            assert verdict is not None
            of = {"path": found, **({"slow": found["by_speed"][0]} if found["by_speed"] else {})}
            for key, each in of.items():
                said[f"{key}_error_percent"] = round(100 * (each["seconds"] / true_s - 1), 2)
                said[f"{key}_error_over_sigma"] = round((each["seconds"] - true_s) / each["sigma"], 2)
            if camera is None:
                (true,) = read_solution(folder / "ground_truth.json").cameras.values()
                true_px, focal_px = (float(each.K[0, 0]) for each in (true, solved.result.reconstruction.cameras[0]))
                sigma_px = solved.result.sigma_intrinsics[0]["f"]
                said["focal_error_percent"] = round(100 * (focal_px / true_px - 1), 2)
                said["focal_error_over_sigma"] = round((focal_px - true_px) / sigma_px, 2)
            said |= {"verdict": [verdict.shutter, verdict.shape], "reasons": verdict.reasons}
            print(json.dumps(said), flush=True)


def gopro(args: argparse.Namespace) -> None:
    """A GoPro with its gyroscope."""
    video = args.shared / "video" / "gopro-hero5-gentle.mp4"
    solved, cpu_s = solved_clip(video, GOPRO)
    print(json.dumps(dict(solved.evidence) | {"cpu_s": round(cpu_s, 1)}), flush=True)


def ours(video: Path, camera: str) -> dict[str, Any]:
    """Seconds, those of the processors by stage, and peak of a run of a video in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        found = in_child(BY_PROCESSOR + OURS, video, Path(folder), "--camera", camera)
        if "crash" not in found:
            solution = json.loads(Path(folder, "out", "solution.json").read_text())
            readout = solution["quality"]["readout_time"]
            found["frames"] = readout["frames"]
            found["readout_ms"] = [round(1e3 * readout[name], 3) for name in ("seconds", "sigma")]
            found["seconds"] = seconds = dict.fromkeys((each["name"] for each in solution["stages"]), 0.0)
            for each in solution["stages"]:  # one comes twice
                seconds[each["name"]] = round(seconds[each["name"]] + each["seconds"], 1)
        return found


def peer(args: argparse.Namespace) -> None:
    """Videos beside pycolmap's chain on their key frames."""
    chain = PEER.replace("pycolmap.match_exhaustive", "pycolmap.match_sequential")
    videos = {WALK / "clip.mp4": str(WALK / "camera.json"), args.shared / "video" / "gopro-hero5-gentle.mp4": GOPRO}
    for video, given in videos.items():
        with tempfile.TemporaryDirectory() as folder:
            frames = Path(folder) / "frames"
            clip = read_clip(video, frames)
            camera = load_photos(frames, given, None, 64, Workers(0), StageLog(None), least=2).cameras.of(0)
            (frames / "camera.json").write_text(json.dumps({"K": camera.K.tolist()}))
            theirs = in_child(chain, frames, Path(folder))
            if "crash" not in theirs:
                theirs |= json.loads(Path(folder, "figures.json").read_text())
        ours(video, given)  # kernels of whatever models it needs
        found = ours(video, given)
        said = {"clip": video.parent.name, "key_frames": len(clip.keys), "ours": found, "theirs": theirs}
        of_map, of_path = (sum(found["seconds"].get(each, 0.0) for each in part) for part in (MAP, PATH))
        first = sum(found["seconds"].get(each, 0.0) for each in ("flow", "path"))
        parts = {
            "cpu": found["cpu_s"], "of_map": of_map, "of_path": of_path, "of_rest": found["cpu_s"] - of_map - of_path,
            "least": found["cpu_s"] - of_path + first,
        }  # fmt: skip
        ratios = {"time": round(found["total_s"] / theirs["total_s"], 2)}
        ratios |= {name: round(seconds / theirs["cpu_s"], 2) for name, seconds in parts.items()}
        print(json.dumps(said | ratios), flush=True)


def first_frames(video: Path, out: Path, num_frames: int) -> None:
    """The first frames of a video."""
    with av.open(str(video)) as source, av.open(str(out), "w") as container:
        of = source.streams.video[0]
        stream = container.add_stream("libx264", rate=of.average_rate, options={"crf": "16", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = of.width, of.height, "yuv420p"
        for frame in islice(source.decode(video=0), num_frames):
            container.mux(stream.encode(frame.reformat(format="yuv420p")))
        container.mux(stream.encode())


def to_and_fro(video: Path, out: Path, num_frames: int) -> None:
    """A video played forwards and, upside down, backwards until it has so many frames.

    Backwards alone it would be that of a shutter that runs from the last line to the first. Turned by 180 degrees, as
    of a camera held the other way round, the first line is the earliest again. Each turn is a cut.
    """
    with av.open(str(video)) as container:
        frames = [frame.reformat(format="yuv420p") for frame in container.decode(video=0)]
        rate, width, height = container.streams.video[0].average_rate, frames[0].width, frames[0].height
    with av.open(str(out), "w") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "18", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for k in range(num_frames):
            place = k % (2 * len(frames))
            picture = frames[min(place, 2 * len(frames) - 1 - place)].to_ndarray()
            if place >= len(frames):  # each of the planes, one after the other
                sizes = width * height, width * height // 4
                planes = np.split(picture.ravel(), [sizes[0], sum(sizes)])
                picture = np.concatenate([plane[::-1] for plane in planes]).reshape(picture.shape)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="yuv420p")))
        container.mux(stream.encode())


def length(args: argparse.Namespace) -> None:
    """Time and memory of longer videos."""
    for kind in args.long:
        for num_frames in args.frames:
            said: dict[str, Any] = {"of": kind, "of_frames": num_frames}
            with tempfile.TemporaryDirectory() as folder:
                video, camera = Path(folder) / "clip.mp4", GOPRO
                if kind == "to-and-fro":
                    to_and_fro(args.shared / "video" / "gopro-hero5-gentle.mp4", video, num_frames)
                else:
                    clip = clip_folder(args.clips, kind, 0, max(args.frames))
                    said["true_ms"] = round(read_solution(clip / "ground_truth.json").options["readout_ms"], 3)
                    first_frames(clip / "clip.mp4", video, num_frames)
                    camera = str(clip / "camera.json")
                found = ours(video, camera)
            if "crash" not in found:
                said |= {f"{name}_per_frame": round(found[f"{kind}_s"] / num_frames, 3) for name, kind in KINDS.items()}
            print(json.dumps(said | found), flush=True)


def unordered(args: argparse.Namespace) -> None:
    """Frames of long videos as photos."""
    for kind in sorted({*args.long} - {"to-and-fro"}):
        for seed in range(min(args.num, 2)):
            clip = clip_folder(args.clips, kind, seed, 300)
            with tempfile.TemporaryDirectory() as folder:
                photos, out = Path(folder) / "photos", Path(folder) / "out"
                photos.mkdir()
                with av.open(str(clip / "clip.mp4")) as container:
                    for k, frame in enumerate(container.decode(video=0)):
                        if k % 4 == 0:
                            cv2.imwrite(str(photos / frame_name(Path("clip.mp4"), k)), frame.to_ndarray(format="bgr24"))
                solution = run(photos, out)
                found = evaluate(out, clip / "ground_truth.json").to_json()
            said: dict[str, Any] = {"clip": clip.name, "photos": len(solution.images)}
            said |= {"registered": len(solution.registered), "verdict": solution.verdict}
            said |= {key: found[key] for key in ("rotation_deg", "center") if key in found}
            print(json.dumps(said), flush=True)


def main() -> None:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=PARTS, nargs="+", default=PARTS)
    parser.add_argument("--clips", type=Path, default=Path(tempfile.gettempdir()) / "rsundistort-clips")
    parser.add_argument("--num", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=100)
    parser.add_argument("--frames", type=int, nargs="+", default=(300, 600, 1200, 1800))
    parser.add_argument("--long", choices=LONG, nargs="+", default=LONG)
    parser.add_argument("--edit", choices=EDITS, nargs="+", default=EDITS)
    parser.add_argument("--kind", choices=("walk", "pan", "vibrating"), nargs="+", default=("walk",))
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    for part in args.only:
        if part in ("level", "pan", "two"):
            of_kind(part, args)
        else:
            {
                "walk": walk, "readout": readout, "stabilised": stabilised, "gopro": gopro, "peer": peer,
                "length": length, "unordered": unordered, "edited": edits,
                "vibrating": partial(readout, kind="vibrating"),
                "gimbal": partial(readout, kind="gimbal"),
                "arm": partial(readout, kind="arm"),
            }[part](args)  # fmt: skip


if __name__ == "__main__":
    main()
