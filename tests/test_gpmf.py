"""GoPro's telemetry: payloads and MP4 files that are built here, item by item, and real ones where they are at hand."""

from __future__ import annotations

import struct
import time
import tracemalloc
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsundistort import RsUndistortWarning
from rsundistort.errors import FileError, FormatError
from rsundistort.io import has_telemetry, motions_from_gyro, read_gpmf, read_gyro
from rsundistort.io.gpmf import _sample_times, parse_payload

av = pytest.importorskip("av")

SHARED = Path(__file__).resolve().parent.parent.parent / "shared" / "video"
SCALE = 1000
RATE_HZ = 400.0


def item(key, kind, size, repeat, data=b""):
    """Key, length, value, padded to four bytes."""
    return struct.pack(">4scBH", key, kind, size, repeat) + data + bytes(-len(data) % 4)


def text(key, value):
    return item(key, b"c", 1, len(value), value)


def nested(key, *items):
    data = b"".join(items)
    return item(key, b"\0", 1, len(data), data)


def number(key, kind, code, value):
    data = struct.pack(">" + code, value)
    return item(key, kind, len(data), 1, data)


def gyro(counts, *, scale=SCALE, unit=b"rad/s", total=None, before=(), kind=b"s", code="h"):
    """A stream of the gyroscope; `counts` (n, 3) as they are stored."""
    counts = np.atleast_2d(counts)
    data = counts.astype(np.dtype(code).newbyteorder(">")).tobytes()
    return nested(
        b"STRM",
        *([] if total is None else [number(b"TSMP", b"L", "I", total)]),
        text(b"STNM", b"Gyroscope (z,x,y)"),
        *before,
        text(b"SIUN", unit),
        *([] if scale is None else [number(b"SCAL", b"s", "h", scale)]),
        item(b"GYRO", kind, 3 * np.dtype(code).itemsize, len(counts), data),
    )


def accelerometer(n=5):
    return nested(b"STRM", number(b"SCAL", b"s", "h", 418), item(b"ACCL", b"s", 6, n, bytes(6 * n)))


def payload(*streams, name=b"Camera"):
    return nested(b"DEVC", number(b"DVID", b"L", "I", 1), text(b"DVNM", name), *streams)


COUNTS = np.array([[172, 70, 125], [-61, 9, -285], [199, 22, 26]])
# HERO5's Z, X, Y are up, left and back: right, down and ahead are the other way
IN_CAMERA = -COUNTS[:, [1, 0, 2]] / SCALE


def camera_rates(found):
    return found.rates @ found.orientation.T


# ---------------------------------------------------------------- payloads


def test_samples_of_the_gyroscope_in_the_camera_axes():
    found = parse_payload(payload(accelerometer(), gyro(COUNTS, total=403)))
    assert camera_rates(found) == pytest.approx(IN_CAMERA)
    assert (found.device, found.num_before, found.stamp_s, found.problems) == ("Camera", 400, None, ())


@pytest.mark.parametrize(
    ("kind", "code"), [(b"b", "i1"), (b"s", "i2"), (b"l", "i4"), (b"j", "i8"), (b"f", "f4"), (b"d", "f8")]
)
def test_types_of_numbers(kind, code):
    counts = np.array([[1, -2, 3], [100, -128, 7]])
    found = parse_payload(payload(gyro(counts, kind=kind, code=code)))
    assert found.rates == pytest.approx(counts / SCALE)


def test_scale_for_each_axis_none_and_degrees():
    each = item(b"SCAL", b"s", 2, 3, struct.pack(">3h", 10, 100, 1000))
    assert parse_payload(payload(gyro(COUNTS, scale=None, before=[each]))).rates == pytest.approx(
        COUNTS / [10, 100, 1000]
    )
    assert parse_payload(payload(gyro(COUNTS, scale=None))).rates == pytest.approx(COUNTS)
    assert parse_payload(payload(gyro(COUNTS, unit=b"deg/s"))).rates == pytest.approx(np.radians(COUNTS / SCALE))
    odd = parse_payload(payload(gyro(COUNTS, unit=b"rpm")))
    assert odd.rates == pytest.approx(COUNTS / SCALE)
    assert odd.problems == ("unit 'rpm' is taken for rad/s",)


@pytest.mark.parametrize("letters", ["ZXY", "YxZ", "zxY", "XYZ", "xyZ"])
def test_orin_says_which_axis_each_number_is_about(letters):
    """The camera rotates about its own right, down and ahead; the numbers are stored as the letters say."""
    omega = np.array([0.3, -0.2, 0.7])
    about = {"X": -omega[0], "Y": -omega[2], "Z": -omega[1]}  # left, back, up
    stored = [about[letter.upper()] * (1 if letter.isupper() else -1) for letter in letters]
    found = parse_payload(payload(gyro(np.round(1000 * np.array(stored)), before=[text(b"ORIN", letters.encode())])))
    assert camera_rates(found)[0] == pytest.approx(omega)
    assert np.linalg.det(found.orientation) == pytest.approx(np.sign(np.linalg.det(found.orientation)))


def test_cameras_that_do_not_say_their_axes():
    hero6 = parse_payload(payload(gyro(COUNTS), name=b"Hero6 Black"))
    said = parse_payload(payload(gyro(COUNTS, before=[text(b"ORIN", b"YxZ")])))
    assert np.array_equal(hero6.orientation, said.orientation)
    strange = parse_payload(payload(gyro(COUNTS, before=[text(b"ORIN", b"QQQ")])))
    assert camera_rates(strange) == pytest.approx(IN_CAMERA)
    assert "'QQQ'" in strange.problems[0]


def test_unknown_keys_other_devices_and_padding_are_passed_over():
    unknown = nested(b"STRM", item(b"wxyz", b"?", 7, 3, bytes(21)), nested(b"QQQQ", number(b"AAAA", b"L", "I", 1)))
    empty = nested(b"STRM", item(b"GYRO", b"s", 6, 0))
    watch = payload(gyro(2 * COUNTS), name=b"Watch")
    found = parse_payload(payload(unknown, empty, gyro(COUNTS)) + watch + bytes(12))
    assert found.rates == pytest.approx(COUNTS / SCALE)
    assert found.problems == ()


def test_readout_and_stamps():
    stamped = gyro(COUNTS, before=[number(b"STMP", b"J", "Q", 2_500_000)])
    frames = nested(b"STRM", number(b"STMP", b"J", "Q", 2_450_000), number(b"SHUT", b"f", "f", 0.002))
    found = parse_payload(payload(stamped, frames, nested(b"STRM", number(b"SROT", b"f", "f", 14.9))))
    assert (found.stamp_s, found.frame_stamp_s) == pytest.approx((2.5, 2.45))
    assert found.readout_s == pytest.approx(0.0149)
    assert parse_payload(payload(nested(b"STRM", number(b"SROT", b"f", "f", 1e9)))).readout_s is None


# ---------------------------------------------------------------- damaged payloads


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (payload(gyro(COUNTS, scale=0)), "SCAL is 0"),
        (payload(gyro(COUNTS, scale=None, before=[item(b"SCAL", b"s", 2, 0)])), "SCAL is empty"),
        (payload(nested(b"STRM", item(b"GYRO", b"s", 4, 2, bytes(8)))), "4 bytes a sample"),
        (payload(nested(b"STRM", item(b"GYRO", b"?", 6, 2, bytes(12)))), "type '?'"),
        (payload(gyro(np.full((2, 3), np.nan), kind=b"f", code="f4")), "no numbers"),
        (b"\xff\xfe\xfd\xfc" * 20, "no key"),
    ],
)
def test_what_cannot_be_read_is_named(data, says):
    found = parse_payload(data)
    assert len(found.rates) == 0
    assert says in "; ".join(found.problems)


def test_a_payload_cut_short_gives_the_samples_that_are_there():
    whole = payload(gyro(np.tile(COUNTS, (10, 1))))
    found = parse_payload(whole[:-50])  # 180 bytes of samples
    assert len(found.rates) == 21
    assert "GYRO is cut short" in found.problems
    assert found.rates[:3] == pytest.approx(COUNTS / SCALE)


def test_sizes_that_lie_do_not_reach_beyond_what_holds_them():
    inner = struct.pack(">4scBH", b"GYRO", b"s", 6, 65535) + COUNTS.astype(">i2").tobytes()
    stream = struct.pack(">4scBH", b"STRM", b"\0", 255, 65535) + inner
    found = parse_payload(struct.pack(">4scBH", b"DEVC", b"\0", 255, 65535) + stream)
    assert found.rates == pytest.approx(COUNTS)
    assert set(found.problems) == {f"{key} is cut short" for key in ("DEVC", "STRM", "GYRO")}


def test_nesting_without_end_ends():
    data = b""
    for key in (b"DEVC", b"STRM") * 2000:
        data = struct.pack(">4scBH", key, b"\0", 1, min(len(data), 65535)) + data
    start = time.perf_counter()
    assert len(parse_payload(data).rates) == 0
    headers = struct.pack(">4scBH", b"DEVC", b"\0", 0, 0) * 100_000
    assert len(parse_payload(headers).rates) == 0
    assert time.perf_counter() - start < 5  # 0.2 s where this was written


@given(st.data())
def test_any_damage_gives_a_payload(data):
    """Bytes of a good payload changed, cut and repeated: nothing is raised, and no sample is invented."""
    stream = gyro(np.arange(60).reshape(-1, 3), total=100, before=[text(b"ORIN", b"YxZ")])
    good = bytearray(payload(accelerometer(), stream))
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(good) - 1))
        good[at] = data.draw(st.integers(0, 255))
    start, end = sorted(data.draw(st.tuples(st.integers(0, 40), st.integers(0, len(good)))))
    found = parse_payload(bytes(good[start:end] + good[: data.draw(st.integers(0, 60))]))
    assert found.rates.shape[1] == 3
    assert 3 * len(found.rates) <= len(good) + 60
    assert np.isfinite(found.rates).all()
    assert found.orientation.shape == (3, 3)


@given(st.binary(max_size=400))
def test_noise_gives_a_payload(data):
    assert parse_payload(data).rates.shape[1] == 3


# ---------------------------------------------------------------- files


def mux(path, payloads, *, times_ms=None, lengths_ms=None, start_ms=0, frames=5):
    """An MP4 with some frames and a gpmd track."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=30)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        track = container.add_data_stream("bin_data") if payloads is not None else None
        if track is not None:
            track.time_base = Fraction(1, 1000)
        for _ in range(frames):
            container.mux(video.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="bgr24")))
        container.mux(video.encode(None))
        for k, data in enumerate(payloads or []):
            packet = av.Packet(data)
            packet.stream = track
            packet.time_base = Fraction(1, 1000)
            packet.pts = packet.dts = times_ms[k] if times_ms is not None else start_ms + 1000 * k
            packet.duration = lengths_ms[k] if lengths_ms is not None else 1000
            container.mux(packet)
    return path


def omega(t):
    """Rates of the camera about right, down and ahead."""
    t = np.asarray(t)
    return np.stack([np.sin(3 * t), 0.5 * np.cos(2 * t), 0.3 + 0.1 * t], axis=-1)


def stored(t):
    """As HERO5 stores them: about up, left and back."""
    return np.round(-omega(t)[:, [1, 0, 2]] * SCALE)


def telemetry(counts, *, first_s=0.0, with_total=True, rate_hz=RATE_HZ, before=lambda total: []):
    """Payloads with so many samples each, taken uniformly from a time on."""
    ends = np.cumsum(counts)
    return [
        payload(
            gyro(
                stored(first_s + np.arange(end - count, end) / rate_hz),
                total=int(end) if with_total else None,
                before=before(end - count),
            )
        )
        for end, count in zip(ends, counts, strict=True)
    ]


def test_a_video_as_a_log(tmp_path):
    path = mux(tmp_path / "GX010001.MP4", telemetry([400] * 5))
    assert has_telemetry(path)
    log = read_gpmf(path)
    assert len(log.time_s) == 2000
    assert log.time_s == pytest.approx(np.arange(2000) / RATE_HZ, abs=1e-9)
    assert log.omega_c == pytest.approx(omega(log.time_s), abs=0.51 / SCALE)
    assert log.readout_s is None


def test_everything_that_takes_a_log_takes_the_video(tmp_path):
    path = mux(tmp_path / "clip.mp4", telemetry([400] * 3))
    known = motions_from_gyro(read_gyro(path), {"a": 1.0}, 0.02)
    assert known["a"][0] == pytest.approx(-0.02 * omega(1.0), rel=5e-3)
    # -y right, -x down, -z ahead of what is stored
    assert np.array_equal(read_gyro(path, "yxz").omega_c, read_gyro(path).omega_c)
    assert read_gyro(path, "XYZ").omega_c == pytest.approx(stored(read_gyro(path).time_s) / SCALE, abs=1.1 / SCALE)


def test_times_are_uniform_though_payloads_hold_what_there_happened_to_be(tmp_path, rng):
    """Samples come in packs of seven: payloads are early or late by up to 9 ms; the line through them is right to 3."""
    exact = np.arange(21) * 397.2
    ends = (np.round(exact / 7) * 7).astype(int)
    payloads = telemetry(np.diff(ends), rate_hz=397.2)
    log = read_gpmf(mux(tmp_path / "a.mp4", payloads))
    truth = np.arange(len(log.time_s)) / 397.2
    assert np.abs(log.time_s - truth).max() < 0.003
    assert np.ptp(np.diff(log.time_s)) < 1e-9


@pytest.mark.parametrize("with_total", [True, False])
def test_samples_are_counted_where_no_total_is_given(tmp_path, with_total):
    log = read_gpmf(mux(tmp_path / "a.mp4", telemetry([400, 400, 400, 40], with_total=with_total)))
    assert log.time_s == pytest.approx(np.arange(1240) / RATE_HZ, abs=1e-9)


def test_the_last_payload_may_last_longer_than_its_samples(tmp_path):
    """As GoPro writes it: 28 samples, said to last a second."""
    log = read_gpmf(mux(tmp_path / "a.mp4", telemetry([400, 400, 28])))
    assert log.time_s[-1] == pytest.approx(827 / RATE_HZ)


def test_one_payload_is_timed_by_its_length(tmp_path):
    log = read_gpmf(mux(tmp_path / "a.mp4", telemetry([200]), lengths_ms=[500]))
    assert log.time_s == pytest.approx(np.arange(200) / RATE_HZ, abs=1e-9)


def test_a_payload_that_is_lost_leaves_a_gap(tmp_path):
    payloads = telemetry([400] * 5)
    payloads[2] = payload(accelerometer())
    log = read_gpmf(mux(tmp_path / "a.mp4", payloads))
    assert log.omega_c == pytest.approx(omega(log.time_s), abs=0.51 / SCALE)
    assert np.isnan(log.mean(np.array(2.4), np.array(2.5))).all()
    assert np.isfinite(log.mean(np.array(3.4), np.array(3.5))).all()


def test_totals_that_lie_are_not_believed(tmp_path):
    payloads = [payload(gyro(stored(np.arange(k, k + 400) / RATE_HZ), total=2**32 - 1 - k)) for k in (0, 400, 800)]
    log = read_gpmf(mux(tmp_path / "a.mp4", payloads))
    assert log.time_s == pytest.approx(np.arange(1200) / RATE_HZ, abs=1e-9)


def test_stamps_of_the_camera_come_before_the_times_of_the_file(tmp_path):
    """The first frame was taken at 7.00 s of the camera's clock, the first sample 20 ms before; the file is coarse."""

    def stamps(total):
        return [number(b"STMP", b"J", "Q", round(1e6 * (6.98 + total / RATE_HZ)))]

    frames = nested(b"STRM", number(b"STMP", b"J", "Q", 7_000_000), number(b"SHUT", b"f", "f", 0.002))
    payloads = [nested(b"DEVC", data[8:], frames) for data in telemetry([400] * 4, first_s=-0.02, before=stamps)]
    log = read_gpmf(mux(tmp_path / "a.mp4", payloads, times_ms=[0, 1040, 1990, 3030]))
    assert log.time_s == pytest.approx(np.arange(1600) / RATE_HZ - 0.02, abs=1e-5)
    assert log.omega_c == pytest.approx(omega(log.time_s), abs=0.51 / SCALE)


def test_samples_that_are_not_uniform_follow_the_payloads_with_a_warning(tmp_path):
    payloads = telemetry([400, 400, 400, 400], with_total=False)
    with pytest.warns(RsUndistortWarning, match="not uniform in time"):
        log = read_gpmf(mux(tmp_path / "a.mp4", payloads, times_ms=[0, 1000, 4000, 5000]))
    assert log.time_s[[0, 400, 800, 1200]] == pytest.approx([0, 1, 4, 5], abs=1e-9)


def test_readout_of_newer_cameras_stands_once_beside_the_movie(tmp_path):
    """HERO8 and later: moov, udta, GPMF."""
    path = mux(tmp_path / "a.mp4", telemetry([400] * 2))
    assert read_gpmf(path).readout_s is None
    data = bytearray(path.read_bytes())
    stated = nested(b"DEVC", number(b"SROT", b"f", "f", 15.4))
    data += struct.pack(">I4s", 8 + len(stated), b"GPMF") + stated  # FFmpeg writes moov last, and udta last in it
    for name in (b"moov", b"udta"):
        at = data.rindex(name) - 4
        (size,) = struct.unpack(">I", data[at : at + 4])
        assert at + size + 8 + len(stated) == len(data)
        data[at : at + 4] = struct.pack(">I", size + 8 + len(stated))
    path.write_bytes(data)
    assert read_gpmf(path).readout_s == pytest.approx(0.0154)


# ---------------------------------------------------------------- damaged files


def test_files_without_a_gyroscope_are_refused_in_one_line(tmp_path):
    plain = mux(tmp_path / "plain.mp4", None)
    assert not has_telemetry(plain)
    with pytest.raises(FormatError, match=r"plain\.mp4 has no track of GoPro's telemetry; give"):
        read_gpmf(plain)
    with pytest.raises(FormatError, match=r"no gyroscope that can be read \(no GYRO in it\)"):
        read_gpmf(mux(tmp_path / "still.mp4", [payload(accelerometer())] * 2))
    with pytest.raises(FormatError, match=r"\(SCAL is 0\)"):
        read_gpmf(mux(tmp_path / "zero.mp4", [payload(gyro(COUNTS, scale=0))] * 2))
    with pytest.raises(FormatError, match="two samples"):
        read_gpmf(mux(tmp_path / "two.mp4", [payload(gyro(COUNTS[:1]))]))
    (tmp_path / "noise.mp4").write_bytes(bytes(range(256)) * 40)
    with pytest.raises(FileError, match=r"noise\.mp4 cannot be read as a video"):
        read_gpmf(tmp_path / "noise.mp4")
    assert not has_telemetry(tmp_path / "noise.mp4")
    with pytest.raises(FileError, match=r"none\.mp4"):
        read_gpmf(tmp_path / "none.mp4")


def test_damage_in_places_gives_the_rest_with_a_warning(tmp_path):
    payloads = telemetry([400] * 4)
    payloads[1] = payload(gyro(COUNTS, scale=0, total=800))
    payloads[3] = payloads[3][:1000]
    with pytest.warns(RsUndistortWarning, match=r"a\.mp4, telemetry: SCAL is 0; DEVC is cut short"):
        log = read_gpmf(mux(tmp_path / "a.mp4", payloads))
    assert 900 < len(log.time_s) < 1000
    assert log.omega_c == pytest.approx(omega(log.time_s), abs=0.51 / SCALE)


def test_a_file_cut_short_gives_what_it_has(tmp_path):
    """The index first, then payloads of which the last are missing."""
    path = mux(tmp_path / "a.mp4", telemetry([400] * 6))
    front = tmp_path / "front.mp4"
    with av.open(str(path)) as source, av.open(str(front), "w", options={"movflags": "faststart"}) as container:
        track = container.add_data_stream("bin_data")
        track.time_base = Fraction(1, 1000)
        for packet in source.demux(source.streams.data[0]):
            if packet.size:
                packet.stream = track
                container.mux(packet)
    front.write_bytes(front.read_bytes()[:-6000])
    with pytest.warns(RsUndistortWarning, match=r"it ends at [345]\.0 s of 6\.0 s|cut short"):
        log = read_gpmf(front)
    assert 1200 <= len(log.time_s) < 2400
    assert log.omega_c == pytest.approx(omega(log.time_s), abs=0.51 / SCALE)


def test_tags_in_another_encoding_are_no_obstacle(tmp_path):
    path = mux(tmp_path / "a.mp4", telemetry([400] * 2))
    data = path.read_bytes()
    at = data.rindex(b"Lavf")
    path.write_bytes(data[:at] + b"\x87\xfff" + data[at + 3 :])
    assert len(read_gpmf(path).time_s) == 800


def test_memory_follows_the_size_of_the_file(tmp_path):
    """65,535 samples are claimed by each of two hundred payloads, of which three are there."""
    lies = payload(
        nested(b"STRM", struct.pack(">4scBH", b"GYRO", b"s", 6, 65535) + COUNTS.astype(">i2").tobytes() + bytes(2))
    )
    path = mux(tmp_path / "a.mp4", [lies] * 200, times_ms=[8 * k for k in range(200)], lengths_ms=[8] * 200)
    tracemalloc.start()
    with pytest.warns(RsUndistortWarning, match="GYRO is cut short"):
        log = read_gpmf(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(log.time_s) == 600
    assert peak < 5e6  # the samples claimed would take 300 MB


@pytest.mark.parametrize(
    ("start_s", "says"), [([0.0, 0.0, 0.0], "do not increase"), ([2.0, 1.0, 0.0], "increase"), ([0, 9, 3], "run back")]
)
def test_times_that_do_not_increase_are_refused(start_s, says):
    payloads = [parse_payload(payload(gyro(COUNTS)))] * 3
    with pytest.raises(FormatError, match=says):
        _sample_times(payloads, np.array(start_s, float), np.ones(3))


# ---------------------------------------------------------------- real ones


@pytest.mark.parametrize(
    ("name", "count", "rms"),
    [("hero5", 399, 0.5), ("hero6", 204, 2.0), ("karma", 392, 0.3), ("Fusion", 3300, 1.0)],
)
def test_payloads_of_real_cameras(name, count, rms):
    path = SHARED / f"{name}.gpmf"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    found = parse_payload(path.read_bytes())
    assert len(found.rates) == count
    assert found.problems == ()
    assert 1e-3 < np.sqrt(np.mean(found.rates**2)) < rms
    assert np.linalg.det(found.orientation) == pytest.approx(1)


def test_a_real_video():
    path = SHARED / "gopro-hero5-gentle.mp4"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    log = read_gpmf(path)
    assert len(log.time_s) == 4795
    assert 1 / log.step_s == pytest.approx(397.2, abs=0.2)
    assert log.time_s[[0, -1]] == pytest.approx([0, 12.08], abs=0.02)  # the length of the video
    assert np.abs(log.omega_c).max() < 2
