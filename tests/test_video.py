"""Frames of videos: small ones, encoded here."""

from __future__ import annotations

import builtins
import csv
import shutil
from fractions import Fraction

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from make_photos import COURTYARD_NAMES, half_courtyard, texture
from rsundistort_cli.main import cli

from rsundistort import RsUndistortWarning, RunOptions, read_solution, run
from rsundistort.errors import FileError, InputError
from rsundistort.io import extract_frames, is_video, read_photo

av = pytest.importorskip("av")

WIDTH, HEIGHT = 320, 240
SCENE = texture(WIDTH + 200, HEIGHT, seed=3)


def view(number):
    """What frame number k shows."""
    return np.ascontiguousarray(SCENE[:, 2 * number : 2 * number + WIDTH])


def encode(path, frames, codec="libx264", pix_fmt="yuv420p", times_ms=None, rotation=0, tags=None, options=None):
    """A video of BGR frames, 30 a second or at given times."""
    with av.open(str(path), "w", options={"movflags": "faststart"} if path.suffix == ".mp4" else {}) as container:
        container.metadata.update(tags or {})
        stream = container.add_stream(codec, rate=30, options={"g": "10", **(options or {})})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pix_fmt
        if times_ms is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        if rotation:
            stream.set_display_rotation(rotation)
        for k, pixels in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(pixels, format="bgr24")
            if times_ms is not None:
                frame.pts, frame.time_base = times_ms[k], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def lossless(path, frames, **kwargs):
    return encode(path, frames, codec="ffv1", pix_fmt="bgr0", **kwargs)


def rows(folder):
    return list(csv.DictReader((folder / "frames.csv").read_text(encoding="utf-8").splitlines()))


# ---------------------------------------------------------------- which frames


def test_every_nth_frame_with_its_time(tmp_path):
    video = lossless(tmp_path / "clip one.mkv", [view(k) for k in range(25)])
    steps = []
    frames = extract_frames(video, tmp_path / "out", every=10, progress=lambda *args: steps.append(args))
    assert frames.names == ("clip one_000000.png", "clip one_000010.png", "clip one_000020.png")
    assert sorted(path.name for path in (tmp_path / "out").glob("[!.]*")) == [*frames.names, "frames.csv"]
    for name, number in zip(frames.names, (0, 10, 20), strict=True):
        assert np.array_equal(read_photo(tmp_path / "out" / name).pixels, view(number))
    # Matroska rounds times to milliseconds
    assert frames.time_s == pytest.approx([0, 10 / 30, 20 / 30], abs=1e-3)
    table = rows(tmp_path / "out")
    assert [row["name"] for row in table] == list(frames.names)
    assert [int(row["frame"]) for row in table] == [0, 10, 20]
    assert [float(row["time_s"]) for row in table] == pytest.approx(frames.time_s, abs=1e-6)
    assert (frames.num_frames, frames.num_damaged, frames.orientation) == (25, 0, 1)
    assert steps[-1][0] == 25


def test_the_sharpest_of_each_group(tmp_path):
    sharp = {3, 8, 10, 19}
    pictures = [view(k) if k in sharp else cv2.GaussianBlur(view(k), (0, 0), 1.5 + k % 3) for k in range(20)]
    frames = extract_frames(lossless(tmp_path / "clip.mkv", pictures), tmp_path / "out", sharpest=5)
    assert [int(row["frame"]) for row in rows(tmp_path / "out")] == sorted(sharp)
    assert len(frames.names) == 4
    assert np.array_equal(read_photo(tmp_path / "out" / frames.names[1]).pixels, view(8))


def test_the_same_video_gives_the_same_files(tmp_path):
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(12)])
    for out in ("a", "b"):
        extract_frames(video, tmp_path / out, sharpest=4)
    for path in (tmp_path / "a").glob("[!.]*"):
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_times_of_a_variable_frame_rate(tmp_path):
    times_ms = np.cumsum([0, 33, 33, 90, 20, 33, 41, 200, 33])
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(9)], times_ms=(times_ms + 500).tolist())
    frames = extract_frames(video, tmp_path / "out", every=2)
    assert frames.time_s == pytest.approx(times_ms[::2] / 1e3, abs=1e-3)


def test_a_stream_that_starts_late_starts_at_zero(tmp_path):
    """Transport streams start at 1.4 s, or whenever the camera was switched on."""
    frames = extract_frames(encode(tmp_path / "clip.ts", [view(k) for k in range(6)]), tmp_path / "out", every=3)
    assert frames.time_s == pytest.approx([0, 0.1], abs=1e-3)


def test_a_stream_without_times(tmp_path):
    video = encode(tmp_path / "clip.h264", [view(k) for k in range(6)])
    with pytest.warns(RsUndistortWarning, match="6 frames have no time"):
        frames = extract_frames(video, tmp_path / "out", every=3)
    assert np.isnan(frames.time_s).all()
    assert [row["time_s"] for row in rows(tmp_path / "out")] == ["", ""]


# ---------------------------------------------------------------- pixels


def test_rotation_is_carried_and_not_applied(tmp_path):
    if not hasattr(av.VideoStream, "set_display_rotation"):
        pytest.skip("this PyAV cannot write a display matrix")
    for angle, orientation in ((-90, 6), (90, 8), (180, 3)):
        folder = tmp_path / str(orientation)
        video = encode(tmp_path / f"{orientation}.mp4", [view(0)] * 2, rotation=angle)
        frames = extract_frames(video, folder, every=1)
        photo = read_photo(folder / frames.names[0])
        assert frames.orientation == orientation
        assert photo.pixels.shape == (HEIGHT, WIDTH, 3)
        if hasattr(cv2, "imencodeWithMetadata"):
            upright = cv2.imread(str(folder / frames.names[0]), cv2.IMREAD_COLOR)  # rotates as the EXIF says
            turn = {6: cv2.ROTATE_90_CLOCKWISE, 8: cv2.ROTATE_90_COUNTERCLOCKWISE, 3: cv2.ROTATE_180}[orientation]
            assert np.array_equal(upright, cv2.rotate(photo.pixels, turn))


def test_make_and_model_are_carried(tmp_path):
    video = lossless(tmp_path / "clip.mkv", [view(k) for k in range(3)], tags={"make": "Apple", "model": "iPhone 6s"})
    frames = extract_frames(video, tmp_path / "out", every=1)
    assert (frames.make, frames.model) == ("Apple", "iPhone 6s")


def test_more_than_eight_bits_stay(tmp_path):
    video = encode(tmp_path / "deep.mkv", [view(0)] * 2, codec="ffv1", pix_fmt="yuv444p10le")
    frames = extract_frames(video, tmp_path / "out", every=1)
    pixels = read_photo(tmp_path / "out" / frames.names[0]).pixels
    assert pixels.dtype == np.uint16
    assert np.abs(pixels / 257.0 - view(0)).max() < 3  # the way to YUV and back


# ---------------------------------------------------------------- damaged videos


NOISE = np.random.default_rng(0).integers(0, 256, (160, 280, 3), dtype=np.uint8)


def noise(number):
    """What nothing compresses, so that each frame has its share of the bytes."""
    return np.ascontiguousarray(np.roll(NOISE, 17 * number, axis=1)[:, :200])


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])  # a transport stream has no length that it could fall short of
def test_a_video_that_was_cut_short_gives_what_it_has(tmp_path, suffix):
    video = encode(tmp_path / f"clip{suffix}", [noise(k) for k in range(40)])
    video.write_bytes(video.read_bytes()[: video.stat().st_size * 11 // 20])
    with pytest.warns(RsUndistortWarning, match=f"clip{suffix}: .*(ends at|damaged)"):
        frames = extract_frames(video, tmp_path / "out", every=5)
    assert 4 <= len(frames.names) <= 5
    assert 16 <= frames.num_frames <= 24


def test_frames_that_build_on_a_damaged_one_are_left_out(tmp_path):
    """A key frame loses its end: what is left is, bit by bit, what the whole video gives but for ten frames."""
    plain = {"bf": "0", "sc_threshold": "0"}  # a key frame each ten frames, in the order of presentation
    video = encode(tmp_path / "clip.mp4", [noise(k) for k in range(30)], options=plain)
    whole = extract_frames(video, tmp_path / "whole", every=1)
    with av.open(str(video)) as container:
        packets = [(p.pos, p.size) for p in container.demux(container.streams.video[0]) if p.size]
    start, size = packets[10]
    data = bytearray(video.read_bytes())
    data[start + size // 4 : start + size] = bytes(size - size // 4)
    video.write_bytes(data)
    with pytest.warns(RsUndistortWarning, match="frames or more are damaged"):
        left = extract_frames(video, tmp_path / "left", every=1)
    assert left.num_damaged > 0
    assert left.time_s == pytest.approx(np.delete(whole.time_s, np.s_[10:20]))
    for name, same in zip(left.names, np.delete(whole.names, np.s_[10:20]), strict=True):
        assert (tmp_path / "left" / name).read_bytes() == (tmp_path / "whole" / same).read_bytes()


def test_what_is_no_video_is_refused(tmp_path):
    whole = encode(tmp_path / "whole.mkv", [view(0)] * 3).read_bytes()
    for name, data in (("empty.mp4", b""), ("text.mp4", b"no video\n" * 99), ("head.mkv", whole[:200])):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(FileError, match=name):
            extract_frames(tmp_path / name, tmp_path / "out", every=1)
        assert not (tmp_path / "out").exists()
    with pytest.raises(FileError, match=r"none\.mp4"):
        extract_frames(tmp_path / "none.mp4", tmp_path / "out", every=1)


def test_which_frames_must_be_said(tmp_path):
    video = encode(tmp_path / "clip.mp4", [view(0)] * 3)
    for kwargs in ({}, {"every": 2, "sharpest": 2}):
        with pytest.raises(InputError, match="--every N or --sharpest N"):
            extract_frames(video, tmp_path / "out", **kwargs)
    with pytest.raises(InputError, match="1 or more"):
        extract_frames(video, tmp_path / "out", every=-1)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("stays")
    with pytest.raises(FileError, match="not empty"):
        extract_frames(video, tmp_path / "out", every=1)


def test_a_video_without_the_extra(tmp_path, monkeypatch):
    video = encode(tmp_path / "clip.mp4", [view(0)] * 3)
    original = builtins.__import__

    def without_av(name, *args, **kwargs):
        if name.split(".")[0] == "av":
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_av)
    with pytest.raises(InputError, match=r'pip install "rsundistort\[video\]"'):
        extract_frames(video, tmp_path / "out", every=1)


def test_videos_are_known_by_their_ending(tmp_path):
    (tmp_path / "CLIP.MOV").write_bytes(b"")
    (tmp_path / "photo.jpg").write_bytes(b"")
    (tmp_path / "folder.mp4").mkdir()
    assert is_video(tmp_path / "CLIP.MOV")
    assert not is_video(tmp_path / "photo.jpg")
    assert not is_video(tmp_path / "folder.mp4")
    assert not is_video(tmp_path / "none.mp4")


# ---------------------------------------------------------------- run


@pytest.fixture
def invoke(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return lambda *args: CliRunner().invoke(cli, [str(arg) for arg in args])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--every", "4", "--sharpest", "4"], "--every N or --sharpest N"),
        (["--every", "4"], "2 photos; the shutter needs at least three"),
        (["--every", "1", "--camera", "300,300,160,120", "--gyro", "gyro.csv"], "Give --readout-ms"),
        (["--every", "1", "--gyro", "gyro.csv", "--gyro-axes", "XX"], "expected X, Y and Z"),
        (["--every", "1", "--camera", "300,300,160,120", "--gyro", "gyro.csv", "--readout-ms", "30"], "covers none"),
    ],
)
def test_run_refuses_in_one_line_and_writes_nothing(invoke, tmp_path, options, says):
    encode(tmp_path / "clip.mp4", [view(k) for k in range(8)])
    (tmp_path / "gyro.csv").write_text("time_s,wx,wy,wz\n100,0,0,0\n101,0,0,0\n")
    before = sorted(path.name for path in tmp_path.iterdir())
    result = invoke("run", "clip.mp4", "-o", "out", "--max-features", "300", *options)
    assert result.exit_code == 1, result.exception
    lines = result.stderr.splitlines()
    assert lines[-1].startswith("error: ")
    assert says in lines[-1]
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_video_that_is_not_there_is_no_folder_of_photos(tmp_path):
    with pytest.raises(FileError, match=r"none\.MP4 does not exist; give a video, or a folder of photos"):
        run(tmp_path / "none.MP4", tmp_path / "out", RunOptions(frames="all"))
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_a_scene_that_slides_by_determines_no_focal_length_and_that_is_said(invoke, tmp_path):
    encode(tmp_path / "clip.mp4", [view(k) for k in range(8)])
    result = invoke("run", "clip.mp4", "-o", "out", "--max-features", "300")
    assert result.exit_code == 0, result.stderr
    assert "the photos hardly determine their focal length" in result.stderr
    solution = read_solution(tmp_path / "out" / "solution.json")
    assert solution.verdict["shape"] == "doubtful"
    (sigma,) = solution.quality["sigma_intrinsics"].values()
    (camera,) = solution.cameras.values()
    assert sigma["f"] > 0.2 * camera.K[0, 0]


def test_options_of_videos_with_a_folder_are_refused(tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError, match="no video"):
        run(tmp_path / "photos", tmp_path / "out", RunOptions(every=3))


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """The courtyard at half size as a video of six frames, half a second apart, and what a gyroscope measured."""
    folder = tmp_path_factory.mktemp("walk")
    photos = half_courtyard(folder)
    frames = [cv2.imread(str(photos / name)) for name in COURTYARD_NAMES]
    times_ms = [500 * k for k in range(len(frames))]
    lossless(folder / "walk.mkv", frames, times_ms=times_ms)
    shutil.rmtree(photos)
    truth = read_solution(folder / "ground_truth.json")
    span = truth.cameras["1"].frame_span
    readout_s, lag_s = 0.025, 7.0
    t = np.arange(0, 2.8, 0.002)
    nearest = np.clip(np.rint(t / 0.5), 0, len(frames) - 1).astype(int)
    phi_frame = np.array([image.motion.phi for image in truth.images])[nearest] * span
    # the sensor's x points left, its y down, its z back
    rates = -phi_frame / readout_s * [-1, 1, -1]
    lines = [
        "time_s,wx,wy,wz",
        *(f"{a + lag_s:.4f},{b[0]:.6f},{b[1]:.6f},{b[2]:.6f}" for a, b in zip(t, rates, strict=True)),
    ]
    (folder / "gyro.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_run_of_a_video_with_a_gyroscope(walk, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    gyro = f"--gyro {walk / 'gyro.csv'} --gyro-offset 7 --gyro-axes xYz --readout-ms 25"
    result = CliRunner().invoke(
        cli,
        [*f"run {walk / 'walk.mkv'} -o out --every 1 --model rotation --max-features 800".split(), *gyro.split()],
    )
    assert result.exit_code == 0, (result.stderr, result.exception)
    solution = read_solution(tmp_path / "out" / "solution.json")
    truth = read_solution(walk / "ground_truth.json")
    assert len(solution.registered) == 6
    # photo 0 begins before the log
    assert "covers" not in result.stderr
    assert "does not cover 1 of 6 photos, such as walk_000000.png" in result.stderr
    span = truth.cameras["1"].frame_span
    errors = [
        np.abs(found.motion.phi - real.motion.phi).max() * span
        for found, real in zip(solution.images, truth.images, strict=True)
    ]
    assert max(errors) < 2e-3
    assert sorted(path.name for path in (tmp_path / "out" / "frames").glob("[!.]*")) == sorted(
        [*(image.name for image in solution.images), "frames.csv"]
    )
    assert {path.name for path in (tmp_path / "out" / "images").iterdir()} == {i.name for i in solution.images}
    assert solution.quality["readout_times"] == {"1": {"ms": 25, "source": "given"}}
    assert solution.options["video"]["name"] == "walk.mkv"
    assert solution.options["gyro"]["offset_s"] == 7
    assert len(solution.options["known"]) == 5
    assert "video              6 of 6 frames" in result.stdout
    span = solution.cameras["1"].frame_span
    turned = np.degrees(np.linalg.norm([image.motion.phi for image in solution.images], axis=1)) * span / 0.025
    assert f"median {np.sort(turned)[3]:.1f}, largest {turned.max():.1f} deg/s, by a readout of" in result.stdout
    assert "  25 ms (given)\n" in result.stdout
