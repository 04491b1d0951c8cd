"""Videos with something wrong: one line that says what, or a warning and a result without it."""

from __future__ import annotations

import warnings
from fractions import Fraction

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from make_photos import texture
from rsundistort_cli.main import cli

from rsundistort.errors import InputError, RsUndistortWarning
from rsundistort.input.key_frames import read_clip
from rsundistort.io.video import VideoReader

av = pytest.importorskip("av")

WIDTH, HEIGHT = 320, 240
SCENE = texture(WIDTH + 200, HEIGHT, seed=5)


def view(number):
    return np.ascontiguousarray(SCENE[:, 3 * number : 3 * number + WIDTH])


def encode(path, frames, codec="libx264", pix_fmt="yuv420p", options=None, rotation=0):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options=options or {})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = pix_fmt
        if rotation:
            stream.set_display_rotation(rotation)
        for pixels in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="bgr24")))
        container.mux(stream.encode(None))
    return path


def only_sound(path):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=16000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 16000), np.float32), format="fltp", layout="mono")
        sound.sample_rate = 16000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    return path


def only_a_cover(path):
    """Sound with a picture of its cover, which is a video stream of one frame."""
    with av.open(str(path), "w") as container:
        sound = container.add_stream("aac", rate=16000)
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = WIDTH, HEIGHT, "yuvj420p"
        cover.disposition = av.stream.Disposition.attached_pic
        container.mux(cover.encode(av.VideoFrame.from_ndarray(view(0), format="bgr24")))
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 16000), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16000
        container.mux(sound.encode(frame))
        for stream in (cover, sound):
            container.mux(stream.encode(None))
    return path


BLACK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (only_sound, "holds no pictures"),
        (only_a_cover, "holds no pictures"),
        (lambda path: encode(path, [view(0)]), "only one frame that shows anything new; a path needs two"),
        (lambda path: encode(path, [BLACK] * 6), "no frame that shows anything; a path needs two"),
        (lambda path: path.write_bytes(b"no video\n" * 99), "cannot be read as a video"),
        (lambda path: path.write_bytes(b""), "cannot be read as a video"),
    ],
)
@pytest.mark.parametrize("command", ["run", "readout"])
def test_a_video_that_tells_nothing_ends_in_one_line(tmp_path, command, make, says):
    make(tmp_path / "clip.mp4")
    out = ["-o", str(tmp_path / "out")] if command == "run" else []
    camera = ["--camera", "300,300,160,120"]
    result = CliRunner().invoke(cli, [command, str(tmp_path / "clip.mp4"), *out, *camera])
    assert result.exit_code == 1, result.exception
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert says in line
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


def test_a_size_that_changes_midway_ends_the_video_there(tmp_path):
    """Two recordings in one transport stream."""
    small = np.ascontiguousarray(view(9)[:120, :160])
    a = encode(tmp_path / "a.ts", [view(k) for k in range(12)]).read_bytes()
    b = encode(tmp_path / "b.ts", [small] * 12).read_bytes()
    (tmp_path / "clip.ts").write_bytes(a + b)
    with pytest.warns(RsUndistortWarning, match=r"clip\.ts: its frames change size at 0\.\d s; what follows was left"):
        clip = read_clip(tmp_path / "clip.ts", tmp_path / "frames")
    assert 8 <= len(clip.names) <= 12


def test_frames_whose_time_runs_back_are_left_out(tmp_path):
    """A recording that begins again in the same stream: its times do, too."""
    one = encode(tmp_path / "a.ts", [view(k) for k in range(20)], options={"bf": "0"}).read_bytes()
    (tmp_path / "clip.ts").write_bytes(one + one)
    with pytest.warns(RsUndistortWarning, match=r"clip\.ts: \d+ frames whose time runs back were left out"):
        clip = read_clip(tmp_path / "clip.ts", tmp_path / "frames")
    assert (np.diff(clip.time_s) > 0).all()
    assert len(clip.names) >= 20


@pytest.mark.parametrize("rate", [24, 25, 20, 15, 12])
def test_frames_of_a_converted_video_have_the_times_of_their_own_rate(tmp_path, rate):
    shown = [k * rate // 30 for k in range(50)]
    video = encode(tmp_path / "clip.mp4", [view(k) for k in shown])
    with pytest.warns(RsUndistortWarning, match=rf"{1e3 / rate:.1f} ms apart"):
        clip = read_clip(video, tmp_path / "frames")
    assert len(clip.numbers) == shown[-1] + 1
    np.testing.assert_allclose(np.diff(clip.time_s), 1 / rate)
    assert clip.frame_s == pytest.approx(1 / rate)


def test_frames_that_come_twice_are_left_out(tmp_path):
    """Of 25 frames a second, converted to 30: each fifth frame comes twice."""
    shown = [k - k // 6 for k in range(42)]
    video = encode(tmp_path / "clip.mp4", [view(k) for k in shown])
    with pytest.warns(
        RsUndistortWarning, match=r"clip\.mp4: 6 of 42 frames show the same as the one before.* 40\.0 ms apart"
    ):
        clip = read_clip(video, tmp_path / "frames")
    assert clip.repeated == (6, 12, 18, 24, 30, 36)
    assert clip.numbers == tuple(k for k in range(42) if k not in clip.repeated)
    np.testing.assert_allclose(np.diff(clip.time_s), 1 / 25)
    assert not clip.part.any()


def test_a_picture_that_freezes_is_a_pause(tmp_path):
    shown = [*range(15), *[14] * 30, *range(15, 30)]
    video = encode(tmp_path / "clip.mp4", [view(k) for k in shown])
    with pytest.warns(RsUndistortWarning, match="30 of 60 frames show the same") as said:
        clip = read_clip(video, tmp_path / "frames")
    assert "apart" not in str(said[0].message)
    assert np.diff(clip.time_s).max() == pytest.approx(31 / 30)
    assert clip.part.tolist() == [0] * 15 + [1] * 15


def test_pictures_that_have_nothing_in_common_share_no_path(tmp_path):
    video = encode(tmp_path / "clip.mp4", [texture(WIDTH, HEIGHT, seed) for seed in range(6)])
    with pytest.raises(InputError, match=r"no frame of clip\.mp4 goes on from the one before.*--every N"):
        read_clip(video, tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


@pytest.mark.filterwarnings("error")
def test_a_calm_scene_after_a_cut_or_a_flash_is_not_taken_for_frames_that_come_twice(tmp_path):
    """Where the step before was a large one, all that follow are small beside it."""
    blurred = cv2.GaussianBlur(SCENE, (0, 0), 6.0)
    other = [np.ascontiguousarray(blurred[::-1, k : k + WIDTH]) for k in range(20)]
    flash = np.clip(other[9].astype(int) + 100, 0, 255).astype(np.uint8)
    frames = [*(view(3 * k) for k in range(10)), *other[:9], flash, *other[10:]]
    assert read_clip(encode(tmp_path / "clip.mp4", frames), tmp_path / "frames").repeated == ()


def test_dark_frames_are_left_out(tmp_path):
    frames = [view(k) for k in range(10)]
    frames[4] = frames[5] = BLACK
    clip = read_clip(encode(tmp_path / "clip.mp4", frames), tmp_path / "frames")
    assert clip.numbers == (0, 1, 2, 3, 6, 7, 8, 9)


def test_an_interlaced_video_is_refused_with_what_mends_it(tmp_path):
    options = {"x264-params": "interlaced=1:tff=1", "flags": "+ildct+ilme"}
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(10)], options=options)
    with VideoReader(video) as reader:
        if not any(picture.interlaced_frame for _, _, picture in reader):
            pytest.skip("this FFmpeg does not encode interlaced frames")
    with pytest.raises(InputError, match=r'interlaced: each frame holds two moments.* ffmpeg -i "clip\.mp4" -vf bwdif'):
        read_clip(video, tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


def test_ten_bits_and_a_rotation_are_no_trouble(tmp_path):
    frames = [view(k) for k in range(8)]
    video = encode(tmp_path / "clip.mp4", frames, pix_fmt="yuv420p10le", rotation=-90)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        clip = read_clip(video, tmp_path / "frames")
    assert clip.frames.orientation == 6
    stored = cv2.imread(str(tmp_path / "frames" / clip.key_names[0]), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    assert stored.shape == (HEIGHT, WIDTH, 3)


def test_tags_in_another_encoding_are_no_trouble(tmp_path):
    with av.open(str(tmp_path / "clip.mp4"), "w") as container:
        container.metadata["comment"] = "AAAAAAAA"
        stream = container.add_stream("libx264", rate=Fraction(30))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for k in range(4):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(view(k), format="bgr24")))
        container.mux(stream.encode(None))
    data = (tmp_path / "clip.mp4").read_bytes()
    (tmp_path / "clip.mp4").write_bytes(data.replace(b"AAAAAAAA", b"\xff\xfe\xe4\xf6\xfc\xc3\xc3\xc3"))
    assert len(read_clip(tmp_path / "clip.mp4", tmp_path / "frames").names) == 4


def test_key_frames_do_not_depend_on_the_memory_that_pictures_are_held_in(tmp_path, monkeypatch):
    video = encode(tmp_path / "clip.mp4", [view(k) for k in range(30)])
    one = read_clip(video, tmp_path / "one")
    monkeypatch.setattr("rsundistort.input.key_frames._HELD_BYTES", 0.0)
    other = read_clip(video, tmp_path / "other")
    assert (one.keys == other.keys).all()
    assert len(one.keys) >= 2
    files = [{path.name: path.read_bytes() for path in each.folder.iterdir()} for each in (one, other)]
    assert files[0] == files[1]
