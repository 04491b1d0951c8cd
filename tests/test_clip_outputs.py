"""What is written of a video: all its frames, its path, and how long a frame took to be read."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from clips import HandHeld, poses_at
from make_photos import texture
from rsundistort_cli.main import cli
from scipy.spatial.transform import Rotation

from rsundistort import (
    Camera,
    GyroOptions,
    RowMotion,
    RsUndistortWarning,
    RunOptions,
    SolveOptions,
    read_solution,
    rectify,
    run,
)
from rsundistort.batch.geometry import PhotoGeometry
from rsundistort.batch.progress import StageLog
from rsundistort.batch.rectify_options import RectifyOptions
from rsundistort.batch.video_frames import rectify_clip
from rsundistort.batch.workers import Workers
from rsundistort.errors import FileError, InputError
from rsundistort.io import write_path
from rsundistort.io.video import VideoReader, frame_name
from rsundistort.io.video_like import pixels_of
from rsundistort.io.video_writer import write_video
from rsundistort.model.orientation import orient_path
from rsundistort.model.path import CameraPath
from rsundistort.rectify import ViewOptions
from rsundistort.solve import OutputOptions, measure_readout
from rsundistort.solve.run_outputs import Outputs

av = pytest.importorskip("av")

WALK = Path(__file__).parents[1] / "sample_scenes" / "walk"
WIDTH, HEIGHT = 320, 240
SCENE = cv2.GaussianBlur(texture(WIDTH + 200, HEIGHT, seed=3), (0, 0), 1.5)
CAMERA = Camera(WIDTH, HEIGHT, [[300, 0, 160], [0, 300, 120], [0, 0, 1]])
STILL = PhotoGeometry("clip", CAMERA, CAMERA, RowMotion(), "global")
FULL_RANGE, LIMITED_RANGE, BT709 = 2, 1, 1


def view(number):
    return np.ascontiguousarray(SCENE[:, 2 * number : 2 * number + WIDTH])


def encode(path, frames, pix_fmt="yuv420p", times_ms=None, rotation=0, full_range=False, sound=None, codec="libx264"):
    """A video as a camera writes it, with little loss."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options={"crf": "4"} if codec == "libx264" else {})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pix_fmt
        context = stream.codec_context
        if codec == "libx264":
            context.color_range = FULL_RANGE if full_range else LIMITED_RANGE
            context.colorspace = context.color_primaries = context.color_trc = BT709
        if times_ms is not None:
            context.time_base = Fraction(1, 1000)
        if rotation:
            stream.set_display_rotation(rotation)
        voice = None if sound is None else container.add_stream(sound, rate=16000)
        for k, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels, format="bgr24")
            if times_ms is not None:
                frame.pts, frame.time_base = times_ms[k], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if voice is not None:
            noise = np.random.default_rng(0).normal(0, 0.1, (1, 16000)).astype(np.float32)
            frame = av.AudioFrame.from_ndarray(noise, format="fltp", layout="mono")
            frame.sample_rate = 16000
            container.mux(voice.encode(frame))
            container.mux(voice.encode(None))
    return path


def frames_of(path):
    with av.open(str(path)) as container:
        return list(container.decode(container.streams.video[0]))


def rectified(video, out, geometry_of=lambda _: STILL, jobs=1):
    """What the log says of it, with the format of the pixels in the file."""
    log = StageLog(None)
    rectify_clip(video, out, geometry_of, STILL, "cubic", Workers(jobs), log)
    return log.stages[-1] | {"pixel_format": frames_of(out)[0].format.name}


def psnr(a, b):
    return 10 * np.log10(255**2 / np.mean((np.asarray(a, float) - b) ** 2))


# ---------------------------------------------------------------- all frames


def test_frames_without_a_motion_stay_as_they_are(tmp_path):
    pictures = [view(k) for k in range(20)]
    video = encode(tmp_path / "clip.mp4", pictures, times_ms=None)
    done = rectified(video, tmp_path / "out.mp4", jobs=2)
    assert (done["frames"], done["lens_only"], done["pixel_format"]) == (20, 0, "yuv420p")
    before, after = frames_of(video), frames_of(tmp_path / "out.mp4")
    assert [frame.time for frame in after] == [frame.time for frame in before]
    # the quality of the encoder; a shift by a tenth of a pixel, or another range, would leave 35 dB
    for a, b in zip(before, after, strict=True):
        assert psnr(a.to_ndarray(format="bgr24"), b.to_ndarray(format="bgr24")) > 41
        assert (b.color_range, b.colorspace) == (LIMITED_RANGE, BT709)
    with av.open(str(video)) as a, av.open(str(tmp_path / "out.mp4")) as b:
        assert a.streams.video[0].average_rate == b.streams.video[0].average_rate
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip.mp4", "out.mp4"]


def test_each_frame_is_rectified_by_its_own_motion(tmp_path):
    """Against the photo's way: the frame as BGR, through `rectify`."""
    pictures = [view(k) for k in range(6)]
    video = encode(tmp_path / "clip.mp4", pictures)
    turns = {frame_name(video, k): RowMotion([0.01 * (k - 2), 0.02 * k, -0.03 * k]) for k in range(6)}

    def geometry_of(name):
        return PhotoGeometry(name, CAMERA, CAMERA, turns[name], "rotation")

    rectified(video, tmp_path / "out.mp4", geometry_of, jobs=2)
    for name, before, after in zip(turns, frames_of(video), frames_of(tmp_path / "out.mp4"), strict=True):
        expected, valid = rectify(before.to_ndarray(format="bgr24"), CAMERA, turns[name], "rotation")
        found = after.to_ndarray(format="bgr24")
        inner = cv2.erode(valid, np.ones((9, 9), np.uint8), borderValue=0) > 0
        grey = [cv2.cvtColor(each, cv2.COLOR_BGR2GRAY) for each in (found, expected)]
        assert psnr(*(each[inner] for each in grey)) > 38
        # colours have half of the size in the file, so only those that change slowly compare
        smooth = [cv2.GaussianBlur(each, (0, 0), 3) for each in (found, expected)]
        assert psnr(*(each[inner] for each in smooth)) > 38
        outer = cv2.dilate(valid, np.ones((17, 17), np.uint8)) == 0
        if outer.any():
            assert found[outer].max() < 12  # black, and not the green of zeros


def test_variable_rate_rotation_and_full_range_are_kept(tmp_path):
    times_ms = np.cumsum([500, 33, 33, 90, 20, 33, 41, 200, 33]).tolist()
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(9)], "yuvj420p", times_ms, -90, full_range=True)
    rectified(video, tmp_path / "out.mp4")
    before, after = frames_of(video), frames_of(tmp_path / "out.mp4")
    np.testing.assert_allclose(np.diff([f.time for f in after]), np.diff(times_ms) / 1e3, rtol=0, atol=1e-3)
    for a, b in zip(before, after, strict=True):
        assert b.rotation == a.rotation == -90
        assert b.color_range == FULL_RANGE
        assert psnr(a.to_ndarray(format="gray"), b.to_ndarray(format="gray")) > 41


def test_ten_bits_stay_ten_bits(tmp_path):
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(5)], "yuv420p10le")
    assert rectified(video, tmp_path / "out.mp4")["pixel_format"] == "yuv420p10le"
    for a, b in zip(frames_of(video), frames_of(tmp_path / "out.mp4"), strict=True):
        deep, found = pixels_of(a), pixels_of(b)
        assert deep.bits == found.bits == 10
        assert psnr(deep.values / 4.0, found.values / 4.0) > 41


def test_ten_bits_become_eight_where_nothing_else_is_built_in(tmp_path, monkeypatch):
    monkeypatch.setattr("rsundistort.io.video_like._ENCODERS", {"mpeg4": {"qmin": "1", "qmax": "3"}})
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(5)], "yuv420p10le")
    with pytest.warns(RsUndistortWarning, match="10 bits a colour, and mpeg4 writes 8"):
        done = rectified(video, tmp_path / "out.mp4")
    assert (done["encoder"], done["pixel_format"]) == ("mpeg4", "yuv420p")
    for a, b in zip(frames_of(video), frames_of(tmp_path / "out.mp4"), strict=True):
        assert psnr(a.to_ndarray(format="gray"), b.to_ndarray(format="gray")) > 38


@pytest.mark.parametrize(("codec", "pix_fmt", "suffix"), [("ffv1", "bgr0", ".mkv"), ("mjpeg", "yuvj422p", ".avi")])
def test_other_formats_of_pixels_mean_the_same_colours(tmp_path, codec, pix_fmt, suffix):
    video = encode(tmp_path / f"clip{suffix}", [view(k) for k in range(4)], pix_fmt, codec=codec)
    rectified(video, tmp_path / "out.mp4")
    with VideoReader(tmp_path / "out.mp4") as reader:
        for (_, _, picture), before in zip(reader, frames_of(video), strict=True):
            a, b = before.to_ndarray(format="gray"), picture.to_ndarray(format="gray")
            if codec == "ffv1":  # grey of BGR is BT.601's, with all 256 levels
                assert picture.colorspace == BT709
                b = cv2.cvtColor(picture.to_ndarray(format="bgr24", src_colorspace="ITU709"), cv2.COLOR_BGR2GRAY)
                a = cv2.cvtColor(before.to_ndarray(format="bgr24"), cv2.COLOR_BGR2GRAY)
            assert psnr(a, b) > 37


def test_sound_is_copied_packet_by_packet(tmp_path):
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(30)], sound="aac")
    rectified(video, tmp_path / "out.mp4")

    def packets(path):
        with av.open(str(path)) as container:
            stream = container.streams.audio[0]
            return [(p.pts * p.time_base, bytes(p)) for p in container.demux(stream) if p.size]

    assert packets(tmp_path / "out.mp4") == packets(video)


def test_a_transport_stream_begins_at_zero_with_its_sound(tmp_path):
    video = encode(tmp_path / "clip.ts", [view(k) for k in range(30)], sound="aac")
    rectified(video, tmp_path / "out.mp4")
    apart = []
    for path in (video, tmp_path / "out.mp4"):
        with av.open(str(path)) as container:
            starts = {s.type: float(s.start_time * s.time_base) for s in container.streams}
        apart.append(starts["video"] - starts["audio"])
    assert min(starts.values()) == pytest.approx(0, abs=0.08)
    assert apart[1] == pytest.approx(apart[0], abs=0.08)  # the beginning that an encoder of sound puts before it


def test_sound_that_does_not_fit_is_left_out_and_said(tmp_path):
    video = encode(tmp_path / "clip.avi", [view(k) for k in range(5)], "yuvj422p", sound="pcm_mulaw", codec="mjpeg")
    with pytest.warns(RsUndistortWarning, match=r"clip\.avi: sound that MP4 does not hold was left out"):
        rectified(video, tmp_path / "out.mp4")
    assert len(frames_of(tmp_path / "out.mp4")) == 5


def test_frames_whose_time_runs_back_are_left_out_and_counted(tmp_path):
    one = encode(tmp_path / "a.ts", [view(k) for k in range(20)]).read_bytes()
    (tmp_path / "clip.ts").write_bytes(one + one)
    with pytest.warns(RsUndistortWarning, match=r"out\.mp4: \d+ frames whose time runs back were left out"):
        done = rectified(tmp_path / "clip.ts", tmp_path / "out.mp4")
    after = [frame.time for frame in frames_of(tmp_path / "out.mp4")]
    assert len(after) == done["frames"] >= 20
    assert (np.diff(after) > 0).all()


def test_frames_that_were_not_placed_lose_their_lens_only(tmp_path):
    lens = Camera(WIDTH, HEIGHT, CAMERA.K, [-0.2, 0, 0, 0, 0])
    geometry = PhotoGeometry("clip", lens, CAMERA, RowMotion(), "global")
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(5)])
    with pytest.warns(RsUndistortWarning, match=r"out\.mp4: 5 of 5 frames have no pose and are corrected for the lens"):
        rectify_clip(video, tmp_path / "out.mp4", lambda _: None, geometry, "cubic", Workers(1), StageLog(None))
    for before, after in zip(frames_of(video), frames_of(tmp_path / "out.mp4"), strict=True):
        expected = cv2.undistort(before.to_ndarray(format="gray"), lens.K, lens.dist)
        assert psnr(after.to_ndarray(format="gray")[9:-9, 9:-9], expected[9:-9, 9:-9]) > 38


def test_a_view_of_odd_sides_loses_a_pixel(tmp_path):
    odd = PhotoGeometry("clip", CAMERA, Camera(301, 201, CAMERA.K), RowMotion(), "global")
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(3)])
    rectify_clip(video, tmp_path / "out.mp4", lambda _: odd, odd, "cubic", Workers(1), StageLog(None))
    (first, *_) = frames_of(tmp_path / "out.mp4")
    assert (first.width, first.height) == (300, 200)


@pytest.mark.parametrize("stop", [KeyboardInterrupt, FileError, MemoryError])
def test_what_is_interrupted_leaves_nothing_under_the_name(tmp_path, stop):
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(20)])

    def geometry_of(name):
        if name.endswith("7.png"):
            raise stop("now")
        return STILL

    with pytest.raises(stop):
        rectified(video, tmp_path / "out.mp4", geometry_of)
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


# ---------------------------------------------------------------- the path


def path_of(hand, time_s, h=1e-4):
    """The path of a hand, its rates by central differences of poses."""
    R, after, before = (hand.rotations(time_s + d) for d in (0, h, -h))
    rate = Rotation.from_matrix(after @ before.transpose(0, 2, 1)).as_rotvec() / (2 * h)
    velocity = (hand.centers(time_s + h) - hand.centers(time_s - h)) / (2 * h)
    zero = np.zeros((len(time_s), 3))
    return CameraPath(time_s, R, hand.centers(time_s), rate, velocity, zero, zero)


def rows_of(path):
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def test_path_csv_has_pose_velocity_and_rotation_of_the_camera(tmp_path):
    hand, time = HandHeld(3), np.arange(12) / 30
    names = [f"clip, one_{k:06d}.png" for k in range(12)]
    write_path(tmp_path / "path.csv", names, path_of(hand, time))
    rows = rows_of(tmp_path / "path.csv")
    assert [row["frame"] for row in rows] == names
    numbers = {key: np.array([float(row[key]) for row in rows]) for key in rows[0] if key != "frame"}
    columns = {key: np.stack([numbers[name] for name in key.split()], axis=1) for key in COLUMNS}
    np.testing.assert_allclose(numbers["time_s"], time, atol=1e-9)
    np.testing.assert_allclose(columns["tx ty tz"], hand.centers(time), atol=1e-9)
    to_world = Rotation.from_quat(columns["qx qy qz qw"])
    np.testing.assert_allclose(to_world.as_matrix(), hand.rotations(time).transpose(0, 2, 1), atol=1e-9)
    h = 1e-3
    moved = (hand.centers(time + h) - hand.centers(time - h)) / (2 * h)
    np.testing.assert_allclose(columns["vx vy vz"], moved, atol=1e-3)
    # a gyroscope fixed to the camera: a rotation about its own axes takes its axes in the world to those a moment later
    later = to_world * Rotation.from_rotvec(h * columns["wx wy wz"])
    true = Rotation.from_matrix(hand.rotations(time + h).transpose(0, 2, 1))
    assert (true.inv() * later).magnitude().max() < 2e-5


COLUMNS = ["tx ty tz", "qx qy qz qw", "vx vy vz", "wx wy wz"]


def test_the_path_of_rotated_frames_is_that_of_a_rotated_camera(tmp_path):
    path = path_of(HandHeld(4), np.arange(8) / 30)
    turned = orient_path(path, 6)
    # shown clockwise, what points right is what pointed up
    np.testing.assert_allclose(turned.R_cw[:, 0], -path.R_cw[:, 1])
    np.testing.assert_allclose(turned.R_cw[:, 1], path.R_cw[:, 0])
    between = np.linspace(0.01, 0.2, 9)
    R, _ = poses_at(path, between)
    turned_R, centers = poses_at(turned, between)
    np.testing.assert_allclose(turned_R, [[[0, -1, 0], [1, 0, 0], [0, 0, 1]]] @ R, atol=1e-12)
    np.testing.assert_allclose(centers, poses_at(path, between)[1])


# ---------------------------------------------------------------- the readout time


@pytest.fixture(scope="module")
def cut(tmp_path_factory):
    """Two thirds of a second of the walk."""
    folder = tmp_path_factory.mktemp("cut")
    pictures = [frame.to_ndarray(format="bgr24") for frame in frames_of(WALK / "clip.mp4")[:20]]
    write_video(folder / "cut.mp4", pictures, Fraction(30))
    (folder / "camera.json").write_bytes((WALK / "camera.json").read_bytes())
    return folder / "cut.mp4"


@pytest.mark.slow
def test_the_readout_time_of_the_walk_is_measured_and_nothing_written(cut, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = sorted(cut.parent.iterdir())
    found = measure_readout(cut, RunOptions(max_features=1000))
    truth = json.loads((WALK / "recipe.json").read_text())["path"]["readout"] / 30
    assert found.measured
    assert abs(found.seconds - truth) < 4 * found.sigma
    assert found.sigma < 0.1 * truth
    assert (found.evidence["frames"], found.evidence["source"]) == (20, "the video")
    assert sorted(cut.parent.iterdir()) == before
    assert list(tmp_path.iterdir()) == []


def test_readout_of_photos_is_refused(tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"")
    result = CliRunner().invoke(cli, ["readout", str(tmp_path / "photo.jpg")])
    assert result.exit_code == 1
    assert "photo.jpg is no video; a readout time is measured from one" in result.stderr
    with pytest.raises(InputError, match="is no video; --frames all is for one"):
        run(half_empty(tmp_path), tmp_path / "out", RunOptions(frames="all"))


def half_empty(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), view(0))
    return folder


@pytest.mark.slow
def test_run_of_a_video_writes_all_its_frames_and_its_path(cut, tmp_path):
    out = tmp_path / "out"
    asked = ["--frames", "all", "--max-features", "1000", "--apply-orientation", "--usd", "--export", "nuke"]
    result = CliRunner().invoke(cli, ["run", str(cut), "-o", str(out), *asked])
    assert result.exit_code == 0, (result.stderr, result.exception)
    solution, rows = read_solution(out / "solution.json"), rows_of(out / "path.csv")
    assert [row["frame"] for row in rows] == [f"cut_{k:06d}.png" for k in range(20)]
    poses = {row["frame"]: [float(row[key]) for key in ("tx", "ty", "tz")] for row in rows}
    for image in solution.registered:  # key frames lie on the path, but for what is not steady within a frame
        np.testing.assert_allclose(poses[image.name], image.center_w, atol=0.01)
    assert len((out / "path.txt").read_text().splitlines()) == 21
    after, before = frames_of(out / "video.mp4"), frames_of(cut)
    assert len(after) == 20
    inner = np.s_[20:-20, 20:-20]
    reference = cv2.imread(str(WALK / "global" / "clip_000009.jpg"))[inner]
    found, raw = (each[9].to_ndarray(format="bgr24")[inner] for each in (after, before))
    assert psnr(found, reference) > max(34, psnr(raw, reference) + 6)
    assert "readout time       " in result.stdout
    assert "of the frame), measured from the video" in " ".join(result.stdout.split())
    assert "measured from the video" in (out / "report.html").read_text(encoding="utf-8")
    assert {"path.csv", "path.txt", "video.mp4", "camera.usda", "nuke/camera.nk", "nuke/camera.chan"} <= written(out)
    assert np.loadtxt(out / "nuke" / "camera.chan")[:, 0].tolist() == list(range(1, 21))
    (camera,) = solution.rectified_cameras.values()
    check_usd(out / "camera.usda", rows[9], 9, camera)


@pytest.fixture(scope="module")
def at_once(tmp_path_factory):
    """Two thirds of a second of the walk, filmed with a global shutter."""
    folder = tmp_path_factory.mktemp("at-once")
    recipe = json.loads((WALK / "recipe.json").read_text())
    recipe["path"] |= {"readout": 0.001, "num_frames": 20}
    recipe["render"]["samples"], recipe["twins"] = 2, {"every": 20}
    (folder / "recipe.json").write_text(json.dumps(recipe))
    asked = ["simulate", "scene", str(folder / "recipe.json"), "-o", str(folder / "clip")]
    CliRunner().invoke(cli, asked, catch_exceptions=False)
    return folder / "clip" / "clip.mp4"


@pytest.mark.slow
def test_a_video_of_a_global_shutter_needs_no_correction_if_the_user_says_what_it_is(at_once, tmp_path):
    how = RunOptions(max_features=1000)
    with pytest.warns(RsUndistortWarning, match="if the camera has a global shutter: run --model global"):
        unsaid = run(at_once, tmp_path / "unsaid", how)
    assert unsaid.verdict["shutter"] == "not-determined"
    said = run(at_once, tmp_path / "said", replace(how, solve=SolveOptions(shutter_model="global")))
    assert said.verdict == {"shutter": "not-found", "shape": "trusted", "reasons": []}
    assert said.shutter_model == "global"
    assert not any(image.lens_only or image.doubtful for image in said.images)
    assert "were read at once" in (tmp_path / "said" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_rolling_shutter_that_is_said_to_be_a_global_one_is_doubted(cut, tmp_path):
    how = RunOptions(max_features=1000, solve=SolveOptions(shutter_model="global"))
    with pytest.warns(RsUndistortWarning, match="The camera has a rolling shutter, which was not removed, as you"):
        found = run(cut, tmp_path / "out", how)
    assert (found.verdict["shutter"], found.verdict["shape"]) == ("not-determined", "doubtful")
    assert all(image.lens_only for image in found.registered)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"shutter_model": "global", "readout_s": 0.02}, "have no readout time; leave out --readout-ms or --mod"),
        ({"shutter_model": "rotation"}, "takes no --still, --known, --remedy or --model but global"),
        ({"still": {"walk-0001.png": 1e-4}}, "takes no --still, --known, --remedy or --model but global"),
        ({"remedy": "none"}, "takes no --still, --known, --remedy or --model but global"),
        ({"crs": "local"}, "frames of a video have no GPS"),
        (RunOptions(gyro=GyroOptions("log.csv", times="times.csv")), "have times of their own; it takes no --photo-t"),
        (RunOptions(features="affine"), "need no other features; leave --features out"),
    ],
)
def test_options_that_a_path_does_not_take_are_refused_before_the_video_is_read(cut, tmp_path, given, says):
    stages = []
    options = given if isinstance(given, RunOptions) else RunOptions(solve=SolveOptions(**given))
    with pytest.raises(InputError, match=says):
        run(cut, tmp_path / "out", options, progress=lambda *told: stages.append(told))
    with pytest.raises(InputError, match=says):
        measure_readout(cut, options)
    assert not stages
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_run_that_is_interrupted_behind_its_video_keeps_the_video_and_its_stage(cut, tmp_path, monkeypatch):
    out, options = tmp_path / "out", RunOptions(frames="all", max_features=1000)

    def stop(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Outputs, "rectify", stop)
        with pytest.raises(KeyboardInterrupt):
            run(cut, out, options)
    before = (out / "video.mp4").stat().st_mtime_ns
    names = [stage["name"] for stage in run(cut, out, options, resume=True).stages]
    assert (out / "video.mp4").stat().st_mtime_ns == before
    assert names.count("video") == 1
    assert names[names.index("video") + 1] == "rectifying"


@pytest.mark.slow
def test_frames_that_come_twice_are_corrected_as_the_one_before(cut, tmp_path):
    shown = [frame.to_ndarray(format="bgr24") for frame in frames_of(cut)]
    twice = tmp_path / "twice.mp4"
    encode(twice, [shown[k * 5 // 6] for k in range(24)], rotation=-90)
    (tmp_path / "camera.json").write_bytes((cut.parent / "camera.json").read_bytes())
    with pytest.warns(RsUndistortWarning, match="4 of 24 frames show the same as the one before.* 40.0 ms apart"):
        solution = run(
            twice, tmp_path / "out", RunOptions(
                frames="all", max_features=1000, outputs=OutputOptions(usd=True, exports=("nuke",)),
                rectify=RectifyOptions(apply_orientation=True, view=ViewOptions(scale=0.51)),
            ),
        )  # fmt: skip
    rows = rows_of(tmp_path / "out" / "path.csv")
    assert len(rows) == 20
    assert solution.options["video"]["repeated"] == [1, 7, 13, 19]
    after = [frame.to_ndarray(format="gray").astype(float) for frame in frames_of(tmp_path / "out" / "video.mp4")]
    steps = np.array([np.abs(second - first).mean() for first, second in pairwise(after)])
    again = np.isin(np.arange(1, 24), solution.options["video"]["repeated"])
    assert steps[again].max() < 0.2 * steps[~again].min()
    # for programs that play the video: a pose for each of its frames, and the sides that they are shown with
    camera = solution.rectified_cameras[solution.registered[0].camera_id]
    assert (camera.width, camera.height, *after[0].shape) == (183, 326, 182, 326)
    camera = replace(camera, width=182)
    assert np.loadtxt(tmp_path / "out" / "nuke" / "camera.chan")[:, 0].tolist() == list(range(1, 25))
    assert ' format "182 326 0 0 182 326 1 rectified"' in (tmp_path / "out" / "nuke" / "camera.nk").read_text()
    for frame, row in ((12, 10), (13, 10), (14, 11), (23, 19)):
        check_usd(tmp_path / "out" / "camera.usda", rows[row], frame, camera, last=23)


def check_usd(path, row, code, camera, last=19):
    """USD's own camera shows its points where the pose of `path.csv` does."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (30, 0, last)
    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(code).frustum
    seen = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    points = UsdGeom.Points(stage.GetPrimAtPath("/World/Points")).GetPointsAttr().Get()
    found = np.array([seen.Transform(Gf.Vec3d(*each)) for each in points])[:, :2]
    pose = {key: float(value) for key, value in row.items() if key != "frame"}
    R_wc = Rotation.from_quat([pose[f"q{axis}"] for axis in "xyzw"]).as_matrix()
    x_c = (np.array(points) * [1, -1, -1] - [pose[f"t{axis}"] for axis in "xyz"]) @ R_wc
    ahead = x_c[:, 2] > 0
    expected = (x_c / x_c[:, 2:]) @ camera.K[:2].T + 0.5
    shown = np.column_stack([(1 + found[:, 0]) / 2 * camera.width, (1 - found[:, 1]) / 2 * camera.height])
    inside = ahead & (expected > 0).all(1) & (expected < [camera.width, camera.height]).all(1)
    assert inside.sum() > 50
    np.testing.assert_allclose(shown[inside], expected[inside], atol=1e-3)


def written(out):
    return {json.loads(line)[0] for line in (out / ".rsundistort-written").read_text().splitlines()}
